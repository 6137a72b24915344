"""Images of a camera that policies were not trained with.

A crop is counted in pixels of the camera that a policy was trained with. Another camera in the same
place has another focal length, principal point or resolution, and the same window of its image
shows more or less of the scene. `reframe` makes the one camera's image out of the other's: a change
of K alone is a map between pixels, whatever the scene. `align_like` is the alignment on top of it.
"""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from palm_jax._checks import (
    OptionError,
    ShapeError,
    as_image,
    as_single,
    check_fits,
    check_pose,
)
from palm_jax.align import overlay as drawing
from palm_jax.align.camera import Camera, check_tcp_in_view, matmul
from palm_jax.align.pipeline import Aligned, AlignSpec, align, align_window, window_origin


def reframe(image: ArrayLike, camera: Camera, other: Camera) -> tuple[jax.Array, jax.Array]:
    """What another camera at the same place, turned the same way, would have taken.

    Bilinear, without antialiasing, like `resize`: where `other` has far fewer pixels for the same
    view, most pixels of the image are not looked at.

    Args:
      image: [H, W, C] uint8 or float32, the camera's size.
      camera: the camera that took it.
      other: the camera whose image is wanted. Only its K and its size are used: its pose is taken
        to be the camera's.

    Returns:
      image: [other.height, other.width, C], dtype of the image; uint8 values are rounded. What lies
        outside the camera's image repeats its border pixels.
      real: bool [other.height, other.width], False for those.

    Raises:
      ShapeError, DtypeError: not an HWC image of uint8 or float, or not of the camera's size.
      CameraError, PoseError: see `Camera.check`.
    """
    image = as_image(image, "image")
    drawing.check_size(image, camera)
    camera.check()
    other.check()
    return _reframe(image, camera, other)


@jax.jit
def _reframe(image: jax.Array, camera: Camera, other: Camera) -> tuple[jax.Array, jax.Array]:
    u, v = _sources(jnp.asarray(camera.K, jnp.float32), other)
    real = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    left, right, across = _neighbours(u, camera.width)
    top, bottom, down = _neighbours(v, camera.height)

    def corner(rows: jax.Array, columns: jax.Array) -> jax.Array:
        return image[rows, columns].astype(jnp.float32)

    upper = corner(top, left) + across * (corner(top, right) - corner(top, left))
    lower = corner(bottom, left) + across * (corner(bottom, right) - corner(bottom, left))
    mixed = upper + down * (lower - upper)
    return (mixed + 0.5 if image.dtype == jnp.uint8 else mixed).astype(image.dtype), real


def _sources(intrinsics: jax.Array, other: Camera) -> tuple[jax.Array, jax.Array]:
    """u, v [h, w]: where the centres of the other camera's pixels lie, in pixels of `intrinsics`
    [3, 3]."""
    wanted = jnp.asarray(other.K, jnp.float32)
    scale_u, scale_v = intrinsics[0, 0] / wanted[0, 0], intrinsics[1, 1] / wanted[1, 1]
    lean = (intrinsics[0, 1] - scale_u * wanted[0, 1]) / wanted[1, 1]
    left = intrinsics[0, 2] - scale_u * wanted[0, 2] - lean * wanted[1, 2]
    top = intrinsics[1, 2] - scale_v * wanted[1, 2]
    map_u, map_v = jnp.stack([scale_u, lean, left]), jnp.stack([jnp.zeros(()), scale_v, top])
    columns = jnp.arange(other.width, dtype=jnp.float32) + 0.5
    rows = jnp.arange(other.height, dtype=jnp.float32) + 0.5
    x, y = (grid.ravel() for grid in jnp.meshgrid(columns, rows))
    # A matrix product, which XLA computes once. Sums it would compute anew, and round otherwise,
    # for the pixels' numbers and for their weights: near whole numbers the two would not agree.
    uv = matmul(jnp.stack([x, y, jnp.ones_like(x)], -1), jnp.stack([map_u, map_v], -1))
    shape = (other.height, other.width)
    return uv[:, 0].reshape(shape), uv[:, 1].reshape(shape)


def _neighbours(point: jax.Array, size: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The pixels before and after each point [h, w] along one axis, and the second one's weight
    [h, w, 1]; points beyond the outermost centres get those."""
    position = jnp.clip(point - 0.5, 0, size - 1)
    start = jnp.floor(position)
    first = start.astype(jnp.int32)
    return first, jnp.minimum(first + 1, size - 1), (position - start)[..., None]


def align_like(
    image: ArrayLike,
    camera: Camera,
    reference: Camera,
    tcp: ArrayLike,
    opening: ArrayLike,
    spec: AlignSpec,
    *,
    mask: ArrayLike | None = None,
    rendered: bool = False,
) -> tuple[Aligned, jax.Array]:
    """`align` for a policy that was trained with another camera's K and image size.

    The policy sees the field of view that it was trained with: the spec's crop and strokes are in
    pixels of `reference`, whose image is made out of the camera's. Where the two cameras are one,
    this is `align` (or `align_window`) of the image itself.

    Args:
      image: [H, W, 3] uint8 or float32 in [0, 1], the camera's size.
      camera: the camera that took it.
      reference: the camera that the policy was trained with. Only its K and its size are used; a
        window with border "shift" stays inside of its image.
      tcp: [4, 4] TCP pose in the world.
      opening: gripper opening, 0 closed to 1 open.
      spec: the policy's.
      mask: bool [H, W] of what is shown; only with `spec.isolate`.
      rendered: the policy was trained on rendered windows, see `align_window`; otherwise on
        camera images, see `align`. The overlay's edges differ, and the window's place by less than
        a pixel of the policy's image.

    Returns:
      aligned: see `align`; `valid` is about the camera's image.
      coverage: float, share of the window that lies inside the camera's image; the rest repeats its
        border pixels (with border "constant" and images that were not rendered: is black).

    Raises:
      ShapeError, DtypeError, CameraError, PoseError, ProjectionError: see `align`.
      OptionError: see `align`; isolation of a crop that was not rendered, whose grid belongs to
        an image that is not made here.
    """
    image = as_image(image, "image", rgb=True)
    tcp = as_single(tcp, "tcp", (4, 4))
    opening = as_single(opening, "opening", ())
    camera.check()
    reference.check()
    drawing.check_size(image, camera)
    if spec.crop is not None:
        check_fits(spec.crop, reference.height, reference.width, "AlignSpec.crop")
    if (mask is not None) != spec.isolate:
        raise OptionError(
            f"mask: expected one if and only if AlignSpec.isolate, which is {spec.isolate}; got "
            f"{'none' if mask is None else 'one'}"
        )
    if spec.isolate and spec.crop is not None and not rendered:
        raise OptionError("rendered: expected True for a crop that is isolated, got False")
    shown = None if mask is None else jnp.asarray(mask, bool)
    if shown is not None and shown.shape != image.shape[:2]:
        raise ShapeError(
            f"mask: expected the image's {list(image.shape[:2])}, got {list(shown.shape)}"
        )
    check_pose(tcp, "tcp")
    check_tcp_in_view(camera, tcp, "tcp")
    return _align_like(image, camera, reference, tcp, opening, spec, shown, rendered)


@partial(jax.jit, static_argnames="rendered")
def _align_like(
    image: jax.Array,
    camera: Camera,
    reference: Camera,
    tcp: jax.Array,
    opening: jax.Array,
    spec: AlignSpec,
    mask: jax.Array | None,
    rendered: bool,
) -> tuple[Aligned, jax.Array]:
    reference = dataclasses.replace(reference, cam_to_world=camera.cam_to_world)
    if rendered:
        view, window_spec = spec.view_camera(reference), spec
    else:
        # The window in the reference's own pixels: `align` resizes it.
        view, window_spec = reference, dataclasses.replace(spec, size=spec.crop or spec.size)
    origin, _ = window_origin(view, tcp, window_spec)
    height, width = (view.height, view.width) if spec.crop is None else (window_spec.size,) * 2
    window = view.cropped(origin[::-1].astype(jnp.float32), height, width)
    pixels, real = _reframe(image, camera, window)
    if spec.border == "constant" and not rendered:
        pixels = jnp.where(real[..., None], pixels, 0)
    shown = None
    if mask is not None:
        shown = _reframe(mask[..., None].astype(jnp.float32), camera, window)[0][..., 0] > 0.5
    if rendered:
        aligned = align_window(pixels, view, origin, tcp, opening, spec, mask=shown)
    else:
        aligned = align(pixels, window, tcp, opening, spec, mask=shown)
    aligned = dataclasses.replace(aligned, valid=camera.sees(tcp[:3, 3]))
    return aligned, real.mean(dtype=jnp.float32)
