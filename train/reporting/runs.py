"""Reading run folders: find them, load what they hold, group and pool them."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palm_jax.train.files import records
from palm_jax.train.reporting import grids, paper

Counts = dict[str, dict[str, int]]  # domain -> successes, episodes, nan

# Folders of a run that hold no runs themselves.
_NOT_RUNS = {"checkpoints", "figures", "videos", "damaged", "shards"}


@dataclass
class Run:
    """What could be read from one run folder."""

    path: Path
    config: dict[str, Any] = field(default_factory=dict)
    sessions: list[dict[str, Any]] = field(default_factory=list)  # where, when and with what
    counts: Counts = field(default_factory=dict)
    episodes: dict[str, records.DomainRecord] = field(default_factory=dict)
    sweeps: dict[str, records.Sweep] = field(default_factory=dict)  # by robot, "" the trained one
    strengths: dict[tuple[str, str], records.StrengthSweep] = field(
        default_factory=dict
    )  # by robot and shift
    quoted: str = ""  # which variant of the hand's initial yaw `counts` are of
    variants: dict[str, Counts] = field(default_factory=dict)
    held_out: dict[str, Any] = field(default_factory=dict)  # of a run on recordings
    metrics: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def method(self) -> str:
        return str(self.config.get("method") or self.path.name)

    @property
    def recorded(self) -> bool:
        """Trained on recordings: there is no simulator to be evaluated in."""
        return self.config.get("kind") == "recorded"

    @property
    def task(self) -> str:
        return str(self.config.get("task") or "")


def find_runs(path: Path) -> list[Path]:
    """Run folders at or below `path`, sorted; a run's own subfolders are not searched."""
    if any((path / name).exists() for name in ("eval.json", "eval.npz", "metrics.jsonl")):
        return [path]
    below = [
        run
        for child in sorted(path.iterdir())
        if child.is_dir() and child.name not in _NOT_RUNS and not child.name.startswith(".")
        for run in find_runs(child)
    ]
    if not below and (path / "config.json").exists():
        return [path]
    return below


def load_run(path: Path) -> Run:
    """Read a run folder; whatever cannot be read becomes an entry of `problems`."""
    run = Run(path)

    def read(name: str, reader: Callable[[Path], Any], default: Any) -> Any:
        if not (path / name).exists():
            return default
        try:
            return reader(path / name)
        except records.RecordError as error:
            run.problems.append(str(error))
            return default

    run.config = read("config.json", records.load_json, {})
    run.sessions = read("env.json", records.load_sessions, [])
    run.counts = read("eval.json", records.load_counts, {})
    run.episodes = read("eval.npz", records.load_eval, {})
    for file in sorted(path.glob("sweep*.npz")):
        if (sweep := read(file.name, records.load_sweep, None)) is not None:
            run.sweeps[records.swept_robot(file)] = sweep
    for file in sorted(path.glob("strength-*.npz")):
        if (strengths := read(file.name, records.load_strengths, None)) is not None:
            run.strengths[records.swept_robot(file), strengths.shift] = strengths
    run.held_out = read(records.HELD_OUT, records.load_json, {})
    run.metrics, complaints = read("metrics.jsonl", records.load_metrics, ([], []))
    run.problems += complaints
    if not run.counts and run.episodes:
        run.counts = records.counts(run.episodes)
    run.counts = _keyed(run.counts)
    variants = read("eval_variants.json", records.load_json, {})
    run.quoted = str(variants.pop("quoted", ""))
    run.variants = {
        name: _keyed(entry) for name, entry in variants.items() if isinstance(entry, dict)
    }
    return run


def _keyed(counts: Mapping[str, dict[str, int]]) -> Counts:
    return {paper.domain_key(name): entry for name, entry in counts.items()}


def grouped(runs: Iterable[Run]) -> dict[str, dict[str, list[Run]]]:
    """task -> method -> runs (seeds), methods in display order."""
    tasks: dict[str, dict[str, list[Run]]] = {}
    for run in runs:
        tasks.setdefault(run.task, {}).setdefault(run.method, []).append(run)
    return {
        task: {name: methods[name] for name in paper.ordered_methods(list(methods))}
        for task, methods in tasks.items()
    }


def pooled(runs: Iterable[Run]) -> Counts:
    """Counts of several runs added up per domain."""
    total: Counts = {}
    for run in runs:
        for domain, entry in run.counts.items():
            into = total.setdefault(domain, {"successes": 0, "episodes": 0, "nan": 0})
            for name in into:
                into[name] += entry.get(name, 0)
    return {name: total[name] for name in paper.ordered_domains(list(total))}


def pooled_episodes(runs: Iterable[Run]) -> dict[str, records.DomainRecord]:
    """Single episodes of several runs, one after the other, per domain."""
    parts: dict[str, list[records.DomainRecord]] = {}
    for run in runs:
        for domain, record in run.episodes.items():
            parts.setdefault(domain, []).append(record)
    return {domain: records.joined(pieces) for domain, pieces in parts.items()}


def lookup(tree: Any, name: str) -> Any:
    """The first value called `name` anywhere in nested dicts, the outermost first."""
    if not isinstance(tree, Mapping):
        return None
    if tree.get(name) is not None:
        return tree[name]
    for value in tree.values():
        found = lookup(value, name)
        if found is not None:
            return found
    return None


def regions_of(config: Mapping[str, Any]) -> grids.Regions:
    """Regions recorded in config.json under "regions", with the package's defaults for the rest."""
    given = lookup(config, "regions")
    known = {item.name for item in dataclasses.fields(grids.Regions)}
    values: dict[str, Any] = {}
    if isinstance(given, Mapping):
        for name, value in given.items():
            if name in known:
                values[name] = tuple(value) if isinstance(value, list) else value
    return grids.Regions(**values)
