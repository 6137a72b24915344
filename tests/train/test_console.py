"""Progress, tables and messages, on a console without a terminal and on one with."""

import io
import shlex

import pytest
from rich.console import Console

from palm_jax.train.reporting import console as printing


class Clock:
    """Seconds that pass only when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def plain() -> tuple[Console, io.StringIO]:
    out = io.StringIO()
    return Console(file=out, force_terminal=False, width=100, highlight=False), out


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.94, "9.9 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (200, "3 min 20 s"),
        (7501, "2 h 05 min"),
        (float("inf"), "?"),
        (float("nan"), "?"),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert printing.duration(seconds) == text


def run_loop(pieces: int, seconds_each: float, **options: int) -> list[str]:
    console, out = plain()
    clock = Clock()
    with printing.ProgressBar(console, pieces, "train [x]", clock=clock, **options) as bar:  # type: ignore[arg-type]
        for index in range(pieces - options.get("done", 0)):
            clock.now += seconds_each
            bar.advance(loss=0.5 / (index + 1))
    return out.getvalue().splitlines()


def test_short_loops_print_nothing() -> None:
    assert run_loop(29, 0.1) == []


def test_without_a_terminal_a_line_about_every_ten_seconds() -> None:
    lines = run_loop(60, 1.0)
    # First after 3 s, then after 13, 23, ... 53 s, and the end.
    assert lines[0] == "train [x]: 5 %  3/60  1.0 steps/s  57 s left  loss 0.167"
    assert [line.split()[4] for line in lines[:-1]] == [
        "3/60", "13/60", "23/60", "33/60", "43/60", "53/60",
    ]  # fmt: skip
    assert lines[-1] == "train [x]: 60 steps in 1 min 00 s, 1.0 steps/s  loss 0.00833"


def test_work_of_an_earlier_run_does_not_count_for_the_rate() -> None:
    lines = run_loop(60, 1.0, done=50)
    assert lines[0].startswith("train [x]: 88 %  53/60  1.0 steps/s  7.0 s left")
    assert lines[-1].startswith("train [x]: 10 steps in 10 s, 1.0 steps/s")


def test_slow_work_shows_seconds_per_piece() -> None:
    assert "4.0 s/step" in run_loop(3, 4.0)[0]


def test_an_interrupted_loop_claims_no_end() -> None:
    console, out = plain()
    clock = Clock()
    bar = printing.ProgressBar(console, 9, "x", clock=clock)
    with pytest.raises(KeyboardInterrupt), bar:
        clock.now += 4
        bar.advance()
        raise KeyboardInterrupt
    assert out.getvalue().splitlines() == ["x: 11 %  1/9  4.0 s/step  32 s left"]


def test_terminal_gets_a_bar_after_three_seconds() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100, color_system=None)
    clock = Clock()
    with printing.ProgressBar(console, 10, "train", clock=clock) as bar:
        clock.now += 2
        bar.advance()
        assert out.getvalue() == ""
        clock.now += 2
        bar.advance()
    assert "20 %" in out.getvalue() and "2/10" in out.getvalue()


def test_track_yields_everything() -> None:
    console, _ = plain()
    assert list(printing.track(console, [3, 1, 2], "x")) == [3, 1, 2]


def test_header_shows_markup_as_text() -> None:
    console, out = plain()
    printing.header(console, "train", {"out": "runs/[red]x", "seed": 3})
    assert "runs/[red]x" in out.getvalue() and "seed" in out.getvalue()


COUNTS = {
    "bc": {"ID": {"successes": 12, "episodes": 24, "nan": 0}},
    "palm": {
        "W": {"successes": 21, "episodes": 24, "nan": 1},
        "ID": {"successes": 24, "episodes": 24, "nan": 0},
        "V": {"successes": 18, "episodes": 24, "nan": 2},
    },
}


def rows(counts: dict[str, dict[str, dict[str, int]]]) -> tuple[dict[str, list[str]], str]:
    console, out = plain()
    printing.results(console, counts)
    lines = [line.split() for line in out.getvalue().splitlines() if line.strip()]
    return {line[0]: line[1:] for line in lines}, " ".join(out.getvalue().split())


def test_results_table_by_hand() -> None:
    table, text = rows(COUNTS)
    assert list(table)[:2] == ["Success", "domain"]
    # ours (interval), [loss,] paper; PALM before BC.
    assert table["ID"] == ["100", "(86-100)", "72", "%", "50", "(31-69)", "52", "%"]
    assert table["W"] == ["88", "(69-96)", "0.12", "-0.02", "0.40"]
    assert table["V"] == ["75", "(55-88)", "0.25", "0.06", "0.61"]
    assert table["OOD"] == ["mean", "0.19", "0.02"]  # the paper's over W and V; BC has no OOD here
    assert "3 episodes went non-finite and count as failures" in text


def test_many_methods_get_a_row_each() -> None:
    counts = {name: COUNTS["palm"] for name in ("palm", "palm-crop", "arro", "mine")}
    table, _ = rows(counts)
    assert table["ARRO"] == ["100", "88", "75", "0.19", "0.40"]  # the paper's (.25 + .55) / 2
    assert table["mine"] == ["100", "88", "75", "0.19"]


def test_the_mean_is_over_the_papers_domains() -> None:
    """As in the paper: what it has no number for is shown, and in no mean."""
    counts = {"palm": {**COUNTS["palm"], "lighting": {"successes": 0, "episodes": 24, "nan": 0}}}
    table, _ = rows(counts)
    assert table["lighting"] == ["0", "(0-14)", "1.00"]
    assert table["OOD"] == ["mean", "0.19", "0.02"]


def test_no_results_no_table() -> None:
    console, out = plain()
    printing.results(console, {"palm": {}})
    assert out.getvalue() == ""


def test_interrupted_command_can_be_pasted() -> None:
    console, out = plain()
    command = ["python", "-m", "palm_jax.train", "--out", "runs/my " + "long " * 30, "--resume"]
    printing.interrupted(console, command, saved="step 12 of 20")
    lines = out.getvalue().splitlines()
    assert "Stopped. Saved: step 12 of 20." in lines
    assert shlex.split(lines[-1]) == command
