"""Environments that are compiled once for all tests, and episodes that several tests look at."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import AlignSpec
from palm_jax.envs import make, shifts
from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner, repeat_params

WORLDS = 16
"""Worlds of every batch: another number would compile everything again."""

SPEC = AlignSpec(crop=200, offset=(0, 40), size=84)
"""The observation that the tests share."""

TASKS = ("lift_spam", "lift_lid")

CASES = (
    ("lift_spam", "panda"),
    ("lift_lid", "panda"),
    ("lift_spam", "ur5"),
    ("lift_spam", "xarm7"),
)
"""Tasks and robots whose experts are looked at."""


def runner(task: str, robot: str = "panda") -> Runner:
    """The one runner of a task on a robot."""
    return _runner(task, robot)


@functools.cache
def _runner(task: str, robot: str) -> Runner:
    return Runner(make(task, robot), WORLDS)


def params(env: Env, domain: str = "in_domain") -> EnvParams:
    """Params of a whole batch."""
    return repeat_params(shifts.shifted(env.default_params(), domain), WORLDS)


def keys(seed: int) -> jax.Array:
    return jax.random.split(jax.random.key(seed), WORLDS)


def stack(trees: list[Any]) -> Any:
    """Pytrees one after the other along a new first axis, in host memory."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def expert_episodes(task: str, robot: str = "panda") -> tuple[State, ...]:
    """The expert without noise in the test region: for each batch the states [T, W, ...].

    An episode goes on after its success until all of its batch have ended.
    """
    batches = 3 if len(runner(task, robot).env.task.stages) == 1 else 2
    return _expert_episodes(task, robot, batches)


@functools.cache
def _expert_episodes(task: str, robot: str, batches: int) -> tuple[State, ...]:
    one = runner(task, robot)
    episodes = []
    for seed in range(batches):
        p = params(one.env, "workspace")
        state = one.reset(keys(100 + seed), p)
        states = [state]
        for _ in range(one.env.task.horizon):
            state = one.step(state, one.expert(state), p)
            states.append(state)
            if bool(jnp.all(state.success | state.nan)):
                break
        episodes.append(stack(states))
    return tuple(episodes)


def tcp(env: Env, states: State) -> np.ndarray:
    """TCP poses [..., 4, 4] of stacked states, read from the site."""
    site = env.mj_model.site("tcp").id
    position = np.asarray(states.data.site_xpos)[..., site, :]
    pose = np.zeros((*position.shape[:-1], 4, 4))
    pose[..., :3, :3] = np.asarray(states.data.site_xmat)[..., site, :, :].reshape(
        *position.shape[:-1], 3, 3
    )
    pose[..., :3, 3], pose[..., 3, 3] = position, 1.0
    return pose


def gaps(env: Env, states: State) -> dict[tuple[str, str], np.ndarray]:
    """Smallest distance [...] between each pair of geoms in contact range (1 m where none is)."""
    contact = states.data._impl.contact
    geoms, distance = np.asarray(contact.geom), np.asarray(contact.dist)
    found = {}
    for first, second in {tuple(pair) for pair in geoms.reshape(-1, 2).tolist()}:
        if min(first, second) < 0:  # MJX fills up unused rows
            continue
        same = (geoms[..., 0] == first) & (geoms[..., 1] == second)
        names = (env.mj_model.geom(first).name, env.mj_model.geom(second).name)
        found[names] = np.where(same, distance, 1.0).min(-1)
    return found
