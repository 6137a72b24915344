"""`python -m palm_jax sweep RUN`: success over camera angle x workspace, as heatmaps and curves.

With `--shift NAME` it is success over the strength of one shift, as a curve; with `--robot NAME`
another robot acts than the one that the policy was trained on.

The grid is a `vmap` over `EnvParams`: every cell is the default distribution pinned to one object
position and one camera angle; only the scenes' other randomness differs between the episodes of a
cell.
"""

import dataclasses
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
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
from palm_jax.envs.rollout import Episodes, repeat_params
from palm_jax.train import checkpoint, report, workspace
from palm_jax.train.config import ConfigError
from palm_jax.train.evaluate import Evaluator, Runners
from palm_jax.train.files import locks, records, shards, versions
from palm_jax.train.host import interrupts
from palm_jax.train.learner import PolicyState
from palm_jax.train.reporting import console as terminal
from palm_jax.train.reporting import runs


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
      other_versions: go on with an unfinished sweep although packages have other versions now.
      shard: "i/n", the i-th of n machines (from 1): it runs its part of the grid's batches, or of
        the strengths, into RUN/shards.
      merge: join the shards of this very command into one sweep; nothing is run.
      take_over: sweep what a process on another machine has claimed, too: only if it is gone.
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
    other_versions: bool = False
    shard: str = ""
    merge: bool = False
    take_over: bool = False


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
    only: range | None = None,
    progress: Callable[[int], None] | None = None,
    partial_file: Path | None = None,
    other_versions: bool = False,
) -> records.Sweep:
    """Runs every cell of the grid.

    Args:
      evaluator: world, method and learner.
      policy: from `Learner.policy_state`.
      angles: [A] radians. xs: [X], ys: [Y] metres.
      episodes: S, in every cell.
      seed: of the scenes.
      aligned: whether the hand's initial yaw turns with the camera.
      only: rows of the episodes (`Job.part`) to run, all by default; the others stay failures.
      progress: told how many episodes were finished.
      partial_file: where finished episodes are kept meanwhile; those that are there are taken over.
      other_versions: also if they were found under other versions.

    Raises:
      ConfigError: they were, and that is not allowed.
    """
    params = evaluator.runner.env.default_params()
    if aligned:
        params = shifts.aligned_hand(params)
    cells = cell_params(params, angles, xs, ys, episodes)
    shape = (len(angles), len(xs), len(ys), episodes)
    question = _digest("grid", angles, xs, ys, episodes, seed, aligned, policy)
    found = _Found(partial_file, question, int(np.prod(shape)), progress, only, other_versions)
    scenes = jax.random.fold_in(jax.random.key(seed), 0)
    for rows, part in evaluator.batches(policy, scenes, cells, found.end, first=found.done):
        found.add(rows, part)
    return records.Sweep(
        angles, xs, ys, found.success.reshape(shape), found.nan.reshape(shape), _worlds(evaluator)
    )


def sweep_strength(
    evaluator: Evaluator,
    policy: PolicyState,
    *,
    shift: str,
    strengths: np.ndarray,
    episodes: int,
    seed: int,
    aligned: bool,
    only: range | None = None,
    progress: Callable[[int], None] | None = None,
    partial_file: Path | None = None,
    other_versions: bool = False,
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
      only: rows of the episodes (`Job.part`) to run, all by default; the others stay failures.
      progress: told how many episodes were finished.
      partial_file, other_versions: as for `sweep`.
    """
    params = evaluator.runner.env.default_params()
    if aligned:
        params = shifts.aligned_hand(params)
    shape = (len(strengths), episodes)
    question = _digest(shift, strengths, episodes, seed, aligned, policy)
    found = _Found(partial_file, question, int(np.prod(shape)), progress, only, other_versions)
    scenes = jax.random.key(seed)
    for row, strength in enumerate(strengths):
        begin = row * episodes
        first, last = max(found.done - begin, 0), min(found.end - begin, episodes)
        if first >= last:
            continue
        there = repeat_params(shifts.shifted(params, shift, strength=float(strength)), episodes)
        for rows, part in evaluator.batches(policy, scenes, there, last, first=first):
            found.add(begin + rows, part)
    success, nan = found.success.reshape(shape), found.nan.reshape(shape)
    return records.StrengthSweep(shift, strengths, success, nan, _worlds(evaluator))


def _worlds(evaluator: Evaluator) -> int:
    return evaluator.runner.worlds


def _digest(*values: Any) -> str:
    """Of a question: numbers, texts and trees of arrays."""
    digest = hashlib.sha256()
    for value in values:
        for leaf in jax.tree.leaves(value):
            array = np.asarray(leaf)
            digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


class _Found:
    """Outcomes in their order, kept in a file from batch to batch: a sweep takes hours."""

    def __init__(
        self,
        path: Path | None,
        question: str,
        total: int,
        progress: Callable[[int], None] | None,
        only: range | None = None,
        other_versions: bool = False,
    ) -> None:
        """What the file holds of the same `question` is taken over; `progress` is told of it.

        `only`: rows that are asked for, all by default; the others stay failures.
        """
        self.total, self.done, self.end = total, 0, total
        if only is not None:
            self.done, self.end = only.start, only.stop
        self.success, self.nan = np.zeros((2, total), bool)
        self._path, self._question, self._progress = path, question, progress
        self._header = {"versions": versions.current()}
        if path is not None and path.exists():
            self._take_over(path, other_versions)

    def _take_over(self, path: Path, other_versions: bool) -> None:
        try:
            kept = records.load_arrays(path)
            noted = records.header_of(kept).get("versions")
            if str(kept["question"]) != self._question:
                return
            success, nan = kept["success"].astype(bool), kept["nan"].astype(bool)
        except (records.RecordError, KeyError):
            return  # damaged: these episodes are run again
        if success.shape != nan.shape or success.ndim != 1 or len(success) > self.total:
            return
        if not self.done <= len(success) <= self.end:
            return
        workspace.check_versions(path, noted, allowed=other_versions, instead="delete the file")
        self._tell(len(success) - self.done)
        self.done = len(success)
        self.success[: self.done], self.nan[: self.done] = success, nan

    def add(self, rows: np.ndarray, part: Episodes) -> None:
        """The outcomes of the next rows."""
        self.success[rows], self.nan[rows] = part.success, part.nan
        self.done = int(rows[-1]) + 1
        if self._path is not None:
            arrays = {
                "question": np.array(self._question),
                "success": self.success[: self.done],
                "nan": self.nan[: self.done],
            }
            records.save_arrays(self._path, records.with_header(arrays, self._header))
        self._tell(len(rows))

    def _tell(self, count: int) -> None:
        if self._progress and count:
            self._progress(count)


class Job(NamedTuple):
    """What a command asks for, the same for every policy."""

    worlds: int  # in a batch
    episodes: int  # in all
    run: Callable[..., Any]  # `sweep` or `sweep_strength`, their grids bound
    record: type[Any]  # what is saved
    grid: dict[str, Any]  # fields of the record that the command says
    shape: tuple[int, ...]  # of the outcomes
    unit: int  # episodes that are not divided among shards

    def part(self, shard: tuple[int, int]) -> range:
        """Rows of a shard (i, n): whole units, as many for each as can be."""
        units = -(-self.episodes // self.unit)
        first, last = ((i * units) // shard[1] * self.unit for i in (shard[0] - 1, shard[0]))
        return range(min(first, self.episodes), min(last, self.episodes))

    def perform(
        self,
        path: Path,
        evaluator: Evaluator,
        policy: PolicyState,
        *,
        header: Mapping[str, Any],
        **options: Any,
    ) -> Any:
        """Runs it into a file, by way of a partial one beside that.

        Args:
          header: of the file, see `header_of`.
          options: see `sweep`.
        """
        kept = path.with_name(f".{path.name}.partial")
        found = self.run(evaluator, policy, partial_file=kept, **options)
        records.save_sweep(path, found, header)
        kept.unlink(missing_ok=True)
        return found


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
        shape: tuple[int, ...] = (len(strengths), count)
        line = {"shift": config.shift, "strengths": strengths}
        return Job(
            worlds, int(np.prod(shape)), run, records.StrengthSweep, line, shape, count,
        )  # fmt: skip
    angles, (xs, ys) = angles_of(config.camera), cells_of(config.workspace)
    count = config.episodes or 1
    grid = partial(sweep, angles=angles, xs=xs, ys=ys, episodes=count)
    shape = (len(angles), len(xs), len(ys), count)
    axes = {"angles": angles, "xs": xs, "ys": ys}
    return Job(
        config.batch, int(np.prod(shape)), grid, records.Sweep, axes, shape, config.batch,
    )  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code, 3 if something is left to another process."""
    config = tyro.cli(SweepConfig, args=argv, prog="python -m palm_jax sweep")
    console = terminal.make_console()
    try:
        with interrupts.raising():
            left = _run(config, console)
    except (ValueError, OSError, MemoryError) as error:
        console.print(f"error: {error}", markup=False)
        return 2
    except KeyboardInterrupt as stop:
        console.print("Stopped; the same command goes on with the batch that was running.")
        return interrupts.leave(stop)
    # With shards, the report is for the one who joins them.
    code = 0 if config.shard else report.main([str(config.run)])
    return code or (locks.LEFT if left else 0)


def _run(config: SweepConfig, console: Console) -> list[Path]:
    """Sweeps every run that the command is about, and writes the files; returns those that are left
    to another process."""
    asked, shard = job(config), shards.parse(config.shard) if config.shard else (1, 1)
    if config.shard and config.merge:
        raise ValueError("shard, merge: expected one of them; --merge alone joins the shards")
    if config.robot and config.robot not in registry.ROBOTS:
        raise ValueError(f"unknown robot {config.robot!r}; known: {', '.join(registry.ROBOTS)}")
    folders = runs.find_runs(config.run) if config.run.is_dir() else []
    if not folders:
        raise FileNotFoundError(f"{config.run}: no run folder here")
    for folder in folders:
        _check_finished(folder)
    runners: dict[tuple[str, str], Runners] = {}
    left: list[Path] = []
    for folder in folders:
        stored = workspace.stored_config(folder)
        robot = config.robot or stored.robot
        path = records.sweep_path(
            folder, "" if robot == stored.robot else robot, shift=config.shift
        )
        header = header_of(config, folder)
        if config.merge:
            arrays = shards.merge(path, asked.shape, asked.part, asked.grid, header)
            records.save_sweep(path, asked.record(**asked.grid, **arrays), header)
            console.print(f"Joined: {path}", markup=False)
            continue
        into = shards.path_of(path, *shard) if config.shard else path
        if _is_there(into, header, config):
            console.print(f"{folder}: swept already (--redo to sweep again)", markup=False)
            continue
        world = stored.task, robot
        if world not in runners:
            runners[world] = Runners.of(
                stored.task,
                robot,
                stored.second_robot,
                asked.worlds,
                tell=lambda text: console.print(text, style="bold", markup=False),
            )
        try:
            name = f".{into.stem}.claim"
            with locks.claim(folder, name=name, take_over=config.take_over):
                # Another process may have made it since.
                if not _is_there(into, header, config):
                    _sweep_one(folder, into, asked, config, header, runners[world], console)
        except locks.Busy as error:
            console.print(f"{into} is left to another process: {error}", markup=False)
            left.append(into)
    return left


def _check_finished(folder: Path) -> None:
    """Raises ConfigError for a run whose policy may yet be another one."""
    if not (folder / "eval.json").exists():
        raise ConfigError(
            f"{folder}: expected a finished run, but it has no eval.json: finish its training "
            "first (--resume)"
        )


def _is_there(path: Path, header: Mapping[str, Any], config: SweepConfig) -> bool:
    """Whether nothing is left to do for a sweep, or a shard of one.

    Raises:
      ShardError: a shard of other conditions is there.
    """
    if config.redo or not path.exists():
        return False
    if config.shard:
        shards.check(path, shards.load(path)[1], header)
        return True
    return is_of(path, header)


def is_of(path: Path, header: Mapping[str, Any]) -> bool:
    """Whether a sweep is of the policy that a header names: it is stale if the run was trained on
    since. One of before there were headers is taken to be; one that cannot be read is not."""
    try:
        found = records.header_of(records.load_arrays(path))
    except records.RecordError:
        return False
    return bool(found.get("policy", header["policy"]) == header["policy"])


def _sweep_one(
    folder: Path,
    path: Path,
    asked: Job,
    config: SweepConfig,
    header: Mapping[str, Any],
    runners: Runners,
    console: Console,
) -> None:
    """One policy's file, or a shard of it."""
    evaluator, policy = workspace.load_policy(folder, runners)
    label = f"sweep {evaluator.method.name}"
    only = range(asked.episodes)
    if config.shard:
        only = asked.part(shards.parse(config.shard))
    with terminal.ProgressBar(console, len(only), label, unit="episode") as bar:
        asked.perform(
            path,
            evaluator,
            policy,
            header=header,
            seed=config.seed,
            aligned=header["aligned"],
            only=only,
            progress=bar.advance,
            other_versions=config.other_versions,
        )
    if config.shard:
        console.print(f"Shard {config.shard}: {path}", markup=False)


def header_of(config: SweepConfig, folder: Path) -> dict[str, Any]:
    """The conditions of a run's sweep, in which its shards must agree.

    Raises:
      ConfigError: the run has no policy.
    """
    stored = workspace.stored_config(folder)
    _, best = workspace.best_checkpoint(folder)
    return {
        "task": stored.task,
        "method": stored.method[0],
        "robot": config.robot or stored.robot,
        "episodes": config.episodes,
        "seed": config.seed,
        "batch": config.batch,
        "aligned": workspace.quoted_variant(folder) == "aligned",
        "policy": checkpoint.content_hash(best),
        "versions": versions.current(),
    }
