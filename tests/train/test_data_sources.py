"""Readers: what they give is what the file holds, whatever its layout."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import datasets
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from palm_jax.train.data import inspection, recording, source
from palm_jax.train.data.errors import (
    DataError,
    ExtraMissingError,
    FormatError,
    KeyMissingError,
    TruncatedError,
)
from palm_jax.train.data.source import open_source

KEY = "observation.images.front"


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return datasets.lerobot(tmp_path_factory.mktemp("lerobot"))


LAYOUTS: dict[str, dict] = {
    "contiguous": {},
    "gzip, a frame a chunk": {"compression": "gzip", "chunks": (1, 128, 128, 3)},
    "gzip, four frames": {"compression": "gzip", "chunks": (4, 128, 128, 3), "shuffle": True},
    "gzip, pieces of frames": {"compression": "gzip", "chunks": True},
    "gzip, pieces that do not divide": {"compression": "gzip", "chunks": (7, 50, 33, 2)},
    "gzip, one chunk": {"compression": "gzip", "chunks": (31, 128, 128, 3)},
    "gzip, more than a block": {"compression": "gzip", "chunks": (24, 128, 128, 3)},
    "lzf": {"compression": "lzf"},
    "checked": {"compression": "gzip", "chunks": (1, 128, 128, 3), "fletcher32": True},
}


@pytest.mark.parametrize("layout", list(LAYOUTS))
def test_images_of_every_layout(layout: str, tmp_path: Path) -> None:
    images = datasets.frames(datasets.CAN)
    changed = datasets.changed(
        datasets.CAN,
        tmp_path,
        lambda f: datasets.replace(f["data/demo_0"], datasets.IMAGES, images, **LAYOUTS[layout]),
    )
    with open_source(changed) as file:
        blocks = list(file.blocks("demo_0", datasets.IMAGES, 8))
        assert max(map(len, blocks)) <= {"m": 24, "o": 31}.get(layout[6:7], 8)
        np.testing.assert_array_equal(np.concatenate(blocks), images)
        np.testing.assert_array_equal(file.image("demo_0", datasets.IMAGES, 5), images[5])
        assert file.length("demo_0") == len(images)


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name.startswith("gzip")])
def test_gzip_is_read_past_hdf5(
    layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In threads, whatever the chunks."""
    images = datasets.frames(datasets.CAN)
    changed = datasets.changed(
        datasets.CAN,
        tmp_path,
        lambda f: datasets.replace(f["data/demo_0"], datasets.IMAGES, images, **LAYOUTS[layout]),
    )
    with open_source(changed) as file:
        monkeypatch.setattr(type(file), "_read", lambda *args: pytest.fail("read by HDF5"))
        got = np.concatenate(list(file.blocks("demo_0", datasets.IMAGES, 8)))
    np.testing.assert_array_equal(got, images)


@pytest.mark.parametrize("kind", ["unfiltered", "never written"])
def test_a_chunk_that_is_not_compressed(kind: str, tmp_path: Path) -> None:
    """HDF5 may skip a filter chunk by chunk; so may whoever writes chunks directly."""
    images = datasets.frames(datasets.CAN)

    def change(file: h5py.File) -> None:
        options = LAYOUTS["gzip, a frame a chunk"]
        if kind == "never written":
            del file["data/demo_0"][datasets.IMAGES]
            dataset = file["data/demo_0"].create_dataset(
                datasets.IMAGES, images.shape, np.uint8, **options
            )
            images[3] = 0
            for row in {*range(len(images))} - {3}:
                dataset[row] = images[row]
            return
        datasets.replace(file["data/demo_0"], datasets.IMAGES, images, **options)
        dataset = file["data/demo_0"][datasets.IMAGES]
        dataset.id.write_direct_chunk((3, 0, 0, 0), images[3].tobytes(), filter_mask=1)

    with open_source(datasets.changed(datasets.CAN, tmp_path, change)) as file:
        got = np.concatenate(list(file.blocks("demo_0", datasets.IMAGES, 8)))
    np.testing.assert_array_equal(got, images)


def test_robomimic_header() -> None:
    with open_source(datasets.LIFT) as file:
        assert file.format == "robomimic" and file.episodes == ("demo_0", "demo_1")
        assert file.fps == pytest.approx(20 / 3) and file.task("demo_0") == "Lift"
        assert file.image_keys == [datasets.IMAGES]
        assert file.features()["actions"].shape == (7,)
        assert set(file.camera_info("demo_0")) == {"agentview"}
        with pytest.raises(KeyMissingError, match="it has actions, dones, obs"):
            file.resolve("nothing")
        with pytest.raises(KeyMissingError, match="demo_0 has no 'nothing'"):
            file.numbers("demo_0", "nothing")


def test_episodes_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    def rename(file: h5py.File) -> None:
        file.move("data/demo_0", "data/demo_10")
        file.move("data/demo_1", "data/demo_9")

    with open_source(datasets.changed(datasets.LIFT, tmp_path, rename)) as file:
        assert file.episodes == ("demo_9", "demo_10")


def test_lerobot_gives_the_frames_of_its_video(lerobot: Path) -> None:
    with open_source(lerobot) as data, h5py.File(datasets.LIFT) as original:
        assert data.format == "lerobot" and data.episodes == ("0", "1") and data.fps == 20
        assert data.image_keys == [KEY] and data.features()[KEY].shape == (128, 128, 3)
        assert data.task("1") == "lift"
        for name, demo in zip(data.episodes, original["data"].values(), strict=True):
            images = demo[datasets.IMAGES][()]
            assert data.length(name) == len(images)
            blocks = list(data.blocks(name, KEY, 8))
            assert [len(block) for block in blocks[:-1]] == [8] * (len(blocks) - 1)
            got = np.concatenate(blocks).astype(int)
            assert got.shape == images.shape
            # Lossy, but each frame is nearest to its own original.
            error = np.abs(got[:, None] - images[None].astype(int)).mean((2, 3, 4))
            np.testing.assert_array_equal(error.argmin(1), np.arange(len(images)))
            assert error.diagonal().max() < 3
            place = len(images) - 2
            single = data.image(name, KEY, place).astype(int)
            assert np.abs(single - images[place]).mean() < 3
            position = data.numbers(name, "observation.state")[:, :3]
            np.testing.assert_allclose(position, demo["obs/robot0_eef_pos"][()], atol=1e-6)


def test_lerobot_poses_are_those_of_the_original(lerobot: Path) -> None:
    """Quaternions in the one file, angles in the other."""
    with (
        recording.open_recording(datasets.LIFT, datasets.robosuite()) as first,
        recording.open_recording(lerobot, datasets.lerobot_calibration()) as second,
    ):
        for one, other in zip(first.source.episodes, second.source.episodes, strict=True):
            expected, got = first.trajectory(one), second.trajectory(other)
            np.testing.assert_allclose(got.tcp, expected.tcp, atol=1e-5)
            np.testing.assert_allclose(got.opening, expected.opening, atol=1e-5)
        with h5py.File(datasets.LIFT) as file:
            grip = np.abs(file["data/demo_0/obs/robot0_gripper_qpos"][()]).mean(1) / 0.04
        np.testing.assert_allclose(first.trajectory("demo_0").opening, grip, atol=1e-12)


def pictures_in_tables(folder: Path, **options: Any) -> tuple[Path, list[np.ndarray]]:
    """The set with its images as PNG in the table, made by Pillow and pyarrow; and the images."""
    root = datasets.lerobot(folder)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][KEY] |= {"dtype": "image"}
    (root / "meta/info.json").write_text(json.dumps(info))
    images = [
        image for name in ("demo_0", "demo_1") for image in datasets.frames(datasets.LIFT, name)
    ]
    pictures = []
    for image in images:
        content = io.BytesIO()
        Image.fromarray(image).save(content, "PNG")
        pictures.append({"bytes": content.getvalue(), "path": "x.png"})
    file = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(file).append_column(KEY, pa.array(pictures)), file, **options)
    return root, images


@pytest.mark.parametrize(
    "options",
    [{}, {"row_group_size": 15}, {"row_group_size": 10, "data_page_size": 1},
     {"row_group_size": 20, "write_statistics": False}],
)  # fmt: skip
def test_images_inside_of_tables(options: dict[str, Any], tmp_path: Path) -> None:
    """However the table is cut into groups of rows."""
    root, images = pictures_in_tables(tmp_path, **options)
    with open_source(root) as data:
        blocks = [block for name in data.episodes for block in data.blocks(name, KEY, 8)]
        assert [len(block) for block in blocks] == [8, 7, 8, 8, 2]
        np.testing.assert_array_equal(np.concatenate(blocks), images)
        np.testing.assert_array_equal(data.image("1", KEY, 2), images[data.length("0") + 2])


def test_images_inside_of_tables_are_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of every picture the bytes go once through the reader: not the column for each block."""
    root, images = pictures_in_tables(tmp_path, row_group_size=33)
    decoded = []

    def batches(file: Any, *args: Any, **options: Any) -> Any:
        for batch in read(file, *args, **options):
            decoded.append(len(batch))
            yield batch

    read = pq.ParquetFile.iter_batches
    with open_source(root) as data:
        monkeypatch.setattr(pq.ParquetFile, "iter_batches", batches)
        monkeypatch.setattr(pq, "read_table", lambda *args, **options: pytest.fail("read whole"))
        assert len(np.concatenate(list(data.blocks("1", KEY, 4)))) == 18
        assert sum(decoded) == 33
        decoded.clear()
        data.image("0", KEY, 3)
        assert sum(decoded) <= 8


def test_a_table_with_too_few_rows(tmp_path: Path) -> None:
    root, _ = pictures_in_tables(tmp_path)
    file = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(file).slice(0, 30), file)
    with open_source(root) as data:
        assert len(np.concatenate(list(data.blocks("0", KEY, 8)))) == 15
        with pytest.raises(TruncatedError, match="episode 1 has 15 rows, meta/episodes says 18"):
            list(data.blocks("1", KEY, 8))
        with pytest.raises(KeyMissingError, match="no column 'other'"):
            data.column("1", "other")


def test_a_video_that_ends_early(tmp_path: Path) -> None:
    with open_source(datasets.lerobot(tmp_path, short_video=3)) as data:
        assert len(np.concatenate(list(data.blocks("0", KEY, 8)))) == data.length("0")
        with pytest.raises(TruncatedError, match="expected 18 frames .* found 15"):
            list(data.blocks("1", KEY, 8))


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("absent", FormatError, "no such file"),
        ("folder", FormatError, "without meta/info.json"),
        ("text", FormatError, "neither HDF5 nor a folder"),
        ("other", FormatError, "no group 'data'"),
        ("empty", FormatError, "no episode"),
        ("cut", TruncatedError, "ends too early .* its header says"),
        ("old", FormatError, "version v3.0, got v2.1"),
        ("footer", TruncatedError, "not a whole parquet file"),
        ("video", TruncatedError, "missing; copy the data set again"),
    ],
)
def test_files_that_are_none(
    name: str, error: type, words: str, tmp_path: Path, lerobot: Path
) -> None:
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
    elif name == "text":
        path.write_text("episode,frame\n")
    elif name in ("other", "empty"):
        with h5py.File(path, "w") as file:
            file.create_group("data" if name == "empty" else "traj_0")
    elif name == "cut":
        content = datasets.LIFT.read_bytes()
        path.write_bytes(content[: len(content) * 2 // 3])
    elif name in ("old", "footer", "video"):
        path.mkdir()
        root = datasets.lerobot(path)
        if name == "old":
            info = root / "meta/info.json"
            info.write_text(info.read_text().replace('"v3.0"', '"v2.1"'))
        elif name == "footer":
            table = root / "data/chunk-000/file-000.parquet"
            table.write_bytes(table.read_bytes()[:-8])
        else:
            next(root.rglob("*.mp4")).unlink()
        path = root
    with pytest.raises(error, match=words), open_source(path) as data:
        data.numbers("0", "action")
        list(data.blocks("0", KEY, 8))


@pytest.mark.parametrize("module", ["pyarrow", "av"])
def test_without_the_extra(module: str, lerobot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ExtraMissingError, match=r"pip install 'palm-jax\[lerobot\]'"):
        with open_source(lerobot) as data:
            list(data.blocks("0", KEY, 8))


def test_reading_lerobot_needs_nothing_but_the_extra() -> None:
    code = (
        "import sys; import palm_jax.train.data; "
        "print({'pyarrow', 'av', 'lerobot', 'torch', 'pandas'} & set(sys.modules))"
    )
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert run.stdout.strip() == "set()", run.stderr


@pytest.mark.long
def test_every_entry_of_info_json_may_be_odd(tmp_path: Path) -> None:
    """It is read, looked into and verified, or refused by name."""
    root = datasets.lerobot(tmp_path)
    path = root / "meta/info.json"
    whole = json.loads(path.read_text())
    tried = refused = 0
    for place, entry in datasets.spoiled(whole):
        tried += 1
        path.write_text(json.dumps(entry))
        try:
            with open_source(root) as data:
                inspection.inspect(data)
                data.columns("1", "observation.state")
        except DataError:
            refused += 1
        except Exception as error:
            raise AssertionError(place) from error
    assert tried > 300 and refused > tried / 4


@pytest.mark.long
@pytest.mark.parametrize("attribute", ["data.env_args", "data/demo_0.camera_info"])
def test_every_entry_of_a_robomimic_header_may_be_odd(attribute: str, tmp_path: Path) -> None:
    place, name = attribute.split(".")
    path = datasets.changed(datasets.CAN, tmp_path, lambda file: None)
    with h5py.File(path) as file:
        whole = json.loads(file[place].attrs[name])
    refused = 0
    for where, entry in datasets.spoiled(whole):
        with h5py.File(path, "r+") as file:
            file[place].attrs[name] = json.dumps(entry)
        try:
            with open_source(path) as data:
                inspection.inspect(data)
                assert data.task("demo_0")
                datasets.robosuite(path)
        except DataError:
            refused += 1
        except Exception as error:
            raise AssertionError(where) from error
    assert refused > 5


def test_fingerprints_tell_files_apart(
    tmp_path: Path, lerobot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_source(datasets.LIFT) as first, open_source(datasets.CAN) as second:
        print_first = first.fingerprint()
        assert print_first["sha256"] != second.fingerprint()["sha256"]
        import hashlib

        expected = hashlib.sha256(datasets.LIFT.read_bytes()).hexdigest()
        assert print_first["sha256"] == expected
        monkeypatch.setattr(source, "WHOLE_HASH_BYTES", 1000)
        assert "sha256_of_ends" in first.fingerprint()
    with open_source(lerobot) as data:
        assert data.fingerprint()["bytes"] == sum(
            file.stat().st_size for file in lerobot.rglob("*") if file.is_file()
        )


def test_inspection(lerobot: Path, tmp_path: Path) -> None:
    with open_source(datasets.LIFT) as file:
        found = inspection.inspect(file)
    assert (found.episodes, found.frames, found.lengths) == (2, 33, (15, 18))
    assert found.images == {datasets.IMAGES: (128, 128)} and found.cameras == ("agentview",)
    assert found.robot is not None and found.robot.rotation == "quat_xyzw"
    assert found.numbers["actions"]["max"] == 1.0 and found.notes == ()
    with open_source(lerobot) as data:
        found = inspection.inspect(data)
    assert found.robot is None and "observation.state" in found.notes[0]

    def spoil(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        demo["obs/robot0_gripper_qpos"][...] /= 5  # a smaller one than the Panda's
        demo["obs/robot0_eef_pos"][3] = np.nan
        for key in ("actions", datasets.IMAGES):
            datasets.replace(file["data/demo_1"], key, file["data/demo_1"][key][:1])

    with open_source(datasets.changed(datasets.LIFT, tmp_path, spoil)) as file:
        notes = inspection.inspect(file).notes
    assert any("demo_1 has 1 frame:" in note for note in notes)
    assert any("obs/robot0_eef_pos has NaN" in note for note in notes)
    assert any("0.04 for open: it moves, but is never half open" in note for note in notes)
