"""The Playground adapter under Playground's own wrappers, next to the plain Runner."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds

from palm_jax.envs import physics

playground = pytest.importorskip("mujoco_playground")

from palm_jax.envs.adapters.playground_env import PlaygroundEnv, make_env  # noqa: E402

TASK = "lift_spam"
HALF = worlds.WORLDS // 2
COMPARED = 10  # control steps; once the pads touch the object, rounding grows


def raw_keys(seed: int) -> jax.Array:
    """What Playground passes around: uint32 [W, 2]."""
    return jax.random.split(jax.random.PRNGKey(seed), worlds.WORLDS)


@functools.cache
def env(domain: str = "in_domain", vision: bool = False) -> PlaygroundEnv:
    return PlaygroundEnv(worlds.runner(TASK).env, domain=domain, spec=worlds.SPEC, vision=vision)


def wrapped(**options: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """(reset, step) of the training wrapper, compiled."""
    env_ = playground.wrapper.wrap_for_brax_training(env(), **options)
    return physics.jit_physics(env_.reset), physics.jit_physics(env_.step)


def expert(state: Any) -> jax.Array:
    return worlds.runner(TASK).expert(jax.vmap(env().world)(state))


def runner_start(state: Any) -> Any:
    """The plain runner's start from the key that a wrapper gave to the environment."""
    keys = jax.random.wrap_key_data(state.info["rng"])
    return worlds.runner(TASK).reset(keys, state.info["params"])


def assert_same_physics(one: Any, other: Any, where: str, rows: Any = slice(None)) -> None:
    for name, atol in {"qpos": 1e-4, "ctrl": 1e-4, "qvel": 1e-3}.items():
        np.testing.assert_allclose(
            getattr(one, name)[rows], getattr(other, name)[rows], atol=atol, err_msg=where
        )


@pytest.mark.slow
def test_training_wrapper_gives_the_runners_physics_and_restarts() -> None:
    """The expert twice: solved, put back to the cached start by the wrapper, solved again."""
    runner, params = worlds.runner(TASK), worlds.params(env()._env)
    reset, step = wrapped(episode_length=100)
    state = first = reset(raw_keys(0))
    plain = runner_start(state)
    assert_same_physics(state.data, plain.data, "reset")
    assert state.obs.keys() == {"state"}
    seen = runner.observe(plain, params, worlds.SPEC)
    np.testing.assert_allclose(state.obs["state"], seen.proprio, atol=1e-4)

    running = np.ones(worlds.WORLDS, bool)
    rewards = np.zeros(worlds.WORLDS)
    for t in range(190):
        action = expert(state)
        state = step(state, action)
        if t < COMPARED:
            plain = runner.step(plain, action, params)
            assert_same_physics(state.data, plain.data, f"step {t}")
            seen = runner.observe(plain, params, worlds.SPEC)
            np.testing.assert_allclose(state.obs["state"], seen.proprio, atol=1e-4)
        rewards += np.asarray(state.reward)
        np.testing.assert_array_equal(state.done, state.metrics["success"])
        ended = np.asarray(state.done) > 0
        # The wrapper shows the first state again at once.
        assert_same_physics(state.data, first.data, f"end in step {t}", ended)
        np.testing.assert_array_equal(state.obs["state"][ended], first.obs["state"][ended])
        assert not np.asarray(state.info["truncation"]).any()
        running &= rewards < 2
        if not running.any():
            break
    assert running.sum() <= 1 and (rewards[~running] >= 2).all()
    assert np.isfinite(state.data.qpos).all()


@pytest.mark.slow
def test_truncation_and_divergence_end_an_episode() -> None:
    reset, step = wrapped(episode_length=3)
    state = first = reset(raw_keys(1))
    action = np.array(expert(state))
    seen = []
    for _ in range(6):
        state = step(state, action)
        seen.append(state)
    ends = [bool(np.all(one.done == 1.0)) for one in seen]
    assert ends == [False, False, True, False, False, True]
    assert [bool(np.all(one.info["truncation"] == 1.0)) for one in seen] == ends
    np.testing.assert_array_equal(seen[2].data.qpos, first.data.qpos)
    # The second episode repeats the first: nothing of it was left behind.
    for one, other in zip(seen[:2], seen[3:5], strict=True):
        np.testing.assert_array_equal(one.data.qpos, other.data.qpos)
        np.testing.assert_array_equal(one.info["episode"].step, other.info["episode"].step)
    assert np.abs(seen[1].data.qpos - first.data.qpos).max() > 1e-3

    action[3, 6] = np.nan
    state = step(reset(raw_keys(1)), action)
    expected = (np.arange(worlds.WORLDS) == 3).astype(np.float32)
    np.testing.assert_array_equal(state.done, expected)
    np.testing.assert_array_equal(state.metrics["nan"], expected)
    assert not np.asarray(state.reward).any() and np.isfinite(state.data.qpos).all()
    action[3, 6] = 0.0
    assert not np.asarray(step(state, action).done).any()


SLIPPERY, HEAVY = slice(HALF, HALF + 4), slice(HALF + 4, None)


def randomise(model: Any) -> tuple[Any, Any]:
    """The first half of the worlds as they are, some slippery, the others heavy."""
    friction = jnp.tile(model.pair_friction, (worlds.WORLDS, 1, 1))
    mass = jnp.tile(model.body_mass, (worlds.WORLDS, 1))
    changed = {
        "pair_friction": friction.at[SLIPPERY, :, :2].mul(0.01),
        "body_mass": mass.at[HEAVY].mul(1.5),
    }
    axes = jax.tree.map(lambda _: None, model).tree_replace(dict.fromkeys(changed, 0))
    return model.tree_replace(changed), axes


@pytest.mark.slow
def test_randomised_friction_and_masses_change_what_happens() -> None:
    """Worlds with nominal values follow the plain runner; slippery objects are not lifted; heavy
    arms move otherwise; and nothing traced stays behind in the environment."""
    runner, params = worlds.runner(TASK), worlds.params(env()._env)
    reset, step = wrapped(episode_length=100, randomization_fn=randomise)
    state = reset(raw_keys(2))
    plain = runner_start(state)
    assert_same_physics(state.data, plain.data, "reset")
    rewards = np.zeros(worlds.WORLDS)
    for t in range(95):
        action = expert(state)
        state = step(state, action)
        if t < COMPARED:
            plain = runner.step(plain, action, params)
            assert_same_physics(state.data, plain.data, f"step {t}", slice(HALF))
        if t == 0:
            off = np.abs(np.asarray(state.data.qvel - plain.data.qvel)).max(-1)
            assert (off[HEAVY] > 1e-3).all(), off
        rewards += np.asarray(state.reward)
    assert (rewards[:HALF] >= 1).sum() >= HALF - 1
    assert not rewards[SLIPPERY].any()
    assert env().mjx_model is env()._env.mjx_model


@pytest.mark.slow
def test_a_full_reset_draws_a_new_scene() -> None:
    reset, step = wrapped(episode_length=1, full_reset=True)
    state = reset(raw_keys(4))
    start = state.info["start"].object_start
    state = step(state, expert(state))
    assert np.all(state.done == 1.0)
    moved = np.abs(np.asarray(state.info["start"].object_start - start)).max(-1)
    assert (moved > 1e-4).all()
    assert not np.asarray(state.info["episode"].step).any()


@pytest.mark.slow
def test_images_are_the_runners_and_every_reset_has_its_scene() -> None:
    one = env("viewpoint+field_of_view", vision=True)
    state = physics.jit_physics(jax.vmap(one.reset))(raw_keys(5))
    params = state.info["params"]
    assert len(set(np.asarray(params.camera_fovy).tolist())) == worlds.WORLDS
    np.testing.assert_array_equal(params.camera_angle[0], params.camera_angle[1])
    plain = runner_start(state)
    seen = worlds.runner(TASK).observe(plain, params, worlds.SPEC)
    image = np.asarray(state.obs["pixels/view_0"])
    assert image.dtype == np.float32 and image.shape == (worlds.WORLDS, 84, 84, 3)
    off = np.abs(image * 255 - np.asarray(seen.image)).max(-1) > 3
    assert off.mean() < 0.005
    assert image.min() >= 0.0 and 0.5 < image.max() <= 1.0


def test_properties_are_playgrounds() -> None:
    one = env()
    assert isinstance(one, playground.MjxEnv) and one.unwrapped is one
    assert one.action_size == 10 and one.observation_size == {"state": (8,)}
    assert env("viewpoint+field_of_view", vision=True).observation_size == {
        "state": (8,),
        "pixels/view_0": (84, 84, 3),
    }
    assert (one.dt, one.sim_dt, one.n_substeps) == (0.05, 0.005, 10)
    assert one.mj_model.nq == one.mjx_model.nq
    assert one.xml_path.endswith("lift_spam.xml")
    typed = jax.eval_shape(one.reset, jax.random.key(0))
    raw = jax.eval_shape(one.reset, jax.random.PRNGKey(0))
    assert typed.data.qpos.shape == raw.data.qpos.shape == (one.mj_model.nq,)
    for domain, message in [
        ("nowhere", "unknown shift 'nowhere'"),
        ("embodiment", "pass its name as robot="),
    ]:
        with pytest.raises(ValueError, match=message):
            make_env(TASK, domain=domain)
