"""Params that describe no possible world are refused by name, before anything is simulated."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from palm_jax.envs import shifts
from palm_jax.envs.base import front_camera
from palm_jax.envs.params import (
    MAX_DISTRACTORS,
    TABLE_HIGH,
    TABLE_LOW,
    EnvParams,
    ParamsError,
    check_params,
    repeat_params,
    take_params,
)

FIELDS = [field.name for field in dataclasses.fields(EnvParams)]


@pytest.fixture(scope="module")
def default() -> EnvParams:
    return worlds.runner("lift_spam").env.default_params()


def camera_at(x: float, y: float, z: float) -> np.ndarray:
    pose = front_camera()
    pose[:3, 3] = (x, y, z)
    return pose


def mirrored() -> np.ndarray:
    return front_camera() * np.array([-1.0, 1.0, 1.0, 1.0])


def transposed() -> np.ndarray:
    return front_camera().T


BAD: list[tuple[str, Any, str]] = [
    ("camera_to_world", camera_at(1.35, 0, 0.70), "a camera above the table .* got .*0.7"),
    ("camera_to_world", camera_at(0.30, 0.1, 0.95), "a camera outside the workspace"),
    ("camera_to_world", mirrored(), "orthonormal, right-handed"),
    ("camera_to_world", 1.1 * np.eye(4) - np.diag([0, 0, 0, 0.1]), "orthonormal, right-handed"),
    ("camera_to_world", transposed(), r"last row \(0, 0, 0, 1\)"),
    ("camera_fovy", 0.7, "1 to 170 degrees, got 0.7; convert radians"),
    ("camera_fovy", 180.0, "1 to 170 degrees, got 180.0"),
    ("camera_angle", [0.2, -0.2], r"low at most high, got \[0.2, -0.2\]; swap"),
    ("camera_angle", [-30.0, 30.0], "at most a whole turn, .* convert degrees"),
    ("camera_radius", [0.0, 1.0], "positive factors"),
    ("camera_radius", [-1.2, -0.8], "positive factors"),
    ("camera_radius", [1.2, 0.8], "low at most high"),
    ("calibration_rotation", [3.0, 0.0, 0.0], "at most pi / 2 radians, .* convert degrees"),
    ("object_low", [0.36, -0.1], r"at most object_high = \[0.35, 0.1\] in x and in y"),
    ("object_high", [0.35, 0.8], "a place on the table, x -0.4 to 0.7 and y -0.75 to 0.75 m"),
    ("object_low", [-0.5, -0.1], "a place on the table"),
    ("area_low", [0.1, 0.3], "at most area_high"),
    ("area_high", [0.9, 0.3], "a place on the table"),
    ("distractors", -1.0, f"a whole number from 0 to {MAX_DISTRACTORS}, got -1"),
    ("distractors", MAX_DISTRACTORS + 1.0, "a whole number from 0 to"),
    ("distractors", 1.5, "a whole number .* got 1.5; round it"),
    ("object_yaw", [0.5, -0.5], "low at most high"),
    ("start_radius", -0.01, "at least 0 m, got -0.01"),
    ("start_height", [[0.2, 0.1]], r"low at most high, got \[\[0.2, 0.1\]\]"),
    ("start_height", [[-0.1, 0.2]], "heights above the table of at least 0 m"),
    ("start_yaw", [0.1, 0.0], "low at most high"),
    ("align_hand", 2.0, r"0 \(no\) to 1 \(yes\), got 2.0"),
    ("robot_visible", -0.5, r"0 \(no\) to 1 \(yes\)"),
    ("light_ambient", [0.3, -0.1, 0.3], "intensities of at least 0"),
    ("light_diffuse", [[0.5, 0.5, 0.5], [-1, 0, 0]], "intensities of at least 0"),
    ("light_direction", [[0, 0, 0], [0, 0, -1]], "directions of any length above 0"),
    ("table_rgb", [255.0, 0, 0], "colours from 0 to 1, got .* divide by 255"),
    ("table_rgb2", [0.5, -0.1, 0], "colours from 0 to 1"),
    ("table_scale", 0.0, "a width above 0 m"),
]


@pytest.mark.parametrize(("field", "value", "message"), BAD)
def test_what_contradicts_itself_is_refused_by_name(
    default: EnvParams, field: str, value: Any, message: str
) -> None:
    """One world, and the third of a batch: the message then says which."""
    bad = dataclasses.replace(default, **{field: jnp.asarray(value, jnp.float32)})
    with pytest.raises(ParamsError, match=f"^EnvParams.{field}: expected .*{message}"):
        check_params(bad)
    several = jax.tree.map(lambda good, worse: jnp.stack([good, good, worse, good]), default, bad)
    with pytest.raises(ParamsError, match=f"^EnvParams.{field} .world 2.: expected .*{message}"):
        check_params(several)


def test_a_colour_of_a_geom_is_checked(default: EnvParams) -> None:
    bad = dataclasses.replace(default, geom_rgb=default.geom_rgb.at[3, 1].set(1.2))
    with pytest.raises(ParamsError, match="geom_rgb: expected colours from 0 to 1"):
        check_params(bad)


def test_a_camera_may_not_come_too_near(default: EnvParams) -> None:
    """The nominal place is fine, a quarter of its distance is in the workspace."""
    near = dataclasses.replace(default, camera_radius=jnp.array([0.25, 1.0]))
    with pytest.raises(ParamsError, match=r"camera_radius \[0.25, 1.0\].*raise camera_radius"):
        check_params(near)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_no_field_may_be_infinite(default: EnvParams, field: str, value: float) -> None:
    leaf = getattr(default, field)
    bad = dataclasses.replace(default, **{field: leaf.at[(0,) * leaf.ndim].set(value)})
    with pytest.raises(ParamsError, match=f"EnvParams.{field}: expected finite numbers"):
        check_params(bad)


@pytest.mark.parametrize("field", FIELDS)
def test_every_field_has_its_shape(default: EnvParams, field: str) -> None:
    bad = dataclasses.replace(default, **{field: getattr(default, field)[None]})
    with pytest.raises(ParamsError, match=r"expected shape \[.*got \["):
        check_params(bad)
    mixed = dataclasses.replace(repeat_params(default, 4), **{field: getattr(default, field)})
    with pytest.raises(ParamsError, match=r"expected shape \[.*got \["):
        check_params(mixed)


@pytest.mark.parametrize("task", worlds.TASKS)
def test_what_the_package_makes_is_accepted(task: str) -> None:
    default = worlds.runner(task).env.default_params()
    check_params(default)
    check_params(repeat_params(repeat_params(default, 3), 2))
    for name, shift in (shifts.SHIFTS | shifts.AXES).items():
        for strength in shifts.strength_range(name):
            check_params(shift(default, strength=strength))


def test_traced_params_pass(default: EnvParams) -> None:
    """Under jit nobody can look: no error, and no failure to trace."""

    @jax.jit
    def traced(params: EnvParams) -> jax.Array:
        check_params(params)
        return params.camera_fovy

    assert traced(dataclasses.replace(default, camera_fovy=jnp.float32(500))) == 500


def test_runners_check_before_they_simulate(default: EnvParams) -> None:
    bad = dataclasses.replace(default, table_scale=jnp.float32(-1))
    runner = worlds.runner("lift_spam")
    with pytest.raises(ParamsError, match="table_scale .world 0.: expected a width above 0 m"):
        runner.reset(worlds.keys(0), repeat_params(bad, worlds.WORLDS))


def test_the_table_is_where_the_model_has_it() -> None:
    model = worlds.runner("lift_spam").env.mj_model
    top = model.geom("table_top")
    np.testing.assert_allclose(TABLE_LOW, (top.pos - top.size)[:2], atol=1e-9)
    np.testing.assert_allclose(TABLE_HIGH, (top.pos + top.size)[:2], atol=1e-9)


def test_params_are_repeated_and_taken(default: EnvParams) -> None:
    many = jax.tree.map(lambda x: x + jnp.arange(5.0).reshape(5, *[1] * x.ndim), default)
    rows = np.array([3, 1])
    for name in FIELDS:
        leaf, some = getattr(default, name), getattr(take_params(many, rows), name)
        np.testing.assert_allclose(some, np.stack([leaf + 3, leaf + 1]), rtol=1e-6)
        assert getattr(repeat_params(default, 5), name).shape == (5, *leaf.shape)
