"""The bookkeeping of benchmarks; what they measure is not a matter of tests."""

import sys
import types

import numpy as np
import pytest

import benchmarks.__main__ as bench
from benchmarks import bench_lift_spam, common


def test_calls_are_timed_in_turns():
    """A warm-up each, then one after the other: a busy moment hits all of them."""
    told: list[str] = []
    found = common.side_by_side(
        {name: lambda name=name: told.append(name) for name in "ab"}, repeats=3, items=5
    )
    assert "".join(told) == "ab" + "ababab"
    for figures in found.values():
        assert figures["per_second"] >= figures["per_second_median"] > 0


def fake(monkeypatch: pytest.MonkeyPatch, name: str, result: dict) -> bench.Benchmark:
    module = types.ModuleType(f"benchmarks.{name}")
    module.run = lambda: result  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return bench.Benchmark((name,), "frames_per_second")


def test_other_packages_have_their_own_entry(monkeypatch):
    """`{"palm_jax": {...}, "peer": {...}}`, each with the headline figure."""
    peers = {"slow": {"frames_per_second": 7.0}}
    made = fake(monkeypatch, "bench_fake", {"frames_per_second": 42000.0, "peers": peers})
    alone = fake(monkeypatch, "bench_alone", {"images_per_second": 5.0})
    alone = alone._replace(headline="images_per_second")
    monkeypatch.setattr(bench, "BENCHMARKS", {"render": made, "align": alone})
    result = bench.collect(["render", "align"])
    assert result["palm_jax"] == {"frames_per_second": 42000.0, "images_per_second": 5.0}
    assert result["slow"] == {"frames_per_second": 7.0}
    rows = [line.split() for line in bench.table(result).splitlines()]
    assert rows == [
        ["palm_jax", "slow"],
        ["frames", "per", "second", "42,000", "7"],
        ["images", "per", "second", "5", "-"],
    ]


def test_edges_are_where_a_neighbour_differs():
    ids = np.zeros((1, 5, 5), int)
    ids[0, 2, 4] = 3
    inside = bench_lift_spam._away_from_edges(ids)[0]
    assert not inside[1:4, 3:].any() and inside[1:4, 1:3].all()
