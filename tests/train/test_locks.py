"""Claims and locks between processes: one at a time, and the dead do not hold anything."""

import errno
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from palm_jax.train import config as configuration
from palm_jax.train import run, workspace
from palm_jax.train.__main__ import main
from palm_jax.train.files import locks

ROOT = Path(__file__).resolve().parents[2]
HOLDER = """
import sys
from palm_jax.train.files import locks
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
        "'import sys\\nfrom palm_jax.train.files import locks\\n"
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


def foreign(folder: Path, **fields: object) -> None:
    """A claim of a process on another machine."""
    folder.mkdir(parents=True, exist_ok=True)
    process = {"pid": os.getpid(), "started": ""}
    owner = {"host": "elsewhere", "processes": [process], "since": "noon", **fields}
    (folder / locks.CLAIM).write_text(json.dumps(owner))


@pytest.mark.parametrize(
    ("before", "now", "taken"),
    [
        ({"JOB_ID": "7"}, {"JOB_ID": "7", "RESTART_COUNT": "1"}, True),
        ({"JOB_ID": "7", "RESTART_COUNT": "2"}, {"JOB_ID": "7", "RESTART_COUNT": "10"}, True),
        # The same attempt: another node of the job, where it may be alive.
        ({"JOB_ID": "7"}, {"JOB_ID": "7"}, False),
        ({"JOB_ID": "7", "RESTART_COUNT": "2"}, {"JOB_ID": "7", "RESTART_COUNT": "2"}, False),
        ({"JOB_ID": "7", "RESTART_COUNT": "2"}, {"JOB_ID": "7", "RESTART_COUNT": "1"}, False),
        ({"JOB_ID": "7"}, {"JOB_ID": "8", "RESTART_COUNT": "1"}, False),
        ({"JOB_ID": "7", "CLUSTER_NAME": "a"},
         {"JOB_ID": "7", "CLUSTER_NAME": "b", "RESTART_COUNT": "1"}, False),
        ({}, {"JOB_ID": "7", "RESTART_COUNT": "1"}, False),
        ({}, {"RESTART_COUNT": "1"}, False),
        ({"JOB_ID": "7"}, {"JOB_ID": "7", "RESTART_COUNT": "many"}, False),
    ],
)  # fmt: skip
def test_a_job_that_slurm_begins_anew_takes_over_what_it_held(
    before: dict[str, str],
    now: dict[str, str],
    taken: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def within(names: dict[str, str], host: str) -> None:
        for name in ("JOB_ID", "RESTART_COUNT", "CLUSTER_NAME"):
            monkeypatch.delenv(f"SLURM_{name}", raising=False)
        for name, value in names.items():
            monkeypatch.setenv(f"SLURM_{name}", value)
        monkeypatch.setattr(locks, "host", lambda: host)

    within(before, "node1")
    with locks.claim(tmp_path):
        left = (tmp_path / locks.CLAIM).read_text()
    (tmp_path / locks.CLAIM).write_text(left)
    within(now, "node2")
    if taken:
        with locks.claim(tmp_path):
            assert json.loads((tmp_path / locks.CLAIM).read_text())["host"] == "node2"
    else:
        with pytest.raises(locks.Busy, match="on node1.*call with --take-over, or delete"):
            with locks.claim(tmp_path):
                pass
        assert (tmp_path / locks.CLAIM).read_text() == left
        with locks.claim(tmp_path, take_over=True):
            pass


@pytest.mark.parametrize("content", ["1e999", "[" * 100_000, "null", '"many"', "[1]"])
def test_a_claim_that_says_nonsense_holds_nothing(content: str, tmp_path: Path) -> None:
    for good in ("41", "42"):
        claim = (
            '{"host": "x", "processes": [{"pid": 41, "started": ""}], "since": "", "attempt": 42}'
        )
        (tmp_path / locks.CLAIM).write_text(claim.replace(good, content))
        with locks.claim(tmp_path):
            pass
        (tmp_path / locks.CLAIM).write_text(claim)
        with pytest.raises(locks.Busy), locks.claim(tmp_path):
            pass


def test_another_users_process_that_the_system_hides_is_alive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """/proc with hidepid: a signal is not permitted, and nothing else is said."""

    def kill(pid: int, number: int) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "kill", kill)
    hidden = Path("/proc/4194305/stat")
    assert not hidden.exists() and locks.Process(4194305, "boot/1").alive
    # Where it does say who has the number now, that counts.
    assert not locks.Process(os.getpid(), "boot/1").alive


def test_a_claim_stays_until_the_next_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A child that joins may be killed, or find no room, while its parent works."""

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    process = holder(tmp_path)
    before = (tmp_path / locks.CLAIM).read_bytes()
    owner = locks._Owner.read(tmp_path / locks.CLAIM)
    assert owner is not None
    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
            patch.setattr(os, name, full)
            locks._write(tmp_path / locks.CLAIM, owner)
        assert (tmp_path / locks.CLAIM).read_bytes() == before
    process.communicate("\n")
    assert {path.name for path in tmp_path.iterdir()} == {".claim.lock"}


def test_a_training_takes_over_what_it_is_told_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun: list[Path] = []
    monkeypatch.setattr(run, "_execute", lambda config, out, console: begun.append(out) or out)
    foreign(tmp_path / "run")
    words = ["--out", str(tmp_path / "run")]
    assert main(words) == 2 and not begun
    assert "by process" in (said := capsys.readouterr().err) and "--take-over" in said
    assert main([*words, "--take-over"]) == 0 and begun == [tmp_path / "run"]
    config = configuration.parse([*words, "--take-over"])
    assert isinstance(config, configuration.Config)
    # It is no part of what the run is, and not proposed for the next time.
    assert "take_over" not in workspace.stored(config, "palm")
    assert "--take-over" not in configuration.resume_command(config)


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
    others = [spawn.Process(target=_alone, args=(tmp_path, 400)) for _ in range(3)]
    for process in others:
        process.start()
    for process in others:
        process.join()
    assert [process.exitcode for process in others] == [0, 0, 0]
