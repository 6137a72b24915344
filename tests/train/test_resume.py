"""A killed training goes on as if nothing had happened, bit for bit."""

import json
import signal
import time
from pathlib import Path
from typing import Any

import play
import pytest

WORDS: dict[str, Any] = {"steps": 24, "checkpoint_every": 5}

pytestmark = pytest.mark.long


def logged(folder: Path) -> list[dict[str, Any]]:
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody disturbed."""
    folder = tmp_path_factory.mktemp("reference") / "run"
    play.finish(play.start(folder, **WORDS))
    assert set(play.scores(folder)) >= {20, 24}
    return folder


def test_a_killed_run_resumes_bit_for_bit(reference: Path, tmp_path: Path) -> None:
    """SIGKILL between two checkpoints, twice: all that comes out is equal."""
    run = tmp_path / "run"
    for number, target in enumerate((7, 18), 1):
        process = play.start(run, options={"pause": 0.2}, **WORDS)
        deadline = time.monotonic() + 240
        while process.poll() is None and time.monotonic() < deadline:
            if logged(run) and logged(run)[-1]["step"] >= target:
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        output, _ = process.communicate()
        assert process.returncode == -signal.SIGKILL, output
        assert not (run / "final.npz").exists()
        kept = [int(p.name) for p in (run / "checkpoints").iterdir() if p.name.isdigit()]
        assert kept and max(kept) % 5 == 0 and 0 < max(kept) < 24
        # Who was killed is told of, too.
        sessions = json.loads((run / "env.json").read_text())["sessions"]
        assert len(sessions) == number and not any("wall_s" in entry for entry in sessions)
    play.finish(play.start(run, **WORDS))
    play.assert_same(reference, run)
    steps = [row["step"] for row in logged(run) if "loss" in row]
    assert steps == list(range(1, 25))


def test_the_seed_is_all_there_is(reference: Path, tmp_path: Path) -> None:
    """Two runs with one seed are identical; another seed gives other parameters."""
    for name, seed in (("again", 0), ("other", 1)):
        play.finish(play.start(tmp_path / name, seed=seed, **WORDS))
    play.assert_same(reference, tmp_path / "again")
    first, second = play.final(reference), play.final(tmp_path / "other")
    weights = [name for name in first if name.startswith(".params") and first[name].ndim > 1]
    assert weights and all((first[name] != second[name]).any() for name in weights)
