"""Orientations as files write them, to matrices. NumPy, float64.

Three angles and four numbers can be read in two ways each; the names here say which:

- `euler_xyz`: about the fixed axes x, then y, then z (SciPy's "xyz"; roll, pitch, yaw),
  R = Rz(c) Ry(b) Rx(a);
- `euler_XYZ`: about the body's own axes x, then y, then z (SciPy's and PyTorch3D's "XYZ"),
  R = Rx(a) Ry(b) Rz(c);
- `quat_xyzw`: the scalar last (SciPy, robosuite, ROS); `quat_wxyz`: the scalar first (MuJoCo,
  SAPIEN);
- `rotvec`: axis times angle; `rot6d`: the first two columns of the matrix; `matrix`: a whole 4x4
  pose.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from palm_jax.train.data.errors import FormatError, PoseDataError


def about(axis: int, angle: np.ndarray) -> np.ndarray:
    """[..., 3, 3] rotation by `angle` [...] (radians) about axis 0, 1 or 2."""
    angle = np.asarray(angle, np.float64)
    matrix = np.zeros((*angle.shape, 3, 3))
    second, third = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1.0
    matrix[..., second, second] = matrix[..., third, third] = np.cos(angle)
    matrix[..., third, second] = np.sin(angle)
    matrix[..., second, third] = -np.sin(angle)
    return matrix


def from_euler_xyz(angles: np.ndarray) -> np.ndarray:
    """[..., 3] radians about the fixed axes -> [..., 3, 3]."""
    x, y, z = (about(axis, angles[..., axis]) for axis in range(3))
    return z @ y @ x


def from_euler_own(angles: np.ndarray) -> np.ndarray:
    """[..., 3] radians about the body's own axes -> [..., 3, 3]."""
    x, y, z = (about(axis, angles[..., axis]) for axis in range(3))
    return x @ y @ z


def from_quat_wxyz(quaternion: np.ndarray) -> np.ndarray:
    """[..., 4] scalar first -> [..., 3, 3]; normalised first."""
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    if (np.abs(length - 1) > 0.05).any():
        raise PoseDataError(
            f"expected quaternions of length 1, got lengths from {length.min():.3g} to "
            f"{length.max():.3g}; check which numbers are the orientation (--pose)"
        )
    w, x, y, z = np.moveaxis(quaternion / length, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def from_quat_xyzw(quaternion: np.ndarray) -> np.ndarray:
    """[..., 4] scalar last -> [..., 3, 3]; normalised first."""
    return from_quat_wxyz(np.roll(quaternion, 1, -1))


def from_rotvec(vector: np.ndarray) -> np.ndarray:
    """[..., 3] axis times angle (radians) -> [..., 3, 3]."""
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    # sin(a / 2) / a tends to one half.
    ratio = np.where(half > 1e-9, np.sin(half) / np.maximum(2 * half, 1e-12), 0.5)
    return from_quat_wxyz(np.concatenate([np.cos(half), vector * ratio], -1))


def from_rot6d(vector: np.ndarray) -> np.ndarray:
    """[..., 6] first two columns -> [..., 3, 3], made orthonormal."""
    x = vector[..., :3] / np.linalg.norm(vector[..., :3], axis=-1, keepdims=True)
    y = vector[..., 3:] - (vector[..., 3:] * x).sum(-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], -1)


READINGS: dict[str, tuple[int, Callable[[np.ndarray], np.ndarray]]] = {
    "euler_xyz": (3, from_euler_xyz),
    "euler_XYZ": (3, from_euler_own),
    "quat_xyzw": (4, from_quat_xyzw),
    "quat_wxyz": (4, from_quat_wxyz),
    "rotvec": (3, from_rotvec),
    "rot6d": (6, from_rot6d),
}
"""Name -> how many numbers follow the position, and how to read them."""

NAMES = (*READINGS, "matrix")


def poses(numbers: np.ndarray, reading: str) -> np.ndarray:
    """Position and orientation as a file has them -> poses [T, 4, 4].

    Args:
      numbers: [T, 3 + n] position (metres), then the orientation; for "matrix" [T, 16] or [T, 4,
        4].
      reading: one of `NAMES`.

    Raises:
      FormatError: another number of columns, or an unknown reading.
      PoseDataError: not finite, not unit quaternions.
    """
    numbers = np.asarray(numbers, np.float64)
    if not np.isfinite(numbers).all():
        bad = np.flatnonzero(~np.isfinite(numbers.reshape(len(numbers), -1)).all(-1))
        raise PoseDataError(
            f"expected finite numbers, got NaN or infinity in {len(bad)} frames, the first at "
            f"{int(bad[0])}"
        )
    if reading == "matrix":
        if numbers.shape[1:] not in ((16,), (4, 4)):
            raise FormatError(f"expected poses of 4 x 4 numbers, got {list(numbers.shape[1:])}")
        return numbers.reshape(-1, 4, 4)
    if reading not in READINGS:
        raise FormatError(f"unknown orientation {reading!r}; known: {', '.join(NAMES)}")
    count, read = READINGS[reading]
    if numbers.shape[1:] != (3 + count,):
        raise FormatError(
            f"expected 3 + {count} numbers for {reading!r}, got {list(numbers.shape[1:])}; name "
            "the columns, e.g. --pose 'observation.state[0:6]'"
        )
    result = np.tile(np.eye(4), (len(numbers), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = read(numbers[:, 3:]), numbers[:, :3]
    return result


def inverted(pose: np.ndarray) -> np.ndarray:
    """The inverse of rigid poses [..., 4, 4]."""
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    result = np.zeros_like(pose)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """The largest angle in degrees between rotations [..., 3, 3]."""
    trace = np.einsum("...ij,...ij->...", first, second)
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max(initial=0.0))
