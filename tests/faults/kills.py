"""Processes that are killed, and asked to stop."""

import functools
import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import play
from faults import workers
from faults.cases import Outcome, case, logged

from palm_jax.train import checkpoint, table
from palm_jax.train.files import locks, records, tables
from palm_jax.train.host import interrupts

KILLS = 25
_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(["faults.workers", "rooms"])


def start(work: Callable[[Path], None], folder: Path) -> BaseProcess:
    """`work` in a process of its own."""
    folder.mkdir(exist_ok=True)
    process = _SERVER.Process(target=work, args=(folder,))
    process.start()
    return process


def lines(folder: Path) -> list[str]:
    """What the work has told so far."""
    path = folder / "progress"
    return path.read_text().splitlines() if path.exists() else []


def wait_for(process: BaseProcess, folder: Path, count: int) -> None:
    """Until the work has told so many lines, or has ended."""
    while process.is_alive() and len(lines(folder)) < count:
        time.sleep(0.002)


def whole(work: Callable[[Path], None], folder: Path) -> Path:
    """Runs to the end."""
    process = start(work, folder)
    process.join()
    output = (folder / "output").read_text()[-3000:]
    assert process.exitcode == 0, f"exit code {process.exitcode}: {output}"
    return folder


def kill_at_random(
    work: Callable[[Path], None],
    folder: Path,
    *,
    pieces: int,
    after: Callable[[], Any],
    kills: int = KILLS,
) -> int:
    """Kills the work so often, each time after at most `pieces` more pieces; then lets it end.

    Args:
      work: a function of `workers`.
      folder: of the work.
      pieces: of progress before a kill, at most.
      after: called after each kill.
      kills: how many; a run that ends before its kill is not counted.

    Returns:
      how many processes were killed.
    """
    rng, done = random.Random(7), 0
    while done < kills:
        process = start(work, folder)
        wait_for(process, folder, len(lines(folder)) + rng.randint(0, pieces))
        # Anywhere between two pieces: also while a file is written, and before the first piece.
        time.sleep(rng.uniform(0, 0.15))
        process.kill()
        process.join()
        if process.exitcode != -signal.SIGKILL:
            assert process.exitcode == 0, (folder / "output").read_text()[-3000:]
            break
        done += 1
        after()
    whole(work, folder)
    return done


@case("kill -9", f"{KILLS} times in a training", long=True)
def _training(folder: Path) -> Outcome:
    expected = whole(workers.train, folder / "whole")
    killed, lost = folder / "killed", []
    killed.mkdir()

    def after() -> None:
        log = killed / "metrics.jsonl"
        rows = [json.loads(row) for row in log.read_text().splitlines()] if log.exists() else []
        found = checkpoint.latest_valid(killed / "checkpoints", repair=False)
        lost.append((rows[-1]["step"] if rows else 0) - (found[0] if found else 0))

    count = kill_at_random(workers.train, killed, pieces=8, after=after)
    assert count == KILLS, f"only {count} kills before the end: more steps are needed"
    assert max(lost) <= workers.EVERY, lost
    play.assert_same(expected, killed)
    aside = killed / "checkpoints" / "damaged"
    halves = len(list(aside.iterdir())) if aside.is_dir() else 0
    return Outcome(
        f"the same bytes as the uninterrupted run; {halves} kills while saving",
        f"at most {max(lost)} updates a kill (interval {workers.EVERY}), repeated",
    )


@case("kill -9", f"{KILLS} times in a sweep", long=True)
def _sweep(folder: Path) -> Outcome:
    expected = whole(workers.run_sweep, folder / "whole")
    killed = folder / "killed"
    killed.mkdir()
    count = kill_at_random(workers.run_sweep, killed, pieces=3, after=lambda: None)
    assert count == KILLS, f"only {count} kills before the end"
    left, right = ((f / "sweep.npz").read_bytes() for f in (expected, killed))
    assert left == right and not list(killed.glob(".*.partial"))
    return Outcome("the same bytes as the uninterrupted one", "the batch that ran, repeated")


def _results(folder: Path) -> tuple[Any, bytes]:
    file = folder / "table.json"
    content = table.read(file, records.load_json(file)["header"])
    assert not content["failed"]
    return content["results"], tables.episodes_file(file).read_bytes()


@case("kill -9", f"{KILLS} times in a table", long=True)
def _table(folder: Path) -> Outcome:
    expected = whole(workers.run_table, folder / "whole")
    killed = folder / "killed"
    killed.mkdir()
    count = kill_at_random(workers.run_table, killed, pieces=4, after=lambda: None)
    assert count == KILLS, f"only {count} kills before the end"
    assert _results(expected)[0] == _results(killed)[0]
    left, right = (
        records.load_arrays(tables.episodes_file(f / "table.json")) for f in (expected, killed)
    )
    assert {name: array.tobytes() for name, array in left.items()} == {
        name: array.tobytes() for name, array in right.items()
    }
    told = lines(killed)
    begun = sum(line.startswith("begin") for line in told)
    cells = len(set(told)) // 2
    return Outcome(
        f"the same results and episodes; {cells} cells, begun {begun} times in all",
        "nothing of a finished cell",
    )


@case("several processes", "three run the same table", long=True)
def _three(folder: Path) -> Outcome:
    folder = folder / "table"
    processes = [start(workers.run_table, folder) for _ in range(3)]
    for process in processes:
        process.join()
        # Who ends before the others tells that cells are left to them.
        assert process.exitcode in (0, locks.LEFT), (folder / "output").read_text()[-3000:]
    told = lines(folder)
    assert len(told) == len(set(told)), "a cell was run twice"
    content = records.load_json(folder / "table.json")
    stored = {cell.name for cell in table._cells_of(content, "results")}
    assert {f"end {name}" for name in stored} == {t for t in told if t.startswith("end")}
    config = table.TableConfig(preset="quick", out=folder)
    assert stored == {cell.name for cell in table.cells(config)}
    return Outcome("every cell is run once, and none is missing in the file")


@case("several processes", "one of three is killed", long=True)
def _one_of_three(folder: Path) -> Outcome:
    folder = folder / "table"
    processes = [start(workers.run_table, folder) for _ in range(3)]
    wait_for(processes[0], folder, 9)
    processes[0].kill()
    for process in processes:
        process.join()
    whole(workers.run_table, folder)
    config = table.TableConfig(preset="quick", out=folder)
    stored = table._cells_of(records.load_json(folder / "table.json"), "results")
    assert {cell.name for cell in stored} == {cell.name for cell in table.cells(config)}
    told = lines(folder)
    twice = [line for line in set(told) if told.count(line) > 1]
    assert len({line.split()[1] for line in twice}) <= 1, twice
    return Outcome("its cell is taken over, no other is run twice", "the cell that ran, repeated")


def _asked_to_stop(folder: Path, number: signal.Signals) -> Outcome:
    expected = whole(workers.train, folder / "whole")
    stopped = folder / "stopped"
    process = start(workers.train, stopped)
    wait_for(process, stopped, 20)
    os.kill(process.pid or 0, number)
    process.join()
    assert process.exitcode == 130, (stopped / "output").read_text()[-3000:]
    assert "Stopping after this update" in (stopped / "output").read_text()
    last = logged(stopped / "metrics.jsonl")[-1]["step"]
    found = checkpoint.latest_valid(stopped / "checkpoints")
    assert found is not None and found[0] == last < workers.STEPS
    whole(workers.train, stopped)
    play.assert_same(expected, stopped)
    return Outcome("saves, says so and ends; goes on to the same bytes")


for _number in (signal.SIGINT, signal.SIGTERM):
    case("signals", f"{_number.name} while training", long=True, number=_number)(_asked_to_stop)


@case("signals", "a second one while training", long=True)
def _asked_twice(folder: Path) -> Outcome:
    expected = whole(workers.train, folder / "whole")
    stopped = folder / "stopped"
    process = start(functools.partial(workers.train, hesitation=60.0), stopped)
    # Five checkpoints with their scores, and one update: what it has to save takes a minute.
    wait_for(process, stopped, 21)
    os.kill(process.pid or 0, signal.SIGTERM)
    while "Stopping after" not in (stopped / "output").read_text() and process.is_alive():
        time.sleep(0.01)
    time.sleep(2 * interrupts.SAME)
    os.kill(process.pid or 0, signal.SIGINT)
    begin = time.monotonic()
    process.join()
    took = time.monotonic() - begin
    assert process.exitcode == 128 + signal.SIGINT and took < 2, (process.exitcode, took)
    whole(workers.train, stopped)
    play.assert_same(expected, stopped)
    return Outcome("ends at once; goes on to the same bytes", "at most one interval, repeated")


@case("determinism", "the same training twice", long=True)
def _twice(folder: Path) -> Outcome:
    one, other = (whole(workers.train, folder / name) for name in ("one", "other"))
    play.assert_same(one, other)
    shutil.rmtree(one)
    return Outcome("the same bytes, log and all")
