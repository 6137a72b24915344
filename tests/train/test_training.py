"""The training command, interrupted in one process: what comes out is what comes out undisturbed.

Worlds and pictures are replaced (`play`); the rest is the command's own code.
"""

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import play
import pytest
from faults import damaged_files
from PIL import Image

from palm_jax.train import checkpoint, demos, metrics, records, workspace
from palm_jax.train.__main__ import main

STEPS, EVERY = 12, 4


class Killed(BaseException):
    """Stands in for the end of the process."""


class Command:
    """`python -m palm_jax.train` with some steps, in a run folder."""

    def __init__(self, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.out, self.patch = out, monkeypatch
        self.told: Callable[[str], None] = lambda line: None
        for place, name, value in play.scenery(out, tell=lambda line: self.told(line)):
            monkeypatch.setattr(place, name, value)

    def __call__(self, *more: object, **options: object) -> int:
        options = {"steps": STEPS, "checkpoint_every": EVERY, **options}
        return main(play.words(self.out, *more, **options))

    def killed(self, place: Any, name: str, count: int) -> None:
        """Runs until `place.name` is called for the `count`-th time, which does not happen."""
        left, real = count, getattr(place, name)

        def counted(*arguments: Any, **options: Any) -> Any:
            nonlocal left
            left -= 1
            if not left:
                raise Killed
            return real(*arguments, **options)

        with self.patch.context() as until, pytest.raises(Killed):
            until.setattr(place, name, counted)
            self()


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(tmp_path / "run", monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        assert Command(out, patch)() == 0
    assert set(play.scores(out)) == {4, 8, 12}
    return out


@pytest.mark.parametrize("step", ["5", "8", "11"])
def test_a_stop_adds_no_checkpoint_to_choose_from(
    step: str, command: Command, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wherever it comes: those with a score, the log and the episodes stay the same."""

    def ask(line: str) -> None:
        if line == step:
            os.kill(os.getpid(), signal.SIGTERM)

    command.told = ask
    assert command() == 130
    assert "--resume" in capsys.readouterr().out
    assert int(step) in [found for found, _ in checkpoint.steps(command.out / "checkpoints")]
    command.told = lambda line: None
    assert command() == 0
    play.assert_same(whole, command.out)


@pytest.mark.parametrize(
    ("place", "name", "count"),
    [
        (play.Chance, "domain", 2),  # while a checkpoint is scored
        (checkpoint, "update_meta", 1),  # between the log's row and the score
        (checkpoint, "update_meta", 3),
        (checkpoint, "save", 2),
        (records, "save_eval", 1),  # in the evaluation
    ],
)
def test_a_kill_leaves_no_hole_in_the_log(
    place: Any, name: str, count: int, command: Command, whole: Path
) -> None:
    command.killed(place, name, count)
    assert command() == 0
    play.assert_same(whole, command.out)


def demonstrations(path: Path, seed: int) -> str:
    """Writes other ones; returns the SHA-256 that the file has of itself."""
    damaged_files.demonstrations(path)
    with h5py.File(path, "r+") as file:
        file["data/demo_0/actions"][0, 0] = seed
        file["data"].attrs["sha256"] = demos._digest(file["data"])
        return str(file["data"].attrs["sha256"])


@pytest.mark.parametrize("step", ["5", None])
def test_other_demonstrations_are_not_gone_on_with(
    step: str | None, command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither by a training nor by a run that has nothing left to do; the same elsewhere are."""
    command.told = lambda line: os.kill(os.getpid(), signal.SIGTERM) if line == step else None
    assert command() == (130 if step else 0)
    begun = json.loads((command.out / "config.json").read_text())["digests"]["demonstrations"]
    with h5py.File(tmp_path / "demos.hdf5") as file:
        assert file["data"].attrs["sha256"] == begun
    other = demonstrations(tmp_path / "other.hdf5", 7)
    before = play.tree(command.out / "checkpoints")
    command.told = lambda line: None
    capsys.readouterr()
    assert command("--data", tmp_path / "other.hdf5") == 2
    error = " ".join(capsys.readouterr().err.split())
    assert f"demonstrations of SHA-256 {begun[:12]}, but {tmp_path}/other.hdf5" in error
    assert other[:12] in error and "choose another --out" in error
    assert play.tree(command.out / "checkpoints") == before
    moved = shutil.move(tmp_path / "demos.hdf5", tmp_path / "moved.hdf5")
    assert command("--data", moved) == 0


def test_other_pictures_behind_the_same_name_are_not_gone_on_with(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(2):
        colour = (9 * number, 0, 0)
        Image.new("RGB", (8, 8), colour).save(folder / f"{number}.png")
    assert command("--backgrounds", folder) == 0
    (folder / "notes.txt").write_text("no picture")
    assert command("--backgrounds", folder) == 0
    Image.new("RGB", (8, 8), (9, 0, 1)).save(folder / "1.png")
    assert command("--backgrounds", folder) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "was begun with backgrounds of SHA-256" in error and str(folder) in error


def test_a_run_from_before_data_were_noted_goes_on(
    command: Command, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its checkpoints are its own, and its data are noted from now on."""
    command.told = lambda line: os.kill(os.getpid(), signal.SIGTERM) if line == "9" else None
    with monkeypatch.context() as before:
        before.setattr(workspace, "bind_data", lambda *_: None)
        assert command() == 130
    values = json.loads((command.out / "config.json").read_text())
    assert "digests" not in values
    command.told = lambda line: None
    assert command() == 0
    play.assert_same(whole, command.out)
    assert not (command.out / "checkpoints" / "damaged").exists()
    assert json.loads((command.out / "config.json").read_text())["digests"]
    assert [step for step, _ in checkpoint.best(command.out / "checkpoints", count=9)] == [
        step for step, _ in checkpoint.best(whole / "checkpoints", count=9)
    ]


def test_checkpoints_of_other_data_are_set_aside(command: Command, tmp_path: Path) -> None:
    """Also if config.json, which would have told, is away."""
    assert command() == 0
    for name in ("config.json", "eval.json"):
        (command.out / name).unlink()
    demonstrations(tmp_path / "demos.hdf5", 7)
    assert command() == 0
    aside = command.out / "checkpoints" / "damaged"
    assert {path.name for path in aside.iterdir()} == {"4-foreign", "8-foreign", "12-foreign"}


def test_a_checkpoint_on_the_disk_has_its_log_there(command: Command) -> None:
    """A power cut may take what was not synced: not rows from before a checkpoint or a score."""
    log, durable, looked = command.out / "metrics.jsonl", [b""], []
    sync = metrics.MetricsLog.sync

    def synced(self: metrics.MetricsLog) -> None:
        sync(self)
        durable.append(log.read_bytes())

    def looking(real: Callable[..., Any]) -> Callable[..., Any]:
        def look(*arguments: Any, **options: Any) -> Any:
            looked.append(log.read_bytes() == durable[-1] != b"")
            return real(*arguments, **options)

        return look

    command.patch.setattr(metrics.MetricsLog, "sync", synced)
    for name in ("save", "update_meta"):
        command.patch.setattr(checkpoint, name, looking(getattr(checkpoint, name)))
    assert command() == 0
    assert looked == [True] * 6
