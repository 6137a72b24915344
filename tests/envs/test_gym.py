"""The Gymnasium adapter: Gymnasium's checkers, its own vector environment, and the plain Runner."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest
import worlds
from contracts import compilations

from palm_jax.align import AlignSpec, proprio
from palm_jax.envs import shifts

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env, data_shares_objects  # noqa: E402
from gymnasium.wrappers.vector import (  # noqa: E402
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    TransformObservation,
)

from palm_jax.envs.adapters import gym_env  # noqa: E402
from palm_jax.envs.adapters.gym_env import PalmEnv, PalmVectorEnv, make_env, make_vec  # noqa: E402

MODES = ("NextStep", "SameStep")
TASK = "lift_spam"


def vector(**options: Any) -> PalmVectorEnv:
    return PalmVectorEnv(worlds.runner(TASK), spec=worlds.SPEC, **options)


def single(**options: Any) -> PalmEnv:
    return make_env(TASK, spec=worlds.SPEC, **options)


def moves(seed: int, steps: int) -> np.ndarray:
    """Small random motions [T, W, 10]."""
    rng = np.random.default_rng(seed)
    action = np.zeros((steps, worlds.WORLDS, 10), np.float32)
    action[..., 0] = action[..., 4] = 1.0
    action[..., 6:9] = rng.uniform(-0.01, 0.01, (steps, worlds.WORLDS, 3))
    action[..., 9] = rng.integers(0, 2, (steps, worlds.WORLDS))
    return action


def assert_same(one: Any, other: Any, where: str) -> None:
    """Equal but for rounding: the same keys, types, shapes and dtypes; edges move by a pixel."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            assert_same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, np.ndarray):
        assert one.shape == other.shape and one.dtype == other.dtype, where
        if one.dtype == object:
            for i, pair in enumerate(zip(one, other, strict=True)):
                assert_same(*pair, f"{where}[{i}]")
        elif one.dtype == np.uint8:
            assert (np.abs(one.astype(int) - other).max(-1) > 3).mean() < 0.005, where
        else:
            np.testing.assert_allclose(one, other, atol=1e-4, err_msg=where)
    else:
        assert one == other, where


@pytest.mark.slow
def test_gymnasiums_checker_has_nothing_to_say() -> None:
    """Warnings are errors here."""
    for mode in (None, "rgb_array"):
        env = gymnasium.make(f"palm_jax/{TASK}-v0", render_mode=mode)
        check_env(env.unwrapped)
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_one_program_equals_gymnasiums_own_vector_env(mode: str) -> None:
    """Observations, rewards, ends and infos (masks included), over ends of episodes."""
    one = vector(horizon=3, autoreset_mode=mode)
    other = gymnasium.vector.SyncVectorEnv(
        [functools.partial(single, horizon=3)] * worlds.WORLDS, autoreset_mode=mode
    )
    assert one.single_observation_space == other.single_observation_space
    assert one.observation_space == other.observation_space
    assert one.action_space == other.action_space
    assert one.metadata == other.metadata
    seeds = [7, 7, *range(worlds.WORLDS - 2)]
    for seed in (5, seeds):
        starts = one.reset(seed=seed), other.reset(seed=seed)
        for name, pair in zip(("obs", "infos"), zip(*starts, strict=True), strict=True):
            assert_same(*pair, f"{name} of reset({seed})")
        for t, action in enumerate(moves(0, 7)):
            results = one.step(action), other.step(action)
            names = ("obs", "reward", "terminated", "truncated", "infos")
            for name, pair in zip(names, zip(*results, strict=True), strict=True):
                assert_same(*pair, f"{name} of step {t}")
            ends = (2, 6) if mode == "NextStep" else (2, 5)
            assert results[0][3].all() == (t in ends), t
    seen = one.reset(seed=seeds)[0]["proprio"]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])


def expert_episode(envs: Any, steps: int) -> tuple[np.ndarray, np.ndarray, list[dict[str, Any]]]:
    """The expert in (wrapped) worlds: rewards [T, W], terminations [T, W], infos."""
    base = envs.unwrapped
    rewards, terminations, infos = [], [], []
    for _ in range(steps):
        action = np.array(base.runner.expert(base.state))
        space = base.action_space
        assert (np.maximum(space.low - action, action - space.high) < 1e-5).all()
        obs, reward, terminated, truncated, info = envs.step(action)
        assert obs["image"] in base.observation_space["image"]
        assert not truncated.any()
        rewards.append(reward)
        terminations.append(terminated)
        infos.append(info)
    return np.stack(rewards), np.stack(terminations), infos


@pytest.mark.parametrize("mode", MODES)
def test_the_expert_is_rewarded_once_an_episode(mode: str) -> None:
    """Gymnasium's statistics are those of the plain runner from the same start."""
    envs = RecordEpisodeStatistics(vector(autoreset_mode=mode))
    envs.reset(seed=3, options={"domain": "workspace"})
    runner, params = worlds.runner(TASK), worlds.params(worlds.runner(TASK).env, "workspace")
    state = envs.unwrapped.state
    np.testing.assert_allclose(state.camera_angle, 0.0)
    solved = []
    for _ in range(runner.env.task.horizon - 1):
        state = runner.step(state, runner.expert(state), params)
        solved.append(np.asarray(state.success))
        if solved[-1].all():
            break
    lengths = np.where(solved[-1], np.argmax(solved, 0) + 1, 0)
    assert solved[-1].sum() >= worlds.WORLDS - 1
    rewards, terminations, infos = expert_episode(envs, len(solved))
    np.testing.assert_array_equal(rewards, terminations)
    for world, length in enumerate(lengths):
        if length:
            assert rewards[: length - 1, world].sum() == 0 and rewards[length - 1, world] == 1
            episode = infos[length - 1]["episode"]
            assert (episode["r"][world], episode["l"][world]) == (1.0, length)
            ended = infos[length - 1] if mode == "NextStep" else infos[length - 1]["final_info"]
            assert ended["success"][world] and ended["_success"][world]
    # The next episodes start elsewhere, in the same domain.
    again = envs.unwrapped.state.object_start
    moved = np.abs(np.asarray(again - state.object_start)).max(-1) > 1e-3
    early = (lengths > 0) & (lengths < len(solved))
    assert moved[early].all()


def test_episodes_do_not_depend_on_the_neighbours() -> None:
    """World 0 has the same second episode, whether the others have ended or not."""
    second = []
    for neighbours_end in (False, True):
        envs = vector(autoreset_mode="SameStep")
        envs.reset(seed=4)
        action = moves(1, 1)[0]
        action[0, 6] = np.nan  # ends world 0
        if neighbours_end:
            for _ in range(2):
                ended = action.copy()
                ended[:, 6] = np.where(np.arange(worlds.WORLDS) > 0, np.nan, 0.0)
                envs.step(ended)
        envs.step(action)
        second.append(np.asarray(envs.state.object_start))
    np.testing.assert_array_equal(second[0][0], second[1][0])
    assert not np.array_equal(second[0][1], second[1][1])


def test_diverged_physics_terminates_without_a_reward() -> None:
    envs = vector()
    envs.reset(seed=0)
    action = moves(2, 1)[0]
    action[2, 6] = np.nan
    obs, reward, terminated, truncated, infos = envs.step(action)
    expected = np.arange(worlds.WORLDS) == 2
    np.testing.assert_array_equal(terminated, expected)
    np.testing.assert_array_equal(infos["nan"], expected)
    assert not reward.any() and not truncated.any() and not infos["success"].any()
    assert obs["proprio"] in envs.observation_space["proprio"]
    _, _, terminated, _, infos = envs.step(moves(2, 1)[0])
    assert not terminated.any() and not infos["nan"].any()


def test_wrappers_that_want_a_mode_find_it() -> None:
    envs = NormalizeReward(vector())
    envs.reset(seed=1)
    assert np.isfinite(envs.step(moves(3, 1)[0])[1]).all()
    one = vector()
    only = TransformObservation(
        one,
        lambda obs: obs["proprio"],
        single_observation_space=one.single_observation_space["proprio"],
        observation_space=one.observation_space["proprio"],
    )
    obs, _ = NormalizeObservation(only).reset(seed=1)
    assert obs.shape == (worlds.WORLDS, 8) and np.abs(obs.mean(0)).max() < 0.1


def test_data_belongs_to_the_caller() -> None:
    envs = vector()
    calls = [envs.reset(seed=0)]
    for action in moves(4, 2):
        obs, *_, info = envs.step(action)
        calls.append((obs, info))
    for one, other in zip(calls, calls[1:], strict=False):
        assert not data_shares_objects(one, other)
        assert all(array.flags.writeable for array in one[0].values())


def test_options_hold_until_the_next_reset() -> None:
    envs = vector(horizon=1, autoreset_mode="SameStep")
    limit = shifts.MAX_CAMERA_ANGLE

    def turns() -> np.ndarray:
        return np.abs(np.asarray(envs.state.camera_angle))

    envs.reset(seed=0, options={"domain": "viewpoint"})
    first = turns()
    envs.step(moves(5, 1)[0])
    assert (first > 0).all() and (turns() > 0).all() and not np.array_equal(first, turns())
    envs.reset(options={})
    assert (turns() == 0).all()
    one = shifts.at_camera_angle(envs.runner.env.default_params(), limit)
    with compilations() as names:
        envs.reset(options={"params": one})
        envs.step(moves(5, 1)[0])
    assert not {"place", "locate", "reposition", "step", "observe"} & set(names)
    np.testing.assert_allclose(turns(), limit, rtol=1e-6)
    each = jax.vmap(lambda angle: shifts.at_camera_angle(one, angle))(
        np.linspace(0.1, 0.4, worlds.WORLDS, dtype=np.float32)
    )
    envs.reset(options={"params": each})
    np.testing.assert_allclose(turns(), np.linspace(0.1, 0.4, worlds.WORLDS), rtol=1e-6)
    envs.step(moves(5, 1)[0])
    np.testing.assert_allclose(turns(), np.linspace(0.1, 0.4, worlds.WORLDS), rtol=1e-6)


def test_every_episode_has_its_own_scene() -> None:
    """A world's place on an axis is drawn anew with its episode, and only then."""
    envs = vector(domain="field_of_view", autoreset_mode="SameStep")
    envs.reset(seed=0)
    first = np.asarray(envs.params.camera_fovy)
    assert len(set(first.tolist())) == worlds.WORLDS
    action = moves(6, 1)[0]
    action[0, 6] = np.nan
    image = envs.step(action)[0]["image"]
    seen = envs.runner.observe(envs.state, envs.params, worlds.SPEC)
    np.testing.assert_array_equal(image, seen.image)
    now = np.asarray(envs.params.camera_fovy)
    np.testing.assert_array_equal(now[1:], first[1:])
    assert now[0] != first[0]
    envs.reset(seed=0)
    np.testing.assert_array_equal(envs.params.camera_fovy, first)


def test_frames_of_every_world() -> None:
    envs = vector(render_mode="rgb_array")
    envs.reset(seed=0)
    frames = envs.render()
    assert len(frames) == worlds.WORLDS
    size = gym_env.RENDER_SIZE
    assert all(f.shape == (size, size, 3) and f.dtype == np.uint8 for f in frames)
    assert len({f.tobytes() for f in frames}) == worlds.WORLDS


def test_proprioception_is_bounded_for_every_layout() -> None:
    envs = vector()
    envs.reset(seed=0, options={"domain": "workspace+viewpoint"})
    params = worlds.params(worlds.runner(TASK).env, "workspace+viewpoint")
    env, state = envs.runner.env, envs.state
    camera = jax.vmap(env.camera)(state, params)
    tcp, opening = jax.vmap(env.tcp)(state), jax.vmap(env.opening)(state)
    for layout, size in {"cam6d_z": 8, "world6d_xyz": 10, "cam6d_xyz": 10, "z": 2}.items():
        spec = AlignSpec(crop=200, size=16, layout=layout)
        space = gym_env.observation_space(env, spec)["proprio"]
        assert space.shape == (size,) and space.is_bounded()
        for row in np.asarray(
            jax.vmap(functools.partial(proprio, layout=layout))(tcp, opening, camera)
        ):
            assert row in space


def test_gymnasium_finds_the_vector_env() -> None:
    envs = gymnasium.make_vec(f"palm_jax/{TASK}-v0", num_envs=3, horizon=5)
    assert isinstance(envs, PalmVectorEnv) and envs.num_envs == 3
    assert envs.spec.id == f"palm_jax/{TASK}-v0"
    assert envs.observation_space["image"].shape == (3, 84, 84, 3)
    assert make_vec(TASK, num_envs=3).runner is envs.runner  # compiled once


def test_bad_input_is_told() -> None:
    for wrong, message in [
        ({"autoreset_mode": "Disabled"}, "expected 'NextStep' or 'SameStep'"),
        ({"render_mode": "human"}, "expected None or 'rgb_array', got 'human'"),
        ({"horizon": 0}, "at least one control step"),
        ({"domain": "workspace+embodiment"}, "pass its name as robot=, and the domain 'workspace'"),
    ]:
        with pytest.raises(ValueError, match=message):
            vector(**wrong)
    envs = vector()
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        envs.step(moves(0, 1)[0])
    with pytest.raises(gymnasium.error.Error, match="pass render_mode='rgb_array'"):
        envs.render()
    blind = dataclasses.replace(envs.runner.env.default_params(), camera_fovy=np.float32(0.0))
    two = jax.tree.map(lambda x: x[:2], worlds.params(envs.runner.env))
    for reset, message in [
        ({"seed": [1, 2]}, "a list of 16, got a list of 2"),
        ({"options": {"size": 3}}, r"expected domain or params, got \['size'\]"),
        ({"options": {"domain": "nowhere"}}, "unknown shift 'nowhere'"),
        ({"options": {"domain": "embodiment"}}, "robot=, and the domain 'in_domain'"),
        ({"options": {"params": blind}}, "camera_fovy: expected 1 to 170 degrees"),
        ({"options": {"params": two}}, r"of 16 .*got camera_fovy of shape \[2\]"),
    ]:
        with pytest.raises(ValueError, match=message):
            envs.reset(**reset)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"expected \[16, 10\], got \[16, 9\]"):
        envs.step(moves(0, 1)[0][:, :9])
    with pytest.raises(ValueError, match="a Runner with one world, got 16"):
        PalmEnv(worlds.runner(TASK))
    with pytest.raises(ValueError, match="unknown task 'knot'"):
        make_vec("knot")
