"""Physics steps of 5 ms a second: MJX as the environments run it, and C MuJoCo beside it."""

import os
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import rollout

from benchmarks.common import measure
from palm_jax.envs import TASKS, make, physics
from palm_jax.envs.base import Env
from palm_jax.envs.rollout import repeat_params

SUBSTEPS = 10


def run(*, worlds: tuple[int, ...] = (64, 128), repeats: int = 10) -> dict[str, Any]:
    """Steps/s by task and worlds; `steps_per_second` is the best of lift_spam."""
    tasks = {task: _task(make(task), worlds, repeats) for task in TASKS}
    best = max(figures["mjx"]["per_second"] for figures in tasks["lift_spam"].values())
    return {"steps_per_second": best, "tasks": tasks, "substeps": SUBSTEPS, "timestep": 0.005}


def _task(env: Env, worlds: tuple[int, ...], repeats: int) -> dict[str, Any]:
    return {str(count): _batch(env, count, repeats) for count in worlds}


def _batch(env: Env, worlds: int, repeats: int) -> dict[str, Any]:
    keys = jax.random.split(jax.random.key(0), worlds)
    params = repeat_params(env.default_params(), worlds)
    data = physics.jit_physics(jax.vmap(env.place))(keys, params).data
    step = physics.jit_physics(jax.vmap(lambda d: physics.substeps(env.mjx_model, d, SUBSTEPS)))
    items = worlds * SUBSTEPS
    mjx = measure(lambda: step(data), repeats=repeats, items=items)
    return {"mjx": mjx, "mujoco.rollout": _rollout(env, data, repeats, items)}


def _rollout(env: Env, data: Any, repeats: int, items: int) -> dict[str, float]:
    """The same steps of the same states by C MuJoCo, one thread a core."""
    model, c = env.mj_model, mujoco.MjData(env.mj_model)
    physics_state = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    inputs = (
        mujoco.mjtState.mjSTATE_CTRL.value
        | mujoco.mjtState.mjSTATE_MOCAP_POS.value
        | mujoco.mjtState.mjSTATE_MOCAP_QUAT.value
    )

    def read(spec: int) -> np.ndarray:
        state = np.zeros(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, c, state, spec)
        return state

    states, controls = [], []
    for world in range(len(data.qpos)):
        c.qpos[:], c.ctrl[:] = data.qpos[world], data.ctrl[world]
        c.mocap_pos[:] = np.reshape(data.mocap_pos[world], (-1, 3))
        c.mocap_quat[:] = np.reshape(data.mocap_quat[world], (-1, 4))
        states.append(read(physics_state))
        controls.append(np.tile(read(inputs), (SUBSTEPS, 1)))
    threads = os.cpu_count() or 1
    pieces = [mujoco.MjData(model) for _ in range(threads)]
    with rollout.Rollout(nthread=threads) as pool:
        figures = measure(
            lambda: pool.rollout(
                model, pieces, np.stack(states), np.stack(controls), control_spec=inputs
            ),
            repeats=repeats,
            items=items,
        )
    return {**figures, "threads": threads}
