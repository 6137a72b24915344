"""The table of bad input: each case is an error of its own name that says what to do, leaves
nothing half-written, and never touches what it was given."""

import contextlib
import json
import resource
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import datasets
import h5py
import jax
import numpy as np
import oracles
import pytest
from jax.experimental.compilation_cache import compilation_cache

from palm_jax.__main__ import main
from palm_jax.train.data import calibration, output
from palm_jax.train.data.errors import DiskFullError

GL = np.diag([1.0, -1.0, -1.0, 1.0])
Change = Callable[[h5py.File], None]


class Case(NamedTuple):
    """One row of the table.

    Attributes:
      error: name of the error, as the command prints it.
      words: of its message, the advice among them.
      change: made to a copy of the Can recording.
      calibrated: entries of the camera in calibration.json that differ, or those of "robot".
      options: of `data align`.
      file: makes the input instead of `change`.
    """

    error: str
    words: list[str]
    change: Change | None = None
    calibrated: dict[str, Any] | None = None
    options: tuple[str, ...] = ()
    file: Callable[[Path], Path] | None = None


def pose() -> np.ndarray:
    return datasets.robosuite(datasets.CAN).cameras["agentview"].cam_to_base


def images(turn: Callable[[np.ndarray], np.ndarray]) -> Change:
    """The stored images turned."""

    def change(file: h5py.File) -> None:
        turned = turn(datasets.frames(datasets.CAN))
        datasets.replace(file["data/demo_0"], datasets.IMAGES, np.ascontiguousarray(turned))

    return change


def rows(key: str, count: int | None = None, value: float | None = None) -> Change:
    """An array cut to some rows, or with a value in its fifth frame."""

    def change(file: h5py.File) -> None:
        values = file["data/demo_0"][key][:count]
        if value is not None:
            values[4] = value
        datasets.replace(file["data/demo_0"], key, values)

    return change


def every(count: int) -> Change:
    """All arrays of the episode cut to some rows."""

    def change(file: h5py.File) -> None:
        demo = file["data/demo_0"]
        for key in ("actions", *(f"obs/{name}" for name in list(demo["obs"]))):
            datasets.replace(demo, key, demo[key][:count])

    return change


def without(*keys: str) -> Change:
    def change(file: h5py.File) -> None:
        for key in keys:
            del file["data/demo_0"][key]

    return change


def renamed(old: str, new: str) -> Change:
    return lambda file: file["data/demo_0"].move(old, new)


def cut(folder: Path) -> Path:
    path = folder / "cut.hdf5"
    content = datasets.CAN.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def text(folder: Path) -> Path:
    path = folder / "notes.hdf5"
    path.write_text("not a recording\n")
    return path


def lerobot(**options: Any) -> Callable[[Path], Path]:
    return lambda folder: datasets.lerobot(folder, **options)


FRONT = {"name": "front", "pose": "observation.state[0:6]", "rotation": "euler_xyz"}
FRONT |= {"opening": "observation.state[6]", "closed": 0.0, "open": 0.04}
SIX = {"pose": "robot0_eef_pos+cube", "rotation": None}

CASES: dict[str, Case] = {
    # Files.
    "truncated HDF5": Case(
        "TruncatedError", ["ends too early", "copy it again", "data repair"], file=cut
    ),
    "not a recording": Case("FormatError", ["neither HDF5 nor a folder"], file=text),
    "no such file": Case("FormatError", ["no such file"], file=lambda folder: folder / "absent"),
    "no images": Case(
        "CameraNameError", ["no images of 'agentview'", "it has none"],
        change=without(datasets.IMAGES),
    ),
    "a video that ends early": Case(
        "TruncatedError", ["expected 18 frames", "found 15", "data repair"],
        file=lerobot(short_video=3), calibrated=FRONT,
    ),
    "images damaged": Case(
        "TruncatedError", ["cannot be read", "data repair"],
        change=lambda file: damage(file["data/demo_0"][datasets.IMAGES]),
    ),
    # Calibration.
    "missing calibration": Case(
        "CalibrationError", ["no such file", "data calibrate --from"],
        options=("--calibration", "absent.json"),
    ),
    "a camera that is not there": Case(
        "CameraNameError", ["'sideview' is not in the calibration", "agentview"],
        options=("--camera", "sideview"),
    ),
    "a camera of another file": Case(
        "CameraNameError", ["no images of 'wrist'", "obs/agentview_image", '"image"'],
        calibrated={"name": "wrist"},
    ),
    "mirrored extrinsics": Case(
        "CalibrationError", ["T_base_cam", "det = -1", "flip two axes"],
        calibrated={"T_base_cam": lambda: pose() @ np.diag([1.0, -1.0, 1.0, 1.0])},
    ),
    "negative focal length": Case(
        "CalibrationError", ["positive focal lengths", "negate both"],
        calibrated={"K": lambda: np.diag([-154.5, -154.5, 1.0])},
    ),
    "K for another resolution": Case(
        "ImageSizeError", ["expected images of 512 x 512", "got 128 x 128", "--rescale 128 128"],
        calibrated={"width": 512, "height": 512},
    ),
    "K with another principal point": Case(
        "ImageSizeError", ["principal point inside", "another resolution", "--rescale"],
        calibrated={"K": lambda: np.array([[618.0, 0, 256], [0, 618, 256], [0, 0, 1]])},
    ),
    "TCP behind the camera": Case(
        "TcpBehindCameraError", ["behind the camera in 100%", "inverted", "data check"],
        calibrated={"T_base_cam": lambda: pose() @ GL},
    ),
    "TCP out of view": Case(
        "TcpOutOfViewError", ["inside the image in 0%", "--least-in-view", "data check"],
        calibrated={"T_base_cam": lambda: oracles.pose(np.eye(3), [0, 3.0, 0]) @ pose()},
    ),
    "inverted extrinsics": Case(
        "TcpOutOfViewError", ["inverted", "--inverse"],
        calibrated={"T_base_cam": lambda: np.linalg.inv(pose())},
    ),
    # Images.
    "images upside down": Case(
        "ImageOrientationError", ["upside down", "--flip ud", "--trust"],
        change=images(lambda i: i[:, ::-1]),
    ),
    "images mirrored": Case(
        "ImageOrientationError", ["mirrored left to right", "--flip lr"],
        change=images(lambda i: i[:, :, ::-1]),
    ),
    "images turned by a half": Case(
        "ImageOrientationError", ["half a turn", "--flip 180"],
        change=images(lambda i: i[:, ::-1, ::-1]),
    ),
    "images turned by a quarter": Case(
        "ImageOrientationError", ["turned clockwise", "--flip cw"],
        change=images(lambda i: np.rot90(i, 1, (1, 2))),
    ),
    "images turned, not square": Case(
        "ImageSizeError", ["96 x 128", "got 128 x 96", "--flip cw or ccw"],
        change=images(lambda i: i[:, :96]), calibrated={"width": 96},
    ),
    # Poses.
    "angles without an order": Case(
        "EulerAmbiguityError",
        ["euler_xyz", "euler_XYZ", "degrees apart", "--rotation"],
        file=lerobot(), calibrated=FRONT | {"rotation": None},
    ),
    "a quaternion without an order": Case(
        "EulerAmbiguityError", ["quat_xyzw (scalar last)", "quat_wxyz (scalar first)"],
        calibrated={"pose": "robot0_eef_pos+robot0_eef_quat_site"},
    ),
    "poses under another name": Case(
        "KeyMissingError", ["which key is the pose", "--pose"],
        change=renamed("obs/robot0_eef_pos", "obs/hand"),
    ),
    "a key that is not there": Case(
        "KeyMissingError", ["has no key 'ee'", "robot0_eef_pos"], calibrated={"pose": "ee"}
    ),
    "NaN poses": Case(
        "PoseDataError", ["demo_0", "NaN or infinity in 1 frames, the first at 4", "data repair"],
        change=rows("obs/robot0_eef_pos", value=np.nan),
    ),
    "quaternions that are none": Case(
        "PoseDataError", ["quaternions of length 1", "--pose"],
        change=rows("obs/robot0_eef_quat", value=0.0),
    ),
    "matrices that are none": Case(
        "PoseDataError", ["frame 0: expected an orthonormal", "data repair"],
        change=lambda file: file["data/demo_0"].create_dataset(
            "obs/pose", data=np.tile(np.diag([2.0, 2, 2, 1]), (31, 1, 1))
        ),
        calibrated={"pose": "pose", "rotation": "matrix"},
    ),
    "a gripper of another kind": Case(
        "OpeningError", ["6 columns", "--closed VALUE --open VALUE"],
        change=lambda file: datasets.replace(
            file["data/demo_0"], "obs/robot0_gripper_qpos", np.ones((31, 6))
        ),
    ),
    "no gripper": Case(
        "OpeningError", ["which key is the gripper", "--opening"],
        change=without("obs/robot0_gripper_qpos"),
    ),
    "a gripper with NaN": Case(
        "PoseDataError", ["robot0_gripper_qpos has NaN"],
        change=rows("obs/robot0_gripper_qpos", value=np.nan),
    ),
    # Episodes.
    "an episode of length one": Case(
        "EpisodeLengthError", ["demo_0 has 1 frame;", "data repair"], change=every(1)
    ),
    "an empty episode": Case(
        "EpisodeLengthError", ["demo_0 has 0 frames;", "data repair"], change=every(0)
    ),
    "fewer poses than actions": Case(
        "EpisodeLengthError", ["expected 31 rows in robot0_eef_pos", "got 28", "data repair"],
        change=lambda file: [
            rows(f"obs/{key}", 28)(file) for key in ("robot0_eef_pos", "robot0_eef_quat")
        ] and None,
    ),
    "fewer images than poses": Case(
        "EpisodeLengthError", ["31 poses and 25 images", "data repair"],
        change=rows(datasets.IMAGES, 25),
    ),
    "more images than poses": Case(
        "EpisodeLengthError", ["31 poses and more images"],
        change=images(lambda i: np.concatenate([i, i[:3]])),
    ),
    "no images in an episode": Case(
        "EpisodeLengthError", ["31 poses and 0 images", "data repair"],
        change=rows(datasets.IMAGES, 0),
    ),
    "no images in an episode, not looked at before": Case(
        "EpisodeLengthError", ["31 poses and 0 images", "data repair"],
        change=rows(datasets.IMAGES, 0), options=("--trust",),
    ),
    # Options.
    "a crop larger than the frame": Case(
        "DataError", ["--crop", "128 x 128", "got 300"], options=("--crop", "300")
    ),
    "an image of no pixels": Case("OptionError", ["AlignSpec.size"], options=("--size", "0")),
    "more transitions than frames": Case(
        "EpisodeLengthError", ["transitions, got 99"], options=("--transitions", "99")
    ),
}  # fmt: skip


def damage(dataset: h5py.Dataset) -> None:
    """Bytes that gzip cannot read."""
    dataset.id.write_direct_chunk((7, 0, 0, 0), b"\0" * 500)


def calibrated(folder: Path, entries: dict[str, Any]) -> Path:
    """calibration.json of the Can recording, with some entries changed."""
    content = datasets.robosuite(datasets.CAN).to_json()
    camera = content["cameras"].pop("agentview")
    content["cameras"][entries.get("name", "agentview")] = camera
    for key, value in entries.items():
        value = np.asarray(value()).tolist() if callable(value) else value
        if key in content["robot"]:
            content["robot"][key] = value
        elif key != "name":
            camera[key] = value
    path = folder / "calibration.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("name", list(CASES))
def test_bad_input(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    case = CASES[name]
    given, made = tmp_path / "given", tmp_path / "made"
    given.mkdir(), made.mkdir()
    if case.file is not None:
        source = case.file(given)
    else:
        source = datasets.changed(datasets.CAN, given, case.change or (lambda file: None))
    words = ["data", "align", str(source), "--out", str(made / "new")]
    if "--calibration" not in case.options:
        words += ["--calibration", str(calibrated(given, case.calibrated or {}))]
    before = datasets.digest(given)
    assert main([*words, *case.options]) == 2
    message = capsys.readouterr().err.split("error: ", 1)[1]
    assert message.startswith(f"{case.error}: "), message
    for part in case.words:
        assert part in message, message
    assert list(made.iterdir()) == [], "something half-written is left"
    assert datasets.digest(given) == before, "the input was touched"


# -- the disk --------------------------------------------------------------------------------------


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The system refuses to let files grow beyond this, as a full disk does; programs that JAX
    compiles meanwhile would be cut short in the cache that all tests share."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        with _no_cache():
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


@contextlib.contextmanager
def _no_cache() -> Iterator[None]:
    before = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()


def align(source: Path, out: Path, *options: str) -> int:
    path = out.parent / "calibration.json"
    if not path.exists():
        calibration.save(datasets.robosuite(), path)
    words = ["data", "align", source, "--calibration", path, "--out", out, *options]
    return main([str(word) for word in words])


@pytest.mark.parametrize("format", ["robomimic", "lerobot"])
def test_a_disk_that_fills_up_on_the_way(
    format: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new"
    options = ("--format", format, "--compression", "none")
    assert align(datasets.LIFT, out, *options) == 0  # everything is compiled and cached
    shutil.rmtree(out) if out.is_dir() else out.unlink()
    capsys.readouterr()
    with files_of_at_most(100_000):
        assert align(datasets.LIFT, out, *options) == 2
    message = capsys.readouterr().err
    assert "error: DiskFullError: " in message and "nothing half-written is left" in message
    assert [path.name for path in tmp_path.iterdir()] == ["calibration.json"]
    assert align(datasets.LIFT, out, *options) == 0  # and with room it works


@pytest.mark.parametrize("format", ["robomimic", "lerobot"])
@pytest.mark.parametrize("size", [0, 300, 5000])
def test_a_disk_that_is_full_at_the_first_byte(
    format: str, size: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new"
    path = calibration.save(datasets.robosuite(), tmp_path / "calibration.json")
    with files_of_at_most(size):
        assert align(datasets.LIFT, out, "--format", format, "--trust") == 2
    message = capsys.readouterr().err
    assert "error: DiskFullError: " in message and "nothing half-written is left" in message
    assert list(tmp_path.iterdir()) == [path]


def test_a_disk_that_is_full_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(output.shutil, "disk_usage", lambda path: usage._replace(free=100_000))
    assert align(datasets.LIFT, tmp_path / "new") == 2
    message = capsys.readouterr().err
    assert "error: DiskFullError: " in message and "nothing has been written" in message
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", ["calibrate", "check", "repair"])
def test_other_commands_on_a_full_disk(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "made"
    made.mkdir()
    path = calibration.save(datasets.robosuite(), tmp_path / "calibration.json")
    words = {
        "calibrate": ["--from", "palm", "--file", path, "--out", made / "new.json"],
        "check": [datasets.LIFT, "--calibration", path, "--out", made / "sheet.png"],
        "repair": [datasets.LIFT, "--out", made / "new.hdf5"],
    }[command]
    with files_of_at_most(300):
        assert main(["data", command, *map(str, words)]) == 2
    assert "error: DiskFullError: " in capsys.readouterr().err
    assert list(made.iterdir()) == []


def test_full_disks_are_recognised() -> None:
    from palm_jax.train.data.errors import disk_full, is_disk_full

    assert is_disk_full(OSError(28, "No space left on device"))
    assert is_disk_full(OSError("Can't write data (file write failed: errno = 28, error = 'x')"))
    assert not is_disk_full(OSError(13, "Permission denied"))
    with pytest.raises(DiskFullError, match="x: no space left on the device; try"):
        with disk_full(Path("x"), "try"):
            raise OSError(122, "quota")
    with pytest.raises(OSError, match="denied"), disk_full(Path("x"), "try"):
        raise OSError(13, "denied")


def test_every_error_is_in_the_table() -> None:
    """A new error comes with a case."""
    from palm_jax.train.data import errors

    named = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.DataError)
    }
    tested = {case.error for case in CASES.values()} | {"DiskFullError"}
    # Without pyarrow: test_data_sources; an output that exists: test_data_align.
    assert named - tested == {"ExtraMissingError", "OutputError"}
