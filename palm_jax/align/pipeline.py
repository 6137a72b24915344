"""The whole alignment of a frame: overlay, crop, resize, proprioception.

`align` takes a full camera image. Where the renderer can be asked for a part of the frame at the
policy's resolution, three helpers do the same for less: `AlignSpec.view_camera` (the frame,
scaled), `window_origin` (which window of it to render) and `align_window` (overlay and
proprioception).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from palm_jax._checks import (
    OptionError,
    ShapeError,
    Vector,
    as_image,
    as_single,
    check_choice,
    check_fits,
    check_pose,
    check_unit_range,
)
from palm_jax.align import camera as cam
from palm_jax.align import crop as cropping
from palm_jax.align import overlay as drawing
from palm_jax.align import pixels
from palm_jax.align.isolate import GRID, isolate
from palm_jax.align.proprio import LAYOUTS, _proprio


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True, kw_only=True)
class AlignSpec:
    """What a policy sees. Static under jit (a pytree without leaves, hashable).

    Attributes:
      crop: pixels per side of the TCP-centric window in the camera image; None for the full frame.
      offset: (u, v) pixels from the TCP to the window's middle; (0, 40) puts the TCP above it.
      size: pixels per side of the policy's image.
      overlay: draw the TCP overlay.
      layout: of the proprioception, see `proprio`.
      border: "shift", "edge" or "constant", see `tcp_crop`.
      axis_length: of the overlay, metres.
      thickness, arrow_length, arrow_width, dot_radius: of the overlay, pixels of the camera image.
      isolate: show only what a mask says, on a black grid (`palm_jax.align.isolate`); the mask is
        passed along with the image.
      frame: rows of the camera image that the stroke sizes refer to. Only `align_window` with
        crop=None needs it: nothing else tells how much its image was scaled.

    Raises:
      OptionError: a value that no image can satisfy.
    """

    crop: int | None = 200
    offset: tuple[float, float] = (0, 40)
    size: int = 84
    overlay: bool = True
    layout: str = "cam6d_z"
    border: str = "shift"
    axis_length: float = 0.1
    thickness: float = 2.0
    arrow_length: float = 10.0
    arrow_width: float = 10.0
    dot_radius: float = 5.0
    isolate: bool = False
    frame: int = 512

    def __post_init__(self) -> None:
        check_choice(self.layout, "AlignSpec.layout", tuple(LAYOUTS))
        check_choice(self.border, "AlignSpec.border", cropping.BORDERS)
        # A list would make the spec unhashable, and jit fail far from here.
        object.__setattr__(self, "offset", tuple(self.offset))
        if len(self.offset) != 2:
            raise OptionError(f"AlignSpec.offset: expected (u, v), got {self.offset!r}")
        for name in ("crop", "size", "frame"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, (int, np.integer)) or value < 1):
                raise OptionError(
                    f"AlignSpec.{name}: expected a positive whole number of pixels, got {value!r}"
                )
        for name in ("axis_length", "thickness", "arrow_length", "arrow_width", "dot_radius"):
            if not getattr(self, name) >= 0:
                raise OptionError(
                    f"AlignSpec.{name}: expected a number of at least 0, got {getattr(self, name)}"
                )

    @property
    def scale(self) -> float:
        """Pixels of the policy's image per pixel of the camera image."""
        return self.size / (self.frame if self.crop is None else self.crop)

    @property
    def strokes(self) -> drawing.Strokes:
        """Sizes of the overlay in the camera image."""
        return drawing.Strokes(
            self.axis_length,
            self.thickness,
            self.arrow_length,
            self.arrow_width,
            self.dot_radius,
        )

    @property
    def proprio_size(self) -> int:
        """Length of the proprioception vector."""
        return LAYOUTS[self.layout]

    def view_camera(self, camera: cam.Camera) -> cam.Camera:
        """The frame at the policy's resolution: a crop of `size` pixels is the policy's image.

        With crop=None the whole frame becomes size x size pixels.

        Raises:
          OptionError: the crop does not fit the frame, or crop=None with an overlay and a frame of
            other than `frame` rows.
        """
        if self.crop is not None:
            check_fits(self.crop, camera.height, camera.width, "AlignSpec.crop")
            return camera.scaled(self.scale)
        if self.overlay and camera.height != self.frame:
            raise OptionError(
                f"AlignSpec.frame: expected the camera's {camera.height} rows, got {self.frame}; "
                "set frame to the camera's height, so that strokes get the right size"
            )
        return camera.scaled((self.size / camera.width, self.size / camera.height))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Aligned:
    """A policy's input. Unpacks into (image, proprio)."""

    image: jax.Array  # [size, size, 3], dtype of the camera image
    proprio: jax.Array  # [n] float32
    valid: jax.Array  # bool: the TCP is in front of the camera and inside its image

    def __iter__(self) -> Iterator[jax.Array]:
        """Iterate over image and proprio."""
        return iter((self.image, self.proprio))


def _jittered(points: drawing.Points, jitter: Vector | None) -> drawing.Points:
    if jitter is None:
        return points
    return dataclasses.replace(points, uv=points.uv + jnp.asarray(jitter, jnp.float32))


def _seen(camera: cam.Camera, tcp: jax.Array) -> tuple[jax.Array, jax.Array]:
    uv, depth = cam._project(camera, tcp[:3, 3])
    return uv, cam.inside(camera, uv, depth)


@jax.jit
def _align(
    image: jax.Array,
    camera: cam.Camera,
    tcp: jax.Array,
    opening: jax.Array,
    spec: AlignSpec,
    mask: jax.Array | None,
    crop_jitter: Vector | None,
    overlay_jitter: Vector | None,
) -> Aligned:
    uv, valid = _seen(camera, tcp)
    if mask is not None:
        image = isolate(image, mask)
    rows, columns = jnp.arange(camera.height), jnp.arange(camera.width)
    if spec.crop is not None:
        # The window is cut before drawing, so that only its pixels are touched. Strokes depend on
        # a pixel's place in the full image alone: they come out as if drawn before.
        uv = uv if crop_jitter is None else uv + jnp.asarray(crop_jitter, jnp.float32)
        wanted = cropping.crop_origin(uv, spec.crop, spec.offset)
        image, rows, columns = cropping.cut_window(image, wanted, spec.crop, spec.border)
    if spec.overlay:
        points = drawing.overlay_points(camera, tcp, spec.axis_length)
        points = drawing.to_pixels(_jittered(points, overlay_jitter))
        image = _stamped(image, drawing.masks(points, spec.strokes, rows, columns), spec.size)
    else:
        image = cropping.resize_any(image, spec.size, spec.size)
    return Aligned(image, _proprio(tcp, opening, camera, spec.layout), valid)


def _stamped(image: jax.Array, drawn: list[jax.Array], size: int) -> jax.Array:
    """The image [H, W, 3] with the masks' colours on it, resized to `size` pixels a side."""
    if image.dtype != jnp.uint8:
        return cropping.resize_any(drawing.stamp(image, drawn), size, size)
    words = drawing.stamp(pixels.pack(image), drawn)
    if words.shape == (size, size):
        return pixels.unpack_words(words)
    return cropping.resize_words(words, size, size)


def align(
    image: ArrayLike,
    camera: cam.Camera,
    tcp: ArrayLike,
    opening: ArrayLike,
    spec: AlignSpec,
    *,
    mask: ArrayLike | None = None,
    crop_jitter: Vector | None = None,
    overlay_jitter: Vector | None = None,
) -> Aligned:
    """Turn a camera image and a TCP pose into a policy's input (PALM, perception alignment).

    In this order: `tcp_overlay`, `tcp_crop`, `resize`, `proprio`. The result equals calling them
    one after the other (but only the pixels of the window are touched).

    Args:
      image: [H, W, 3] uint8 or float32 in [0, 1], the camera's size.
      camera: the camera that took it.
      tcp: [4, 4] TCP pose in the world, z the approach direction, y the opening axis.
      opening: gripper opening, 0 closed to 1 open.
      spec: what to do.
      mask: bool [H, W] of what is shown; only with `spec.isolate`, which comes before all else.
      crop_jitter: [2] (u, v) pixels added to the TCP before cropping, as a calibration error would
        do; the reference rounds it to whole pixels.
      overlay_jitter: [2] (u, v) pixels added to the overlay, drawn independently of the other.

    Returns:
      Aligned(image [size, size, 3] of the image's dtype, proprio [n], valid []). Under jit and
      vmap, `valid` is False where the TCP lies behind the camera or outside the image: the window
      is then the one nearest to it (behind the camera: the top left one), the overlay is cut off
      or absent, and the proprioception is computed as always.

    Raises:
      ShapeError, DtypeError: image not [H, W, 3] of uint8 or float, not the camera's size; tcp not
        [4, 4].
      OptionError: crop larger than the image; concrete float pixels outside [0, 1]; a mask without
        `spec.isolate`, or that without a mask.
      CameraError, PoseError: see `Camera.check`; concrete tcp not a rigid pose.
      ProjectionError: concrete TCP behind the camera or outside its image.
    """
    image = as_image(image, "image", rgb=True)
    tcp = as_single(tcp, "tcp", (4, 4))
    opening = as_single(opening, "opening", ())
    camera.check()
    drawing.check_size(image, camera)
    if spec.crop is not None:
        check_fits(spec.crop, camera.height, camera.width, "AlignSpec.crop")
    check_pose(tcp, "tcp")
    cam.check_tcp_in_view(camera, tcp, "tcp")
    check_unit_range(image, "image")
    checked = _mask(mask, spec)
    return _align(image, camera, tcp, opening, spec, checked, crop_jitter, overlay_jitter)


def _mask(mask: ArrayLike | None, spec: AlignSpec) -> jax.Array | None:
    if (mask is not None) != spec.isolate:
        raise OptionError(
            f"mask: expected one if and only if AlignSpec.isolate, which is {spec.isolate}; got "
            f"{'none' if mask is None else 'one'}"
        )
    return None if mask is None else jnp.asarray(mask, bool)


def window_origin(
    view_camera: cam.Camera,
    tcp: ArrayLike,
    spec: AlignSpec,
    *,
    jitter: Vector | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Which window of the scaled frame to render for a TCP.

    Args:
      view_camera: `spec.view_camera(camera)`.
      tcp: [4, 4] TCP pose in the world.
      spec: the policy's spec; its crop and offset are in pixels of the unscaled camera.
      jitter: [2] (u, v) crop jitter, pixels of the unscaled camera.

    Returns:
      origin: int32 [2] (row, col) of the size x size window's top left pixel in `view_camera`'s
        frame. With border "shift" it is moved so that the window lies inside the frame; with the
        other borders it may lie outside, and a renderer shows what is there. Zeros for crop=None.
      valid: bool, the TCP is in front of the camera and inside the frame. No value is checked.

    Raises:
      ShapeError: tcp not [4, 4].
    """
    return _window_origin(view_camera, as_single(tcp, "tcp", (4, 4)), spec, jitter)


@jax.jit
def _window_origin(
    view_camera: cam.Camera, tcp: jax.Array, spec: AlignSpec, jitter: Vector | None
) -> tuple[jax.Array, jax.Array]:
    uv, valid = _seen(view_camera, tcp)
    if spec.crop is None:
        return jnp.zeros(2, jnp.int32), valid
    if jitter is not None:
        uv = uv + spec.scale * jnp.asarray(jitter, jnp.float32)
    offset = np.asarray(spec.offset, np.float32) * np.float32(spec.scale)
    origin = cropping.crop_origin(uv, spec.size, offset)
    if spec.border == "shift":
        origin = cropping.clamp_origin(origin, spec.size, view_camera.height, view_camera.width)
    return origin, valid


def align_window(
    image: ArrayLike,
    view_camera: cam.Camera,
    origin: Vector,
    tcp: ArrayLike,
    opening: ArrayLike,
    spec: AlignSpec,
    *,
    mask: ArrayLike | None = None,
    jitter: Vector | None = None,
) -> Aligned:
    """`align` for an image that was rendered as the policy's window: overlay and proprioception.

    The strokes have the spec's sizes times `spec.scale` and soft edges: what the strokes of
    `align` look like after its resize. Use one of the two for both training and evaluation.

    Args:
      image: [size, size, 3] uint8 or float32, the window of `view_camera`'s frame at `origin`.
      view_camera: `spec.view_camera(camera)`.
      origin: int32 [2] (row, col), from `window_origin`.
      tcp: [4, 4] TCP pose in the world.
      opening: gripper opening, 0 closed to 1 open.
      spec: the policy's spec.
      mask: bool [size, size] of what is shown; only with `spec.isolate`.
      jitter: [2] (u, v) overlay jitter, pixels of the unscaled camera.

    Returns:
      Aligned, see `align`; `valid` refers to the whole frame. No value is checked: this is the
      inner loop of rollouts.

    Raises:
      ShapeError, DtypeError: image not [size, size, 3] of uint8 or float; tcp not [4, 4].
      OptionError: a mask without `spec.isolate`, or that without a mask.
    """
    image = as_image(image, "image", rgb=True)
    if image.shape[:2] != (spec.size, spec.size):
        raise ShapeError(
            f"image: expected the spec's {spec.size} x {spec.size} pixels, got "
            f"{image.shape[0]} x {image.shape[1]}; render the window at spec.view_camera(camera)"
        )
    tcp = as_single(tcp, "tcp", (4, 4))
    opening = as_single(opening, "opening", ())
    origin = jnp.asarray(origin, jnp.int32)
    checked = _mask(mask, spec)
    return _align_window(image, view_camera, origin, tcp, opening, spec, checked, jitter)


@jax.jit
def _align_window(
    image: jax.Array,
    view_camera: cam.Camera,
    origin: jax.Array,
    tcp: jax.Array,
    opening: jax.Array,
    spec: AlignSpec,
    mask: jax.Array | None,
    jitter: Vector | None,
) -> Aligned:
    _, valid = _seen(view_camera, tcp)
    if mask is not None:
        image = isolate(image, mask, pitch=max(GRID * spec.scale, 2.0))
    if spec.overlay:
        points = drawing.overlay_points(view_camera, tcp, spec.axis_length)
        points = _jittered(points, None if jitter is None else spec.scale * jnp.asarray(jitter))
        strokes = spec.strokes.scaled(spec.scale)
        rows, columns = origin[:, None] + jnp.arange(spec.size, dtype=jnp.int32)
        covered = drawing.coverage(points, strokes, rows, columns)
        image = drawing.paint(image, covered)
    return Aligned(image, _proprio(tcp, opening, view_camera, spec.layout), valid)
