"""The bookkeeping of benchmarks; what they measure is not a matter of tests."""

import json
from pathlib import Path

import numpy as np
import pytest

import benchmarks.__main__ as bench
from benchmarks import bench_lift_spam, common, page


def test_calls_are_timed_in_turns():
    """A warm-up each, then one after the other: a busy moment hits all of them."""
    told: list[str] = []
    found = common.side_by_side(
        {name: lambda name=name: told.append(name) for name in "ab"}, repeats=3, items=5
    )
    assert "".join(told) == "ab" + "ababab"
    for figures in found.values():
        assert figures["per_second"] >= figures["per_second_median"] > 0


def test_other_packages_have_their_own_entry(monkeypatch):
    """`{"palm_jax": {...}, "peer": {...}}`, each with the headline figure; a benchmark that crashes
    costs the others nothing."""
    results = {
        "bench_fake": {"frames_per_second": 42000.0, "peers": {"slow": {"frames_per_second": 7.0}}},
        "bench_alone": {"images_per_second": 5.0},
        "bench_broken": "exit code -11 (signal 11)",
    }
    monkeypatch.setattr(bench, "_alone", lambda module, device: results[module])
    table = {
        "render": bench.Benchmark(("bench_fake",), "frames_per_second"),
        "train": bench.Benchmark(("bench_broken",), "samples_per_second"),
        "align": bench.Benchmark(("bench_alone",), "images_per_second"),
    }
    monkeypatch.setattr(bench, "BENCHMARKS", table)
    result = bench.collect(list(table))
    assert result["palm_jax"] == {"frames_per_second": 42000.0, "images_per_second": 5.0}
    assert result["slow"] == {"frames_per_second": 7.0}
    assert result["failed"] == {"bench_broken": "exit code -11 (signal 11)"}
    rows = [line.split() for line in bench.table(result).splitlines()]
    assert rows == [
        ["palm_jax", "slow"],
        ["frames", "per", "second", "42,000", "7"],
        ["images", "per", "second", "5", "-"],
    ]


def test_a_benchmark_runs_in_a_process_of_its_own(tmp_path: Path):
    """What it prints does not matter, how it ends does."""
    good, bad = (bench._alone(name, "") for name in ("common", "no_such_module"))
    assert good == "exit code 1" and bad == "exit code 1"  # neither has a `run`


def test_edges_are_where_a_neighbour_differs():
    ids = np.zeros((1, 5, 5), int)
    ids[0, 2, 4] = 3
    inside = bench_lift_spam._away_from_edges(ids)[0]
    assert not inside[1:4, 3:].any() and inside[1:4, 1:3].all()


RESULT = {
    "machine": "a machine, 2 cores",
    "load": [0.25, 0.0, 0.0],
    "date": "2026-01-01",
    "versions": {"jax": "1.2"},
    "details": {
        "align": {
            "bench_align": {
                "operations": {
                    "64": {
                        "align": {
                            "palm_jax": {"per_second_median": 12345.6},
                            "opencv": {"per_second_median": 98.76},
                        },
                        "overlay": {"palm_jax": {"per_second_median": 7.0}},
                    }
                },
                "ours": {"random_crop": {"per_second_median": 3.0}},
            }
        }
    },
}


def test_a_page_gets_the_figures_between_its_markers(tmp_path: Path):
    source, target = tmp_path / "result.json", tmp_path / "page.md"
    source.write_text(json.dumps(RESULT))
    target.write_text(f"before\n{page.BEGIN}\nold\n{page.END}\nafter\n")
    assert page.main([str(source), str(target)]) == 0
    written = target.read_text()
    assert written.startswith("before\n") and written.endswith("\nafter\n")
    assert "old" not in written
    assert "| batch of 64 | palm_jax | opencv |" in written
    assert "| align | 12 346 | 98.8 |" in written
    assert "| overlay | 7.0 | - |" in written
    # Once more changes nothing.
    assert page.main([str(source), str(target)]) == 0
    assert target.read_text() == written


def test_a_page_without_markers_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source, target = tmp_path / "result.json", tmp_path / "page.md"
    source.write_text(json.dumps(RESULT))
    target.write_text("text")
    assert page.main([str(source), str(target)]) == 1
    assert "page.md: expected the markers" in capsys.readouterr().err
    assert target.read_text() == "text"
