"""Pinhole camera: pose, projection and the way back.

Camera axes are OpenCV's: x right, y down, z forward. `cam_to_world` is the camera's pose. The
point (u, v) is in pixels, u right, v down; pixel (row i, column j) covers [j, j + 1) x [i, i + 1).
World z is up. Metres, radians, float32.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from palm_jax._checks import (
    CameraError,
    OptionError,
    ProjectionError,
    ShapeError,
    Vector,
    as_float,
    as_single,
    check_intrinsics,
    check_pose,
    is_concrete,
)

# Points nearer than this to the camera's plane, or behind it, have no image.
NEAREST_DEPTH = 1e-4
# Where such points are put: finite, and outside every image.
OFF_IMAGE = -1e6


def matmul(a: ArrayLike, b: ArrayLike) -> jax.Array:
    """Matrix product in full float32: accelerators would round geometry to fewer bits."""
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera. A pytree: `K` and `cam_to_world` are leaves, the sizes are static.

    Attributes:
      K: [3, 3] intrinsics in pixels, positive focal lengths.
      cam_to_world: [4, 4] pose of the camera, OpenCV axes (x right, y down, z forward).
      height: rows of the image.
      width: columns of the image.

    Nothing is checked while constructing (pytrees are rebuilt with tracers inside); `check` does,
    and every operation that takes a camera with concrete values calls it.
    """

    K: jax.Array | np.ndarray  # [3, 3]
    cam_to_world: jax.Array | np.ndarray  # [4, 4]
    height: int = dataclasses.field(metadata={"static": True})
    width: int = dataclasses.field(metadata={"static": True})

    @classmethod
    def from_fovy(cls, fovy: ArrayLike, height: int, width: int, cam_to_world: ArrayLike) -> Camera:
        """Camera with square pixels and the principal point at the image centre.

        Args:
          fovy: vertical field of view in degrees, between 0 and 180.
          height: rows.
          width: columns.
          cam_to_world: [4, 4] pose, OpenCV axes.

        Raises:
          CameraError: a concrete `fovy` outside (0, 180).
        """
        if is_concrete(fovy) and not 0 < float(np.asarray(fovy)) < 180:
            raise CameraError(
                f"fovy: expected degrees between 0 and 180, got {float(np.asarray(fovy)):g}"
            )
        half = jnp.asarray(fovy, jnp.float32) * (math.pi / 360)
        focal = height / 2 / jnp.tan(half)
        zero, one = jnp.zeros_like(focal), jnp.ones_like(focal)
        rows = [focal, zero, one * (width / 2), zero, focal, one * (height / 2), zero, zero, one]
        intrinsics = jnp.stack(rows, -1).reshape(*focal.shape, 3, 3)
        return cls(intrinsics, jnp.asarray(cam_to_world, jnp.float32), height, width)

    def check(self) -> Camera:
        """Return self, or raise if shapes or concrete values are not those of a camera.

        Raises:
          ShapeError: `K` is not [3, 3] or `cam_to_world` not [4, 4].
          CameraError: focal lengths not positive, last row of `K` not (0, 0, 1), sizes below 1.
          PoseError: `cam_to_world` is not a rigid pose.
        """
        for name, value, shape in (
            ("Camera.K", self.K, (3, 3)),
            ("Camera.cam_to_world", self.cam_to_world, (4, 4)),
        ):
            if np.shape(value) != shape:
                raise ShapeError(
                    f"{name}: expected shape {list(shape)}, got {list(np.shape(value))}; "
                    "batch cameras with jax.vmap"
                )
        if self.height < 1 or self.width < 1:
            raise CameraError(
                f"Camera: expected height and width of at least 1, got {self.height} x {self.width}"
            )
        check_intrinsics(self.K, "Camera.K")
        check_pose(self.cam_to_world, "Camera.cam_to_world")
        return self

    def rotated_about(self, center: Vector, angle: ArrayLike) -> Camera:
        """The camera carried round the world z axis through `center`, looking along with it.

        Args:
          center: [3] point in the world, metres (its z has no effect).
          angle: radians, counter-clockwise seen from above.
        """
        center = as_single(center, "center", (3,))
        turn = rotation_z(angle)
        pose = jnp.asarray(self.cam_to_world, jnp.float32)
        rotation = matmul(turn, pose[:3, :3])
        position = center + matmul(turn, pose[:3, 3] - center)
        moved = pose.at[:3, :3].set(rotation).at[:3, 3].set(position)
        return dataclasses.replace(self, cam_to_world=moved)

    def turned(self, pan: ArrayLike, tilt: ArrayLike, keep: Vector) -> Camera:
        """The camera turned about its own centre, with the image shifted to keep a point in place.

        The pan is about the world's vertical, so that the horizon stays as level as it is; the tilt
        about the camera's x axis. The principal point moves such that `keep` stays at its pixel:
        what a TCP-centric window of a turned camera shows.

        Args:
          pan: radians, counter-clockwise seen from above.
          tilt: radians, upwards.
          keep: [3] point in the world, metres, in front of the camera before and after.
        """
        keep = as_single(keep, "keep", (3,))
        pose = jnp.asarray(self.cam_to_world, jnp.float32)
        rotation = matmul(matmul(rotation_z(pan), pose[:3, :3]), _rotation_x(tilt))
        moved = dataclasses.replace(self, cam_to_world=pose.at[:3, :3].set(rotation))
        shift = _project(self, keep)[0] - _project(moved, keep)[0]
        intrinsics = jnp.asarray(self.K, jnp.float32).at[:2, 2].add(shift)
        return dataclasses.replace(moved, K=intrinsics)

    def scaled(self, factor: float | tuple[float, float]) -> Camera:
        """The same view with `factor` times the pixels per side (a pair: horizontal, vertical).

        Sizes are rounded to whole pixels; the focal lengths and the principal point are not.
        """
        horizontal, vertical = factor if isinstance(factor, tuple) else (factor, factor)
        if not (horizontal > 0 and vertical > 0):
            raise OptionError(f"factor: expected positive numbers, got {factor!r}")
        scale = np.array([[horizontal], [vertical], [1.0]], np.float32)
        return Camera(
            jnp.asarray(self.K, jnp.float32) * scale,
            self.cam_to_world,
            max(1, round(self.height * vertical)),
            max(1, round(self.width * horizontal)),
        )

    def cropped(self, origin_uv: Vector, height: int, width: int) -> Camera:
        """The camera of a window of the image: the principal point moves by -origin_uv.

        Args:
          origin_uv: [2] (u, v) of the window's top left corner, pixels; may lie outside.
          height: rows of the window.
          width: columns of the window.
        """
        origin = as_single(origin_uv, "origin_uv", (2,))
        intrinsics = jnp.asarray(self.K, jnp.float32).at[:2, 2].add(-origin)
        return Camera(intrinsics, self.cam_to_world, height, width)

    def sees(self, points: ArrayLike) -> jax.Array:
        """[...] bool: which of the world points [..., 3] lie in front of the camera, in the image.

        Anything may be in between; only the frame is tested.
        """
        return inside(self, *_project(self, as_float(points, "points", (3,))))


def rotation_z(angle: ArrayLike) -> jax.Array:
    """[3, 3] rotation by `angle` (radians) about z."""
    angle = jnp.asarray(angle, jnp.float32)
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).reshape(*c.shape, 3, 3)


def _rotation_x(angle: ArrayLike) -> jax.Array:
    """[3, 3] rotation by `angle` [] (radians) about x."""
    angle = jnp.asarray(angle, jnp.float32)
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def inside(camera: Camera, uv: jax.Array, depth: jax.Array) -> jax.Array:
    """[...] bool: points with these uv [..., 2] and depth [...] that fall on a pixel."""
    limit = jnp.asarray([camera.width, camera.height], jnp.float32)
    return (depth > NEAREST_DEPTH) & ((uv >= 0) & (uv < limit)).all(-1)


@jax.jit
def _project(camera: Camera, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    pose = jnp.asarray(camera.cam_to_world, jnp.float32)
    local = matmul(points - pose[:3, 3], pose[:3, :3])
    depth = local[..., 2]
    ahead = depth > NEAREST_DEPTH
    ray = local / jnp.where(ahead, depth, 1.0)[..., None]
    uv = matmul(ray, jnp.asarray(camera.K, jnp.float32)[:2].T)
    return jnp.where(ahead[..., None], uv, OFF_IMAGE), depth


def project(camera: Camera, points: Vector) -> tuple[jax.Array, jax.Array]:
    """Image points of world points: K inv(cam_to_world) p, divided by the depth (PALM, eq. 1).

    Args:
      camera: the camera.
      points: [..., 3] world coordinates, metres.

    Returns:
      uv: [..., 2] pixels, u right, v down; not limited to the image.
      depth: [...] metres along the camera's z axis.
      A point behind the camera, or nearer than 0.1 mm to its plane, has uv = (-1e6, -1e6): finite
      and outside every image. Its depth tells (also under jit and vmap); `Camera.sees` tests both.

    Raises:
      ShapeError, CameraError, PoseError: see `Camera.check`.
    """
    camera.check()
    return _project(camera, as_float(points, "points", (3,)))


def _rays(camera: Camera, uv: jax.Array) -> jax.Array:
    """[..., 3] directions in the world, one metre deep along the camera's z."""
    intrinsics = jnp.asarray(camera.K, jnp.float32)
    y = (uv[..., 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (uv[..., 0] - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    local = jnp.stack([x, y, jnp.ones_like(x)], -1)
    return matmul(local, jnp.asarray(camera.cam_to_world, jnp.float32)[:3, :3].T)


def unproject(camera: Camera, uv: Vector, depth: ArrayLike) -> jax.Array:
    """World points [..., 3] seen at uv [..., 2] (pixels) and depth [...] (metres along z).

    The inverse of `project` for points in front of the camera.

    Raises:
      ShapeError, CameraError, PoseError: see `Camera.check`.
    """
    camera.check()
    uv = as_float(uv, "uv", (2,))
    depth = jnp.asarray(depth, jnp.float32)
    origin = jnp.asarray(camera.cam_to_world, jnp.float32)[:3, 3]
    return origin + depth[..., None] * _rays(camera, uv)


def unproject_to_height(camera: Camera, uv: Vector, z: ArrayLike) -> jax.Array:
    """Where the rays through uv [..., 2] (pixels) meet the horizontal planes at z [...] (metres).

    Used to place an object of known height from its mask's centroid (the global policy).

    Returns:
      [..., 3] world points. NaN under jit and vmap where the ray runs parallel to the plane or
      meets it behind the camera.

    Raises:
      ProjectionError: the same case with concrete values.
      ShapeError, CameraError, PoseError: see `Camera.check`.
    """
    camera.check()
    uv = as_float(uv, "uv", (2,))
    origin = jnp.asarray(camera.cam_to_world, jnp.float32)[:3, 3]
    rays = _rays(camera, uv)
    steep = jnp.abs(rays[..., 2]) > 1e-6
    depth = (jnp.asarray(z, jnp.float32) - origin[2]) / jnp.where(steep, rays[..., 2], 1.0)
    hit = steep & (depth > NEAREST_DEPTH)
    if is_concrete(hit) and not np.asarray(hit).all():
        raise ProjectionError(
            f"unproject_to_height: expected rays that meet z = {np.asarray(z).tolist()} in front "
            f"of the camera at {np.asarray(origin).tolist()}, got none for uv "
            f"{np.asarray(uv)[~np.asarray(hit)].tolist()}; check the height and that uv lies "
            "below the horizon"
        )
    points = origin + depth[..., None] * rays
    return jnp.where(hit[..., None], points, jnp.nan)


def check_tcp_in_view(camera: Camera, tcp: jax.Array, name: str) -> None:
    """Raise ProjectionError when a concrete camera does not have a concrete TCP in its image."""
    if not is_concrete((camera, tcp)):
        return
    uv, depth = _project(camera, tcp[:3, 3])
    if float(depth) <= NEAREST_DEPTH:
        raise ProjectionError(
            f"{name}: expected the TCP in front of the camera, got depth {float(depth):.4g} m; "
            "check that cam_to_world is the camera's pose (not its inverse) with z forward"
        )
    if not bool(inside(camera, uv, depth)):
        raise ProjectionError(
            f"{name}: expected the TCP inside the {camera.height} x {camera.width} image, got "
            f"(u, v) = ({float(uv[0]):.1f}, {float(uv[1]):.1f}); move or turn the camera, widen "
            "the frame, or call it under jax.jit and use the `valid` flag"
        )
