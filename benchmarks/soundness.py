"""What episodes say about physics: slip of held objects, depth of contacts, worlds that diverge."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner

_RISEN = 0.005  # metres above where the pads took it: from here on the hand alone carries it
_MAX_MOVE, _MAX_TURN = 0.015, 0.1  # of a random action: metres and radians, per axis
_TOGGLE = 0.1  # share of the steps in which a pushing hand commands its gripper the other way


class Seen(NamedTuple):
    """What is kept of the states of W worlds; stacked, every field is [T + 1, W, ...]."""

    tcp: np.ndarray  # [W, 4, 4]
    position: np.ndarray  # [W, B, 3] of the movable bodies, metres
    geoms: np.ndarray  # int [W, C, 2] of each contact, -1 where there is none
    distance: np.ndarray  # [W, C] metres
    success: np.ndarray  # bool [W]
    nan: np.ndarray  # bool [W]


def watcher(env: Env) -> Callable[[State], Seen]:
    """(states [W]) -> `Seen` in host memory."""
    bodies = np.array([env.mj_model.body(name).id for name in env.task.movable])

    @jax.jit
    def look(state: State) -> Seen:
        contact = state.data._impl.contact
        return Seen(
            tcp=jax.vmap(env.tcp)(state),
            position=state.data.xpos[:, bodies],
            geoms=contact.geom,
            distance=contact.dist,
            success=state.success,
            nan=state.nan,
        )

    return lambda state: jax.tree.map(np.asarray, look(state))


# -- the expert ------------------------------------------------------------------------------------


def held(env: Env, seen: Seen) -> np.ndarray:
    """bool [T + 1, W, B]: whether both pads touch the body."""
    pads = [env.mj_model.geom(name).id for name in env.robot.pads]
    touch = seen.distance < 0.0
    result = np.zeros(seen.position.shape[:-1], bool)
    for index, name in enumerate(env.task.movable):
        geoms = np.flatnonzero(env.mj_model.geom_bodyid == env.mj_model.body(name).id)
        body = np.isin(seen.geoms, geoms).any(-1) & touch
        result[..., index] = np.all(
            [(body & (seen.geoms == pad).any(-1)).any(-1) for pad in pads], axis=0
        )
    return result


def largest_slip(env: Env, seen: Seen, length: np.ndarray, worlds: np.ndarray) -> float:
    """The largest way (metres) of a carried body in the hand's frame.

    Counted from the moment the hand alone carries it (5 mm above where the pads took it) to the
    moment they let go. `length` [W]: control steps of each episode; `worlds`: which to look at.
    """
    rotation, centre = seen.tcp[..., :3, :3], seen.tcp[..., :3, 3]
    inside = np.einsum("twji,twbj->twbi", rotation, seen.position - centre[:, :, None])
    grip, worst = held(env, seen), 0.0
    for world in worlds:
        for body in range(grip.shape[-1]):
            steps = slice(0, length[world] + 1)
            for first, last in _runs(grip[steps, world, body]):
                height = seen.position[first:last, world, body, 2]
                carried = inside[first:last, world, body][height > height[0] + _RISEN]
                if len(carried):
                    worst = max(worst, float(np.linalg.norm(carried - carried[0], axis=-1).max()))
    return worst


def _runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """[first, last) of every stretch of True in flags [T]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def deepest(
    env: Env, seen: Seen, length: np.ndarray, worlds: np.ndarray
) -> dict[str, dict[str, Any]]:
    """The deepest contact (metres) of each category, and the pair of geoms that it is of."""
    found: dict[str, dict[str, Any]] = {}
    before_end = np.arange(len(seen.nan))[:, None] <= length[None]
    inside = before_end & np.isin(np.arange(len(length)), worlds)
    depth = np.where(inside[..., None], -seen.distance, 0.0)
    pairs = {tuple(sorted(pair)) for pair in np.unique(seen.geoms.reshape(-1, 2), axis=0).tolist()}
    for first, second in sorted(pairs):
        if first < 0:  # MJX fills up unused rows
            continue
        same = np.isin(seen.geoms, (first, second)).all(-1)
        value = float(np.where(same, depth, 0.0).max())
        names = [env.mj_model.geom(geom).name for geom in (first, second)]
        category = "-".join(sorted(_kind(env, name) for name in names))
        if category not in found or value > found[category]["depth_m"]:
            found[category] = {"depth_m": value, "pair": names}
    return found


def _kind(env: Env, geom: str) -> str:
    if geom in (*env.robot.pads, *env.robot.tips):
        return "finger"
    body = env.mj_model.body(env.mj_model.geom(geom).bodyid[0]).name
    return "object" if body in env.task.movable else "support"


# -- random actions --------------------------------------------------------------------------------

RANDOM = ("random", "pushing")
"""Kinds of random actions: every step drawn anew; or in one direction all the time, so that most
hands end up pressing on the table or on an object."""


def random_episodes(
    runner: Runner, kind: str, params: EnvParams, episodes: int, *, steps: int, seed: int = 0
) -> dict[str, Any]:
    """Counts worlds that diverge under actions that nobody would train on.

    Args:
      runner: W worlds at a time.
      kind: one of `RANDOM`.
      params: leading axis [W].
      episodes, steps: how many and how long.
      seed: of scenes and actions.
    """
    worlds, model = runner.worlds, runner.env.mj_model
    free = [int(model.body(name).dofadr[0]) for name in runner.env.task.movable]
    draw = jax.jit(_random_actions, static_argnames=("count", "kind"))
    nan, fast = np.zeros(0, bool), np.zeros(0)
    for batch in range(-(-episodes // worlds)):
        scene_key, key = jax.random.split(jax.random.fold_in(jax.random.key(seed), batch))
        state = runner.reset(jax.random.split(scene_key, worlds), params)
        fastest = np.zeros(worlds)
        for t in range(steps):
            action = draw(key, jnp.int32(t), count=worlds, kind=kind)
            state = runner.step(state, action, params)
            speed = [np.linalg.norm(state.data.qvel[:, i : i + 3], axis=-1) for i in free]
            fastest = np.maximum(fastest, np.max(speed, axis=0))
        nan, fast = np.append(nan, state.nan), np.append(fast, fastest)
    return {
        "episodes": episodes,
        "steps": steps,
        "nan": int(nan[:episodes].sum()),
        "object_faster_than_3_m_s": int((fast[:episodes] > 3.0).sum()),
    }


def _random_actions(key: jax.Array, step: jax.Array, *, count: int, kind: str) -> jax.Array:
    """Actions [count, 10] of one step. `key` is the episode's."""
    move_key, turn_key, grip_key, bias_key = jax.random.split(key, 4)
    fresh = [
        jax.random.uniform(jax.random.fold_in(k, step), (count, 3), minval=-1.0)
        for k in (move_key, turn_key)
    ]
    coin = jax.random.uniform(jax.random.fold_in(grip_key, step), (count,))
    if kind == "random":
        move, turn = fresh
        gripper = coin < 0.5
    else:
        biased = jax.random.uniform(bias_key, (3, count, 3), minval=-1.0)
        move = jnp.clip(biased[0] + 0.3 * fresh[0], -1.0, 1.0)
        turn = 0.3 * (biased[1] + fresh[1])
        gripper = (biased[2, :, 0] > 0.0) ^ (coin < _TOGGLE)
    x, y, z = jnp.moveaxis(_MAX_TURN * turn, -1, 0)
    one = jnp.ones(count)
    # Columns one and two of I + [turn]x; `step` makes them a rotation.
    rotation = jnp.stack([one, z, -y, -z, one, x], -1)
    return jnp.concatenate([rotation, _MAX_MOVE * move, gripper[:, None]], -1)
