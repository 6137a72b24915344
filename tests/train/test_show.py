"""Pictures of the worlds: what is asked for, which moments are shown, and where they end up."""

from pathlib import Path
from typing import Any

import numpy as np
import oracles
import pytest
from PIL import Image

from palm_jax.envs import ROBOTS, TASKS, shifts
from palm_jax.envs.tasks import Stage
from palm_jax.train import show

PICK, PLACE = Stage(("a",), 0.8, (0.1, 0.2)), Stage(("b",), 0.8, (0.1, 0.2), open_hand=False)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tasks", "lift_pot"], f"unknown task 'lift_pot'; known: {', '.join(TASKS)}"),
        (["--robots", "pr2"], f"unknown robot 'pr2'; known: {', '.join(ROBOTS)}"),
        (["--domains", "night"], "unknown shift 'night'"),
        (["--domains", "in_domain", "workspace+embodiment"], "see --robots"),
        (["--size", "8"], "at least 16 pixels"),
    ],
)
def test_a_wrong_command_is_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert show.main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and error.count("\n") == 1


def test_everything_is_the_default() -> None:
    config = show.checked(show.ShowConfig())
    assert config.tasks == tuple(TASKS) and config.robots == tuple(ROBOTS)
    assert config.domains == show.DOMAINS
    # Every paper domain on one robot, and every axis that changes what the camera sees.
    paper = {domain for domain in shifts.DOMAINS if not shifts.other_robot(domain)}
    axes = {name for name in shifts.AXES if not name.startswith("calibration")}
    assert set(show.DOMAINS) == paper | axes


def test_moments_of_an_episode() -> None:
    assert show.moments([0] * 9, [PICK]) == ([0, 4, 8], ["start", "middle", "end"])
    assert show.moments([0, 0, 0, 1, 1], [PICK, PLACE]) == ([0, 2, 4], ["start", "picked", "end"])
    # Dropped once: the first time counts. The last stage was never reached.
    dropped = [0, 1, 0, 1, 1, 2, 2]
    assert show.moments(dropped, [PICK, PLACE, PICK, PLACE]) == (
        [0, 0, 4, 6],
        ["start", "picked 1", "placed 1", "end"],
    )


@pytest.mark.parametrize("view", show.VIEWS.values(), ids=list(show.VIEWS))
def test_views_are_the_poses_of_cameras(view: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
    pose = show.looking_at(*view)
    np.testing.assert_allclose(pose, oracles.looking_at(*map(np.array, view)), atol=1e-6)


def test_batches_are_filled_up() -> None:
    assert list(show._batches([1, 2, 3, 4, 5], 2)) == [[1, 2], [3, 4], [5, 5]]
    assert list(show._batches([1], 3)) == [[1, 1, 1]]


class StubStudio:
    """Grey pictures whose level says what they are of."""

    def __init__(self, env: Any, worlds: int, size: int) -> None:
        self.env, self.size = env, size

    def grey(self, level: int) -> np.ndarray:
        return np.full((self.size, self.size, 3), level, np.uint8)

    def starts(self, seed: int, params: list[Any], *, seen_by: Any = None) -> list[np.ndarray]:
        return [self.grey(round(200 * float(p.camera_fovy) / 48)) for p in params]

    def expert(self, seed: int) -> tuple[list[np.ndarray], list[str]]:
        return [self.grey(50), self.grey(90), self.grey(130)], ["start", "middle", "end"]

    def portraits(self, seed: int) -> list[np.ndarray]:
        return [self.grey(110)] * (len(show.VIEWS) + 1)

    def close(self) -> None:
        pass


def test_files(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through the command, with a stub for the renderer: the five kinds of files, and that the
    shift is in the pictures (a camera of 40 and of 48 degrees: grey 167 and 200)."""
    monkeypatch.setattr(show, "Studio", StubStudio)
    words = ["--tasks", "lift_lid", "--robots", "panda", "ur5", "--out", str(tmp_path / "new")]
    assert show.main([*words, "--domains", "in_domain", "field_of_view"]) == 0
    names = ["worlds.png", "robots.png", "axes.png", "methods.png", "lift_lid.png"]
    printed = capsys.readouterr().out.splitlines()
    assert {str(tmp_path / "new" / name) for name in names} <= set(printed)
    levels = {name: np.asarray(Image.open(tmp_path / "new" / name).convert("L")) for name in names}
    # Two rows of one picture each per level: the axes' five strengths give more of them.
    cell = 190 * 190
    counts = {name: np.bincount(level.ravel(), minlength=256) for name, level in levels.items()}
    assert counts["worlds.png"][[167, 200]].min() > 2 * cell
    assert counts["robots.png"][110] > 2 * len(show.VIEWS) * cell
    assert counts["axes.png"][133] > cell and counts["axes.png"][200] > cell
    assert counts["methods.png"][167] > 8 * 7 * cell  # the paper's domains, methods and the camera
    assert counts["lift_lid.png"][[50, 90, 130]].min() > 2 * cell
