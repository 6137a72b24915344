"""Physics steps of 5 ms a second: MJX as the environments run it, C MuJoCo and plain MJX beside it;
and how long an environment takes to compile."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import mjx, rollout

from benchmarks.common import measure
from palm_jax.envs import ROBOTS, TASKS, make, physics
from palm_jax.envs.base import Env
from palm_jax.envs.rollout import repeat_params

SUBSTEPS = 10
_PEER = "mujoco.rollout"

_WORLDS: dict[str, tuple[int, ...]] = {
    "cpu": (64, physics.MAX_CPU_WORLDS),
    "gpu": (1024, 4096, 16384),
}

COMPILED = ("lift_spam", "panda")
"""The task and the robot whose compile time is measured."""

_TASKS = tuple(name for name, task in TASKS.items() if task.robot_visible)
"""Those whose physics is their own: a robot that is not drawn moves as one that is."""

_COMPILE_CACHE = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
}


def run(*, worlds: tuple[int, ...] | None = None, repeats: int = 10) -> dict[str, Any]:
    """Steps/s by robot and task; `steps_per_second` is that of lift_spam on panda at the number of
    worlds that is best.

    `worlds` are tried there; `robots` has every task on every robot at the last of them.
    """
    worlds = worlds or _WORLDS.get(jax.default_backend(), _WORLDS["gpu"])
    robots: dict[str, dict[str, dict[str, Any]]] = {}
    for robot in ROBOTS:
        robots[robot] = {}
        for task in _TASKS:
            counts = worlds if (task, robot) == COMPILED else worlds[-1:]
            robots[robot][task] = _task(make(task, robot), counts, repeats)
            _report(task, robot, robots[robot][task][str(worlds[-1])])
    by_worlds = robots[COMPILED[1]][COMPILED[0]]
    rows = by_worlds.values()
    best = {name: max(row[name]["per_second_median"] for row in rows) for name in ("mjx", _PEER)}
    plain = _plain_mjx(make("lift_spam"))
    return {
        "steps_per_second": best["mjx"],
        "peers": {
            _PEER: {"steps_per_second": best[_PEER]},
            "mjx.step, default options": {"steps_per_second": plain["per_second_median"]},
        },
        "plain_mjx": plain,
        "by_worlds": by_worlds,
        "robots": {
            robot: {task: row[str(worlds[-1])] for task, row in by_task.items()}
            for robot, by_task in robots.items()
        },
        "compile": compile_seconds(*COMPILED, worlds=worlds[-1]),
        "substeps": SUBSTEPS,
        "timestep": 0.005,
    }


def _report(task: str, robot: str, figures: dict[str, dict[str, float]]) -> None:
    """A row of the table for people, on stderr: stdout is the JSON."""
    ours, theirs = (figures[name]["per_second_median"] for name in ("mjx", _PEER))
    print(
        f"  {task:<22} {robot:<6} MJX {ours:>8.0f} steps/s   C MuJoCo {theirs:>8.0f} steps/s",
        file=sys.stderr,
        flush=True,
    )


def compile_seconds(task: str, robot: str, *, worlds: int) -> dict[str, Any]:
    """Seconds until the first `reset` and `step` of a new process are done (imports left out): with
    an empty folder of compiled programs, and with the one that this leaves."""
    found: dict[str, Any] = {"task": task, "robot": robot, "worlds": worlds}
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, **_COMPILE_CACHE, "JAX_COMPILATION_CACHE_DIR": folder}
        for name in ("cold_seconds", "warm_seconds"):
            words = [sys.executable, "-m", "benchmarks.first_step", task, robot, str(worlds)]
            done = subprocess.run(
                words,
                env=environment,
                cwd=Path(__file__).resolve().parents[1],
                check=True,
                stdout=subprocess.PIPE,
                text=True,
            )
            found[name] = json.loads(done.stdout.splitlines()[-1])["seconds"]
    cold, warm = found["cold_seconds"], found["warm_seconds"]
    print(f"  first reset and step: {cold:.0f} s, with cache {warm:.0f} s", file=sys.stderr)
    return found


def _task(env: Env, worlds: tuple[int, ...], repeats: int) -> dict[str, Any]:
    return {str(count): _batch(env, count, repeats) for count in worlds}


def _batch(env: Env, worlds: int, repeats: int) -> dict[str, Any]:
    keys = jax.random.split(jax.random.key(0), worlds)
    params = repeat_params(env.default_params(), worlds)
    data = physics.jit_physics(jax.vmap(env.place))(keys, params).data
    step = physics.jit_physics(jax.vmap(lambda d: physics.substeps(env.mjx_model, d, SUBSTEPS)))
    items = worlds * SUBSTEPS
    ours = measure(lambda: step(data), repeats=repeats, items=items)
    return {"mjx": ours, _PEER: _rollout(env, data, repeats, items)}


def _plain_mjx(env: Env) -> dict[str, float]:
    """One world, as the documentation of MJX steps it: without the compiler option."""
    data = jax.tree.map(lambda x: x[None], mjx.make_data(env.mj_model))
    step = jax.jit(jax.vmap(mjx.step, in_axes=(None, 0)))
    return measure(lambda: step(env.mjx_model, data), repeats=3, items=1)


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
