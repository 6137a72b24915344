"""What policies see is the aligned image of the full frame."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from oracles import crop, project, rotation_6d

from palm_jax.align import AlignSpec, align_window, window_origin
from palm_jax.envs.base import PAPER_FRAME, WIDE_FRAME, State
from palm_jax.render import render

PLAIN = dataclasses.replace(worlds.SPEC, overlay=False)


def assert_same_picture(one: jax.Array, other: jax.Array) -> None:
    """But for pixels at an edge, which rounding may put on either side: one in a thousand."""
    off = np.abs(np.asarray(one).astype(int) - np.asarray(other)).max(-1) > 1
    assert off.mean() <= 1e-3, off.sum()


@functools.cache
def observer(spec: AlignSpec, frame: int = WIDE_FRAME) -> Callable[[State, Any], Any]:
    """`Env.observe` of one world, compiled once."""
    env = worlds.runner("lift_spam").env
    return jax.jit(lambda state, params: env.observe(state, params, spec, frame=frame))


@pytest.fixture(scope="module")
def world() -> tuple[Any, State, Any]:
    """One world in mid-lift: (env, state, params), no batch axis."""
    env = worlds.runner("lift_spam").env
    states = worlds.expert_episodes("lift_spam")[0]
    state = jax.tree.map(lambda x: jnp.asarray(x[len(x) // 2, 3]), states)
    return env, state, env.default_params()


@pytest.mark.parametrize("frame", [WIDE_FRAME, PAPER_FRAME])
def test_an_observation_is_the_crop_of_the_full_frame(
    world: tuple[Any, State, Any], frame: int
) -> None:
    """Bit for bit: the window's pixels are those of the whole frame at the policy's resolution."""
    env, state, params = world
    camera = PLAIN.view_camera(env.camera(state, params, frame=frame))
    full = jax.jit(lambda s, p: render(env.scene(s, p), camera).rgb)(state, params)
    tcp = np.asarray(env.tcp(state))
    uv, _ = project(camera.K, camera.cam_to_world, tcp[:3, 3])
    offset = (0, 40 * PLAIN.size / PLAIN.crop)
    expected = crop(np.asarray(full), uv, PLAIN.size, offset)
    seen = observer(PLAIN, frame)(state, params)
    np.testing.assert_array_equal(seen.image, expected)
    assert seen.image.std() > 10 and seen.valid


def test_overlay_and_proprioception_are_those_of_align(world: tuple[Any, State, Any]) -> None:
    env, state, params = world
    spec = worlds.SPEC

    @jax.jit
    def draw(image: jax.Array, state: State, params: Any) -> Any:
        view, tcp = spec.view_camera(env.camera(state, params)), env.tcp(state)
        origin, _ = window_origin(view, tcp, spec)
        return align_window(image, view, origin, tcp, env.opening(state), spec)

    plain, seen = observer(PLAIN)(state, params), observer(spec)(state, params)
    drawn = draw(plain.image, state, params)
    assert_same_picture(seen.image, drawn.image)
    assert (np.asarray(seen.image) != np.asarray(plain.image)).any(-1).sum() > 50
    np.testing.assert_allclose(seen.proprio, plain.proprio, atol=1e-6)
    tcp, camera = np.asarray(env.tcp(state)), np.asarray(state.camera_to_world)
    expected = rotation_6d(camera[:3, :3].T @ tcp[:3, :3])
    np.testing.assert_allclose(seen.proprio[:6], expected, atol=1e-5)
    np.testing.assert_allclose(seen.proprio[6], tcp[2, 3], atol=1e-6)
    fingers = np.mean(np.asarray(state.data.qpos)[env._gripper_qpos]) / 0.04
    np.testing.assert_allclose(env.opening(state), fingers, atol=1e-5)


def test_batched_observations_are_those_of_each_world() -> None:
    """The Runner's one loop over all worlds draws what each world alone would be."""
    runner = worlds.runner("lift_spam")
    params = worlds.params(runner.env, "workspace+viewpoint")
    state = runner.reset(worlds.keys(11), params)
    batch = runner.observe(state, params, worlds.SPEC)
    single = observer(worlds.SPEC)
    for world in (0, 7):
        state_of, params_of = jax.tree.map(lambda x, w=world: x[w], (state, params))
        alone = single(state_of, params_of)
        assert_same_picture(batch.image[world], alone.image)
        np.testing.assert_allclose(batch.proprio[world], alone.proprio, atol=1e-6)


def test_full_frame_specs_need_no_crop(world: tuple[Any, State, Any]) -> None:
    env, state, params = world
    spec = AlignSpec(crop=None, size=64, overlay=False, layout="world6d_xyz", offset=(0, 0))
    seen = jax.jit(lambda s, p: env.observe(s, p, spec, frame=PAPER_FRAME))(state, params)
    full = jax.jit(lambda s, p: env.render(s, p, 64).rgb)(state, params)
    np.testing.assert_array_equal(seen.image, full)
    assert seen.proprio.shape == (spec.proprio_size,)


def test_a_hidden_robot_is_not_drawn(world: tuple[Any, State, Any]) -> None:
    env, state, params = world
    draw = jax.jit(lambda s, p: env.render(s, p, 128, outputs=("segmentation",)).segmentation)
    shown = np.asarray(draw(state, params))
    hidden = np.asarray(draw(state, dataclasses.replace(params, robot_visible=jnp.zeros(()))))
    model = env.mj_model
    robot = set(env.scene_model.geoms[env.scene_model.robot].tolist())
    names = {model.geom(g).name for g in robot}
    assert {"hand_body", "left_finger_tip", "base_foot"} <= names and "spam_can" not in names
    is_robot = np.isin(shown, list(robot))
    assert is_robot.sum() > 100
    assert not np.isin(hidden, list(robot)).any()
    np.testing.assert_array_equal(hidden[~is_robot], shown[~is_robot])


def test_params_reach_the_picture(world: tuple[Any, State, Any]) -> None:
    """Lights and colours are leaves: each changes what is drawn."""
    env, state, params = world
    draw = jax.jit(lambda s, p: env.render(s, p, 64).rgb)
    base = np.asarray(draw(state, params)).astype(int)
    for name in ("light_ambient", "light_diffuse", "geom_rgb"):
        darker = dataclasses.replace(params, **{name: 0.5 * getattr(params, name)})
        assert np.asarray(draw(state, darker)).astype(int).mean() < base.mean() - 3, name
    narrow = dataclasses.replace(params, camera_fovy=0.5 * params.camera_fovy)
    assert (np.asarray(draw(state, narrow)) != base).any(-1).mean() > 0.3


def test_restored_states_look_like_the_recorded_ones() -> None:
    """Demonstrations are states: their pictures are made later, and are the same."""
    runner = worlds.runner("lift_spam")
    params = worlds.params(runner.env, "workspace+viewpoint")
    state = runner.reset(worlds.keys(12), params)
    state = runner.step(state, runner.expert(state), params)
    restored = runner.restore(
        state.data.qpos,
        state.data.mocap_pos,
        state.data.mocap_quat,
        state.camera_to_world,
        params,
    )
    then = runner.observe(state, params, worlds.SPEC)
    now = runner.observe(restored, params, worlds.SPEC)
    assert_same_picture(now.image, then.image)
    np.testing.assert_allclose(now.proprio, then.proprio, atol=1e-6)
