"""`python -m palm_jax table`: the paper's main table, every cell a policy that is trained and
evaluated.

A cell is a task, a method and a seed: one training command in a process of its own, so that a crash
costs that cell alone, and a second call goes on where the first one ended. Demonstrations are made
once for each task. Finished cells go into one JSON file at once:

    {"header": {...}, "results": {task: {method: {seed: {domain: {"successes", "episodes",
    "nan"}}}}}, "failed": {task: {method: {seed: log}}}, "times": {...}, "demonstrations": {...}}

The header says under which conditions; a file with another one is not touched. `demonstrations` has
the SHA-256 of what each policy was trained on, `times` how long it took, `commits` by which code,
`hands` what the method solved in each variant of the hand's initial yaw and which one `results`
quotes; all laid out alike. The episodes one by one lie in an .npz file beside it (`files.tables`).
`--page` makes Markdown and figures of the two.
"""

import dataclasses
import datetime
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tyro
from rich.console import Console

from palm_jax.envs.registry import TASKS
from palm_jax.envs.shifts import DOMAINS
from palm_jax.train import config as configuration
from palm_jax.train import demos, methods, workspace
from palm_jax.train.config import Config, ConfigError
from palm_jax.train.files import locks, records, shards, tables, versions
from palm_jax.train.files.metrics import plain
from palm_jax.train.files.tables import Cell
from palm_jax.train.host import compiled, interrupts
from palm_jax.train.reporting import console as terminal
from palm_jax.train.reporting import paper, table_page

_FIRST = ("palm", "bc")
"""Methods whose cells come first: the claim stands and falls with them."""

_POLL_S = 0.1  # how soon the end of a cell, and a signal, are noticed
_KEPT = (
    "robot", "other_robot", "demos", "demo_seed", "demo_noise", "image_size", "random_crop",
    "width", "norm", "steps", "epochs", "batch_size", "learning_rate", "schedule", "warmup_steps",
    "weight_decay", "ema", "overlay_warmup", "perspective", "turn", "select_from",
    "select_scenes", "checkpoint_every", "scenes", "eval_seed",
)  # fmt: skip
"""The recipe: fields of the configuration that decide what comes out of a cell."""


@dataclasses.dataclass(frozen=True)
class TableConfig:
    """Train and evaluate every cell of the paper's main table; goes on where it was stopped.

    Attributes:
      preset: quick, cpu or paper.
      tasks: rows.
      methods: columns; palm and bc are run first.
      seeds: of training.
      out: folder of the cells and the demonstrations; by default runs/table-PRESET.
      json: where the results are collected; by default OUT/table.json.
      shard: "i/n", the i-th of n machines (from 1): it takes every n-th cell. Each has its own
        folder and file; `--merge` joins the files.
      merge: files of other shards whose results are taken over; nothing is run.
      take_over: run cells that a process on another machine has claimed, too: only if it is gone.
      page: a Markdown file that the results are written into; nothing is run.
    """

    preset: str = "cpu"
    tasks: tuple[str, ...] = paper.TABLE_TASKS
    methods: tuple[str, ...] = table_page.PAPER_METHODS
    seeds: tuple[int, ...] = (0,)
    out: Path | None = None
    json: Path | None = None
    shard: str = "1/1"
    merge: tuple[Path, ...] = ()
    take_over: bool = False
    page: Path | None = None

    @property
    def folder(self) -> Path:
        """`out`, its default resolved."""
        return self.out or Path("runs") / f"table-{self.preset}"

    @property
    def file(self) -> Path:
        """`json`, its default resolved."""
        return self.json or self.folder / "table.json"


def cells(config: TableConfig) -> list[Cell]:
    """Those of this shard, in the order in which they are run: a method's over all tasks before the
    next method's, palm and bc first.

    Raises:
      ConfigError: an unknown preset, task or method.
      ShardError: a shard that is none.
    """
    _check(config)
    order = [*_FIRST, *[name for name in config.methods if name not in _FIRST]]
    every = [
        Cell(task, method, seed)
        for method in order
        if method in config.methods
        for seed in config.seeds
        for task in config.tasks
    ]
    index, count = shards.parse(config.shard)
    return every[index - 1 :: count]


def _check(config: TableConfig) -> None:
    if config.preset not in configuration.PRESETS:
        raise ConfigError(
            f"unknown preset {config.preset!r}; known: {', '.join(configuration.PRESETS)}"
        )
    for task in config.tasks:
        if task not in TASKS:
            raise ConfigError(f"unknown task {task!r}; known: {', '.join(TASKS)}")
    for method in config.methods:
        try:
            methods.find(method)
        except ValueError as error:
            raise ConfigError(str(error)) from error
    for name in ("tasks", "methods", "seeds"):
        values = getattr(config, name)
        if not values or len(set(values)) < len(values):
            raise ConfigError(f"{name}: expected one or more, each once, got {values}")


def cell_config(config: TableConfig, cell: Cell) -> Config:
    """The training command of a cell."""
    return dataclasses.replace(
        configuration.PRESETS[config.preset](),
        task=cell.task,
        method=(cell.method,),
        seed=cell.seed,
        out=config.folder / cell.name,
        data=config.folder / "demos" / f"{cell.task}.hdf5",
        domains=DOMAINS,
        sweep=False,
    )


# -- the file --------------------------------------------------------------------------------------


def header(config: TableConfig) -> dict[str, Any]:
    """The conditions under which the cells of a file were made."""
    preset = configuration.PRESETS[config.preset]()
    recipe = {name: getattr(preset, name) for name in _KEPT} | {"other_robot": preset.second_robot}
    if preset.epochs is not None:
        del recipe["steps"]  # of each task's own demonstrations
    return {
        "preset": config.preset,
        "recipe": plain(recipe),
        "domains": list(DOMAINS),
        "versions": versions.current(),
        **dict.fromkeys(_ORIGIN, ""),  # nothing is made yet
    }


_START_ANEW = (
    "move it and the .npz or .json file beside it away and call again; finished cells are taken "
    "from their folders, and other shards' merged anew"
)
_MUST_AGREE = ("preset", "recipe", "domains", "versions")
_ORIGIN = ("machine", "devices", "commit")
"""Of the processes that made cells, not of those that enter or merge them: this one does not even
ask for devices, which only one process may be able to hold."""
_PARTS = ("times", "commits", "hands", workspace.DEMONSTRATIONS)
"""What is told of a cell beside its results."""


def read(path: Path, fresh: dict[str, Any]) -> dict[str, Any]:
    """The file's content, or an empty table under this header.

    Raises:
      ConfigError: it was made under other conditions; the message names the field.
    """
    if not path.exists():
        return {"header": fresh, "results": {}, "failed": {}}
    try:
        table = tables.load(path)
    except records.RecordError as error:
        raise records.RecordError(f"{error}: {_START_ANEW}") from error
    old = table.get("header", {})
    for name in _MUST_AGREE:
        if old.get(name) != fresh[name]:
            raise ConfigError(
                f"{path} was begun with {_difference(name, old.get(name), fresh[name])}: results "
                "of two kinds are not mixed. Choose another --json and --out, or go back"
            )
    beside = tables.episodes_file(path)
    if table.get("results") and not beside.exists():
        raise records.RecordError(
            f"{path}: the episodes of its cells are expected in {beside.name} beside it, which is "
            f"not there: put it back, or {_START_ANEW}"
        )
    return table


def _difference(name: str, old: Any, new: Any) -> str:
    """The first entry in which they differ, in words."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(set(old) | set(new)):
            if old.get(key) != new.get(key):
                return f"{name}.{key} = {old.get(key)!r}, now it is {new.get(key)!r}"
    return f"{name} = {old!r}, now it is {new!r}"


# -- running ---------------------------------------------------------------------------------------


def run(config: TableConfig, console: Console) -> Path:
    """Runs what is missing; returns the file.

    Raises:
      ConfigError, ShardError: see `cells`, `read` and `_merge`.
      KeyboardInterrupt: the running cell was stopped; it resumes from its last checkpoint.
    """
    asked, fresh = cells(config), header(config)
    table = read(config.file, fresh)
    if config.merge:
        with locks.locked(config.file):
            _merge_all(config, read(config.file, fresh), fresh, console)
        return config.file
    missing = [cell for cell in asked if tables.get(table, "results", cell) is None]
    done = len(asked) - len(missing)
    console.print(f"{len(asked)} cells, {done} done, into {config.file}", markup=False)
    took: list[float] = []
    for number, cell in enumerate(missing):
        try:
            with locks.claim(config.folder / cell.name, take_over=config.take_over):
                if tables.get(read(config.file, fresh), "results", cell) is None:
                    _announce(console, cell, len(missing) - number, took)
                    _run_cell(config, cell, fresh, console, took)
        except locks.Busy as error:
            console.print(f"{cell.name} is left to another process: {error}", markup=False)
    return config.file


def _run_cell(
    config: TableConfig, cell: Cell, fresh: dict[str, Any], console: Console, took: list[float]
) -> None:
    """Trains a cell that is claimed, and enters what came of it into the file."""
    start = time.monotonic()
    log = config.folder / f"{cell.name}.log"
    command = cell_config(config, cell)
    _check_demonstrations(command)
    code = _train(command, log)
    try:
        made = _made(config.folder / cell.name, fresh) if code == 0 else None
        words = f"exit code {code}"
    except ConfigError as error:  # of this cell alone: others go on
        made, words = None, str(error)
    except records.RecordError as error:
        made, words = None, f"{error}; move {config.folder / cell.name} away to make it again"
    with locks.locked(config.file):  # another process may write beside us
        table = read(config.file, fresh)
        if made is not None:
            _enter(table, config.file, cell, made)
            took.append(time.monotonic() - start)
        else:
            tables.put(table, "failed", cell, str(log))
            words = f"{cell.name} failed ({words}): see {log}"
            console.print(words, style="bold red", markup=False, soft_wrap=True)
        tables.store(config.file, table)


class _Made(NamedTuple):
    """What a finished cell left in its folder."""

    counts: dict[str, dict[str, int]]
    episodes: dict[str, records.DomainRecord]
    sessions: list[dict[str, Any]]
    parts: dict[str, Any]  # what is known of `_PARTS`


def _made(folder: Path, header: Mapping[str, Any]) -> _Made:
    """Reads the folder of a finished cell.

    Raises:
      RecordError: a file that results rest on is missing or damaged.
      ConfigError: it was made under other versions than the table.
    """
    sessions = records.load_sessions(folder / "env.json")
    _check_versions(header, sessions, folder)
    counts = records.load_counts(folder / "eval.json")
    episodes = records.load_eval(folder / "eval.npz")
    records.compare_counts(folder / "eval.json", counts, episodes)
    times = records.load_notes(folder / records.TIMES)
    parts = {
        "times": times if _took(times) else None,
        "commits": "; ".join(sorted({str(e["commit"]) for e in sessions if e.get("commit")})),
        "hands": _hands(folder),
        workspace.DEMONSTRATIONS: _trained_on(folder),
    }
    known = {name: value for name, value in parts.items() if value}
    return _Made(counts, episodes, sessions, known)


def _enter(table: dict[str, Any], path: Path, cell: Cell, made: _Made) -> None:
    """A finished cell, into the table and the file beside it."""
    for entry in made.sessions:
        _note_origin(table["header"], entry)
    _keep_episodes(path, {cell: made.episodes})
    tables.put(table, "results", cell, made.counts)
    for name, value in made.parts.items():
        tables.put(table, name, cell, value)
    tables.drop(table, "failed", cell)
    _note_speed(table)


def _hands(folder: Path) -> dict[str, Any] | None:
    """{"quoted": variant, "successes": {variant: {domain: n}}} of the hand's initial yaw; None for
    a method that has but one, and for notes that are none."""
    notes = records.load_notes(folder / "eval_variants.json")
    quoted = str(notes.pop("quoted", None))
    try:
        successes = {
            variant: {domain: int(entry["successes"]) for domain, entry in domains.items()}
            for variant, domains in notes.items()
        }
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    several = len(successes) > 1 and quoted in successes
    return {"quoted": quoted, "successes": successes} if several else None


def _check_versions(
    header: Mapping[str, Any], sessions: Sequence[Mapping[str, Any]], folder: Path
) -> None:
    """Raises ConfigError for a cell that was worked on under other versions than the table's."""
    for entry in sessions:
        if found := versions.difference(entry.get("versions"), header["versions"]):
            name, old, new = found
            raise ConfigError(
                f"{folder} was made with {name} {old}, the table with {new}: results of two kinds "
                "are not mixed. Move the folder away to run the cell again, or choose another "
                "--json and --out"
            )


def _trained_on(folder: Path) -> str | None:
    """SHA-256 of a cell's demonstrations; None from a version that did not note it."""
    digests = records.load_notes(folder / "config.json").get(workspace.DIGESTS)
    return digests.get(workspace.DEMONSTRATIONS) if isinstance(digests, dict) else None


def _check_demonstrations(config: Config) -> None:
    """Raises ConfigError for a file in OUT/demos that was not collected as the recipe says.

    Its seed and disturbance are compared, not its digest: two kinds of processor round differently,
    and a machine that goes on with a table collects the same scenes, but not the same bits."""
    assert config.data is not None
    if not config.data.exists():
        return
    try:
        found = demos.collected_with(config.data)
    except demos.DemoFileError:
        return  # the cell fails with the same words in its log, and others go on
    for name, value in {"seed": config.demo_seed, "noise": config.demo_noise}.items():
        if found[name] != value:
            raise ConfigError(
                f"{config.data} was collected with {name} {found[name]}, the table's recipe says "
                f"{value}: move it away, or choose another --out"
            )


def _took(times: Mapping[str, Any]) -> tuple[float, float] | None:
    """Updates a second and the evaluation's seconds, from a cell's times.json; None if one of them
    is not known: a process that is killed after its results are written leaves no time for them."""
    updates, training, selection, evaluation = (
        records.seconds(times, name)
        for name in ("updates", "training_and_selection_s", "selection_s", "evaluation_s")
    )
    if not updates or training is None or evaluation is None:
        return None
    training -= selection or 0.0
    return (updates / training, evaluation) if training > 0 else None


def _note_speed(table: dict[str, Any]) -> None:
    """Medians over the cells, into the header: samples a second, seconds of an evaluation."""
    every = (tables.get(table, "times", cell) or {} for cell in tables.cells(table, "times"))
    took = list(filter(None, map(_took, every)))
    recipe, header = table["header"]["recipe"], table["header"]
    if took:
        rate, evaluation = map(statistics.median, zip(*took, strict=True))
        header["samples_per_second"] = round(rate * recipe["batch_size"], 1)
        header["evaluation_seconds"] = round(evaluation, 1)


def _keep_episodes(table: Path, fresh: Mapping[Cell, Mapping[str, records.DomainRecord]]) -> None:
    """Adds the episodes of cells to those beside the table."""
    try:
        kept = tables.load_episodes(table)
    except records.RecordError as error:
        raise records.RecordError(f"{error}: {_START_ANEW}") from error
    tables.save_episodes(table, {**kept, **fresh})


def _announce(console: Console, cell: Cell, left: int, took: list[float]) -> None:
    if not took:
        console.print(f"{cell.name}: {left} to go", highlight=False)
        return
    seconds = left * sum(took) / len(took)
    end = datetime.datetime.now() + datetime.timedelta(seconds=seconds)
    console.print(
        f"{cell.name}: {left} to go, {terminal.duration(seconds)}, until about {end:%H:%M}"
    )


def _train(config: Config, log: Path) -> int:
    """Runs a cell's command, or goes on with it; returns its exit code."""
    assert config.out is not None and config.data is not None
    resume = (config.out / "config.json").exists()
    words = configuration.command(config, resume=resume)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as output:
        output.write(f"$ {' '.join(words)}\n")
        output.flush()
        # In a group of its own: a terminal's Ctrl-C reaches it through us, and once.
        process = subprocess.Popen(
            [sys.executable, *words[1:]],
            stdout=output,
            stderr=subprocess.STDOUT,
            env=_environment(),
            close_fds=False,
            process_group=0,
        )
        return _outcome(process)


def _outcome(process: subprocess.Popen[bytes]) -> int:
    """Waits for a cell. A signal is passed on: the cell saves, and goes on another time."""
    stop = interrupts.Stop("Stopping after the running cell has saved; once more ends at once.")
    try:
        with stop.listening(at_once=process.kill):
            while process.poll() is None and not stop():
                time.sleep(_POLL_S)
            if stop():
                process.terminate()
            code = process.wait()
    finally:
        process.kill()  # nothing, if it has ended
    if stop() or code == 130:
        raise KeyboardInterrupt
    return code


def _environment() -> dict[str, str]:
    """The cells of a table share compiled programs; and memory in large pages, which glibc must be
    told before a process begins, trains a fifth faster (docs/performance.md).

    Raises:
      CacheError: see `compiled.folder`.
    """
    ours = {
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
        "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
    }
    if compiled.VARIABLE not in os.environ and (folder := compiled.folder()) is not None:
        ours[compiled.VARIABLE] = str(folder)
    return {**ours, **os.environ}


def _merge(
    table: dict[str, Any], path: Path, fresh: dict[str, Any]
) -> tuple[tables.Episodes, list[Cell]]:
    """Takes over what only the other file has.

    Returns:
      the episodes of the cells that came with results, and the cells of which the table keeps
      other results than the file's.

    Raises:
      ConfigError: there is no such file, or one of other conditions.
      RecordError: a cell's episodes are missing, or others than its counts say.
    """
    if not path.exists():
        raise ConfigError(
            f"merge: expected the JSON file of a shard, got {path}, which is not there"
        )
    other, beside = read(path, fresh), tables.load_episodes(path)
    taken = tables.Episodes()
    for cell in tables.cells(other, "results"):
        if tables.get(table, "results", cell) is None:
            tables.check_counts(path, other, cell, beside)
            for part in ("results", *_PARTS):
                if (value := tables.get(other, part, cell)) is not None:
                    tables.put(table, part, cell, value)
            tables.drop(table, "failed", cell)
            taken[cell] = beside[cell]
    for cell in tables.cells(other, "failed"):
        if tables.get(table, "results", cell) is None:
            tables.put(table, "failed", cell, tables.get(other, "failed", cell))
    if taken:
        _note_origin(table["header"], other["header"])
    return taken, _other_results(table, other)


def _merge_all(
    config: TableConfig, table: dict[str, Any], fresh: dict[str, Any], console: Console
) -> None:
    taken = tables.Episodes()
    for path in config.merge:
        found, left_out = _merge(table, path, fresh)
        for cell in left_out:
            console.print(
                f"{cell.name}: {path} has other results of it, which are left out: of a cell that "
                "was run twice the first one counts",
                markup=False,
                soft_wrap=True,
            )
        taken |= found
    _note_speed(table)
    _keep_episodes(config.file, taken)
    tables.store(config.file, table)


def _other_results(table: Mapping[str, Any], other: Mapping[str, Any]) -> list[Cell]:
    """Cells of which two tables tell different things."""
    return [
        cell
        for cell in tables.cells(other, "results")
        if tables.get(other, "results", cell) != tables.get(table, "results", cell)
    ]


def _note_origin(header: dict[str, Any], made: Mapping[str, Any]) -> None:
    """Adds where and by which commits results were made, as `made` has it, to a header."""
    for name in _ORIGIN:
        words = (_words(part.get(name)) for part in (header, made))
        header[name] = "; ".join(sorted(set().union(*words)))


def _words(origin: Any) -> list[str]:
    """What a header ("a; b") or a session (one, or a list of devices) says."""
    if not isinstance(origin, list):
        return str(origin).split("; ") if origin else []
    return [", ".join(map(str, origin))]


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code: 0, or 1 if cells failed, 2 for a command that cannot be
    run, 3 if cells of the share are not done, 130 when interrupted."""
    config = tyro.cli(TableConfig, args=argv, prog="python -m palm_jax table")
    console = terminal.make_console()
    try:
        if config.page is not None:
            written = table_page.write(config.file, config.page)
            console.print(f"Written: {', '.join(map(str, written))}", highlight=False, markup=False)
            return 0
        with interrupts.raising():
            path = run(config, console)
    except (
        ConfigError, compiled.CacheError, shards.ShardError, records.RecordError, OSError,
    ) as error:  # fmt: skip
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        console.print("Stopped; the same command goes on with what is missing.")
        return interrupts.leave(stop)
    return _summary(config, path, console)


def _summary(config: TableConfig, path: Path, console: Console) -> int:
    """Tells what has failed and what is not done; returns the exit code."""
    table = records.load_json(path) if path.exists() else {}
    failed = list(tables.cells(table, "failed"))
    asked = [] if config.merge else cells(config)
    done = (*tables.cells(table, "results"), *failed)
    left = [cell for cell in asked if cell not in done]
    words = f"; {len(failed)} cells failed" if failed else ""
    words += f"; {len(left)} cells are left to other processes" if left else ""
    console.print(f"Results: {path}{words}", markup=False)
    return 1 if failed else locks.LEFT if left else 0
