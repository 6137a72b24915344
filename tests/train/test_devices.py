"""Training shared by devices and processes: what one device computes, up to the order of the sums.

The processes run beside each other, each with devices of its own (virtual ones, of the CPU).
"""

import dataclasses
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from palm_jax.train import checkpoint, devices
from palm_jax.train.devices import DeviceError, Split, Together

SCRIPT = Path(__file__).with_name("devices_process.py")
ROOT = Path(__file__).resolve().parents[2]

TOLERANCE = 2e-4
"""Largest difference of any number of the state after twelve updates, beside one device (measured:
see docs/scaling.md). Adam divides by the gradient's size, so that rounding in a gradient that is
nearly zero moves a parameter by a part of the learning rate of 1e-3."""


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


def difference(one: Path, other: Path) -> float:
    left, right = final(one), final(other)
    assert left.keys() == right.keys() and len(left) > 50
    for name in left:
        assert left[name].dtype == right[name].dtype and left[name].shape == right[name].shape
    return max(float(np.abs(left[name] - right[name]).max()) for name in left if left[name].size)


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One process with one device."""
    folder = tmp_path_factory.mktemp("one")
    finish(start(folder, 1, 12))
    return folder


@pytest.mark.slow
def test_four_devices_give_the_parameters_of_one(one: Path, tmp_path: Path) -> None:
    finish(start(tmp_path, 4, 12))
    assert 0 < difference(one, tmp_path) < TOLERANCE


@pytest.mark.slow
def test_two_processes_train_and_checkpoint_together(one: Path, tmp_path: Path) -> None:
    """Two devices each; from a checkpoint that one device wrote, with checkpoints of their own."""
    shutil.copytree(one / "checkpoints/4", tmp_path / "checkpoints/4")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    finish(*(start(tmp_path, 2, 12, port, 2, index) for index in range(2)))
    assert difference(one, tmp_path) < TOLERANCE
    # Whoever reads them needs to know nothing of processes or devices.
    store = tmp_path / "checkpoints"
    assert [step for step, path in checkpoint.steps(store) if checkpoint.verify(path)] == [4, 8, 12]
    assert {path.name for path in store.iterdir()} == {"4", "8", "12"}


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
