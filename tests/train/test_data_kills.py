"""`data align` is killed and stopped by real signals, wherever it is, and goes on."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import align_process
import datasets
import h5py
import jax
import numpy as np
import pytest

from palm_jax.train import data
from palm_jax.train.data import output

EPISODES = 24
_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(["align_process"])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    def more(file: h5py.File) -> None:
        for number in range(2, EPISODES):
            file.copy(f"data/demo_{number % 2}", f"data/demo_{number}")
        file["mask/train"] = np.array([b"demo_3", b"demo_7"])

    return datasets.changed(datasets.LIFT, tmp_path_factory.mktemp("source"), more)


def start(source: Path, out: Path, format: str) -> BaseProcess:
    calibration = out.parent / "calibration.json"
    if not calibration.exists():
        data.save_calibration(datasets.robosuite(), calibration)
    words = ["align", source, "--calibration", calibration, "--out", out, "--format", format]
    words = [*map(str, words), "--trust"]
    args = (words, out.parent / "output", jax.config.jax_compilation_cache_dir)
    process = _SERVER.Process(target=align_process.align, args=args)
    process.start()
    return process


def finish(process: BaseProcess, folder: Path) -> None:
    process.join()
    assert process.exitcode == 0, (folder / "output").read_text()[-2000:]


def content(path: Path) -> dict[str, Any]:
    """All that an output holds: of HDF5 every array and attribute, of a folder every file."""
    if path.is_dir():
        files = (file for file in path.rglob("*") if file.is_file())
        return {str(file.relative_to(path)): file.read_bytes() for file in files}
    found: dict[str, Any] = {}

    def note(name: str, item: Any) -> None:
        found.update({f"{name}@{key}": repr(value) for key, value in item.attrs.items()})
        if isinstance(item, h5py.Dataset):
            found[name] = (item.dtype.str, item.shape, item.chunks, item[()].tobytes())

    with h5py.File(path) as file:
        file.visititems(note)
    return found


@pytest.fixture(scope="module")
def undisturbed(source: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    wholes = {}
    for format in ("robomimic", "lerobot"):
        out = tmp_path_factory.mktemp(format) / "out"
        finish(start(source, out, format), out.parent)
        wholes[format] = content(out)
        assert len(wholes[format]) >= 6
    return wholes


def episodes(partial: Path) -> int:
    """How many are finished, at least; of HDF5 by its size, for it is being written."""
    notes = len(list((partial / "parts").glob("*.json")))
    files = [partial / name for name in ("data.hdf5", "left.hdf5")]
    size = max((file.stat().st_size for file in files if file.exists()), default=0)
    return max(notes, size // 120_000)


POINTS: dict[str, Callable[[Path], bool]] = {
    "the folder is there": Path.exists,
    "an episode": lambda partial: episodes(partial) >= 1,
    "half of them": lambda partial: episodes(partial) >= EPISODES // 2,
    "all, or nearly": lambda partial: (
        episodes(partial) >= EPISODES - 1 or (partial / "set" / "data").exists()
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format", "number"),
    [
        ("robomimic", signal.SIGKILL),
        pytest.param("robomimic", signal.SIGINT, marks=pytest.mark.long),
        pytest.param("lerobot", signal.SIGKILL, marks=pytest.mark.long),
        pytest.param("lerobot", signal.SIGINT, marks=pytest.mark.long),
    ],
)
def test_killed_wherever_it_is(
    number: signal.Signals, format: str, source: Path, undisturbed: dict[str, dict], tmp_path: Path
) -> None:
    """Again and again; it ends with what the undisturbed command makes."""
    out, before = tmp_path / "out", datasets.digest(source)
    partial, stopped = output.partial_path(out), 0
    for reached in POINTS.values():
        process = start(source, out, format)
        while process.is_alive() and not reached(partial):
            time.sleep(0.001)
        process.is_alive() and os.kill(process.pid or 0, number)
        process.join()
        if process.exitcode == 0:
            break  # it was too fast, at one of the last points
        assert process.exitcode == (130 if number == signal.SIGINT else -number)
        assert not out.exists() and partial.exists()
        stopped += 1
    assert stopped >= 2
    if not out.exists():
        finish(start(source, out, format), tmp_path)
    told = (tmp_path / "output").read_text()
    assert ("To go on from there" in told) == (number == signal.SIGINT)
    assert "had been finished before" in told
    assert content(out) == undisturbed[format]
    assert datasets.digest(source) == before
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"out", "output", "calibration.json"}
