"""A data file seen through one calibrated camera: trajectories of the TCP, and where they appear.

Nothing here reads images; a whole file is surveyed in seconds before the first of them is touched.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from palm_jax._checks import PoseError, check_pose
from palm_jax.align import Camera
from palm_jax.train.data import calibration as calib
from palm_jax.train.data import rotations
from palm_jax.train.data.calibration import Calibration, CameraCalibration, RobotKeys
from palm_jax.train.data.errors import (
    CalibrationError,
    DataError,
    EpisodeLengthError,
    EulerAmbiguityError,
    FormatError,
    KeyMissingError,
    OpeningError,
    PoseDataError,
    TcpBehindCameraError,
    TcpOutOfViewError,
)
from palm_jax.train.data.source import Source, open_source

KNOWN_POSES = {
    "robot0_eef_pos+robot0_eef_quat": "quat_xyzw",  # robosuite
    "palm_tcp": "matrix",  # what `data align` has written
    "tcp": "matrix",  # this package's own demonstrations
}
"""Keys that are understood without being told -> how their orientation reads."""

KNOWN_OPENINGS = {
    "robot0_gripper_qpos": (2, 0.0, 0.04),  # robosuite's Panda: metres a finger
    "palm_opening": (1, 0.0, 1.0),  # what `data align` has written
    "opening": (1, 0.0, 1.0),  # this package's own demonstrations
    "gripper_position": (1, 1.0, 0.0),  # DROID: 0 open, 1 closed
}
"""Key -> number of columns, value when closed, value when open."""

LEAST_IN_VIEW = 0.75
"""Share of frames that must show the TCP, unless told otherwise."""

OUTSIDE = 0.25
"""How far beyond closed and open a gripper's values may be, as a share of the range between."""

STILL, HELD = 0.05, 0.2
"""A gripper that is never further open, as a share of that range, is closed throughout; one that
varies by less, as a share of its opening, holds something throughout."""


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """The robot in one episode of T frames."""

    tcp: np.ndarray  # [T, 4, 4] float64, base
    opening: np.ndarray  # [T] float64, 0 closed to 1 open
    reach: tuple[float, float]  # least and most of the opening before it was limited to 0..1


@dataclasses.dataclass(frozen=True)
class Survey:
    """Where the TCP appears, over all frames."""

    episodes: int
    frames: int
    in_view: float  # share of frames with the TCP in front of the camera, inside the image
    behind: float  # share with the TCP behind the camera
    worst: str  # the episode with the smallest share in view
    worst_share: float
    opening: tuple[float, float]  # least and most of the gripper, 0 closed to 1 open, not clipped


def gripper_values(numbers: np.ndarray) -> np.ndarray:
    """[T] one number a frame of a gripper's columns [T, n]: itself, or the mean absolute value of
    several fingers, which move with opposite signs."""
    return numbers[:, 0] if numbers.shape[1] == 1 else np.abs(numbers).mean(1)


def projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """uv [T, 2] (NaN behind the camera) and depth [T] of points [T, 3] in the base's frame.

    `palm_jax.align.project` in NumPy: episodes have all lengths, and it would compile for each.
    """
    pose = np.asarray(camera.cam_to_world, np.float64)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = (local / depth[:, None]) @ np.asarray(camera.K, np.float64)[:2].T
    return np.where((depth > 1e-4)[:, None], uv, np.nan), depth


def inside(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """[T] bool: uv [T, 2] lies on a pixel of the image."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((uv >= 0) & (uv < [camera.width, camera.height])).all(-1))


class Recording:
    """A source and one camera of a calibration, checked against each other.

    Attributes:
      source: the data.
      calibration: all of it.
      camera: the calibrated camera.
      image_key: of its images in the data.
      keys: where the data has the robot's pose and gripper, nothing left open.

    Raises:
      CameraNameError, ImageSizeError: see `Calibration.find`, `CameraCalibration.upright`.
      CalibrationError: the camera has poses of episodes that are not in the data.
      KeyMissingError, EulerAmbiguityError, OpeningError: the robot's keys are unknown.
    """

    def __init__(self, source: Source, calibration: Calibration, camera: str | None = None):
        self.source, self.calibration = source, calibration
        self.camera, self.image_key = calibration.find(camera, source.image_keys)
        height, width, _ = source.features()[self.image_key].shape
        self.camera.upright(np.empty((0, height, width, 3), np.uint8))
        _check_episodes(source, self.camera)
        self.keys = robot_keys(source, calibration.robot)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.source.close()

    def trajectory(self, episode: str) -> Trajectory:
        """The robot's path in an episode.

        Raises:
          EpisodeLengthError, PoseDataError, FormatError: see `trajectory_of`.
          DataError: see `Source.columns`.
        """
        numbers, gripper = robot_columns(self.source, episode, self.keys)
        try:
            hand = trajectory_of(self.keys, numbers, gripper, self.source.length(episode))
        except (EpisodeLengthError, PoseDataError, FormatError) as error:
            raise type(error)(
                f"{self.source.path}: {episode}: {error}; leave the episode out: `python -m "
                f"palm_jax data repair {self.source.path} --calibration C --out NEW`, or mend it "
                "where it was made"
            ) from error
        return dataclasses.replace(hand, tcp=hand.tcp @ self.calibration.ee_to_tcp)

    def survey(self, episodes: Iterable[str] | None = None) -> Survey:
        """Reads every pose and tells where the TCP appears.

        Raises:
          EpisodeLengthError, PoseDataError: see `trajectory`.
        """
        names = list(self.source.episodes if episodes is None else episodes)
        shares: list[float] = []
        behind = seen = frames = 0
        reached: list[float] = []
        for name in names:
            camera = self.camera.camera(name)
            hand = self.trajectory(name)
            uv, depth = projected(camera, hand.tcp[:, :3, 3])
            visible = inside(camera, uv)
            shares.append(float(visible.mean()))
            behind += int((depth <= 1e-4).sum())
            seen, frames = seen + int(visible.sum()), frames + len(uv)
            reached += hand.reach
        worst = int(np.argmin(shares))
        return Survey(
            len(names), frames, seen / frames, behind / frames, names[worst], shares[worst],
            (min(reached), max(reached)),
        )  # fmt: skip

    def check_opening(self, survey: Survey) -> None:
        """Raises where the gripper's values are not those between closed and open.

        Raises:
          OpeningError: see `range_problem`.
        """
        problem = range_problem(self.keys, survey.opening)
        if problem:
            raise OpeningError(
                f"{self.source.path}: {problem}; change the calibration: `data calibrate --from "
                "palm --file C --closed VALUE --open VALUE --out NEW` (--trust if you know better)"
            )


def robot_columns(source: Source, episode: str, keys: RobotKeys) -> tuple[np.ndarray, np.ndarray]:
    """Pose [T, n] and gripper [T, m] of an episode, as the file has them.

    Raises:
      DataError: see `Source.columns`.
    """
    assert keys.pose and keys.opening
    return source.columns(episode, keys.pose), source.columns(episode, keys.opening)


def trajectory_of(
    keys: RobotKeys, numbers: np.ndarray, gripper: np.ndarray, length: int
) -> Trajectory:
    """The hand's path out of what a file has.

    Args:
      keys: nothing left open.
      numbers, gripper: see `robot_columns`.
      length: frames that the episode should have.

    Raises:
      EpisodeLengthError: fewer than two frames, or arrays of another length.
      PoseDataError: poses that are not finite or not rigid, a gripper that is not finite.
      FormatError: see `rotations.poses`.
    """
    assert keys.pose and keys.rotation and keys.opening
    if length < 2:
        raise EpisodeLengthError(f"expected at least two frames, a motion, got {length}")
    for key, values in ((keys.pose, numbers), (keys.opening, gripper)):
        if len(values) != length:
            raise EpisodeLengthError(f"expected {length} rows in {key}, got {len(values)}")
    try:
        poses = rotations.poses(numbers, keys.rotation)
    except (PoseDataError, FormatError) as error:
        raise type(error)(f"{keys.pose}: {error}") from error
    try:
        check_pose(poses, keys.pose)
    except PoseError:
        raise PoseDataError(f"{keys.pose}: {_first_problem(poses)}") from None
    if not np.isfinite(gripper).all():
        raise PoseDataError(f"{keys.opening} has NaN or infinity")
    opening = openness(keys, gripper)
    reach = float(opening.min()), float(opening.max())
    return Trajectory(poses, np.clip(opening, 0.0, 1.0), reach)


def openness(keys: RobotKeys, gripper: np.ndarray) -> np.ndarray:
    """[T] of the gripper's columns [T, m]: 0 where it is as when closed, 1 as when open."""
    assert keys.closed is not None and keys.open is not None
    return (gripper_values(gripper) - keys.closed) / (keys.open - keys.closed)


def range_problem(keys: RobotKeys, reach: tuple[float, float]) -> str:
    """Why values of the gripper do not fit the range from closed to open, or an empty string.

    Args:
      keys: nothing left open.
      reach: see `Trajectory`.
    """
    assert keys.closed is not None and keys.open is not None
    low, high = reach
    values = sorted(keys.closed + share * (keys.open - keys.closed) for share in reach)
    found = (
        f"{keys.opening} goes from {values[0]:.4g} to {values[1]:.4g}, with {keys.closed:g} for "
        f"closed and {keys.open:g} for open"
    )
    if low < -OUTSIDE or high > 1 + OUTSIDE:
        return f"{found}: far outside, all of it would count as closed or open"
    if STILL < high < 0.5 and high - low > HELD * high:
        return f"{found}: it moves, but is never half open, and would never count as open"
    return ""


def _check_episodes(source: Source, camera: CameraCalibration) -> None:
    """Raises where a camera has poses of episodes that a file neither has nor had."""
    known = {*source.episodes, *source.left_out}
    lacking = [name for name in camera.by_episode if name not in known]
    if not lacking:
        return
    anew = source.numbered_anew
    advice = f"rename them; the file has {_some(source.episodes)}"
    if anew:
        moved = _some([f"{old} is now {new}" for old, new in anew.items()])
        advice = (
            f"`data repair` has numbered the episodes anew ({moved}): give it the --calibration, "
            "and it writes one for the new file"
        )
    raise CalibrationError(
        f"cameras.{camera.name}.by_episode: expected names of episodes in {source.path}, got "
        f"{_some(lacking)}, whose poses would be left unused: {advice}"
    )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _first_problem(poses: np.ndarray) -> str:
    """What is wrong with the first of [T, 4, 4] that is no pose."""
    for frame, pose in enumerate(poses):
        try:
            check_pose(pose, f"frame {frame}")
        except PoseError as error:
            return str(error)
    return ""


def open_recording(
    path: Path, calibration: Calibration | Path, *, camera: str | None = None
) -> Recording:
    """Opens a data file with its calibration.

    Args:
      path: robomimic HDF5 file, or folder of a LeRobot v3 data set.
      calibration: or the path of its file.
      camera: name; None: the only one with images.

    Raises:
      DataError: see `open_source`, `calibration.load`, `Recording`.
    """
    checked = calibration if isinstance(calibration, Calibration) else calib.load(calibration)
    source = open_source(path)
    try:
        return Recording(source, checked, camera)
    except BaseException:
        source.close()
        raise


def check_view(recording: Recording, survey: Survey, *, least: float = LEAST_IN_VIEW) -> None:
    """Raises where the TCP is not in the images, as it is with a wrong calibration.

    Raises:
      TcpBehindCameraError, TcpOutOfViewError: with the share, and what to try.
    """
    where = f"{recording.source.path} with camera {recording.camera.name!r}"
    look = "`python -m palm_jax data check` tries the usual mistakes and draws them"
    if survey.behind > max(1 - least, 0.02):
        raise TcpBehindCameraError(
            f"{where}: the TCP lies behind the camera in {survey.behind:.0%} of the frames: "
            f"T_base_cam is inverted, or its axes are not OpenCV's; {look}"
        )
    if survey.in_view < least:
        raise TcpOutOfViewError(
            f"{where}: the TCP is inside the image in {survey.in_view:.0%} of the frames, expected "
            f"at least {least:.0%} (--least-in-view); {look}"
        )


# -- the robot's keys ------------------------------------------------------------------------------


def robot_keys(source: Source, given: RobotKeys) -> RobotKeys:
    """`given`, with what it leaves open filled in from known keys.

    Raises:
      KeyMissingError: no known key, or one that is not there.
      EulerAmbiguityError: an orientation that can be read in several ways.
      OpeningError: a gripper of unknown range.
    """
    pose = given.pose or _known(source, KNOWN_POSES)
    if pose is None:
        candidates = [
            key
            for key in source.number_keys
            if int(np.prod(source.features()[key].shape)) in (6, 7, 9, 16)
        ]
        raise KeyMissingError(
            f"{source.path}: which key is the pose of the hand? None is known by name; keys of a "
            f"fitting size: {', '.join(candidates) or 'none'}. Write it into the calibration: "
            "`data calibrate ... --pose 'KEY[a:b]' --rotation NAME`"
        )
    rotation = given.rotation or KNOWN_POSES.get(pose) or _rotation(source, pose)
    opening, closed, opened = _gripper(source, given)
    return RobotKeys(pose, rotation, opening, closed, opened)


def _known(source: Source, names: Iterable[str]) -> str | None:
    for name in names:
        try:
            for part in name.split("+"):
                source.resolve(part)
        except KeyMissingError:
            continue
        return name
    return None


def _sample(source: Source, expression: str) -> np.ndarray:
    """The columns in the first episode that can be read: a damaged one is named where it is used.

    Raises:
      DataError: none can.
    """
    problems = []
    for name in source.episodes:
        try:
            return source.columns(name, expression)
        except DataError as error:
            problems.append(error)
    raise problems[0]


def _rotation(source: Source, pose: str) -> str:
    """How to read a pose by its number of columns alone, where that settles it."""
    numbers = _sample(source, pose)
    count = numbers.shape[1]
    if count in (9, 16):
        return "rot6d" if count == 9 else "matrix"
    pairs = {6: ("euler_xyz", "euler_XYZ"), 7: ("quat_xyzw", "quat_wxyz")}
    if count not in pairs:
        raise FormatError(
            f"{source.path}: {pose} has {count} columns; expected a position and an orientation: 6 "
            "(three angles), 7 (quaternion), 9 (two columns of the matrix) or 16 (4 x 4)"
        )
    raise EulerAmbiguityError(f"{source.path}: {pose}: {ambiguity(numbers, *pairs[count])}")


def ambiguity(numbers: np.ndarray, first: str, second: str) -> str:
    """Says that numbers [T, 3 + n] can be read in two ways, and how far those are apart."""
    try:
        one, other = (rotations.poses(numbers, name)[:, :3, :3] for name in (first, second))
        distance = f"; here the two are up to {rotations.apart(one, other):.0f} degrees apart"
    except PoseDataError:
        distance = ""
    meaning = {
        "euler_xyz": "about the fixed axes, SciPy's 'xyz'",
        "euler_XYZ": "about the hand's own axes, SciPy's 'XYZ'",
        "quat_xyzw": "scalar last",
        "quat_wxyz": "scalar first",
    }
    return (
        f"is the orientation {first} ({meaning[first]}) or {second} "
        f"({meaning[second]})?{distance}. Say which (for a pose --rotation, for a camera --euler); "
        "`data check` shows whether it fits the images"
    )


def _gripper(source: Source, given: RobotKeys) -> tuple[str, float, float]:
    opening = given.opening or _known(source, KNOWN_OPENINGS)
    if opening is None:
        raise OpeningError(
            f"{source.path}: which key is the gripper? None is known by name. Write it into the "
            "calibration: `data calibrate ... --opening KEY --closed VALUE --open VALUE`"
        )
    columns = _sample(source, opening)
    count, closed, opened = KNOWN_OPENINGS.get(opening, (0, None, None))
    closed = given.closed if given.closed is not None else closed
    opened = given.open if given.open is not None else opened
    told = given.closed is not None and given.open is not None
    if closed is None or opened is None or (columns.shape[1] != count and not told):
        size = gripper_values(columns)
        several = f"Its {columns.shape[1]} columns have a mean absolute value"
        raise OpeningError(
            f"{source.path}: what is {opening} when the gripper is closed, and what when open? "
            f"{several if columns.shape[1] > 1 else 'It goes'} from {size.min():.4g} to "
            f"{size.max():.4g} in an episode. Write it into the calibration: "
            "`data calibrate ... --opening KEY --closed VALUE --open VALUE`"
        )
    if closed == opened:
        raise OpeningError(f"{opening}: closed and open are both {closed}")
    return opening, float(closed), float(opened)
