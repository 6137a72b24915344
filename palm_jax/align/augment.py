"""Random augmentation of image batches, for training only.

Each random op draws and then calls a deterministic one, which is public too: `random_overlay` ->
`overlay_blend`, `random_perspective` -> `perspective_warp`, `random_turn` -> `turn_view`,
`random_crop` -> `subpixel_crop`.
Batches are [B, H, W, C], uint8 or float32 in [0, 1]; the dtype is kept and uint8 results are
rounded to nearest. Keep images uint8 until the last op: it is several times faster. The reference's
order is perspective, overlay, normalisation, crop.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from palm_jax._checks import (
    CameraError,
    OptionError,
    ShapeError,
    as_float,
    as_image,
    as_single,
    check_fits,
    check_range,
    is_concrete,
)
from palm_jax.align.camera import Camera, matmul


def _to_dtype(image: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """float32 values on the scale of `dtype`: 0..255 for uint8, 0..1 for floats."""
    if image.dtype == dtype:
        return image.astype(jnp.float32)
    return image * 255 if dtype == jnp.uint8 else image.astype(jnp.float32) / 255


def _from_float(values: jax.Array, dtype: jnp.dtype) -> jax.Array:
    return (values + 0.5).astype(dtype) if dtype == jnp.uint8 else values


def overlay_blend(image: ArrayLike, background: ArrayLike, alpha: ArrayLike) -> jax.Array:
    """(1 - alpha) image + alpha background.

    Args:
      image: [H, W, C] uint8 or float32 in [0, 1].
      background: [H, W, C], either dtype.
      alpha: scalar in [0, 1].

    Returns:
      [H, W, C], dtype of `image`.

    Raises:
      ShapeError, DtypeError: shapes differ, or not HWC images of uint8 or float.
      OptionError: a concrete alpha outside [0, 1].
    """
    image, background = as_image(image, "image"), as_image(background, "background")
    if image.shape != background.shape:
        raise ShapeError(
            f"background: expected the image's shape {list(image.shape)}, got "
            f"{list(background.shape)}; resize it first"
        )
    check_range(alpha, "alpha", 0.0, 1.0)
    return _blend(image, background, jnp.asarray(alpha, jnp.float32))


@jax.jit
def _blend(image: jax.Array, background: jax.Array, alpha: jax.Array) -> jax.Array:
    start = image.astype(jnp.float32)
    mixed = start + alpha * (_to_dtype(background, image.dtype) - start)
    return _from_float(mixed, image.dtype)


def _if_any(
    chosen: jax.Array, op: Callable[..., jax.Array], images: jax.Array, *args: Any
) -> jax.Array:
    """op(images, *args) if any image is chosen, else the images.

    Saves the work where an augmentation is off. The branch also stores its result: without one, XLA
    would redo the whole op for each tap of the gather in the next op.
    """
    return lax.cond(chosen.any(), op, lambda images, *_: images, images, *args)


def random_overlay(
    key: jax.Array,
    images: ArrayLike,
    bank: ArrayLike,
    *,
    fraction: float = 0.5,
    alpha: ArrayLike = 0.5,
) -> jax.Array:
    """Blend a random background into a random part of the batch (PALM, Random Overlay).

    Exactly int(fraction * B) images are chosen without replacement; each gets a background drawn
    from the bank with replacement.

    Args:
      key: PRNG key.
      images: [B, H, W, C] uint8 or float32 in [0, 1].
      bank: [N, H, W, C] backgrounds of the same size, either dtype, e.g. `procedural_bank`.
      fraction: part of the batch, a Python number in [0, 1].
      alpha: weight of the background; may be traced (0 while warming up).

    Returns:
      [B, H, W, C], dtype of `images`; images not chosen are unchanged.

    Raises:
      ShapeError, DtypeError: not batches of HWC images of uint8 or float, or of different sizes.
      OptionError: fraction traced or outside [0, 1]; a concrete alpha outside [0, 1].
    """
    images, bank = as_image(images, "images", rank=4), as_image(bank, "bank", rank=4)
    if bank.shape[1:] != images.shape[1:] or bank.shape[0] == 0:
        raise ShapeError(
            f"bank: expected [N, {', '.join(map(str, images.shape[1:]))}] with N of at least 1, "
            f"got {list(bank.shape)}; resize the backgrounds to the images"
        )
    if not is_concrete(fraction):
        raise OptionError(
            "fraction: expected a Python number (the count is fixed while tracing), got a tracer; "
            "switch the overlay off and on with alpha instead"
        )
    check_range(fraction, "fraction", 0.0, 1.0)
    check_range(alpha, "alpha", 0.0, 1.0)
    count = int(fraction * images.shape[0])
    return _random_overlay(key, images, bank, count, jnp.asarray(alpha, jnp.float32))


@partial(jax.jit, static_argnames="count")
def _random_overlay(
    key: jax.Array, images: jax.Array, bank: jax.Array, count: int, alpha: jax.Array
) -> jax.Array:
    batch = images.shape[0]
    order_key, bank_key = jax.random.split(key)
    chosen = jax.random.permutation(order_key, batch) < count
    pick = jax.random.randint(bank_key, (batch,), 0, bank.shape[0])
    weights = jnp.where(chosen, alpha, 0.0)
    return _if_any(weights > 0, _blend_picked, images, bank, pick, weights)


def _blend_picked(
    images: jax.Array, bank: jax.Array, pick: jax.Array, weights: jax.Array
) -> jax.Array:
    return jax.vmap(_blend)(images, bank[pick], weights)


def perspective_warp(image: ArrayLike, corners: ArrayLike) -> jax.Array:
    """Move the image's corners and everything between by the homography that does so.

    Bilinear; what comes from outside the image is black.

    Args:
      image: [H, W, 3] uint8 or float32.
      corners: [4, 2] (u, v) in pixels: where the outer corners (0, 0), (W, 0), (W, H), (0, H) of
        the image go, in this order.

    Returns:
      [H, W, 3], dtype of the image. Under jit and vmap, corners that are not those of a convex
      quadrilateral give black pixels where no source point exists.

    Raises:
      ShapeError, DtypeError: not an RGB image of uint8 or float; corners not [4, 2].
      OptionError: concrete corners that are not convex, or not in this order.
    """
    image = as_image(image, "image", rgb=True)
    corners = as_single(corners, "corners", (4, 2))
    if is_concrete(corners):
        edges = np.roll(np.asarray(corners), -1, 0) - np.asarray(corners)
        following = np.roll(edges, -1, 0)
        turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
        if not (turns > 0).all():
            raise OptionError(
                "corners: expected a convex quadrilateral in the order top left, top right, "
                f"bottom right, bottom left, got {np.asarray(corners).tolist()}"
            )
    return _warp(image, corners)


def _pull_matrix(corners: jax.Array) -> list[list[jax.Array]]:
    """3x3 from output (u, v, 1) to source (s, t, 1) times a positive number, s and t in 0..1.

    The map of the unit square to a quadrilateral in closed form, and its adjugate as the inverse.
    """
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners
    ax, ay, bx, by = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    sx, sy = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    area = ax * by - bx * ay
    g, h = (sx * by - bx * sy) / area, (ax * sy - sx * ay) / area
    a, b, c = x1 - x0 + g * x1, x3 - x0 + h * x3, x0
    d, e, f = y1 - y0 + g * y1, y3 - y0 + h * y3, y0
    return [
        [e - f * h, c * h - b, b * f - c * e],
        [f * g - d, a - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]


def _source_points(
    corners: jax.Array, active: jax.Array | bool, height: int, width: int
) -> tuple[jax.Array, jax.Array]:
    """[H, W] columns and rows of the source, as pixel indices within -1 .. W and -1 .. H."""
    x = np.arange(width, dtype=np.float32)[None, :]
    y = np.arange(height, dtype=np.float32)[:, None]
    pull = _pull_matrix(corners)
    u, v, w = (row[0] * (x + 0.5) + (row[1] * (y + 0.5) + row[2]) for row in pull)
    # Points behind the horizon divide by NaN, and NaN fails the comparison below. Everything after
    # the two divisions is cheap: XLA stores the results of divisions that have several users, and
    # computes the rest anew for each of the four gathers.
    w = jnp.where(w > 0, w, jnp.nan)
    points = []
    for source, at, size in ((u, x, width), (v, y, height)):
        position = source * size / w - 0.5
        position = jnp.where(position > -1, jnp.minimum(position, size), -1.0)
        # Choosing here and not between two images is exact, too, and halves the cost.
        points.append(jnp.where(active, position, at))
    return points[0], points[1]


def _taps(position: jax.Array, size: int) -> list[tuple[jax.Array, jax.Array]]:
    """The two pixels on either side of a position, with their weights: 0 outside the image."""
    floor = jnp.floor(position)
    taps = []
    for pixel, weight in ((floor, 1 - (position - floor)), (floor + 1, position - floor)):
        real = (pixel >= 0) & (pixel < size)
        index = jnp.clip(pixel, 0, size - 1).astype(jnp.int32)
        taps.append((index, jnp.where(real, weight, 0.0)))
    return taps


def _sample(image: jax.Array, column: jax.Array, row: jax.Array) -> jax.Array:
    """Bilinear samples at pixel indices within -1 .. W and -1 .. H; black beyond the image."""
    height, width, depth = image.shape
    # Weights instead of a black margin: padding would pull the ops before it into a slow loop.
    source = image.reshape(height * width, depth)
    total = jnp.zeros((), jnp.float32)
    for row_index, down in _taps(row, height):
        for column_index, across in _taps(column, width):
            pixel = source.at[row_index * width + column_index].get(mode="promise_in_bounds")
            total += (down * across)[..., None] * pixel.astype(jnp.float32)
    return _from_float(total, image.dtype)


@jax.jit
def _warp(image: jax.Array, corners: jax.Array, active: jax.Array | bool = True) -> jax.Array:
    return _sample(image, *_source_points(corners, active, *image.shape[:2]))


def random_perspective(
    key: jax.Array,
    images: ArrayLike,
    *,
    distortion: ArrayLike = 0.2,
    probability: ArrayLike = 0.5,
) -> jax.Array:
    """Mild random perspective, drawn per image (PALM, perspective augmentation).

    Each corner of a warped image moves inwards by U(0, distortion * W / 2) and
    U(0, distortion * H / 2) pixels; the outside is black. Actions and proprioception stay as they
    are.

    Args:
      key: PRNG key.
      images: [B, H, W, 3] uint8 or float32.
      distortion: in [0, 1).
      probability: chance of each image to be warped.

    Returns:
      [B, H, W, 3], dtype of `images`; images not drawn are unchanged.

    Raises:
      ShapeError, DtypeError: not a batch of RGB images of uint8 or float.
      OptionError: concrete distortion or probability outside their ranges.
    """
    images = as_image(images, "images", rank=4, rgb=True)
    check_range(distortion, "distortion", 0.0, 0.999)
    check_range(probability, "probability", 0.0, 1.0)
    strength = jnp.asarray(distortion, jnp.float32), jnp.asarray(probability, jnp.float32)
    return _random_perspective(key, images, *strength)


@jax.jit
def _random_perspective(
    key: jax.Array, images: jax.Array, distortion: jax.Array, probability: jax.Array
) -> jax.Array:
    batch, height, width, _ = images.shape
    corner_key, choice_key = jax.random.split(key)
    outer = jnp.asarray([[0, 0], [width, 0], [width, height], [0, height]], jnp.float32)
    inwards = jnp.asarray([[1, 1], [-1, 1], [-1, -1], [1, -1]], jnp.float32)
    reach = distortion / 2 * jnp.asarray([width, height], jnp.float32)
    moves = jax.random.uniform(corner_key, (batch, 4, 2)) * reach * inwards
    chosen = jax.random.bernoulli(choice_key, probability, (batch,))
    return _if_any(chosen, jax.vmap(_warp), images, outer + moves, chosen)


def _crop_step(full: int, size: int) -> float:
    """Distance of two samples: the reference's grid spans size / full of the pixel centres."""
    return size / full * (full - 1) / (size - 1) if size > 1 else 0.0


def turn_view(image: ArrayLike, camera: Camera, turned: Camera) -> jax.Array:
    """The image that the camera would have taken, had it been turned about its own centre.

    Exact but for the pixels: no depth is needed, because turning shows nothing new. Bilinear;
    beyond the image its border pixels are repeated.

    Args:
      image: [H, W, 3] uint8 or float32.
      camera: the camera that took it.
      turned: where it looks instead, at the same place; its K may differ. See `Camera.turned`.

    Returns:
      [H, W, 3], dtype of the image. Pixels whose ray runs behind the old camera are those of the
      border.

    Raises:
      ShapeError, DtypeError: not an RGB image of uint8 or float.
      CameraError: concrete cameras at two places.
      PoseError: see `Camera.check`.
    """
    image = as_image(image, "image", rgb=True)
    camera.check()
    turned.check()
    if is_concrete((camera, turned)):
        apart = np.linalg.norm(
            np.asarray(camera.cam_to_world)[:3, 3] - np.asarray(turned.cam_to_world)[:3, 3]
        )
        if apart > 1e-4:
            raise CameraError(
                f"turned: expected a camera at the place of the first, got one {apart:.4f} m away; "
                "a camera that moves sees other things, which no warp can show"
            )
    return _turn_view(image, camera, turned)


def _turn_homography(camera: Camera, turned: Camera) -> jax.Array:
    """[3, 3] from a pixel (u, v, 1) of the turned camera to one of the first, times a number."""
    old, new = (jnp.asarray(c.cam_to_world, jnp.float32)[:3, :3] for c in (camera, turned))
    # In closed form: batched 3x3 solvers are slow on CPUs.
    fx, skew, cx = turned.K[0, 0], turned.K[0, 1], turned.K[0, 2]
    fy, cy = turned.K[1, 1], turned.K[1, 2]
    zero, one = jnp.zeros_like(fx), jnp.ones_like(fx)
    back = jnp.stack(
        [
            jnp.stack([1 / fx, -skew / (fx * fy), (skew * cy - cx * fy) / (fx * fy)]),
            jnp.stack([zero, 1 / fy, -cy / fy]),
            jnp.stack([zero, zero, one]),
        ]
    )
    return matmul(jnp.asarray(camera.K, jnp.float32), matmul(matmul(old.T, new), back))


@jax.jit
def _turn_view(
    image: jax.Array, camera: Camera, turned: Camera, active: jax.Array | bool = True
) -> jax.Array:
    height, width, _ = image.shape
    pull = _turn_homography(camera, turned)
    x = np.arange(width, dtype=np.float32)[None, :]
    y = np.arange(height, dtype=np.float32)[:, None]
    u, v, w = (row[0] * (x + 0.5) + (row[1] * (y + 0.5) + row[2]) for row in pull)
    w = jnp.maximum(w, 1e-6)
    points = []
    for source, at, size in ((u, x, width), (v, y, height)):
        position = jnp.clip(source / w - 0.5, 0.0, size - 1.0)
        points.append(jnp.where(active, position, at))
    return _sample(image, *points)


def random_turn(
    key: jax.Array,
    images: ArrayLike,
    cameras: Camera,
    points: ArrayLike,
    *,
    pan: ArrayLike = 0.35,
    tilt: ArrayLike = 0.17,
    probability: ArrayLike = 0.5,
) -> tuple[jax.Array, Camera]:
    """Images as if each camera had been turned a little about its own centre, with that camera.

    A perspective augmentation that stays consistent: an object at the side of the frame is seen
    under another angle than the camera's rotation suggests, and a policy whose rotation input is
    in the camera's frame must learn which of the two counts. Compute the proprioception with the
    camera that is returned.

    Args:
      key: PRNG key.
      images: [B, H, W, 3] uint8 or float32.
      cameras: the cameras that took them, leaves with a leading axis [B]; of a cropped image, see
        `Camera.cropped`.
      points: [B, 3] points that keep their pixels (the TCPs), metres in the world.
      pan, tilt: largest angles, radians; see `Camera.turned`.
      probability: chance of each image to be turned.

    Returns:
      images [B, H, W, 3] of the same dtype, and the turned cameras; images and cameras that are
      not drawn are unchanged.

    Raises:
      ShapeError, DtypeError: not a batch of RGB images of uint8 or float; points not [B, 3].
      OptionError: concrete angles outside 0 .. 1.5, or probability outside 0 .. 1.
    """
    images = as_image(images, "images", rank=4, rgb=True)
    check_range(pan, "pan", 0.0, 1.5)
    check_range(tilt, "tilt", 0.0, 1.5)
    check_range(probability, "probability", 0.0, 1.0)
    points = as_float(points, "points", (3,))
    if points.shape[:-1] != images.shape[:1]:
        raise ShapeError(
            f"points: expected one for each of the {images.shape[0]} images, [B, 3], got "
            f"{list(points.shape)}"
        )
    limits = jnp.asarray([pan, tilt], jnp.float32)
    return _random_turn(key, images, cameras, points, limits, jnp.asarray(probability, jnp.float32))


@jax.jit
def _random_turn(
    key: jax.Array,
    images: jax.Array,
    cameras: Camera,
    points: jax.Array,
    limits: jax.Array,
    probability: jax.Array,
) -> tuple[jax.Array, Camera]:
    batch = images.shape[0]
    angle_key, choice_key = jax.random.split(key)
    chosen = jax.random.uniform(choice_key, (batch,)) < probability
    angles = jax.random.uniform(angle_key, (batch, 2), minval=-1.0, maxval=1.0) * limits
    angles = jnp.where(chosen[:, None], angles, 0.0)
    turned = jax.vmap(lambda camera, a, point: camera.turned(a[0], a[1], point))(
        cameras, angles, points
    )
    return _if_any(chosen, jax.vmap(_turn_view), images, cameras, turned, chosen), turned


def _slack(full: int, size: int) -> float:
    """Largest start of a crop whose samples stay between the first and the last pixel centre."""
    return (full - 1) * (1 - size / full)


def subpixel_crop(image: ArrayLike, start: ArrayLike, size: int) -> jax.Array:
    """Bilinear crop at a fractional position, as the reference samples it.

    Sample i of an axis of n pixels lies at start + i * step in pixel indices (0 is the centre of
    the first pixel), where step = size / n * (n - 1) / (size - 1): the grid covers size / n of the
    span between the outer pixel centres, so the crop is shrunk by a thousandth or so.

    Args:
      image: [H, W, C] uint8 or float32.
      start: [2] (u, v) position of the first sample, limited to 0 .. (n - 1) (1 - size / n).
      size: rows and columns of the crop, a Python int.

    Returns:
      [size, size, C], dtype of the image. A start that is not finite counts as 0.

    Raises:
      ShapeError, DtypeError: not an HWC image of uint8 or float; start not [2].
      OptionError: size not a positive int or larger than the image.
    """
    image = as_image(image, "image")
    start = as_single(start, "start", (2,))
    check_fits(size, image.shape[0], image.shape[1], "size")
    return _subpixel_crop(image, start, size)


@partial(jax.jit, static_argnames="size")
def _subpixel_crop(image: jax.Array, start: jax.Array, size: int) -> jax.Array:
    height, width, _ = image.shape
    count = np.arange(size, dtype=np.float32)
    start = jnp.where(jnp.isfinite(start), start, 0.0)
    column, row = (
        jnp.clip(at, 0.0, _slack(full, size)) + count * np.float32(_crop_step(full, size))
        for at, full in ((start[0], width), (start[1], height))
    )
    # Rounding must not carry the last sample past the last pixel, where black begins.
    column, row = jnp.minimum(column, width - 1), jnp.minimum(row, height - 1)
    return _sample(image, column[None, :], row[:, None])


def random_crop(key: jax.Array, images: ArrayLike, size: int) -> jax.Array:
    """A random window of each image at sub-pixel positions (the reference's CropRandomizer).

    Args:
      key: PRNG key.
      images: [B, H, W, C] uint8 or float32.
      size: rows and columns of the crop, a Python int.

    Returns:
      [B, size, size, C], dtype of `images`: `subpixel_crop` with a start drawn uniformly over all
      positions, per image and axis.

    Raises:
      ShapeError, DtypeError: not a batch of HWC images of uint8 or float.
      OptionError: size not a positive int or larger than the images.
    """
    images = as_image(images, "images", rank=4)
    _, height, width, _ = images.shape
    check_fits(size, height, width, "size")
    return _random_crop(key, images, size)


@partial(jax.jit, static_argnames="size")
def _random_crop(key: jax.Array, images: jax.Array, size: int) -> jax.Array:
    batch, height, width, _ = images.shape
    most = jnp.asarray([_slack(width, size), _slack(height, size)], jnp.float32)
    starts = jax.random.uniform(key, (batch, 2)) * most
    return jax.vmap(lambda image, start: _subpixel_crop(image, start, size))(images, starts)


def center_crop(images: ArrayLike, size: int) -> jax.Array:
    """The middle window, for evaluation: whole pixels, rounded up-left if the margin is odd.

    It lies within 0.05 pixels of `subpixel_crop` at its mean start for 76 of 84 pixels, and costs
    nothing.

    Args:
      images: [..., H, W, C] uint8 or float32.
      size: rows and columns of the crop, a Python int.

    Returns:
      [..., size, size, C], dtype of `images`.

    Raises:
      ShapeError, DtypeError: not HWC images of uint8 or float.
      OptionError: size not a positive int or larger than the images.
    """
    rank = max(3, np.ndim(images))
    images = as_image(images, "images", rank=rank)
    height, width = images.shape[-3:-1]
    check_fits(size, height, width, "size")
    top, left = (height - size) // 2, (width - size) // 2
    return images[..., top : top + size, left : left + size, :]
