"""`python -m palm_jax table --page PAGE.md`: a table's file as Markdown and figures, the paper's
numbers beside ours. Everything comes from the file and the episodes beside it; nothing is run."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from palm_jax.train.files import records, tables
from palm_jax.train.files.metrics import write_atomic
from palm_jax.train.files.records import DomainRecord, RecordError
from palm_jax.train.files.tables import Cell
from palm_jax.train.reporting import claims, figures, grids, paper, stats
from palm_jax.train.reporting.runs import regions_of

_COLUMNS = tuple(paper.DOMAINS)

PAPER_METHODS = (
    "palm", "bc", "palm-crop", "palm-overlay", "palm-aug", "palm-prop", "mirrorduo", "roviaug",
    "arro",
)  # fmt: skip
"""Columns of the paper's table."""


def markers(preset: str) -> tuple[str, str]:
    """The lines of the page that the text of this preset stands between."""
    return f"<!-- table {preset}: generated -->", f"<!-- table {preset}: end -->"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_cell, line)) + " |" for line in lines)


def _cell(words: str) -> str:
    """Words that end neither their cell nor their line, and begin no HTML."""
    return " ".join(words.split()).replace("|", "\\|").replace("<", "&lt;")


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.2f}".replace("-0.00", "0.00")


def _interval(found: claims.Estimate) -> str:
    if found.value != found.value:
        return "-"
    return f"{_number(found.value)} ({_number(found.low)} to {_number(found.high)})"


def rows_of(table: Mapping[str, Any], episodes: tables.Episodes) -> claims.Rows:
    """The tasks of the paper's table: task -> method -> counts, seeds summed."""
    return {
        task: {
            method: claims.summed(seeds, _solved(episodes, task, method, seeds))
            for method, seeds in table["results"][task].items()
            if seeds
        }
        for task in paper.TABLE_TASKS
        if table["results"].get(task)
    }


def _solved(
    episodes: tables.Episodes, task: str, method: str, seeds: Iterable[str]
) -> dict[str, list[ArrayLike]]:
    """Domain -> for each seed whether it solved scene n [N]."""
    found: dict[str, list[ArrayLike]] = {}
    for seed in seeds:
        for domain, record in episodes[Cell(task, method, int(seed))].items():
            found.setdefault(domain, []).append(record.solved)
    return found


# -- parts of the page -----------------------------------------------------------------------------


def _conditions(header: Mapping[str, Any]) -> str:
    recipe = header["recipe"]
    versions = ", ".join(f"{name} {version}" for name, version in header["versions"].items())
    return (
        f"{recipe['demos']} demonstrations of the {recipe['robot']} a task, {_length(recipe)} of "
        f"{recipe['batch_size']} samples, {recipe['image_size']}-pixel images, width "
        f"{recipe['width']}, {recipe['scenes']} scenes a domain (seed {recipe['eval_seed']}), the "
        "same for every method; those that make more of the demonstrations (MirrorDuo, RoVi-Aug) "
        f"see each of them half as often. In domains with E the {recipe['other_robot']} acts. "
        f"{header['machine']}; {versions}; commit {header['commit']}."
    )


_INTERVALS = (
    "In brackets are central 95 % intervals of posteriors (Jeffreys' prior; in the tables of tasks "
    "Wilson's). They are about scenes: how much one training differs from the next is not in them, "
    "and seeds, which are tried in the same scenes, count as the scenes that they are worth: with "
    "three seeds between 50 and 150, as they agree or not. A task of which a method solves less "
    "than a tenth in-domain, its seeds together, is in none of its losses, and two methods are "
    "compared on the tasks that are left of both."
)


_CAPTIONS = {
    "samples": "Every episode of BC and PALM, seeds together: where the object lay (in-domain and "
    "workspace), and how far the camera was turned (viewpoint).",
    "heatmaps": "Percent solved over where the object lay, in-domain and workspace, seeds "
    "together; below it solved of played.",
}


def _length(recipe: Mapping[str, Any]) -> str:
    """How long policies are trained."""
    if recipe.get("epochs") is None:
        return f"{recipe['steps']} updates"
    return f"{recipe['epochs']:g} passes over them in updates"


def _collections(table: Mapping[str, Any]) -> list[str]:
    """Tasks whose cells were not all trained on the same bits, in words."""
    found = []
    for task, row in table.get("demonstrations", {}).items():
        digests = {digest for seeds in row.values() for digest in seeds.values()}
        if len(digests) > 1:
            found.append(f"{len(digests)} collections of {_cell(paper.task_label(task))}")
    return found


def _means(rows: claims.Rows) -> str:
    """Ours above the paper's, a pair of lines for each method that every task has."""
    posterior, body = claims.Posterior(rows), []
    for method in posterior.methods:
        losses = [claims.estimate(posterior.loss(method, key)) for key in paper.OOD_DOMAINS]
        mean = claims.estimate(posterior.mean_loss(method))
        ours = [claims.estimate(posterior.success(method)), *losses, mean]
        left_out = [paper.task_label(t) for t in rows if t not in posterior.tasks(method)]
        losses_of = f" (losses without {' and '.join(left_out)})" if left_out else ""
        name = _cell(paper.method_label(method) + losses_of)
        body.append([name, *map(_interval, ours)])
        if (base := paper.in_domain_success(method)) is not None:
            theirs = [base, *(paper.degradation(method, key) for key in paper.OOD_DOMAINS)]
            theirs.append(paper.average_degradation(method))
            body.append(["- the paper", *(_number(v) for v in theirs if v is not None)])
    labels = [paper.domain_label(key) for key in paper.OOD_DOMAINS]
    return markdown(["", "success ID", *(f"loss {label}" for label in labels), "mean loss"], body)


def _seeds(table: Mapping[str, Any]) -> str:
    """The means again, of each training seed that a method has on every task; nothing where no
    method has two."""
    body = []
    for method in paper.ordered_methods(list(PAPER_METHODS)):
        by_task = [table["results"].get(t, {}).get(method, {}) for t in paper.TABLE_TASKS]
        shared = sorted(set.intersection(*map(set, by_task)), key=int)
        for seed in shared if len(shared) > 1 else ():
            counts = [row[seed] for row in by_task]
            rates = [claims.rate(c, "ID") for c in counts]
            losses = [
                claims.loss(c, key)
                for c, rate in zip(counts, rates, strict=True)
                for key in paper.OOD_DOMAINS
                if rate >= claims.LEAST_IN_DOMAIN
            ]
            lost = sum(losses) / len(losses) if losses else math.nan
            mean = sum(rates) / len(rates)
            body.append([paper.method_label(method), seed, _number(mean), _number(lost)])
    return markdown(["", "seed", "success ID", "mean loss"], body) if body else ""


def _claims(rows: claims.Rows) -> str:
    body = []
    for claim in claims.judge(rows):
        numbers = "; ".join(f"{q.text}: {_interval(q.difference)}" for q in claim.questions)
        body.append([claim.name, claim.text, f"**{claim.verdict}**", numbers or "-"])
    return markdown(["", "the paper's claim", "here", "differences, above zero as claimed"], body)


def _task(table: Mapping[str, Any], task: str) -> str:
    """Every policy of a task: what it solved, and the command that repeats it."""
    header, row, body = table["header"], table["results"][task], []
    for method in paper.ordered_methods([name for name, seeds in row.items() if seeds]):
        for seed, counts in sorted(row[method].items(), key=lambda item: int(item[0])):
            cell = Cell(task, method, int(seed))
            body.append(_policy(header, cell, counts, tables.get(table, "hands", cell)))
    labels = [paper.domain_label(key) for key in _COLUMNS]
    return markdown(["method", "seed", "hand", *labels, "mean loss", "command"], body)


def _policy(
    header: Mapping[str, Any], cell: Cell, counts: claims.Counts, hands: Mapping[str, Any] | None
) -> list[str]:
    by_key = {paper.domain_key(domain): entry for domain, entry in counts.items()}
    cells = [f"{by_key[key]['successes']}/{by_key[key]['episodes']}" for key in _COLUMNS]
    base = by_key["ID"]
    low, high = stats.wilson_interval(base["successes"], base["episodes"])
    cells[0] += f" ({100 * low:.0f} to {100 * high:.0f} %)"
    learned = claims.rate(counts, "ID") >= claims.LEAST_IN_DOMAIN
    losses = [claims.loss(counts, key) if learned else math.nan for key in paper.OOD_DOMAINS]
    nan = sum(entry["nan"] for entry in counts.values())
    name = paper.method_label(cell.method) + (f", {nan} diverged" if nan else "")
    command = (
        f"`python -m palm_jax.train --preset {header['preset']} --task {cell.task} "
        f"--method {cell.method} --seed {cell.seed} --no-sweep`"
    )
    return [name, str(cell.seed), _hand(hands), *cells, _number(sum(losses) / len(losses)), command]


def _hand(hands: Mapping[str, Any] | None) -> str:
    """Which variant of the hand's initial yaw is quoted, and what the others solved in all."""
    if hands is None:
        return "-"
    total = {name: sum(domains.values()) for name, domains in hands["successes"].items()}
    quoted = hands["quoted"]
    others = (f"{name}: {count}" for name, count in total.items() if name != quoted)
    return f"{quoted}: {total[quoted]} ({', '.join(others)})"


def _missing(table: Mapping[str, Any]) -> list[str]:
    """Methods of the paper's table, each with the tasks on which it has no policy yet."""
    lines = []
    for method in PAPER_METHODS:
        tasks = [
            paper.task_label(task)
            for task in paper.TABLE_TASKS
            if not table["results"].get(task, {}).get(method)
        ]
        if tasks:
            where = "every task" if len(tasks) == len(paper.TABLE_TASKS) else ", ".join(tasks)
            lines.append(f"{paper.method_label(method)} ({where})")
    return lines


def _failed(table: Mapping[str, Any]) -> Iterator[str]:
    for task, row in table.get("failed", {}).items():
        for method, seeds in row.items():
            for seed in seeds:
                yield f"{paper.task_label(task)}, {paper.method_label(method)}, seed {seed}"


def text(
    table: Mapping[str, Any], episodes: tables.Episodes, drawn: Mapping[str, Sequence[str]]
) -> str:
    """What stands between the markers.

    Args:
      table: content of the JSON file.
      episodes: of the file beside it.
      drawn: task -> paths of its figures, relative to the page.
    """
    rows, header = rows_of(table, episodes), table["header"]
    parts = [f"## The main table, preset `{header['preset']}`", _cell(_conditions(header))]
    parts += ["### Means over the tasks", _INTERVALS, _means(rows)]
    if seeds := _seeds(table):
        parts += [
            "Each training seed by itself, a task that it does not do in-domain left out of its "
            "loss:",
            seeds,
        ]
    parts += ["### The claims", _claims(rows)]
    missing, failed, collections = _missing(table), list(_failed(table)), _collections(table)
    if collections:
        parts.insert(
            2,
            "A task's demonstrations have the same scenes and disturbances throughout, but were "
            "collected anew on each machine, and processors round differently: there are "
            f"{' and '.join(collections)}. The JSON file has the SHA-256 of what each policy saw.",
        )
    if missing:
        parts.insert(1, f"Not complete: {'; '.join(missing)} not run yet.")
    if failed:
        parts.append(f"Failed, and in no number above: {_cell('; '.join(failed))}.")
    for task in table["results"]:
        parts += [f"### {_cell(paper.task_label(task))}", _task(table, task)]
        for path in drawn.get(task, ()):
            kind = Path(path).stem.partition("_")[0]
            parts += [f"![{Path(path).stem}]({path})", f"*{_CAPTIONS[kind]}*"]
    return "\n\n".join(parts)


# -- figures ---------------------------------------------------------------------------------------


def _joined(episodes: tables.Episodes) -> dict[str, dict[str, dict[str, DomainRecord]]]:
    """task -> method -> domain -> episodes, seeds joined."""
    parts: dict[tuple[str, str, str], list[DomainRecord]] = {}
    for cell, by_domain in episodes.items():
        for domain, record in by_domain.items():
            parts.setdefault((cell.task, cell.method, domain), []).append(record)
    found: dict[str, dict[str, dict[str, DomainRecord]]] = {}
    for (task, method, domain), several in parts.items():
        by_method = found.setdefault(task, {}).setdefault(method, {})
        by_method[domain] = records.joined(several)
    return found


def draw(task: str, methods: Mapping[str, Mapping[str, DomainRecord]], folder: Path) -> list[Path]:
    """Figures of one task: where BC and PALM succeed, and a heatmap of every method."""
    regions = regions_of({"task": task})
    pair = {name: methods[name] for name in ("bc", "palm") if name in methods}
    made = []
    if pair:
        made.append(folder / f"samples_{records.file_word(task)}.png")
        figures.save(figures.sample_distribution(pair, regions), made[-1])
    maps = {
        name: grids.grid_of_records(
            [methods[name]["in_domain"], methods[name]["workspace"]], regions
        )
        for name in paper.ordered_methods(list(methods))
    }
    if maps:
        made.append(folder / f"heatmaps_{records.file_word(task)}.png")
        figures.save(figures.heatmaps(maps, regions), made[-1], dpi=110)
    return made


def write(table_file: Path, page: Path) -> list[Path]:
    """Writes the table into the page, between its markers, and the figures beside it.

    Returns:
      the files written, the page first.

    Raises:
      RecordError: the table or the page cannot be used; the message says why.
    """
    table, episodes = tables.load(table_file), tables.load_episodes(table_file)
    preset = table["header"]["preset"]
    if preset != records.file_word(preset):  # it becomes a folder's name and a comment's
        raise RecordError(f"{table_file}: expected a preset's name, got {preset!r}")
    for cell in tables.cells(table, "results"):
        tables.check_counts(table_file, table, cell, episodes)
    drawn = {
        task: draw(task, methods, page.parent / "images" / f"table_{preset}")
        for task, methods in _joined(episodes).items()
    }
    relative = {t: [str(path.relative_to(page.parent)) for path in ps] for t, ps in drawn.items()}
    before, after = _around(page, preset)
    begin, end = markers(preset)
    content = f"{before}{begin}\n\n{text(table, episodes, relative)}\n\n{end}{after}"
    write_atomic(page, content.encode())
    return [page, *(path for paths in drawn.values() for path in paths)]


def _around(page: Path, preset: str) -> tuple[str, str]:
    begin, end = markers(preset)
    if not page.exists():
        return "# Results\n\n", "\n"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed:
        raise RecordError(f"{page}: expected the markers {begin!r} and {end!r}; add them")
    return before, after
