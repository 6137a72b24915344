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
from palm_jax.train.data import calibration, output, verify
from palm_jax.train.data.errors import DiskFullError
from palm_jax.train.files.metrics import plain

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


def intrinsics(cx: float, cy: float) -> np.ndarray:
    return np.array([[154.5, 0, cx], [0, 154.5, cy], [0, 0, 1]])


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


def attribute(name: str, value: Any, place: str = "data") -> Change:
    return lambda file: file[place].attrs.__setitem__(name, value)


def described(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Path]:
    """A LeRobot set with another meta/info.json: changed in place, or what `change` returns."""

    def make(folder: Path) -> Path:
        root = datasets.lerobot(folder)
        path = root / "meta" / "info.json"
        content = json.loads(path.read_text())
        other = change(content)
        path.write_text(json.dumps(content if other is None else other))
        return root

    return make


def feature(key: str, **entries: Any) -> Callable[[Path], Path]:
    return described(lambda info: info["features"][key].update(entries))


def listed(change: Callable[[dict[str, list[Any]]], Any]) -> Callable[[Path], Path]:
    """A LeRobot set with another table meta/episodes."""

    def make(folder: Path) -> Path:
        import pyarrow as pa
        import pyarrow.parquet as pq

        root = datasets.lerobot(folder)
        path = root / "meta/episodes/chunk-000/file-000.parquet"
        columns = pq.read_table(path).to_pydict()
        change(columns)
        pq.write_table(pa.table(columns), path)
        return root

    return make


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
    # What files say of themselves.
    "env_args that are cut": Case(
        "FormatError", ["env_args: expected JSON, got {cut"], change=attribute("env_args", "{cut")
    ),
    "env_args that are a list": Case(
        "FormatError", ["env_args: expected an object {...}, got [1]"],
        change=attribute("env_args", "[1]"),
    ),
    "env_kwargs that are a text": Case(
        "FormatError", ["env_kwargs: expected an object"],
        change=attribute("env_args", '{"env_kwargs": "x"}'),
    ),
    "a rate that is a text": Case(
        "FormatError", ["control_freq: expected frames a second, got fast"],
        change=attribute("env_args", '{"env_kwargs": {"control_freq": "fast"}}'),
    ),
    "a rate of nothing": Case(
        "FormatError", ["fps: expected frames a second, got 0"],
        change=lambda file: [attribute("env_args", "{}")(file), attribute("fps", 0)(file)] and None,
    ),
    "a single action": Case(
        "FormatError", ["demo_0: actions: expected an array with a row for each frame", "repair"],
        change=lambda file: datasets.replace(file["data/demo_0"], "actions", np.float64(3)),
    ),
    "a number of frames that is a text": Case(
        "FormatError", ["demo_0: num_samples: expected a whole number of at least 0, got many"],
        change=lambda file: [
            attribute("num_samples", "many", "data/demo_0")(file), without("actions")(file)
        ] and None,
    ),
    "info.json that is a list": Case(
        "FormatError", ["info.json: expected an object"], file=described(lambda info: [1])
    ),
    "info.json without a rate": Case(
        "FormatError", ["info.json: fps: expected frames a second, got nothing"],
        file=described(lambda info: info.pop("fps") and None),
    ),
    "info.json with no rate": Case(
        "FormatError", ["fps: expected frames a second, got 0"],
        file=described(lambda info: info.update(fps=0)),
    ),
    "info.json with a rate in words": Case(
        "FormatError", ["fps: expected frames a second, got fast"],
        file=described(lambda info: info.update(fps="fast")),
    ),
    "info.json without features": Case(
        "FormatError", ["features: expected an object {...}, got nothing"],
        file=described(lambda info: info.pop("features") and None),
    ),
    "a feature without a shape": Case(
        "FormatError", ["features: action: expected a dtype, and a shape"],
        file=feature("action", shape=None),
    ),
    "a feature without a type": Case(
        "FormatError", ["features: action: expected a dtype, and a shape"],
        file=feature("action", dtype=None),
    ),
    "a shape in words": Case(
        "FormatError", ["features: action: expected a dtype, and a shape"],
        file=feature("action", shape=["seven"]),
    ),
    "a feature of another width": Case(
        "FormatError", ["observation.state: expected 8 numbers a frame", "episode 0"],
        file=feature("observation.state", shape=[8]), calibrated=FRONT,
    ),
    "info.json without the place of the tables": Case(
        "FormatError", ["data_path: expected a path with {chunk_index}", "got nothing"],
        file=described(lambda info: info.pop("data_path") and None),
    ),
    "a place with other names": Case(
        "FormatError", ["data_path: expected a path", "got data/{episode}"],
        file=described(lambda info: info.update(data_path="data/{episode}")),
    ),
    "info.json without the place of the videos": Case(
        "FormatError", ["video_path: expected a path with {chunk_index}"],
        file=described(lambda info: info.update(video_path=None)),
    ),
    "episodes without a length": Case(
        "FormatError", ["meta/episodes: row 0: length: expected a number", "got nothing"],
        file=listed(lambda columns: columns.pop("length")),
    ),
    "episodes without a table": Case(
        "FormatError", ["meta/episodes: row 0: data/chunk_index: expected a number"],
        file=listed(lambda columns: columns.pop("data/chunk_index")),
    ),
    "episodes that begin nowhere": Case(
        "FormatError", ["row 0: videos/observation.images.front/from_timestamp: expected"],
        file=listed(lambda columns: columns.pop("videos/observation.images.front/from_timestamp")),
    ),
    "an episode that comes twice": Case(
        "FormatError", ["expected each episode_index once"],
        file=listed(lambda columns: columns.update(episode_index=[0, 0])),
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
        calibrated={"width": 512, "height": 512, "K": lambda: intrinsics(256, 256)},
    ),
    "K with another principal point": Case(
        "ImageSizeError", ["principal point near", "cx = 256.0 of 128;", "another resolution",
                           "--rescale"],
        calibrated={"K": lambda: intrinsics(256, 256)},
    ),
    "K for a smaller resolution": Case(
        "ImageSizeError", ["cx = 32.0 of 128;", "another resolution", "--rescale", "--off-centre"],
        calibrated={"K": lambda: intrinsics(32, 32)},
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
    "a camera of episodes that are not there": Case(
        "CalibrationError", ["by_episode", "got traj_3", "rename them; the file has demo_0"],
        calibrated={"by_episode": lambda: {"traj_3": pose()}},
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
        change=images(lambda i: i[:, :96]),
        calibrated={"width": 96, "K": lambda: intrinsics(48, 64)},
    ),
    # Measured pixels.
    "a camera that was moved": Case(
        "ReprojectionError", ["within 3.0 px", "agentview_tcp_uv", "stood elsewhere", "--trust"],
        calibrated={"T_base_cam": lambda: pose() @ oracles.pose(np.eye(3), [0.03, 0, 0])},
    ),
    "pixels that are none": Case(
        "FormatError", ["expected 31 x 2 measured pixels", "got 3 x 2", "--pixels", "--trust"],
        change=rows("obs/agentview_tcp_uv", 3),
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
    "a gripper in other units": Case(
        "OpeningError", ["from 0.02083 to", "0.001 for open: far outside", "--open VALUE", "--tr"],
        calibrated={"opening": "robot0_gripper_qpos", "closed": 0.0, "open": 0.001},
    ),
    "a gripper that is never open": Case(
        "OpeningError", ["with 0 for closed and 0.4 for open", "never half open", "--open VALUE"],
        calibrated={"opening": "robot0_gripper_qpos", "closed": 0.0, "open": 0.4},
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
        "EpisodeLengthError", ["demo_0: expected at least two frames", "got 1;", "data repair"],
        change=every(1),
    ),
    "an empty episode": Case(
        "EpisodeLengthError", ["demo_0: expected at least two frames", "got 0;", "data repair"],
        change=every(0),
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
    "all of it in another format": Case(
        "OutputError", ["--keep all", "within one format"],
        options=("--keep", "all", "--format", "lerobot"),
    ),
    "a crop larger than the frame": Case(
        "DataError", ["--crop", "128 x 128", "got 300"], options=("--crop", "300")
    ),
    "an image of no pixels": Case("OptionError", ["AlignSpec.size"], options=("--size", "0")),
    **{
        f"a spec with {text}": Case(
            "DataError", ["--spec: ", "expected a value like"], options=("--spec", text)
        )
        for text in (
            '{"axis_length": "x"}', '{"axis_length": null}', '{"offset": 3}',
            '{"offset": ["a", 1]}', '{"overlay": "no"}', '{"crop": true}', '{"crop": 40.5}',
            '{"thickness": NaN}',
        )
    },
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
        value = plain(value()) if callable(value) else value
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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "camera_info: expected JSON"),
        ("[]", "camera_info: expected an object"),
        ('{"agentview": 3}', "agentview: expected an object"),
        ('{"agentview": {"intrinsics": [[1]]}}', "intrinsics: expected 3 x 3 finite numbers, got"),
    ],
)
@pytest.mark.parametrize("command", ["inspect", "calibrate"])
def test_camera_info_that_is_none(
    command: str, text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is read where `data align` has the calibration already."""
    change = attribute("camera_info", text, "data/demo_0")
    path = str(datasets.changed(datasets.CAN, tmp_path, change))
    more = ["--from", "robosuite", "--out", str(tmp_path / "new.json"), "--file"]
    assert main(["data", command, *(more if command == "calibrate" else []), path]) == 2
    message = capsys.readouterr().err
    assert "error: FormatError: " in message and words in message


def test_damaged_headers_are_reported_by_verify(tmp_path: Path) -> None:
    """One episode's, among the others' problems; a total in words."""

    def spoil(file: h5py.File) -> None:
        datasets.replace(file["data/demo_1"], "actions", np.float64(3))
        file["data"].attrs["total"] = "many"

    problems = verify(datasets.changed(datasets.LIFT, tmp_path, spoil))
    assert list(problems) == ["demo_1"] and "a row for each frame" in problems["demo_1"][0]
    total = datasets.changed(datasets.CAN, tmp_path, attribute("total", "many"))
    assert verify(total) == {"": ["total is many, not 31"]}


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
    # Without pyarrow: test_data_sources.
    assert named - tested == {"ExtraMissingError"}
