"""Shifts change what they say, and nothing else."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from oracles import project

from palm_jax.envs import make, shifts
from palm_jax.envs.base import EnvParams
from palm_jax.envs.rollout import repeat_params
from palm_jax.envs.tasks import WORKSPACE_CENTRE


@pytest.fixture(scope="module")
def default() -> EnvParams:
    return make("lift_spam").default_params()


def changed(before: EnvParams, after: EnvParams) -> set[str]:
    names = [field.name for field in dataclasses.fields(EnvParams)]
    return {n for n in names if not np.array_equal(getattr(before, n), getattr(after, n))}


@pytest.mark.parametrize(
    ("shift", "fields"),
    [
        (shifts.workspace, {"object_low", "object_high"}),
        (shifts.viewpoint, {"camera_angle"}),
        (shifts.aligned_hand, {"align_hand"}),
        (lambda p: shifts.at_camera_angle(p, jnp.float32(0.2)), {"camera_angle"}),
        (lambda p: shifts.at_object(p, jnp.array([0.3, 0.1])), {"object_low", "object_high"}),
        (lambda p: shifts.shifted(p, "in_domain"), set()),
        (
            lambda p: shifts.shifted(p, "workspace+viewpoint"),
            {"object_low", "object_high", "camera_angle"},
        ),
    ],
)
def test_only_the_fields_of_a_shift_change(
    default: EnvParams, shift: Callable[[EnvParams], EnvParams], fields: set[str]
) -> None:
    after = jax.jit(shift)(default)
    assert changed(default, after) == fields
    before_types = [(x.shape, x.dtype) for x in jax.tree.leaves(default)]
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(after)] == before_types


def test_regions_and_angles_are_the_papers(default: EnvParams) -> None:
    np.testing.assert_allclose(default.object_high - default.object_low, [0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(default.object_low + default.object_high, [0.5, 0], atol=1e-6)
    shifted = shifts.shifted(default, "workspace+viewpoint")
    np.testing.assert_allclose(shifted.object_low, [0.05, -0.35], atol=1e-6)
    np.testing.assert_allclose(shifted.object_high, [0.45, 0.35], atol=1e-6)
    np.testing.assert_allclose(np.degrees(shifted.camera_angle), [-30, 30], atol=1e-4)


@pytest.mark.parametrize("shift", list(shifts.SHIFTS.values()))
def test_strength_scales_a_shift(default: EnvParams, shift: Callable[..., EnvParams]) -> None:
    assert changed(default, shift(default, strength=0.0)) == set()
    half, full = shift(default, strength=0.5), shift(default)
    for name in changed(default, full):
        start, middle, end = (np.asarray(getattr(p, name)) for p in (default, half, full))
        np.testing.assert_allclose(middle, (start + end) / 2, atol=1e-6)


@pytest.mark.parametrize("domain", ["wokspace", "workspace+lights", ""])
def test_unknown_shifts_list_the_known_ones(default: EnvParams, domain: str) -> None:
    with pytest.raises(ValueError, match="known: in_domain, workspace, viewpoint"):
        shifts.shifted(default, domain)


def test_every_domain_is_a_shift(default: EnvParams) -> None:
    seen = [jax.tree.leaves(shifts.shifted(default, domain)) for domain in shifts.DOMAINS]
    flat = {tuple(np.concatenate([np.ravel(x) for x in leaves])) for leaves in seen}
    assert len(flat) == len(shifts.DOMAINS) == 4


def test_viewpoint_turns_the_camera_about_the_workspace_centre() -> None:
    runner = worlds.runner("lift_spam")
    default = runner.env.default_params()
    angles = np.linspace(-0.5, 0.5, worlds.WORLDS).astype(np.float32)
    pinned = jax.vmap(shifts.at_camera_angle, in_axes=(None, 0))(default, jnp.asarray(angles))
    state = runner.reset(worlds.keys(3), pinned)
    np.testing.assert_allclose(state.camera_angle, angles, atol=1e-6)
    nominal, centre = np.asarray(default.camera_to_world, np.float64), np.array(WORKSPACE_CENTRE)
    for angle, pose in zip(angles, np.asarray(state.camera_to_world), strict=True):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        np.testing.assert_allclose(pose[:3, :3], turn @ nominal[:3, :3], atol=1e-6)
        expected = centre + turn @ (nominal[:3, 3] - centre)
        np.testing.assert_allclose(pose[:3, 3], expected, atol=1e-6)
    cameras = jax.vmap(runner.env.camera)(state, repeat_params(default, worlds.WORLDS))
    for matrix, pose in zip(cameras.K, cameras.cam_to_world, strict=True):
        uv, _ = project(matrix, pose, centre)
        np.testing.assert_allclose(uv, project(cameras.K[0], nominal, centre)[0], atol=1e-2)
