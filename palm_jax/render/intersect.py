"""Rays against primitives: what depends on the geom alone, and the tests for each family.

Rays are written in pixels. With (u, v) measured from the principal point, a pixel's ray reaches
depth t (metres along the camera's z) at the point `t * (x, y, 1)` of the camera frame, and in the
scaled frame of a geom (unit ball, unit cube, ...) at `eye + t * (a * u + b * v + c)`. The vectors
a, b, c and eye are computed once per world and geom; a ray costs a few multiply-adds, and t is the
planar depth as it is.

All arithmetic is elementwise: sums are written out, so that they give the same bits whatever the
batch. Per pixel, a vector is a tuple of three arrays: no array of pixels has a minor axis of 3.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

NEAR = 1e-3
"""Metres: what lies nearer to the camera's plane is not seen."""

_SMALLEST = 1e-5  # metres, stands for a size of zero
_INFINITE = 1e8  # metres, half width of an infinite plane
_TINY = 1e-12

Vector = tuple[jax.Array, jax.Array, jax.Array]
Hit = tuple[jax.Array, jax.Array]

FAMILIES = ("ellipsoid", "capsule", "cylinder", "box", "plane")
"""Kinds of intersection test, in the order in which geoms are drawn; a sphere is an ellipsoid."""


def family(primitive: str) -> str:
    """The family of a primitive type."""
    return "ellipsoid" if primitive == "sphere" else primitive


class Placed(NamedTuple):
    """Geoms in the frame of the camera; W worlds, G geoms."""

    ray: jax.Array  # [W, G, 3, 3]: rows a, b, c; a ray's scaled local direction is a u + b v + c
    eye: jax.Array  # [W, G, 3] the camera in the scaled local frame
    scale: jax.Array  # [W, G, 3] metres per unit of the scaled frame
    half: jax.Array  # [W, G] half length of the straight part in radii: 0 ellipsoid, inf cylinder
    ok: jax.Array  # bool [W, G]: to be drawn
    centre: jax.Array  # [W, G, 3] metres, camera frame
    turn: jax.Array  # [W, G, 3, 3] rows: unit axes of the geom and its bounding box, camera frame
    reach: jax.Array  # [W, G, 3] half sizes of the bounding box, metres


def each(function: Callable[[int], jax.Array]) -> Vector:
    """The vector of `function(0)`, `function(1)`, `function(2)`."""
    return function(0), function(1), function(2)


def dot(p: Vector, q: Vector) -> jax.Array:
    """Sum of products of two vectors."""
    return p[0] * q[0] + (p[1] * q[1] + p[2] * q[2])


def components(vectors: jax.Array) -> Vector:
    """[..., 3] as a tuple of three [...]."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def turned(vectors: jax.Array, axes: jax.Array) -> jax.Array:
    """Row vectors [..., 3] times matrices [..., 3, 3], summed in a fixed order."""
    x, y, z = (vectors[..., i, None] * axes[..., i, :] for i in range(3))
    return x + (y + z)


def _sizes(kinds: Sequence[str], size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Scale of the local frame, half sizes of the bounding box, and half length in radii."""

    def is_kind(*names: str) -> np.ndarray:
        return np.asarray([kind in names for kind in kinds])

    x, y, z = components(jnp.maximum(size, _SMALLEST))
    plane, capsule, cylinder = is_kind("plane"), is_kind("capsule"), is_kind("cylinder")
    ball = is_kind("sphere", "capsule")
    half = jnp.where(capsule, size[..., 1] / x, jnp.where(cylinder, jnp.inf, 0.0))
    wide = jnp.where(plane & (size[..., 0] <= 0), _INFINITE, x)
    across = jnp.where(plane & (size[..., 1] <= 0), _INFINITE, y)
    across = jnp.where(ball | cylinder, x, across)
    deep = jnp.where(ball, x, jnp.where(cylinder, y, jnp.where(plane, 1.0, z)))
    reach = jnp.where(plane, 0.0, jnp.where(capsule, x + size[..., 1], deep))
    return jnp.stack([wide, across, deep], -1), jnp.stack([wide, across, reach], -1), half


def _used_sizes(kinds: Sequence[str]) -> np.ndarray:
    """bool [G, 3]: the entries of a size that mean something for each type."""
    count = {"sphere": 1, "capsule": 2, "cylinder": 2, "plane": 2}
    return np.asarray([[i < count.get(kind, 3) for i in range(3)] for kind in kinds])


def place(
    kinds: Sequence[str],
    pos: jax.Array,
    mat: jax.Array,
    size: jax.Array,
    visible: jax.Array,
    intrinsics: jax.Array,
    cam_to_world: jax.Array,
) -> Placed:
    """Geoms in the frame of the camera.

    Args:
      kinds: G primitive types.
      pos, mat, size, visible: [W, G, 3], [W, G, 3, 3], [W, G, 3], bool [W, G].
      intrinsics, cam_to_world: [W, 3, 3], [W, 4, 4].
    """
    size = jnp.where(_used_sizes(kinds), size, 1.0)
    camera_ok = jnp.isfinite(intrinsics).all((-1, -2)) & jnp.isfinite(cam_to_world).all((-1, -2))
    pose = jnp.concatenate([mat, pos[..., None, :], size[..., None, :]], -2)
    ok = visible & jnp.isfinite(pose).all((-1, -2)) & (size >= 0).all(-1) & camera_ok[:, None]
    # What is not drawn gets a harmless pose: no NaN enters, also not in gradients.
    pos = jnp.where(ok[..., None], pos, 0.0)
    mat = jnp.where(ok[..., None, None], mat, jnp.eye(3))
    size = jnp.where(ok[..., None], size, 1.0)
    intrinsics = jnp.where(camera_ok[:, None, None], intrinsics, jnp.eye(3))
    cam_to_world = jnp.where(camera_ok[:, None, None], cam_to_world, jnp.eye(4))

    scale, reach, half = _sizes(kinds, size)
    camera = cam_to_world[:, None, :3, :3]
    fx, fy, skew = (intrinsics[:, None, None, i, j] for i, j in ((0, 0), (1, 1), (0, 1)))
    away = pos - cam_to_world[:, None, :3, 3]
    turn = turned(jnp.swapaxes(mat, -1, -2), camera[:, :, None])
    a = turn[..., 0] / (scale * fx)
    b = (turn[..., 1] - turn[..., 0] * (skew / fx)) / (scale * fy)
    c = turn[..., 2] / scale
    return Placed(
        ray=jnp.stack([a, b, c], -2),
        eye=-turned(away, mat) / scale,
        scale=scale,
        half=half,
        ok=ok,
        centre=turned(away, camera),
        turn=turn,
        reach=reach,
    )


# -- nearest hit: columns per geom, then the test --------------------------------------------------
#
# `columns` turns geoms [W, G] into the numbers [W, G, F] that `hit` reads, there as a list of F
# arrays that broadcast against (u, v). `hit` returns the depth at which the ray enters and whether
# it counts. NaN means a miss: every comparison with it is false. Sums are nested by hand so that
# each is one chain of multiply-adds, and quantities are used as few times as possible: the compiler
# stores what is used often.


def _along(p: jax.Array, q: Placed) -> jax.Array:
    """Coefficients [W, G, 3] in (u, v, 1) of p . direction, for p [W, G, 3]."""
    return turned(p, jnp.swapaxes(q.ray, -1, -2))


def _at(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> jax.Array:
    return p[0] * u + (p[1] * v + p[2])


def _directions(q: Placed) -> jax.Array:
    """Coefficients in (u, v, 1) of x, y, z of the direction: [W, G, 9]."""
    return jnp.swapaxes(q.ray, -1, -2).reshape(*q.half.shape, 9)


def smaller(p: jax.Array, q: jax.Array) -> jax.Array:
    """q where p is not a number; cheaper than a minimum that has to return NaN."""
    return jnp.where(p < q, p, q)


def larger(p: jax.Array, q: jax.Array) -> jax.Array:
    """As `smaller`."""
    return jnp.where(p > q, p, q)


def _ellipsoid_columns(q: Placed) -> jax.Array:
    # |direction|^2 and the discriminant |direction|^2 - |eye x direction|^2 are quadratic in u, v.
    # The cross product loses no digits where the camera is far; the textbook's b^2 - a c would.
    ox, oy, oz = (q.eye[..., i, None] for i in range(3))
    dx, dy, dz = components(q.ray)
    moment = (oy * dz - oz * dy, oz * dx - ox * dz, ox * dy - oy * dx)

    def square(p: Vector) -> jax.Array:
        return dot(each(lambda i: p[i][..., :, None]), each(lambda i: p[i][..., None, :]))

    length = square((dx, dy, dz))
    forms = jnp.stack([length, length - square(moment)], -3)
    # Upper triangle, with the mixed terms doubled; the rest is not read.
    forms = forms * np.asarray([[1, 2, 2], [0, 1, 2], [0, 0, 1]], np.float32)
    return jnp.concatenate([forms.reshape(*q.half.shape, 18), -_along(q.eye, q)], -1)


def _quadratic_at(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> jax.Array:
    return (p[0] * u + (p[1] * v + p[2])) * u + ((p[4] * v + p[5]) * v + p[8])


def _ellipsoid_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> Hit:
    discriminant = _quadratic_at(p[9:], u, v)
    depth = (_at(p[18:], u, v) - jnp.sqrt(discriminant)) / _quadratic_at(p, u, v)
    return depth, discriminant >= 0


def _tube_columns(q: Placed) -> jax.Array:
    """Of the cylinder x^2 + y^2 = 1: direction, moment about the axis, -eye . direction."""
    ox, oy = q.eye[..., 0, None], q.eye[..., 1, None]
    dx, dy, _ = components(q.ray)
    moment, back = ox * dy - oy * dx, -(ox * dx + oy * dy)
    return jnp.concatenate([_directions(q), moment, back], -1)


def _tube(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> Vector:
    """|direction|^2 across the axis, discriminant, -eye . direction."""
    dx, dy = _at(p, u, v), _at(p[3:], u, v)
    square = jnp.maximum(dx * dx + dy * dy, _TINY)
    moment = _at(p[9:], u, v)
    return square, square - moment * moment, _at(p[12:], u, v)


def _cylinder_columns(q: Placed) -> jax.Array:
    oz = q.eye[..., 2:]
    return jnp.concatenate([_tube_columns(q), -1 - oz, 1 - oz], -1)


def _cylinder_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> Hit:
    square, discriminant, back = _tube(p, u, v)
    across = 1 / square
    reach, middle = jnp.sqrt(discriminant) * across, back * across
    along = 1 / _at(p[6:], u, v)
    low, high = p[15] * along, p[16] * along
    near = larger(smaller(low, high), middle - reach)
    far = smaller(larger(low, high), middle + reach)
    return near, (near <= far) & (discriminant >= 0)


def _capsule_columns(q: Placed) -> jax.Array:
    x, y, z = components(q.eye)
    return jnp.concatenate([_tube_columns(q), jnp.stack([z, q.half, x * x + (y * y - 1)], -1)], -1)


def _capsule_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> Hit:
    # A ray that enters the infinite cylinder beyond an end can only enter through that end's ball.
    square, discriminant, back = _tube(p, u, v)
    dz, oz, half = _at(p[6:], u, v), p[15], p[16]
    side = (back - jnp.sqrt(discriminant)) / square
    z = oz + side * dz
    from_ball = oz - jnp.where(z > 0, half, -half)
    square3, back3 = square + dz * dz, back - from_ball * dz
    discriminant3 = back3 * back3 - square3 * (p[17] + from_ball * from_ball)
    ball = (back3 - jnp.sqrt(discriminant3)) / square3
    on_side = jnp.abs(z) <= half
    return jnp.where(on_side, side, ball), on_side | (discriminant3 >= 0)


def _box_columns(q: Placed) -> jax.Array:
    return jnp.concatenate([_directions(q), -1 - q.eye, 1 - q.eye], -1)


def _box_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> Hit:
    near, far = [], []
    for i in range(3):
        inverse = 1 / _at(p[3 * i :], u, v)
        low, high = p[9 + i] * inverse, p[12 + i] * inverse
        near.append(smaller(low, high))
        far.append(larger(low, high))
    entry = larger(larger(near[0], near[1]), near[2])
    return entry, entry <= smaller(smaller(far[0], far[1]), far[2])


def _plane_columns(q: Placed) -> jax.Array:
    return jnp.concatenate([_directions(q), q.eye], -1)


def _plane_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> Hit:
    dz = _at(p[6:], u, v)
    depth = -p[11] / dz
    x, y = p[9] + depth * _at(p, u, v), p[10] + depth * _at(p[3:], u, v)
    return depth, (dz < 0) & (jnp.abs(x) <= 1) & (jnp.abs(y) <= 1)


# -- shadow: does the geom lie between p and p + limit * d? (scaled local frame) -------------------


def _ball_blocks(p: Vector, d: Vector, limit: float) -> jax.Array:
    square, ahead = dot(d, d), dot(p, d)
    discriminant = ahead * ahead - square * (dot(p, p) - 1)
    entry = -ahead - jnp.sqrt(discriminant)
    return (entry > 0) & (entry < limit * square)


def _ellipsoid_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    del half
    return _ball_blocks(p, d, limit)


def _tube_span(p: Vector, d: Vector) -> tuple[jax.Array, jax.Array]:
    square = jnp.maximum(d[0] * d[0] + d[1] * d[1], _TINY)
    moment, ahead = p[0] * d[1] - p[1] * d[0], p[0] * d[0] + p[1] * d[1]
    reach = jnp.sqrt(square - moment * moment)
    return (-ahead - reach) / square, (reach - ahead) / square


def _slab_span(p: jax.Array, d: jax.Array) -> tuple[jax.Array, jax.Array]:
    inverse = 1 / d
    low, high = (-1 - p) * inverse, (1 - p) * inverse
    return smaller(low, high), larger(low, high)


def _cylinder_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    del half
    near, far = _tube_span(p, d)
    low, high = _slab_span(p[2], d[2])
    near, far = larger(low, near), smaller(high, far)
    return (near <= far) & (near > 0) & (near < limit)


def _capsule_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    near, _ = _tube_span(p, d)
    z = p[2] + near * d[2]
    side = (jnp.abs(z) <= half) & (near > 0) & (near < limit)
    end = jnp.where(z > 0, half, -half)
    return side | ((jnp.abs(z) > half) & _ball_blocks((p[0], p[1], p[2] - end), d, limit))


def _box_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    del half
    spans = [_slab_span(p[i], d[i]) for i in range(3)]
    near = larger(larger(spans[0][0], spans[1][0]), spans[2][0])
    far = smaller(smaller(spans[0][1], spans[1][1]), spans[2][1])
    return (near <= far) & (near > 0) & (near < limit)


def _plane_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    del half
    s = -p[2] / d[2]
    x, y = p[0] + s * d[0], p[1] + s * d[1]
    # A thing that stands on a plane dips into it by a rounding error: a millimetre is no shadow.
    return (s > 0) & (jnp.abs(p[2]) > 1e-3) & (s < limit) & (jnp.abs(x) <= 1) & (jnp.abs(y) <= 1)


class Tests(NamedTuple):
    """The functions of one family."""

    columns: Callable[[Placed], jax.Array]  # numbers per geom, [W, G, F]
    hit: Callable[[Sequence[jax.Array], jax.Array, jax.Array], Hit]  # -> depth, counts
    blocks: Callable[[Vector, Vector, jax.Array, float], jax.Array]


TESTS = {
    "ellipsoid": Tests(_ellipsoid_columns, _ellipsoid_hit, _ellipsoid_blocks),
    "capsule": Tests(_capsule_columns, _capsule_hit, _capsule_blocks),
    "cylinder": Tests(_cylinder_columns, _cylinder_hit, _cylinder_blocks),
    "box": Tests(_box_columns, _box_hit, _box_blocks),
    "plane": Tests(_plane_columns, _plane_hit, _plane_blocks),
}


class Kind(NamedTuple):
    """Of the geom that each ray hit: its family, as masks."""

    cylinder: jax.Array
    box: jax.Array
    plane: jax.Array


def surface(
    depth: jax.Array, o: Vector, d: Vector, half: jax.Array, kind: Kind
) -> tuple[jax.Array, Vector, Vector]:
    """Depth to full precision, local point and outward gradient of the implicit surface there.

    `depth` (a constant for differentiation) is within about 1e-4 of the truth; one Newton step on
    the surface's equation f(o + t d) = 0 makes it exact to rounding and carries the derivatives of
    the geom's pose and size: dt = -df / (grad f . d). All families share one equation:
    x^2 + y^2 + (z beyond the straight part)^2 = 1 for the round ones, and for the flat ones the
    side whose plane the ray meets last.
    """
    depth = jax.lax.stop_gradient(depth)
    x, y, z = each(lambda i: o[i] + depth * d[i])
    # How far out the point is along each axis, counted on the side that faces the camera.
    fx, fy, fz = (jnp.where(w > 0, -p, p) for p, w in ((x, d[0]), (y, d[1]), (z, d[2])))
    lid = kind.cylinder & (fz > x * x + y * y)
    on_x = kind.box & (fx >= fy) & (fx >= fz)
    on_y = kind.box & ~on_x & (fy >= fz)
    on_z = (kind.box & ~on_x & ~on_y) | lid | kind.plane
    flat = kind.box | lid | kind.plane
    facing = [jnp.where(w > 0, -1.0, 1.0) for w in d]
    beyond = z - jnp.clip(z, -half, half)
    gx = jnp.where(flat, jnp.where(on_x, facing[0], 0.0), x)
    gy = jnp.where(flat, jnp.where(on_y, facing[1], 0.0), y)
    gz = jnp.where(flat, jnp.where(on_z, facing[2], 0.0), jnp.where(kind.cylinder, 0.0, beyond))
    out = jnp.where(on_x, fx, jnp.where(on_y, fy, fz)) - jnp.where(kind.plane, 0.0, 1.0)
    off = jnp.where(flat, out, 0.5 * (x * x + y * y + gz * gz - 1))
    slope = jnp.minimum(gx * d[0] + (gy * d[1] + gz * d[2]), -1e-6)
    limit = 1e-3 * depth
    step = jnp.clip(-off / slope, -limit, limit)
    depth = depth + step
    point = (x + step * d[0], y + step * d[1], z + step * d[2])
    return depth, point, (gx, gy, gz)
