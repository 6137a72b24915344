"""Training shared by devices and processes: what one device computes, up to the order of the sums.

The processes run beside each other, each with devices of its own (virtual ones, of the CPU).
"""

import dataclasses
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import tiny
from rich.console import Console

from palm_jax.train import __main__ as training
from palm_jax.train import checkpoint, devices, learner, run
from palm_jax.train.devices import DeviceError, Split, Together
from palm_jax.train.training import Interrupted, Score, Training

SCRIPT = Path(__file__).with_name("devices_process.py")
ROOT = Path(__file__).resolve().parents[2]

CONFIG = learner.LearnerConfig(
    width=4, norm="batch", crop=40, embed=8, hidden=(16,), batch_size=8, steps=12,
    learning_rate=1e-3, warmup_steps=2, ema=0.9,
)  # fmt: skip
"""That of devices_process.py, which cannot be imported: it chooses its devices first."""

PARAMETERS = 2 * CONFIG.learning_rate, 1e-4
"""Largest difference and root mean square, over all parameters after twelve updates, of one device
and several (measured: 4.0e-4 and 1.1e-5). The sums of a gradient have another order, so that a ReLU
near zero may open on one side alone; Adam makes a step of up to the learning rate of that."""

STATE = 1e-4
"""Largest difference of any number of the state, of four devices in one and in two processes
(measured: 7.9e-6): the order of the sums is nearly the same."""


def start(folder: Path, *words: object) -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    if cache := jax.config.jax_compilation_cache_dir:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), str(folder), *map(str, words)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(*processes: subprocess.Popen[str]) -> None:
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), outputs


def final(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "final.npz", allow_pickle=False) as file:
        return dict(file)


def differences(one: Path, other: Path, part: str = "") -> np.ndarray:
    """Of every number of the state, or of those whose names begin with `part`."""
    left, right = final(one), final(other)
    assert left.keys() == right.keys() and len(left) > 50
    for name in left:
        assert left[name].dtype == right[name].dtype and left[name].shape == right[name].shape
    names = [name for name in left if name.startswith(part)]
    return np.concatenate([np.ravel(left[name].astype(float) - right[name]) for name in names])


def assert_near(one: Path, other: Path) -> None:
    found = differences(one, other, ".params")
    assert np.abs(found).max() < PARAMETERS[0]
    assert np.sqrt(np.mean(found**2)) < PARAMETERS[1]


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One process with one device."""
    folder = tmp_path_factory.mktemp("one")
    finish(start(folder, 1, 12))
    return folder


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One process with four devices."""
    folder = tmp_path_factory.mktemp("four")
    finish(start(folder, 4, 12))
    return folder


@pytest.mark.slow
def test_four_devices_give_the_parameters_of_one(one: Path, four: Path) -> None:
    assert_near(one, four)
    assert np.abs(differences(one, four)).max() > 0  # it was not one device again


@pytest.mark.slow
def test_two_processes_train_and_checkpoint_together(one: Path, four: Path, tmp_path: Path) -> None:
    """Two devices each; from a checkpoint that one device wrote, with checkpoints of their own."""
    shutil.copytree(one / "checkpoints/4", tmp_path / "checkpoints/4")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    finish(*(start(tmp_path, 2, 12, port, 2, index) for index in range(2)))
    assert_near(one, tmp_path)
    assert np.abs(differences(four, tmp_path)).max() < STATE
    # Whoever reads them needs to know nothing of processes or devices.
    store = tmp_path / "checkpoints"
    assert {path.name for path in store.iterdir()} == {"4", "8", "12"}
    loaded = checkpoint.load(store / "12", learner.make_learner(CONFIG, 3).abstract_state())
    leaves = jax.tree_util.tree_leaves_with_path(loaded)
    for name, array in final(tmp_path).items():
        found = next(leaf for path, leaf in leaves if jax.tree_util.keystr(path) == name)
        np.testing.assert_array_equal(found, array)


def test_a_batch_that_the_devices_do_not_divide_is_refused() -> None:
    Split(None).check(7)
    axes = (jax.sharding.AxisType.Auto,)
    mesh = jax.sharding.AbstractMesh((4,), ("data",), axes)
    split = Split(mesh)  # type: ignore[arg-type]
    split.check(32)
    with pytest.raises(DeviceError, match="batch_size 30 cannot be split over 4 devices"):
        split.check(30)


def test_one_device_is_left_alone() -> None:
    split = Split.over(jax.devices()[:1])
    tree = {"a": jax.numpy.ones(3)}
    assert split.mesh is None and split.count == 1
    assert split.everywhere(tree) is tree and split.on_one(tree) is tree


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("auto", None),
        ("node0:12345,2,0", ("node0:12345", 2, 0)),
        ("10.0.0.7:80,16,15", ("10.0.0.7:80", 16, 15)),
        ("[::1]:12345,2,1", ("[::1]:12345", 2, 1)),
    ],
)
def test_addresses(text: str, found: tuple[str, int, int] | None) -> None:
    assert devices.address_of(text) == found


@pytest.mark.parametrize(
    "text", ["", "Auto", "node0", "node0:12345", "node0:12345,2", "node0,2,0", "node0:12345,2,2",
             "node0:12345,-2,0", "node0:12345,2,0,1", "node0:x,2,0", "a b:1,2,0"],
)  # fmt: skip
def test_addresses_that_are_none(text: str) -> None:
    with pytest.raises(DeviceError, match="expected auto, or HOST:PORT,COUNT,INDEX.*got"):
        devices.address_of(text)


def test_the_command_joins_the_others_before_it_does_anything(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr(devices, "connect", lambda text: done.append(f"connect {text}"))
    monkeypatch.setattr(run, "execute", lambda config, console: done.append("execute"))
    assert training.main(["--distributed", "node0:1,2,1"]) == 0
    assert done == ["connect node0:1,2,1", "execute"]
    assert capsys.readouterr().out == ""  # what all processes say is said by one
    monkeypatch.undo()
    assert training.main(["--distributed", "node0:1,2"]) == 2
    assert "expected auto, or HOST:PORT,COUNT,INDEX" in capsys.readouterr().err


def test_processes_of_one_machine_do_not_listen_to_the_network() -> None:
    for host, alone in (("127.0.0.1", True), ("localhost", True), ("[::1]", True),
                        ("10.0.0.7", False), ("node0", False)):  # fmt: skip
        assert devices._loopback(devices.Address(f"{host}:12345", 2, 0)) is alone


def test_a_process_alone_waits_for_nobody() -> None:
    devices.wait()
    tree = {"a": np.ones(3), "b": True}
    assert devices.from_first(tree) is tree and devices.is_first() and devices.leave(2) == 2
    asked = [False]
    stop = Together(lambda: asked[0])
    assert not stop() and not stop.agreed
    asked[0] = True
    assert stop() and stop.agreed


def test_who_leaves_scores_no_checkpoint_whoever_was_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Another process was: the others wait for this one."""

    class Asked:
        agreed = True

        def __init__(self, asked: Callable[[], bool]) -> None:
            assert not asked()

        def __call__(self) -> bool:
            return True

    def stopping(*_: Any, should_stop: Any, on_checkpoint: Any, **__: Any) -> None:
        assert should_stop()
        on_checkpoint(2, tiny.state("bc", 2))

    def score(step: int, state: learner.TrainState) -> Score:
        raise AssertionError("a selection is played")

    monkeypatch.setattr(devices, "Together", Asked)
    monkeypatch.setattr(learner, "run", stopping)
    config = dataclasses.replace(tiny.config("bc"), steps=4, checkpoint_every=2)
    job = Training(config, "bc", tiny.learner("bc"), tmp_path, "x", score, augment=False)
    nothing = learner.Batch({}, np.zeros((0, 1)), np.zeros((0, 1)))
    with pytest.raises(Interrupted):
        job.train(nothing, Console())
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["2"]


def test_as_many_devices_as_divide_the_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "local_devices", lambda: ["a", "b", "c", "d"])
    found = {worlds: len(devices.local_for(worlds)) for worlds in (24, 50, 63, 7)}
    assert found == {24: 4, 50: 2, 63: 3, 7: 1}


def test_the_devices_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclasses.dataclass
    class Fake:
        device_kind: str

    assert devices.described() == str(jax.devices()[0])
    monkeypatch.setattr(jax, "devices", lambda: [Fake("H100")] * 16)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert devices.described() == "16 x H100 in 2 processes"


WORLDS = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_num_cpu_devices", 4)
from palm_jax.envs.rollout import batched_over

def halve(x, stop):  # as long as each world needs, as in the physics
    count = jax.lax.while_loop(lambda c: c[0] > stop, lambda c: (c[0] / 2, c[1] + 1), (x, 0))
    return {"value": count[0], "steps": count[1]}

x, stop = jnp.linspace(1.0, 900.0, 8), jnp.linspace(0.1, 2.0, 8)
expected = jax.jit(jax.vmap(halve))(x, stop)
for n in (1, 2, 4):
    found = jax.jit(batched_over(jax.devices()[:n], 8)(halve))(x, stop)
    assert all(len(leaf.sharding.device_set) == n for leaf in found.values())
    for name in found:
        np.testing.assert_array_equal(found[name], expected[name])
text = jax.jit(batched_over(jax.devices(), 8)(halve)).lower(x, stop).compile().as_text()
assert not {"all-reduce", "all-gather", "collective-permute"} & set(text.replace("(", " ").split())
try:
    batched_over(jax.devices(), 6)
except ValueError as error:
    assert "6 worlds cannot be split over 4 devices" in str(error)
else:
    raise AssertionError("6 worlds over 4 devices")
"""


@pytest.mark.slow
def test_worlds_are_split_over_devices_that_send_nothing_to_each_other() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", WORLDS], env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
