"""Rotations as six numbers and the proprioceptive input.

A 6D rotation is the first two COLUMNS of the matrix, one after the other: the frame's x axis, then
its y axis. (Some libraries take rows.) Metres, float32.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from palm_jax._checks import OptionError, as_float, check_choice, check_pose, check_rotation
from palm_jax.align.camera import Camera, matmul

# Numbers in each layout, the gripper bit included.
LAYOUTS = {"cam6d_z": 8, "world6d_xyz": 10, "cam6d_xyz": 10, "world6d_z": 8, "z": 2}
# Above this opening (0..1) a gripper counts as open; one that holds an object must not reach it.
OPEN_ABOVE = 0.95


def rotation_6d(matrix: ArrayLike) -> jax.Array:
    """First two columns of a rotation, one after the other (PALM, proprioception).

    Args:
      matrix: [..., 3, 3].

    Returns:
      [..., 6]: column 0, then column 1.

    Raises:
      ShapeError: last axes not [3, 3].
      PoseError: concrete values that are not a rotation.
    """
    matrix = as_float(matrix, "matrix", (3, 3))
    check_rotation(matrix, "matrix")
    return _rotation_6d(matrix)


def _rotation_6d(matrix: jax.Array) -> jax.Array:
    return jnp.concatenate([matrix[..., 0], matrix[..., 1]], -1)


def _unit(vector: jax.Array, otherwise: jax.Array) -> jax.Array:
    """Normalised [..., 3], or `otherwise` where it is shorter than 1e-6 or not finite."""
    square = (vector * vector).sum(-1, keepdims=True)
    usable = jnp.isfinite(square) & (square > 1e-12)
    length = jnp.sqrt(jnp.where(usable, square, 1.0))
    return jnp.where(usable, vector / length, otherwise)


def matrix_from_6d(vector: ArrayLike) -> jax.Array:
    """Rotation of a 6D vector by Gram-Schmidt; the inverse of `rotation_6d`.

    Args:
      vector: [..., 6]: the x axis, then the y axis, of any lengths and not quite perpendicular.

    Returns:
      [..., 3, 3] rotation: x normalised, y made perpendicular to it, z their cross product. Any
      input gives a rotation: a first half of (almost) zero length is replaced by (1, 0, 0), a
      second half (almost) parallel to the first by the coordinate axis x or y that is less parallel
      to it; halves that are not finite are replaced in the same way.

    Raises:
      ShapeError: last axis not 6.
    """
    return _matrix_from_6d(as_float(vector, "vector", (6,)))


@jax.jit
def _matrix_from_6d(vector: jax.Array) -> jax.Array:
    x = _unit(vector[..., :3], jnp.asarray([1.0, 0.0, 0.0]))
    spare = jnp.where(jnp.abs(x[..., :1]) < 0.9, jnp.eye(3)[0], jnp.eye(3)[1])
    spare = _unit(_without(spare, x), spare)
    # Unit length before the projection, or a huge second half would leave a rounding error.
    y = _unit(_without(_unit(vector[..., 3:], spare), x), spare)
    y = _unit(_without(y, x), spare)
    return jnp.stack([x, y, jnp.cross(x, y)], -1)


def _without(vector: jax.Array, unit: jax.Array) -> jax.Array:
    """The part of `vector` perpendicular to `unit`."""
    return vector - (vector * unit).sum(-1, keepdims=True) * unit


def proprio(
    tcp: ArrayLike, opening: ArrayLike, camera: Camera | None, *, layout: str = "cam6d_z"
) -> jax.Array:
    """Proprioceptive input: rotation, position, gripper bit, in that order (PALM, proprioception).

    Args:
      tcp: [..., 4, 4] TCP pose in the world.
      opening: [...] gripper opening, 0 closed to 1 open.
      camera: the camera of the image; may be None for layouts without "cam".
      layout: "cam6d_z" (PALM, 8 numbers): 6D of the TCP's rotation seen from the camera
        (R_camera^T R_tcp, OpenCV axes), height. "world6d_xyz" (10): 6D in the world, position.
        "cam6d_xyz" (10), "world6d_z" (8), "z" (2): height only. Heights and positions are world
        metres, not relative to the table or the camera.

    Returns:
      [..., n]; the last number is 1 where opening > 0.95, else 0.

    Raises:
      OptionError: unknown layout, or a "cam" layout without a camera.
      ShapeError: tcp not [..., 4, 4].
      PoseError, CameraError: concrete tcp not a rigid pose; see `Camera.check`.
    """
    check_choice(layout, "layout", tuple(LAYOUTS))
    tcp = as_float(tcp, "tcp", (4, 4))
    check_pose(tcp, "tcp")
    if camera is not None:
        camera.check()
    return _proprio(tcp, jnp.asarray(opening, jnp.float32), camera, layout)


@partial(jax.jit, static_argnames="layout")
def _proprio(tcp: jax.Array, opening: jax.Array, camera: Camera | None, layout: str) -> jax.Array:
    parts = []
    rotation = tcp[..., :3, :3]
    if layout.startswith("cam6d"):
        if camera is None:
            raise OptionError(f"layout {layout!r}: expected a camera, got None; pass the image's")
        to_camera = jnp.asarray(camera.cam_to_world, jnp.float32)[:3, :3].T
        parts.append(_rotation_6d(matmul(to_camera, rotation)))
    elif layout.startswith("world6d"):
        parts.append(_rotation_6d(rotation))
    parts.append(tcp[..., :3, 3] if layout.endswith("xyz") else tcp[..., 2:3, 3])
    is_open = (opening > OPEN_ABOVE).astype(jnp.float32)
    parts.append(jnp.broadcast_to(is_open, tcp.shape[:-2])[..., None])
    return jnp.concatenate(parts, -1)
