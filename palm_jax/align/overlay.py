"""TCP overlay: the TCP's axes drawn as arrows, its origin as a dot.

x red, y green, z blue, then a white dot; no occlusion test. An arrow is two convex shapes, a shaft
of four half-planes and a head of three; a pixel's signed distances to them say how much of it is
covered. Two ways to draw share this:

- Sharp follows the reference, which draws on the full camera image before cropping: end points
  cut to whole pixels, no antialiasing, edges as in PIL. Coverage is 0 or 1.
- Smooth is for images rendered at the policy's resolution, where the strokes are thinner than a
  pixel: end points are exact and coverage is a fraction, as the reference's strokes look after its
  resize.

About 80 operations a pixel for the smooth one, 20 for the sharp one, and no branches.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from palm_jax._checks import (
    ShapeError,
    as_image,
    as_single,
    check_pose,
    check_range,
    check_unit_range,
)
from palm_jax.align import camera as cam
from palm_jax.align import pixels

# PIL fills a polygon row by row and rounds both ends of each run to whole pixels: an edge reaches
# half a pixel along the row. (Slightly less keeps exact ties away from the limit.)
REACH = 0.47
# Pixels exactly on an edge belong to the polygon; this is for the rounding of float32.
ON_EDGE = 0.01
_COLOURS = (0x0000FF, 0x00FF00, 0xFF0000, 0xFFFFFF)  # packed words: x, y, z, dot


@dataclasses.dataclass(frozen=True)
class Strokes:
    """Sizes of the drawing: axis_length in metres, the rest in pixels of the image drawn on."""

    axis_length: float = 0.1
    thickness: float = 2.0
    arrow_length: float = 10.0
    arrow_width: float = 10.0
    dot_radius: float = 5.0

    def scaled(self, factor: float) -> Strokes:
        """The same drawing on an image with `factor` times the pixels."""
        return Strokes(
            self.axis_length,
            self.thickness * factor,
            self.arrow_length * factor,
            self.arrow_width * factor,
            self.dot_radius * factor,
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Points:
    """Where the overlay goes, in pixels."""

    uv: jax.Array  # [4, 2] origin, then the tips of x, y, z
    drawn: jax.Array  # [4] bool: in front of the camera; without the origin nothing is


def overlay_points(camera: cam.Camera, tcp: jax.Array, axis_length: ArrayLike) -> Points:
    """Project the TCP's origin and the tips of its axes."""
    steps = jnp.concatenate([jnp.zeros((3, 1)), jnp.eye(3)], 1) * axis_length
    world = tcp[:3, 3] + cam.matmul(tcp[:3, :3], steps).T
    uv, depth = cam._project(camera, world)
    ahead = depth > cam.NEAREST_DEPTH
    drawn = ahead & ahead[0]
    # What is not drawn must not poison the arithmetic of what is (a TCP of NaNs is not ahead).
    return Points(jnp.where(drawn[:, None], uv, 0.0), drawn)


def to_pixels(points: Points) -> Points:
    """Cut the points to whole pixels, as the reference does before drawing."""
    return Points(jnp.floor(points.uv), points.drawn)


def _direction(vector: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Length of a [2] vector and its unit components; (1, 0) for a zero vector."""
    square = vector[0] ** 2 + vector[1] ** 2
    zero = square < 1e-12
    length = jnp.sqrt(jnp.where(zero, 1.0, square))
    unit_x = jnp.where(zero, 1.0, vector[0] / length)
    return jnp.where(zero, 0.0, length), unit_x, vector[1] / length


def _half_plane(x: ArrayLike, y: ArrayLike, inside: ArrayLike) -> jax.Array:
    """[3] coefficients of the distance x u + y v + inside, positive within."""
    return jnp.stack([jnp.asarray(value, jnp.float32) for value in (x, y, inside)])


def _whole(value: jax.Array) -> jax.Array:
    """Round to the nearest whole number, halves away from zero."""
    return jnp.sign(value) * jnp.floor(jnp.abs(value) + 0.5)


def _whole_down(value: jax.Array) -> jax.Array:
    """Round to the nearest whole number, halves towards zero."""
    return jnp.sign(value) * jnp.ceil(jnp.abs(value) - 0.5)


def _sharp_line(end: jax.Array, thickness: ArrayLike) -> list[jax.Array]:
    """Half-planes of a line from (0, 0) to `end` (whole pixels), as PIL widens lines.

    PIL moves the line's two sides by whole pixels, so an even thickness lies off centre.
    """
    length, dx, dy = _direction(end)
    grow = (jnp.asarray(thickness, jnp.float32) - 1) / 2
    more, less = _whole(grow), _whole_down(grow)
    above = _whole_down(less * dy) * dy + _whole(more * dx) * dx
    below = _whole_down(more * dy) * dy + _whole(less * dx) * dx
    slack = REACH * jnp.abs(dy) + ON_EDGE
    return [
        _half_plane(dy, -dx, above + slack),
        _half_plane(-dy, dx, below + slack),
        _half_plane(dx, dy, REACH),
        _half_plane(-dx, -dy, length + REACH),
    ]


def _sharp_side(a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Half-plane on c's side of the line a-b, with the pixels the line touches."""
    _, dx, dy = _direction(b - a)
    side = jnp.sign(dx * (c[1] - a[1]) - dy * (c[0] - a[0]))
    nx, ny = -side * dy, side * dx
    return _half_plane(nx, ny, REACH * jnp.abs(dy) + ON_EDGE - nx * a[0] - ny * a[1])


def _sharp_arrow(tip: jax.Array, strokes: Strokes) -> jax.Array:
    """[7, 3] half-planes: shaft to `arrow_length` before the tip, triangle from there."""
    _, dx, dy = _direction(tip)
    neck = tip - strokes.arrow_length * jnp.stack([dx, dy])
    half = strokes.arrow_width / 2 * jnp.stack([-dy, dx])
    # The small number keeps 5.9999995 from becoming pixel 5 where the reference gets 6.
    neck, left, right = (jnp.floor(p + 1e-4) for p in (neck, neck + half, neck - half))
    head = [(tip, left, right), (right, tip, left), (left, right, tip)]
    return jnp.stack([*_sharp_line(neck, strokes.thickness), *(_sharp_side(*s) for s in head)])


def _smooth_arrow(tip: jax.Array, strokes: Strokes) -> jax.Array:
    """[7, 3] half-planes of the same shapes, where they are."""
    length, dx, dy = _direction(tip)
    neck, half = length - strokes.arrow_length, strokes.thickness / 2
    slope = strokes.arrow_width / (2 * max(strokes.arrow_length, 1e-6))
    lean = 1 / (1 + slope**2) ** 0.5
    return jnp.stack(
        [
            _half_plane(dy, -dx, half),
            _half_plane(-dy, dx, half),
            _half_plane(dx, dy, jnp.maximum(-neck, 0.0)),
            _half_plane(-dx, -dy, jnp.maximum(neck, 0.0)),
            _half_plane(lean * (dy - slope * dx), lean * (-dx - slope * dy), lean * slope * length),
            _half_plane(lean * (-dy - slope * dx), lean * (dx - slope * dy), lean * slope * length),
            _half_plane(dx, dy, -neck),
        ]
    )


def _planes(points: Points, strokes: Strokes, *, sharp: bool) -> jax.Array:
    """[3, 7, 3] half-planes of the x, y, z arrows in pixels from the origin: four of the shaft,
    three of the head. Nothing is inside of an arrow that is not drawn, or that has no length."""
    arrow = _sharp_arrow if sharp else _smooth_arrow
    tips = points.uv[1:] - points.uv[0]
    planes = jax.vmap(lambda tip: arrow(tip, strokes))(tips)
    drawn = points.drawn[1:] & (jnp.abs(tips).max(-1) > 1e-6)
    return jnp.where(drawn[:, None, None], planes, jnp.asarray([0.0, 0.0, -1e3]))


def coverage(
    points: Points, strokes: Strokes, rows: jax.Array, columns: jax.Array
) -> list[jax.Array]:
    """Four [H, W] coverages in [0, 1], for the x, y, z arrows and the dot: smooth.

    Args:
      points: in pixels.
      strokes: sizes, in pixels of the same frame; Python numbers.
      rows, columns: int [H], [W] pixel numbers, in the frame of the points.
    """
    # The reference names a pixel by its corner, and so draws half a pixel up-left of its centre.
    x = (columns.astype(jnp.float32) + (0.5 - points.uv[0, 0]))[None, :]
    y = (rows.astype(jnp.float32) + (0.5 - points.uv[0, 1]))[:, None]
    planes = _planes(points, strokes, sharp=False)
    depths = []
    for axis in range(3):
        distance = [nx * x + (ny * y + inside) for nx, ny, inside in planes[axis]]
        shaft = jnp.minimum(jnp.minimum(*distance[:2]), jnp.minimum(*distance[2:4]))
        head = jnp.minimum(jnp.minimum(*distance[4:6]), distance[6])
        depths.append(jnp.maximum(shaft, head))
    # (r^2 - d^2) / 2r equals r - d at the rim, where it matters, and needs no square root.
    radius = jnp.maximum(jnp.asarray(strokes.dot_radius, jnp.float32), 1e-6)
    dot = (radius * radius - (x * x + y * y)) / (2 * radius)
    depths.append(jnp.where(points.drawn[0], dot, -1e3))
    return [jnp.clip(depth + 0.5, 0.0, 1.0) for depth in depths]


def masks(points: Points, strokes: Strokes, rows: jax.Array, columns: jax.Array) -> list[jax.Array]:
    """Four bool [H, W], the pixels of the x, y, z arrows and the dot as PIL draws them: sharp.

    Args:
      points: on whole pixels.
      strokes, rows, columns: see `coverage`.
    """
    x = columns.astype(jnp.float32) - points.uv[0, 0]
    y = rows.astype(jnp.float32) - points.uv[0, 1]
    # A row cuts a convex shape in one run of pixels: two comparisons a pixel instead of the
    # distances to all its sides.
    low, high = _runs(_planes(points, strokes, sharp=True), y)
    inside = (x >= low[..., None]) & (x <= high[..., None])
    # PIL's disc in a box of +-r pixels holds the centres within about r + 3/8.
    radius = jnp.asarray(strokes.dot_radius, jnp.float32)
    reach = jnp.where(points.drawn[0], radius * (radius + 0.75), -1.0)
    dot = (x * x)[None, :] + (y * y)[:, None] <= reach
    return [*(inside[axis, 0] | inside[axis, 1] for axis in range(3)), dot]


def _runs(planes: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First and last x [3, 2, H] of each arrow's shaft and head in the rows at `y` [H]; the first
    beyond the last where there is none."""
    slope = planes[..., 0, None]
    offset = planes[..., 1, None] * y + planes[..., 2, None]
    level = jnp.abs(slope) < 1e-9  # a side along the row: all of it or nothing
    bound = -offset / jnp.where(level, 1.0, slope)
    nowhere = jnp.where(offset >= 0.0, -jnp.inf, jnp.inf)
    low = jnp.where(level, nowhere, jnp.where(slope > 0.0, bound, -jnp.inf))
    high = jnp.where(~level & (slope < 0.0), bound, jnp.inf)
    parts = (slice(0, 4), slice(4, 7))
    return (
        jnp.stack([low[:, part].max(1) for part in parts], 1),
        jnp.stack([high[:, part].min(1) for part in parts], 1),
    )


def paint(image: jax.Array, covered: list[jax.Array]) -> jax.Array:
    """Lay red, green, blue, white over an image [H, W, 3] in that order, by their coverages."""
    red, green, blue, white = covered
    rest = 1 - white
    blue_left = 1 - blue
    green_left = (1 - green) * blue_left
    keep = (1 - red) * green_left * rest
    added = (red * green_left * rest + white, green * blue_left * rest + white, blue * rest + white)
    if image.dtype != jnp.uint8:
        return image * keep[..., None] + jnp.stack(added, -1)
    packed = pixels.pack(image)
    return pixels.unpack([pixels.channel(packed, i) * keep + 255 * added[i] for i in range(3)])


def stamp(image: jax.Array, drawn: list[jax.Array]) -> jax.Array:
    """Red, green, blue, white in that order over the pixels of the masks [H, W] of an image: packed
    words [H, W], or float [H, W, 3]."""
    for mask, colour in zip(drawn, _COLOURS, strict=True):
        if image.dtype == jnp.uint32:
            image = jnp.where(mask, jnp.uint32(colour), image)
        else:
            value = np.array([(colour >> shift) & 1 for shift in (0, 8, 16)], image.dtype)
            image = jnp.where(mask[..., None], value, image)
    return image


@jax.jit
def _tcp_overlay(
    image: jax.Array, camera: cam.Camera, tcp: jax.Array, strokes: dict[str, ArrayLike]
) -> jax.Array:
    style = Strokes(**strokes)  # type: ignore[arg-type]
    points = to_pixels(overlay_points(camera, tcp, style.axis_length))
    rows, columns = jnp.arange(camera.height), jnp.arange(camera.width)
    drawn = masks(points, style, rows, columns)
    if image.dtype != jnp.uint8:
        return stamp(image, drawn)
    return pixels.unpack_words(stamp(pixels.pack(image), drawn))


def tcp_overlay(
    image: ArrayLike,
    camera: cam.Camera,
    tcp: ArrayLike,
    *,
    axis_length: ArrayLike = 0.1,
    thickness: ArrayLike = 2.0,
    arrow_length: ArrayLike = 10.0,
    arrow_width: ArrayLike = 10.0,
    dot_radius: ArrayLike = 5.0,
) -> jax.Array:
    """Draw the TCP's axes and origin on the camera's image (PALM, TCP overlay).

    Arrows in the order x red, y green, z blue, then a white dot, as the reference draws them: end
    points cut to whole pixels; each shaft ends `arrow_length` before the tip, where a triangle of
    that length begins; an axis shorter than that has a shaft that runs backwards. Nothing hides
    the drawing. A calibration error (overlay jitter) is a shift of the principal point:
    `camera.cropped(-jitter, height, width)`.

    Args:
      image: [H, W, 3] uint8 or float32 in [0, 1], the camera's size.
      camera: the camera that took the image.
      tcp: [4, 4] TCP pose in the world.
      axis_length: metres.
      thickness, arrow_length, arrow_width, dot_radius: pixels; `arrow_width` is the whole base.

    Returns:
      [H, W, 3], dtype of the image. Under jit and vmap: nothing is drawn if the TCP lies behind
      the camera, an axis whose tip does is left out, and what falls outside the image is cut off.

    Raises:
      ShapeError, DtypeError: image not [H, W, 3] of uint8 or float; tcp not [4, 4].
      OptionError: concrete float pixels outside [0, 1]; a negative size.
      CameraError, PoseError: see `Camera.check`; concrete tcp not a rigid pose.
      ProjectionError: concrete TCP behind the camera or outside its image.
    """
    image = as_image(image, "image", rgb=True)
    tcp = as_single(tcp, "tcp", (4, 4))
    camera.check()
    check_size(image, camera)
    check_pose(tcp, "tcp")
    cam.check_tcp_in_view(camera, tcp, "tcp")
    check_unit_range(image, "image")
    strokes = {
        "axis_length": axis_length,
        "thickness": thickness,
        "arrow_length": arrow_length,
        "arrow_width": arrow_width,
        "dot_radius": dot_radius,
    }
    for name, value in strokes.items():
        check_range(value, name, 0.0, float("inf"))
    return _tcp_overlay(image, camera, tcp, strokes)


def check_size(image: jax.Array, camera: cam.Camera) -> None:
    """Raise ShapeError unless the image has the camera's size."""
    if image.shape[:2] != (camera.height, camera.width):
        raise ShapeError(
            f"image: expected the camera's {camera.height} x {camera.width} pixels, got "
            f"{image.shape[0]} x {image.shape[1]}; use camera.scaled or camera.cropped to describe "
            "a resized or cropped image"
        )
