"""Worlds that do not fit into memory: halved where that changes nothing, else an error."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import rooms
import tiny
from rich.console import Console

from palm_jax.train import demos, run
from palm_jax.train.__main__ import main
from palm_jax.train.evaluate import VIEW
from palm_jax.train.reporting import films

FULL = "RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes.\nBuffer assignment: ..."


def needs(worlds: int, most: int) -> None:
    """Stands in for an allocation."""
    if worlds > most:
        raise jax.errors.JaxRuntimeError(FULL)


def test_demonstrations_are_rendered_with_fewer_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def render(runner: Any, data: Any, spec: Any, *, frame: int) -> tuple[Any, Any, Any]:
        asked.append(runner.worlds)
        needs(runner.worlds, 3)
        return np.zeros((5, 8, 8, 3), np.uint8), np.zeros((5, 9)), {"fx": np.zeros(5)}

    monkeypatch.setattr(demos, "render_observations", render)
    evaluator, _ = rooms.evaluator(8)
    data: Any = type("Data", (), {"actions": np.zeros((5, 10)), "tcp": np.zeros((5, 4, 4))})()
    batch = run._samples(tiny.config("palm"), evaluator, data)
    assert asked == [8, 4, 2] and evaluator.runners.worlds == {"panda": 2}
    assert batch.images[VIEW].shape == (5, 8, 8, 3)


@pytest.mark.parametrize(("domain", "robot"), [("in_domain", "panda"), ("embodiment", "ur5")])
def test_pictures_of_a_domain_are_drawn_with_fewer_worlds(
    domain: str, robot: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[int] = []

    def first(self: films.Camera, trace: films.Trace) -> tuple[np.ndarray, np.ndarray]:
        needs(self.runner.worlds, 5)
        return np.zeros((8, 8, 3), np.uint8), np.zeros((9, 9, 3), np.uint8)

    def film(self: films.Camera, trace: films.Trace, world: int) -> films.Film:
        needs(self.runner.worlds, 2)
        drawn.append(self.runner.worlds)
        return films.Film(*np.zeros((2, 3, 8, 8, 3), np.uint8), success=True)

    monkeypatch.setattr(films.Camera, "first", first)
    monkeypatch.setattr(films.Camera, "film", film)
    monkeypatch.setattr(run.videos, "write_video", lambda path, frames: None)
    evaluator, _ = rooms.evaluator(8)
    trace = films.Trace()
    trace.solved = [np.ones(8, bool)]
    config = dataclasses.replace(tiny.config("palm"), videos=1, scenes=8)
    run._film(config, evaluator, {domain: trace}, tmp_path, aligned=False)
    assert evaluator.runners.worlds[robot] == 2 and drawn == [2]
    with np.load(tmp_path / "views.npz", allow_pickle=False) as views:
        assert views[f"input/{domain}"].shape == (8, 8, 3)


def test_demonstrations_are_not_collected_with_fewer(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Their draws depend on the number of worlds."""

    def collect(runner: Any, path: Path, **options: Any) -> None:
        needs(runner.worlds, 3)
        raise jax.errors.JaxRuntimeError("INTERNAL: broken")

    monkeypatch.setattr(demos, "collect", collect)
    large: Any = rooms.Room(8)
    with pytest.raises(MemoryError, match=r"8 worlds do not fit.*lower --scenes.*9 bytes\.\)"):
        run._collect(tiny.CONFIG, large, tmp_path / "demos.hdf5", Console())
    small: Any = rooms.Room(2)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        run._collect(tiny.CONFIG, small, tmp_path / "demos.hdf5", Console())


def test_a_training_that_does_not_fit_says_what_to_lower(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def execute(*_: Any) -> None:
        raise jax.errors.JaxRuntimeError(FULL)

    monkeypatch.setattr(run, "execute", execute)
    assert main([]) == 1
    said = capsys.readouterr().err
    assert "lower --batch-size" in said and "Out of memory allocating 9 bytes" in said
    assert "Buffer assignment" not in said and "Traceback" not in said
