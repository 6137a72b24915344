"""Full disks, read-only folders, clocks that jump, and folders that somebody else works in."""

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from faults.cases import Outcome, case, file_limit, refused, small_disk, snapshot
from faults.damaged_files import TREE, _results, _saved

from palm_jax.envs import make
from palm_jax.envs.expert import Frames, Recording
from palm_jax.train import checkpoint, demos
from palm_jax.train.files import locks, metrics, records

# -- full disk -------------------------------------------------------------------------------------


def _save_checkpoint(folder: Path) -> None:
    noise = np.random.default_rng(0).normal(size=100_000)  # which cannot be compressed
    checkpoint.save(folder / "checkpoints", 300, {**TREE, "noise": noise}, keep=1)


def _save_results(folder: Path) -> None:
    many = {f"d{i}": np.random.default_rng(i).normal(size=9000) for i in range(4)}
    records.save_arrays(folder / "eval.npz", many)


def _save_json(folder: Path) -> None:
    metrics.write_json(folder / "eval.json", {str(i): i for i in range(40_000)})


_WRITERS: tuple[tuple[str, Callable[[Path], Any]], ...] = (
    ("a checkpoint", _save_checkpoint),
    ("eval.npz", _save_results),
    ("eval.json", _save_json),
)


def _before(folder: Path) -> dict[str, bytes]:
    shutil.copytree(_saved(), folder / "checkpoints")
    _results(folder)
    return snapshot(folder)


def _full(folder: Path, write: Callable[[Path], Any]) -> Outcome:
    before = _before(folder)
    with refused(OSError, "File too large", str(folder)), file_limit(24_000):
        write(folder)
    assert snapshot(folder) == before  # nothing half-written, nothing lost
    assert checkpoint.latest_valid(folder / "checkpoints") is not None
    write(folder)  # and there is room again
    return Outcome("an error that names it; what was there is whole, and no part is left")


def _full_tmpfs(folder: Path, write: Callable[[Path], Any]) -> Outcome:
    disk = folder / "disk"
    with small_disk(disk) as remount:
        before = _before(disk)
        with refused(OSError, "No space left", str(disk)):
            write(disk)
        assert snapshot(disk) == before
        remount("size=16m")
        write(disk)
    return Outcome("an error that names it; what was there is whole, and no part is left")


for _name, _write in _WRITERS:
    case("full disk", f"{_name} meets the limit of file sizes", write=_write)(_full)
    case("full disk", f"{_name} meets a full tmpfs", write=_write)(_full_tmpfs)


class _Data(NamedTuple):
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray


class _Start(NamedTuple):
    camera_to_world: np.ndarray
    data: _Data


class _Expert:
    """Stands in for the `Demonstrator`: every world is solved, by noise."""

    STEPS = 40

    def __init__(self, runner: Any) -> None:
        self.runner = runner

    def __call__(self, key: Any, keys: Any, params: Any, *, noise: float) -> Recording:
        rng, worlds = np.random.default_rng(0), self.runner.worlds

        def some(*shape: int) -> Any:
            return rng.normal(size=(self.STEPS, worlds, *shape))

        stage, success = np.zeros((2, self.STEPS, worlds), int)
        frames = Frames(some(16), some(15), some(4, 4), some(), stage, some(10), success)
        start = _Start(
            np.tile(np.eye(4), (worlds, 1, 1)),
            _Data(np.zeros((worlds, 1, 3)), np.zeros((worlds, 1, 4))),
        )
        return Recording(frames, start, np.full(worlds, self.STEPS), np.ones(worlds, bool))


def _collect(path: Path) -> Path:
    runner: Any = SimpleNamespace(env=make("lift_lid"), worlds=2)
    with mock.patch.object(demos, "Demonstrator", _Expert):
        return demos.collect(runner, path, count=8, seed=0, noise=0.0)


@case("full disk", "demonstrations meet a full tmpfs")
def _full_demos(folder: Path) -> Outcome:
    disk = folder / "disk"
    path = disk / "demos.hdf5"
    for size in (8, 64, 360):  # from the first byte to the last ones
        with small_disk(disk, size=f"{size}k") as remount:
            with refused(OSError, "No space left", str(path)):
                _collect(path)
            assert not list(disk.iterdir()), "something is left"
            remount("size=4m")
            found = demos.load(_collect(path), task="lift_lid", robot="panda", count=8)
            assert found.episodes == 8 and len(found.qpos) == 8 * _Expert.STEPS
    return Outcome("an error that names it; no file of that name comes to be", "the collection")


# -- read-only -------------------------------------------------------------------------------------


def _claim(folder: Path) -> None:
    with locks.claim(folder):
        pass


def _log(folder: Path) -> None:
    metrics.MetricsLog(folder / "metrics.jsonl", resume_step=0)


for _name, _write in (*_WRITERS, ("a claim", _claim), ("a log", _log)):

    @case("read-only", f"{_name} is to be written there", write=_write)
    def _read_only(folder: Path, write: Callable[[Path], Any]) -> Outcome:
        disk = folder / "disk"
        with small_disk(disk, size="4m") as remount:
            before = _before(disk)
            remount("ro")
            with refused(OSError, "Read-only file system", str(disk)):
                write(disk)
            # Readers do without writing.
            newest = checkpoint.latest_valid(disk / "checkpoints", repair=False)
            assert newest is not None and newest[0] == 200
            assert len(records.load_eval(disk / "eval.npz")) == 2
            assert snapshot(disk) == before
            remount("rw")
        return Outcome("an error that names the file; readers go on")


@case("read-only", "the run's folder is a file")
def _folder_is_a_file(folder: Path) -> Outcome:
    (folder / "run").write_text("mine")
    with refused(OSError, str(folder / "run")), locks.claim(folder / "run"):
        pass
    assert (folder / "run").read_text() == "mine"
    return Outcome("an error that names the file, which stays")


# -- clocks ----------------------------------------------------------------------------------------


@case("clock", "files are dated 1970 and 2099")
def _dated(folder: Path) -> Outcome:
    store = shutil.copytree(_saved(), folder / "checkpoints")
    for path in store.rglob("*"):
        os.utime(path, (0, 0) if "200" in path.parts else (4_070_908_800,) * 2)
    found = checkpoint.latest_valid(store)
    assert found is not None and found[0] == 200
    return Outcome("the newest is the one with most steps: no date is looked at")


def _claimed_by(folder: Path, process: locks.Process, *, host: str = "", since: str = "") -> None:
    owner = {
        "host": host or locks.host(),
        "processes": [dataclasses.asdict(process)],
        "since": since,
    }
    (folder / locks.CLAIM).write_text(json.dumps(owner))


@case("clock", "a claim of a live process is dated 1970")
def _old_claim(folder: Path) -> Outcome:
    _claimed_by(folder, locks.Process.own(), since="1970-01-01T00:00:00")
    with refused(locks.Busy, "since 1970", f"process {os.getpid()} on this machine"):
        with locks.claim(folder):
            pass
    return Outcome("respected: the process is asked, not the date")


@case("clock", "a claim of a dead process is dated 2099")
def _future_claim(folder: Path) -> Outcome:
    _claimed_by(folder, locks.Process(2**22 + 1, "boot/1"), since="2099-01-01T00:00:00")
    with locks.claim(folder):
        pass
    return Outcome("taken over")


@case("claims", "a dead process's number belongs to another one now")
def _number_again(folder: Path) -> Outcome:
    _claimed_by(folder, locks.Process(os.getpid(), "boot/1"))
    with locks.claim(folder):
        pass
    return Outcome("taken over: processes are told apart by when they began")


@case("claims", "a process on another machine holds the folder")
def _elsewhere(folder: Path) -> Outcome:
    _claimed_by(folder, locks.Process(1, ""), host="elsewhere")
    with refused(locks.Busy, "on elsewhere", "cannot be seen from here", "delete"):
        with locks.claim(folder):
            pass
    with locks.claim(folder, take_over=True):
        pass
    return Outcome("refused with what to do; taken over when told")


@case("claims", "a claim is cut in half")
def _half_a_claim(folder: Path) -> Outcome:
    (folder / locks.CLAIM).write_text('{"host": "el')
    with locks.claim(folder):
        assert locks.Process.own() in locks._Owner.read(folder / locks.CLAIM).processes  # type: ignore[union-attr]
    return Outcome("taken over: its writer ended before it began to work")


@case("claims", "the claim is deleted under its holder")
def _deleted_claim(folder: Path) -> Outcome:
    with locks.claim(folder):
        (folder / locks.CLAIM).unlink()
    return Outcome("the holder ends as usual")
