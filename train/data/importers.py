"""Calibrations out of what others store: robosuite, MuJoCo, ManiSkill, DROID, plain arrays.

Each function returns cameras by name. Conventions differ: MuJoCo and OpenGL cameras look along -z
with y up; ManiSkill's `extrinsic_cv` maps the world into the camera, its `cam2world_gl` is a pose
with OpenGL axes; DROID writes a pose as position and three angles, which its own code reads in two
ways.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import mujoco
import numpy as np

from palm_jax.train.data import rotations
from palm_jax.train.data.calibration import (
    CameraCalibration,
    as_opencv,
    image_key,
    short_names,
)
from palm_jax.train.data.errors import (
    CalibrationError,
    CameraNameError,
    EulerAmbiguityError,
    FormatError,
    KeyMissingError,
)
from palm_jax.train.data.recording import ambiguity
from palm_jax.train.data.robomimic import open_hdf5, refuse
from palm_jax.train.data.source import Source
from palm_jax.train.files import hdf5 as hdf5_files

Cameras = dict[str, CameraCalibration]
Size = tuple[int, int]  # width, height

# Poses of one camera that differ by less are the same: files store float32.
_SAME = 1e-5


def intrinsics_of(fovy: float, width: int, height: int) -> np.ndarray:
    """[3, 3] of a renderer's camera: vertical field of view in degrees, square pixels."""
    focal = height / 2 / np.tan(np.radians(fovy) / 2)
    return np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])


def image_size(source: Source, name: str) -> Size | None:
    """Width and height of a camera's images in a file, or None."""
    dummy = CameraCalibration(name, np.eye(3), 1, 1, np.eye(4))  # only its name matters
    key = image_key(dummy, source.image_keys)
    if key is None:
        return None
    height, width, _ = source.features()[key].shape
    return width, height


def with_images(source: Source, names: Sequence[str]) -> list[str]:
    """Cameras asked for; all that have images, if none is.

    Raises:
      CameraNameError: none has images.
    """
    if names:
        return list(names)
    found = [min(short_names(key), key=len) for key in source.image_keys]
    if not found:
        raise CameraNameError(f"{source.path} has no images; name the cameras with --camera")
    return found


def _merged(
    name: str,
    matrices: Mapping[str, np.ndarray],
    size: Size,
    poses: Mapping[str, np.ndarray],
) -> CameraCalibration:
    """One camera from its intrinsics and its pose in every episode.

    Raises:
      CalibrationError: the intrinsics differ.
    """
    first, K = next(iter(matrices.items()))
    for episode, matrix in matrices.items():
        if matrix.shape != K.shape or not np.allclose(matrix, K, rtol=_SAME, atol=_SAME):
            raise CalibrationError(
                f"{name}: expected the same K in every episode, got {K.tolist()} in {first} and "
                f"{matrix.tolist()} in {episode}; split the file into those that share it"
            )
    usual = next(iter(poses.values()))
    other = {episode: pose for episode, pose in poses.items() if np.abs(pose - usual).max() > _SAME}
    return CameraCalibration(name, K, *size, usual, by_episode=other)


# -- robosuite, robomimic --------------------------------------------------------------------------


def from_robosuite(source: Source, names: Sequence[str], size: Size | None) -> Cameras:
    """From `camera_info` of a robomimic file (camera poses, OpenCV axes), else from `model_file`.

    Args:
      source: the file.
      names: cameras; empty: all with images.
      size: of the images that `camera_info` describes; None: that of the stored ones.

    Raises:
      CalibrationError: the file has neither, or the camera moves.
      CameraNameError: not in the file.
    """
    names = with_images(source, names)
    first = source.episodes[0]
    if not source.camera_info(first):
        models = {episode: source.model_file(episode) for episode in source.episodes}
        whole = {episode: model for episode, model in models.items() if model}
        if not whole:
            raise CalibrationError(
                f"{source.path}: neither camera_info nor model_file in {first}; write the "
                "calibration from what your recording used: `data calibrate --from npy --K ... "
                "--extrinsics ...`"
            )
        sizes = {name: size or image_size(source, name) for name in names}
        return from_models(whole, names, sizes)
    return {name: _camera_info(source, name, size) for name in names}


def _camera_info(source: Source, name: str, size: Size | None) -> CameraCalibration:
    poses, matrices = {}, {}
    for episode in source.episodes:
        info = source.camera_info(episode)
        if name not in info:
            raise CameraNameError(
                f"{source.path}: {episode} has no camera_info of {name!r}, only of "
                f"{', '.join(info) or 'none'}"
            )
        if "eye_in_hand" in name:
            raise CalibrationError(f"{name}: a wrist camera moves with the TCP; PALM needs none")
        matrices[episode] = np.asarray(info[name]["intrinsics"], float)
        poses[episode] = np.asarray(info[name]["extrinsics"], float)
    size = size or image_size(source, name)
    if size is None:
        raise CameraNameError(f"{source.path}: no images of {name!r}; give their --size")
    return _merged(name, matrices, size, poses)


# -- MuJoCo ----------------------------------------------------------------------------------------


def from_mujoco(xml: str, names: Sequence[str], size: Size | None) -> Cameras:
    """From an MJCF: its fixed cameras.

    Args:
      xml: the model. Meshes and textures need not exist: only bodies and cameras are looked at.
      names: cameras; empty: all that do not move.
      size: of the images, for K.

    Raises:
      CalibrationError: not an MJCF, a camera that hangs on a joint, or no size.
      CameraNameError: not in the model.
    """
    return from_models({"": xml}, names, dict.fromkeys(names, size), default=size)


def from_models(
    models: Mapping[str, str],
    names: Sequence[str],
    sizes: Mapping[str, Size | None],
    *,
    default: Size | None = None,
) -> Cameras:
    """See `from_mujoco`, for one model an episode."""
    found: dict[str, dict[str, np.ndarray]] = {}
    fovy: dict[str, dict[str, float]] = {}
    for episode, xml in models.items():
        for name, (pose, angle) in _fixed_cameras(xml, names).items():
            found.setdefault(name, {})[episode] = as_opencv(pose, "opengl", False)
            fovy.setdefault(name, {})[episode] = angle
    cameras = {}
    for name, poses in found.items():
        size = sizes.get(name) or default
        if size is None:
            raise CalibrationError(f"{name}: give the size of its images: --size WIDTH HEIGHT")
        matrices = {episode: intrinsics_of(angle, *size) for episode, angle in fovy[name].items()}
        cameras[name] = _merged(name, matrices, size, poses)
    return cameras


def _fixed_cameras(xml: str, names: Sequence[str]) -> dict[str, tuple[np.ndarray, float]]:
    """Name -> (pose with MuJoCo's axes, vertical field of view in degrees)."""
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise CalibrationError(f"not a readable MJCF: {error}") from error
    world = root.find("worldbody")
    if root.tag != "mujoco" or world is None:
        raise CalibrationError(f"not an MJCF: <{root.tag}> without a worldbody")
    moving: set[str] = set()
    _reduce(world, moving, moves=False)
    for part in list(root):
        if part.tag not in ("compiler", "worldbody", "default"):
            root.remove(part)
    for part in root.iter("default"):
        for child in list(part):
            if child.tag not in ("default", "camera"):
                part.remove(child)
    try:
        model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise CalibrationError(f"MuJoCo cannot read the model's cameras: {error}") from error
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    present = {model.camera(i).name: i for i in range(model.ncam)}
    standing = [name for name in present if name not in moving]
    for name in names:
        if name in moving:
            raise CalibrationError(f"camera {name!r} hangs on a joint; PALM needs one that stands")
        if name not in present:
            raise CameraNameError(
                f"the model has no camera {name!r}; it has {', '.join(standing) or 'none'}"
            )
    result = {}
    for name in names or standing:
        pose = np.eye(4)
        pose[:3, :3] = data.cam_xmat[present[name]].reshape(3, 3)
        pose[:3, 3] = data.cam_xpos[present[name]]
        result[name] = (pose, float(model.cam_fovy[present[name]]))
    return result


def _reduce(body: ElementTree.Element, moving: set[str], *, moves: bool) -> None:
    """Keeps bodies and cameras alone; notes the cameras below a joint."""
    moves = moves or any(child.tag in ("joint", "freejoint") for child in body)
    for child in list(body):
        if child.tag == "camera":
            if moves:
                moving.add(child.get("name", ""))
        elif child.tag == "body":
            _reduce(child, moving, moves=moves or child.get("mocap") == "true")
        else:
            body.remove(child)


# -- ManiSkill -------------------------------------------------------------------------------------


def from_maniskill(path: Path, source: Source | None, names: Sequence[str], size: Size) -> Cameras:
    """From `intrinsic_cv`, `extrinsic_cv` (world to camera) and `cam2world_gl`.

    Args:
      path: HDF5 file of trajectories, or JSON {camera: {"intrinsic_cv": ..., ...}}.
      source: the data set, where it is LeRobot's, with keys `sensors.CAMERA.intrinsic_cv`; then
        `path` is not read.
      names: cameras; empty: all.
      size: of the images.

    Raises:
      CalibrationError: no such arrays, or two that contradict each other.
      CameraNameError: not in the file.
    """
    found = _sensors_of_source(source) if source is not None else _sensors_of_file(path)
    if not found:
        raise CalibrationError(f"{path}: no intrinsic_cv beside an extrinsic_cv or cam2world_gl")
    for name in names:
        if name not in found:
            raise CameraNameError(f"{path} has no camera {name!r}, only {', '.join(found)}")
    return {name: _sensor(name, found[name], size) for name in names or found}


Sensor = dict[str, dict[str, np.ndarray]]  # episode -> array name -> values


def _sensor(name: str, episodes: Sensor, size: Size) -> CameraCalibration:
    poses, matrices = {}, {}
    for episode, arrays in episodes.items():
        pose = None
        if "intrinsic_cv" in arrays:
            matrices[episode] = _still(arrays["intrinsic_cv"], f"{name}.intrinsic_cv")
        if "extrinsic_cv" in arrays:
            pose = _square(_still(arrays["extrinsic_cv"], f"{name}.extrinsic_cv"))
            pose = as_opencv(pose, "opencv", True)
        if "cam2world_gl" in arrays:
            other = _still(arrays["cam2world_gl"], f"{name}.cam2world_gl")
            other = as_opencv(other, "opengl", False)
            if pose is not None and np.abs(pose - other).max() > 1e-3:
                raise CalibrationError(
                    f"{name}: extrinsic_cv (world to camera, OpenCV) and cam2world_gl (pose, "
                    f"OpenGL) contradict each other by {np.abs(pose - other).max():.3g}; one of "
                    "them has another convention than ManiSkill's"
                )
            pose = other if pose is None else pose
        if pose is not None:
            poses[episode] = pose
    if not poses or not matrices:
        raise CalibrationError(f"{name}: needs intrinsic_cv, and extrinsic_cv or cam2world_gl")
    return _merged(name, matrices, size, poses)


def _still(values: np.ndarray, where: str) -> np.ndarray:
    """The one matrix in [T, n, m] (or [n, m]) of a camera that stands still."""
    values = np.asarray(values, float)
    stack = values.reshape(-1, *values.shape[-2:])
    if np.abs(stack - stack[0]).max() > 1e-4:
        raise CalibrationError(f"{where}: the camera moves; PALM needs one that stands still")
    return stack[0]


def _square(matrix: np.ndarray) -> np.ndarray:
    return matrix if matrix.shape == (4, 4) else np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])


_ARRAYS = ("intrinsic_cv", "extrinsic_cv", "cam2world_gl")


def _sensors_of_file(path: Path) -> dict[str, Sensor]:
    if path.suffix == ".json":
        try:
            content = json.loads(path.read_text())
            return {
                name: {"": {key: np.asarray(entry[key]) for key in _ARRAYS if key in entry}}
                for name, entry in content.items()
            }
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise CalibrationError(f"{path}: not a readable JSON file ({error})") from error
    found: dict[str, Sensor] = {}
    with open_hdf5(path) as file:

        def note(name: str, item: Any) -> None:
            parts = name.split("/")
            if isinstance(item, h5py.Dataset) and parts[-1] in _ARRAYS and len(parts) > 1:
                episodes = found.setdefault(parts[-2], {})
                episodes.setdefault(parts[0], {})[parts[-1]] = item[()]

        refuse(path, hdf5_files.way_out(file))
        file.visititems(note)
    return found


def _sensors_of_source(source: Source) -> dict[str, Sensor]:
    found: dict[str, Sensor] = {}
    for key in source.number_keys:
        parts = key.replace("/", ".").split(".")
        if parts[-1] in _ARRAYS and len(parts) > 1:
            episodes = found.setdefault(parts[-2], {})
            for episode in source.episodes:
                values = source.numbers(episode, key)
                if values.ndim == 2:  # flattened
                    rows = {9: 3, 12: 3, 16: 4}.get(values.shape[1], 1)
                    values = values.reshape(len(values), rows, -1)
                episodes.setdefault(episode, {})[parts[-1]] = values
    return found


# -- DROID, plain arrays ---------------------------------------------------------------------------


def vector_pose(vector: Iterable[float], euler: str | None) -> np.ndarray:
    """[4, 4] of six numbers: position (m) and three angles (rad).

    Args:
      vector: x, y, z, then the angles.
      euler: "xyz" (fixed axes: DROID's calibration files) or "XYZ" (the body's own axes).

    Raises:
      EulerAmbiguityError: `euler` is None.
      CalibrationError: not six numbers.
    """
    numbers = np.asarray(list(vector), float)
    if numbers.shape != (6,):
        raise CalibrationError(f"expected x, y, z and three angles, got {numbers.size} numbers")
    if euler is None:
        raise EulerAmbiguityError(
            f"camera pose: {ambiguity(numbers[None], 'euler_xyz', 'euler_XYZ')}"
        )
    if euler not in ("xyz", "XYZ"):
        raise CalibrationError(f"--euler: expected xyz or XYZ, got {euler!r}")
    return rotations.poses(numbers[None], f"euler_{euler}")[0]


def from_droid(
    source: Source | None,
    name: str,
    extrinsics: Iterable[float] | None,
    K: np.ndarray,
    size: Size,
    euler: str | None,
) -> Cameras:
    """From DROID's six numbers: the camera's pose in the base, OpenCV axes.

    Args:
      source: a data set with the key `camera_extrinsics.NAME` in every episode (the LeRobot port);
        None: `extrinsics` are used.
      name: of the camera.
      extrinsics: x, y, z (m) and three angles (rad).
      K: [3, 3]. DROID's documented files have none; it comes from the camera's maker or another
        release.
      size: of the images.
      euler: how the angles read, see `vector_pose`.

    Raises:
      EulerAmbiguityError, CalibrationError, KeyMissingError.
    """
    if extrinsics is not None:
        return {name: CameraCalibration(name, K, *size, vector_pose(extrinsics, euler))}
    if source is None:
        raise CalibrationError("give --extrinsics x,y,z,a,b,c or a --file that has them")
    key = _extrinsics_key(source, name)
    poses = {}
    for episode in source.episodes:
        vectors = source.columns(episode, key)
        if np.abs(vectors - vectors[0]).max() > 1e-4:
            raise CalibrationError(f"{key}: the camera moves in {episode}")
        poses[episode] = vector_pose(vectors[0], euler)
    return {name: _merged(name, {"": K}, size, poses)}


def _extrinsics_key(source: Source, name: str) -> str:
    wanted = [key for key in source.number_keys if "extrinsics" in key]
    near = [key for key in wanted if name in key]
    if len(near) != 1:
        raise KeyMissingError(
            f"{source.path}: expected one key with 'extrinsics' and {name!r} in its name, found "
            f"{', '.join(near or wanted) or 'none'}; give --extrinsics x,y,z,a,b,c"
        )
    return near[0]


def from_arrays(
    name: str,
    K: np.ndarray,
    pose: np.ndarray,
    size: Size,
    *,
    axes: str = "opencv",
    inverse: bool = False,
) -> Cameras:
    """From a matrix of intrinsics and one of extrinsics.

    Args:
      name: of the camera.
      K: [3, 3].
      pose: [4, 4] or [3, 4].
      size: of the images.
      axes: of the camera, a key of `calibration.AXES`.
      inverse: `pose` maps the base into the camera.

    Raises:
      CalibrationError: not such matrices.
    """
    pose = np.asarray(pose, float)
    if pose.shape not in ((4, 4), (3, 4)):
        raise CalibrationError(f"--extrinsics: expected 4 x 4 or 3 x 4 numbers, got {pose.shape}")
    pose = as_opencv(_square(pose), axes, inverse)
    return {name: CameraCalibration(name, np.asarray(K, float), *size, pose)}


def numbers_or_file(text: str, where: str) -> np.ndarray:
    """Numbers separated by commas, or the content of a .npy file.

    Raises:
      FormatError: neither.
    """
    path = Path(text)
    if path.suffix == ".npy":
        try:
            return np.asarray(np.load(path, allow_pickle=False), float)
        except (OSError, ValueError) as error:
            raise FormatError(f"{where}: {path} cannot be read ({error})") from error
    try:
        return np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        raise FormatError(f"{where}: expected numbers or a .npy file, got {text!r}") from None


def intrinsics(numbers: np.ndarray) -> np.ndarray:
    """[3, 3] from 3 x 3, 9 or 4 numbers (fx, fy, cx, cy).

    Raises:
      CalibrationError: another number of them.
    """
    if numbers.size == 4:
        fx, fy, cx, cy = numbers.ravel()
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if numbers.size != 9:
        raise CalibrationError(f"--K: expected fx,fy,cx,cy or 3 x 3 numbers, got {numbers.size}")
    return numbers.reshape(3, 3)
