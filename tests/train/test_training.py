"""The training command, interrupted in one process: what comes out is what comes out undisturbed.

Worlds and pictures are replaced (`play`); the rest is the command's own code.
"""

import contextlib
import json
import math
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import play
import pytest
from faults import damaged_files
from PIL import Image

from palm_jax.train import checkpoint, demos, sweep, workspace
from palm_jax.train.__main__ import main
from palm_jax.train.files import locks, metrics, records, versions

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


def test_epochs_are_passes_over_the_demonstrations(command: Command) -> None:
    assert main(play.words(command.out, epochs=3, checkpoint_every=4)) == 0
    with h5py.File(command.out.with_name("demos.hdf5")) as file:
        frames = sum(len(demo["actions"]) for demo in file["data"].values())
    updates = math.ceil(3 * frames / play.TINY["batch_size"])
    assert max(step for step, _ in checkpoint.steps(command.out / "checkpoints")) == updates
    assert json.loads((command.out / "times.json").read_text())["updates"] == updates


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


def test_a_network_of_another_version_is_told_and_not_a_traceback(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    command.told = lambda line: os.kill(os.getpid(), signal.SIGTERM) if line == "9" else None
    assert command() == 130
    play.model.cache_clear()
    command.patch.setattr(play, "small", lambda config: config)
    assert command() == 2
    play.model.cache_clear()
    error = " ".join(capsys.readouterr().err.split())
    assert "checkpoints/9: leaf " in error and "the checkpoint has" in error


def sessions(folder: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((folder / "env.json").read_text())["sessions"]
    return found


def other_jax(patch: pytest.MonkeyPatch) -> str:
    """Pretends that another JAX is installed; returns the version of the right one."""
    real = versions.current()
    patch.setattr(versions, "current", lambda: {**real, "jax": "0.0.1"})
    return real["jax"]


@pytest.mark.parametrize("noted", ["now", "before"])
def test_other_versions_do_not_go_on_unless_they_are_told_to(
    noted: str, command: Command, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command.told = lambda line: os.kill(os.getpid(), signal.SIGTERM) if line == "9" else None
    assert command() == 130
    first = sessions(command.out)
    if noted == "before":  # env.json told of the last session alone
        (command.out / "env.json").write_text(json.dumps(first[0]))
    jax_version = other_jax(command.patch)
    before = play.tree(command.out / "checkpoints")
    command.told = lambda line: None
    capsys.readouterr()
    assert command() == 2
    error = " ".join(capsys.readouterr().err.split())
    assert f"checkpoints/9 was begun with jax {jax_version}, now it is 0.0.1" in error
    assert "--other-versions" in error and play.tree(command.out / "checkpoints") == before
    assert command("--other-versions") == 0
    play.assert_same(whole, command.out)
    found = sessions(command.out)
    assert [entry["versions"]["jax"] for entry in found] == [jax_version, "0.0.1", "0.0.1"]
    assert found[:1] == first and "--other-versions" in found[2]["command"]
    assert all(entry["wall_s"] >= 0 for entry in found) and found[2]["worlds"] == {"panda": 1}
    assert "other_versions" not in json.loads((command.out / "config.json").read_text())


def test_a_finished_run_is_not_said_to_be_made_by_who_looks_at_it(command: Command) -> None:
    assert command() == 0
    before = (command.out / "env.json").read_bytes()
    other_jax(command.patch)
    assert command() == 0
    assert (command.out / "env.json").read_bytes() == before


class Swept:
    """Stands in for a sweep of one cell."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, *_: Any, angles: Any, xs: Any, ys: Any, episodes: int, **__: Any) -> Any:
        self.count += 1
        cells = np.zeros((len(angles), len(xs), len(ys), episodes), bool)
        return records.Sweep(angles, xs, ys, cells, cells)


@pytest.fixture
def swept(command: Command) -> Swept:
    found = Swept()
    command.patch.setattr(sweep, "sweep", found)
    command.patch.setattr(sweep.report, "main", lambda words: 0)
    return found


def policy_of(path: Path) -> str:
    """As a sweep's file tells it."""
    with np.load(path, allow_pickle=False) as file:
        return str(json.loads(str(file["header"]))["policy"])


def test_a_sweep_says_of_which_policy_it_is(
    command: Command, swept: Swept, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of an earlier policy is made again, by the command and after a training."""
    words = [str(command.out), "--camera", "0", "--workspace", "1x1"]
    path = command.out / "sweep.npz"
    command.told = lambda line: os.kill(os.getpid(), signal.SIGTERM) if line == "9" else None
    assert command() == 130
    assert sweep.main(words) == 2 and swept.count == 0
    assert "expected a finished run" in " ".join(capsys.readouterr().out.split())
    command.told = lambda line: None
    assert command() == 0
    assert sweep.main(words) == 0 and sweep.main(words) == 0 and swept.count == 1
    assert "swept already" in capsys.readouterr().out
    scores = play.scores(command.out)
    best, worst = (f(scores, key=scores.__getitem__) for f in (max, min))
    store = command.out / "checkpoints"
    assert policy_of(path) == checkpoint.content_hash(store / str(best))
    for number, again in enumerate((lambda: sweep.main(words), lambda: command("--sweep"))):
        better = (worst, best)[number]
        checkpoint.update_meta(store / str(better), score=2.0 + number)
        assert again() == 0 and again() == 0
        assert swept.count == 2 + number
        assert policy_of(path) == checkpoint.content_hash(store / str(better))
    # From before there were headers: it is what it was taken for.
    records.save_sweep(path, records.load_sweep(path))
    assert sweep.main(words) == 0 and swept.count == 3


def test_what_another_process_has_swept_meanwhile_is_not_swept_again(
    command: Command, swept: Swept
) -> None:
    assert command() == 0
    words = [str(command.out), "--camera", "0", "--workspace", "1x1"]
    assert sweep.main(words) == 0 and swept.count == 1
    path = command.out / "sweep.npz"
    content = path.read_bytes()
    path.unlink()

    @contextlib.contextmanager
    def claim(*_: Any, **__: Any) -> Iterator[None]:
        path.write_bytes(content)  # by the process that had the claim until now
        yield

    command.patch.setattr(locks, "claim", claim)
    assert sweep.main(words) == 0 and swept.count == 1


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
