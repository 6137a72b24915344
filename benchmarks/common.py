"""What every benchmark needs: timing, and what the figures were measured on."""

import datetime
import json
import os
import platform
import resource
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

PACKAGES = ("palm-jax", "jax", "jaxlib", "flax", "mujoco", "mujoco-mjx", "numpy")


def use(device: str) -> None:
    """Makes JAX run on "cpu" or "gpu".

    Raises:
      RuntimeError: there is none.
    """
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda,cpu"}[device])
    try:
        found = jax.default_backend()
    except RuntimeError as error:
        raise RuntimeError(
            f"--device {device}: JAX finds none ({error}); a GPU needs jax[cuda12]"
        ) from error
    if found != device:
        raise RuntimeError(f"--device {device}: JAX runs on {found} already")


def measure(call: Callable[[], Any], *, repeats: int, items: int) -> dict[str, float]:
    """Rates of `call`, which handles `items` things; its first run compiles and is reported alone.

    Returns:
      per_second of the best and of the median run, CPU milliseconds for each item (less sensitive
      to a busy machine than wall time), seconds of the first run.
    """
    return side_by_side({"call": call}, repeats=repeats, items=items)["call"]


def side_by_side(
    calls: dict[str, Callable[[], Any]], *, repeats: int, items: int
) -> dict[str, dict[str, float]]:
    """`measure` of several calls in turns, so that a busy moment of the machine hits them all."""
    first = {name: _timed(call)[0] for name, call in calls.items()}
    runs: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            runs[name].append(_timed(call))
    found = {}
    for name, pairs in runs.items():
        seconds, cpu = np.array(pairs).T
        found[name] = {
            "per_second": items / float(seconds.min()),
            "per_second_median": items / float(np.median(seconds)),
            "cpu_ms_each": 1e3 * float(cpu.mean()) / items,
            "first_call_seconds": first[name],
        }
    return found


def headline(row: dict[str, dict[str, float]], unit: str) -> dict[str, Any]:
    """`unit` (such as "images_per_second") of ours, and under `peers` that of every other package,
    of a row as `side_by_side` gives it: medians."""
    rates = {name: {unit: figures["per_second_median"]} for name, figures in row.items()}
    return {**rates.pop("palm_jax"), "peers": rates}


def _timed(call: Callable[[], Any]) -> tuple[float, float]:
    """Wall and CPU seconds until the result of `call` is there."""
    start, before = time.perf_counter(), _cpu_seconds()
    jax.block_until_ready(call())
    return time.perf_counter() - start, _cpu_seconds() - before


def _cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def conditions() -> dict[str, Any]:
    """Machine, versions, load and time."""
    return {
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "devices": [device.device_kind for device in jax.devices()],
        "load": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "versions": {name: version for name in PACKAGES if (version := _version(name))}
        | {"python": platform.python_version()},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def publish(result: dict[str, Any], file: Path | None) -> None:
    """Prints a benchmark's JSON, and writes it to `file` as well if one is given."""
    text = json.dumps(result, indent=2)
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")
    print(text)
