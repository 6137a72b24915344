"""`data align`: what it writes is what slow references compute, is resumable, and is verified."""

import dataclasses
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import datasets
import h5py
import numpy as np
import oracles
import pytest
from scipy.spatial.transform import Rotation

from palm_jax.__main__ import main
from palm_jax.align import AlignSpec
from palm_jax.train import data
from palm_jax.train.data import (
    aligning,
    commands,
    job,
    lerobot_writer,
    output,
    robomimic_writer,
    soundness,
)
from palm_jax.train.data.errors import (
    CalibrationError,
    DataError,
    EpisodeLengthError,
    OutputError,
    TruncatedError,
)
from palm_jax.train.data.job import Options
from palm_jax.train.data.recording import Recording, open_recording

SPEC = aligning.paper_spec(128)
"""The same for most tests: it is compiled once."""

OURS = {
    "obs/palm_image": ((84, 84, 3), np.uint8),
    "obs/palm_proprio": ((8,), np.float32),
    "obs/palm_valid": ((), np.bool_),
    "obs/palm_tcp": ((4, 4), np.float32),
    "obs/palm_opening": ((), np.float32),
    "palm_actions": ((10,), np.float32),
}


@pytest.fixture
def lift() -> Iterator[Recording]:
    with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
        yield recording


@pytest.fixture(scope="module")
def aligned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("aligned") / "lift.hdf5"
    with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
        data.align_file(recording, SPEC, path)
    return path


def arrays(path: Path, episode: str = "demo_0") -> dict[str, np.ndarray]:
    found = {}
    with h5py.File(path) as file:

        def note(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                found[name] = item[()]

        file[f"data/{episode}"].visititems(note)
    return found


def poses(episode: str) -> np.ndarray:
    """Of the hand, by h5py and SciPy."""
    with h5py.File(datasets.LIFT) as file:
        demo = file[f"data/{episode}/obs"]
        turns = Rotation.from_quat(demo["robot0_eef_quat"][()]).as_matrix()
        return np.stack(
            [oracles.pose(r, p) for r, p in zip(turns, demo["robot0_eef_pos"][()], strict=True)]
        )


def camera(path: Path = datasets.LIFT, episode: str = "demo_0") -> tuple[np.ndarray, np.ndarray]:
    """K and pose that robosuite wrote."""
    with h5py.File(path) as file:
        info = json.loads(file[f"data/{episode}"].attrs["camera_info"])["agentview"]
    return np.array(info["intrinsics"]), np.array(info["extrinsics"])


def expected_image(
    image: np.ndarray, tcp: np.ndarray, seen_by: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Overlay, crop and resize one after the other, slowly."""
    K, pose = seen_by
    drawn = oracles.draw_overlay(
        image, K, pose, tcp, SPEC.axis_length, int(SPEC.thickness), SPEC.arrow_length,
        SPEC.arrow_width, int(SPEC.dot_radius),
    )  # fmt: skip
    uv = oracles.project(K, pose, tcp[:3, 3])[0]
    assert SPEC.crop is not None
    return oracles.resize(oracles.crop(drawn, uv, SPEC.crop, SPEC.offset), 84, 84)


# -- what is computed ------------------------------------------------------------------------------


@pytest.mark.parametrize("episode", ["demo_0", "demo_1"])
def test_against_slow_references(aligned: Path, episode: str) -> None:
    got, tcp = arrays(aligned, episode), poses(episode)
    images = datasets.frames(datasets.LIFT, episode)
    for name, (shape, dtype) in OURS.items():
        assert got[name].shape == (len(tcp), *shape) and got[name].dtype == dtype, name
    assert got["obs/palm_valid"].all()
    _, pose = camera()
    for frame in range(0, len(tcp), 5):
        image = expected_image(images[frame], tcp[frame], camera())
        # Truncated, and line rasterisers differ: see the tolerances of the overlay.
        assert np.abs(got["obs/palm_image"][frame] - image).mean() < 3
        sixd = oracles.rotation_6d(pose[:3, :3].T @ tcp[frame, :3, :3])
        opening = got["obs/palm_opening"][frame]
        expected = [*sixd, tcp[frame, 2, 3], float(opening > 0.95)]
        np.testing.assert_allclose(got["obs/palm_proprio"][frame], expected, atol=1e-5)
    ends = [*tcp[1:], tcp[-1]]
    deltas = [oracles.delta(now, then) for now, then in zip(tcp, ends, strict=True)]
    np.testing.assert_allclose(got["palm_actions"][:, :9], deltas, atol=2e-5)
    # At 20 / 3 frames a second the gripper moves three times as far in a frame.
    labels = oracles.gripper_labels(got["obs/palm_opening"], 0.06)
    np.testing.assert_array_equal(got["palm_actions"][:, 9], labels)


def test_the_stream_is_what_the_file_holds(aligned: Path, lift: Recording) -> None:
    for episode in data.aligned_episodes(lift, SPEC):
        got = arrays(aligned, episode.name)
        for name in ("image", "proprio", "valid", "tcp", "opening"):
            value = getattr(episode, {"image": "images"}.get(name, name))
            np.testing.assert_array_equal(got[f"obs/palm_{name}"], value)
        np.testing.assert_array_equal(got["palm_actions"], episode.actions)
        assert episode.camera.height == 128
    (only,) = data.aligned_episodes(lift, SPEC, episodes=["demo_1"])
    assert only.name == "demo_1"


def test_labels_do_not_depend_on_the_padding(lift: Recording) -> None:
    trajectory = lift.trajectory("demo_1")
    every = aligning.labels(trajectory)
    short = dataclasses.replace(trajectory, tcp=trajectory.tcp[:9], opening=trajectory.opening[:9])
    np.testing.assert_array_equal(aligning.labels(short)[:8], every[:8])
    np.testing.assert_allclose(
        aligning.labels(short)[8, :9], [1, 0, 0, 0, 1, 0, 0, 0, 0], atol=1e-6
    )
    longest = int(np.argmax(np.linalg.norm(every[:, 6:9], axis=1)))
    over = aligning.labels(trajectory, transitions=1)
    np.testing.assert_array_equal(over[longest, :9], [1, 0, 0, 0, 1, 0, 0, 0, 0])
    assert (over[np.arange(len(over)) != longest] == every[np.arange(len(over)) != longest]).all()


@pytest.mark.parametrize("rate", [10, 20, 60])
def test_a_gripper_closes_in_a_second_at_any_rate(rate: int, tmp_path: Path) -> None:
    """A file that says its rate, through `stream`: open, closing for a second, closed."""
    assert aligning.PAPER_STEP * aligning.PAPER_RATE == pytest.approx(0.4)  # a second's
    steps = np.clip(np.arange(3 * rate) - rate, 0, rate) / rate

    def write(file: h5py.File) -> None:
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": rate}})
        demo = file["data/demo_0"]
        rows = np.resize(np.arange(15), 3 * rate)
        for key in (datasets.IMAGES, "actions", "obs/robot0_eef_pos", "obs/robot0_eef_quat"):
            datasets.replace(demo, key, demo[key][()][rows])
        fingers = 0.04 * np.stack([1 - steps, steps - 1], 1)
        datasets.replace(demo, "obs/robot0_gripper_qpos", fingers)

    path = datasets.changed(datasets.LIFT, tmp_path, write)
    with open_recording(path, datasets.robosuite(path)) as recording:
        (found,) = aligning.stream(recording, SPEC, episodes=["demo_0"])
    np.testing.assert_array_equal(found.actions[:rate, 9], 1)
    np.testing.assert_array_equal(found.actions[rate:, 9], 0)


@pytest.mark.parametrize("flip", ["ud", "lr", "180", "cw", "ccw"])
def test_flipped_images_give_the_same(flip: str, lift: Recording) -> None:
    turn: Callable[[np.ndarray], np.ndarray] = {
        "ud": np.flipud, "lr": np.fliplr, "180": lambda i: np.rot90(i, 2),
        "cw": lambda i: np.rot90(i, 1), "ccw": lambda i: np.rot90(i, -1),
    }[flip]  # fmt: skip
    images = datasets.frames(datasets.LIFT)[:8]
    stored = np.stack([turn(image) for image in images])
    trajectory, calibrated = lift.trajectory("demo_0"), lift.camera
    turned = dataclasses.replace(calibrated, flip=flip)
    args = (turned.camera(), trajectory.tcp[:8], trajectory.opening[:8], SPEC)
    got = aligning.align_frames(turned.upright(stored), *args)
    np.testing.assert_array_equal(got.image, aligning.align_frames(images, *args).image)


def test_distorted_images_are_undistorted_first(lift: Recording) -> None:
    from palm_jax.align import align, undistort

    images, trajectory = datasets.frames(datasets.LIFT)[:3], lift.trajectory("demo_0")
    dist, view = (-0.2, 0.05, 0.0, 0.0), lift.camera.camera()
    got = aligning.align_frames(
        images, view, trajectory.tcp[:3], trajectory.opening[:3], SPEC, dist=dist
    )
    for frame, image in enumerate(images):
        clean = undistort(image, view.K, dist)
        expected = align(clean, view, trajectory.tcp[frame], trajectory.opening[frame], SPEC)
        difference = np.abs(np.asarray(expected.image, int) - got.image[frame])
        assert difference.max() <= 1  # fused, sums may round to the other side


def test_a_camera_that_moved_between_episodes(tmp_path: Path) -> None:
    """The file says where the camera stood in each episode; each is aligned with its own."""

    def move(file: h5py.File) -> None:
        attributes = file["data/demo_1"].attrs
        info = json.loads(attributes["camera_info"])
        turn = oracles.pose(Rotation.from_euler("y", 4, degrees=True).as_matrix(), [0, 0, 0.1])
        pose = np.array(info["agentview"]["extrinsics"]) @ turn
        info["agentview"]["extrinsics"] = pose.tolist()
        attributes["camera_info"] = json.dumps(info)

    path = datasets.changed(datasets.LIFT, tmp_path, move)
    with open_recording(path, datasets.robosuite(path)) as recording:
        found = list(data.aligned_episodes(recording, SPEC))
    for episode in found:
        own, tcp = camera(path, episode.name), poses(episode.name)
        images = datasets.frames(path, episode.name)
        np.testing.assert_allclose(episode.camera.cam_to_world, own[1], atol=1e-6)
        for frame in range(0, len(tcp), 5):
            sixd = oracles.rotation_6d(own[1][:3, :3].T @ tcp[frame, :3, :3])
            np.testing.assert_allclose(episode.proprio[frame, :6], sixd, atol=1e-5)
            image = expected_image(images[frame], tcp[frame], own)
            assert np.abs(episode.images[frame] - image).mean() < 3
    assert [episode.name for episode in found] == ["demo_0", "demo_1"]


def test_one_of_many_episodes_has_no_images(tmp_path: Path) -> None:
    """It is neither skipped nor are the others written without it."""

    def empty(file: h5py.File) -> None:
        for number in range(2, 12):
            file.copy(f"data/demo_{number % 2}", f"data/demo_{number}")
        demo = file["data/demo_2"]
        datasets.replace(demo, datasets.IMAGES, demo[datasets.IMAGES][:0])

    (tmp_path / "source").mkdir(), (tmp_path / "out").mkdir()
    path = datasets.changed(datasets.LIFT, tmp_path / "source", empty)
    for trust in (False, True):
        with open_recording(path, datasets.robosuite()) as recording:
            with pytest.raises(EpisodeLengthError, match="demo_2 has 15 poses and 0 images"):
                data.align_file(recording, SPEC, tmp_path / "out" / "new", trust=trust)
        assert list((tmp_path / "out").iterdir()) == []


def test_more_images_than_poses_where_a_block_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def add(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        images = np.repeat(demo[datasets.IMAGES], 2, 0)[:20]
        datasets.replace(demo, datasets.IMAGES, images)

    monkeypatch.setattr(aligning, "BLOCK", 5)
    path = datasets.changed(datasets.LIFT, tmp_path, add)
    with open_recording(path, datasets.robosuite()) as recording:
        with pytest.raises(EpisodeLengthError, match="15 poses and more images"):
            list(data.aligned_episodes(recording, SPEC))


def test_the_paper_scales_with_the_frame() -> None:
    assert aligning.paper_spec(512) == AlignSpec()
    half = aligning.paper_spec(256, size=64, layout="z")
    assert (half.crop, half.offset, half.dot_radius, half.size) == (100, (0, 20), 2, 64)


def test_reading_ahead_passes_everything_on() -> None:
    assert list(aligning.ahead(range(20))) == list(range(20))

    def broken() -> Iterator[int]:
        yield 1
        raise TruncatedError("here")

    items = aligning.ahead(broken())
    assert next(items) == 1
    with pytest.raises(TruncatedError, match="here"):
        next(items)
    endless = aligning.ahead(iter(int, 1))
    next(endless)
    endless.close()  # type: ignore[attr-defined]


# -- what is written -------------------------------------------------------------------------------


def test_the_rest_is_kept_as_it_was(aligned: Path) -> None:
    before, after = arrays(datasets.LIFT), arrays(aligned)
    assert set(after) - set(before) == set(OURS)
    assert set(before) - set(after) == {datasets.IMAGES}
    for key in set(before) & set(after):
        np.testing.assert_array_equal(before[key], after[key], err_msg=key)
    with h5py.File(datasets.LIFT) as old, h5py.File(aligned) as new:
        assert new["data"].attrs["total"] == 33
        for key, value in old["data/demo_0"].attrs.items():
            assert new["data/demo_0"].attrs[key] == value


def test_provenance(aligned: Path) -> None:
    with h5py.File(aligned) as file:
        made = json.loads(file["data"].attrs["palm"])
    assert made["source"]["sha256"] and made["source"]["name"] == datasets.LIFT.name
    assert made["calibration_sha256"] == datasets.robosuite().sha256
    assert made["spec"]["crop"] == 50 and made["options"]["keep"] == "numbers"
    assert set(made["versions"]) == {"palm_jax", "python", "jax", "numpy", "h5py"}
    assert made["robot"]["pose"] == "robot0_eef_pos+robot0_eef_quat"


def test_keeping_everything_under_the_usual_names(lift: Recording, tmp_path: Path) -> None:
    out = tmp_path / "all.hdf5"
    data.align_file(lift, SPEC, out, Options(keep="all", instead=True, compression="none"))
    before, after = arrays(datasets.LIFT), arrays(out)
    np.testing.assert_array_equal(after["source_actions"], before["actions"])
    np.testing.assert_array_equal(after[datasets.IMAGES], before[datasets.IMAGES])
    assert after["actions"].shape == (15, 10) and "palm_actions" not in after
    assert data.verify(out) == {}


def test_keeping_nothing_with_filter_keys(tmp_path: Path) -> None:
    def mask(file: h5py.File) -> None:
        file["mask/train"] = np.array([b"demo_1", b"demo_7"])

    path = datasets.changed(datasets.LIFT, tmp_path, mask)
    with open_recording(path, datasets.robosuite()) as recording:
        data.align_file(recording, SPEC, tmp_path / "none.hdf5", Options(keep="none", prefix="p"))
    found = arrays(tmp_path / "none.hdf5")
    assert set(found) == {name.replace("palm_", "p_") for name in OURS}
    with h5py.File(tmp_path / "none.hdf5") as file:
        assert list(file["mask/train"][()]) == [b"demo_1"]


AGAIN = dataclasses.replace(
    datasets.robosuite(), robot=data.RobotKeys(pose="palm_tcp", opening="palm_opening")
)
"""For what has been aligned: its own poses."""


@pytest.mark.parametrize(
    ("format", "keep"),
    [("robomimic", "numbers"), ("robomimic", "all"), ("robomimic", "none"),
     ("lerobot", "numbers"), ("lerobot", "none")],
)  # fmt: skip
def test_an_aligned_file_can_be_aligned_again(
    format: str, keep: str, aligned: Path, tmp_path: Path
) -> None:
    """From its own poses, with the same result beside the first one."""
    both, out = tmp_path / "both.hdf5", tmp_path / "out"
    with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
        data.align_file(recording, SPEC, both, Options(keep="all"))
    with open_recording(both, AGAIN, camera="agentview") as recording:
        options = Options(format=format, keep=keep, prefix="palm" if keep == "none" else "second")
        data.align_file(recording, SPEC, out, options)
    first = arrays(aligned, "demo_1")
    if format == "lerobot":
        columns = table_of(out, "data/chunk-000/file-000.parquet")
        for key in ["palm_actions"] * (keep != "none") + [f"action.{options.prefix}"]:
            np.testing.assert_allclose(columns[key][15:], first["palm_actions"], atol=2e-6)
        return
    second = arrays(out, "demo_1")
    assert len(second) == len(OURS) + {"none": 0, "numbers": 16, "all": 18}[keep]
    for key in OURS:
        kept = second[key.replace("palm", options.prefix)]
        np.testing.assert_allclose(kept, first[key], atol=2e-6 if kept.dtype.kind == "f" else 1)
        if keep == "all":
            np.testing.assert_array_equal(second[key], first[key])


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ({"keep": "all"}, {}, "obs/palm_proprio"),
        ({"keep": "all"}, {"keep": "all"}, "obs/palm_image"),
        ({"keep": "all", "instead": True}, {"prefix": "p", "instead": True}, "source_actions"),
        ({"keep": "all", "prefix": "p"}, {"prefix": "p"}, "obs/p_proprio"),
    ],
)
def test_names_that_would_be_there_twice(
    first: dict, second: dict, name: str, lift: Recording, tmp_path: Path
) -> None:
    data.align_file(lift, SPEC, tmp_path / "first", Options(**first))
    with open_recording(tmp_path / "first", datasets.robosuite(), camera="agentview") as recording:
        with pytest.raises(OutputError, match=f"{name}.* would be in the output twice.*--prefix"):
            data.align_file(recording, SPEC, tmp_path / "second", Options(**second))
    assert [path.name for path in tmp_path.iterdir()] == ["first"]


@pytest.mark.parametrize(
    ("first", "second", "name"),
    [
        ({}, {}, "observation.palm_proprio"),
        ({"encoding": "h264"}, {"keep": "all"}, "observation.images.palm"),
        ({"instead": True}, {"prefix": "p", "instead": True}, "source_state"),
    ],
)
def test_names_that_would_be_there_twice_in_a_set(
    first: dict, second: dict, name: str, front: Path, tmp_path: Path
) -> None:
    calibration = datasets.lerobot_calibration()
    with open_recording(front, calibration) as recording:
        data.align_file(recording, SPEC, tmp_path / "first", Options(keep="all", **first))
    if first.get("instead"):
        calibration = datasets.lerobot_calibration(
            pose="source_state[0:6]", opening="source_state[6]"
        )
    with open_recording(tmp_path / "first", calibration, camera="front") as recording:
        with pytest.raises(OutputError, match=f"{name}.* would be in the output twice.*--prefix"):
            data.align_file(recording, SPEC, tmp_path / "second", Options(**second))
        # Of a video and a column with the same last word neither is lost.
        made = Options(keep="all", prefix="second")
        data.align_file(recording, SPEC, tmp_path / "second", made)
    names = [
        set(json.loads((tmp_path / step / "meta/info.json").read_text())["features"])
        for step in ("first", "second")
    ]
    new = {f"observation.second_{key}" for key in ("proprio", "valid", "tcp", "opening")}
    assert names[1] - names[0] == {"observation.images.second", "action.second"} | new
    assert names[0] <= names[1]
    assert data.verify(tmp_path / "second", robot=calibration.robot) == {}


@pytest.mark.parametrize("prefix", ["../x", "a/b", "", "a.b"])
def test_prefixes_are_words(prefix: str) -> None:
    with pytest.raises(OutputError, match="prefix: expected letters"):
        Options(prefix=prefix)


# -- LeRobot ---------------------------------------------------------------------------------------


def table_of(root: Path, name: str) -> dict[str, Any]:
    import pyarrow.parquet as pq

    return pq.read_table(root / name).to_pydict()


@pytest.mark.parametrize("encoding", ["png", "h264"])
def test_lerobot_layout(encoding: str, aligned: Path, lift: Recording, tmp_path: Path) -> None:
    """Checked with pyarrow, PIL and PyAV alone."""
    import io

    import av
    import pyarrow.parquet as pq
    from PIL import Image

    root = tmp_path / "set"
    data.align_file(lift, SPEC, root, Options(format="lerobot", encoding=encoding))
    info = json.loads((root / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["total_frames"] == 33
    assert info["total_episodes"] == 2 and info["splits"] == {"train": "0:2"}
    assert all("/" not in name for name in info["features"])
    data_file = info["data_path"].format(chunk_index=0, file_index=0)
    columns = table_of(root, data_file)
    schema = pq.read_schema(root / data_file)
    wanted = {k for k, f in info["features"].items() if f["dtype"] != "video"}
    assert set(columns) == wanted
    assert columns["index"] == list(range(33))
    assert columns["episode_index"] == [0] * 15 + [1] * 18
    assert columns["frame_index"] == [*range(15), *range(18)]
    np.testing.assert_allclose(columns["timestamp"][:15], np.arange(15) * 0.15, atol=1e-6)
    assert schema.field("observation.palm_proprio").type.list_size == 8
    assert pq.ParquetFile(root / data_file).num_row_groups == 2
    first, second = arrays(aligned, "demo_0"), arrays(aligned, "demo_1")
    for ours, theirs in (
        ("obs/palm_proprio", "observation.palm_proprio"),
        ("palm_actions", "action.palm"),
        ("obs/palm_valid", "observation.palm_valid"),
        ("actions", "action"),
        ("obs/cube_pos", "observation.cube_pos"),
    ):
        both = np.concatenate([first[ours], second[ours]])
        np.testing.assert_array_equal(columns[theirs], both)
    images = np.concatenate([first["obs/palm_image"], second["obs/palm_image"]])
    key = "observation.images.palm"
    rows = table_of(root, "meta/episodes/chunk-000/file-000.parquet")
    assert rows["length"] == [15, 18] and rows["dataset_from_index"] == [0, 15]
    assert rows["tasks"] == [["Lift"], ["Lift"]] and rows["dataset_to_index"] == [15, 33]
    if encoding == "png":
        got = [np.asarray(Image.open(io.BytesIO(item["bytes"]))) for item in columns[key]]
        np.testing.assert_array_equal(got, images)
    else:
        got = []
        for number in range(2):
            assert rows[f"videos/{key}/from_timestamp"][number] == 0
            place = {k: rows[f"videos/{key}/{k}"][number] for k in ("chunk_index", "file_index")}
            name = info["video_path"].format(video_key=key, **place)
            with av.open(str(root / name)) as video:
                got += [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        error = np.abs(np.array(got, int) - images)
        assert len(got) == 33 and error.mean() < 8
    stats = json.loads((root / "meta/stats.json").read_text())
    proprio = np.concatenate([first["obs/palm_proprio"], second["obs/palm_proprio"]]).astype(float)
    for name in ("min", "max", "mean", "std"):
        expected = getattr(proprio, name)(0)
        np.testing.assert_allclose(stats["observation.palm_proprio"][name], expected, atol=1e-9)
    mean = (images / 255).mean((0, 1, 2)).reshape(3, 1, 1)
    np.testing.assert_allclose(stats[key]["mean"], mean, atol=1e-9)
    np.testing.assert_allclose(
        stats[key]["std"], (images / 255).std((0, 1, 2)).reshape(3, 1, 1), atol=1e-9
    )
    assert stats[key]["count"] == [33]
    tasks = pq.read_table(root / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0], "task": ["Lift"]}
    note = json.loads(tasks.schema.metadata[b"pandas"])
    assert note["index_columns"] == ["task"]
    made = json.loads((root / "meta/palm.json").read_text())
    assert made["calibration_sha256"] == datasets.robosuite().sha256
    assert data.verify(root) == {}
    assert not list(root.parent.glob(".*"))


@pytest.fixture(scope="module")
def front(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return datasets.lerobot(tmp_path_factory.mktemp("front"))


def test_from_lerobot_and_back(front: Path, aligned: Path, tmp_path: Path) -> None:
    """The same recording, in a video: the same numbers, nearly the same images."""
    for options, out in (
        (Options(format="robomimic"), tmp_path / "back.hdf5"),
        (Options(keep="all", instead=True), tmp_path / "set"),
    ):
        with open_recording(front, datasets.lerobot_calibration()) as recording:
            data.align_file(recording, SPEC, out, options)
        assert data.verify(out, robot=datasets.lerobot_calibration().robot) == {}
    got, expected = arrays(tmp_path / "back.hdf5"), arrays(aligned)
    np.testing.assert_allclose(got["obs/palm_proprio"], expected["obs/palm_proprio"], atol=1e-5)
    np.testing.assert_allclose(got["palm_actions"], expected["palm_actions"], atol=1e-4)
    np.testing.assert_allclose(got["actions"], expected["actions"], atol=1e-6)
    difference = got["obs/palm_image"].astype(int) - expected["obs/palm_image"]
    assert np.abs(difference).mean() < 3
    columns = table_of(tmp_path / "set", "data/chunk-000/file-000.parquet")
    np.testing.assert_array_equal(columns["action"][:15], got["palm_actions"])
    np.testing.assert_array_equal(columns["observation.state"][:15], got["obs/palm_proprio"])
    before = table_of(front, "data/chunk-000/file-000.parquet")
    assert columns["source_state"] == before["observation.state"]
    assert columns["source_action"] == before["action"]
    (video,) = front.rglob("*.mp4")
    copied = tmp_path / "set" / video.relative_to(front)
    assert copied.read_bytes() == video.read_bytes()
    rows = table_of(tmp_path / "set", "meta/episodes/chunk-000/file-000.parquet")
    starts = rows["videos/observation.images.front/from_timestamp"]
    assert starts == [0.0, pytest.approx(0.75)]


def changed_set(folder: Path, columns: dict[str, Any], features: dict[str, Any]) -> Path:
    """The LeRobot set with columns put in, and declared."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    root = datasets.lerobot(folder)
    file = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    for name, values in columns.items():
        if name in table.column_names:
            table = table.drop_columns([name])
        table = table.append_column(name, pa.array(values))
    pq.write_table(table, file)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"] |= features
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def stored_like_the_front(root: Path, video: str) -> None:
    """Says of a video where its episodes are."""
    import pyarrow.parquet as pq

    file = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    for name in table.column_names:
        if name.startswith("videos/observation.images.front/"):
            own = name.replace("observation.images.front", video)
            table = table.append_column(own, table[name])
    pq.write_table(table, file)


def with_stats(root: Path) -> None:
    wrong = {"min": [-99.0] * 7, "max": [99.0] * 7, "mean": [None] * 7, "std": [0.0] * 7}
    image = {"mean": [[[0.5]]] * 3, "count": [33]}
    stats = {"observation.state": wrong | {"count": [33]}, "observation.images.front": image}
    (root / "meta/stats.json").write_text(json.dumps(stats))


@pytest.mark.parametrize("kept", [1, 2])
def test_statistics_are_those_of_what_is_kept(kept: int, tmp_path: Path) -> None:
    """Those of images, which nobody has looked at, are kept for as long as they are right."""
    (tmp_path / "old").mkdir()
    columns = table_of(datasets.lerobot(tmp_path / "old"), "data/chunk-000/file-000.parquet")
    state = np.array(columns["observation.state"])
    if kept == 1:
        state[20, 3] = np.nan
    root = changed_set(tmp_path, {"observation.state": state.astype(np.float32).tolist()}, {})
    with_stats(root)
    robot = datasets.lerobot_calibration().robot
    assert len(data.repair(root, tmp_path / "new", robot=robot).kept) == kept
    stats = json.loads((tmp_path / "new/meta/stats.json").read_text())
    rows = state[:15] if kept == 1 else state
    for name in ("min", "max", "mean", "std"):
        expected = getattr(rows.astype(np.float32).astype(float), name)(0)
        np.testing.assert_allclose(stats["observation.state"][name], expected, atol=1e-9)
    assert stats["observation.state"]["count"] == [len(rows)]
    assert ("observation.images.front" in stats) == (kept == 2)


@pytest.mark.parametrize("command", ["align", "repair"])
def test_tasks_and_times_of_every_frame_are_kept(command: str, tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    index, times = [1] * 8 + [0] * 7 + [2] * 18, [i / 20 + 0.003 for i in [*range(15), *range(18)]]
    columns = {"task_index": index, "timestamp": np.array(times, np.float32)}
    root = changed_set(tmp_path, columns, {})
    words = ["place", "lift", "wave", "unused"]
    pq.write_table(
        pa.table({"task_index": [0, 1, 2, 3], "task": words}), root / "meta/tasks.parquet"
    )
    episodes = root / "meta/episodes/chunk-000/file-000.parquet"
    rows = pq.read_table(episodes).to_pylist()
    rows[0]["tasks"], rows[1]["tasks"] = ["lift", "place"], ["wave"]
    pq.write_table(pa.Table.from_pylist(rows), episodes)
    out = tmp_path / "out"
    if command == "repair":
        data.repair(root, out, robot=datasets.lerobot_calibration().robot)
    else:
        with open_recording(root, datasets.lerobot_calibration()) as recording:
            data.align_file(recording, SPEC, out)
    got = table_of(out, "data/chunk-000/file-000.parquet")
    found = pq.read_table(out / "meta/tasks.parquet").to_pydict()
    assert found == {"task_index": [0, 1, 2], "task": words[:3]}
    assert got["task_index"] == index
    np.testing.assert_array_equal(got["timestamp"], columns["timestamp"])
    tasks = table_of(out, "meta/episodes/chunk-000/file-000.parquet")["tasks"]
    assert tasks == [["lift", "place"], ["wave"]]


def test_what_robomimic_cannot_hold_is_left_out_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    depth = {"dtype": "video", "shape": [128, 128, 3], "names": None}
    features = {
        "language_instruction": {"dtype": "string", "shape": [1], "names": None},
        "observation.depth": depth | {"info": {"is_depth_map": True}},
    }
    root = changed_set(tmp_path, {"language_instruction": ["lift"] * 33}, features)
    stored_like_the_front(root, "observation.depth")
    path = data.save_calibration(datasets.lerobot_calibration(), tmp_path / "c.json")
    words = ["align", root, "--calibration", path, "--out", tmp_path / "new.hdf5"]
    assert commands.main([*map(str, words), "--format", "robomimic"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "not kept: language_instruction (string, not numbers)" in told
    assert "not kept: observation.depth (video, not numbers)" in told
    found = arrays(tmp_path / "new.hdf5")
    assert found["obs/state"].shape == (15, 7) and "obs/language_instruction" not in found
    with open_recording(root, datasets.lerobot_calibration()) as recording:
        data.align_file(recording, SPEC, tmp_path / "new")
    kept = table_of(tmp_path / "new", "data/chunk-000/file-000.parquet")
    assert kept["language_instruction"] == ["lift"] * 33


def test_what_lerobot_cannot_hold_is_left_out_and_told(tmp_path: Path) -> None:
    def add(file: h5py.File) -> None:
        for number, demo in enumerate(file["data"].values()):
            length = len(demo["actions"])
            demo["camera_pose"] = np.eye(4)
            demo["square"] = np.zeros((15, 3))  # by chance as many rows as the first has frames
            demo["text"] = "lift"
            demo["timestamp"] = np.arange(length)
            demo["obs/note"] = np.array([b"x"] * length)
            demo["obs/wide"] = np.zeros((length, 2 + number))
            if number == 0:
                demo["obs/first"] = np.zeros(length)
            else:
                demo["obs/second"] = np.zeros(length)
            demo["obs/fine"] = np.arange(length)

    path = datasets.changed(datasets.LIFT, tmp_path, add)
    with open_recording(path, datasets.robosuite()) as recording:
        result = data.align_file(recording, SPEC, tmp_path / "set", Options(format="lerobot"))
    rows, same_kind = "no numbers with a row for each frame", "not the same in all episodes"
    assert result.skipped == {
        "camera_pose": rows, "square": rows, "text": rows, "obs/note": rows,
        "obs/wide": same_kind, "obs/first": same_kind, "obs/second": same_kind,
        "timestamp": "LeRobot has its own",
    }  # fmt: skip
    columns = table_of(tmp_path / "set", "data/chunk-000/file-000.parquet")
    assert columns["observation.fine"] == [*range(15), *range(18)]
    np.testing.assert_allclose(columns["timestamp"][:15], np.arange(15) * 0.15, atol=1e-6)
    assert data.verify(tmp_path / "set") == {}


# -- stopping and going on -------------------------------------------------------------------------


def same(first: Path, second: Path) -> None:
    """Two outputs hold the same, bit for bit."""
    if first.is_dir():
        names = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
        assert names == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
        for name in names:
            assert (first / name).read_bytes() == (second / name).read_bytes(), name
        return
    for episode in ("demo_0", "demo_1"):
        one, other = arrays(first, episode), arrays(second, episode)
        assert set(one) == set(other)
        for key, value in one.items():
            np.testing.assert_array_equal(value, other[key], err_msg=key)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Stop:
    """Progress that presses Ctrl-C after so many frames."""

    def __init__(self, after: int):
        self.left = after

    def __call__(self, frames: int) -> None:
        self.left -= frames
        if self.left < 0:
            raise KeyboardInterrupt


@pytest.mark.parametrize("format", ["robomimic", "lerobot"])
@pytest.mark.parametrize("after", [0, 20])
def test_stopped_and_resumed(format: str, after: int, tmp_path: Path) -> None:
    options = Options(format=format)
    source, whole, stopped = datasets.LIFT, tmp_path / "whole", tmp_path / "stopped"
    before = datasets.digest(source)

    def run(out: Path, spec: AlignSpec = SPEC, **more: Any) -> job.Result:
        with open_recording(source, datasets.robosuite()) as recording:
            return data.align_file(recording, spec, out, options, **more)

    run(whole)
    with pytest.raises(KeyboardInterrupt):
        run(stopped, progress=Stop(after))
    assert not stopped.exists() and output.partial_path(stopped).exists()
    if after:
        left = contents(output.partial_path(stopped))
        with pytest.raises(OutputError, match="begun with spec = .*delete it"):
            run(stopped, spec=dataclasses.replace(SPEC, size=64))
        assert contents(output.partial_path(stopped)) == left
    result = run(stopped)
    assert result.resumed == (1 if after else 0)
    same(whole, stopped)
    assert datasets.digest(source) == before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def damaged(partial: Path, damage: str) -> None:
    """What a kill, or bits that flip, may leave of the first episode."""
    if damage.startswith("hdf5"):
        file = partial / "data.hdf5"
        if damage == "hdf5 cut":
            os.truncate(file, 20_000)
            return
        if damage == "hdf5 taken over":  # killed while it went on with an earlier file
            file.rename(partial / "left.hdf5")
            file.write_bytes(b"half")
            return
        with h5py.File(file, "r+") as content:
            key = "obs/palm_proprio" if damage == "hdf5 new" else "obs/robot0_eef_pos"
            content[f"data/demo_0/{key}"][3, 2] += 0.1
        return
    pattern = {"note": "*.json", "table": "*.parquet", "video": "*.mp4"}[damage.split()[0]]
    (file,) = [f for f in partial.rglob(pattern) if f.name != output.RECIPE and "1" not in f.name]
    if damage.endswith("gone"):
        file.unlink()
    elif damage.endswith("cut"):
        os.truncate(file, file.stat().st_size // 2)
    else:
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "resumed"),
    [("hdf5 cut", 0), ("hdf5 new", 0), ("hdf5 kept", 0), ("hdf5 taken over", 1), ("note cut", 0),
     ("note gone", 0), ("table cut", 0), ("table flipped", 0), ("video cut", 0), ("video gone", 0),
     ("video flipped", 0)],
)  # fmt: skip
def test_a_damaged_partial_is_made_again(damage: str, resumed: int, tmp_path: Path) -> None:
    """Killed without a chance to close the file, or bits that flipped since."""
    options = Options(
        format="robomimic" if damage.startswith("hdf5") else "lerobot",
        encoding="h264" if damage.startswith("video") else "png",
    )
    # Twice the same images: of 84 pixels x264 does not make twice the same bytes.
    spec = dataclasses.replace(SPEC, size=128) if damage.startswith("video") else SPEC
    whole, out = tmp_path / "whole", tmp_path / "out"
    with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
        data.align_file(recording, spec, whole, options)
        with pytest.raises(KeyboardInterrupt):
            data.align_file(recording, spec, out, options, progress=Stop(20))
        damaged(output.partial_path(out), damage)
        assert data.align_file(recording, spec, out, options).resumed == resumed
    same(whole, out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]


@pytest.mark.parametrize("format", ["robomimic", "lerobot"])
def test_one_process_writes_an_output(format: str, lift: Recording, tmp_path: Path) -> None:
    """A second one is refused and changes nothing, whatever it wants to write."""
    options, out, whole = Options(format=format), tmp_path / "out", tmp_path / "whole"
    refused = []

    def second(frames: int) -> None:
        before = contents(output.partial_path(out))
        for write in (
            lambda: data.align_file(lift, SPEC, out, options, trust=True),
            lambda: data.repair(datasets.LIFT, out),
        ):
            with pytest.raises(OutputError, match="another process is writing .*--out"):
                write()
            refused.append(frames)
        assert contents(output.partial_path(out)) == before

    data.align_file(lift, SPEC, whole, options)
    with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
        data.align_file(recording, SPEC, out, options, progress=second)
    assert len(refused) >= 4
    same(whole, out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]


@pytest.mark.parametrize("format", ["robomimic", "lerobot"])
def test_an_output_that_appears_in_the_meantime(
    format: str, lift: Recording, tmp_path: Path
) -> None:
    """It is not overwritten, and the hours of work are not lost."""
    options, out, whole = Options(format=format), tmp_path / "out", tmp_path / "whole"
    data.align_file(lift, SPEC, whole, options)

    def appear(frames: int) -> None:
        out.write_text("mine")

    with pytest.raises(OutputError, match="has appeared in the meantime.*move it"):
        data.align_file(lift, SPEC, out, options, progress=appear)
    assert out.read_text() == "mine"
    out.unlink()
    assert data.align_file(lift, SPEC, out, options).resumed == 2
    same(whole, out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]


@pytest.mark.parametrize("left", ["other format", "folder", "file", "link", "align"])
def test_what_is_in_the_way_is_not_deleted(left: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    partial = output.partial_path(out)
    words = "is none of ours.*delete it"
    if left == "folder":
        partial.mkdir()
        (partial / "data.hdf5").write_text("precious")
    elif left == "file":
        partial.write_text("precious")
    elif left == "link":
        partial.symlink_to(tmp_path / "nowhere")
    else:
        with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
            with pytest.raises(KeyboardInterrupt):
                data.align_file(recording, SPEC, out, progress=Stop(20))
        words = "begun by another" if left == "align" else "was begun with options"
    before = {partial: partial.read_bytes()} if left == "file" else contents(partial)
    if left == "align":
        with pytest.raises(OutputError, match=words):
            data.repair(datasets.LIFT, out)
    else:
        options = Options(format="lerobot" if left == "other format" else "robomimic")
        with open_recording(datasets.LIFT, datasets.robosuite()) as recording:
            with pytest.raises(OutputError, match=words):
                data.align_file(recording, SPEC, out, options, trust=True)
    after = {partial: partial.read_bytes()} if left == "file" else contents(partial)
    assert after == before and not out.exists() and os.path.lexists(partial)


def test_a_folder_with_nothing_but_its_recipe_is_in_nobodys_way(
    lift: Recording, tmp_path: Path
) -> None:
    """Killed between giving the output its name and removing the folder; or before it was there."""
    out = tmp_path / "out"
    with output.begun(out, {"another": "command"}):
        pass
    (tmp_path / ".out.partial.new").mkdir()
    (tmp_path / ".out.partial.lock").touch()
    data.align_file(lift, SPEC, out)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("command", ["align", "repair"])
def test_a_copy_of_a_video_that_was_interrupted(
    command: str, front: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(file: Path, target: Path) -> None:
        target.write_bytes(file.read_bytes()[:3000])
        raise KeyboardInterrupt

    def run() -> None:
        if command == "repair":
            data.repair(front, tmp_path / "out", robot=datasets.lerobot_calibration().robot)
            return
        with open_recording(front, datasets.lerobot_calibration()) as recording:
            data.align_file(recording, SPEC, tmp_path / "out", Options(keep="all"))

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(lerobot_writer.shutil, "copyfile", half)
        run()
    run()
    (video,), (copied,) = front.rglob("*.mp4"), (tmp_path / "out").rglob("*.mp4")
    assert copied.read_bytes() == video.read_bytes()
    assert data.verify(tmp_path / "out") == {}


def test_outputs_are_never_overwritten(lift: Recording, aligned: Path, front: Path) -> None:
    with pytest.raises(OutputError, match="not overwritten"):
        data.align_file(lift, SPEC, aligned)
    with (
        open_recording(front, datasets.lerobot_calibration()) as recording,
        pytest.raises(OutputError, match="inside the source"),
    ):
        data.align_file(recording, SPEC, front / "new")


@pytest.mark.parametrize(
    ("spec", "options", "words"),
    [
        ({"crop": 200}, {}, "--crop: expected at most the 128 x 128"),
        ({"isolate": True}, {}, "no masks"),
        ({"size": 83}, {"format": "lerobot", "encoding": "h264"}, "even number"),
        ({}, {"format": "lerobot", "keep": "all"}, "within one format"),
    ],
)
def test_options_that_cannot_be(
    spec: dict, options: dict, words: str, lift: Recording, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=words):
        data.align_file(
            lift, dataclasses.replace(SPEC, **spec), tmp_path / "new", Options(**options)
        )
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match="compression: expected one of gzip, lzf, none"):
        Options(compression="zip")


# -- verify and repair -----------------------------------------------------------------------------


def test_flipped_bits_are_found(aligned: Path, tmp_path: Path) -> None:
    path = tmp_path / "flipped.hdf5"
    shutil.copyfile(aligned, path)
    assert data.verify(path) == {}
    with h5py.File(path, "r+") as file:
        file["data/demo_1/obs/palm_image"][4, 30, 30, 1] ^= 1
    (problem,) = data.verify(path)["demo_1"]
    assert "obs/palm_image is not what was written" in problem


@pytest.mark.parametrize("keep", ["numbers", "all"])
def test_every_array_has_a_checksum(keep: str, tmp_path: Path) -> None:
    """What is kept of the source, too, whatever it is; computed by hashlib alone."""
    import hashlib

    def add(file: h5py.File) -> None:
        demo = file["data/demo_1"]
        demo["note"], demo["extra/matrix"] = "some words", np.eye(3)
        demo["extra/words"] = np.array(["a", "bc"], object)
        demo["next_obs/robot0_eef_pos"] = demo["obs/robot0_eef_pos"][()]

    (tmp_path / "source").mkdir()
    source = datasets.changed(datasets.LIFT, tmp_path / "source", add)
    with open_recording(source, datasets.robosuite()) as recording:
        data.align_file(recording, SPEC, tmp_path / "whole.hdf5", Options(keep=keep, instead=True))
    keys = list(arrays(tmp_path / "whole.hdf5", "demo_1"))
    assert {"note", "extra/words", "source_actions", "next_obs/robot0_eef_pos"} <= set(keys)
    with h5py.File(tmp_path / "whole.hdf5") as file:
        hashes = json.loads(file["data/demo_1"].attrs["palm_sha256"])
        for key in ("obs/robot0_eef_pos", "extra/matrix", "obs/palm_image"):
            values = file["data/demo_1"][key][()]
            expected = hashlib.sha256(f"{values.dtype.str}{values.shape[1:]}".encode())
            expected.update(values.tobytes())
            assert hashes[key] == expected.hexdigest(), key
    assert set(hashes) == set(keys) and data.verify(tmp_path / "whole.hdf5") == {}
    for key in keys:
        path = tmp_path / "flipped.hdf5"
        shutil.copyfile(tmp_path / "whole.hdf5", path)
        with h5py.File(path, "r+") as file:
            dataset = file["data/demo_1"][key]
            values = dataset[()]
            if key == "note":
                dataset[()] = "other words"
            elif key == "extra/words":
                dataset[1] = "b"
            else:
                raw = bytearray(np.ascontiguousarray(values).tobytes())
                raw[len(raw) // 2 - len(raw) // 2 % values.dtype.itemsize] ^= 1
                dataset[...] = np.frombuffer(bytes(raw), values.dtype).reshape(values.shape)
        assert f"{key} is not what was written" in " ".join(data.verify(path)["demo_1"]), key


@pytest.mark.parametrize("command", ["align", "repair"])
def test_every_file_of_a_set_has_a_checksum(command: str, front: Path, tmp_path: Path) -> None:
    import hashlib

    root, robot = tmp_path / "set", datasets.lerobot_calibration().robot
    if command == "repair":
        data.repair(front, root, robot=robot)
    else:
        with open_recording(front, datasets.lerobot_calibration()) as recording:
            options = Options(keep="all", encoding="h264")
            data.align_file(recording, SPEC, root, options)
    files = {str(p.relative_to(root)): p for p in root.rglob("*") if p.is_file()}
    hashes = json.loads(files.pop("meta/palm.json").read_text())["sha256"]
    assert hashes == {n: hashlib.sha256(p.read_bytes()).hexdigest() for n, p in files.items()}
    assert data.verify(root, robot=robot) == {}
    for name, path in files.items():
        whole = path.read_bytes()
        if name.endswith("json"):
            path.write_bytes(whole.replace(b"1", b"2", 1))
        elif name.endswith("mp4"):
            path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        else:
            path.write_bytes(whole[:10] + bytes([whole[10] ^ 1]) + whole[11:])
        try:
            found = data.verify(root, robot=robot)[""]
            assert f"{name} is not what was written (sha256)" in found
        except DataError:
            assert name.endswith(("parquet", "info.json"))  # cannot even be opened
        path.unlink()
        if name.startswith("videos/"):
            assert any(name in text for text in data.verify(root, robot=robot)[""])
        path.write_bytes(whole)


@pytest.mark.parametrize("content", ["{", "[]", '{"sha256": 3}', '{"sha256": {"../x": "0"}}'])
def test_checksums_of_strangers(content: str, front: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    shutil.copytree(front, root)
    (root / "meta/palm.json").write_text(content)
    (problem,) = data.verify(root)[""]
    assert "meta/palm.json cannot be read" in problem or "leads out of the data set" in problem

    def write(file: h5py.File) -> None:
        file["data/demo_0"].attrs["palm_sha256"] = content

    path = datasets.changed(datasets.LIFT, tmp_path, write)
    assert any("palm_sha256 cannot" in t or "missing" in t for t in data.verify(path)["demo_0"])


@pytest.mark.parametrize(
    "key", ["next_obs/image", "next_obs/pos", "extra/deep/numbers", "extra/words", "obs/mask"]
)
def test_verify_reads_every_array(key: str, tmp_path: Path) -> None:
    def add(file: h5py.File) -> None:
        demo, options = file["data/demo_1"], {"compression": "gzip", "chunks": True}
        if key.endswith("words"):
            demo.create_dataset(key, data=np.array([b"abc"] * 18), **options)
        elif key.endswith(("image", "mask")):
            demo.create_dataset(
                key, data=demo[datasets.IMAGES][..., : 3 - ("mask" in key)], **options
            )
        else:
            demo.create_dataset(key, data=np.zeros((18, 3)), **options)

    def damage(file: h5py.File) -> None:
        dataset = file["data/demo_1"][key]
        info = dataset.id.get_chunk_info(dataset.id.get_num_chunks() - 1)
        dataset.id.write_direct_chunk(info.chunk_offset, b"\0" * 50)

    path = datasets.changed(datasets.LIFT, tmp_path, add)
    assert data.verify(path) == {}
    with h5py.File(path, "r+") as file:
        damage(file)
    assert f"{key} cannot be read" in data.verify(path)["demo_1"][0]


def test_verify_reads_filter_keys(tmp_path: Path) -> None:
    def add(file: h5py.File) -> None:
        names = np.array([b"demo_0"] * 100)
        file.create_dataset("mask/train", data=names, compression="gzip")
        file["mask/train"].id.write_direct_chunk((0,), b"\0" * 50)

    (problem,) = data.verify(datasets.changed(datasets.LIFT, tmp_path, add))[""]
    assert "mask/train cannot be read" in problem


def test_verify_reads_every_column(tmp_path: Path) -> None:
    """A page that is damaged in a column that nothing else needs."""
    import pyarrow.parquet as pq

    words = [f"word {number}" for number in range(33)]
    features = {"words": {"dtype": "string", "shape": [1], "names": None}}
    root = changed_set(tmp_path, {"words": words}, features)
    assert data.verify(root) == {}
    file = root / "data/chunk-000/file-000.parquet"
    group = pq.read_metadata(file).row_group(0)
    column = group.column(group.num_columns - 1)
    content = bytearray(file.read_bytes())
    begin = column.dictionary_page_offset or column.data_page_offset
    content[begin : begin + 40] = bytes(40)
    file.write_bytes(content)
    assert "not a whole parquet file" in data.verify(root)["0"][0]


def test_verify_finds_what_does_not_add_up(tmp_path: Path) -> None:
    def spoil(file: h5py.File) -> None:
        file["data"].attrs["total"] = 99
        file["data/demo_0/obs/robot0_eef_pos"][3] = np.nan
        demo = file["data/demo_1"]
        datasets.replace(demo, datasets.IMAGES, demo[datasets.IMAGES][:-2])
        datasets.replace(demo, "obs/robot0_joint_pos", demo["obs/robot0_joint_pos"][:-1])

    path = datasets.changed(datasets.LIFT, tmp_path, spoil)
    problems = data.verify(path)
    assert problems[""] == ["total is 99, not 33"]
    assert "NaN or infinity in 1 frames, the first at 3" in problems["demo_0"][0]
    assert f"{datasets.IMAGES} has 16 images, expected 18" in problems["demo_1"]
    assert "obs/robot0_joint_pos has 17 rows, expected 18" in problems["demo_1"]


def test_repair_leaves_the_unsound_out(tmp_path: Path) -> None:
    def spoil(file: h5py.File) -> None:
        file["data/demo_0/obs/robot0_eef_pos"][3] = np.nan
        file["data/demo_1"].attrs["num_samples"] = 5
        file["mask/valid"] = np.array([b"demo_0", b"demo_1"])

    path = datasets.changed(datasets.LIFT, tmp_path, spoil)
    before = datasets.digest(path)
    result = data.repair(path, tmp_path / "new.hdf5")
    assert result.kept == ("demo_1",) and "NaN" in result.dropped["demo_0"]
    assert data.verify(tmp_path / "new.hdf5") == {} and datasets.digest(path) == before
    original, saved = (arrays(p, "demo_1") for p in (datasets.LIFT, tmp_path / "new.hdf5"))
    for key, value in original.items():
        np.testing.assert_array_equal(saved[key], value)
    with h5py.File(tmp_path / "new.hdf5") as file:
        assert list(file["mask/valid"][()]) == [b"demo_1"] and list(file["data"]) == ["demo_1"]
        assert file["data"].attrs["total"] == 18
        assert json.loads(file["data"].attrs["palm_repair"])["dropped"]["demo_0"]


def scaled(poses: np.ndarray) -> np.ndarray:
    poses[3] *= [[2.0], [2.0], [2.0], [1.0]]
    return poses


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("obs/robot0_eef_quat", lambda q: q * (np.arange(15) != 4)[:, None], "length 1"),
        ("obs/palm_tcp", scaled, "frame 3: expected an orthonormal"),
        ("obs/robot0_gripper_qpos", lambda q: q / (np.arange(15) != 4)[:, None], "has NaN"),
        ("obs/robot0_gripper_qpos", lambda q: q[:-1], "expected 15 rows in .*, got 14"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.filterwarnings("ignore:invalid value")
def test_repair_leaves_out_what_align_refuses(
    key: str, change: Callable[[np.ndarray], np.ndarray], words: str, aligned: Path, tmp_path: Path
) -> None:
    def spoil(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        datasets.replace(demo, key, change(demo[key][()]))

    told = datasets.robosuite()
    if key == "obs/palm_tcp":
        told = dataclasses.replace(told, robot=data.RobotKeys("palm_tcp", None, "palm_opening"))
        camera = dataclasses.replace(told.cameras["agentview"], image=datasets.IMAGES)
        told = dataclasses.replace(told, cameras={"agentview": camera})
    path = datasets.changed(aligned, tmp_path, spoil)
    with h5py.File(path, "r+") as file, h5py.File(datasets.LIFT) as old:
        for name in ("demo_0", "demo_1"):
            old.copy(old[f"data/{name}/{datasets.IMAGES}"], file[f"data/{name}/obs"])
    with (
        open_recording(path, told) as recording,
        pytest.raises(DataError, match=f"demo_0: .*{words}.* data repair .* --calibration C"),
    ):
        recording.survey()
    problems = data.verify(path, robot=told.robot)
    assert list(problems) == ["demo_0"] and re.search(words, problems["demo_0"][0])
    assert data.repair(path, tmp_path / "new.hdf5", robot=told.robot).kept == ("demo_1",)
    with open_recording(tmp_path / "new.hdf5", told) as recording:
        assert recording.survey().episodes == 1


def test_a_damaged_first_episode_hides_no_other(tmp_path: Path) -> None:
    """Its gripper cannot be read, by which the keys are recognised."""

    def spoil(file: h5py.File) -> None:
        values = file["data/demo_0/obs/robot0_gripper_qpos"][()]
        datasets.replace(file["data/demo_0"], "obs/robot0_gripper_qpos", values, compression="gzip")
        file["data/demo_0/obs/robot0_gripper_qpos"].id.write_direct_chunk((0, 0), b"\0" * 50)
        file["data/demo_1/obs/robot0_eef_pos"][3] = np.nan
        file.copy("data/demo_1", "data/demo_2")
        file["data/demo_2/obs/robot0_eef_pos"][3] = file["data/demo_2/obs/robot0_eef_pos"][2]

    path = datasets.changed(datasets.LIFT, tmp_path, spoil)
    assert "cannot be read" in data.verify(path)["demo_0"][0]
    assert data.repair(path, tmp_path / "new.hdf5").kept == ("demo_2",)


def test_poses_that_nobody_looked_at_are_mentioned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = datasets.lerobot(tmp_path)
    path = data.save_calibration(datasets.lerobot_calibration(), tmp_path / "c.json")
    for command in (["verify"], ["repair", "--out", str(tmp_path / "new")]):
        words = ["data", command[0], str(root), *command[1:]]
        assert main(words) == 0
        assert "poses were not looked at; pass --calibration" in capsys.readouterr().out
    assert main(["data", "verify", str(root), "--calibration", str(path)]) == 0
    assert "not looked at" not in capsys.readouterr().out


@pytest.mark.parametrize("share", [0.55, 0.7, 0.9])
@pytest.mark.parametrize("compressed", [True, False])
def test_repair_of_a_cut_file_takes_nothing_for_zeros(
    share: float, compressed: bool, tmp_path: Path
) -> None:
    whole = tmp_path / "whole.hdf5"
    shutil.copyfile(datasets.LIFT, whole)
    if not compressed:
        whole.unlink()
        with h5py.File(datasets.LIFT) as old, h5py.File(whole, "w") as new:
            for name in ("demo_0", "demo_1"):
                old.copy(old[f"data/{name}"], new.require_group("data"), name=name)
                images = old[f"data/{name}/{datasets.IMAGES}"][()]
                datasets.replace(new[f"data/{name}"], datasets.IMAGES, images)
    content = whole.read_bytes()
    cut = tmp_path / "cut.hdf5"
    cut.write_bytes(content[: int(share * len(content))])
    try:
        result = data.repair(cut, tmp_path / "saved.hdf5")
    except (TruncatedError, OutputError):
        assert not (tmp_path / "saved.hdf5").exists()
        return
    assert data.verify(tmp_path / "saved.hdf5") == {}
    for name in result.kept:
        saved = arrays(tmp_path / "saved.hdf5", name)
        for key, value in arrays(datasets.LIFT, name).items():
            np.testing.assert_array_equal(saved[key], value, err_msg=key)


@pytest.mark.parametrize("kind", ["robosuite", "aligned"])
def test_a_cut_file_from_which_something_can_be_saved(
    kind: str, aligned: Path, tmp_path: Path
) -> None:
    """The second episode lies at the end."""
    content = (aligned if kind == "aligned" else datasets.LIFT).read_bytes()
    cut = tmp_path / "cut.hdf5"
    cut.write_bytes(content[: int(0.8 * len(content))])
    result = data.repair(cut, tmp_path / "saved.hdf5")
    assert result.kept == ("demo_0",) and "beyond the end" in result.dropped["demo_1"]


def test_repair_of_lerobot(tmp_path: Path) -> None:
    root = datasets.lerobot(tmp_path, short_video=3)
    robot = datasets.lerobot_calibration().robot
    assert "15 images, expected 18" in data.verify(root, robot=robot)["1"][0]
    result = data.repair(root, tmp_path / "saved", robot=robot)
    assert result.kept == ("0",) and list(result.dropped) == ["1"]
    told = datasets.lerobot_calibration()
    front = told.cameras["front"]
    front = dataclasses.replace(front, by_episode={"1": front.cam_to_base})
    with open_recording(
        tmp_path / "saved", dataclasses.replace(told, cameras={"front": front})
    ) as recording:
        assert recording.source.episodes == ("0",)  # the other is known to be gone
    assert data.verify(tmp_path / "saved", robot=robot) == {}
    before = table_of(root, "data/chunk-000/file-000.parquet")
    after = table_of(tmp_path / "saved", "data/chunk-000/file-000.parquet")
    assert after["observation.state"] == before["observation.state"][:15]
    with data.open_source(tmp_path / "saved") as saved, data.open_source(root) as old:
        key = "observation.images.front"
        for got, expected in zip(saved.blocks("0", key, 8), old.blocks("0", key, 8), strict=True):
            np.testing.assert_array_equal(got, expected)


# -- calibrations after a repair -------------------------------------------------------------------


def raised(name: str) -> data.Calibration:
    """The Lift calibration whose camera stood higher in one episode."""
    found = datasets.robosuite()
    camera = found.cameras["agentview"]
    pose = camera.cam_to_base + oracles.pose(np.zeros((3, 3)), [0, 0, 0.3]) - np.diag([0, 0, 0, 1])
    camera = dataclasses.replace(camera, by_episode={name: pose})
    return dataclasses.replace(found, cameras={"agentview": camera})


@pytest.mark.parametrize("spoiled", ["demo_0", "demo_1"])
def test_the_calibration_of_before_is_that_of_the_repaired_file(
    spoiled: str, tmp_path: Path
) -> None:
    """align, its error, repair, align: as docs/your_data.md says. Repaired twice."""

    def spoil(file: h5py.File) -> None:
        file[f"data/{spoiled}/obs/robot0_eef_pos"][3] = np.nan

    path = datasets.changed(datasets.LIFT, tmp_path, spoil)
    first, second = tmp_path / "first.hdf5", tmp_path / "second.hdf5"
    data.repair(path, first)
    data.repair(first, second)
    (kept,) = {"demo_0", "demo_1"} - {spoiled}
    for repaired in (first, second):
        with open_recording(repaired, raised("demo_1")) as recording:
            (episode,) = data.aligned_episodes(recording, SPEC)
        assert episode.name == kept
        height = camera()[1][2, 3] + (0.3 if kept == "demo_1" else 0)
        assert episode.camera.cam_to_world[2, 3] == pytest.approx(height, abs=1e-6)


def test_poses_of_episodes_that_there_are_not(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"by_episode: expected .* got traj_1.*demo_0, demo"):
        open_recording(datasets.LIFT, raised("traj_1"))


def test_lerobot_numbers_anew_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    root = datasets.lerobot(tmp_path)
    table = root / "data/chunk-000/file-000.parquet"
    columns = pq.read_table(table).to_pydict()
    columns["observation.state"][2][0] = float("nan")  # of episode 0
    pq.write_table(pa.table(columns), table)
    told = datasets.lerobot_calibration()
    front, pose = told.cameras["front"], raised("1").cameras["agentview"].by_episode["1"]
    told = data.Calibration(
        {"front": dataclasses.replace(front, by_episode={"0": pose, "1": pose})},
        told.ee_to_tcp,
        told.robot,
    )
    path = data.save_calibration(told, tmp_path / "c.json")
    words = ["data", "repair", root, "--calibration", path, "--out", tmp_path / "new"]
    assert main([str(word) for word in words]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "numbered anew: 1 is now 0 (all in" in out
    assert "cameras.front.by_episode: 0 was left out" in out
    assert "cameras.front.by_episode: 1 is now 0" in out
    note = json.loads((tmp_path / "new/meta/palm.json").read_text())
    assert note["episodes"] == {"1": "0"} and list(note["dropped"]) == ["0"]
    with pytest.raises(CalibrationError, match="got 1, .*anew .1 is now 0.: give it the --cal"):
        open_recording(tmp_path / "new", told)
    with open_recording(tmp_path / "new", tmp_path / "new/meta/calibration.json") as recording:
        assert list(recording.camera.by_episode) == ["0"]
        np.testing.assert_allclose(recording.camera.camera("0").cam_to_world, pose, atol=1e-6)
        (episode,) = data.aligned_episodes(recording, SPEC)
    assert len(episode.images) == 18
    assert main(["data", "repair", str(root), "--out", str(tmp_path / "again")]) == 0
    assert (
        "numbered anew" not in capsys.readouterr().out
    )  # without it no pose is known, none is bad


def test_nothing_to_repair(tmp_path: Path) -> None:
    def spoil(file: h5py.File) -> None:
        file["data/demo_0/obs/robot0_eef_quat"][0, 1] = np.inf

    path = datasets.changed(datasets.CAN, tmp_path, spoil)
    with pytest.raises(OutputError, match="no sound episode to save .*demo_0"):
        soundness.repair(path, tmp_path / "new.hdf5")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_checksums_do_not_depend_on_blocks() -> None:
    values = np.arange(60, dtype=np.float32).reshape(20, 3)
    whole, parts = output.Digest(), output.Digest()
    whole.add(values)
    for first in range(0, 20, 7):
        parts.add(values[first : first + 7])
    assert whole.hex() == parts.hex()
    assert robomimic_writer.CHECKSUMS == "palm_sha256"
