"""The training command, interrupted in one process: what comes out is what comes out undisturbed.

Worlds and pictures are replaced (`play`); the rest is the command's own code.
"""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import play
import pytest

from palm_jax.train import checkpoint, metrics, records
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
