"""The two files of a main table: counts in JSON, and beside them every episode in .npz.

    {"header": {...}, "results": {task: {method: {seed: {domain: {"successes", "episodes",
    "nan"}}}}}, "sha256": "...", and further parts that are laid out like "results"}

The episodes lie under TASK/METHOD/SEED/DOMAIN, laid out like those of eval.npz. Counts and episodes
are checked against each other wherever both are read."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from palm_jax.train.files import records
from palm_jax.train.files.metrics import plain, write_json
from palm_jax.train.files.records import DomainRecord, RecordError


class Cell(NamedTuple):
    """One policy."""

    task: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.task}/{self.method}-s{self.seed}"


Episodes = dict[Cell, dict[str, DomainRecord]]  # cell -> domain


def load(path: Path) -> dict[str, Any]:
    """The JSON file.

    Raises:
      RecordError: it is damaged, or not what was written.
    """
    table = records.load_json(path)
    if table.get("sha256", digest(table)) != digest(table):
        raise RecordError(f"{path}: the content is not what was written")
    return table


def store(path: Path, table: Mapping[str, Any]) -> None:
    """Writes the JSON file, whole or not at all."""
    write_json(path, {**table, "sha256": digest(table)})


def digest(table: Mapping[str, Any]) -> str:
    """SHA-256 of a table's content, so that a digit that was changed is noticed."""
    content = {name: value for name, value in table.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(plain(content), sort_keys=True).encode()).hexdigest()


def put(table: dict[str, Any], part: str, cell: Cell, value: Any) -> None:
    """Sets what a part of the table says of a cell."""
    row = table.setdefault(part, {}).setdefault(cell.task, {})
    row.setdefault(cell.method, {})[str(cell.seed)] = value


def get(table: Mapping[str, Any], part: str, cell: Cell) -> Any:
    """What a part says of a cell; None if nothing."""
    row = table.get(part, {}).get(cell.task, {})
    return row.get(cell.method, {}).get(str(cell.seed))


def drop(table: dict[str, Any], part: str, cell: Cell) -> None:
    """Takes a cell out of a part."""
    table.get(part, {}).get(cell.task, {}).get(cell.method, {}).pop(str(cell.seed), None)


def cells(table: Mapping[str, Any], part: str) -> Iterator[Cell]:
    """Those that a part says something of."""
    for task, row in table.get(part, {}).items():
        for method, seeds in row.items():
            for seed in seeds:
                yield Cell(task, method, int(seed))


def episodes_file(table: Path) -> Path:
    """Where the episodes of a table's JSON file are kept."""
    return table.with_suffix(".npz")


def load_episodes(table: Path) -> Episodes:
    """The episodes beside a JSON file; empty where there is no such file.

    Raises:
      RecordError: the file is damaged or none of a table.
    """
    path, found = episodes_file(table), Episodes()
    for name, record in (records.load_eval(path) if path.exists() else {}).items():
        try:
            task, method, seed, domain = name.split("/")
            found.setdefault(Cell(task, method, int(seed)), {})[domain] = record
        except ValueError as error:
            raise RecordError(
                f"{path}: expected arrays named TASK/METHOD/SEED/DOMAIN/..., got {name!r}"
            ) from error
    return found


def save_episodes(table: Path, episodes: Mapping[Cell, Mapping[str, DomainRecord]]) -> None:
    """Writes the .npz file, whole or not at all."""
    named = {
        f"{cell.task}/{cell.method}/{cell.seed}/{domain}": record
        for cell, by_domain in episodes.items()
        for domain, record in by_domain.items()
    }
    records.save_eval(episodes_file(table), named)


def check_counts(path: Path, table: Mapping[str, Any], cell: Cell, episodes: Episodes) -> None:
    """Check that a cell's counts are those of its episodes.

    Raises:
      RecordError: they differ, or the episodes are missing; cell and domain are named.
    """
    counts = get(table, "results", cell)
    records.compare_counts(f"{path}: {cell.name}", counts, episodes.get(cell, {}))
