"""The same episodes in C MuJoCo: its physics, the environment's own servo, stages and success."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from palm_jax.envs import physics, tree
from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner

SUBSTEPS = 10


class Steps(NamedTuple):
    """Where the hand was, and what had been reached, T control steps of W worlds long."""

    tcp: np.ndarray  # [T, W, 3] metres, after each step
    success: np.ndarray  # bool [T, W]
    nan: np.ndarray  # bool [T, W]


class Replay:
    """W worlds whose physics is C MuJoCo's.

    C MuJoCo advances the joints by the ten substeps of a control step; everything else (expert,
    inverse kinematics, contacts that tasks read, stages, success) is the environment's code on a
    state with those joints.

    Args:
      runner: gives the environment, the batch and the expert.
    """

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        env = runner.env
        self._servo = physics.jit_physics(jax.vmap(env.servo))
        self._judge = physics.jit_physics(jax.vmap(lambda *args: _judged(env, *args)))

    def __call__(self, start: State, params: EnvParams, horizon: int) -> Steps:
        """The expert's episodes from `start` [W]; ends early once all worlds are done.

        Args:
          start: as `Runner.reset` gives it.
          params: leading axis [W].
          horizon: most control steps.
        """
        runner, state, found = self.runner, start, []
        worlds = [_c_data(runner.env.mj_model, start, world) for world in range(runner.worlds)]
        for _ in range(horizon):
            ctrl = np.asarray(self._servo(state, runner.expert(state)))
            last, now = _advance(runner.env.mj_model, worlds, ctrl)
            state = self._judge(state, jnp.asarray(ctrl), last, now)
            jumped = np.asarray(state.jump)
            if jumped.any():
                state = runner.jump(state, params)
                for world in np.flatnonzero(jumped):
                    _write(worlds[world], state, int(world))
            found.append(
                jax.tree.map(np.asarray, (_tcp(runner.env, state), state.success, state.nan))
            )
            if (found[-1][1] | found[-1][2]).all():
                break
        return Steps(*(np.stack(field) for field in zip(*found, strict=True)))


class _Joints(NamedTuple):
    """Of W worlds."""

    qpos: np.ndarray  # [W, nq]
    qvel: np.ndarray  # [W, nv]


def _tcp(env: Env, state: State) -> jax.Array:
    return jax.vmap(env.tcp)(state)[:, :3, 3]


def _judged(env: Env, state: State, ctrl: jax.Array, last: _Joints, now: _Joints) -> State:
    """`Env.judge` of what C MuJoCo gave. Like MJX's, contacts are those that the last substep
    started with, poses agree with the final joints."""
    data = state.data.replace(qpos=last.qpos, qvel=last.qvel, ctrl=ctrl)
    data = mjx.collision(env.mjx_model, tree.kinematics(env.mjx_model, data))
    data = tree.kinematics(env.mjx_model, data.replace(qpos=now.qpos, qvel=now.qvel))
    return env.judge(state, data)


def _c_data(model: mujoco.MjModel, state: State, world: int) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.mocap_pos[:] = np.reshape(state.data.mocap_pos[world], (-1, 3))
    data.mocap_quat[:] = np.reshape(state.data.mocap_quat[world], (-1, 4))
    _write(data, state, world)
    return data


def _write(data: mujoco.MjData, state: State, world: int) -> None:
    data.qpos[:], data.qvel[:] = state.data.qpos[world], state.data.qvel[world]
    data.qacc_warmstart[:] = 0.0


def _advance(
    model: mujoco.MjModel, worlds: list[mujoco.MjData], ctrl: np.ndarray
) -> tuple[_Joints, _Joints]:
    """One control step: the joints before the last substep, and after it."""
    pair = []
    for data, control in zip(worlds, ctrl, strict=True):
        data.ctrl[:] = control
        mujoco.mj_step(model, data, nstep=SUBSTEPS - 1)
        before = (data.qpos.astype(np.float32), data.qvel.astype(np.float32))
        mujoco.mj_step(model, data)
        pair.append((before, (data.qpos.astype(np.float32), data.qvel.astype(np.float32))))
    stack: Any = jax.tree.map(lambda *rows: np.stack(rows), *pair)
    return _Joints(*stack[0]), _Joints(*stack[1])


def compare(pairs: Sequence[tuple[Steps, Steps]]) -> dict[str, Any]:
    """How far two executions of the same episodes agree.

    Args:
      pairs: MJX's and C MuJoCo's, one pair a batch.

    Returns:
      worlds by outcome, and the distance (metres) of the two hands at the end of the episode that
      ended first.
    """
    solved, drifts = [], []
    for pair in pairs:
        solved.append([steps.success[-1] & ~steps.nan[-1] for steps in pair])
        first = np.min([length(steps.success | steps.nan) for steps in pair], axis=0) - 1
        mjx_tcp, c_tcp = (steps.tcp[first, np.arange(len(first))] for steps in pair)
        drifts.append(np.linalg.norm(mjx_tcp - c_tcp, axis=-1))
    ours, theirs = np.concatenate(solved, axis=1)
    drift = np.concatenate(drifts)
    return {
        "both": int((ours & theirs).sum()),
        "only_mjx": int((ours & ~theirs).sum()),
        "only_c": int((~ours & theirs).sum()),
        "neither": int((~ours & ~theirs).sum()),
        "drift_median_m": float(np.median(drift)),
        "drift_worst_m": float(drift.max()),
    }


def length(done: np.ndarray) -> np.ndarray:
    """Control steps int [W] up to and with the first at which done [T, W], or T."""
    return np.where(done.any(0), done.argmax(0) + 1, len(done))
