"""`python -m palm_jax bench [render|physics|align|data|train|eval|all] [--json FILE]`.

`bench worlds` has its own options, see `benchmarks.bench_worlds`.

Prints one JSON: `palm_jax` has the headline figure of each benchmark that ran, every other package
that was measured beside it has its own, `details` all that was measured, the rest on what and when.
"""

import argparse
import importlib
import json
import subprocess
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
    "data": Benchmark(("bench_data",), "file_frames_per_second"),
    "train": Benchmark(("bench_train",), "samples_per_second"),
    "eval": Benchmark(("bench_eval",), "seconds"),
}


def collect(names: Sequence[str], device: str = "") -> dict[str, Any]:
    """Runs benchmarks, each in a process of its own: packages that are compared do not always bear
    each other, and a crash is to cost one benchmark. The load is that before the first.

    Returns:
      the JSON; `failed` has the modules that ended badly, and how.
    """
    result: dict[str, Any] = {"palm_jax": {}, **common.conditions(), "details": {}, "failed": {}}
    for name in names:
        benchmark, found = BENCHMARKS[name], {}
        for module in benchmark.modules:
            print(f"bench {name}: {module}", file=sys.stderr, flush=True)
            start = time.perf_counter()
            measured = _alone(module, device)
            if isinstance(measured, str):
                result["failed"][module] = measured
            else:
                found[module] = measured
            print(f"  {time.perf_counter() - start:.0f} s", file=sys.stderr, flush=True)
        result["details"][name] = found
        first = found.get(benchmark.modules[0])
        if first is not None:
            result["palm_jax"][benchmark.headline] = first[benchmark.headline]
            for package, figures in first.get("peers", {}).items():
                result.setdefault(package, {}).update(figures)
    return result


def _alone(module: str, device: str) -> dict[str, Any] | str:
    """The result of one module, or how its process ended."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.alone", module, *([device] if device else [])],
        cwd=Path(__file__).resolve().parents[1],
        stdout=subprocess.PIPE,
        text=True,
        close_fds=False,
    )
    if done.returncode:
        signal = f" (signal {-done.returncode})" if done.returncode < 0 else ""
        message = f"exit code {done.returncode}{signal}"
        print(f"  {module} failed: {message}", file=sys.stderr, flush=True)
        return message
    measured: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return measured


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
    parser.add_argument(
        "--device", choices=("cpu", "gpu"), help="where JAX runs (default: where it likes to)"
    )
    options = parser.parse_args(words)
    names = options.names or ["all"]
    unknown = [name for name in names if name not in (*BENCHMARKS, "all")]
    if unknown:
        parser.error(
            f"unknown benchmark {unknown[0]!r}; known: {', '.join(BENCHMARKS)}, all, worlds"
        )
    if options.device:
        try:
            common.use(options.device)
        except RuntimeError as error:
            parser.error(str(error))
    chosen = list(BENCHMARKS) if "all" in names else list(dict.fromkeys(names))
    result = collect(chosen, options.device or "")
    common.publish(result, options.json)
    print(table(result), file=sys.stderr)
    return 1 if result["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
