"""Claims and locks between processes: one at a time, and the dead do not hold anything."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import pytest

from palm_jax.train import interrupts, locks

ROOT = Path(__file__).resolve().parents[2]
HOLDER = """
import sys
from palm_jax.train import locks
with locks.claim(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.readline()
"""


def holder(folder: Path) -> subprocess.Popen[str]:
    """Another process that holds the claim until it is given a line."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, folder],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    return process


def test_a_claim_is_held_by_one_and_dies_with_it(tmp_path: Path) -> None:
    process = holder(tmp_path)
    with pytest.raises(locks.Busy, match=f"by process {process.pid} on this machine"):
        with locks.claim(tmp_path):
            pass
    process.communicate("\n")
    assert not (tmp_path / locks.CLAIM).exists()
    process = holder(tmp_path)
    process.kill()
    process.communicate()
    assert (tmp_path / locks.CLAIM).exists()
    with locks.claim(tmp_path):
        pass
    assert not (tmp_path / locks.CLAIM).exists()


def test_a_child_shares_the_claim_and_may_outlive_its_parent(tmp_path: Path) -> None:
    with locks.claim(tmp_path):
        process = holder(tmp_path)
        with pytest.raises(locks.Busy):  # not from a process that somebody else started
            subprocess_claim(tmp_path)
    # We have let go, the child has not.
    with pytest.raises(locks.Busy, match=f"by process {process.pid} "), locks.claim(tmp_path):
        pass
    process.communicate("\n")
    assert not (tmp_path / locks.CLAIM).exists()


def subprocess_claim(folder: Path) -> None:
    """Claims in a grandchild, whose parent holds nothing."""
    code = (
        "import subprocess, sys; sys.exit(subprocess.run([sys.executable, '-c', "
        "'import sys\\nfrom palm_jax.train import locks\\n"
        "try:\\n with locks.claim(sys.argv[1]): pass\\n"
        "except locks.Busy: sys.exit(5)', sys.argv[1]]).returncode)"
    )
    if subprocess.run([sys.executable, "-c", code, folder], cwd=ROOT).returncode == 5:
        raise locks.Busy("as expected")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"host": 1}', '{"processes": [3]}'])
def test_a_half_written_claim_holds_nothing(content: str, tmp_path: Path) -> None:
    (tmp_path / locks.CLAIM).write_text(content)
    with locks.claim(tmp_path):
        stored = json.loads((tmp_path / locks.CLAIM).read_text())
        assert stored["processes"][0]["pid"] == os.getpid()


def test_a_number_that_is_used_again_is_another_process() -> None:
    own = locks.Process.own()
    assert own.alive and not locks.Process(own.pid, "boot/1").alive
    assert not locks.Process(2**40, "").alive


def _count(path: Path, times: int) -> None:
    for _ in range(times):
        with locks.locked(path):
            number = int(path.read_text())
            path.write_text(str(number + 1))


def test_nothing_is_lost_between_reading_and_writing(tmp_path: Path) -> None:
    path = tmp_path / "count"
    path.write_text("0")
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=_count, args=(path, 100)) for _ in range(2)]
    for process in others:
        process.start()
    _count(path, 100)
    for process in others:
        process.join()
    assert path.read_text() == "300"


def test_waiting_is_told(tmp_path: Path) -> None:
    told = threading.Event()
    with locks.locked(tmp_path / "x"):
        held = threading.Thread(
            target=lambda: locks.locked(tmp_path / "x", waiting=told.set).__enter__()
        )
        held.start()
        assert told.wait(10)
    held.join()


ALONE = HOLDER.replace("locks.claim", "locks.alone")


def test_alone_does_not_wait_and_leaves_nothing(tmp_path: Path) -> None:
    lock = tmp_path / ".x.lock"
    process = subprocess.Popen(
        [sys.executable, "-c", ALONE, lock],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    for _ in range(2):  # the first refusal has taken nothing away
        with pytest.raises(locks.Busy, match="another process holds"), locks.alone(lock):
            pass
    process.kill()
    process.communicate()
    assert lock.exists()
    with locks.alone(lock):
        with pytest.raises(locks.Busy), locks.alone(lock):
            pass
    assert list(tmp_path.iterdir()) == []


def _alone(folder: Path, times: int) -> None:
    for _ in range(times):
        try:
            with locks.alone(folder / ".x.lock"):
                (folder / "in").mkdir()  # fails if another is in there
                (folder / "in").rmdir()
        except locks.Busy:
            pass


def test_alone_means_alone_also_while_the_file_is_deleted(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=_alone, args=(tmp_path, 2000)) for _ in range(3)]
    for process in others:
        process.start()
    for process in others:
        process.join()
    assert [process.exitcode for process in others] == [0, 0, 0]


def test_a_signal_is_noted_and_the_next_is_deadly() -> None:
    before = signal.getsignal(signal.SIGTERM)
    stop = interrupts.Stop()
    with stop.listening():
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop() and signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(KeyboardInterrupt), interrupts.raising():
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


class Thing:
    """To be referred to weakly."""


def test_an_interrupt_in_a_callback_is_not_lost() -> None:
    """Python drops what is raised there."""
    before, called = sys.unraisablehook, []

    def interrupt(reference: object) -> None:
        called.append(reference)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)  # the handler runs here at the latest

    thing = Thing()
    reference = weakref.ref(thing, interrupt)
    with pytest.raises(KeyboardInterrupt), interrupts.raising():
        del thing
        assert called == [reference]
        for _ in range(500):
            time.sleep(0.01)
        pytest.fail("the interrupt is lost")
    assert sys.unraisablehook is before


def test_other_exceptions_in_callbacks_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(dropped.exc_type))
    thing = Thing()
    reference = weakref.ref(thing, lambda reference: 1 / 0)
    with interrupts.raising():
        del thing
    assert told == [ZeroDivisionError] and reference() is None
