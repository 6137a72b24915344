"""Bulk episodes: the two executions agree, nothing is compiled twice, and the contract holds."""

import dataclasses
from collections import Counter
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from contracts import check_env, compilations

from palm_jax.align import Aligned, AlignSpec
from palm_jax.envs import physics, shifts
from palm_jax.envs.registry import TASKS
from palm_jax.envs.rollout import Runner, scan_episodes
from palm_jax.train.evaluate import Evaluator, Runners
from palm_jax.train.learner import LearnerConfig, Normalizer, Range, make_learner
from palm_jax.train.methods import find


def steer(key: jax.Array, images: jax.Array, proprio: jax.Array) -> jax.Array:
    """A deterministic policy [B, 10] that depends on everything it sees, smoothly."""
    del key
    colour = images.astype(jnp.float32).mean((1, 2)) / 255 - 0.5
    rotation = jnp.tile(jnp.array([1.0, 0, 0, 0, 1.0, 0]), (len(images), 1))
    move = 0.01 * (colour + 0.3 * proprio[:, :3])
    closed = jnp.zeros((len(images), 1))
    return jnp.concatenate([rotation, move, closed], -1)


@pytest.mark.long
@pytest.mark.slow
def test_one_scan_gives_the_runners_episodes() -> None:
    """Outcomes are equal, and the states that the policy sees agree to rounding."""
    runner, horizon = worlds.runner("lift_spam"), 6
    params = worlds.params(runner.env, "workspace+viewpoint")
    seen: list[Any] = []

    def look(images: jax.Array, proprio: jax.Array) -> None:
        seen.append((np.asarray(images), np.asarray(proprio)))

    def act(key: jax.Array, images: jax.Array, proprio: jax.Array) -> jax.Array:
        jax.debug.callback(look, images, proprio, ordered=True)
        return steer(key, images, proprio)

    def scanned(key: jax.Array, keys: jax.Array, params: Any) -> Any:
        return scan_episodes(runner.env, key, keys, params, act, worlds.SPEC, horizon=horizon)

    one = runner.run(jax.random.key(0), worlds.keys(20), params, act, worlds.SPEC, horizon=horizon)
    jax.effects_barrier()
    of_runner, seen = seen, []
    other = physics.jit_physics(scanned)(jax.random.key(0), worlds.keys(20), params)
    jax.effects_barrier()
    for name, left, right in zip(one._fields, one, other, strict=True):
        np.testing.assert_allclose(left, right, atol=1e-5, err_msg=name)
    assert len(of_runner) == len(seen) == horizon
    for t, (left, right) in enumerate(zip(of_runner, seen, strict=True)):
        np.testing.assert_allclose(left[1], right[1], atol=1e-4, err_msg=f"step {t}")
        # An edge may move by a pixel, and few pixels are edges.
        off = np.abs(left[0].astype(int) - right[0]).max(-1) > 3
        assert off.mean() < 0.005, t
    assert np.abs(seen[-1][1] - seen[0][1]).max() > 0.005  # something moved


def test_the_expert_as_a_policy_is_stopped_when_all_have_ended() -> None:
    """`run` latches lengths, ends early, and shows every state to `watch`."""
    runner = worlds.runner("lift_spam")
    params = worlds.params(runner.env, "workspace")
    states: list[Any] = []

    def act(key: jax.Array, images: jax.Array, proprio: jax.Array) -> jax.Array:
        return runner.expert(states[-1])

    found = runner.run(
        jax.random.key(0), worlds.keys(100), params, act, worlds.SPEC, watch=states.append
    )
    recorded = worlds.expert_episodes("lift_spam")[0]
    np.testing.assert_array_equal(found.success, recorded.success[-1])
    expected = np.where(recorded.success[-1], recorded.success.argmax(0), runner.env.task.horizon)
    np.testing.assert_array_equal(found.length, expected)
    if recorded.success[-1].all():
        assert len(states) == found.length.max() + 1 < runner.env.task.horizon
    np.testing.assert_allclose(found.object_xy, recorded.object_start[0, :, :2], atol=1e-6)
    assert not found.nan.any() and found.seen.all()


def test_batches_beyond_the_limit_are_refused() -> None:
    env = worlds.runner("lift_spam").env
    for count in (0, physics.MAX_CPU_WORLDS + 1):
        if jax.default_backend() == "cpu":
            with pytest.raises(ValueError, match=f"expected 1 to 128 worlds .* got {count}"):
                Runner(env, count)


def untrained(task: str) -> tuple[Evaluator, Any]:
    """The evaluator of a tiny policy on both robots, and its parameters."""
    method, runners = find("palm"), Runners(partial(worlds.runner, task), "panda", "ur5")
    spec = method.spec(TASKS[task], 84)
    config = LearnerConfig(width=2, crop=76, embed=4, hidden=(8,))
    learner = make_learner(config, spec.proprio_size)
    ranges = [Range(jnp.full(n, -0.01), jnp.full(n, 0.01)) for n in (spec.proprio_size, 10)]
    state = jax.jit(learner.init)(jax.random.key(0), Normalizer(*ranges))
    return Evaluator(runners, method, learner, 84), learner.policy_state(state)


@pytest.mark.slow
def test_all_domains_compile_each_piece_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain is data: after a robot's first one nothing is compiled, whatever shifts."""
    evaluator, policy = untrained("lift_spam")
    for domain in ("in_domain", "embodiment"):
        env = evaluator.runners.domain(domain).env
        monkeypatch.setattr(env, "task", dataclasses.replace(env.task, horizon=3))
    count = worlds.WORLDS + 3  # one whole batch, and one that is filled up
    robots: set[bool] = set()
    for domain in (*shifts.DOMAINS, "workspace+lighting+distractors"):
        with compilations() as names:
            record = evaluator.domain(policy, domain, seed=0, count=count, aligned=True)
        pieces = Counter(name for name in names if name in PIECES)
        robot = shifts.other_robot(domain)
        # The policy is compiled once for both robots.
        most = Counter({**dict.fromkeys(PIECES, 1), "act": 1 if robots else 2})
        assert pieces <= most and (robot not in robots or not pieces), pieces
        robots.add(robot)
        assert record.success.shape == (count,) and not record.nan.any()
        assert (record.length == 3).all() and (record.draws >= 1).all()
    assert robots == {False, True}


PIECES = {"place", "locate", "reposition", "observe", "act"}
"""Names of what is compiled; both the environment's step and the policy are an `act`."""


@pytest.mark.parametrize("task", worlds.TASKS)
def test_environments_keep_the_contract(task: str) -> None:
    check_env(worlds.runner(task), jax.random.key(30), worlds.SPEC)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ToyState:
    x: jax.Array  # [3]
    step: jax.Array  # int32 []
    reachable: jax.Array  # bool []


class Toy:
    """The smallest environment that keeps the contract; `fault` breaks one promise."""

    action_size = 10
    task = SimpleNamespace(stages=("the only one",))

    def __init__(self, fault: str = "") -> None:
        self.fault = fault

    def default_params(self) -> jax.Array:
        return jnp.ones(2)

    def place(self, key: jax.Array, params: jax.Array) -> ToyState:
        x = jax.random.normal(key, (3,))
        return ToyState(x, jnp.zeros((), jnp.int32), jnp.ones((), bool))

    def locate(self, state: ToyState, params: jax.Array) -> ToyState:
        return state

    def reposition(self, key: jax.Array, state: ToyState, params: jax.Array) -> ToyState:
        return state

    def expert(self, state: ToyState) -> jax.Array:
        return jnp.zeros(10)

    restore = expert

    jump = locate

    def act(self, state: ToyState, action: jax.Array) -> ToyState:
        x = state.x + action[6:9]
        if self.fault == "nan":
            x = jnp.where(state.step == 2, jnp.nan, x)
        if self.fault == "dtype":
            return ToyState(x, (state.step + 1).astype(jnp.float32), state.reachable)
        return ToyState(x, state.step + 1, state.reachable)

    def observe(self, state: ToyState, params: Any, spec: AlignSpec, *, frame: int) -> Aligned:
        image = jnp.clip(128 + 40 * state.x, 0, 255) * (self.fault != "same worlds")
        image = jnp.broadcast_to(image, (spec.size, spec.size, 3))
        dtype = jnp.float32 if self.fault == "image" else jnp.uint8
        return Aligned(image.astype(dtype), state.x, jnp.ones((), bool))


class Forgetful(Runner):
    """Compiles its step anew at every call."""

    def __init__(self, env: Any, worlds: int) -> None:
        super().__init__(env, worlds)
        self._act = lambda *arguments: jax.jit(jax.vmap(env.act))(*arguments)


class Unseeded(Runner):
    """Draws other scenes from the same key."""

    def reset(self, keys: jax.Array, params: Any) -> Any:
        self.count = getattr(self, "count", -1) + 1
        return super().reset(jax.vmap(lambda k: jax.random.fold_in(k, self.count))(keys), params)


def toy(fault: str, kind: type[Runner] = Runner) -> Runner:
    env: Any = Toy(fault)
    return kind(env, 4)


SMALL = AlignSpec(crop=8, size=8)


def test_pieces_are_counted_by_name() -> None:
    """The budget above counts something."""
    runner = toy("")
    params = jnp.ones((4, 2))
    with compilations() as names:
        state = runner.reset(jax.random.split(jax.random.key(0), 4), params)
        runner.step(state, jnp.zeros((4, 10)), params)
        runner.step(state, jnp.ones((4, 10)), params)
        runner.observe(state, params, SMALL)
    assert sorted(name for name in names if name in PIECES) == sorted(PIECES)


def test_a_sound_toy_passes() -> None:
    check_env(toy(""), jax.random.key(0), SMALL)


@pytest.mark.parametrize(
    ("fault", "kind", "message"),
    [
        ("nan", Runner, "not finite after step 2"),
        ("dtype", Runner, "shapes or dtypes change"),
        ("image", Runner, "float32"),
        ("same worlds", Runner, "worlds look the same"),
        ("", Forgetful, "compiled"),
        ("", Unseeded, "two resets with one key differ"),
    ],
)
def test_broken_environments_are_found_out(fault: str, kind: type[Runner], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_env(toy(fault, kind), jax.random.key(0), SMALL)
