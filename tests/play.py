"""The training command without a simulator: all of `palm_jax.train` but worlds and pictures.

Images are noise, and how a policy does is drawn from its parameters: whoever chooses another
checkpoint gets other results. What is replaced is named in `scenery`; nothing else is.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from faults.damaged_files import demonstrations

from palm_jax.train import checkpoint, evaluate, learner, loop, report, run, training, workspace
from palm_jax.train.config import Config
from palm_jax.train.evaluate import Evaluator, Runners
from palm_jax.train.files.metrics import MetricsLog
from palm_jax.train.files.records import DomainRecord
from palm_jax.train.host import devices, interrupts
from palm_jax.train.learner import Learner, LearnerConfig, PolicyState
from palm_jax.train.methods import Method

PROPRIO = 3
SAMPLES = 30
TINY = {
    "demos": 2, "width": 2, "image_size": 24, "random_crop": 20, "batch_size": 4, "ema": 0.9,
    "warmup_steps": 4, "overlay_warmup": 0, "select_from": 0.0, "select_scenes": 9,
}  # fmt: skip
"""Options of the command; `words` takes others, too."""


def words(out: Path, *more: object, **options: object) -> list[str]:
    """A command line with a run folder, and demonstrations beside it (which are written)."""
    data = out.with_name("demos.hdf5")
    if not data.exists():
        data.parent.mkdir(parents=True, exist_ok=True)
        half = data.with_suffix(f".{os.getpid()}")  # who calls may be killed
        demonstrations(half).replace(data)
    found = ["--out", str(out), "--data", str(data), "--method", "palm", "--no-sweep"]
    for name, value in {**TINY, **options}.items():
        found += [f"--{name.replace('_', '-')}", str(value)]
    if (out / "config.json").exists():
        found.append("--resume")
    return [*found, *map(str, more)]


def samples(side: int) -> learner.Batch:
    """What demonstrations look like: noise."""
    rng = np.random.default_rng(0)
    return learner.Batch(
        {evaluate.VIEW: rng.integers(0, 256, (SAMPLES, side, side, 3), dtype=np.uint8)},
        rng.normal(size=(SAMPLES, PROPRIO)).astype(np.float32),
        rng.normal(size=(SAMPLES, 10)).astype(np.float32),
    )


def backgrounds(side: int) -> np.ndarray:
    """Others in every process: those of the first count."""
    rng = np.random.default_rng(1 + jax.process_index())
    return rng.integers(0, 256, (5, side, side, 3), dtype=np.uint8)


def small(config: LearnerConfig) -> LearnerConfig:
    """A head of a few numbers."""
    return dataclasses.replace(config, embed=8, hidden=(16,))


class Chance(Evaluator):
    """Outcomes by chance, from the parameters of the policy."""

    def domain(
        self, policy: PolicyState, domain: str, *, seed: int, count: int, **_: object
    ) -> DomainRecord:
        digest = hashlib.sha256(f"{domain} {seed}".encode())
        for leaf in jax.tree.leaves(policy):
            digest.update(np.asarray(leaf).tobytes())
        rng = np.random.default_rng(list(digest.digest()))
        return DomainRecord(
            success=rng.random(count) < 0.5,
            nan=np.zeros(count, bool),
            object_xy=rng.normal(size=(count, 2)).astype(np.float32),
            camera_angle=np.zeros(count, np.float32),
            length=rng.integers(1, 99, count).astype(np.int32),
            draws=np.ones(count, np.int32),
        )


@functools.cache
def model(config: LearnerConfig) -> Learner:
    """A learner, compiled once a process."""
    return learner.make_learner(small(config), PROPRIO, (evaluate.VIEW,))


def _evaluator(config: Config, method: Method, runners: Runners) -> Evaluator:
    return Chance(runners, method, model(config.learner(method)), config.image_size)


def _runners(*_: object, **__: object) -> Any:
    return SimpleNamespace(first=None, worlds={"panda": 1})


def _training(folder: Path, fail_at: int) -> Callable[..., learner.TrainState]:
    """`loop.run`, whose result the first process leaves in FOLDER/final.npz, and which fails
    before an update."""
    train = loop.run

    def kept(*arguments: Any, should_stop: Callable[[], bool], **options: Any) -> Any:
        calls = itertools.count(1)

        def look() -> bool:
            if next(calls) == fail_at:
                raise RuntimeError("broken on purpose")
            return should_stop()

        state = train(*arguments, should_stop=look, **options)
        if devices.is_first():
            leaves = jax.tree_util.tree_leaves_with_path(state)
            arrays = {jax.tree_util.keystr(name): np.asarray(leaf) for name, leaf in leaves}
            np.savez(folder / "final.npz", allow_pickle=False, **arrays)
        return state

    return kept


def scenery(
    folder: Path,
    *,
    tell: Callable[[str], None] = lambda line: None,
    pause: float = 0.0,
    fail_at: int = 0,
    hesitation: float = 0.0,
) -> Iterator[tuple[Any, str, Any]]:
    """(object, attribute, value) of all that is to be replaced.

    Args:
      folder: where the state at the end of a training is left.
      tell: called with the number of every step that was logged; all of them are.
      pause: seconds after that.
      fail_at: the update, counted from where the training begins, before which it raises.
      hesitation: seconds that a checkpoint takes more after somebody asked for an end.
    """
    asked: list[interrupts.Stop] = []

    class Noted(interrupts.Stop):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            asked.append(self)

    def slow(*arguments: Any, **options: Any) -> Path:
        time.sleep(hesitation if any(stop() for stop in asked) else 0.0)
        return save(*arguments, **options)

    save = checkpoint.save

    class Told(MetricsLog):
        def write(self, step: int, values: Any) -> None:
            super().write(step, values)
            tell(str(step))
            time.sleep(pause)

    yield Runners, "of", _runners
    yield workspace, "make_evaluator", _evaluator
    yield run, "_samples", lambda config, *_: samples(config.image_size)
    yield run, "_film", lambda *_, **__: None
    yield report, "write_report", lambda *_, **__: None
    yield training, "backgrounds", lambda config: backgrounds(config.image_size)
    yield training, "LOG_EVERY", 1
    yield training, "MetricsLog", Told
    yield loop, "run", _training(folder, fail_at)
    if hesitation:
        yield interrupts, "Stop", Noted
        yield checkpoint, "save", slow


def set_up(folder: Path, **options: Any) -> None:
    """Replaces it for the rest of a process; see `scenery`."""
    for place, name, value in scenery(folder, **options):
        setattr(place, name, value)


def start(
    folder: Path, *more: object, options: Mapping[str, Any] | None = None, **words_: object
) -> subprocess.Popen[str]:
    """The command in a process of its own (`train/training_process.py`).

    Args:
      folder: of the run.
      more, words_: see `words`.
      options: of the process.
    """
    root = Path(__file__).resolve().parents[1]
    environment = {**os.environ, "PYTHONPATH": f"{root}{os.pathsep}{root / 'tests'}"}
    # The processes run the same programs: the suite's cache compiles them once.
    if cache := jax.config.jax_compilation_cache_dir:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
    script = root / "tests" / "train" / "training_process.py"
    command = [str(script), str(folder), json.dumps(options or {}), *words(folder, *more, **words_)]
    return subprocess.Popen(
        [sys.executable, *command],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(*processes: subprocess.Popen[str]) -> None:
    """Waits for them; all must end well."""
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), outputs


def final(folder: Path) -> dict[str, np.ndarray]:
    """The state at the end of a training."""
    with np.load(folder / "final.npz", allow_pickle=False) as file:
        return dict(file)


def assert_same(one: Path, other: Path) -> None:
    """Two run folders hold the same: state, log, scores and episodes, byte by byte."""
    for name in ("final.npz", "eval.npz"):
        with np.load(one / name) as left, np.load(other / name) as right:
            assert left.files == right.files
            for array in left.files:
                assert left[array].dtype == right[array].dtype, array
                assert left[array].tobytes() == right[array].tobytes(), array
    for name in ("metrics.jsonl", "eval.json", "eval_variants.json"):
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    assert scores(one) == scores(other)


def tree(folder: Path) -> dict[str, bytes]:
    """All files below a folder, by name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def scores(folder: Path) -> dict[int, float]:
    """Of the checkpoints that have one."""
    found = {}
    for manifest in (folder / "checkpoints").glob("*/manifest.json"):
        content = json.loads(manifest.read_text())
        if "score" in content["meta"]:
            found[content["step"]] = content["meta"]["score"]
    return found
