"""A killed training run goes on as if nothing had happened, bit for bit."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

SCRIPT = Path(__file__).with_name("training_process.py")
ROOT = Path(__file__).resolve().parents[2]


def start(folder: Path, *, seed: int = 0, pause: float = 0.0) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    # The processes run the same program: the suite's cache compiles it once.
    if cache := jax.config.jax_compilation_cache_dir:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), str(folder), str(seed), str(pause)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> None:
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output


def final(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "final.npz") as file:
        return dict(file)


def logged(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody disturbed."""
    folder = tmp_path_factory.mktemp("reference")
    finish(start(folder))
    return folder


def assert_same(one: Path, other: Path) -> None:
    left, right = final(one), final(other)
    assert left.keys() == right.keys()
    for name in left:
        assert left[name].dtype == right[name].dtype, name
        assert left[name].tobytes() == right[name].tobytes(), name
    assert logged(one) == logged(other)


@pytest.mark.slow
def test_a_killed_run_resumes_bit_for_bit(reference: Path, tmp_path: Path) -> None:
    """SIGKILL between two checkpoints, twice: parameters, optimiser, average and log are equal."""
    for target in (7, 18):
        process = start(tmp_path, pause=0.2)
        log, deadline = tmp_path / "metrics.jsonl", time.monotonic() + 240
        while process.poll() is None and time.monotonic() < deadline:
            if log.exists() and len(log.read_text().splitlines()) >= target:
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        output, _ = process.communicate()
        assert process.returncode == -signal.SIGKILL, output
        assert not (tmp_path / "final.npz").exists()
        kept = [int(p.name) for p in (tmp_path / "checkpoints").iterdir() if p.name.isdigit()]
        assert kept and max(kept) % 5 == 0 and 0 < max(kept) < 24
    finish(start(tmp_path))
    assert_same(reference, tmp_path)
    assert [row["step"] for row in logged(tmp_path)] == list(range(1, 25))


@pytest.mark.slow
def test_the_seed_is_all_there_is(reference: Path, tmp_path: Path) -> None:
    """Two runs with one seed are identical; another seed gives other parameters."""
    for name, seed in (("again", 0), ("other", 1)):
        (tmp_path / name).mkdir()
        finish(start(tmp_path / name, seed=seed))
    assert_same(reference, tmp_path / "again")
    first, second = final(reference), final(tmp_path / "other")
    weights = [name for name in first if name.startswith(".params") and first[name].ndim > 1]
    assert weights and all((first[name] != second[name]).any() for name in weights)
