"""An evaluation as the training command does it: 8 domains x 50 scenes, after compilation.

The policy is an untrained width-16 network, so that every episode takes its whole horizon: the
worst case. Each piece is waited for, which costs little and tells where the time goes.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs import make, shifts
from palm_jax.envs.registry import TASKS
from palm_jax.envs.rollout import Act, Runner
from palm_jax.train.config import Config
from palm_jax.train.evaluate import Evaluator, Runners
from palm_jax.train.learner import LearnerConfig, Normalizer, PolicyState, Range, make_learner
from palm_jax.train.methods import find

Clock = dict[str, float]


def timed(clock: Clock, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, with the seconds until its results are there added to `clock[name]`."""

    def call(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        result = jax.block_until_ready(function(*arguments, **options))
        clock[name] = clock.get(name, 0.0) + time.perf_counter() - start
        return result

    return call


class TimedRunner(Runner):
    """A runner that notes where time goes."""

    def __init__(self, task: str, robot: str, worlds: int, clock: Clock) -> None:
        super().__init__(make(task, robot), worlds)
        self.step = timed(clock, "physics", self.step)
        self.reset = timed(clock, "reset", self.reset)  # type: ignore[method-assign]
        self.observe = timed(clock, "render", self.observe)  # type: ignore[method-assign]


@dataclasses.dataclass(frozen=True)
class TimedEvaluator(Evaluator):
    """An evaluator that notes the policy's time."""

    clock: Clock = dataclasses.field(default_factory=dict)

    def act(self, policy: PolicyState, rows: np.ndarray | None = None) -> Act:
        return timed(self.clock, "policy", super().act(policy, rows))


def run(*, task: str = "lift_spam", scenes: int = 50, horizon: int | None = None) -> dict[str, Any]:
    """Seconds of the whole evaluation, and of its parts."""
    clock: Clock = {}
    config, method = Config(task=task), find("palm")
    runners = Runners(
        lambda robot: TimedRunner(task, robot, scenes, clock), config.robot, config.second_robot
    )
    size = method.spec(TASKS[task], 84).proprio_size
    learner = make_learner(LearnerConfig(width=16), size)
    ranges = [Range(jnp.full(n, -0.01), jnp.full(n, 0.01)) for n in (size, 10)]
    state = jax.jit(learner.init)(jax.random.key(0), Normalizer(*ranges))
    policy = learner.policy_state(state)
    evaluator = TimedEvaluator(runners, method, learner, 84, clock)
    whole = TASKS[task]

    def evaluate(steps: int) -> int:
        total = 0
        for domain in shifts.DOMAINS:
            runners.domain(domain).env.task = dataclasses.replace(whole, horizon=steps)
            record = evaluator.domain(policy, domain, seed=0, count=scenes, aligned=True)
            total += int(record.length.sum())
        return total

    start = time.perf_counter()
    evaluate(1)
    first = time.perf_counter() - start
    clock.clear()
    start = time.perf_counter()
    steps = evaluate(horizon or whole.horizon)
    seconds = time.perf_counter() - start
    return {
        "seconds": seconds,
        "parts": {**clock, "rest": seconds - sum(clock.values())},
        "control_steps_per_second": steps / seconds,
        "first_call_seconds": first,
        "task": task,
        "scenes": scenes,
        "domains": list(shifts.DOMAINS),
        "robots": [runners.robot, runners.other],
        "horizon": horizon or whole.horizon,
        "width": learner.config.width,
    }
