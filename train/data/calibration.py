"""`calibration.json`: where the cameras of a data file are, and how its poses are to be read.

::

    {"format": "palm-calib/1", "axes": "opencv",
     "cameras": {"front": {"K": 3x3, "width": 640, "height": 480, "dist": null,
                           "mount": "static", "flip": "none", "image": null,
                           "T_base_cam": 4x4, "by_episode": {"demo_7": 4x4},
                           "off_centre": 0.15}},
     "T_ee_tcp": 4x4,
     "robot": {"pose": "robot0_eef_pos+robot0_eef_quat", "rotation": "quat_xyzw",
               "opening": "robot0_gripper_qpos", "closed": 0.0, "open": 0.04},
     "made_from": "robosuite: camera_info of lift.hdf5"}

- `T_base_cam` is the camera's pose (camera to base, OpenCV axes: x right, y down, z forward). The
  base is the frame in which the file's poses are given, with z up: robosuite's world, a real
  robot's base.
- `K` is in pixels of a width x height image, (0, 0) the corner of the first pixel.
- `flip` turns the stored images upright: none, ud, lr, 180, cw or ccw (a quarter turn).
- `image` names the key of the camera's images where its own name does not tell.
- `off_centre` is how far K's principal point may lie from the middle, as a share of the image:
  further off, K is taken for that of another resolution. Cropped images need more.
- `by_episode` holds the camera's pose in the episodes in which it was another one.
- `T_ee_tcp` is the TCP in the frame of the recorded poses: origin between the finger pads, z the
  approach direction, y the opening axis (docs/conventions.md).
- `robot` may be absent or have nulls where the keys are known ones (`recording.KNOWN_POSES`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax._checks import (
    OFF_CENTRE,
    CameraError,
    PoseError,
    check_centre,
    check_intrinsics,
    check_pose,
)
from palm_jax.align import Camera
from palm_jax.align.lens import LENGTHS
from palm_jax.train.data import rotations
from palm_jax.train.data.errors import CalibrationError, CameraNameError, ImageSizeError
from palm_jax.train.data.headers import is_number
from palm_jax.train.files.metrics import plain, write_json

FORMAT = "palm-calib/1"

FLIPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": lambda images: images,
    "ud": lambda images: images[..., ::-1, :, :],
    "lr": lambda images: images[..., :, ::-1, :],
    "180": lambda images: images[..., ::-1, ::-1, :],
    "cw": lambda images: np.swapaxes(images, -3, -2)[..., :, ::-1, :],
    "ccw": lambda images: np.swapaxes(images, -3, -2)[..., ::-1, :, :],
}
"""Name -> what makes stored images [..., H, W, 3] upright (views)."""

AXES = {
    "opencv": np.diag([1.0, 1.0, 1.0, 1.0]),
    "opengl": np.diag([1.0, -1.0, -1.0, 1.0]),
    "coppelia": np.diag([-1.0, -1.0, 1.0, 1.0]),
}
"""Camera axes of others -> what a pose with such axes is multiplied by, on the right."""


def as_opencv(pose: np.ndarray, axes: str, inverse: bool) -> np.ndarray:
    """A camera's poses in the base, OpenCV axes, out of what others store.

    Args:
      pose: [..., 4, 4].
      axes: of its camera, a key of `AXES`.
      inverse: it maps the base into the camera.
    """
    return (rotations.inverted(pose) if inverse else pose) @ AXES[axes]


def turned(flip: str, width: int, height: int) -> tuple[int, int]:
    """Width and height of the images as stored, for an upright image of this size."""
    return (height, width) if flip in ("cw", "ccw") else (width, height)


@dataclasses.dataclass(frozen=True)
class CameraCalibration:
    """One camera. Its values are checked when it is made.

    Attributes:
      name: of the camera.
      K: [3, 3] intrinsics, pixels of a width x height image.
      width, height: of the upright image.
      cam_to_base: [4, 4] pose, OpenCV axes.
      dist: None, or 4, 5 or 8 lens coefficients (OpenCV's).
      flip: what turns the stored images upright, a key of `FLIPS`.
      image: key of the images in the data; None: found by the camera's name.
      by_episode: poses [4, 4] of the episodes in which it differs.
      off_centre: how far the principal point may lie from the middle, as a share of the image:
        further off, K is taken for that of another resolution (`Calibration` checks it).

    Raises:
      CalibrationError: a value that no camera has; the message names it.
    """

    name: str
    K: np.ndarray
    width: int
    height: int
    cam_to_base: np.ndarray
    dist: tuple[float, ...] | None = None
    flip: str = "none"
    image: str | None = None
    by_episode: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    off_centre: float = OFF_CENTRE

    def __post_init__(self) -> None:
        where = f"cameras.{self.name}"
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise CalibrationError(f"{where}.{name}: expected a number of pixels, got {value}")
        if not is_number(self.off_centre) or self.off_centre < 0:
            raise CalibrationError(
                f"{where}.off_centre: expected a share of the image, got {self.off_centre!r}"
            )
        if not isinstance(self.flip, str) or self.flip not in FLIPS:
            raise CalibrationError(
                f"{where}.flip: expected one of {', '.join(FLIPS)}; got {self.flip!r}"
            )
        if self.dist is not None and len(self.dist) not in LENGTHS:
            raise CalibrationError(
                f"{where}.dist: expected null or {', '.join(map(str, LENGTHS))} coefficients (k1, "
                f"k2, p1, p2[, k3[, k4, k5, k6]]), got {len(self.dist)}"
            )
        if self.dist is not None and not all(map(is_number, self.dist)):
            raise CalibrationError(f"{where}.dist: expected finite numbers, got {self.dist}")
        if self.image is not None and not isinstance(self.image, str):
            raise CalibrationError(f"{where}.image: expected a key, got {self.image!r}")
        self._check_intrinsics(f"{where}.K")
        _checked_pose(self.cam_to_base, f"{where}.T_base_cam")
        for episode, pose in self.by_episode.items():
            _checked_pose(pose, f"{where}.by_episode.{episode}")

    def _check_intrinsics(self, where: str) -> None:
        if np.shape(self.K) != (3, 3):
            raise CalibrationError(f"{where}: expected 3 x 3 numbers, got {np.shape(self.K)}")
        try:
            check_intrinsics(self.K, where)
        except CameraError as error:
            raise CalibrationError(str(error)) from error

    def check_centre(self) -> None:
        """Raises where K is that of another resolution.

        Raises:
          ImageSizeError: the principal point is further off the middle than `off_centre`.
        """
        advice = (
            "K belongs to another resolution: give the size that was calibrated (--size), and the "
            "size of the images with --rescale; for images cropped to one side: --off-centre SHARE"
        )
        try:
            check_centre(
                self.K, self.height, self.width, self.off_centre, f"cameras.{self.name}.K", advice
            )
        except CameraError as error:
            raise ImageSizeError(str(error)) from error

    def camera(self, episode: str | None = None) -> Camera:
        """The pinhole camera of the upright, undistorted images of an episode."""
        pose = self.cam_to_base if episode is None else self.by_episode.get(episode, None)
        pose = self.cam_to_base if pose is None else pose
        return Camera(
            np.asarray(self.K, np.float32), np.asarray(pose, np.float32), self.height, self.width
        )

    def rescaled(self, width: int, height: int) -> CameraCalibration:
        """The same camera for images that were resized to another number of pixels.

        Raises:
          ImageSizeError: another aspect ratio: the images were cropped or padded as well.
        """
        across, down = width / self.width, height / self.height
        # Sizes are rounded: the two factors may differ by a pixel.
        if abs(across - down) * max(self.width, self.height) > 1.0 + 1e-9:
            raise ImageSizeError(
                f"cameras.{self.name}: expected images of the calibrated shape "
                f"{self.width} x {self.height}, got {width} x {height}: they were cropped or "
                "padded, not only resized; calibrate with such images, or move K's principal point "
                "by the margin that was cut off, and give that size"
            )
        scale = np.array([[across], [down], [1.0]])
        return dataclasses.replace(self, K=self.K * scale, width=width, height=height)

    def upright(self, images: np.ndarray) -> np.ndarray:
        """Stored images [..., h, w, 3] turned upright: [..., height, width, 3].

        Raises:
          ImageSizeError: images of another size than the calibration's.
        """
        width, height = turned(self.flip, self.width, self.height)
        got_height, got_width = images.shape[-3:-1]
        if (got_width, got_height) != (width, height):
            turned_by = "; if they were turned by a quarter: --flip cw or ccw instead"
            also = (
                turned_by if (got_height, got_width) == (width, height) != (height, width) else ""
            )
            raise ImageSizeError(
                f"cameras.{self.name}: expected images of {width} x {height} pixels (width x "
                f"height), as calibrated, got {got_width} x {got_height}; if they were resized: "
                f"`data calibrate --from palm --file C --camera {shlex.quote(self.name)} --rescale "
                f"{got_width} {got_height} --out NEW`"
                f"{also}"
            )
        return FLIPS[self.flip](images)


@dataclasses.dataclass(frozen=True)
class RobotKeys:
    """Which keys of the data hold the robot's pose and its gripper, and how to read them.

    Attributes:
      pose: key, `key[a:b]`, or several joined with "+": position, then orientation.
      rotation: one of `rotations.NAMES`.
      opening: key (or `key[a:b]`) of the gripper.
      closed, open: its value when closed and when open (the mean of the absolute values, if there
        are several).

    Raises:
      CalibrationError: a value of another kind.
    """

    pose: str | None = None
    rotation: str | None = None
    opening: str | None = None
    closed: float | None = None
    open: float | None = None

    def __post_init__(self) -> None:
        for name in ("pose", "rotation", "opening"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                raise CalibrationError(f"robot.{name}: expected a text, got {value!r}")
        for name in ("closed", "open"):
            value = getattr(self, name)
            if value is not None and not is_number(value):
                raise CalibrationError(f"robot.{name}: expected a finite number, got {value!r}")
        if self.rotation is not None and self.rotation not in rotations.NAMES:
            raise CalibrationError(
                f"robot.rotation: expected one of {', '.join(rotations.NAMES)}; got "
                f"{self.rotation!r}"
            )


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Everything in a `calibration.json`.

    Attributes:
      cameras: by name.
      ee_to_tcp: [4, 4] the TCP in the frame of the recorded poses.
      robot: where the data has the robot's pose.
      made_from: in words.
    """

    cameras: Mapping[str, CameraCalibration]
    ee_to_tcp: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    robot: RobotKeys = RobotKeys()
    made_from: str = ""

    def __post_init__(self) -> None:
        if not self.cameras:
            raise CalibrationError("cameras: expected at least one, got none")
        for camera in self.cameras.values():
            camera.check_centre()
        _checked_pose(self.ee_to_tcp, "T_ee_tcp")

    def camera(self, name: str) -> CameraCalibration:
        """A camera by its name.

        Raises:
          CameraNameError: not in the calibration.
        """
        if name not in self.cameras:
            raise CameraNameError(
                f"camera {name!r} is not in the calibration, which has "
                f"{', '.join(sorted(self.cameras))}"
            )
        return self.cameras[name]

    def find(self, name: str | None, image_keys: Iterable[str]) -> tuple[CameraCalibration, str]:
        """A camera of this calibration and the key of its images.

        Args:
          name: of the camera; None: the only one that has images.
          image_keys: those that the data file has.

        Raises:
          CameraNameError: not in the calibration, without images, or several to choose from.
        """
        keys = list(image_keys)
        wanted = [self.camera(name).name] if name is not None else list(self.cameras)
        found = {n: key for n in wanted if (key := image_key(self.cameras[n], keys)) is not None}
        if len(found) == 1:
            ((only, key),) = found.items()
            return self.cameras[only], key
        if found:
            raise CameraNameError(
                f"several cameras have images: {', '.join(found)}; choose one with --camera"
            )
        raise CameraNameError(
            f"the file has no images of {' or '.join(map(repr, wanted))}: it has "
            f"{', '.join(keys) or 'none at all'}; rename the camera in the calibration, or give it "
            'the key of its images as "image"'
        )

    def renumbered(self, numbers: Mapping[str, str]) -> Calibration:
        """The same for a file whose episodes have other names.

        Args:
          numbers: old name -> new name of the episodes that are still there.
        """

        def moved(camera: CameraCalibration) -> CameraCalibration:
            poses = camera.by_episode.items()
            kept = {numbers[name]: pose for name, pose in poses if name in numbers}
            return dataclasses.replace(camera, by_episode=kept)

        cameras = {name: moved(camera) for name, camera in self.cameras.items()}
        return dataclasses.replace(self, cameras=cameras)

    def to_json(self) -> dict[str, Any]:
        """The content of the file."""
        cameras = {
            name: {
                "K": camera.K,
                "width": camera.width,
                "height": camera.height,
                "dist": camera.dist,
                "mount": "static",
                "flip": camera.flip,
                "image": camera.image,
                "T_base_cam": camera.cam_to_base,
                "by_episode": camera.by_episode,
                "off_centre": camera.off_centre,
            }
            for name, camera in self.cameras.items()
        }
        content: dict[str, Any] = plain(
            {
                "format": FORMAT,
                "axes": "opencv",
                "cameras": cameras,
                "T_ee_tcp": self.ee_to_tcp,
                "robot": self.robot,
                "made_from": self.made_from,
            }
        )
        return content

    @property
    def sha256(self) -> str:
        """Of the content, whatever the layout of the file; `made_from` does not count."""
        content = self.to_json() | {"made_from": ""}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def short_names(key: str) -> set[str]:
    """The names under which a key of images may be asked for: whole, without where it lies, and
    without the ending that says image."""
    last = key.split("/")[-1]
    for prefix in ("observation.images.", "observation.image.", "observation."):
        last = last.removeprefix(prefix)
    ends = ("_image", "_rgb", ".image", ".rgb")
    return {key, last, *(last.removesuffix(end) for end in ends)} - {""}


def image_key(camera: CameraCalibration, keys: Iterable[str]) -> str | None:
    """The key of a camera's images among those of a file, or None."""
    wanted = camera.image or camera.name
    keys = list(keys)
    if wanted in keys:
        return wanted
    near = [key for key in keys if wanted in short_names(key)]
    return near[0] if len(near) == 1 else None


def _checked_pose(pose: Any, where: str) -> np.ndarray:
    if np.shape(pose) != (4, 4):
        raise CalibrationError(f"{where}: expected 4 x 4 numbers, got {np.shape(pose)}")
    try:
        check_pose(pose, where)
    except PoseError as error:
        raise CalibrationError(str(error)) from error
    return np.asarray(pose, np.float64)


def save(calibration: Calibration, path: Path) -> Path:
    """Writes the file, atomically."""
    return write_json(path, calibration.to_json())


def load(path: Path) -> Calibration:
    """Reads and checks a `calibration.json`.

    Raises:
      CalibrationError: missing, not JSON, of another format, or with a value that cannot be; the
        message names the field.
    """
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise CalibrationError(
            f"{path}: no such file; make one: `python -m palm_jax data calibrate --from robosuite|"
            f"mujoco|maniskill|droid|npy ... --out {path}`"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not a readable JSON file ({error})") from error
    try:
        return from_json(content)
    except CalibrationError as error:
        raise type(error)(f"{path}: {error}") from error


def from_json(content: Any) -> Calibration:
    """The inverse of `Calibration.to_json`, with checks.

    Raises:
      CalibrationError: see `load`.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise CalibrationError(f"format: expected {FORMAT!r}, got {found!r}")
    if content.get("axes") != "opencv":
        raise CalibrationError(
            f"axes: expected 'opencv' (x right, y down, z forward), got {content.get('axes')!r}; "
            "`data calibrate --axes opengl|coppelia` converts"
        )
    cameras = _object(content.get("cameras"), "cameras")
    robot = _object(content.get("robot") or {}, "robot")
    unknown = set(robot) - {field.name for field in dataclasses.fields(RobotKeys)}
    if unknown:
        raise CalibrationError(f"robot: unknown entries {', '.join(sorted(unknown))}")
    return Calibration(
        {name: _camera(name, entry) for name, entry in cameras.items()},
        _array(content.get("T_ee_tcp", np.eye(4).tolist()), "T_ee_tcp"),
        RobotKeys(**robot),
        str(content.get("made_from", "")),
    )


def _camera(name: str, entry: Any) -> CameraCalibration:
    where = f"cameras.{name}"
    entry = _object(entry, where)
    if entry.get("mount", "static") != "static":
        raise CalibrationError(
            f"{where}.mount: expected 'static', got {entry['mount']!r}; PALM aligns the images of "
            "a camera that stands still (a wrist camera moves with the TCP and needs no alignment)"
        )
    for key in ("K", "width", "height", "T_base_cam"):
        if entry.get(key) is None:
            raise CalibrationError(f"{where}.{key}: missing")
    dist = entry.get("dist")
    return CameraCalibration(
        name=name,
        K=_array(entry["K"], f"{where}.K"),
        width=entry["width"],
        height=entry["height"],
        cam_to_base=_array(entry["T_base_cam"], f"{where}.T_base_cam"),
        dist=None if dist is None else tuple(_array(dist, f"{where}.dist").ravel().tolist()),
        flip=entry.get("flip", "none"),
        image=entry.get("image"),
        by_episode={
            episode: _array(pose, f"{where}.by_episode.{episode}")
            for episode, pose in _object(
                entry.get("by_episode") or {}, f"{where}.by_episode"
            ).items()
        },
        off_centre=entry.get("off_centre", OFF_CENTRE),
    )


def _object(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise CalibrationError(f"{where}: expected an object, got {type(value).__name__}")
    return value


def _array(value: Any, where: str) -> np.ndarray:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{where}: expected numbers ({error})") from error
    if not np.isfinite(array).all():
        raise CalibrationError(f"{where}: expected finite numbers")
    return array
