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


def measure(call: Callable[[], Any], *, repeats: int, items: int) -> dict[str, float]:
    """Rates of `call`, which handles `items` things; its first run compiles and is reported alone.

    Returns:
      per_second of the best and of the median run, CPU milliseconds for each item (less sensitive
      to a busy machine than wall time), seconds of the first run.
    """
    start = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - start
    seconds, before = [], _cpu_seconds()
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    cpu = _cpu_seconds() - before
    return {
        "per_second": items / min(seconds),
        "per_second_median": items / float(np.median(seconds)),
        "cpu_ms_each": 1e3 * cpu / repeats / items,
        "first_call_seconds": first,
    }


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
