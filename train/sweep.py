"""`python -m palm_jax sweep RUN`: success over camera angle x workspace, as heatmaps and curves.

With `--shift NAME` it is success over the strength of one shift, as a curve; with `--robot NAME`
another robot acts than the one that the policy was trained on.

The grid is a `vmap` over `EnvParams`: every cell is the default distribution pinned to one object
position and one camera angle; only the scenes' other randomness differs between the episodes of a
cell.
"""

import dataclasses
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from palm_jax.envs import registry, shifts
from palm_jax.envs.base import EnvParams
from palm_jax.envs.rollout import repeat_params, take_params
from palm_jax.train import checkpoint, records, report, runs, shards, workspace
from palm_jax.train import console as terminal
from palm_jax.train.evaluate import Evaluator, Runners
from palm_jax.train.learner import PolicyState


@dataclasses.dataclass(frozen=True)
class SweepConfig:
    """Sweep the policies of a run folder (or of a folder of runs) over camera angle and workspace,
    or over the strength of a shift.

    Attributes:
      run: a run folder, or a folder of run folders (drawn side by side).
      robot: the robot to act with; by default the one that the policy was trained on.
      camera: LOW:HIGH:COUNT camera angles in degrees.
      workspace: COLUMNSxROWS object positions over the test region (x cells by y cells).
      shift: sweep the strength of this shift instead of the grid of camera and workspace.
      strength: LOW:HIGH:COUNT strengths; by default the shift's whole range.
      episodes: in every cell (1 by default), or at every strength (24 by default).
      seed: of the scenes.
      batch: worlds simulated at once (at most 128 on a CPU).
      redo: sweep again where a sweep is there already.
      shard: "i/n", the i-th of n machines (from 1): it runs every n-th batch of the grid, or every
        n-th strength, into RUN/shards.
      merge: join the shards of this very command into one sweep; nothing is run.
    """

    run: tyro.conf.Positional[Path]
    robot: str = ""
    camera: str = "-30:30:5"
    workspace: str = "5x7"
    shift: str = ""
    strength: str = ""
    episodes: int | None = None
    seed: int = 2000
    batch: int = 64
    redo: bool = False
    shard: str = ""
    merge: bool = False


def angles_of(text: str) -> np.ndarray:
    """Radians of `LOW:HIGH:COUNT` in degrees, or of one number.

    Raises:
      ValueError: anything else.
    """
    return np.radians(_range_of(text, "camera: expected LOW:HIGH:COUNT in degrees, e.g. -30:30:13"))


def strengths_of(text: str) -> np.ndarray:
    """Strengths `LOW:HIGH:COUNT`, or one.

    Raises:
      ValueError: anything else.
    """
    return _range_of(text, "strength: expected LOW:HIGH:COUNT, e.g. -1:1:5")


def _range_of(text: str, expected: str) -> np.ndarray:
    match = re.fullmatch(r"(-?\d*\.?\d+)(?::(-?\d*\.?\d+):(\d+))?", text)
    if not match or (match[3] is not None and int(match[3]) < 1):
        raise ValueError(f"{expected}, got {text!r}")
    low, high, count = match[1], match[2] or match[1], int(match[3] or 1)
    return np.linspace(float(low), float(high), count)


def default_strengths(shift: str) -> str:
    """The whole range of a shift; of several together, what all of them take.

    Raises:
      ValueError: an unknown shift.
    """
    low = max(shifts.strength_range(name)[0] for name in shifts.parts(shift))
    return f"{low:g}:1:5"


def cells_of(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Cell centres (x, y) in metres of a grid `XxY` over the test region.

    Raises:
      ValueError: anything else.
    """
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise ValueError(f"workspace: expected COLUMNSxROWS, e.g. 9x9, got {text!r}")
    corners = zip(shifts.TEST_LOW, shifts.TEST_HIGH, map(int, match.groups()), strict=True)
    xs, ys = (low + (np.arange(n) + 0.5) / n * (high - low) for low, high, n in corners)
    return xs, ys


def cell_params(
    params: EnvParams, angles: np.ndarray, xs: np.ndarray, ys: np.ndarray, episodes: int
) -> EnvParams:
    """Params of every episode of the grid, leading axis [A * X * Y * S] in that order."""
    a, x, y, _ = np.meshgrid(angles, xs, ys, np.arange(episodes), indexing="ij")
    xy = jnp.asarray(np.stack([x.ravel(), y.ravel()], -1), jnp.float32)

    def pin(angle: jax.Array, position: jax.Array) -> EnvParams:
        return shifts.at_object(shifts.at_camera_angle(params, angle), position)

    return jax.vmap(pin)(jnp.asarray(a.ravel(), jnp.float32), xy)


def sweep(
    evaluator: Evaluator,
    policy: PolicyState,
    *,
    angles: np.ndarray,
    xs: np.ndarray,
    ys: np.ndarray,
    episodes: int,
    seed: int,
    aligned: bool,
    shard: tuple[int, int] = (1, 1),
    progress: Callable[[int], None] | None = None,
) -> records.Sweep:
    """Runs every cell of the grid.

    Args:
      evaluator: world, method and learner.
      policy: from `Learner.policy_state`.
      angles: [A] radians. xs: [X], ys: [Y] metres.
      episodes: S, in every cell.
      seed: of the scenes.
      aligned: whether the hand's initial yaw turns with the camera.
      shard: (i, n) runs every n-th unit, see `palm_jax.train.shards`; the others stay failures.
      progress: told how many episodes were finished.
    """
    params = evaluator.runner.env.default_params()
    if aligned:
        params = shifts.aligned_hand(params)
    cells = cell_params(params, angles, xs, ys, episodes)
    total, batch = len(angles) * len(xs) * len(ys) * episodes, evaluator.runner.worlds
    success, nan = np.zeros(total, bool), np.zeros(total, bool)
    for first in range(0, total, batch):
        if first // batch % shard[1] != shard[0] - 1:
            continue
        rows = np.arange(first, min(first + batch, total))
        part = take_params(cells, rows)
        scenes = jax.random.fold_in(jax.random.key(seed), first)
        result = evaluator.episodes(policy, scenes, part, len(rows))
        success[rows], nan[rows] = result.success, result.nan
        if progress:
            progress(len(rows))
    shape = (len(angles), len(xs), len(ys), episodes)
    return records.Sweep(angles, xs, ys, success.reshape(shape), nan.reshape(shape))


def sweep_strength(
    evaluator: Evaluator,
    policy: PolicyState,
    *,
    shift: str,
    strengths: np.ndarray,
    episodes: int,
    seed: int,
    aligned: bool,
    shard: tuple[int, int] = (1, 1),
    progress: Callable[[int], None] | None = None,
) -> records.StrengthSweep:
    """Runs the same scenes at every strength of a shift.

    Args:
      evaluator: world, method and learner.
      policy: from `Learner.policy_state`.
      shift: a name of `SHIFTS` or `AXES`, or several joined by `+`.
      strengths: [K].
      episodes: S, the scenes.
      seed: of the scenes.
      aligned: whether the hand's initial yaw turns with the camera.
      shard: (i, n) runs every n-th unit, see `palm_jax.train.shards`; the others stay failures.
      progress: told how many episodes were finished.

    """
    params = evaluator.runner.env.default_params()
    if aligned:
        params = shifts.aligned_hand(params)
    success, nan = np.zeros((2, len(strengths), episodes), bool)
    for row, strength in enumerate(strengths):
        if row % shard[1] != shard[0] - 1:
            continue
        there = repeat_params(shifts.shifted(params, shift, strength=float(strength)), episodes)
        result = evaluator.episodes(policy, jax.random.key(seed), there, episodes)
        success[row], nan[row] = result.success, result.nan
        if progress:
            progress(episodes)
    return records.StrengthSweep(shift, strengths, success, nan)


class Job(NamedTuple):
    """What a command asks for, the same for every policy."""

    worlds: int  # in a batch
    episodes: int  # in all
    run: Callable[..., Any]  # `sweep` or `sweep_strength`, their grids bound
    save: Callable[[Path, Any], Path]
    record: type[Any]  # what is saved
    grid: dict[str, Any]  # fields of the record that the command says
    units: np.ndarray  # number of the unit of every episode, in the shape of `success`

    def part(self, shard: tuple[int, int]) -> int:
        """Episodes of a shard."""
        return int((self.units % shard[1] == shard[0] - 1).sum())


def job(config: SweepConfig) -> Job:
    """What a configuration asks for.

    Raises:
      ValueError: a grid, strength or shift that is none.
    """
    if config.shift:
        if not shifts.parts(config.shift) or shifts.other_robot(config.shift):
            raise ValueError(
                f"shift: expected shifts with a strength, got {config.shift!r}; "
                "another robot is --robot"
            )
        strengths = strengths_of(config.strength or default_strengths(config.shift))
        count = config.episodes or 24
        run = partial(sweep_strength, shift=config.shift, strengths=strengths, episodes=count)
        # Worlds beyond the scenes of one strength would run for nothing.
        worlds = min(config.batch, count)
        units = np.repeat(np.arange(len(strengths))[:, None], count, axis=1)
        line = {"shift": config.shift, "strengths": strengths}
        return Job(
            worlds, units.size, run, records.save_strengths, records.StrengthSweep, line, units
        )
    angles, (xs, ys) = angles_of(config.camera), cells_of(config.workspace)
    count = config.episodes or 1
    grid = partial(sweep, angles=angles, xs=xs, ys=ys, episodes=count)
    shape = (len(angles), len(xs), len(ys), count)
    units = (np.arange(np.prod(shape)) // config.batch).reshape(shape)
    axes = {"angles": angles, "xs": xs, "ys": ys}
    return Job(config.batch, units.size, grid, records.save_sweep, records.Sweep, axes, units)


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    config = tyro.cli(SweepConfig, args=argv, prog="python -m palm_jax sweep")
    console = terminal.make_console()
    try:
        _run(config, console)
    except (ValueError, OSError) as error:
        console.print(f"error: {error}", markup=False)
        return 2
    if config.shard:
        return 0  # the report is for the one who joins the shards
    return report.main([str(config.run)])


def _run(config: SweepConfig, console: Console) -> None:
    """Sweeps every run that the command is about, and writes the files."""
    asked, shard = job(config), shards.parse(config.shard) if config.shard else (1, 1)
    if config.shard and config.merge:
        raise ValueError("shard, merge: expected one of them; --merge alone joins the shards")
    if config.robot and config.robot not in registry.ROBOTS:
        raise ValueError(f"unknown robot {config.robot!r}; known: {', '.join(registry.ROBOTS)}")
    folders = runs.find_runs(config.run) if config.run.is_dir() else []
    if not folders:
        raise FileNotFoundError(f"{config.run}: no run folder here")
    runners: dict[tuple[str, str], Runners] = {}
    for folder in folders:
        stored = workspace.stored_config(folder)
        robot = config.robot or stored.robot
        path = records.sweep_path(
            folder, "" if robot == stored.robot else robot, shift=config.shift
        )
        if config.merge:
            asked.save(path, _merged(config, asked, folder, path))
            console.print(f"Joined: {path}", markup=False)
            continue
        into = shards.path_of(path, *shard) if config.shard else path
        if into.exists() and not config.redo:
            if config.shard:
                shards.check(into, shards.load(into)[1], _header(config, folder))
            console.print(f"{folder}: swept already (--redo to sweep again)", markup=False)
            continue
        world = stored.task, robot
        if world not in runners:
            runners[world] = Runners.of(stored.task, robot, stored.second_robot, asked.worlds)
        evaluator, policy = workspace.load_policy(folder, runners[world])
        label = f"sweep {evaluator.method.name}"
        with terminal.ProgressBar(console, asked.part(shard), label, unit="episode") as bar:
            found = asked.run(
                evaluator,
                policy,
                seed=config.seed,
                aligned=workspace.quoted_variant(folder) == "aligned",
                shard=shard,
                progress=bar.advance,
            )
        if config.shard:
            shards.save(into, vars(found), _header(config, folder))
            console.print(f"Shard {config.shard}: {into}", markup=False)
        else:
            asked.save(path, found)


def _header(config: SweepConfig, folder: Path) -> dict[str, Any]:
    """The conditions of a run's sweep in which its shards must agree."""
    best = checkpoint.best(folder / "checkpoints")
    stored = workspace.stored_config(folder)
    return {
        "task": stored.task,
        "method": stored.method[0],
        "robot": config.robot or stored.robot,
        "episodes": config.episodes,
        "seed": config.seed,
        "batch": config.batch,
        "aligned": workspace.quoted_variant(folder) == "aligned",
        "policy": checkpoint.fingerprint(best[0][1]) if best else None,
        "versions": workspace.versions(),
    }


def _merged(config: SweepConfig, asked: Job, folder: Path, path: Path) -> Any:
    arrays = shards.merge(path, asked.units, asked.grid, _header(config, folder))
    return asked.record(**{**asked.grid, "success": arrays["success"], "nan": arrays["nan"]})
