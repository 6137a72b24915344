"""Checks at the public entries of the core.

Shapes, dtypes and options are known while tracing and are always checked. Values are checked only
where they are concrete (an eager call); under `jax.jit` and `jax.vmap` each function documents what
it returns for bad values instead. Every message says what was expected, what came, what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

# Rotations from float32 physics drift by about 1e-5; a scaled or mistyped matrix is off by more.
ROTATION_TOLERANCE = 1e-3


# What functions take for a short vector such as (u, v).
Vector = ArrayLike | Sequence[float]


class ShapeError(ValueError):
    """An array has the wrong rank or size."""


class DtypeError(TypeError):
    """An array has a dtype the operation does not take."""


class OptionError(ValueError):
    """An option is unknown or outside its range."""


class PoseError(ValueError):
    """A 4x4 matrix is not a rigid pose."""


class CameraError(ValueError):
    """A camera's intrinsics are not those of a pinhole camera looking along +z."""


class ProjectionError(ValueError):
    """A point lies behind the camera or outside the image."""


def is_concrete(tree: Any) -> bool:
    """True when no leaf of `tree` is being traced, so that values may be looked at."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def as_float(value: Vector, name: str, trailing: tuple[int, ...]) -> jax.Array:
    """`value` as float32 with the last axes equal to `trailing` (raises ShapeError)."""
    array = jnp.asarray(value, jnp.float32)
    rank = len(trailing)
    if array.shape[array.ndim - rank :] != trailing or array.ndim < rank:
        raise ShapeError(
            f"{name}: expected the last axes to be {list(trailing)}, got shape "
            f"{list(array.shape)}; batch axes go in front (or use jax.vmap)"
        )
    return array


def as_single(value: Vector, name: str, shape: tuple[int, ...]) -> jax.Array:
    """`value` as float32 of exactly `shape` (raises ShapeError)."""
    array = jnp.asarray(value, jnp.float32)
    if array.shape != shape:
        raise ShapeError(
            f"{name}: expected shape {list(shape)}, got {list(array.shape)}; "
            "this function takes one example, batch it with jax.vmap"
        )
    return array


def as_image(image: ArrayLike, name: str, *, rank: int = 3, rgb: bool = False) -> jax.Array:
    """`image` as a uint8 or float32 array [..., H, W, C] of the given rank.

    Raises ShapeError for another rank (or, with `rgb`, for C other than 3), DtypeError for a dtype
    that is neither uint8 nor floating.
    """
    array = jnp.asarray(image)
    layout = "[B, H, W, C]" if rank == 4 else "[H, W, C]"
    if array.ndim != rank:
        hint = "add or index the batch axis" if rank == 4 else "batch with jax.vmap"
        raise ShapeError(
            f"{name}: expected rank {rank} {layout}, got shape {list(array.shape)}; {hint}"
        )
    if rgb and array.shape[-1] != 3:
        raise ShapeError(
            f"{name}: expected 3 colour channels last, got shape {list(array.shape)}; "
            "move a leading channel axis to the end, drop alpha"
        )
    if array.dtype == jnp.uint8:
        return array
    if not jnp.issubdtype(array.dtype, jnp.floating):
        raise DtypeError(
            f"{name}: expected uint8 (0..255) or float32 (0..1), got {array.dtype}; "
            "convert with .astype(np.uint8) or divide by 255"
        )
    return array.astype(jnp.float32)


def check_unit_range(image: jax.Array, name: str) -> None:
    """Raise OptionError for a concrete float image that is not in [0, 1]."""
    if image.dtype == jnp.uint8 or not is_concrete(image) or image.size == 0:
        return
    values = np.asarray(image)
    low, high = float(values.min()), float(values.max())
    if not (low >= -1e-3 and high <= 1 + 1e-3):
        raise OptionError(
            f"{name}: expected floats in [0, 1], got values from {low:.4g} to {high:.4g}; "
            "divide by 255 or pass uint8"
        )


def check_fits(size: int, height: int, width: int, name: str) -> None:
    """Raise OptionError unless a window of `size` pixels fits a height x width image."""
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 1:
        raise OptionError(
            f"{name}: expected a positive whole number of pixels, got {size!r}; "
            "the size of an image must be known while tracing"
        )
    if size > height or size > width:
        raise OptionError(
            f"{name}: expected at most the image's {height} x {width} pixels, got {size}; "
            "use a smaller crop or a larger image"
        )


def check_choice(value: str, name: str, known: tuple[str, ...]) -> None:
    """Raise OptionError for a name that is not one of `known`."""
    if value not in known:
        raise OptionError(f"{name}: expected one of {', '.join(known)}; got {value!r}")


def check_range(value: ArrayLike, name: str, low: float, high: float) -> None:
    """Raise OptionError for a concrete number outside [low, high]; traced numbers pass."""
    if is_concrete(value) and not low <= float(np.asarray(value)) <= high:
        raise OptionError(
            f"{name}: expected a number from {low:g} to {high:g}, got {float(np.asarray(value)):g}"
        )


def check_pose(pose: Any, name: str) -> None:
    """Raise PoseError unless a concrete [..., 4, 4] array is a rigid pose."""
    if not is_concrete(pose):
        return
    matrix = np.asarray(pose, np.float64)
    if not np.isfinite(matrix).all():
        raise PoseError(f"{name}: expected finite numbers, got {matrix.tolist()}")
    if np.abs(matrix[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(initial=0.0) > ROTATION_TOLERANCE:
        raise PoseError(
            f"{name}: expected the last row (0, 0, 0, 1), got {matrix[..., 3, :].tolist()}; "
            "the translation is the last column, not the last row"
        )
    check_rotation(matrix[..., :3, :3], name)


def check_rotation(rotation: Any, name: str) -> None:
    """Raise PoseError unless a concrete [..., 3, 3] array is orthonormal and right-handed."""
    if not is_concrete(rotation):
        return
    matrix = np.asarray(rotation, np.float64)
    gram = np.swapaxes(matrix, -1, -2) @ matrix - np.eye(3)
    error = float(np.abs(gram).max(initial=0.0))
    if not error <= ROTATION_TOLERANCE:
        raise PoseError(
            f"{name}: expected an orthonormal rotation, got one with |R^T R - I| = {error:.3g}; "
            "remove scale and shear, e.g. matrix_from_6d(rotation_6d(R))"
        )
    if (np.linalg.det(matrix) < 0).any():
        raise PoseError(
            f"{name}: expected a right-handed rotation (det = 1), got a mirror (det = -1); "
            "flip two axes, never one"
        )


def check_intrinsics(intrinsics: Any, name: str) -> None:
    """Raise CameraError unless a concrete K is [[fx, s, cx], [0, fy, cy], [0, 0, 1]], f > 0."""
    if not is_concrete(intrinsics):
        return
    matrix = np.asarray(intrinsics, np.float64)
    if not np.isfinite(matrix).all():
        raise CameraError(f"{name}: expected finite numbers, got {matrix.tolist()}")
    focal = matrix[..., (0, 1), (0, 1)]
    if not (focal > 0).all():
        raise CameraError(
            f"{name}: expected positive focal lengths K[0, 0], K[1, 1], got {focal.tolist()}; "
            "for a simulator with negative ones (x left, y up) negate both and use "
            "cam_to_world @ diag(-1, -1, 1, 1)"
        )
    if np.abs(matrix[..., 2, :] - (0.0, 0.0, 1.0)).max(initial=0.0) > 1e-6:
        raise CameraError(
            f"{name}: expected the last row (0, 0, 1), got {matrix[..., 2, :].tolist()}; "
            "divide K by K[2, 2], and do not pass K transposed"
        )


OFF_CENTRE = 0.15
"""A lens's optical axis meets its image within this share of the middle."""


def check_centre(K: Any, height: int, width: int, most: float, name: str, advice: str) -> None:
    """Raise CameraError unless K is that of a height x width image, as far as its centre tells.

    Args:
      K: [3, 3].
      height, width: pixels.
      most: how far the principal point may lie from the middle, as a share of the image.
      name: of K.
      advice: what to do, for the message.
    """
    for axis, centre, size in (("cx", K[0, 2], width), ("cy", K[1, 2], height)):
        if abs(centre / size - 0.5) > most:
            raise CameraError(
                f"{name}: expected a principal point near the middle of the image, got {axis} = "
                f"{centre:.1f} of {size}; {advice}"
            )
