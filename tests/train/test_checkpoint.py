"""Checkpoints: what is written comes back bit for bit, and what is damaged never does."""

import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from palm_jax.train import checkpoint
from palm_jax.train.checkpoint import CheckpointMismatch, DamagedCheckpoint


def make_tree(seed: int) -> dict[str, Any]:
    """The kinds of leaves there are: several dtypes, sizes 0 and 1, named tuples."""
    keys = jax.random.split(jax.random.key(seed))
    params = {
        "kernel": jax.random.normal(keys[0], (300, 40)),
        "bias": jax.random.normal(keys[1], (5,), jnp.bfloat16),
    }
    return {
        "step": jnp.int32(seed),
        "params": params,
        "opt_state": optax.adam(1e-3).init(params),
        "ema_params": {},
        "nothing": jnp.zeros((0, 3)),
        "pixels": np.arange(12, dtype=np.uint8).reshape(3, 4),
    }


def bits(tree: Any) -> list[tuple[str, tuple[int, ...], bytes]]:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return [(str(leaf.dtype), leaf.shape, leaf.tobytes()) for leaf in leaves]


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the checkpoints 1 and 2; to be copied before it is harmed."""
    folder = tmp_path_factory.mktemp("saved") / "checkpoints"
    for step in (1, 2):
        checkpoint.save(folder, step, make_tree(step), {"score": step / 4})
    return folder


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "checkpoints")


def newest(folder: Path) -> int | None:
    found = checkpoint.latest_valid(folder)
    if found is None:
        return None
    step, path = found
    assert path == folder / str(step)
    return step


def set_aside(folder: Path) -> list[str]:
    damaged = folder / "damaged"
    return sorted(path.name for path in damaged.iterdir()) if damaged.is_dir() else []


def array_files(path: Path) -> list[Path]:
    return sorted(file for file in (path / "arrays").rglob("*") if file.is_file())


def test_round_trip_is_exact(saved: Path) -> None:
    tree = make_tree(2)
    step, path = checkpoint.latest_valid(saved) or pytest.fail("nothing found")
    assert step == 2
    assert checkpoint.read_meta(path) == {"score": 0.5}
    for target in (tree, jax.eval_shape(lambda: make_tree(7))):
        loaded = checkpoint.load(path, target)
        assert jax.tree.structure(loaded) == jax.tree.structure(tree)
        assert bits(loaded) == bits(tree)
    assert isinstance(checkpoint.load(path, tree)["pixels"], np.ndarray)
    assert isinstance(loaded["params"]["kernel"], jax.Array)
    assert not list(saved.glob(".*"))  # no leftovers


def test_loaded_arrays_may_be_donated(saved: Path) -> None:
    """They must own their memory: a view of NumPy's would be written through, or refused."""
    loaded = checkpoint.load(saved / "1", make_tree(1))
    kernel = loaded["params"]["kernel"]
    expected = np.array(kernel) + 1
    result = jax.jit(lambda x: x + 1, donate_argnums=0)(kernel)
    assert np.array_equal(result, expected)
    assert kernel.is_deleted()


def test_the_manifest_lists_every_file_and_no_pickle(saved: Path) -> None:
    manifest = json.loads((saved / "2" / "manifest.json").read_text())
    files = {p.relative_to(saved / "2").as_posix() for p in array_files(saved / "2")}
    assert set(manifest["files"]) == files
    assert manifest["leaves"]["params/kernel"] == {"dtype": "float32", "shape": [300, 40]}
    assert manifest["leaves"]["opt_state/0/mu/bias"] == {"dtype": "bfloat16", "shape": [5]}
    assert manifest["versions"]["jax"] == jax.__version__
    for file in array_files(saved / "2"):
        assert file.suffix not in (".pkl", ".pickle")


def flip(file: Path, position: int) -> None:
    content = bytearray(file.read_bytes())
    content[position] ^= 1
    file.write_bytes(content)


def test_a_flipped_bit_in_any_file_is_found(saved: Path, tmp_path: Path) -> None:
    for number, file in enumerate([*array_files(saved / "2"), saved / "2" / "manifest.json"]):
        folder = shutil.copytree(saved, tmp_path / str(number))
        target = folder / file.relative_to(saved)
        if target.stat().st_size == 0:
            continue
        flip(target, target.stat().st_size // 2)
        assert newest(folder) == 1, f"damage in {file} was not noticed"
        reason = "bad-manifest" if file.name == "manifest.json" else "wrong-hash"
        assert set_aside(folder) == [f"2-{reason}"]
        with pytest.raises(DamagedCheckpoint):
            checkpoint.load(folder / "damaged" / f"2-{reason}", make_tree(2))


def test_a_changed_score_in_the_manifest_is_found(folder: Path) -> None:
    file = folder / "2" / "manifest.json"
    file.write_text(file.read_text().replace('"score": 0.5', '"score": 0.9'))
    with pytest.raises(DamagedCheckpoint, match="its own checksum"):
        checkpoint.read_meta(folder / "2")


def largest(path: Path) -> Path:
    return max(array_files(path), key=lambda file: file.stat().st_size)


def _truncate(path: Path) -> None:
    os.truncate(largest(path), largest(path).stat().st_size // 2)


def _empty_file(path: Path) -> None:
    os.truncate(largest(path), 0)


def _lose_a_file(path: Path) -> None:
    largest(path).unlink()


def _empty_folder(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


def _no_manifest(path: Path) -> None:
    (path / "manifest.json").unlink()


def _half_a_manifest(path: Path) -> None:
    os.truncate(path / "manifest.json", 100)


def _not_json(path: Path) -> None:
    (path / "manifest.json").write_bytes(b"\xff\xfe\x00")


def _not_an_object(path: Path) -> None:
    (path / "manifest.json").write_text("[1, 2]")


def _another_program(path: Path) -> None:
    (path / "manifest.json").write_text('{"format": "other", "version": 3}')


def _a_file(path: Path) -> None:
    shutil.rmtree(path)
    path.write_text("not a folder")


def _renamed(path: Path) -> None:
    shutil.rmtree(path)
    path.with_name("1").rename(path)
    shutil.copytree(path, path.with_name("1"))


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (_truncate, "wrong-size"),
        (_empty_file, "wrong-size"),
        (_lose_a_file, "missing-file"),
        (_empty_folder, "empty"),
        (_no_manifest, "no-manifest"),
        (_half_a_manifest, "bad-manifest"),
        (_not_json, "bad-manifest"),
        (_not_an_object, "bad-manifest"),
        (_another_program, "unknown-format"),
        (_a_file, "not-a-folder"),
        (_renamed, "wrong-step"),
    ],
)
def test_damage_is_named_set_aside_and_survived(
    folder: Path, harm: Callable[[Path], None], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    harm(folder / "2")
    assert checkpoint.latest_valid(folder, repair=False) == (1, folder / "1")
    assert set_aside(folder) == []  # a mere reader moves nothing
    with caplog.at_level(logging.WARNING):
        assert newest(folder) == 1
    assert f"({reason})" in caplog.text
    assert set_aside(folder) == [f"2-{reason}"]
    assert bits(checkpoint.load(folder / "1", make_tree(0))) == bits(make_tree(1))
    assert not (folder / "2").exists()
    checkpoint.save(folder, 2, make_tree(2))  # the step's name is free again
    assert newest(folder) == 2


def test_all_damaged_is_none_and_nothing_is_lost(folder: Path) -> None:
    _truncate(folder / "1")
    _truncate(folder / "2")
    assert newest(folder) is None
    assert set_aside(folder) == ["1-wrong-size", "2-wrong-size"]
    checkpoint.save(folder, 2, make_tree(2))
    _truncate(folder / "2")
    assert newest(folder) is None
    assert set_aside(folder) == ["1-wrong-size", "2-wrong-size", "2-wrong-size-2"]
    assert newest(folder / "absent") is None


def test_other_names_are_left_alone(folder: Path) -> None:
    (folder / "notes").mkdir()
    (folder / "99.old").mkdir()
    assert newest(folder) == 2
    assert (folder / "notes").is_dir() and (folder / "99.old").is_dir()


KILLED_BEFORE_THE_RENAME = """
import os, sys
import numpy as np
from palm_jax.train import checkpoint

def die(source, target):
    os.kill(os.getpid(), 9)

checkpoint.os.rename = die
checkpoint.save(sys.argv[1], 3, {"x": np.arange(4.0)})
"""


def test_killed_between_write_and_rename(folder: Path) -> None:
    """The whole process, so that no handler of ours can tidy up."""
    root = Path(__file__).resolve().parents[2]
    run = subprocess.run([sys.executable, "-c", KILLED_BEFORE_THE_RENAME, folder], cwd=root)
    assert run.returncode == -9
    assert len(list(folder.glob(".saving-3-*"))) == 1
    assert newest(folder) == 2
    assert set_aside(folder) == ["3-unfinished"]
    assert not list(folder.glob(".saving-*"))


def test_an_error_while_writing_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(checkpoint, "_hash_files", full_disk)
    with pytest.raises(OSError, match="no space"):
        checkpoint.save(folder, 3, make_tree(3))
    assert sorted(path.name for path in folder.iterdir()) == ["1", "2"]


def test_a_writer_that_is_alive_is_not_disturbed(folder: Path) -> None:
    alive = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        busy = folder / f".saving-3-{alive.pid}"
        busy.mkdir()
        assert newest(folder) == 2
        assert busy.is_dir()
    finally:
        alive.communicate(b"\n")
    assert newest(folder) == 2
    assert set_aside(folder) == ["3-unfinished"]


def test_a_step_can_be_saved_again(folder: Path) -> None:
    checkpoint.save(folder, 2, make_tree(5))
    assert bits(checkpoint.load(folder / "2", make_tree(0))) == bits(make_tree(5))
    assert not list(folder.glob(".*"))


def test_mismatches_name_the_leaf(saved: Path) -> None:
    path = saved / "2"
    tree = make_tree(2)

    def with_kernel(kernel: Any) -> dict[str, Any]:
        return {**tree, "params": {**tree["params"], "kernel": kernel}}

    with pytest.raises(
        CheckpointMismatch, match=r"'params/kernel': expected float16\[300, 40\].*has float32"
    ):
        checkpoint.load(path, with_kernel(tree["params"]["kernel"].astype(jnp.float16)))
    with pytest.raises(CheckpointMismatch, match=r"'params/kernel'.*\[300, 41\]"):
        checkpoint.load(path, with_kernel(jax.ShapeDtypeStruct((300, 41), jnp.float32)))
    with pytest.raises(CheckpointMismatch, match="'extra' is expected, but not in"):
        checkpoint.load(path, {**tree, "extra": jnp.ones(1)})
    fewer = {name: leaf for name, leaf in tree.items() if name != "pixels"}
    with pytest.raises(CheckpointMismatch, match="'pixels' is in the checkpoint, but not expected"):
        checkpoint.load(path, fewer)


def test_trees_that_cannot_be_stored_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not unique"):
        checkpoint.save(tmp_path, 1, {"a/b": jnp.ones(1), "a": {"b": jnp.ones(1)}})
    with pytest.raises(ValueError, match="'a' is a typed key"):
        checkpoint.save(tmp_path, 1, {"a": jax.random.key(0)})
    with pytest.raises(ValueError, match="no leaves"):
        checkpoint.save(tmp_path, 1, {})
    with pytest.raises(ValueError, match="step is -1"):
        checkpoint.save(tmp_path, -1, {"a": jnp.ones(1)})


def test_retention_and_choice(tmp_path: Path) -> None:
    tree = {"x": np.arange(3.0)}
    scores = {10: 0.2, 20: 0.9, 30: float("nan"), 40: 0.9, 50: 0.5, 60: None}
    for step, score in scores.items():
        checkpoint.save(tmp_path, step, tree, {"score": score})
    ranked = [step for step, _ in checkpoint.best(tmp_path, count=10)]
    assert ranked == [40, 20, 50, 10]  # the newer first among equals; no score, no rank
    assert checkpoint.prune(tmp_path, keep=2) == [10, 30]
    assert [step for step, _ in checkpoint.steps(tmp_path)] == [20, 40, 50, 60]

    checkpoint.update_meta(tmp_path / "60", score=np.float32(0.95), note="late")
    assert checkpoint.read_meta(tmp_path / "60")["note"] == "late"
    checkpoint.verify(tmp_path / "60")
    assert checkpoint.best(tmp_path) == [(60, tmp_path / "60")]
    checkpoint.save(tmp_path, 70, tree, {"score": 0.0}, keep=1)
    assert [step for step, _ in checkpoint.steps(tmp_path)] == [60, 70]

    largest(tmp_path / "60").write_bytes(b"")  # the best is damaged: the next best is chosen
    assert checkpoint.best(tmp_path) == [(70, tmp_path / "70")]


def test_the_two_newest_stay_without_any_score(tmp_path: Path) -> None:
    for step in (1, 2, 3):
        checkpoint.save(tmp_path, step, {"x": np.ones(1)}, keep=3)
    assert [step for step, _ in checkpoint.steps(tmp_path)] == [2, 3]


def test_a_relative_folder_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tree = {"a": np.arange(3, dtype=np.float32)}
    checkpoint.save("runs/here", 5, tree)
    found = checkpoint.latest_valid(Path("runs/here"))
    assert found is not None and found[0] == 5
    np.testing.assert_array_equal(checkpoint.load(found[1], tree)["a"], tree["a"])


def test_a_checkpoint_of_other_options_is_named_and_set_aside(tmp_path: Path) -> None:
    tree = {"x": np.ones(1)}
    checkpoint.save(tmp_path, 1, tree, {checkpoint.FINGERPRINT: "mine", "score": 0.1})
    checkpoint.save(tmp_path, 2, tree, {checkpoint.FINGERPRINT: "theirs", "score": 0.9})
    assert checkpoint.best(tmp_path, fingerprints=["mine"]) == [(1, tmp_path / "1")]
    assert checkpoint.latest_valid(tmp_path, fingerprints=["mine"]) == (1, tmp_path / "1")
    assert set_aside(tmp_path) == ["2-foreign"]
    checkpoint.save(tmp_path, 3, tree)  # from before there were fingerprints
    assert checkpoint.latest_valid(tmp_path, fingerprints=["mine"]) == (3, tmp_path / "3")
