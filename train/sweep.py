"""`python -m palm_jax sweep RUN`: success over camera angle x workspace, as heatmaps and curves.

The grid is a `vmap` over `EnvParams`: every cell is the default distribution pinned to one object
position and one camera angle; only the scenes' other randomness differs between the episodes of a
cell.
"""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from palm_jax.envs import registry, shifts
from palm_jax.envs.base import EnvParams
from palm_jax.envs.rollout import Runner, take_params
from palm_jax.train import console as terminal
from palm_jax.train import records, report, runs, workspace
from palm_jax.train.evaluate import Evaluator
from palm_jax.train.learner import PolicyState


@dataclasses.dataclass(frozen=True)
class SweepConfig:
    """Sweep the policies of a run folder (or of a folder of runs) over camera angle and workspace.

    Attributes:
      run: a run folder, or a folder of run folders (drawn side by side).
      camera: LOW:HIGH:COUNT camera angles in degrees.
      workspace: COLUMNSxROWS object positions over the test region (x cells by y cells).
      episodes: in every cell.
      seed: of the scenes.
      batch: worlds simulated at once (at most 128 on a CPU).
      redo: sweep again where a sweep is there already.
    """

    run: tyro.conf.Positional[Path]
    camera: str = "-30:30:5"
    workspace: str = "5x7"
    episodes: int = 1
    seed: int = 2000
    batch: int = 64
    redo: bool = False


def angles_of(text: str) -> np.ndarray:
    """Radians of `LOW:HIGH:COUNT` in degrees, or of one number.

    Raises:
      ValueError: anything else.
    """
    match = re.fullmatch(r"(-?[\d.]+)(?::(-?[\d.]+):(\d+))?", text)
    if not match or (match[3] is not None and int(match[3]) < 1):
        raise ValueError(
            f"camera: expected LOW:HIGH:COUNT in degrees, e.g. -30:30:13, got {text!r}"
        )
    low, high, count = match[1], match[2] or match[1], int(match[3] or 1)
    return np.radians(np.linspace(float(low), float(high), count))


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
      progress: told how many episodes were finished.
    """
    params = evaluator.runner.env.default_params()
    if aligned:
        params = shifts.aligned_hand(params)
    cells = cell_params(params, angles, xs, ys, episodes)
    total, batch = len(angles) * len(xs) * len(ys) * episodes, evaluator.runner.worlds
    success, nan = np.zeros(total, bool), np.zeros(total, bool)
    for first in range(0, total, batch):
        rows = np.arange(first, min(first + batch, total))
        part = take_params(cells, rows)
        scenes = jax.random.fold_in(jax.random.key(seed), first)
        result = evaluator.episodes(policy, scenes, part, len(rows))
        success[rows], nan[rows] = result.success, result.nan
        if progress:
            progress(len(rows))
    shape = (len(angles), len(xs), len(ys), episodes)
    return records.Sweep(angles, xs, ys, success.reshape(shape), nan.reshape(shape))


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    config = tyro.cli(SweepConfig, args=argv, prog="python -m palm_jax sweep")
    console = terminal.make_console()
    try:
        angles, (xs, ys) = angles_of(config.camera), cells_of(config.workspace)
        folders = runs.find_runs(config.run) if config.run.is_dir() else []
        if not folders:
            raise FileNotFoundError(f"{config.run}: no run folder here")
        runner: Runner | None = None
        for folder in folders:
            if (folder / "sweep.npz").exists() and not config.redo:
                console.print(f"{folder}: swept already (--redo to sweep again)")
                continue
            stored = workspace.stored_config(folder)
            if runner is None or runner.env.task.name != stored.task:
                runner = Runner(registry.make(stored.task, stored.robot), config.batch)
            evaluator, policy = workspace.load_policy(folder, runner)
            total = len(angles) * len(xs) * len(ys) * config.episodes
            with terminal.ProgressBar(console, total, f"sweep {evaluator.method.name}") as bar:
                result = sweep(
                    evaluator,
                    policy,
                    angles=angles,
                    xs=xs,
                    ys=ys,
                    episodes=config.episodes,
                    seed=config.seed,
                    aligned=workspace.quoted_variant(folder) == "aligned",
                    progress=bar.advance,
                )
            records.save_sweep(folder / "sweep.npz", result)
    except (ValueError, OSError) as error:
        console.print(f"error: {error}", markup=False)
        return 2
    return report.main([str(config.run)])
