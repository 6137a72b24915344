"""Readers of files and messages that somebody else has written: whatever is in them, a reader gives
what it promises, or an error of its own kind that names the file."""

import copy
import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import h5py
import msgpack
import numpy as np
import pytest
import tiny
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from palm_jax import wire
from palm_jax.train import workspace
from palm_jax.train.config import ConfigError
from palm_jax.train.data import calibration
from palm_jax.train.data.errors import CalibrationError, DataError
from palm_jax.train.data.source import Source, open_source
from palm_jax.train.files import pictures, records, shards
from palm_jax.train.files import torch as torch_files

bounded = settings(
    max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

DEEP = "[" * 100_000 + "]" * 100_000
ODD = st.sampled_from(
    [None, True, False, 0, -1, 1, 3, 2**70, 10**400, 0.5, -0.0, math.inf, math.nan, "", "x",
     "../../x", "/etc/hostname", "64", "\0", "\ud800", [], {}, [[]], [1, "a"], {"a": {}}, "DEEP"]
)  # fmt: skip


def places(value: Any, at: tuple = ()) -> list[tuple]:
    """The paths of all nodes of a JSON value."""
    inner = value.items() if isinstance(value, dict) else ()
    inner = enumerate(value) if isinstance(value, list) else inner
    return [at, *(place for key, child in inner for place in places(child, (*at, key)))]


@st.composite
def changed(draw: Callable[..., Any], good: Any) -> str:
    """The text of a JSON value in which some nodes are missing, or something else."""
    value = {"": copy.deepcopy(good)}
    for _ in range(draw(st.integers(1, 3))):
        found = [place for place in places(value) if place]
        *way, last = draw(st.sampled_from(found))
        parent = value
        for key in way:
            parent = parent[key]
        if way and draw(st.booleans()):
            del parent[last]
        else:
            parent[last] = copy.deepcopy(draw(ODD))
    text = json.dumps(value.get("", {})).replace('"DEEP"', DEEP)
    return text.replace("Infinity", draw(st.sampled_from(["Infinity", "1e999"])))


def named(error: Exception, path: Path) -> None:
    assert path.name in str(error) or path.parent.name in str(error), error


# ------------------------------------------------------------------------------------------- JSON


@bounded
@given(data=st.data())
def test_a_calibration_is_one_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    good = datasets.robosuite().to_json()
    path = tmp_path / "calibration.json"
    path.write_text(data.draw(changed(good)))
    try:
        found = calibration.load(path)
    except CalibrationError as error:
        named(error, path)
    else:
        calibration.from_json(json.loads(json.dumps(found.to_json())))
        for camera in found.cameras.values():
            assert np.isfinite(np.asarray(camera.camera("demo_0").cam_to_world)).all()


@bounded
@given(data=st.data())
def test_a_runs_configuration_is_one_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    good = json.loads((tiny.run() / "config.json").read_text())
    (tmp_path / "config.json").write_text(data.draw(changed(good)))
    try:
        found = workspace.stored_config(tmp_path)
    except (ConfigError, records.RecordError) as error:
        named(error, tmp_path / "config.json")
    else:
        dataclasses.replace(found, backgrounds=None).check()
        assert isinstance(found.out, Path | None) and isinstance(found.backgrounds, Path | None)


@bounded
@given(data=st.data())
def test_counts_are_counts_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "eval.json"
    count = {"successes": 3, "episodes": 8, "nan": 1}
    path.write_text(data.draw(changed({"in_domain": count, "viewpoint": count})))
    try:
        found = records.load_counts(path)
    except records.RecordError as error:
        named(error, path)
    else:
        for entry in found.values():
            assert 0 <= entry["successes"] <= entry["episodes"] and type(entry["nan"]) is int


@bounded
@given(data=st.data())
def test_lines_of_a_log_are_records_or_left_out(data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    text = data.draw(changed({"step": 3, "loss": 0.5}))
    path.write_text('{"step": 1}\n' + text + '\n{"step": 9}\n')
    found, _ = records.load_metrics(path)
    assert found[0] == {"step": 1} and found[-1] == {"step": 9}
    assert json.loads(json.dumps(found, allow_nan=False)) == found  # and can be written again


# ----------------------------------------------------------------------------------------- arrays

ARRAYS = st.sampled_from(
    [np.array("text"), np.array(["a", "b"]), np.array([1j, 2]), np.zeros(0), np.array(3),
     np.array([b"x"]), np.array(["2026-01-01"], "M8[D]"), np.full(8, np.nan), np.full(8, np.inf),
     np.full(8, 2**60), np.zeros((8, 2)), np.zeros((8, 3), np.float16), np.zeros((2, 2, 2, 2)),
     np.arange(8) % 2 == 0, np.zeros((4, 4, 3), np.uint8), np.zeros(8, [("a", "f4")])]
)  # fmt: skip


def arrays_of(data: st.DataObject, good: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Some arrays are missing, others of another kind."""
    found = dict(good)
    for _ in range(data.draw(st.integers(1, 3))):
        name = data.draw(st.sampled_from(sorted(good)))
        if data.draw(st.integers(0, 3)) == 0:
            found.pop(name, None)
        else:
            found[name] = data.draw(ARRAYS)
    return found


def written(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    np.savez(path, allow_pickle=False, **arrays)
    return path


@bounded
@given(data=st.data())
def test_episodes_are_whole_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    good = {
        f"{domain}/{name}": np.zeros((8, 2) if name == "object_xy" else 8, kind)
        for domain in ("in_domain", "viewpoint")
        for name, kind in records._DTYPES.items()
    }
    path = written(tmp_path / "eval.npz", arrays_of(data, good))
    try:
        found = records.load_eval(path)
    except records.RecordError as error:
        named(error, path)
    else:
        for record in found.values():
            for name, kind in records._DTYPES.items():
                assert getattr(record, name).dtype == kind
            assert records.counts(found)


@bounded
@given(data=st.data())
def test_sweeps_are_whole_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    grid = {"angles": np.zeros(2), "xs": np.zeros(2), "ys": np.zeros(2), "worlds": np.array(4)}
    outcomes = {name: np.zeros((2, 2, 2, 2), bool) for name in ("success", "nan")}
    path = written(tmp_path / "sweep.npz", arrays_of(data, {**grid, **outcomes}))
    try:
        sweep = records.load_sweep(path)
    except records.RecordError as error:
        named(error, path)
    else:
        assert sweep.solved.shape == (len(sweep.angles), len(sweep.xs), len(sweep.ys)) + (2,)
        assert all(np.isfinite(axis).all() for axis in (sweep.angles, sweep.xs, sweep.ys))
    strengths = {"shift": np.array("light"), "strengths": np.zeros(8), "worlds": np.array(4)}
    outcomes = {name: np.zeros((8, 2), bool) for name in ("success", "nan")}
    path = written(tmp_path / "strength-light.npz", arrays_of(data, {**strengths, **outcomes}))
    try:
        curve = records.load_strengths(path)
    except records.RecordError as error:
        named(error, path)
    else:
        assert len(curve.solved) == len(curve.strengths) and np.isfinite(curve.strengths).all()


@bounded
@given(data=st.data())
def test_shards_are_whole_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    grid = {"angles": np.zeros(2), "xs": np.zeros(2), "ys": np.zeros(2)}
    good = {name: np.zeros((2, 2, 2, 2), bool) for name in ("success", "nan")}
    good |= {**grid, "worlds": np.array(4), records.HEADER: np.array('{"seed": 0}')}
    path = shards.path_of(tmp_path / "sweep.npz", 1, 1)
    path.parent.mkdir(exist_ok=True)
    found = arrays_of(data, good)
    if data.draw(st.booleans()):
        found[records.HEADER] = np.array(data.draw(changed({"seed": 0})).replace("\0", ""))
    written(path, found)
    try:
        joined = shards.merge(
            tmp_path / "sweep.npz", (2, 2, 2, 2), lambda part: range(16), grid, {"seed": 0}
        )
    except (records.RecordError, shards.ShardError) as error:
        named(error, path)
    else:
        assert joined["success"].shape == (2, 2, 2, 2) and joined["success"].dtype == bool


@bounded
@given(data=st.data())
def test_views_are_images_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    good = {f"{kind}/in_domain": np.zeros((4, 4, 3), np.uint8) for kind in ("input", "frame")}
    path = written(tmp_path / "views.npz", arrays_of(data, good))
    try:
        found = records.load_views(path)
    except records.RecordError as error:
        named(error, path)
    else:
        assert all(view.dtype == np.uint8 and view.shape[2:] == (3,) for view in found.values())


# ------------------------------------------------------------------------------------- recordings


def reads(source: Source) -> None:
    """All that a recording's first episode has."""
    name = source.episodes[0]
    assert source.length(name) >= 0 and np.isfinite(source.fps) and source.fps > 0
    for key, feature in source.features().items():
        if feature.images:
            source.image(name, key, 0)
        else:
            source.numbers(name, key)
    source.task(name), source.split(), source.camera_info(name), source.model_file(name)


@settings(bounded, max_examples=60)
@given(data=st.data())
def test_a_lerobot_folder_is_one_or_refused(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    root = lerobot_folder(tmp_path_factory)
    good = json.loads((root.parent / "info.json").read_text())
    text = data.draw(changed(good)).replace("/etc/hostname", "elsewhere").replace("../../x", "up")
    (root / "meta" / "info.json").write_text(text)
    try:
        with open_source(root) as source:
            reads(source)
    except DataError as error:
        assert root.name in str(error), error


def test_a_type_that_nobody_knows_is_no_number(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    root = datasets.lerobot(tmp_path)
    info = json.loads((root / "meta" / "info.json").read_text())
    for dtype in ("\ud800", "(3,", "a"):  # NumPy would read the last two as a language of its own
        info["features"]["frame_index"]["dtype"] = dtype
        (root / "meta" / "info.json").write_text(json.dumps(info))
        with open_source(root) as source:
            assert source.in_all(source.episodes)[1] == {"frame_index": f"{dtype}, not numbers"}
    assert not recwarn.list


_LEROBOT: list[Path] = []


def lerobot_folder(factory: pytest.TempPathFactory) -> Path:
    """One for all examples, its right info.json beside it."""
    if not _LEROBOT:
        root = datasets.lerobot(factory.mktemp("lerobot"))
        (root.parent / "info.json").write_text((root / "meta" / "info.json").read_text())
        _LEROBOT.append(root)
    return _LEROBOT[0]


@settings(bounded, max_examples=60)
@given(data=st.data())
def test_a_robomimic_file_is_one_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    def change(file: h5py.File) -> None:
        names: list[str] = []
        file.visit(names.append)
        for _ in range(data.draw(st.integers(1, 3))):
            at = data.draw(st.sampled_from(["data", "data/demo_0", *names]))
            kind = data.draw(st.sampled_from(["delete", "array", "group", "attribute", "text"]))
            item = file.get(at)
            if item is None or (kind == "attribute" and not item.attrs):
                continue
            if kind == "attribute":
                name = data.draw(st.sampled_from(sorted(item.attrs)))
                item.attrs[name] = data.draw(st.sampled_from(["{", "[]", 3.5, -1, b"\xff", [1, 2]]))
                continue
            del file[at]
            if kind == "array":
                value = data.draw(ARRAYS)
                if value.dtype.kind not in "UM":
                    file[at] = value
            elif kind == "group":
                file.create_group(at)
            elif kind == "text":
                file[at] = "text"

    path = datasets.changed(datasets.LIFT, tmp_path, change)
    try:
        with open_source(path) as source:
            reads(source)
    except DataError as error:
        named(error, path)


# ------------------------------------------------------------------------- pictures, weights, wire


@st.composite
def damaged(draw: Callable[..., Any], good: bytes) -> bytes:
    content = bytearray(good)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(content) - 1)))
        kind = draw(st.integers(0, 3))
        if kind == 0 and content:
            content[at] = draw(st.integers(0, 255))
        elif kind == 1:
            del content[at : at + draw(st.integers(1, 64))]
        elif kind == 2:
            content[at:at] = draw(st.binary(max_size=16))
        else:
            del content[at:]
    return bytes(content)


@pytest.mark.parametrize("kind", pictures.FORMATS)
@settings(bounded, max_examples=60)
@given(data=st.data())
def test_a_picture_is_one_or_refused(kind: str, data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    colours = np.random.default_rng(0).integers(0, 255, (12, 12, 3), np.uint8)
    Image.fromarray(colours).save(path, format=kind)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        found = pictures.read_folder(tmp_path, 8)
    except ValueError as error:
        named(error, path)
    else:
        assert found.shape == (1, 8, 8, 3) and found.dtype == np.uint8


@bounded
@given(data=st.data())
def test_weights_are_tensors_or_refused(data: st.DataObject, tmp_path: Path) -> None:
    entry = {"dtype": "F32", "shape": [2, 3], "data_offsets": [0, 24]}
    text = data.draw(changed({"a": entry, "b": {**entry, "data_offsets": [24, 48]}})).encode()
    size = data.draw(st.sampled_from([len(text), len(text), len(text) - 1, 2**62]))
    path = tmp_path / "w.safetensors"
    path.write_bytes(size.to_bytes(8, "little") + text + bytes(48))
    try:
        found, _ = torch_files.read_tensors(path)
    except ValueError as error:
        named(error, path)
    else:
        assert all(isinstance(tensor, np.ndarray) for tensor in found.values())


def tree(leaves: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    keys = st.text(max_size=3) | st.sampled_from([b"__ndarray__", b"data", b"dtype", b"shape",
                                                  b"__npgeneric__", 3, None])  # fmt: skip
    return st.recursive(
        leaves, lambda x: st.lists(x, max_size=4) | st.dictionaries(keys, x, max_size=5)
    )


MESSAGES = tree(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=4)
    | st.binary(max_size=9) | st.sampled_from(["<f4", "|O", "<f16", "V8", "<U1", ">i8", "f4,f4"])
)  # fmt: skip


@bounded
@given(MESSAGES | st.binary(max_size=40))
def test_a_message_is_one_or_refused(message: Any) -> None:
    content = message if isinstance(message, bytes) else msgpack.packb(message)
    try:
        read = wire.unpack(content)
    except wire.WireError as error:
        assert str(error)
    else:
        assert not isinstance(read, (bytearray, memoryview, msgpack.ExtType))


@bounded
@given(data=st.data())
def test_a_damaged_message_is_one_or_refused(data: st.DataObject) -> None:
    good = wire.pack({"image": np.zeros((2, 2, 3), np.uint8), "opening": np.float32(0.5), "a": [1]})
    try:
        read = wire.unpack(data.draw(damaged(good)))
    except wire.WireError as error:
        assert str(error)
    else:
        assert not isinstance(read, (bytearray, memoryview, msgpack.ExtType))
