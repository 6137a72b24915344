"""The page of a table: every number of the file is on it, and nothing around it is touched."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palm_jax.envs.shifts import DOMAINS
from palm_jax.train import config, table
from palm_jax.train.files import records, tables
from palm_jax.train.files.tables import Cell
from palm_jax.train.reporting import paper, table_page
from palm_jax.train.table import TableConfig

METHODS = ("palm", "bc")


def record(generator: np.random.Generator, episodes: int) -> records.DomainRecord:
    return records.DomainRecord(
        success=generator.random(episodes) < 0.7,
        nan=np.zeros(episodes, bool),
        object_xy=generator.uniform((0.1, -0.3), (0.4, 0.3), (episodes, 2)).astype(np.float32),
        camera_angle=generator.uniform(-0.5, 0.5, episodes).astype(np.float32),
        length=np.full(episodes, 50, np.int32),
        draws=np.ones(episodes, np.int32),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of two methods on two tasks, PALM with two seeds, and its episodes."""
    folder = tmp_path_factory.mktemp("table")
    generator = np.random.default_rng(0)
    asked = TableConfig(preset="quick", tasks=("lift_lid", "insert_peg"), methods=METHODS)
    content: dict[str, Any] = {"header": table.header(asked), "results": {}, "failed": {}}
    episodes = {}
    for task in asked.tasks:
        for method, seed in (("palm", "0"), ("palm", "1"), ("bc", "0")):
            found = {domain: record(generator, 20) for domain in DOMAINS}
            row = content["results"].setdefault(task, {}).setdefault(method, {})
            row[seed] = records.counts(found)
            episodes[Cell(task, method, int(seed))] = found
    content["failed"] = {"lift_lid": {"arro": {"0": "arro.log"}}}
    content["demonstrations"] = {
        "lift_lid": {"palm": {"0": "a" * 64, "1": "b" * 64}, "bc": {"0": "a" * 64}},
        "insert_peg": {"palm": {"0": "c" * 64, "1": "c" * 64}},
    }
    path = folder / "table.json"
    successes = {domain: 12 for domain in DOMAINS}
    variants = {"aligned": successes, "unaligned": successes | {"viewpoint": 10}}
    hands = {"quoted": "aligned", "successes": variants}
    content["hands"] = {"lift_lid": {"bc": {"0": hands}}}
    path.write_text(json.dumps(content))
    tables.save_episodes(path, episodes)
    return path


@pytest.fixture(scope="module")
def page(made: Path) -> str:
    path = made.parent / "results.md"
    begin, end = table_page.markers("quick")
    path.write_text(f"# Before\n\n{begin}\nstale words\n{end}\n\nAfter.\n")
    assert table.main(["--json", str(made), "--page", str(path)]) == 0
    return path.read_text()


def test_what_is_around_stays(page: str) -> None:
    assert (
        page.startswith("# Before\n") and page.endswith("\nAfter.\n") and "stale words" not in page
    )


def test_every_policy_has_its_counts(page: str, made: Path) -> None:
    for row in json.loads(made.read_text())["results"].values():
        for seeds in row.values():
            for counts in seeds.values():
                cells = [f"{counts[d]['successes']}/20" for d in DOMAINS]
                assert re.search(r"\| " + cells[0] + r" \([^|]*\| " + " | ".join(cells[1:]), page)


def test_each_seed_is_told_where_there_are_several() -> None:
    def counts(good: int, shifted: int) -> dict[str, dict[str, int]]:
        solved = dict.fromkeys(DOMAINS, shifted) | {"in_domain": good}
        return {d: {"successes": n, "episodes": 20, "nan": 0} for d, n in solved.items()}

    several = {"0": counts(20, 15), "1": counts(10, 10), "2": counts(20, 20)}
    results = {task: {"palm": several, "bc": {"0": counts(20, 0)}} for task in paper.TABLE_TASKS}
    results["lift_lid"] = {"palm": {"0": counts(20, 20), "1": counts(1, 0)}, "bc": {}}
    lines = table_page._seeds({"results": results}).splitlines()
    # A quarter on three tasks of four; and of three tasks, as one is not done at all.
    assert lines[2:] == ["| PALM | 0 | 1.00 | 0.19 |", "| PALM | 1 | 0.39 | 0.00 |"]
    assert table_page._seeds({"results": {}}) == ""


def test_who_learns_nothing_has_nothing_to_lose() -> None:
    def row(solved: int) -> list[str]:
        counts = {domain: {"successes": 0, "episodes": 20, "nan": 0} for domain in DOMAINS}
        counts["in_domain"]["successes"] = solved
        return table_page._policy({"preset": "cpu"}, Cell("lift_lid", "bc", 0), counts, None)

    assert row(1)[-2] == "-" and row(2)[-2] == "1.00"


def test_the_command_beside_a_policy_is_its_own(page: str) -> None:
    commands = re.findall(r"`python -m palm_jax\.train ([^`]*)`", page)
    parsed = [config.parse(words.split()) for words in commands]
    assert {(c.task, *c.method, c.seed) for c in parsed} == {
        (task, method, seed)
        for task in ("lift_lid", "insert_peg")
        for method, seed in (("palm", 0), ("palm", 1), ("bc", 0))
    }
    wanted = table.cell_config(TableConfig(preset="quick"), Cell("lift_lid", "bc", 0))
    same = next(c for c in parsed if c.task == "lift_lid" and c.method == ("bc",))
    for name in ("demo_seed", "eval_seed", "domains", "steps", "sweep", "scenes"):
        assert getattr(same, name) == getattr(wanted, name)


def test_what_was_not_run_is_said(page: str) -> None:
    line = next(line for line in page.splitlines() if line.startswith("Not complete: "))
    assert "PALM (Lift Spam, Rearrange Veggies)" in line and "ARRO (every task)" in line


def test_collections_of_several_machines_are_counted(page: str) -> None:
    assert "there are 2 collections of Lift Lid. The JSON" in page


def test_the_hand_that_is_quoted_is_told_with_the_other(page: str) -> None:
    lines = [
        line.split(" | ")[:3]
        for line in page.splitlines()
        if line.startswith(("| BC |", "| PALM |"))
    ]
    assert [line[2] for line in lines if len(line) == 3 and line[1] in "01"] == [
        "-", "-", "aligned: 96 (unaligned: 94)", "-", "-", "-",
    ]  # fmt: skip


@pytest.mark.parametrize("damage", ["a digit", "another sum", "no episodes", "a foreign name"])
def test_what_does_not_fit_together_is_not_published(
    damage: str, made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, page = tmp_path / "table.json", tmp_path / "page.md"
    content, episodes = json.loads(made.read_text()), tables.load_episodes(made)
    counts = content["results"]["lift_lid"]["bc"]["0"]["viewpoint"]
    good = counts["successes"]
    if damage != "another sum":
        tables.store(path, content)
    if damage == "a digit":
        path.write_text(path.read_text().replace('"episodes": 20', '"episodes": 21', 1))
        words = "table.json: the content is not what was written"
    elif damage == "another sum":
        counts["successes"] = good + 1 if good < 20 else good - 1
        tables.store(path, content)
        words = "table.json: lift_lid/bc-s0: viewpoint"
    elif damage == "no episodes":
        words = "table.json: lift_lid/palm-s0: in_domain"
    else:
        words = "expected arrays named TASK/METHOD/SEED/DOMAIN/..., got 'viewpoint'"
    if damage == "a foreign name":
        some = episodes[Cell("lift_lid", "bc", 0)]["viewpoint"]
        records.save_eval(tables.episodes_file(path), {"viewpoint": some})
    elif damage != "no episodes":
        tables.save_episodes(path, episodes)
    assert table.main(["--json", str(path), "--page", str(page)]) == 2
    assert words in capsys.readouterr().err and not page.exists()


def test_what_failed_is_said(page: str) -> None:
    assert "Failed, and in no number above: Lift Lid, ARRO, seed 0." in page


def test_the_figures_are_there(page: str, made: Path) -> None:
    figures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", page)
    assert len(figures) == 4
    assert all((made.parent / figure).stat().st_size > 1000 for figure in figures)


def test_episodes_of_seeds_are_joined(made: Path) -> None:
    found = table_page._joined(tables.load_episodes(made))
    assert found["lift_lid"]["palm"]["workspace"].episodes == 40
    assert found["lift_lid"]["bc"]["workspace"].episodes == 20


def test_a_page_without_markers_is_not_touched(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "page.md"
    path.write_text("# Mine\n")
    assert table.main(["--json", str(made), "--page", str(path)]) == 2
    assert "markers" in capsys.readouterr().err and path.read_text() == "# Mine\n"
