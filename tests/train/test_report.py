"""The HTML report: complete, self-contained, escaped, and honest about what is missing."""

import base64
import html.parser
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palm_jax.train import report
from palm_jax.train.files import records
from palm_jax.train.reporting import figures, page, runs, videos

VOID = {"meta", "img", "br", "link", "input", "hr"}


class Reader(html.parser.HTMLParser):
    """Checks that tags nest, and collects text, table cells and everything that is loaded."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.loads: list[str] = []
        self.rows: list[list[str]] = []
        self.text = ""
        self.seen: list[str] = []
        self.feed(content)
        self.close()
        assert self.stack == [], "unclosed tags"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]
        if tag not in VOID:
            self.stack.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        if "style" not in self.stack:
            self.text += data + " "
        if {"td", "th"} & set(self.stack):
            cell = self.rows[-1][-1]
            self.rows[-1][-1] = f"{cell} {data}".strip()

    def row(self, name: str) -> list[str]:
        """The cells after the one that starts with `name`."""
        (found,) = [r for r in self.rows if r and re.match(rf"{re.escape(name)}( |$)", r[0])]
        return found[1:]


def episodes(good: int, total: int, nan: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(total)
    return {
        "success": np.arange(total) < good,
        "nan": np.arange(total) >= total - nan,
        "object_xy": rng.uniform((0.05, -0.35), (0.45, 0.35), (total, 2)),
        "camera_angle": rng.uniform(-0.5, 0.5, total),
        "length": np.full(total, 50),
        "draws": np.arange(total) // (total - 1) + 1,  # the last one twice
    }


def write_run(folder: Path, method: str, good: dict[str, int], **config: Any) -> None:
    folder.mkdir(parents=True)
    record = {d: episodes(k, 24, nan=int(d == "E")) for d, k in good.items()}
    records.save_eval(folder / "eval.npz", record)
    counts = records.counts({d: records.domain_record(r) for d, r in record.items()})
    (folder / "eval.json").write_text(json.dumps(counts))
    settings = {"task": "lift_lid", "method": method, "preset": "quick", "seed": 3, **config}
    (folder / "config.json").write_text(json.dumps(settings))
    about = {"date": "2031-02-03", "machine": "2 cores", "versions": {"jax": "9.8.7"}, "wall_s": 61}
    (folder / "env.json").write_text(json.dumps(about))
    lines = [json.dumps({"step": step, "loss": 1 / (1 + step)}) for step in range(5)]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")


PALM = {"ID": 24, "W": 21, "V": 18, "E": 12}
BC = {"ID": 12, "W": 3, "V": 6, "E": 0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods with a sweep, videos, a picture of somebody else, and HTML in a name."""
    root = tmp_path_factory.mktemp("runs") / "demo"
    write_run(root / "palm", "palm", PALM, learner={"width": 16}, demos=60)
    write_run(root / "bc", "bc", BC, note="<script>alert('x')</script>")
    sweep = records.Sweep(
        np.radians([-20.0, 0.0, 20.0]), np.array([0.1, 0.3]), np.array([-0.2, 0.0, 0.2]),
        np.ones((3, 2, 3, 2), bool), np.zeros((3, 2, 3, 2), bool),
    )  # fmt: skip
    records.save_sweep(root / "palm" / "sweep.npz", sweep)
    records.save_sweep(root / "palm" / "sweep-ur5.npz", sweep)
    some = np.ones((2, 5), bool)
    curve = records.StrengthSweep("object_color", np.array([-1.0, 1.0]), some, ~some)
    records.save_sweep(root / "bc" / "strength-object_color.npz", curve)
    y = np.arange(24, dtype=np.uint8)
    clip = [np.stack([np.add.outer(y, y + i)] * 3, -1).astype(np.uint8) for i in range(4)]
    videos.write_video(root / "videos" / "bc_workspace_viewpoint_2.mp4", clip)
    videos.write_video(root / "palm" / "videos" / "in-domain.mp4", clip)
    figures.save(figures.gallery({"palm": {"ID": clip[0]}}), root / "figures" / "policy_inputs.png")
    return root


@pytest.fixture(scope="module")
def content(folder: Path) -> str:
    return report.write_report(folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def read(content: str) -> Reader:
    return Reader(content)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of the text: no figures, which take most of the time."""
    monkeypatch.setattr(report, "draw", lambda methods, folder, prefix: [])


def test_the_page_is_one_file_without_scripts_or_requests(content: str, read: Reader) -> None:
    assert content.startswith("<!doctype html>")
    assert read.loads and all(value.startswith("data:") for value in read.loads)
    assert not {"script", "link", "iframe", "object"} & set(read.seen)
    style = content[content.index("<style>") : content.index("</style>")]
    assert "url(" not in style and "@import" not in style
    assert "http" not in style


def test_embedded_media_are_the_files(folder: Path, read: Reader) -> None:
    inside = [base64.b64decode(value.partition("base64,")[2]) for value in read.loads]
    expected = [*(folder / "figures").glob("*.png"), *folder.rglob("videos/*.mp4")]
    assert len(expected) == len(inside) == 9 + 2
    assert {file.read_bytes() for file in expected} == set(inside)


def test_figures_made(folder: Path) -> None:
    assert {file.name for file in (folder / "figures").iterdir()} == {
        "domains.png", "samples.png", "heatmap.png", "angles.png", "training.png",
        "policy_inputs.png", "heatmap-ur5.png", "angles-ur5.png", "strength.png",
    }  # fmt: skip


def test_sweeps_with_another_robot_and_over_a_strength_are_told_apart(read: Reader) -> None:
    for text in (
        "Success over the object's start position, from a sweep",
        "Success with the robot ur5 over the object's start position, from a sweep",
        "Success with the robot ur5 over the camera's rotation",
        "Success over the strength of a shift (first seed)",
    ):
        assert text in read.text


@pytest.mark.usefixtures("undrawn")
def test_eight_domains_and_others(tmp_path: Path) -> None:
    """The paper's order and its mean over seven; another domain has a row, and no part in it."""
    good = {"workspace+viewpoint+embodiment": 12, "lighting": 0, "viewpoint_cone+object_color": 6}
    good |= {"in_domain": 24, "viewpoint+embodiment": 18, "workspace+embodiment": 24}
    good |= {"embodiment": 12, "workspace+viewpoint": 24, "viewpoint": 18, "workspace": 24}
    write_run(tmp_path / "palm", "palm", good, robot="panda", other_robot="ur5")
    read = Reader(report.build(tmp_path / "palm"))
    names = [row[0] for row in read.rows]
    assert names[2:] == [
        "ID in-domain", "W workspace", "V viewpoint", "E embodiment", "W+V workspace + viewpoint",
        "W+E workspace + embodiment", "V+E viewpoint + embodiment", "All all three",
        "lighting", "viewpoint cone + object color", "OOD mean",
    ]  # fmt: skip
    assert read.row("lighting")[1].startswith("1.00")
    # (0 + .25 + .5 + 0 + 0 + .25 + .5) / 7, and the last row of the paper's Table I.
    assert read.row("OOD mean") == ["", "0.21 paper 0.08"]
    assert "embodiment ur5" in " ".join(read.text.split())


@pytest.mark.usefixtures("undrawn")
def test_start_poses_drawn_again_are_told(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "palm", {"in_domain": 24, "embodiment": 12})
    text = " ".join(Reader(report.build(tmp_path / "a")).text.split())
    assert "could not reach it: ID 1.04 (most 2), E 1.04 (most 2)." in text
    record = {**episodes(3, 24), "draws": np.ones(24)}
    records.save_eval(tmp_path / "a" / "eval.npz", {"in_domain": record})
    assert "could not reach it: ID 1.00 (most 1)." in report.build(tmp_path / "a")
    records.save_eval(tmp_path / "a" / "eval.npz", {"in_domain": {**record, "draws": np.zeros(24)}})
    assert "Start poses drawn" not in report.build(tmp_path / "a")


def test_table_by_hand(read: Reader) -> None:
    # success: ours, interval, paper; degradation: ours, interval, paper. PALM, then BC.
    palm_rate, palm_loss, bc_rate, bc_loss = read.row("W")
    assert palm_rate == "88 % 69–96 paper ≈ 73"
    assert palm_loss.startswith("0.12 ") and palm_loss.endswith(" paper −0.02")
    assert bc_rate == "12 % 4–31 paper ≈ 31"
    assert bc_loss.startswith("0.75 ") and bc_loss.endswith(" paper 0.40")
    assert read.row("ID") == ["100 % 86–100 paper 72", "", "50 % 31–69 paper 52", ""]
    # E: 12 of 24, one of them went NaN but is no success anyway. Means: (.125 + .25 + .5) / 3 and
    # (.75 + .5 + 1) / 3; the paper's over the same domains: .14 / 3 and 1.8 / 3.
    assert read.row("OOD mean") == ["", "0.29 paper 0.05", "", "0.75 paper 0.60"]


def test_header_footnotes_and_command(read: Reader) -> None:
    for text in ("Lift Lid", "PALM, BC", "quick", "2031-02-03", "jax 9.8.7", "2 min 02 s in all"):
        assert text in read.text
    assert "24 scenes per domain and run" in read.text
    assert "2 of 192 episodes went non-finite" in read.text
    assert "base width 16 trained from scratch" in read.text
    assert "Demonstrations: 60" in read.text
    command = "python -m palm_jax.train --task lift_lid --method palm --preset quick --seed 3"
    assert command in read.text


@pytest.mark.usefixtures("undrawn")
def test_both_initial_yaws_are_told(tmp_path: Path) -> None:
    write_run(tmp_path / "bc", "bc", {"in_domain": 24, "viewpoint": 12})
    count = {"episodes": 24, "nan": 0}
    other = {"in_domain": {"successes": 24, **count}, "viewpoint": {"successes": 5, **count}}
    variants = {"quoted": "unaligned", "unaligned": {}, "aligned": other}
    (tmp_path / "bc" / "eval_variants.json").write_text(json.dumps(variants))
    text = " ".join(Reader(report.build(tmp_path)).text.split())
    assert "the better is quoted (not turned with the camera)" in text
    assert "Turned with the camera: V 5/24 (quoted: 12/24)." in text


def test_everything_is_escaped(content: str, read: Reader) -> None:
    assert "<script>alert" not in content
    assert "<script>alert('x')</script>" in read.text  # shown as text, in the raw configuration


def test_video_captions(content: str) -> None:
    assert "<figcaption>BC, workspace + viewpoint, 2</figcaption>" in content
    assert "<figcaption>PALM, in-domain</figcaption>" in content


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("palm-crop_wv_03", ("palm-crop", "WV", "03")),
        ("palm-ID", ("palm", "ID", "")),
        ("bc_viewpoint", ("bc", "V", "")),
        ("teaser", ("", "", "teaser")),
        ("palm_workspace_viewpoint_success1", ("palm", "WV", "success 1")),
        ("mirrorduo-all-1", ("mirrorduo", "WVE", "1")),
    ],
)
def test_clip_names(stem: str, expected: tuple[str, str, str]) -> None:
    assert report.clip_name(stem) == expected


@pytest.mark.usefixtures("undrawn")
def test_a_single_run_folder(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "bc", tmp_path / "bc")
    (tmp_path / "bc" / "env.json").write_text(json.dumps({"command": ["python", "x y.py"]}))
    read = Reader(report.write_report(tmp_path / "bc", out=tmp_path / "o" / "p.html").read_text())
    assert (tmp_path / "o" / "p.html").exists()
    assert read.row("ID") == ["50 % 31–69 paper 52", ""]
    assert "python 'x y.py'" in read.text


@pytest.mark.usefixtures("undrawn")
def test_a_run_of_several_sessions_tells_of_all(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "bc", tmp_path / "bc")
    entries = [
        {"date": f"2031-02-0{day}", "versions": {"jax": f"9.8.{day}"}, "command": f"train {day}"}
        for day in (3, 4)
    ]
    content = {"sessions": [{**entries[0], "wall_s": 61}, entries[1], {**entries[1], "wall_s": 5}]}
    (tmp_path / "bc" / "env.json").write_text(json.dumps(content))
    read = Reader(report.write_report(tmp_path / "bc").read_text())
    for word in ("2031-02-03", "2031-02-04", "jax 9.8.3", "jax 9.8.4", "train 3", "train 4"):
        assert word in read.text, word
    assert "1 min 06 s in all" in read.text


def test_missing_parts_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text('{"task": "t", "method": "palm"}')
    read = Reader(report.build(tmp_path / "run"))
    assert "Not evaluated yet: PALM." in read.text
    assert "could not be used" not in read.text
    assert not read.loads


def test_damaged_inputs_are_named_and_the_rest_is_shown(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "palm"
    shutil.copytree(folder / "palm", run)
    (run / "eval.npz").write_bytes((run / "eval.npz").read_bytes()[:300])
    (run / "env.json").write_text("{broken")
    (run / "sweep.npz").write_bytes(b"")
    (run / "videos" / "cut.mp4").write_bytes(b"\0" * 40)
    with (run / "metrics.jsonl").open("a") as file:
        file.write("rubbish\n{}\n")
    read = Reader(report.build(run))
    assert "could not be used" in read.text
    for name in ("eval.npz", "env.json", "sweep.npz", "cut.mp4", "metrics.jsonl"):
        assert name in read.text, name
    assert read.row("ID") == ["100 % 86–100 paper 72", ""]
    assert sum(value.startswith("data:video") for value in read.loads) == 1


@pytest.mark.usefixtures("undrawn")
def test_large_videos_are_named_instead(folder: Path) -> None:
    read = Reader(report.build(folder, max_megabytes=0.0001))
    assert not any(value.startswith("data:video") for value in read.loads)
    assert "Too large for this page: " in read.text
    assert "videos/bc_workspace_viewpoint_2.mp4" in read.text


@pytest.mark.usefixtures("undrawn")
def test_seeds_are_pooled_and_tasks_averaged(tmp_path: Path) -> None:
    write_run(tmp_path / "a" / "palm" / "0", "palm", {"ID": 24, "W": 12})
    write_run(tmp_path / "a" / "palm" / "1", "palm", {"ID": 12, "W": 6}, seed=4)
    write_run(tmp_path / "b" / "palm", "palm", {"ID": 24, "W": 24}, task="insert_peg")
    read = Reader(report.build(tmp_path))
    # Lift Lid: ID 36/48, W 18/48, loss 1/2. Insert Peg: 24/24, 24/24, loss 0. Means: 7/8 and 1/4.
    cells = read.row("PALM")
    assert re.fullmatch(r"88 % \d+–\d+ paper 72", cells[0])
    assert cells[1] == "0.25 paper −0.02" and cells[2] == "–"
    assert cells[-1] == "0.25 paper −0.02"
    rates = [row[1] for row in read.rows if row[0].startswith("W workspace")]
    assert rates == ["38 % 25–52 paper ≈ 73", "100 % 86–100 paper ≈ 73"]
    assert "Up to 2 training seeds per method are pooled" in read.text


def test_finding_runs_skips_their_own_folders(tmp_path: Path) -> None:
    write_run(tmp_path / "x" / "palm", "palm", {"ID": 3})
    (tmp_path / "x" / "config.json").write_text("{}")
    for inner in ("checkpoints/10", "figures", "videos"):
        (tmp_path / "x" / inner).mkdir(parents=True)
        (tmp_path / "x" / inner / "config.json").write_text("{}")
    (tmp_path / "empty").mkdir()
    assert runs.find_runs(tmp_path) == [tmp_path / "x" / "palm"]


def test_recorded_regions_are_used() -> None:
    regions = runs.regions_of({"env": {"regions": {"train_x": [0.1, 0.2], "other": 3}}})
    assert regions.train_x == (0.1, 0.2) and regions.test_y == (-0.35, 0.35)


@pytest.mark.usefixtures("undrawn")
def test_degradation_needs_an_in_domain_success(tmp_path: Path) -> None:
    write_run(tmp_path / "bc", "bc", {"ID": 0, "W": 3})
    read = Reader(report.build(tmp_path))
    assert read.row("W")[1] == "– paper 0.40"
    assert page.tiles({"palm": {"W": {"successes": 1, "episodes": 2, "nan": 0}}}) == ""


@pytest.mark.usefixtures("undrawn")
def test_command_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "page.html"
    assert report.main([str(folder / "bc"), "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out and out.exists()
    assert report.main([str(tmp_path / "nowhere")]) == 2
    assert "is not a folder" in capsys.readouterr().err
    (tmp_path / "empty").mkdir()
    assert report.main([str(tmp_path / "empty")]) == 2
    assert "no run in" in capsys.readouterr().err
