"""Training shared by devices and processes: what one device computes, up to the order of the sums.

The processes run beside each other, each with devices of its own (virtual ones, of the CPU).
"""

import dataclasses
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np
import play
import pytest
import tiny
from faults import damaged_files
from rich.console import Console

from palm_jax.train import __main__ as training
from palm_jax.train import checkpoint, learner, loop, methods, run, workspace
from palm_jax.train.host import devices
from palm_jax.train.host.devices import DeviceError, Split, Together
from palm_jax.train.training import Interrupted, Score, Training

ROOT = Path(__file__).resolve().parents[2]

# Images large enough for 2 x 2 features at the end: a norm over single numbers would give zeros
# whose sign is rounding, and the gradient of a ReLU at zero depends on that sign.
WORDS: dict[str, Any] = {
    "width": 4, "norm": "batch", "image_size": 44, "random_crop": 40, "batch_size": 8, "steps": 12,
    "learning_rate": 1e-3, "warmup_steps": 2, "checkpoint_every": 4,
}  # fmt: skip

PARAMETERS = 2 * WORDS["learning_rate"], 1e-4
"""Largest difference and root mean square, over all parameters after twelve updates, of one device
and several (measured: 4.0e-4 and 1.1e-5). The sums of a gradient have another order, so that a ReLU
near zero may open on one side alone; Adam makes a step of up to the learning rate of that."""

STATE = 1e-4
"""Largest difference of any number of the state, of four devices in one and in two processes
(measured: 7.9e-6): the order of the sums is nearly the same."""


def start(folder: Path, devices: int, *more: object, **options: object) -> subprocess.Popen[str]:
    """The command with so many devices."""
    return play.start(folder, *more, options={"devices": devices, **options}, **WORDS)


def together(folder: Path, *more: object, second: Mapping[str, Any] | None = None) -> Any:
    """Two processes of one run with two devices each; `second`: options of the second alone."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    where = [("--distributed", f"127.0.0.1:{port},2,{index}") for index in range(2)]
    return (
        start(folder, 2, *where[0]),
        start(folder, 2, *where[1], *more, **(second or {})),
    )


def differences(one: Path, other: Path, part: str = "") -> np.ndarray:
    """Of every number of the state, or of those whose names begin with `part`."""
    left, right = play.final(one), play.final(other)
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
    folder = tmp_path_factory.mktemp("one") / "run"
    play.finish(start(folder, 1))
    return folder


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One process with four devices."""
    folder = tmp_path_factory.mktemp("four") / "run"
    play.finish(start(folder, 4))
    return folder


def begun(one: Path, folder: Path) -> Path:
    """The run of one device after its first checkpoint, to go on with."""
    run = shutil.copytree(one, folder / "run")
    for step in ("8", "12"):
        shutil.rmtree(run / "checkpoints" / step)
    for name in ("eval.json", "final.npz"):
        (run / name).unlink()
    return run


@pytest.mark.slow
def test_four_devices_give_the_parameters_of_one(one: Path, four: Path) -> None:
    assert_near(one, four)
    assert np.abs(differences(one, four)).max() > 0  # it was not one device again


@pytest.mark.slow
def test_two_processes_train_and_checkpoint_together(one: Path, four: Path, tmp_path: Path) -> None:
    """Two devices each; from a checkpoint that one device wrote, with checkpoints of their own."""
    run = begun(one, tmp_path)
    play.finish(*together(run))
    assert_near(one, run)
    assert np.abs(differences(four, run)).max() < STATE
    # Whoever reads them needs to know nothing of processes or devices.
    assert set(play.scores(run)) == {4, 8, 12} and (run / "eval.json").exists()
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows if "loss" in row] == list(range(1, 13))
    stored = workspace.stored_config(run).learner(methods.find("palm"))
    loaded = checkpoint.load(run / "checkpoints/12", play.model(stored).abstract_state())
    leaves = jax.tree_util.tree_leaves_with_path(loaded)
    for name, array in play.final(run).items():
        found = next(leaf for path, leaf in leaves if jax.tree_util.keystr(path) == name)
        np.testing.assert_array_equal(found, array)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("fault", ["it raises", "it has other demonstrations"])
def test_a_process_that_fails_ends_the_other(fault: str, one: Path, tmp_path: Path) -> None:
    """Which says why; and the run goes on afterwards."""
    run, begin = begun(one, tmp_path), time.monotonic()
    if fault == "it raises":
        processes, code, words = together(run, second={"fail_at": 3}), 1, "broken on purpose"
    else:
        other = damaged_files.demonstrations(tmp_path / "other.hdf5")
        with h5py.File(other, "r+") as file:
            file["data/demo_0/actions"][0, 0] = 7
            del file["data"].attrs["sha256"]
        processes, code = together(run, "--data", other), 2
        words = f"{other}: other demonstrations than those of the first process"
    outputs = [process.communicate(timeout=120)[0] for process in processes]
    assert time.monotonic() - begin < 120
    assert processes[1].returncode == code and words in " ".join(outputs[1].split()), outputs
    assert processes[0].returncode != 0 and not (run / "eval.json").exists(), outputs
    play.finish(start(run, 4))
    assert_near(one, run)


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
    monkeypatch.setattr(loop, "run", stopping)
    config = dataclasses.replace(tiny.config("bc"), steps=4, checkpoint_every=2)
    workspace.begin(dataclasses.replace(config, out=tmp_path), tmp_path, "bc")
    job = Training(config, "bc", tiny.learner("bc"), tmp_path, score, augment=False)
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
