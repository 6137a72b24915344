"""Files that are not what was written."""

import dataclasses
import functools
import hashlib
import io
import json
import logging
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np
from faults.cases import Outcome, case, cut, flip, flip_inside, refused, snapshot
from rich.console import Console

from palm_jax.envs import make
from palm_jax.envs.base import EnvParams
from palm_jax.train import checkpoint, demos, run, table, training, workspace
from palm_jax.train.config import Config, ConfigError
from palm_jax.train.files import metrics, records, tables
from palm_jax.train.reporting import runs

# -- checkpoints -----------------------------------------------------------------------------------

TREE = {"w": np.arange(3000, dtype=np.float32).reshape(60, 50), "step": np.int32(0)}


@functools.cache
def _saved() -> Path:
    folder = Path(tempfile.mkdtemp()) / "checkpoints"
    for step in (100, 200):
        meta = {checkpoint.FINGERPRINT: "mine", "score": step / 1000}
        checkpoint.save(folder, step, {**TREE, "step": np.int32(step)}, meta)
    return folder


def _manifest(path: Path) -> Path:
    return path / "manifest.json"


def _largest(path: Path) -> Path:
    files = (p for p in (path / "arrays").rglob("*") if p.is_file())
    return max(files, key=lambda p: p.stat().st_size)


def _smallest(path: Path) -> Path:
    files = (p for p in (path / "arrays").rglob("*") if p.is_file() and p.stat().st_size)
    return min(files, key=lambda p: p.stat().st_size)


def _empty_folder(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


def _a_file(path: Path) -> None:
    shutil.rmtree(path)
    path.write_text("?")


def _another_step(path: Path) -> None:
    shutil.rmtree(path)
    shutil.copytree(path.with_name("100"), path)


def _foreign(path: Path) -> None:
    shutil.rmtree(path)
    checkpoint.save(path.parent, 200, TREE, {checkpoint.FINGERPRINT: "theirs"})


def _half_written(path: Path) -> None:
    _manifest(path).unlink()  # it comes last
    path.rename(path.with_name(f"{checkpoint.SAVING}200-{2**22 + 1}"))


def _half_removed(path: Path) -> None:
    path.rename(path.with_name(f"{checkpoint.REMOVING}200-{2**22 + 1}"))


def _changed_score(path: Path) -> None:
    file = _manifest(path)
    file.write_text(file.read_text().replace('"score": 0.2', '"score": 0.9'))


def _other_version(path: Path) -> None:
    _manifest(path).write_text(json.dumps({"format": checkpoint.FORMAT, "version": 99}))


def _forged(path: Path) -> None:
    content = json.loads(_manifest(path).read_text())
    del content["files"], content["checksum"]
    checksum = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    _manifest(path).write_text(json.dumps({**content, "checksum": checksum}))


_HARMS: tuple[tuple[str, Callable[[Path], Any], str | None], ...] = (
    ("a bit of the largest file is flipped", lambda p: flip(_largest(p)), "wrong-hash"),
    ("its first bit is flipped", lambda p: flip(_largest(p), 0), "wrong-hash"),
    ("its last bit is flipped", lambda p: flip(_largest(p), -1, bit=7), "wrong-hash"),
    ("a bit of the smallest file is flipped", lambda p: flip(_smallest(p)), "wrong-hash"),
    ("the largest file is cut in half", lambda p: cut(_largest(p)), "wrong-size"),
    ("the largest file lacks one byte", lambda p: cut(_largest(p), 0.9999), "wrong-size"),
    ("the largest file is empty", lambda p: cut(_largest(p), 0), "wrong-size"),
    ("a file is deleted", lambda p: _largest(p).unlink(), "missing-file"),
    ("all arrays are deleted", lambda p: shutil.rmtree(p / "arrays"), "missing-file"),
    ("the folder is empty", _empty_folder, "empty"),
    ("a file has the folder's name", _a_file, "not-a-folder"),
    ("another step's checkpoint lies there", _another_step, "wrong-step"),
    ("another run's checkpoint lies there", _foreign, "foreign"),
    ("the manifest is deleted", lambda p: _manifest(p).unlink(), "no-manifest"),
    ("the manifest is empty", lambda p: cut(_manifest(p), 0), "bad-manifest"),
    ("the manifest is cut in half", lambda p: cut(_manifest(p)), "bad-manifest"),
    ("a bit of the manifest is flipped", lambda p: flip(_manifest(p)), "bad-manifest"),
    ("the manifest is no text", lambda p: _manifest(p).write_bytes(b"\xff\x00"), "bad-manifest"),
    ("the score in the manifest is changed", _changed_score, "bad-manifest"),
    ("the manifest is of a later version", _other_version, "unknown-format"),
    ("the manifest has a right checksum, but no files", _forged, "bad-manifest"),
    ("its writer was killed before the end", _half_written, "unfinished"),
    ("its remover was killed before the end", _half_removed, None),
)


def _damaged_checkpoint(folder: Path, harm: Callable[[Path], Any], reason: str | None) -> Outcome:
    store = shutil.copytree(_saved(), folder / "checkpoints")
    harm(store / "200")
    older, told = snapshot(store / "100"), _Told()
    with told:
        found = checkpoint.latest_valid(store, fingerprints=["mine"])
    assert found == (100, store / "100") and snapshot(store / "100") == older
    loaded = checkpoint.load(found[1], TREE)
    assert loaded["w"].tobytes() == TREE["w"].tobytes() and int(loaded["step"]) == 100
    if reason is None:
        return Outcome("was being deleted: deleted to the end")
    assert (store / "damaged" / f"200-{reason}").exists() and f"({reason})" in told.text
    return Outcome(f"set aside as 200-{reason}, step 100 is used", "one interval")


class _Told(logging.Handler):
    """The warnings of the checkpoints' module, while they are caught."""

    def __init__(self) -> None:
        super().__init__()
        self.text = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.text += record.getMessage()

    def __enter__(self) -> "_Told":
        logging.getLogger(checkpoint.__name__).addHandler(self)
        return self

    def __exit__(self, *error: object) -> None:
        logging.getLogger(checkpoint.__name__).removeHandler(self)


for _name, _harm, _reason in _HARMS:
    case("checkpoint", _name, harm=_harm, reason=_reason)(_damaged_checkpoint)


@case("checkpoint", "its writer was killed before it gave it its name")
def _nameless(folder: Path) -> Outcome:
    store = shutil.copytree(_saved(), folder / "checkpoints")
    whole = snapshot(store)
    (store / "200").rename(store / f"{checkpoint.SAVING}200-{2**22 + 1}")
    assert checkpoint.latest_valid(store, fingerprints=["mine"]) == (200, store / "200")
    assert snapshot(store) == whole
    return Outcome("whole: it is given its name, and used")


@case("checkpoint", "every one is damaged")
def _all_damaged(folder: Path) -> Outcome:
    store = shutil.copytree(_saved(), folder / "checkpoints")
    for step in ("100", "200"):
        cut(_largest(store / step))
    assert checkpoint.latest_valid(store) is None and not checkpoint.steps(store)
    assert len(list((store / "damaged").iterdir())) == 2
    return Outcome("both are set aside, training begins anew", "the training, said")


@case("checkpoint", "the best one is damaged")
def _best_damaged(folder: Path) -> Outcome:
    store = shutil.copytree(_saved(), folder / "checkpoints")
    flip(_largest(store / "200"))
    with _Told() as told:
        assert checkpoint.best(store) == [(100, store / "100")]
    assert "wrong-hash" in told.text
    return Outcome("passed over with a warning, the next best acts", "one interval")


@case("checkpoint", "a network of another size is asked for")
def _other_network(folder: Path) -> Outcome:
    other = {**TREE, "w": np.zeros((60, 51), np.float32)}
    before = snapshot(_saved())
    with refused(checkpoint.CheckpointMismatch, "leaf 'w'", "[60, 51]", "[60, 50]"):
        checkpoint.load(_saved() / "200", other)
    assert snapshot(_saved()) == before
    return Outcome("refused: the leaf is named, nothing is cast")


# -- results ---------------------------------------------------------------------------------------


def _results(folder: Path) -> dict[str, records.DomainRecord]:
    rng = np.random.default_rng(0)
    found = {
        domain: records.domain_record(
            {
                "success": rng.random(24) < 0.5,
                "nan": np.zeros(24, bool),
                "object_xy": rng.normal(size=(24, 2)),
                "camera_angle": rng.normal(size=24),
                "length": np.arange(24),
            }
        )
        for domain in ("in_domain", "workspace")
    }
    records.save_eval(folder / "eval.npz", found)
    metrics.write_json(folder / "eval.json", records.counts(found))
    return found


def _repeated(folder: Path, words: str) -> Outcome:
    """A method with damaged results is evaluated again, and what was there is kept."""
    out = io.StringIO()
    before = snapshot(folder)
    assert not run._finished(folder, Console(file=out, width=1000))
    assert words in out.getvalue(), out.getvalue()
    after = snapshot(folder)
    assert {name.removesuffix(".damaged"): content for name, content in after.items()} == before
    return Outcome("named and set aside, the evaluation is repeated", "one evaluation")


_EVAL_HARMS: tuple[tuple[str, str, Callable[[Path], Any], str], ...] = (
    ("eval.json", "is cut in half", cut, "not readable as JSON"),
    ("eval.json", "is empty", lambda p: cut(p, 0), "not readable as JSON"),
    ("eval.json", "is a list", lambda p: p.write_text("[1]"), "expected a JSON object"),
    (
        "eval.json",
        "counts more successes than episodes",
        lambda p: p.write_text('{"in_domain": {"successes": 9, "episodes": 4, "nan": 0}}'),
        "impossible counts",
    ),
    (
        "eval.json",
        "has another digit",
        lambda p: p.write_text(p.read_text().replace('"nan": 0', '"nan": 1', 1)),
        "but the episodes in the .npz file beside it count",
    ),
    ("eval.npz", "is cut in half", cut, "not a readable .npz file"),
    ("eval.npz", "is empty", lambda p: cut(p, 0), "not a readable .npz file"),
    ("eval.npz", "has a flipped bit", flip_inside, "eval.npz"),
    ("eval.npz", "is missing", lambda p: p.unlink(), "not a readable .npz file"),
    (
        "eval.npz",
        "holds a pickle",
        lambda p: np.savez(p, **{"a/b": np.array([{}], object)}),
        "not a readable .npz file",
    ),
    (
        "eval.npz",
        "has episodes of different numbers",
        lambda p: np.savez(p, **{f"a/{n}": np.zeros(2 + (n == "nan")) for n in records._DTYPES}),
        "expected shape",
    ),
)


def _damaged_eval(folder: Path, file: str, harm: Callable[[Path], Any], words: str) -> Outcome:
    _results(folder)
    harm(folder / file)
    return _repeated(folder, words)


for _file, _what, _harm, _words in _EVAL_HARMS:
    case("results", f"{_file} {_what}", file=_file, harm=_harm, words=_words)(_damaged_eval)


def _damaged_sweep(folder: Path, shift: str, harm: Callable[[Path], Any]) -> Outcome:
    cells = np.zeros((2, 1, 1, 3), bool)
    path = records.sweep_path(folder, shift=shift)
    if shift:
        curve = records.StrengthSweep(shift, np.arange(2.0), cells[:, 0, 0], cells[:, 0, 0])
        records.save_sweep(path, curve)
    else:
        records.save_sweep(
            path, records.Sweep(np.arange(2.0), np.ones(1), np.ones(1), cells, cells)
        )
    _results(folder)
    harm(path)
    found = runs.load_run(folder)
    assert any(path.name in problem for problem in found.problems), found.problems
    assert found.counts
    return Outcome("named in the report, which shows the rest", "the sweep, said")


for _shift in ("", "lighting"):
    for _what, _harm in (("is cut in half", cut), ("has a flipped bit", flip_inside)):
        _file = records.sweep_path(Path(), shift=_shift).name
        case("results", f"{_file} {_what}", shift=_shift, harm=_harm)(_damaged_sweep)


@case("results", "metrics.jsonl ends in half a line")
def _half_a_line(folder: Path) -> Outcome:
    path = folder / "metrics.jsonl"
    with metrics.MetricsLog(path) as log:
        for step in range(1, 5):
            log.write(step, {"loss": 1.0})
    whole = path.read_bytes()
    os.truncate(path, len(whole) - 5)
    with metrics.MetricsLog(path, resume_step=3) as log:
        log.write(4, {"loss": 1.0})
    assert path.read_bytes() == whole
    return Outcome("dropped and written again")


@case("results", "metrics.jsonl has a damaged line")
def _damaged_line(folder: Path) -> Outcome:
    path = folder / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"st\x00p": 2\n{"step": 3}\n')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert [row["step"] for row in metrics.read_metrics(path)] == [1, 3]
    assert "1 unreadable lines left out" in str(caught[0].message)
    return Outcome("left out with a warning", "a point of a curve, said")


@case("results", "times.json and env.json are damaged")
def _damaged_notes(folder: Path) -> Outcome:
    for left in ("{", '{"evaluation_s": null}', '{"evaluation_s": [1]}'):
        (folder / "times.json").write_text(left)
        with training.timed(folder, "evaluation_s"):
            pass
        (found,) = records.load_json(folder / "times.json").items()
        assert found[0] == "evaluation_s" and 0 <= found[1] < 60
    return Outcome("begun anew: no result rests on them", "timings")


# -- configuration and tables ----------------------------------------------------------------------


def _config(folder: Path) -> Config:
    return dataclasses.replace(Config(), method=("palm",), out=folder)


@case("configuration", "config.json is cut in half")
def _half_a_config(folder: Path) -> Outcome:
    workspace.begin(_config(folder), folder, "palm")
    cut(folder / "config.json")
    with refused(ConfigError, "config.json", "not readable as JSON", "move it away"):
        workspace.begin(dataclasses.replace(_config(folder), resume=True), folder, "palm")
    (folder / "config.json").rename(folder / "away")
    workspace.begin(dataclasses.replace(_config(folder), resume=True), folder, "palm")
    return Outcome("named, with what to do; checkpoints of other options are not used")


@case("configuration", "config.json is of a run with other options")
def _other_options(folder: Path) -> Outcome:
    workspace.begin(_config(folder), folder, "palm")
    before = snapshot(folder)
    other = dataclasses.replace(_config(folder), resume=True, seed=3)
    with refused(ConfigError, "begun with seed = 0, but now seed = 3"):
        workspace.begin(other, folder, "palm")
    assert snapshot(folder) == before
    return Outcome("refused: the option is named")


@case("configuration", "a second run wants the same folder")
def _second_run(folder: Path) -> Outcome:
    workspace.begin(_config(folder), folder, "palm")
    with refused(ConfigError, "holds a run already", "--resume"):
        workspace.begin(_config(folder), folder, "palm")
    return Outcome("refused, with both ways out")


def _enter(content: dict[str, Any], config: table.TableConfig, cell: tables.Cell) -> None:
    made = table._made(config.folder / cell.name, content["header"])
    table._enter(content, config.file, cell, made)


def _a_table(folder: Path) -> tuple[table.TableConfig, dict[str, Any]]:
    config = table.TableConfig(
        preset="quick", out=folder, tasks=("lift_lid",), methods=("palm", "bc")
    )
    fresh = table.header(config)
    content = table.read(config.file, fresh)
    cell = tables.Cell("lift_lid", "palm", 0)
    found = folder / cell.name
    found.mkdir(parents=True)
    _results(found)
    metrics.write_json(found / "env.json", {"sessions": []})
    _enter(content, config, cell)
    tables.store(config.file, content)
    return config, fresh


_TABLE_HARMS: tuple[tuple[str, Callable[[Path], Any], str], ...] = (
    ("table.json is cut in half", cut, "not readable as JSON"),
    ("table.json is empty", lambda p: cut(p, 0), "not readable as JSON"),
    (
        "a digit of table.json is changed",
        lambda p: p.write_text(p.read_text().replace('"nan": 0', '"nan": 7', 1)),
        "the content is not what was written",
    ),
    ("table.npz is cut in half", lambda p: cut(p.with_suffix(".npz")), "not a readable .npz"),
    ("table.npz has a flipped bit", lambda p: flip_inside(p.with_suffix(".npz")), "table.npz"),
)


def _damaged_table(folder: Path, harm: Callable[[Path], Any], words: str) -> Outcome:
    """Refused by name; and once the files are away, cells come back from their folders."""
    config, fresh = _a_table(folder)
    whole = snapshot(folder)
    harm(config.file)
    cell = tables.Cell("lift_lid", "palm", 0)
    with refused(records.RecordError, words, "move it and the .npz or .json file beside it away"):
        _enter(table.read(config.file, fresh), config, cell)
    for path in (config.file, config.file.with_suffix(".npz")):
        path.unlink(missing_ok=True)
    content = table.read(config.file, fresh)
    _enter(content, config, cell)
    tables.store(config.file, content)
    assert snapshot(folder) == whole
    return Outcome("named, with what to do; cells come back from their folders")


for _name, _harm, _words in _TABLE_HARMS:
    case("table", _name, harm=_harm, words=_words)(_damaged_table)


@case("table", "table.json was begun under other conditions")
def _other_conditions(folder: Path) -> Outcome:
    config, fresh = _a_table(folder)
    before = snapshot(folder)
    recipe = {**fresh["recipe"], "steps": 7}
    with refused(ConfigError, "begun with recipe.steps = 2400, now it is 7"):
        table.read(config.file, {**fresh, "recipe": recipe})
    assert snapshot(folder) == before
    return Outcome("refused: the condition is named, nothing is mixed")


# -- demonstrations --------------------------------------------------------------------------------


@functools.cache
def _params() -> EnvParams:
    return jax.tree.map(np.asarray, make("lift_lid").default_params())


def demonstrations(path: Path) -> Path:
    """A file as `collect` writes it, of numbers that no expert made."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for index in range(2):
            demo = data.create_group(f"demo_{index}")
            shapes = {"qpos": (5, 9), "tcp": (5, 4, 4), "opening": (5,), "stage": (5,)}
            for name, shape in shapes.items():
                demo[f"obs/{name}"] = rng.normal(size=shape).astype(np.float32)
            demo["actions"] = rng.normal(size=(5, 10)).astype(np.float32)
            for field in dataclasses.fields(EnvParams):
                demo[f"env_params/{field.name}"] = getattr(_params(), field.name)
            for name, size in {"mocap_pos": (1, 3), "mocap_quat": (1, 4)}.items():
                demo.attrs[name] = np.zeros(size)
            demo.attrs["camera_to_world"] = np.eye(4)
        data.attrs.update(
            {
                "format": demos.FORMAT,
                "version": demos.VERSION,
                "task": "lift_lid",
                "robot": "panda",
                "attempts": 2,
            }
        )
        data.attrs[demos._DIGEST] = demos._digest(data)
    return path


def read_demonstrations(path: Path) -> demos.Demos:
    return demos.load(path, task="lift_lid", robot="panda", count=2)


def _edit(change: Callable[[h5py.Group], Any]) -> Callable[[Path], None]:
    def harm(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            change(file["data"])

    return harm


def _nan(data: h5py.Group) -> None:
    data["demo_1/actions"][2, 3] = np.nan
    data.attrs[demos._DIGEST] = demos._digest(data)


def _changed(data: h5py.Group) -> None:
    data["demo_1/actions"][2, 3] += 1e-3


_DEMO_HARMS: tuple[tuple[str, Callable[[Path], Any], str], ...] = (
    ("is cut in half", cut, "not a whole demonstration file"),
    ("is empty", lambda p: cut(p, 0), "not a whole demonstration file"),
    ("is no HDF5", lambda p: p.write_bytes(b"text" * 500), "not a whole demonstration file"),
    ("has another superblock", lambda p: flip(p, 8, bit=6), "not a whole demonstration file"),
    ("has another number", _edit(_changed), "the content differs from what was written"),
    ("lacks a demonstration", _edit(lambda d: d.pop("demo_0")), "differs from what was written"),
    ("has a NaN", _edit(_nan), "actions is incomplete or not finite"),
    ("is of another task", _edit(lambda d: d.attrs.update(task="x")), "expected task 'lift_lid'"),
    ("is of another version", _edit(lambda d: d.attrs.update(version=1)), "expected version 2"),
)


def _damaged_demos(folder: Path, harm: Callable[[Path], Any], words: str) -> Outcome:
    path = demonstrations(folder / "demos.hdf5")
    assert read_demonstrations(path).episodes == 2
    harm(path)
    before = path.read_bytes()
    with refused(demos.DemoFileError, "demos.hdf5", words):
        read_demonstrations(path)
    assert path.read_bytes() == before
    return Outcome("refused by name, and left as it is", "the collection, said")


for _name, _harm, _words in _DEMO_HARMS:
    case("demonstrations", f"the file {_name}", harm=_harm, words=_words)(_damaged_demos)
