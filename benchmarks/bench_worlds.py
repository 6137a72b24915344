"""`python -m palm_jax bench worlds`: is every task solvable on every robot, is its physics sound?

Of every task on every robot: what the scripted expert solves in the training and in the test
region and how its episodes go, whether C MuJoCo agrees on them, how deep things press into each
other, how far a held object slips, and whether physics survives random actions.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import common, replay, soundness
from palm_jax.envs import ROBOTS, TASKS, make, shifts
from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner, repeat_params
from palm_jax.train.reporting import figures, grids

DOMAINS = ("in_domain", "workspace")
CELLS = (4, 7)
"""Cells of the test region along x and y."""

RANDOM_STEPS = 60
_BATCH = 64


def run(
    tasks: Sequence[str] = tuple(TASKS),
    robots: Sequence[str] = tuple(ROBOTS),
    *,
    scenes: int = 64,
    random: int = 1000,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Everything, by task and robot; `worst_expert_success` is that of the test region.

    Args:
      tasks, robots: names.
      scenes: expert episodes in each of `DOMAINS`.
      random: episodes of each kind of random actions.
      folder: where to put maps of the expert's success, one file a task, if anywhere.
    """
    found: dict[str, Any] = {}
    for task in tasks:
        for robot in robots:
            start = time.perf_counter()
            result = world(Runner(make(task, robot), min(scenes, _BATCH)), scenes, random)
            found.setdefault(task, {})[robot] = result
            seconds = time.perf_counter() - start
            print(f"{line(task, robot, result)}  {seconds:.0f} s", file=sys.stderr, flush=True)
        if folder:
            draw(task, found[task], folder)
    rates = [result["workspace"]["success"] for row in found.values() for result in row.values()]
    return {"worst_expert_success": min(rates), "tasks": found}


def world(runner: Runner, scenes: int, random: int) -> dict[str, Any]:
    """The figures of one task on one robot."""
    second = replay.Replay(runner)
    result: dict[str, Any] = {}
    for index, domain in enumerate(DOMAINS):
        params = _params(runner, domain)
        key = jax.random.fold_in(jax.random.key(7), index)
        batches = [
            _episodes(runner, second, jax.random.fold_in(key, batch), params)
            for batch in range(-(-scenes // runner.worlds))
        ]
        result[domain] = _expert_figures(runner.env, batches)
    for kind in soundness.RANDOM if random else ():
        result[kind] = soundness.random_episodes(
            runner, kind, _params(runner, "workspace"), random, steps=RANDOM_STEPS
        )
    return result


def _params(runner: Runner, domain: str) -> EnvParams:
    return repeat_params(shifts.shifted(runner.env.default_params(), domain), runner.worlds)


# -- the expert ------------------------------------------------------------------------------------


class _Batch(NamedTuple):
    """The expert's episodes of W worlds."""

    start: State  # [W]
    seen: soundness.Seen  # [T + 1, W, ...]
    length: np.ndarray  # int [W]
    theirs: replay.Steps  # the same in C MuJoCo


def _episodes(runner: Runner, second: replay.Replay, key: jax.Array, params: EnvParams) -> _Batch:
    """Without noise, to the horizon or until all worlds are done; then once more in C MuJoCo."""
    look, horizon = soundness.watcher(runner.env), runner.env.task.horizon
    state = start = runner.reset(jax.random.split(key, runner.worlds), params)
    seen = [look(state)]
    while len(seen) <= horizon and not (seen[-1].success | seen[-1].nan).all():
        state = runner.step(state, runner.expert(state), params)
        seen.append(look(state))
    stacked = soundness.Seen(*(np.stack(field) for field in zip(*seen, strict=True)))
    length = replay.length(stacked.success[1:] | stacked.nan[1:])
    return _Batch(start, stacked, length, second(start, params, horizon))


def _expert_figures(env: Env, batches: Sequence[_Batch]) -> dict[str, Any]:
    success = np.concatenate([batch.seen.success[-1] for batch in batches])
    nan = np.concatenate([batch.seen.nan[-1] for batch in batches])
    length = np.concatenate([batch.length for batch in batches])
    xy = np.concatenate([batch.start.object_start[:, :2] for batch in batches])
    draws = np.concatenate([batch.start.draws for batch in batches])
    solved = success & ~nan
    steps = length[solved] if solved.any() else length
    return {
        "scenes": len(success),
        "solved": int(solved.sum()),
        "success": float(solved.mean()),
        "nan": int(nan.sum()),
        "steps": {
            "min": int(steps.min()),
            "median": int(np.median(steps)),
            "max": int(steps.max()),
        },
        "redrawn_starts": float((draws > 1).mean()),
        "cells": _cells(xy, solved),
        **_contacts(env, batches),
        "c_mujoco": _agreement(batches),
    }


def _cells(xy: np.ndarray, solved: np.ndarray) -> dict[str, Any]:
    """Counts over the test region, [x][y]."""
    edges = [
        np.linspace(low, high, cells + 1)
        for low, high, cells in zip(shifts.TEST_LOW, shifts.TEST_HIGH, CELLS, strict=True)
    ]
    counts, good = (
        np.histogram2d(rows[:, 0], rows[:, 1], bins=edges)[0].astype(int)
        for rows in (xy, xy[solved])
    )
    return {
        "x_edges": edges[0].tolist(),
        "y_edges": edges[1].tolist(),
        "episodes": counts.tolist(),
        "solved": good.tolist(),
    }


def _contacts(env: Env, batches: Sequence[_Batch]) -> dict[str, Any]:
    """Of the solved episodes: where it failed, the object may have been knocked over."""
    slips = [0.0]
    depths: dict[str, dict[str, Any]] = {}
    for batch in batches:
        worlds = np.flatnonzero(batch.seen.success[-1] & ~batch.seen.nan[-1])
        slips.append(soundness.largest_slip(env, batch.seen, batch.length, worlds))
        for name, entry in soundness.deepest(env, batch.seen, batch.length, worlds).items():
            if name not in depths or entry["depth_m"] > depths[name]["depth_m"]:
                depths[name] = entry
    return {"largest_slip_m": max(slips), "deepest": depths}


def _agreement(batches: Sequence[_Batch]) -> dict[str, Any]:
    pairs = []
    for batch in batches:
        seen = batch.seen
        ours = replay.Steps(seen.tcp[1:, :, :3, 3], seen.success[1:], seen.nan[1:])
        pairs.append((ours, batch.theirs))
    return replay.compare(pairs)


# -- what people read ------------------------------------------------------------------------------


def line(task: str, robot: str, result: dict[str, Any]) -> str:
    """One line of text."""
    parts = [f"{task} {robot}:"]
    for domain in DOMAINS:
        entry = result[domain]
        steps, other = entry["steps"], entry["c_mujoco"]
        parts.append(
            f"{domain} {entry['solved']}/{entry['scenes']} "
            f"({steps['min']}-{steps['median']}-{steps['max']} steps, "
            f"C MuJoCo {other['both'] + other['only_c']}, drift "
            f"{1e3 * other['drift_median_m']:.1f} to {1e3 * other['drift_worst_m']:.1f} mm, "
            f"slip {1e3 * entry['largest_slip_m']:.1f} mm);"
        )
    parts += [f"{k} {result[k]['nan']} NaN;" for k in soundness.RANDOM if k in result]
    return " ".join(parts)


def draw(task: str, by_robot: dict[str, Any], folder: Path) -> Path:
    """Maps of the expert's success over the test region, one for each robot: `expert_TASK.png`."""
    panels = {}
    for robot, result in by_robot.items():
        cells = result["workspace"]["cells"]
        names = ("x_edges", "y_edges", "solved", "episodes")
        panels[robot] = grids.Grid(*(np.array(cells[name], float) for name in names))
    title = f"{task.replace('_', ' ').capitalize()}: the scripted expert"
    figure = figures.heatmaps(panels, grids.Regions(), title=title)
    return figures.save(figure, folder / f"expert_{task}.png")


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m palm_jax bench worlds",
        description="The expert, C MuJoCo's view of it, contacts and random actions, as JSON.",
    )
    for name, known in (("tasks", TASKS), ("robots", ROBOTS)):
        parser.add_argument(
            f"--{name}", nargs="+", choices=list(known), default=list(known), metavar="NAME",
            help=f"any of {', '.join(known)} (default: all)",
        )  # fmt: skip
    parser.add_argument("--scenes", type=int, default=64, help="expert episodes in each region")
    parser.add_argument("--random", type=int, default=1000, help="episodes of random actions")
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw success maps there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the JSON there as well")
    options = parser.parse_args(argv)
    if options.scenes < 1 or options.random < 0:
        parser.error("expected at least 1 scene and no negative number of random episodes")
    result = run(
        options.tasks,
        options.robots,
        scenes=options.scenes,
        random=options.random,
        folder=options.figures,
    )
    headline = {"worst_expert_success": result["worst_expert_success"]}
    report = {"palm_jax": headline, **common.conditions(), "details": {"worlds": result}}
    common.publish(report, options.json)
    return 0
