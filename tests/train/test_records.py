"""Evaluation and sweep files: round trips, and named errors for damaged ones."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palm_jax.train.files import records


def values(n: int = 3) -> dict[str, Any]:
    return {
        "success": np.arange(n) % 2 == 0,
        "nan": np.arange(n) == 0,
        "object_xy": np.arange(2.0 * n).reshape(n, 2),
        "camera_angle": np.linspace(-0.5, 0.5, n),
        "length": np.arange(n) + 10,
        "draws": np.arange(n) + 1,
    }


def small_sweep() -> records.Sweep:
    success = np.zeros((2, 3, 4, 5), bool)
    success[1, 2, 3] = True
    return records.Sweep(np.array([-0.1, 0.1]), np.arange(3.0), np.arange(4.0), success, ~success)


def test_evaluation_round_trip(tmp_path: Path) -> None:
    path = records.save_eval(tmp_path / "eval.npz", {"W+V": values(3), "ID": values(4)})
    loaded = records.load_eval(path)
    assert list(loaded) == ["W+V", "ID"]
    for name, array in values(3).items():
        np.testing.assert_array_equal(getattr(loaded["W+V"], name), np.float32(array))
    assert loaded["ID"].length.dtype == np.int32 and loaded["ID"].success.dtype == bool
    assert [p.name for p in tmp_path.iterdir()] == ["eval.npz"]
    # Saving what was loaded changes nothing.
    again = records.save_eval(tmp_path / "again.npz", loaded)
    assert again.read_bytes() == path.read_bytes()


def test_a_non_finite_episode_is_no_success() -> None:
    record = records.domain_record(values(3))  # successes 0 and 2, of which 0 went non-finite
    assert record.solved.tolist() == [False, False, True]
    assert records.counts({"ID": record}) == {"ID": {"successes": 1, "episodes": 3, "nan": 1}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"object_xy": np.zeros((3, 3))}, r"W/object_xy: expected shape \(3, 2\).*got \(3, 3\)"),
        ({"length": np.zeros(2)}, r"W/length: expected shape \(3,\).*got \(2,\)"),
    ],
)
def test_wrong_shapes_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(records.RecordError, match=message):
        records.domain_record({**values(3), **change}, where="W")


def test_missing_array_is_named() -> None:
    incomplete = {name: array for name, array in values(3).items() if name != "nan"}
    with pytest.raises(records.RecordError, match="missing nan"):
        records.domain_record(incomplete)


def test_files_from_before_draws_were_counted_still_load(tmp_path: Path) -> None:
    old = {f"ID/{name}": array for name, array in values(4).items() if name != "draws"}
    np.savez(tmp_path / "eval.npz", **old)
    loaded = records.load_eval(tmp_path / "eval.npz")["ID"]
    assert loaded.draws.tolist() == [0] * 4 and loaded.length.tolist() == [10, 11, 12, 13]


def test_strengths_round_trip(tmp_path: Path) -> None:
    success = np.array([[True, False, True], [True, True, True]])
    sweep = records.StrengthSweep("lighting", np.array([-1.0, 0.5]), success, ~success)
    loaded = records.load_strengths(records.save_sweep(tmp_path / "s.npz", sweep))
    assert loaded.shift == "lighting" and loaded.strengths.tolist() == [-1.0, 0.5]
    np.testing.assert_array_equal(loaded.success, success)
    np.testing.assert_array_equal(loaded.nan, ~success)
    np.testing.assert_array_equal(loaded.solved, success)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"success": np.zeros((2, 3)), "nan": np.zeros((2, 3))}, r"shape \[1, S\], got \(2, 3\)"),
        ({"nan": np.zeros((1, 2))}, r"got \(1, 3\) and \(1, 2\)"),
        ({"shift": None}, "s.npz: missing shift"),
    ],
)
def test_wrong_strengths_are_named(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    whole = {"shift": "lighting", "strengths": [0.5], "success": np.zeros((1, 3))}
    arrays = whole | {"nan": np.zeros((1, 3))} | change
    kept = {name: array for name, array in arrays.items() if array is not None}
    np.savez(tmp_path / "s.npz", **kept)
    with pytest.raises(records.RecordError, match=message):
        records.load_strengths(tmp_path / "s.npz")


def test_sweep_round_trip(tmp_path: Path) -> None:
    sweep = small_sweep()
    loaded = records.load_sweep(records.save_sweep(tmp_path / "sweep.npz", sweep))
    for name in ("angles", "xs", "ys", "success", "nan"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(sweep, name))
    assert loaded.solved.sum() == 5


def test_sweep_with_a_wrong_grid_is_named(tmp_path: Path) -> None:
    path = tmp_path / "sweep.npz"
    two = np.zeros(2)
    np.savez(path, angles=two, xs=two, ys=two, success=np.zeros((2, 2, 3, 1)))
    with pytest.raises(records.RecordError, match=r"sweep.npz: success: .*got \(2, 2, 3, 1\)"):
        records.load_sweep(path)


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "text"])
def test_damaged_archives_are_named(damage: str, tmp_path: Path) -> None:
    path = records.save_eval(tmp_path / "eval.npz", {"ID": values(200)})
    content = bytearray(path.read_bytes())
    if damage == "truncate":
        content = content[: len(content) // 2]
    elif damage == "flip":
        content[content.index(b"object_xy.npy") + 60] ^= 0xFF  # in the compressed numbers
    else:
        content = bytearray(b"" if damage == "empty" else b"not an archive")
    path.write_bytes(content)
    with pytest.raises(records.RecordError, match="eval.npz"):
        records.load_eval(path)


@pytest.mark.parametrize(
    "content",
    ["{", "[1]", '{"ID": 3}', '{"ID": {"successes": 5, "episodes": 4}}', '{"ID": {"episodes": 4}}'],
)
def test_damaged_counts_are_named(content: str, tmp_path: Path) -> None:
    path = tmp_path / "eval.json"
    path.write_text(content)
    with pytest.raises(records.RecordError, match="eval.json"):
        records.load_counts(path)


def test_counts_without_nan_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "eval.json"
    path.write_text(json.dumps({"ID": {"successes": 3, "episodes": 4}}))
    assert records.load_counts(path) == {"ID": {"successes": 3, "episodes": 4, "nan": 0}}


def test_metrics_with_damaged_lines(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1, "loss": 0.5}\nrubbish\n{"step": 2, "loss": 0.4}\n{"step": 3, "lo')
    found, complaints = records.load_metrics(path)
    assert [record["step"] for record in found] == [1, 2]
    assert len(complaints) == 1 and "1 unreadable" in complaints[0]


def test_an_archive_whose_directory_hides_arrays_is_refused(tmp_path: Path) -> None:
    """One byte, the length of an entry's comment, makes zipfile pass over the entries after it."""
    cells = np.ones((1, 1, 1, 3), bool)
    sweep = records.Sweep(np.zeros(1), np.zeros(1), np.zeros(1), cells, cells)
    path = records.save_sweep(tmp_path / "sweep.npz", sweep)
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\x01\x02", 0, content.index(b"nan.npy", len(content) // 2))
    before = content.rindex(b"PK\x01\x02", 0, entry)
    content[before + 32] = len(content) - content.index(b"PK\x05\x06") + 150
    path.write_bytes(bytes(content))
    with pytest.raises(records.RecordError, match=r"sweep.npz: not a readable"):
        records.load_sweep(path)
