"""`python -m palm_jax report RUN|DIR`: everything about one or more runs on one HTML page.

The page is one file without scripts or outside requests: styles inline, pictures and videos as
base64. It is built from what the run folders hold (`palm_jax.train.files.records`). A missing input
leaves its part out; a damaged one is named on the page, and the rest is shown.

DIR may be one run, or hold runs at any depth: methods, seeds and tasks are read from each
`config.json`. Seeds of a method are pooled, tasks get a section each, and several tasks a table of
their means, which is what the paper's Table I shows.
"""

import json
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from palm_jax import __version__
from palm_jax.train.files import records
from palm_jax.train.files.metrics import write_atomic
from palm_jax.train.reporting import figures, grids, paper
from palm_jax.train.reporting.console import duration
from palm_jax.train.reporting.page import (
    CSS,
    damaged_media,
    esc,
    held_out_table,
    listing,
    mean_table,
    picture,
    result_table,
    section,
    tiles,
    video,
)
from palm_jax.train.reporting.runs import (
    Run,
    find_runs,
    grouped,
    load_run,
    lookup,
    pooled,
    pooled_episodes,
    regions_of,
)


def draw(methods: Mapping[str, list[Run]], folder: Path, prefix: str) -> list[tuple[Path, str]]:
    """Draw whatever the runs of one task allow, as PNG files in `folder`.

    Returns:
      (file, caption) in the order of the page.
    """
    regions = regions_of(next(iter(methods.values()))[0].config)
    episodes = {name: pooled_episodes(runs) for name, runs in methods.items()}
    episodes = {name: by_domain for name, by_domain in episodes.items() if by_domain}
    counts = {name: entry for name, runs in methods.items() if (entry := pooled(runs))}
    made: list[tuple[Path, str]] = []

    def add(name: str, figure: Figure, caption: str) -> None:
        made.append((figures.save(figure, folder / f"{prefix}{name}.png"), caption))

    if counts:
        add(
            "domains",
            figures.domain_bars(counts),
            "Success per domain. Bars: this run, with Wilson 95 % intervals. Diamonds: what the "
            "paper's Table I implies, ID · (1 − degradation).",
        )
    pair = [name for name in ("bc", "palm") if name in episodes] or list(episodes)[:2]
    if pair:
        add(
            "samples",
            figures.sample_distribution({name: episodes[name] for name in pair}, regions),
            "Where each policy succeeds: one mark per scene over the object's start position "
            "(above), and scenes per ten degrees of camera rotation (below).",
        )
    made += _draw_sweeps(methods, episodes, regions, folder, prefix)
    made += _draw_strengths(methods, folder, prefix)
    metrics = {name: runs[0].metrics for name, runs in methods.items() if runs[0].metrics}
    if metrics:
        add(
            "training",
            figures.training_curves(metrics),
            "Training (the first seed of each method). Faint: every record; strong: running "
            "median.",
        )
    return made


def _draw_sweeps(
    methods: Mapping[str, list[Run]],
    episodes: Mapping[str, Mapping[str, records.DomainRecord]],
    regions: grids.Regions,
    folder: Path,
    prefix: str,
) -> list[tuple[Path, str]]:
    """Heatmaps and angle curves, a pair for each robot that was swept with.

    Those of the trained robot come from the evaluation where there is no sweep.
    """
    # The first seed: seeds may have been swept over different grids.
    first = {name: runs[0].sweeps for name, runs in methods.items()}
    made = []
    for robot in sorted({"", *(robot for sweeps in first.values() for robot in sweeps)}):
        sweeps = {name: by_robot[robot] for name, by_robot in first.items() if robot in by_robot}
        if sweeps:
            where = "from a sweep over positions and camera angles (first seed)"
            maps = {name: grids.grid_of_sweep(sweep) for name, sweep in sweeps.items()}
            curves = {name: grids.curve_of_sweep(sweep) for name, sweep in sweeps.items()}
        else:
            where = "from the scenes of the evaluation"
            maps = {
                name: grids.grid_of_records(chosen, regions)
                for name, by_domain in episodes.items()
                if (chosen := _domains(by_domain, "ID", "W"))
            }
            curves = {
                name: grids.curve_of_records(chosen, regions)
                for name, by_domain in episodes.items()
                if (chosen := _domains(by_domain, "V"))
            }
        suffix, actor = _robot_words(robot)
        if maps:
            file = folder / f"{prefix}heatmap{suffix}.png"
            figures.save(figures.heatmaps(maps, regions), file)
            made.append((file, f"Success{actor} over the object's start position, {where}."))
        if any(len(curve.at) > 1 for curve in curves.values()):
            file = folder / f"{prefix}angles{suffix}.png"
            figures.save(figures.angle_curves(curves, regions), file)
            text = f"Success{actor} over the camera's rotation, {where}; Wilson 95 % intervals."
            made.append((file, text))
    return made


def _draw_strengths(
    methods: Mapping[str, list[Run]], folder: Path, prefix: str
) -> list[tuple[Path, str]]:
    """Curves over the strength of shifts, a figure for each robot that was swept with."""
    panels: dict[str, dict[str, dict[str, grids.Curve]]] = {}  # robot -> shift -> method
    for name, runs in methods.items():
        for (robot, shift), found in runs[0].strengths.items():
            by_shift = panels.setdefault(robot, {}).setdefault(shift, {})
            by_shift[name] = grids.curve_of_strengths(found)
    made = []
    for robot, shown in sorted(panels.items()):
        suffix, actor = _robot_words(robot)
        file = folder / f"{prefix}strength{suffix}.png"
        figures.save(figures.strength_curves(shown), file)
        text = f"Success{actor} over the strength of a shift (first seed); Wilson 95 % intervals."
        made.append((file, text))
    return made


def _robot_words(robot: str) -> tuple[str, str]:
    """What a file name and a caption say of the robot; nothing for the trained one."""
    return (f"-{robot}", f" with the robot {robot}") if robot else ("", "")


def _domains(
    by_domain: Mapping[str, records.DomainRecord], *wanted: str
) -> list[records.DomainRecord]:
    return [record for name, record in by_domain.items() if paper.domain_key(name) in wanted]


def _unique(values: Iterable[Any]) -> str:
    """Distinct values in order, joined; lists and dicts as short text."""
    seen = []
    for value in values:
        if value in (None, "", [], {}):
            continue
        if isinstance(value, Mapping):
            text = " · ".join(f"{key} {item}" for key, item in value.items())
        elif isinstance(value, (list, tuple)):
            text = ", ".join(map(str, value))
        else:
            text = str(value)
        if text not in seen:
            seen.append(text)
    return (", " if max(map(len, seen), default=0) < 20 else "  |  ").join(seen)


def facts(runs: Sequence[Run]) -> dict[str, str]:
    """The header: what was run, when, where and with what."""

    def first(*names: str) -> str:
        found = []
        for run in runs:
            for session in run.sessions or [{}]:
                values = [lookup(session, name) for name in names]
                values += [lookup(run.config, name) for name in names]
                found.append(next((value for value in values if value is not None), None))
        return _unique(found)

    walls = [_seconds(session) for run in runs for session in run.sessions]
    known = [wall for wall in walls if wall is not None]
    wall = duration(sum(known)) + (" in all" if len(known) > 1 else "") if known else ""
    entries = {
        "task": _unique(paper.task_label(run.task) for run in runs if run.task),
        "data": _unique(lookup(run.config.get("source"), "name") for run in runs),
        "methods": ", ".join(
            paper.method_label(m) for m in paper.ordered_methods(list({run.method for run in runs}))
        ),
        "preset": first("preset"),
        "robot": first("robot"),
        "embodiment": first("other_robot") if any(map(_embodied, runs)) else "",
        "seeds": first("seed"),
        "date": first("date", "started", "time"),
        "wall time": wall,
        "machine": first("machine", "cpu", "platform"),
        "devices": first("devices", "device"),
        "versions": first("versions"),
        "commit": first("commit", "git_sha", "git"),
    }
    return {name: value for name, value in entries.items() if value}


def _embodied(run: Run) -> bool:
    return any("E" in domain for domain in run.counts if domain in paper.DOMAINS)


def _seconds(env: Mapping[str, Any]) -> float | None:
    for name in ("wall_s", "wall_time_s", "wall_seconds", "wall_time"):
        value = lookup(env, name)
        if isinstance(value, (int, float)):
            return float(value)
    return None


def commands(runs: Sequence[Run]) -> list[str]:
    """The commands that made the runs: as recorded, else put together from config.json."""
    lines = []
    for run in runs:
        found = [_command(session) for session in run.sessions]
        lines += [line for line in found if line] or [_command_of(run.config)]
    return list(dict.fromkeys(lines))


def _command(session: Mapping[str, Any]) -> str:
    recorded = lookup(session, "command") or lookup(session, "argv")
    if isinstance(recorded, list):
        return shlex.join(map(str, recorded))
    return recorded if isinstance(recorded, str) else ""


def _command_of(config: Mapping[str, Any]) -> str:
    words = ["python", "-m", "palm_jax.train"]
    for name in ("task", "method", "preset", "seed"):
        if (value := config.get(name)) is not None:
            words += [f"--{name}", str(value)]
    return shlex.join(words)


def variant_notes(runs: Iterable[Run]) -> list[str]:
    """Methods that were evaluated with two initial yaws of the hand: what the other one gave."""
    words = {"aligned": "turned with the camera", "unaligned": "not turned with the camera"}
    notes = []
    for run in runs:
        others = {name: entry for name, entry in run.variants.items() if name != run.quoted}
        for name, entry in others.items():
            turned = [d for d in entry if ("V" if d in paper.DOMAINS else "viewpoint") in d]
            numbers = ", ".join(
                f"{paper.domain_label(d)} {entry[d]['successes']}/{entry[d]['episodes']}"
                f" (quoted: {run.counts[d]['successes']}/{run.counts[d]['episodes']})"
                for d in paper.ordered_domains(turned)
                if d in run.counts
            )
            notes.append(
                f"{paper.method_label(run.method)} was evaluated with the hand's initial yaw "
                f"turned with the camera and without, and the better is quoted "
                f"({words.get(run.quoted, run.quoted)}). {words.get(name, name).capitalize()}: "
                f"{numbers or 'no turned domains'}."
            )
    return notes


def draw_notes(runs: Sequence[Run]) -> list[str]:
    """How many start poses were drawn, which tells how often the arm could not reach one."""
    found: dict[str, list[int]] = {}
    for run in runs:
        for domain, record in run.episodes.items():
            drawn = record.draws[record.draws > 0]  # 0: not recorded
            if drawn.size:
                found.setdefault(paper.domain_key(domain), []).extend(drawn)
    if not found:
        return []
    numbers = ", ".join(
        f"{paper.domain_label(d)} {np.mean(found[d]):.2f} (most {max(found[d])})"
        for d in paper.ordered_domains(list(found))
    )
    return [
        "Start poses drawn per scene, one for each stage of the task that began and another "
        f"wherever the arm could not reach it: {numbers}."
    ]


_RECORDED_NOTES = (
    "Episodes held out took no part in the training, but the checkpoint with the smallest loss on "
    "them was chosen: expect slightly more on new ones.",
    "The errors are those of single actions on recorded frames, not a rate of success: in a closed "
    "loop small errors add up, and some do not matter. Compare methods by them with care, and "
    "policies by trying them.",
    "R² is 1 where an action's number is foretold exactly, 0 where its mean would do as well, less "
    "where that would be better; – where it never varies.",
)


def footnotes(runs: Sequence[Run]) -> list[str]:
    """What a reader must know to weigh the numbers."""
    if all(run.recorded for run in runs):
        return list(_RECORDED_NOTES)
    notes = []
    scenes = sorted({entry["episodes"] for run in runs for entry in run.counts.values()})
    if scenes:
        count = f"{scenes[0]}" if len(scenes) == 1 else f"{scenes[0]} to {scenes[-1]}"
        seeds: dict[tuple[str, str], int] = {}
        for run in runs:
            seeds[run.task, run.method] = seeds.get((run.task, run.method), 0) + 1
        most = max(seeds.values())
        pooled_note = (
            f" Up to {most} training seeds per method are pooled: the intervals cover the choice "
            "of scenes, not the spread between seeds."
            if most > 1
            else " One training seed per method: the intervals cover the choice of scenes only."
        )
        notes.append(f"{count} scenes per domain and run; Wilson 95 % intervals.{pooled_note}")
    bad = sum(entry["nan"] for run in runs for entry in run.counts.values())
    total = sum(entry["episodes"] for run in runs for entry in run.counts.values())
    if total:
        notes.append(
            f"{bad} of {total} episodes went non-finite (NaN); such episodes are counted, as "
            "failures."
        )
    notes += draw_notes(runs)
    notes += variant_notes(runs)
    notes.append(
        "Degradation is 1 − OOD / ID with each method's own in-domain success, so a method that "
        "is weak in-domain can degrade little. Negative values are gains. Its interval treats the "
        "two success rates as independent."
    )
    notes.append(
        "The paper's numbers are means over its four simulated tasks; a single task here need not "
        "match them. Its OOD mean is taken over the domains that were evaluated here. "
        "Paper successes marked ≈ are implied by its table, ID · (1 − degradation)."
    )
    return notes


_SIMULATOR = (
    "Simulator: MuJoCo MJX with scenes, robots and a ray caster written for this package; the "
    "paper uses RLBench (CoppeliaSim, OpenGL). Exact object ranges of the paper are not public."
)


def differences(config: Mapping[str, Any]) -> list[str]:
    """Where this set-up departs from the paper's, as far as config.json tells."""
    recorded = config.get("kind") == "recorded"
    lines = [] if recorded else [_SIMULATOR]
    width, demos, steps = (lookup(config, name) for name in ("width", "demos", "steps"))
    if isinstance(width, int):
        lines.append(
            f"Encoder: ResNet-18 of base width {width} trained from scratch; the paper's has width "
            "64 and starts from ImageNet weights."
            if not lookup(config, "pretrained")
            else f"Encoder: ResNet-18 of base width {width}, pretrained; the paper's has width 64."
        )
    if isinstance(demos, int):
        lines.append(f"Demonstrations: {demos}; the paper uses 200 or 300 per task.")
    if isinstance(steps, int):
        lines.append(
            f"Training: {steps} steps; the paper trains for 600 epochs with batches of 64."
        )
    frame = lookup(config, "frame")
    if frame is not None and not recorded:
        lines.append(
            f"Virtual camera frame: {frame}, at the paper's focal length. The paper's has 512 "
            "pixels, and near its border the crop window shifts, so that the TCP leaves its pixel."
        )
    scored = lookup(config, "select_scenes")
    if isinstance(scored, int):
        lines.append(
            f"Checkpoints are chosen by in-domain success on {scored} scenes that are not among "
            "those reported; the paper reports the best of its top three."
        )
    labels = lookup(config, "labels")
    if isinstance(labels, str) and not recorded:
        lines.append(f"Action labels: {labels}; the paper's are achieved next poses.")
    return lines


def _tables(methods: Mapping[str, list[Run]]) -> str:
    """Tiles and table of one task, and what has no numbers yet."""
    counts = {name: entry for name, runs in methods.items() if (entry := pooled(runs))}
    body = tiles(counts) + result_table(counts) if counts else ""
    recorded = {name: found for name, runs in methods.items() if (found := _held_out(runs))}
    if recorded:
        body += held_out_table(recorded)
    unevaluated = [
        paper.method_label(name) for name in methods if name not in {**counts, **recorded}
    ]
    if unevaluated:
        body += f'<p class="note">Not evaluated yet: {esc(", ".join(unevaluated))}.</p>'
    return body


def _held_out(runs: Sequence[Run]) -> dict[str, Any]:
    """The figures of the first seed that has some: errors on few episodes are not pooled."""
    return next((run.held_out for run in runs if "loss" in run.held_out), {})


def _media(path: Path, runs: Sequence[Run]) -> tuple[list[Path], list[Path]]:
    """Pictures in the folder itself, and videos of the folder and its runs."""
    videos = {
        file.resolve(): file
        for folder in [path, *(run.path for run in runs)]
        for file in sorted((folder / "videos").glob("*"))
        if file.suffix.lower() in (".mp4", ".gif") and not file.name.startswith(".")
    }
    pictures = sorted((path / "figures").glob("*.png"))
    inside = [path.resolve(), *(run.path.resolve() for run in runs)]
    return (
        [p for p in pictures if not p.name.startswith(".") and _within(p.resolve(), inside)],
        [shown for file, shown in videos.items() if _within(file, inside)],
    )


def _within(file: Path, folders: Sequence[Path]) -> bool:
    """Whether a file lies there: a page is passed on, and must not carry what a link points at."""
    return any(file.is_relative_to(folder) for folder in folders)


def clip_name(stem: str) -> tuple[str, str, str]:
    """Method, domain and rest of a file name such as "palm-crop_wv_03"; empty where not given."""
    known = [m for m in paper.METHODS if re.match(rf"{re.escape(m)}([-_ ]|$)", stem)]
    method = max(known, key=len, default="")
    words = re.split(r"[-_ ]+", stem[len(method) :].strip("-_ "))
    # The longest beginning that names a domain: "workspace_viewpoint_2" is W+V, number 2.
    for count in range(len(words), 0, -1):
        domain = paper.domain_key(" ".join(words[:count]))
        if domain in paper.DOMAINS:
            return method, domain, _spaced(words[count:])
    return method, "", _spaced(words)


def _spaced(words: Sequence[str]) -> str:
    """Words with a space before a trailing number: "success1" reads "success 1"."""
    return " ".join(re.sub(r"(?<=[a-z])(\d+)$", r" \1", word) for word in words)


def _clip_caption(file: Path, root: Path) -> str:
    method, domain, rest = clip_name(file.stem)
    folder = file.parent.parent
    if not method and folder != root:
        method = folder.name
    parts = [method and paper.method_label(method), domain and paper.domain_title(domain), rest]
    return ", ".join(part for part in parts if part)


def _videos(files: Sequence[Path], root: Path, room: float) -> tuple[str, list[str]]:
    """Videos inline up to `room` bytes; and the names of those for which there was none."""
    order = paper.ordered_methods(list(paper.METHODS))

    def place(file: Path) -> tuple[int, int, str]:
        method, domain, _ = clip_name(file.stem)
        by_domain = list(paper.DOMAINS).index(domain) if domain else len(paper.DOMAINS)
        return by_domain, order.index(method) if method else len(order), str(file)

    shown, left = [], []
    for file in sorted(files, key=place):
        size = file.stat().st_size * 4 / 3
        if size > room:
            left.append(str(file.relative_to(root)))
            continue
        room -= size
        shown.append(video(file, _clip_caption(file, root)))
    return (f'<div class="videos">{"".join(shown)}</div>' if shown else ""), left


def build(path: Path, *, max_megabytes: float = 40.0) -> str:
    """The page for a run folder or a folder of runs; draws the figures on the way.

    Args:
      path: the folder; figures are written to path/figures.
      max_megabytes: for the videos on the page; those beyond are named, not shown.

    Raises:
      FileNotFoundError: there is no such folder, or no run in it.
    """
    if not path.is_dir():
        raise FileNotFoundError(f"{path} is not a folder")
    runs = [load_run(folder) for folder in find_runs(path)]
    if not runs:
        raise FileNotFoundError(
            f"no run in {path}: expected config.json, eval.json, eval.npz or metrics.jsonl in it "
            "or in folders below it"
        )
    problems = [problem for run in runs for problem in run.problems]
    tasks = grouped(runs)
    drawn: list[Path] = []
    tables, plots = [], []
    for task, methods in tasks.items():
        made = draw(
            methods, path / "figures", f"{records.file_word(task)}-" if len(tasks) > 1 else ""
        )
        drawn += [file for file, _ in made]
        plots.append("".join(picture(file, caption) for file, caption in made))
        tables.append(_tables(methods))
    gallery, clips = _media_parts(path, runs, drawn, problems, max_megabytes)
    media = [section("Videos", clips), section("What it looks like", gallery)]
    if len(tasks) == 1:
        sections = [section("Results", tables[0]), *media, section("Figures", plots[0])]
    else:
        counts = {
            task: {name: pooled(members) for name, members in methods.items()}
            for task, methods in tasks.items()
        }
        sections = [section("Mean over tasks", mean_table(counts)), *media]
        for task, table, plot in zip(tasks, tables, plots, strict=True):
            sections.append(section(paper.task_label(task) or "No task named", table + plot))
    return _page(runs, tasks, sections, problems)


# Pictures that other parts of the package leave in figures/.
_CAPTIONS = {
    "inputs": "What each policy is trained with: frames from the first to the last of its data.",
    "gallery": "What each policy sees in each domain, at the start of the domain's first scene.",
}


def _media_parts(
    path: Path,
    runs: Sequence[Run],
    drawn: Sequence[Path],
    problems: list[str],
    max_megabytes: float,
) -> tuple[str, str]:
    """Pictures that others put into figures/, and videos; damaged ones go to `problems`."""
    others, videos = _media(path, runs)
    damaged = {file: why for file in others + videos if (why := damaged_media(file))}
    problems += damaged.values()
    extra = [file for file in others if file not in drawn and file not in damaged]
    gallery = "".join(
        picture(file, _CAPTIONS.get(file.stem, re.sub(r"[-_]+", " ", file.stem).capitalize()))
        for file in extra
    )
    clips, left = _videos([f for f in videos if f not in damaged], path, max_megabytes * 1e6)
    if left:
        clips += f'<p class="note">Too large for this page: {esc(", ".join(left))}.</p>'
    return gallery, clips


def _leading(runs: Sequence[Run]) -> Run:
    """The run that the page is about: PALM if it is among them."""
    return next((run for run in runs if run.method == "palm"), runs[0])


def _page(
    runs: Sequence[Run],
    tasks: Mapping[str, Mapping[str, list[Run]]],
    sections: Sequence[str],
    problems: Sequence[str],
) -> str:
    names = [paper.task_label(task) for task in tasks if task]
    methods = paper.ordered_methods(list({run.method for run in runs}))
    title = " · ".join(names) if names else "Results"
    labels = [paper.method_label(name) for name in methods]
    about = "success in and out of the training distribution"
    if all(run.recorded for run in runs):
        about = "trained on recordings, measured on episodes held out"
    lead = f"{', '.join(labels)}: {about}"
    warning = ""
    if problems:
        warning = (
            '<div class="warn"><b>Some inputs could not be used</b>' + listing(problems) + "</div>"
        )
    entries = "".join(f"<dt>{esc(k)}</dt><dd>{esc(v)}</dd>" for k, v in facts(runs).items())
    how = f"<pre>{esc(chr(10).join(commands(runs)))}</pre>" + "".join(_raw(run) for run in runs)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{esc(title)} - palm_jax</title><style>{CSS}</style></head><body>"
        f'<header><h1>{esc(title)}</h1><p class="lead">{esc(lead)}</p>'
        f'<dl class="facts">{entries}</dl></header>{warning}<main>{"".join(sections)}'
        + section("How to read the numbers", listing(footnotes(runs)))
        + section("What differs from the paper", listing(differences(_leading(runs).config)))
        + section("How to reproduce", how)
        + f"</main><footer>palm_jax {esc(__version__)}</footer></body></html>\n"
    )


def _raw(run: Run) -> str:
    if not run.config and not run.sessions:
        return ""
    content = json.dumps({"config": run.config, "env": run.sessions}, indent=2, sort_keys=True)
    return (
        f"<details><summary>configuration and environment of {esc(run.path.name)}</summary>"
        f"<pre>{esc(content)}</pre></details>"
    )


def write_report(path: Path, *, out: Path | None = None, max_megabytes: float = 40.0) -> Path:
    """Build the page and write it, whole or not at all.

    Args:
      path: a run folder, or a folder with runs in it.
      out: the file; path/report.html if not given.
      max_megabytes: for the videos on the page.

    Returns:
      the file written.
    """
    page = build(path, max_megabytes=max_megabytes)
    return write_atomic(out or path / "report.html", page.encode("utf-8"))


@dataclass(frozen=True)
class Options:
    """Build one self-contained HTML page from a run folder, or from a folder with runs in it."""

    path: tyro.conf.Positional[Path]
    """The run folder, or a folder above several."""
    out: Path | None = None
    """The file to write; PATH/report.html if not given."""
    max_megabytes: float = 40.0
    """Videos beyond this size in all are named instead of shown."""


def main(argv: Sequence[str] | None = None) -> int:
    """The verb `report`; returns 0, or 2 with a message if there is nothing to report on."""
    options = tyro.cli(Options, args=argv, prog="palm-jax report")
    try:
        written = write_report(options.path, out=options.out, max_megabytes=options.max_megabytes)
    except FileNotFoundError as error:
        print(f"palm-jax report: {error}", file=sys.stderr)
        return 2
    print(f"Report: {written}")
    return 0
