"""Two signals to real processes, whatever they are doing when these come."""

import os
import signal
import socket
import subprocess
import sys
import time
import weakref
from pathlib import Path

import pytest

from palm_jax.train.files import locks
from palm_jax.train.host import interrupts

ROOT = Path(__file__).resolve().parents[2]

LISTENING = """
import sys
from palm_jax.train.host import interrupts

def work():
{work}

stop = interrupts.Stop("noted")
try:
    with {how}:
        work()
except KeyboardInterrupt as signalled:
    print("interrupted")
    sys.exit(interrupts.leave(signalled))
print("asked" if stop() else "not asked", flush=True)
"""

IN_PYTHON = """
    import time
    print("ready", flush=True)
    while not stop():
        time.sleep(0.01)
"""
SAVING = IN_PYTHON + "    time.sleep(1)\n"
IN_C = """
    import ctypes
    lock = ctypes.create_string_buffer(64)  # zeros are a mutex that nobody has locked
    library = ctypes.CDLL(None)
    library.pthread_mutex_lock(lock)
    print("ready", flush=True)
    library.pthread_mutex_lock(lock)  # for ever, without the interpreter's lock
"""
COMPILING = """
    import jax, jax.numpy as jnp
    def long(x):
        total = x
        for j in range(300):
            y = x + j
            for i in range(10):
                y = jnp.sort(y @ x + i)[::-1]
            total += y
        return total
    lowered = jax.jit(long).lower(jnp.ones((8, 8)))
    print("ready", flush=True)
    lowered.compile()  # for half a minute
"""
COMPUTING = """
    import jax, jax.numpy as jnp
    loop = jax.jit(lambda n: jax.lax.fori_loop(0, n, lambda i, x: jnp.sin(x) + i, 0.0))
    loop(3).block_until_ready()
    print("ready", flush=True)
    loop(2**31 - 1).block_until_ready()  # for minutes
"""
NOTING, RAISING = "stop.listening()", "interrupts.raising()"


class Worker:
    """A process that is ready for signals."""

    def __init__(self, folder: Path, work: str, how: str = NOTING, before: tuple[str, ...] = ()):
        self.path = folder / "output"
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)  # compiled anew
        with self.path.open("w") as output:
            self.process = subprocess.Popen(
                [*before, sys.executable, "-c", LISTENING.format(work=work, how=how)],
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
                process_group=0,
            )

    def output(self) -> str:
        return self.path.read_text()

    def wait_for(self, text: str) -> float:
        """Seconds until it has said so."""
        begin = time.monotonic()
        while text not in self.output():
            assert self.process.poll() is None, self.output()
            assert time.monotonic() < begin + 100, self.output()
            time.sleep(0.01)
        return time.monotonic() - begin

    def send(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def end(self) -> tuple[int, float]:
        """Its exit code, and the seconds until it came."""
        begin = time.monotonic()
        try:
            return self.process.wait(30), time.monotonic() - begin
        finally:
            self.process.kill()


PAUSE = 2 * interrupts.SAME


@pytest.mark.parametrize(
    ("work", "how"),
    [(IN_C, NOTING), (IN_C, RAISING), (COMPUTING, NOTING), (COMPUTING, RAISING),
     (COMPILING, NOTING)],
    ids=["C", "C, raising", "computing", "computing, raising", "compiling"],
)  # fmt: skip
def test_the_second_ends_a_process_in_which_no_python_runs(
    work: str, how: str, tmp_path: Path
) -> None:
    worker = Worker(tmp_path, work, how)
    worker.wait_for("ready")
    time.sleep(PAUSE)
    worker.send(signal.SIGTERM)
    said = worker.wait_for("noted" if how == NOTING else "Stopping; once more ends at once.")
    time.sleep(PAUSE)
    assert worker.process.poll() is None
    worker.send(signal.SIGINT)
    code, took = worker.end()
    assert code == 128 + signal.SIGINT and said < 5 and took < 5
    assert "asked" not in worker.output() and "interrupted" not in worker.output()


def test_the_first_ends_a_compilation_without_a_crash(tmp_path: Path) -> None:
    """JAX asks for signals while it compiles, and compiles on in another thread."""
    worker = Worker(tmp_path, COMPILING, RAISING)
    worker.wait_for("ready")
    time.sleep(PAUSE)
    worker.send(signal.SIGTERM)
    code, took = worker.end()
    assert code == 130 and took < 5, worker.output()
    assert worker.output().splitlines()[-1] == "interrupted"


def test_the_first_lets_the_work_end(tmp_path: Path) -> None:
    worker = Worker(tmp_path, IN_PYTHON)
    worker.wait_for("ready")
    worker.send(signal.SIGTERM)
    assert worker.end()[0] == 0
    assert worker.output().splitlines() == ["ready", "", "noted", "asked"]


def test_the_first_raises_once(tmp_path: Path) -> None:
    worker = Worker(tmp_path, IN_PYTHON, RAISING)
    worker.wait_for("ready")
    worker.send(signal.SIGTERM)
    assert worker.end()[0] == 130
    assert worker.output().splitlines()[-1] == "interrupted"


def test_two_within_a_moment_are_one_request(tmp_path: Path) -> None:
    """timeout(1) sends one to the process and one to its group."""
    worker = Worker(tmp_path, SAVING)
    worker.wait_for("ready")
    for _ in range(2):
        worker.send(signal.SIGTERM)
        time.sleep(interrupts.SAME / 20)
    assert worker.end()[0] == 0
    assert worker.output().splitlines() == ["ready", "", "noted", "asked"]


def test_what_must_end_with_it_is_told(tmp_path: Path) -> None:
    said = "stop.listening(at_once=lambda: print('told', flush=True))"
    worker = Worker(tmp_path, IN_C, said)
    worker.wait_for("ready")
    worker.send(signal.SIGTERM)
    time.sleep(PAUSE)
    worker.send(signal.SIGTERM)
    assert worker.end()[0] == 128 + signal.SIGTERM
    assert worker.output().splitlines() == ["ready", "", "noted", "told"]


AT_A_BARRIER = """
    import os, time
    from palm_jax.train.host import devices
    devices.connect(os.environ["WHERE"])
    devices.wait()
    print("ready", flush=True)
    if devices.is_first():
        time.sleep(100)  # an evaluation
    devices.wait()
"""


@pytest.mark.slow
def test_the_second_ends_a_process_that_waits_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    workers = []
    for index in range(2):
        monkeypatch.setenv("WHERE", f"127.0.0.1:{port},2,{index}")
        (tmp_path / str(index)).mkdir()
        workers.append(Worker(tmp_path / str(index), AT_A_BARRIER, RAISING))
    first, second = workers
    try:
        second.wait_for("ready")
        time.sleep(PAUSE)
        second.send(signal.SIGTERM)
        second.wait_for("Stopping; once more ends at once.")
        time.sleep(PAUSE)
        assert second.process.poll() is None and first.process.poll() is None
        second.send(signal.SIGTERM)
        code, took = second.end()
        assert code == 128 + signal.SIGTERM and took < 5
    finally:
        first.process.kill()
        first.process.wait()


IN_A_TABLE = """
    import subprocess, sys
    from palm_jax.train import table
    stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); " \\
        "print('ready', flush=True); time.sleep(60)"
    child = subprocess.Popen([sys.executable, "-c", stubborn])
    print(f"child {child.pid};", flush=True)
    table._outcome(child)
"""


@pytest.mark.slow
def test_the_second_to_a_table_ends_the_running_cell_as_well(tmp_path: Path) -> None:
    worker = Worker(tmp_path, IN_A_TABLE, "interrupts.raising()")
    worker.wait_for("ready")
    child = int(worker.output().partition("child ")[2].partition(";")[0])
    worker.send(signal.SIGTERM)
    worker.wait_for("Stopping after the running cell")
    time.sleep(PAUSE)
    assert Path(f"/proc/{child}").exists()
    worker.send(signal.SIGTERM)
    assert worker.end()[0] == 128 + signal.SIGTERM
    deadline = time.monotonic() + 10
    while locks._started(child) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not locks._started(child), "the cell's process outlives the table's"


def test_a_closed_terminal_does_not_matter(tmp_path: Path) -> None:
    worker = Worker(tmp_path, "    import os; os.close(2)\n" + IN_C)
    worker.wait_for("ready")
    worker.send(signal.SIGTERM)
    time.sleep(PAUSE)
    worker.send(signal.SIGTERM)
    assert worker.end()[0] == 128 + signal.SIGTERM


def test_all_is_as_before_in_the_end() -> None:
    handlers = [signal.getsignal(number) for number in interrupts.SIGNALS]
    files = len(os.listdir("/proc/self/fd"))
    stop = interrupts.Stop()
    with stop.listening():
        assert not stop()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop()
    with pytest.raises(KeyboardInterrupt), interrupts.raising():
        os.kill(os.getpid(), signal.SIGTERM)
    assert [signal.getsignal(number) for number in interrupts.SIGNALS] == handlers
    assert signal.set_wakeup_fd(-1) == -1
    assert len(os.listdir("/proc/self/fd")) == files


class Thing:
    """To be referred to weakly."""


@pytest.mark.parametrize("number", interrupts.SIGNALS)
def test_an_interrupt_in_a_callback_is_not_lost(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python drops what is raised there. That it is raised again is no second signal."""
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    monkeypatch.setattr(interrupts, "SAME", 0.0)
    before, called = sys.unraisablehook, []

    def interrupt(reference: object) -> None:
        called.append(reference)
        os.kill(os.getpid(), number)
        time.sleep(0)  # the handler runs here at the latest

    thing = Thing()
    reference = weakref.ref(thing, interrupt)
    with pytest.raises(KeyboardInterrupt), interrupts.raising():
        del thing
        assert called == [reference]
        for _ in range(500):
            time.sleep(0.01)
        pytest.fail("the interrupt is lost")
    assert sys.unraisablehook is before and not ended


def test_other_exceptions_in_callbacks_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(dropped.exc_type))
    thing = Thing()
    reference = weakref.ref(thing, lambda reference: 1 / 0)
    with interrupts.raising():
        del thing
    assert told == [ZeroDivisionError] and reference() is None
