"""Checkpoints: what is written comes back bit for bit, and what is damaged never does."""

import errno
import hashlib
import json
import logging
import os
import shutil
import subprocess
import sys
import threading
import time
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


def _forged(**entries: Any) -> Callable[[Path], None]:
    """Another manifest with a right checksum; entries that are `None` are left out."""

    def harm(path: Path) -> None:
        manifest = {**json.loads((path / "manifest.json").read_text()), **entries}
        kept = {k: v for k, v in manifest.items() if v is not None and k != "checksum"}
        text = json.dumps(kept, sort_keys=True)
        kept["checksum"] = hashlib.sha256(text.encode()).hexdigest()
        (path / "manifest.json").write_text(json.dumps(kept))

    return harm


def _deep(path: Path) -> None:
    (path / "manifest.json").write_text('{"meta": ' + "[" * 100_000 + "]" * 100_000 + "}")


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (_forged(files=None), "files is not"),
        (_forged(files=["arrays/x"]), "files is not"),
        (_forged(files={"arrays/x": 3}), "files: arrays/x is not"),
        (_forged(files={"arrays/x": {"size": "3", "sha256": ""}}), "files: arrays/x is not"),
        (_forged(step=None), "step is not"),
        (_forged(step="2"), "step is not"),
        (_forged(meta=[1]), "meta is not"),
        (_forged(leaves={"params/bias": {"shape": []}}), "leaves: params/bias is not"),
        (_deep, "unreadable"),
    ],
)
def test_a_manifest_of_another_kind_is_survived(
    harm: Callable[[Path], None], said: str, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Whoever made it knew how to make its checksum."""
    harm(folder / "2")
    assert checkpoint.best(folder) == [(1, folder / "1")]
    assert newest(folder) == 1 and set_aside(folder) == ["2-bad-manifest"]
    assert said in caplog.text


def test_a_bad_sector_is_survived(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, broken = hashlib.file_digest, largest(folder / "2")

    def digest(stream: Any, name: str) -> Any:
        if Path(stream.name) == broken:
            raise OSError(errno.EIO, os.strerror(errno.EIO), stream.name)
        return real(stream, name)

    monkeypatch.setattr(checkpoint.hashlib, "file_digest", digest)
    assert newest(folder) == 1 and set_aside(folder) == ["2-unreadable"]


def test_too_many_open_files_are_nobodys_damage(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def digest(*_: Any) -> Any:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(checkpoint.hashlib, "file_digest", digest)
    with pytest.raises(OSError, match="Too many open files"):
        newest(folder)
    assert set_aside(folder) == []


@pytest.mark.parametrize("after", range(1, 8))
def test_a_checkpoint_that_is_removed_while_it_is_read_is_passed_over(
    after: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the training that a reader looks at: after so many looks at files of it."""
    left, real = after, os.stat
    doomed = folder / "2"

    def stat(path: Any, *arguments: Any, **options: Any) -> Any:
        nonlocal left
        if isinstance(path, (str, Path)) and doomed in (Path(path), *Path(path).parents):
            left -= 1
            if left == 0:
                doomed.rename(folder / ".removing-2-1")
        return real(path, *arguments, **options)

    for reader in (
        lambda: checkpoint.best(folder)[0],
        lambda: checkpoint.latest_valid(folder, repair=False),
        lambda: checkpoint.latest_valid(folder),
    ):
        left = after
        with monkeypatch.context() as removing:
            removing.setattr(os, "stat", stat)
            assert reader() == (1, folder / "1")
        assert set_aside(folder) == []
        if (folder / ".removing-2-1").exists():
            (folder / ".removing-2-1").rename(doomed)
        else:  # a reader that repairs deletes what was to be deleted
            assert not doomed.exists()


KILLED_BEFORE_A_RENAME = """
import os, sys
from pathlib import Path
import numpy as np
from palm_jax.train import checkpoint

left, real = int(sys.argv[3]), os.rename

def rename(source, target):
    global left
    left -= Path(source).name.startswith(".saving-") or Path(target).name.startswith(".removing-")
    if left == 0:
        os.kill(os.getpid(), 9)
    real(source, target)

os.rename = rename
checkpoint.save(sys.argv[1], int(sys.argv[2]), {"x": np.arange(4.0)})
"""


@pytest.mark.parametrize(
    ("step", "renames", "new", "aside"),
    [
        (3, 1, True, []),  # whole but for its name
        (2, 1, False, ["2-unfinished"]),  # the old one has the name
        (2, 2, True, []),  # nobody has it
    ],
)
def test_killed_between_write_and_rename(
    step: int, renames: int, new: bool, aside: list[str], folder: Path
) -> None:
    """The whole process, so that no handler of ours can tidy up."""
    root = Path(__file__).resolve().parents[2]
    words = [str(folder), str(step), str(renames)]
    run = subprocess.run([sys.executable, "-c", KILLED_BEFORE_A_RENAME, *words], cwd=root)
    assert run.returncode == -9
    assert len(list(folder.glob(f".saving-{step}-*"))) == 1
    assert newest(folder) == step
    assert set_aside(folder) == aside and not list(folder.glob(".*"))
    names = json.loads((folder / str(step) / "manifest.json").read_text())["leaves"].keys()
    assert (names == {"x"}) is new


def test_half_a_checkpoint_is_set_aside(folder: Path) -> None:
    _truncate(folder / "2")
    (folder / "2").rename(folder / f".saving-2-{2**22 + 1}")
    assert newest(folder) == 1 and set_aside(folder) == ["2-unfinished"]


def test_what_has_the_name_keeps_it_if_it_cannot_be_replaced(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.rename

    def rename(source: Path, target: Path) -> None:
        if ".saving-" in str(source):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, target)

    monkeypatch.setattr(checkpoint.os, "rename", rename)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(folder, 2, make_tree(5))
    monkeypatch.undo()
    assert bits(checkpoint.load(folder / "2", make_tree(0))) == bits(make_tree(2))
    assert not list(folder.glob(".*"))


def test_an_error_while_writing_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(checkpoint, "_hash_files", full_disk)
    with pytest.raises(OSError, match="no space"):
        checkpoint.save(folder, 3, make_tree(3))
    assert sorted(path.name for path in folder.iterdir()) == ["1", "2"]


def test_a_failed_save_outlasts_threads_that_go_on_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Orbax raises with the first of its writes that fails, while others are still under way."""
    writers = []

    def fail(path: Path, tree: Any) -> None:
        def write_late() -> None:
            time.sleep(0.1)
            path.mkdir(parents=True, exist_ok=True)
            (path / "late").write_bytes(b"...")

        writers.append(threading.Thread(target=write_late))
        writers[0].start()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint, "_orbax_save", fail)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(tmp_path, 1, make_tree(1))
    writers[0].join()
    assert list(tmp_path.iterdir()) == []


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
