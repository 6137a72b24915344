"""`python -m palm_jax bench [render|physics|align|train|eval|all] [--json FILE]`.

`bench worlds` has its own options, see `benchmarks.bench_worlds`.

Prints one JSON: `palm_jax` has the headline figure of each benchmark that ran, every other package
that was measured beside it has its own, `details` all that was measured, the rest on what and when.
"""

import argparse
import importlib
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import common


class Benchmark(NamedTuple):
    """One benchmark: its modules, each with `run() -> dict`, and the key of its headline figure."""

    modules: tuple[str, ...]  # the headline is of the first, and so are `peers`: that of others
    headline: str


BENCHMARKS: dict[str, Benchmark] = {
    "render": Benchmark(("bench_lift_spam", "bench_render"), "frames_per_second"),
    "physics": Benchmark(("bench_physics",), "steps_per_second"),
    "align": Benchmark(("bench_align",), "images_per_second"),
    "train": Benchmark(("bench_train",), "samples_per_second"),
    "eval": Benchmark(("bench_eval",), "seconds"),
}


def collect(names: Sequence[str]) -> dict[str, Any]:
    """Runs benchmarks; the load is that before the first."""
    result: dict[str, Any] = {"palm_jax": {}, **common.conditions(), "details": {}}
    for name in names:
        benchmark, found = BENCHMARKS[name], {}
        for module in benchmark.modules:
            print(f"bench {name}: {module}", file=sys.stderr, flush=True)
            start = time.perf_counter()
            found[module] = importlib.import_module(f"benchmarks.{module}").run()
            print(f"  {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
        first = found[benchmark.modules[0]]
        result["palm_jax"][benchmark.headline] = first[benchmark.headline]
        for package, figures in first.get("peers", {}).items():
            result.setdefault(package, {}).update(figures)
        result["details"][name] = found
    return result


def table(result: dict[str, Any]) -> str:
    """The headline figures for people: a row each, a column for each package."""
    headlines = [b.headline for b in BENCHMARKS.values() if b.headline in result["palm_jax"]]
    packages = [
        name
        for name, figures in result.items()
        if isinstance(figures, dict) and any(headline in figures for headline in headlines)
    ]
    rows = [["", *packages]]
    for headline in headlines:
        figures = [result[package].get(headline) for package in packages]
        rows.append(
            [headline.replace("_", " ")] + ["-" if f is None else f"{f:,.0f}" for f in figures]
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(
            [row[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        )
        for row in rows
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["worlds"]:
        return int(importlib.import_module("benchmarks.bench_worlds").main(words[1:]))
    parser = argparse.ArgumentParser(
        prog="python -m palm_jax bench", description="Speed, as JSON; best on an idle machine."
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"any of {', '.join(BENCHMARKS)}, or all (the default); or worlds, which has options",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the JSON there as well")
    options = parser.parse_args(words)
    names = options.names or ["all"]
    unknown = [name for name in names if name not in (*BENCHMARKS, "all")]
    if unknown:
        parser.error(
            f"unknown benchmark {unknown[0]!r}; known: {', '.join(BENCHMARKS)}, all, worlds"
        )
    result = collect(list(BENCHMARKS) if "all" in names else list(dict.fromkeys(names)))
    common.publish(result, options.json)
    print(table(result), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
