"""Lens distortion (OpenCV's model) and its removal.

Alignment assumes a pinhole camera. Where the calibration of a real one has distortion coefficients,
`undistort` its images first; the camera's `K` then describes them.

The coefficients are OpenCV's, in its order: k1, k2, p1, p2[, k3[, k4, k5, k6]]. OpenCV names a
pixel by its centre, this package by its corner, so a principal point that OpenCV calibrated is half
a pixel further to the right and further down here.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from palm_jax._checks import OptionError, Vector, as_float, as_image, as_single, check_intrinsics
from palm_jax.align import pixels

LENGTHS = (4, 5, 8)
# Newton's method doubles the number of right digits at every step: from 10 % to float32's end.
_STEPS = 8


def _coefficients(dist: Vector) -> jax.Array:
    """All eight, zeros where there are fewer."""
    values = jnp.asarray(dist, jnp.float32)
    if values.ndim != 1 or values.shape[0] not in LENGTHS:
        raise OptionError(
            f"dist: expected {', '.join(map(str, LENGTHS))} coefficients (k1, k2, p1, p2[, k3[, "
            f"k4, k5, k6]]), got shape {list(values.shape)}; flatten OpenCV's [1, n], and "
            "calibrate without thin prism and tilt"
        )
    return jnp.concatenate([values, jnp.zeros(8 - values.shape[0])])


def _distort(x: jax.Array, y: jax.Array, dist: jax.Array) -> tuple[jax.Array, jax.Array]:
    k1, k2, p1, p2, k3, k4, k5, k6 = dist
    square = x * x + y * y
    radial = (1 + square * (k1 + square * (k2 + square * k3))) / (
        1 + square * (k4 + square * (k5 + square * k6))
    )
    across, down = square + 2 * x * x, square + 2 * y * y
    return (
        x * radial + 2 * p1 * x * y + p2 * across,
        y * radial + 2 * p2 * x * y + p1 * down,
    )


def _normalised(intrinsics: jax.Array, u: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    y = (v - intrinsics[1, 2]) / intrinsics[1, 1]
    return (u - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0], y


def _in_pixels(intrinsics: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    u = intrinsics[0, 0] * x + intrinsics[0, 1] * y + intrinsics[0, 2]
    return u, intrinsics[1, 1] * y + intrinsics[1, 2]


def _entry(K: ArrayLike, dist: Vector) -> tuple[jax.Array, jax.Array]:
    check_intrinsics(K, "K")
    return as_single(K, "K", (3, 3)), _coefficients(dist)


def distort_points(uv: Vector, K: ArrayLike, dist: Vector) -> jax.Array:
    """Where the lens puts the points that a pinhole camera would show at uv.

    Args:
      uv: [..., 2] pixels of the pinhole camera's image.
      K: [3, 3] intrinsics of both images.
      dist: [4], [5] or [8] coefficients, OpenCV's order.

    Returns:
      [..., 2] pixels of the real image.

    Raises:
      ShapeError, CameraError: uv not [..., 2]; K not the intrinsics of a camera.
      OptionError: another number of coefficients.
    """
    uv = as_float(uv, "uv", (2,))
    return _distort_points(uv, *_entry(K, dist))


@jax.jit
def _distort_points(uv: jax.Array, intrinsics: jax.Array, dist: jax.Array) -> jax.Array:
    x, y = _distort(*_normalised(intrinsics, uv[..., 0], uv[..., 1]), dist)
    return jnp.stack(_in_pixels(intrinsics, x, y), -1)


def undistort_points(uv: Vector, K: ArrayLike, dist: Vector) -> jax.Array:
    """Where a pinhole camera would show the points that the real image has at uv.

    The inverse of `distort_points`, by Newton's method. A strong barrel distortion folds the plane
    over far outside the image; what is asked for there has no inverse and no meaning.

    Args:
      uv: [..., 2] pixels of the real image.
      K: [3, 3] intrinsics of both images.
      dist: [4], [5] or [8] coefficients, OpenCV's order.

    Returns:
      [..., 2] pixels of the pinhole camera's image.

    Raises:
      ShapeError, CameraError, OptionError: see `distort_points`.
    """
    uv = as_float(uv, "uv", (2,))
    return _undistort_points(uv, *_entry(K, dist))


@jax.jit
def _undistort_points(uv: jax.Array, intrinsics: jax.Array, dist: jax.Array) -> jax.Array:
    wanted = _normalised(intrinsics, uv[..., 0], uv[..., 1])
    one, zero = jnp.ones_like(wanted[0]), jnp.zeros_like(wanted[0])

    def step(_: int, point: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        def model(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
            return _distort(x, y, dist)

        (now_x, now_y), (xx, yx) = jax.jvp(model, point, (one, zero))
        _, (xy, yy) = jax.jvp(model, point, (zero, one))
        off_x, off_y = now_x - wanted[0], now_y - wanted[1]
        area = xx * yy - xy * yx
        area = jnp.where(jnp.abs(area) < 1e-6, 1.0, area)
        return (
            point[0] - (yy * off_x - xy * off_y) / area,
            point[1] - (xx * off_y - yx * off_x) / area,
        )

    x, y = jax.lax.fori_loop(0, _STEPS, step, wanted)
    return jnp.stack(_in_pixels(intrinsics, x, y), -1)


def undistort(image: ArrayLike, K: ArrayLike, dist: Vector) -> jax.Array:
    """The image as a pinhole camera with the same intrinsics would have taken it.

    Bilinear, black where the real image has nothing to show.

    Args:
      image: [H, W, 3] uint8 or float32 in [0, 1].
      K: [3, 3] intrinsics of both images.
      dist: [4], [5] or [8] coefficients, OpenCV's order.

    Returns:
      [H, W, 3], dtype of the image; uint8 values are rounded.

    Raises:
      ShapeError, DtypeError: image not [H, W, 3] of uint8 or float; K not [3, 3].
      CameraError, OptionError: see `distort_points`.
    """
    image = as_image(image, "image", rgb=True)
    return _undistort(image, *_entry(K, dist))


@jax.jit
def _undistort(image: jax.Array, intrinsics: jax.Array, dist: jax.Array) -> jax.Array:
    height, width, _ = image.shape
    u = jnp.arange(width, dtype=jnp.float32)[None, :] + 0.5
    v = jnp.arange(height, dtype=jnp.float32)[:, None] + 0.5
    x, y = _normalised(intrinsics, u, v)
    real_u, real_v = _in_pixels(intrinsics, *_distort(x, y, dist))
    return _sample(image, real_u - 0.5, real_v - 0.5)


def _sample(image: jax.Array, column: jax.Array, row: jax.Array) -> jax.Array:
    """Bilinear values [H, W, 3] at fractional pixel numbers [H, W], black outside the image."""
    height, width, _ = image.shape
    # One ring of pixels beyond the border is half black; what lies further is black altogether.
    column, row = jnp.clip(column, -1.0, width), jnp.clip(row, -1.0, height)
    left, top = jnp.floor(column), jnp.floor(row)
    across, down = column - left, row - top
    left, top = left.astype(jnp.int32), top.astype(jnp.int32)
    whole = image.dtype == jnp.uint8
    # Packed, a gather fetches a pixel instead of a channel.
    flat = pixels.pack(image).reshape(-1) if whole else image.reshape(-1, 3)
    planes: list[jax.Array] = [jnp.zeros(column.shape)] * 3
    for below, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        i, j = top + below, left + right
        inside = (i >= 0) & (i < height) & (j >= 0) & (j < width)
        corner = flat[jnp.where(inside, i * width + j, 0)]
        weight = (down if below else 1 - down) * (across if right else 1 - across)
        weight = jnp.where(inside, weight, 0.0)
        for index in range(3):
            value = pixels.channel(corner, index) if whole else corner[..., index]
            planes[index] = planes[index] + weight * value
    return pixels.unpack(planes) if whole else jnp.stack(planes, -1)
