"""`python -m palm_jax data COMMAND`: alignment for data that this package did not record.

* `inspect FILE`: what is in it;
* `calibrate --from ...`: a calibration.json out of what others store;
* `check FILE --calibration C`: does it fit the images, and if not, why;
* `align FILE --calibration C --out NEW`: PALM's images, proprioception and labels as new keys;
* `verify FILE`, `repair FILE --out NEW`: is it whole, and what of it can be saved.

Exit codes: 0, 1 where `check` or `verify` found something, 2 for an error that is named, 130 for
Ctrl-C.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from palm_jax._checks import OptionError
from palm_jax.align import AlignSpec
from palm_jax.train.data import aligning, check, importers, inspection, job, soundness
from palm_jax.train.data import calibration as calib
from palm_jax.train.data.calibration import Calibration, CameraCalibration, RobotKeys
from palm_jax.train.data.errors import CalibrationError, DataError, OutputError, disk_full
from palm_jax.train.data.headers import is_number
from palm_jax.train.data.recording import LEAST_IN_VIEW, Recording, open_recording
from palm_jax.train.data.source import Source, open_source
from palm_jax.train.files import records
from palm_jax.train.host import interrupts
from palm_jax.train.reporting import console as terminal

File = tyro.conf.Positional[Path]
Flip = Literal["none", "ud", "lr", "180", "cw", "ccw"]
Axes = Literal["opencv", "opengl", "coppelia"]


# -- inspect ---------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Inspect:
    """What is in a data file: episodes, keys, images, and what would be in the way.

    Attributes:
      file: robomimic HDF5 file, or folder of a LeRobot v3 data set.
    """

    file: File


def run_inspect(config: Inspect, console: Console) -> int:
    with open_source(config.file) as source:
        found = inspection.inspect(source)
    shortest, longest = found.lengths
    console.print(
        f"{found.path}: {found.format}, {found.episodes} episodes, {found.frames} frames "
        f"({shortest} to {longest}), {found.fps:.3g} frames a second"
    )
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("key", "a frame", "type", "range in the first episode"):
        table.add_column(column)
    for key, (width, height) in found.images.items():
        table.add_row(escape(key), f"{width} x {height}", "images", "")
    for key, entry in found.numbers.items():
        shape = " x ".join(map(str, entry["shape"])) or "1"
        extent = f"{entry['min']:.4g} to {entry['max']:.4g}" if "min" in entry else ""
        table.add_row(escape(key), shape, entry["dtype"], extent)
    console.print(table)
    console.print(f"calibrated cameras: {', '.join(found.cameras) or 'none in the file'}")
    if found.robot is not None:
        robot = found.robot
        console.print(
            f"pose: {robot.pose} ({robot.rotation}); gripper: {robot.opening} from "
            f"{robot.closed:g} (closed) to {robot.open:g} (open)",
            markup=False,
        )
    for note in found.notes:
        console.print(f"note: {note}", markup=False)
    return 0


# -- calibrate -------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Calibrate:
    """Make a calibration.json out of what others store.

    Attributes:
      from_: robosuite (camera_info or model_file of a robomimic file), mujoco (an MJCF), maniskill
        (HDF5, JSON, or a LeRobot folder), droid (six numbers), npy (arrays or numbers), palm (a
        calibration.json, to change it).
      out: the new file; nothing is overwritten.
      file: what to read, see `from`.
      camera: names; by default all that have images (npy, droid: one name is needed; palm: those to
        change, the others stay as they are).
      size: width and height of the images that K describes, if no file tells.
      K: npy, droid: fx,fy,cx,cy or a .npy file of 3 x 3.
      extrinsics: npy: a .npy file of 4 x 4; droid: x,y,z and three angles.
      inverse: the extrinsics map the base (world) into the camera.
      axes: of the camera in the extrinsics.
      euler: how three angles read: xyz about fixed axes, XYZ about the camera's own.
      dist: lens coefficients of OpenCV (numbers or .npy).
      pixel_origin: what (0, 0) is in K: the corner of the first pixel (renderers), or its centre
        (OpenCV's calibration), which is half a pixel away.
      flip: what turns the stored images upright.
      off_centre: how far K's principal point may lie from the middle, as a share of the image, 0.15
        unless told otherwise: more for images that were cropped to one side.
      rescale: width and height to which the images were resized since.
      image: key of the camera's images, where its name does not tell.
      pose: key of the hand's pose, KEY[a:b] or several joined with +.
      rotation: how its orientation reads.
      opening: key of the gripper, with its values when --closed and --open.
      closed: see opening.
      open: see opening.
      tcp_offset: the TCP's origin in the frame of the recorded poses, metres.
      tcp_turn: degrees about that frame's z axis to the TCP's frame (y along the fingers' opening).
    """

    from_: Annotated[
        Literal["robosuite", "mujoco", "maniskill", "droid", "npy", "palm"],
        tyro.conf.arg(name="from"),
    ]
    out: Path
    file: Path | None = None
    camera: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    K: str | None = None
    extrinsics: str | None = None
    inverse: bool = False
    axes: Axes = "opencv"
    euler: Literal["xyz", "XYZ"] | None = None
    dist: str | None = None
    pixel_origin: Literal["corner", "centre"] = "corner"
    flip: Flip | None = None
    off_centre: float | None = None
    rescale: tuple[int, int] | None = None
    image: str | None = None
    pose: str | None = None
    rotation: (
        Literal["euler_xyz", "euler_XYZ", "quat_xyzw", "quat_wxyz", "rotvec", "rot6d", "matrix"]
        | None
    ) = None
    opening: str | None = None
    closed: float | None = None
    open: float | None = None
    tcp_offset: tuple[float, float, float] | None = None
    tcp_turn: float | None = None


def make_calibration(config: Calibrate) -> Calibration:
    """The calibration that the options describe.

    Raises:
      CalibrationError, DataError: see `importers`.
    """
    _check_used(config)
    old = None
    if config.from_ == "palm":
        old = calib.load(_file(config))
        made_from = old.made_from
        cameras = {
            name: _changed_pose(old.camera(name), config) for name in config.camera or old.cameras
        }
    else:
        cameras = _imported(config)
        made_from = f"{config.from_}: {config.file.name if config.file else 'numbers'}"
    if config.image is not None and len(cameras) > 1:
        raise CalibrationError(
            f"--image names the images of one camera, not of {', '.join(cameras)}; choose it with "
            "--camera"
        )
    kept = old.cameras if old is not None else {}
    cameras = {**kept, **{name: _changed(camera, config) for name, camera in cameras.items()}}
    before = old.robot if old is not None else RobotKeys()
    given = {f.name: getattr(config, f.name) for f in dataclasses.fields(RobotKeys)}
    robot = dataclasses.replace(before, **{k: v for k, v in given.items() if v is not None})
    tcp = old.ee_to_tcp if old is not None else np.eye(4)
    return Calibration(cameras, _tcp(config, tcp), robot, made_from)


_USED = {
    "robosuite": {"size"},
    "mujoco": {"size"},
    "maniskill": {"size"},
    "droid": {"size", "K", "extrinsics", "euler", "inverse", "axes"},
    "npy": {"size", "K", "extrinsics", "inverse", "axes"},
    "palm": {"inverse", "axes"},
}
"""Options that not every importer uses."""


def _check_used(config: Calibrate) -> None:
    """Raises for an option that would have no effect.

    Raises:
      CalibrationError: with what uses it.
    """
    for field in dataclasses.fields(config):
        users = [kind for kind, used in _USED.items() if field.name in used]
        if users and config.from_ not in users and getattr(config, field.name) != field.default:
            raise CalibrationError(
                f"--{field.name}: --from {config.from_} does not use it, only {', '.join(users)}; "
                "leave it out, or change the finished calibration with --from palm"
            )


def _file(config: Calibrate) -> Path:
    if config.file is None:
        raise CalibrationError(f"--from {config.from_} needs a --file")
    return config.file


def _tcp(config: Calibrate, before: np.ndarray) -> np.ndarray:
    if config.tcp_offset is None and config.tcp_turn is None:
        return before
    from palm_jax.train.data.rotations import about

    tcp = np.eye(4)
    tcp[:3, :3] = about(2, np.radians(config.tcp_turn or 0.0))
    tcp[:3, 3] = config.tcp_offset or (0.0, 0.0, 0.0)
    return tcp


def _changed_pose(camera: CameraCalibration, config: Calibrate) -> CameraCalibration:
    if not config.inverse and config.axes == "opencv":
        return camera

    def change(pose: np.ndarray) -> np.ndarray:
        return calib.as_opencv(pose, config.axes, config.inverse)

    return dataclasses.replace(
        camera,
        cam_to_base=change(camera.cam_to_base),
        by_episode={name: change(pose) for name, pose in camera.by_episode.items()},
    )


def _changed(camera: CameraCalibration, config: Calibrate) -> CameraCalibration:
    changes: dict[str, Any] = {}
    if config.pixel_origin == "centre":
        changes["K"] = camera.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    for name in ("flip", "image", "off_centre"):
        if getattr(config, name) is not None:
            changes[name] = getattr(config, name)
    if config.dist is not None:
        numbers = importers.numbers_or_file(config.dist, "--dist").ravel()
        changes["dist"] = tuple(numbers.tolist())
    camera = dataclasses.replace(camera, **changes)
    return camera.rescaled(*config.rescale) if config.rescale is not None else camera


def _imported(config: Calibrate) -> dict[str, CameraCalibration]:
    if config.from_ == "mujoco":
        try:
            xml = _file(config).read_text()
        except OSError as error:
            raise CalibrationError(f"{config.file}: cannot be read ({error})") from error
        return importers.from_mujoco(xml, config.camera, config.size)
    if config.from_ == "robosuite":
        with open_source(_file(config)) as source:
            return importers.from_robosuite(source, config.camera, config.size)
    if config.from_ == "maniskill":
        return _maniskill(config)
    return _numbers(config)


def _maniskill(config: Calibrate) -> dict[str, CameraCalibration]:
    path = _file(config)
    if not path.is_dir():
        if config.size is None:
            raise CalibrationError("--from maniskill needs the --size of the images")
        return importers.from_maniskill(path, None, config.camera, config.size)
    with open_source(path) as source:
        size = config.size or _only_size(source, config.camera)
        return importers.from_maniskill(path, source, config.camera, size)


def _only_size(source: Source, names: Sequence[str]) -> tuple[int, int]:
    sizes = {importers.image_size(source, n) for n in importers.with_images(source, names)} - {None}
    if len(sizes) != 1:
        raise CalibrationError(f"images of several sizes {sorted(map(str, sizes))}; give --size")
    (size,) = sizes
    assert size is not None
    return size


def _numbers(config: Calibrate) -> dict[str, CameraCalibration]:
    """DROID and plain arrays: one camera."""
    if len(config.camera) != 1:
        raise CalibrationError(f"--from {config.from_} makes one camera: name it with --camera")
    (name,) = config.camera
    if config.K is None:
        raise CalibrationError("--K: expected fx,fy,cx,cy or a .npy file; no file has it otherwise")
    K = importers.intrinsics(importers.numbers_or_file(config.K, "--K"))
    source = open_source(config.file) if config.file is not None else None
    try:
        size = config.size or (importers.image_size(source, name) if source is not None else None)
        if size is None:
            raise CalibrationError("--size: expected the width and height of the images")
        if config.from_ == "droid":
            vector = None
            if config.extrinsics is not None:
                vector = importers.numbers_or_file(config.extrinsics, "--extrinsics").ravel()
            cameras = importers.from_droid(source, name, vector, K, size, config.euler)
            return {key: _changed_pose(camera, config) for key, camera in cameras.items()}
        if config.extrinsics is None:
            raise CalibrationError("--extrinsics: expected a .npy file of 4 x 4 numbers")
        pose = importers.numbers_or_file(config.extrinsics, "--extrinsics")
        pose = pose.reshape(-1, 4) if pose.ndim == 1 and pose.size in (12, 16) else pose
        return importers.from_arrays(name, K, pose, size, axes=config.axes, inverse=config.inverse)
    finally:
        if source is not None:
            source.close()


def run_calibrate(config: Calibrate, console: Console) -> int:
    if config.out.exists():
        raise OutputError(f"{config.out} exists and is not overwritten; choose another --out")
    calibration = make_calibration(config)
    with disk_full(config.out, "nothing has been written; make room, or choose another --out"):
        calib.save(calibration, config.out)
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("camera", "images", "focal length", "at (m)", "looks along", "flip", "poses"):
        table.add_column(column)
    for name, camera in calibration.cameras.items():
        pose = camera.cam_to_base
        table.add_row(
            escape(name),
            f"{camera.width} x {camera.height}",
            f"{camera.K[0, 0]:.1f}, {camera.K[1, 1]:.1f}",
            ", ".join(f"{value:.3f}" for value in pose[:3, 3]),
            ", ".join(f"{value:.2f}" for value in pose[:3, 2]),
            camera.flip,
            str(1 + len(camera.by_episode)),
        )
    console.print(table)
    console.print(f"written: {config.out}; now `data check`", markup=False)
    return 0


# -- check -----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Check:
    """Does a calibration fit the images? Reprojects the TCP, draws it, finds the usual mistakes.

    Attributes:
      file: robomimic HDF5 file, or folder of a LeRobot v3 data set.
      calibration: calibration.json.
      camera: name; by default the only one with images.
      out: the sheet of overlays; by default FILE-CAMERA.png in the current folder. It replaces an
        older sheet, nothing else.
      least_in_view: share of frames that must show the TCP.
      pixels: key of measured pixels of the TCP; by default CAMERA_tcp_uv, if there is one.
    """

    file: File
    calibration: Path
    camera: str | None = None
    out: Path | None = None
    least_in_view: float = LEAST_IN_VIEW
    pixels: str | None = None


def run_check(config: Check, console: Console) -> int:
    with open_recording(config.file, config.calibration, camera=config.camera) as recording:
        name = records.file_word(recording.camera.name)
        out = config.out or Path(f"{config.file.stem}-{name}.png")
        check.check_sheet(out, config.file)
        report = check.check(recording, least=config.least_in_view, pixels=config.pixels)
        spec = aligning.paper_spec(recording.camera.height)
        with disk_full(out, "the sheet was not written"):
            check.sheet(recording, report, spec, out)
    _print_report(console, recording, report)
    console.print(f"sheet: {out}", markup=False)
    return 0 if report.problem is None else 1


def _print_report(console: Console, recording: Recording, report: check.Report) -> None:
    survey, evidence = report.survey, report.motion
    console.print(
        f"{survey.episodes} episodes, {survey.frames} frames: TCP in the image in "
        f"{survey.in_view:.1%}, behind the camera in {survey.behind:.1%}; least in "
        f"{survey.worst} ({survey.worst_share:.1%})",
        markup=False,
    )
    low, high = survey.opening
    console.print(f"gripper: {recording.keys.opening}, {low:.0%} to {high:.0%} open", markup=False)
    if report.reprojection is not None:
        error = report.reprojection
        console.print(
            f"reprojection error against {error.key}: mean {error.mean:.3f} px, at most "
            f"{error.most:.3f} px, over {error.frames} frames",
            markup=False,
        )
    if not evidence.tells:
        console.print(
            "the images move too little to tell whether they are flipped: look at the sheet"
        )
    table = Table(
        box=box.SIMPLE_HEAD, title="Do the images move with the TCP?", title_justify="left"
    )
    for column in ("correlation", "in the image", "reading"):
        table.add_column(column)
    now = evidence.as_is
    shown = [(now, "as calibrated")]
    shown += [(f, check.told(f.reading, recording.camera.flip)) for f in evidence.others[:4]]
    shown.sort(key=lambda entry: -entry[0].score)
    for finding, text in shown:
        if finding is not now and abs(finding.score - now.score) < 1e-6:
            continue  # the same pixels by other words
        style = "bold" if finding is evidence.best else None
        table.add_row(f"{finding.score:.2f}", f"{finding.in_view:.0%}", escape(text), style=style)
    if evidence.pairs:
        console.print(table)
    if report.problem is None:
        console.print("good" if evidence.tells else "nothing wrong found", style="bold")
    else:
        name = type(report.problem).__name__
        console.print(f"{name}: {report.problem}", markup=False, style="bold red")


# -- align -----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Align:
    """Write PALM's images, proprioception and labels as new keys into a new file. Resumable.

    Sizes in pixels that are not given are the paper's, scaled from its 512 rows.

    Attributes:
      file: robomimic HDF5 file, or folder of a LeRobot v3 data set.
      calibration: calibration.json.
      out: the new file or folder; nothing is overwritten.
      camera: name; by default the only one with images.
      crop: pixels per side of the TCP-centred window, in the camera's image.
      full_frame: no crop: the whole frame, resized (plain behaviour cloning).
      offset: pixels from the TCP to the window's middle, right and down.
      size: pixels per side of the policy's image.
      overlay: draw the TCP's axes.
      layout: of the proprioception.
      border: what happens where the window leaves the frame.
      axis_length: of the overlay, metres.
      spec: fields of AlignSpec as JSON, in a file or here; they override the options above.
      format: of the output; by default the input's.
      keep: of the source: numbers (all but images), all, or none.
      compression: of the images in HDF5.
      encoding: of the images in LeRobot: png (exact), h264 or av1 (lossy).
      prefix: of the new keys.
      instead: under the names that learners look for (actions; action, observation.state); what
        was there is kept as source_*.
      transitions: frames with so many largest motions of an episode become the identity.
      least_in_view: share of frames that must show the TCP.
      trust: skip looking at the images, at pixels measured in them and at the gripper's range for a
        wrong calibration.
    """

    file: File
    calibration: Path
    out: Path
    camera: str | None = None
    crop: int | None = None
    full_frame: bool = False
    offset: tuple[int, int] | None = None
    size: int = 84
    overlay: bool = True
    layout: Literal["cam6d_z", "world6d_xyz", "cam6d_xyz", "world6d_z", "z"] = "cam6d_z"
    border: Literal["shift", "edge", "constant"] = "shift"
    axis_length: float = 0.1
    spec: str | None = None
    format: Literal["robomimic", "lerobot"] | None = None
    keep: Literal["numbers", "all", "none"] = "numbers"
    compression: Literal["gzip", "lzf", "none"] = "gzip"
    encoding: Literal["png", "h264", "av1"] = "png"
    prefix: str = "palm"
    instead: bool = False
    transitions: int = 0
    least_in_view: float = LEAST_IN_VIEW
    trust: bool = False


def make_spec(config: Align, height: int) -> AlignSpec:
    """The spec that the options describe, for frames of `height` rows.

    Raises:
      DataError: `--spec` is not what it should be.
      OptionError: a value that no image can satisfy.
    """
    fields: dict[str, Any] = {
        "size": config.size,
        "overlay": config.overlay,
        "layout": config.layout,
        "border": config.border,
        "axis_length": config.axis_length,
    }
    if config.crop is not None or config.full_frame:
        fields["crop"] = None if config.full_frame else config.crop
    if config.offset is not None:
        fields["offset"] = config.offset
    return aligning.paper_spec(height, **(fields | _spec_json(config.spec)))


def _spec_json(text: str | None) -> dict[str, Any]:
    if text is None:
        return {}
    try:
        content = json.loads(text if text.lstrip().startswith("{") else Path(text).read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"--spec: expected JSON or a file of it ({error})") from error
    known = {field.name: field.default for field in dataclasses.fields(AlignSpec)}
    if not isinstance(content, dict) or not set(content) <= set(known):
        raise DataError(f"--spec: expected an object with some of {', '.join(sorted(known))}")
    for name, value in content.items():
        if not (_like(value, known[name]) or (name == "crop" and value is None)):
            raise DataError(f"--spec: {name}: expected a value like {known[name]!r}, got {value!r}")
    return content


def _like(value: Any, default: Any) -> bool:
    """Whether a value of JSON is of a default's kind; a whole number is also a number."""
    if isinstance(default, tuple):
        return isinstance(value, list) and len(value) == len(default) and all(map(is_number, value))
    if isinstance(default, float):
        return is_number(value)
    return type(value) is type(default)


def run_align(config: Align, console: Console) -> int:
    options = job.Options(
        config.format, config.keep, config.compression, config.encoding, config.prefix,
        config.instead, config.transitions,
    )  # fmt: skip
    with open_recording(config.file, config.calibration, camera=config.camera) as recording:
        spec = make_spec(config, recording.camera.height)
        total = sum(recording.source.length(name) for name in recording.source.episodes)
        with terminal.ProgressBar(console, total, "align", unit="frame") as bar:
            result = job.align_file(
                recording, spec, config.out, options,
                least=config.least_in_view, trust=config.trust, progress=bar.advance,
            )  # fmt: skip
    if result.resumed:
        console.print(f"{result.resumed} episodes had been finished before")
    console.print(
        f"{result.episodes} episodes, {result.frames} frames, TCP in the image in "
        f"{result.in_view:.1%}; crop {spec.crop}, {spec.size} x {spec.size} pixels, "
        f"{spec.proprio_size} numbers ({spec.layout})",
        markup=False,
    )
    for key, why in result.skipped.items():
        console.print(f"not kept: {key} ({why})", markup=False)
    console.print(f"written: {result.path}", markup=False)
    return 0


# -- verify, repair --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Verify:
    """Is a data file whole? Reads everything; of videos it counts the frames.

    Attributes:
      file: robomimic HDF5 file, or folder of a LeRobot v3 data set.
      calibration: calibration.json, if only it tells the robot's keys.
    """

    file: File
    calibration: Path | None = None


def run_verify(config: Verify, console: Console) -> int:
    robot = _robot(config.calibration)
    problems = soundness.verify(config.file, robot=robot)
    _print_unread(config.file, robot, console)
    for name, texts in problems.items():
        for text in texts:
            console.print(f"{name or config.file}: {text}", markup=False)
    if problems:
        told = f" --calibration {config.calibration}" if config.calibration is not None else ""
        console.print(
            f"`python -m palm_jax data repair {config.file}{told} --out NEW` saves the sound "
            "episodes",
            markup=False,
        )
        return 1
    console.print(f"{config.file}: sound", markup=False)
    return 0


def _print_unread(path: Path, robot: RobotKeys | None, console: Console) -> None:
    reason = soundness.unread(path, robot=robot)
    if reason:
        console.print(f"note: poses were not looked at; pass --calibration. {reason}", markup=False)


@dataclasses.dataclass(frozen=True)
class Repair:
    """Copy the sound episodes of a file into a new one.

    Attributes:
      file: robomimic HDF5 file, or folder of a LeRobot v3 data set; never touched.
      out: the new one; nothing is overwritten.
      calibration: calibration.json, if only it tells the robot's keys.
    """

    file: File
    out: Path
    calibration: Path | None = None


def run_repair(config: Repair, console: Console) -> int:
    calibration = None if config.calibration is None else calib.load(config.calibration)
    robot = None if calibration is None else calibration.robot
    result = soundness.repair(config.file, config.out, robot=robot)
    _print_unread(config.file, robot, console)
    for name, reason in result.dropped.items():
        console.print(f"left out {name}: {reason}", markup=False)
    console.print(f"{len(result.kept)} episodes written: {result.path}", markup=False)
    if any(old != new for old, new in result.numbers.items()):
        _follow_numbers(result, calibration, console)
    return 0


def _follow_numbers(
    result: soundness.Repair, calibration: Calibration | None, console: Console
) -> None:
    """Says how LeRobot's episodes are numbered anew, and lets the calibration follow."""
    numbers, meta = result.numbers, result.path / "meta"
    pairs = [f"{old} is now {new}" for old, new in numbers.items() if old != new]
    told = ", ".join(pairs[:3]) + (", ..." if len(pairs) > 3 else "")
    console.print(f"episodes are numbered anew: {told} (all in {meta / 'palm.json'})", markup=False)
    if calibration is None:
        console.print(
            "a calibration with poses by_episode must follow: repeat with --calibration C",
            markup=False,
        )
        return
    for camera in calibration.cameras.values():
        for name in camera.by_episode:
            now = f"is now {numbers[name]}" if name in numbers else "was left out"
            console.print(f"cameras.{camera.name}.by_episode: {name} {now}", markup=False)
    path = meta / "calibration.json"
    with disk_full(path, "the episodes are written, their calibration is not"):
        calib.save(calibration.renumbered(numbers), path)
    console.print(f"written: {path}, for the new numbers", markup=False)


def _robot(calibration: Path | None) -> RobotKeys | None:
    return None if calibration is None else calib.load(calibration).robot


# -- the command -----------------------------------------------------------------------------------

COMMANDS: dict[str, tuple[type, Callable[[Any, Console], int]]] = {
    "inspect": (Inspect, run_inspect),
    "calibrate": (Calibrate, run_calibrate),
    "check": (Check, run_check),
    "align": (Align, run_align),
    "verify": (Verify, run_verify),
    "repair": (Repair, run_repair),
}


def usage() -> str:
    """The text of `--help`."""
    width = max(map(len, COMMANDS))
    lines = [
        f"  {name:<{width}}  {(config.__doc__ or '').splitlines()[0]}"
        for name, (config, _) in COMMANDS.items()
    ]
    return (
        "usage: python -m palm_jax data COMMAND [options]\n\n"
        + "\n".join(lines)
        + "\n\n`python -m palm_jax data COMMAND --help` lists the options.\n"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(usage())
        return 0
    if words[0] not in COMMANDS:
        near = difflib.get_close_matches(words[0], COMMANDS, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        print(f"error: unknown command {words[0]!r}.{hint}\n\n{usage()}", file=sys.stderr, end="")
        return 2
    kind, run = COMMANDS[words[0]]
    config: Any = tyro.cli(kind, args=words[1:], prog=f"python -m palm_jax data {words[0]}")
    console = terminal.make_console()
    try:
        with interrupts.raising():
            return run(config, console)
    except (DataError, OptionError) as error:
        print(f"error: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        saved = "finished episodes" if words[0] == "align" else ""
        terminal.interrupted(console, ["python", "-m", "palm_jax", "data", *words], saved=saved)
        return interrupts.leave(stop)
