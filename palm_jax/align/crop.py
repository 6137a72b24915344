"""TCP-centric crop and the resize that follows it.

Images are HWC, uint8 or float32 in [0, 1]; the dtype is kept. (u, v) is in pixels, u right, v down.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from palm_jax._checks import (
    OptionError,
    ProjectionError,
    Vector,
    as_image,
    as_single,
    check_choice,
    check_fits,
    is_concrete,
)
from palm_jax.align import pixels

BORDERS = ("shift", "edge", "constant")
# The row or column of a window pixel that shows no pixel of the image: far from every stroke.
NOWHERE = -(2**24)


def crop_origin(uv: jax.Array, size: int, offset: Vector) -> jax.Array:
    """int32 [2] (row, col) of the unclamped window of `size` pixels for a TCP at uv [2].

    A coordinate that is not finite counts as 0, so that the integer is defined.
    """
    corner = uv + jnp.asarray(offset, jnp.float32) - size // 2
    corner = jnp.clip(jnp.where(jnp.isfinite(corner), corner, 0.0), -1e9, 1e9)
    return jnp.floor(corner).astype(jnp.int32)[::-1]


def clamp_origin(origin: jax.Array, size: int, height: int, width: int) -> jax.Array:
    """int32 [2]: the nearest origin (row, col) whose window lies inside the image."""
    limit = jnp.asarray([height - size, width - size], jnp.int32)
    return jnp.clip(origin, 0, limit)


def cut_window(
    image: jax.Array, wanted: jax.Array, size: int, border: str
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The window at `wanted` (row, col), and which pixels of the image it shows.

    Returns:
      window: [size, size, C].
      rows, columns: int32 [size], the image's row (column) behind each row (column) of the window;
        NOWHERE where there is none (border "constant").
    """
    height, width, depth = image.shape
    origin = clamp_origin(wanted, size, height, width)
    start = (origin[0], origin[1], jnp.int32(0))
    window = lax.dynamic_slice(image, start, (size, size, depth))
    steps = jnp.arange(size, dtype=jnp.int32)
    if border == "shift":
        return window, origin[0] + steps, origin[1] + steps
    # What lies inside the image lies inside the clamped window, too.
    source = steps + wanted[:, None]
    limit = jnp.asarray([[height - 1], [width - 1]], jnp.int32)
    near = jnp.clip(source, 0, limit)
    moved = window[near[0] - origin[0]][:, near[1] - origin[1]]
    if border == "edge":
        return moved, near[0], near[1]
    real = source == near
    rows, columns = jnp.where(real, source, NOWHERE)
    both = real[0][:, None] & real[1][None, :]
    return jnp.where(both[..., None], moved, 0), rows, columns


def tcp_crop(
    image: ArrayLike,
    uv: Vector,
    size: int,
    *,
    offset: Vector = (0, 0),
    border: str = "shift",
) -> jax.Array:
    """Square window of the image round the projected TCP (PALM, TCP-centric crop).

    The window's top left pixel is column floor(u + offset_u - size // 2), row
    floor(v + offset_v - size // 2): with offset (0, 40) the TCP sits 40 pixels above the middle.

    Args:
      image: [H, W, C] uint8 or float32.
      uv: [2] the TCP in pixels.
      size: rows and columns of the window, a Python int.
      offset: [2] (u, v) pixels from the TCP to the window's middle; may be traced (crop jitter).
      border: what happens where the window leaves the image. "shift": it is moved back inside, so
        the TCP leaves its place (the paper's code). "edge", "constant": the TCP keeps its place;
        the missing part repeats the border pixels or is zero.

    Returns:
      [size, size, C], dtype of the image. Under jit and vmap a uv outside the image follows the
      same rules, and a uv that is not finite is taken as 0; use the flag of `align` or
      `Camera.sees` to drop such frames.

    Raises:
      ShapeError, DtypeError: not an HWC image of uint8 or float; uv not [2].
      OptionError: unknown border; size not a positive int or larger than the image.
      ProjectionError: a concrete uv outside the image.
    """
    image = as_image(image, "image")
    uv = as_single(uv, "uv", (2,))
    height, width, _ = image.shape
    check_fits(size, height, width, "size")
    check_choice(border, "border", BORDERS)
    _check_uv(uv, height, width)
    return _tcp_crop(image, uv, jnp.asarray(offset, jnp.float32), size, border)


@partial(jax.jit, static_argnames=("size", "border"))
def _tcp_crop(
    image: jax.Array, uv: jax.Array, offset: jax.Array, size: int, border: str
) -> jax.Array:
    return cut_window(image, crop_origin(uv, size, offset), size, border)[0]


def _check_uv(uv: jax.Array, height: int, width: int) -> None:
    if not is_concrete(uv):
        return
    u, v = np.asarray(uv).tolist()
    if not (0 <= u < width and 0 <= v < height):
        raise ProjectionError(
            f"uv: expected a point inside the {height} x {width} image, got ({u:.1f}, {v:.1f}); "
            "check the camera pose and that uv is (u right, v down) in this image's pixels"
        )


def _taps(size_in: int, size_out: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the two source pixels of each output pixel, and the weight of the second."""
    # In float32 like the reference: float64 positions truncate differently on 2 % of the values.
    scale = np.float32(size_in) / np.float32(size_out)
    position = (np.arange(size_out, dtype=np.float32) + np.float32(0.5)) * scale - np.float32(0.5)
    position = np.clip(position, 0, size_in - 1)
    first = position.astype(np.int32)
    return first, np.minimum(first + 1, size_in - 1), position - first


def resize(image: ArrayLike, size: int | tuple[int, int]) -> jax.Array:
    """Bilinear resize, half-pixel centres, no antialiasing (the reference's interpolation).

    Each output pixel mixes four input pixels whatever the scale, so shrinking a lot aliases; do the
    same in training and evaluation.

    Args:
      image: [H, W, C] uint8 or float32.
      size: rows and columns, or a pair (rows, columns); Python ints.

    Returns:
      [rows, columns, C], dtype of the image; uint8 values are truncated, not rounded.

    Raises:
      ShapeError, DtypeError: not an HWC image of uint8 or float.
      OptionError: a size that is not positive.
    """
    image = as_image(image, "image")
    rows, columns = size if isinstance(size, tuple) else (size, size)
    if rows < 1 or columns < 1:
        raise OptionError(f"size: expected positive numbers of pixels, got {size!r}")
    return resize_any(image, rows, columns)


@partial(jax.jit, static_argnames=("rows", "columns"))
def resize_any(image: jax.Array, rows: int, columns: int) -> jax.Array:
    """`resize` without its checks."""
    if image.shape[:2] == (rows, columns):
        return image
    if image.dtype == jnp.uint8 and image.shape[-1] == 3:
        return resize_words(pixels.pack(image), rows, columns)
    top, bottom, down = _taps(image.shape[0], rows)
    left, right, across = _taps(image.shape[1], columns)
    # Rows first: they are contiguous copies, and only these few reach the column gather.
    upper, lower = image[top].astype(jnp.float32), image[bottom].astype(jnp.float32)
    bands = upper + down[:, None, None] * (lower - upper)
    start = bands[:, left]
    mixed = start + across[:, None] * (bands[:, right] - start)
    return mixed.astype(image.dtype)


def resize_words(words: jax.Array, rows: int, columns: int) -> jax.Array:
    """`resize` of packed pixels [H, W] to uint8 [rows, columns, 3]: a gather fetches a pixel."""
    top, bottom, down = _taps(words.shape[0], rows)
    left, right, across = _taps(words.shape[1], columns)
    # Rows, then columns, each corner for itself: with one gather for all, XLA computes what the
    # words come from (such as an overlay) anew for every corner.
    corners = [words[row][:, column] for column in (left, right) for row in (top, bottom)]
    planes = []
    for index in range(3):
        over_left, under_left, over_right, under_right = (
            pixels.channel(corner, index) for corner in corners
        )
        start = over_left + down[:, None] * (under_left - over_left)
        end = over_right + down[:, None] * (under_right - over_right)
        planes.append(start + across * (end - start))
    return pixels.unpack(planes, half=0.0)
