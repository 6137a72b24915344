"""Rays against primitives: what depends on the geom alone, and the tests for each family.

Rays are written in pixels. With (u, v) measured from the principal point, a pixel's ray through the camera
reaches depth t (metres along the camera's z) at the point `t * (x, y, 1)` of the camera frame, and in the
scaled frame of a geom (unit sphere, unit cube, ...) at `o + t * (a * u + b * v + c)`. The vectors a, b, c, o
are computed once per world and geom; a ray costs a few multiply-adds, and t is the planar depth as it is.

Layout: a vector is a tuple of three arrays, so that no array has a minor axis of 3, and all arithmetic is
elementwise: sums written out give the same bits whatever the batch.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

NEAR = 1e-3
"""Metres: what lies nearer to the camera's plane is not seen."""

_SMALLEST = 1e-5  # metres, stands for a size of zero
_INFINITE = 1e8  # metres, half width of an infinite plane
_TINY = 1e-12

Vector = tuple[jax.Array, jax.Array, jax.Array]

FAMILIES = ("ellipsoid", "capsule", "cylinder", "box", "plane")
"""Kinds of intersection test, in the order in which geoms are drawn; a sphere is an ellipsoid."""


def family(primitive: str) -> str:
    """The family of a primitive type."""
    return "ellipsoid" if primitive == "sphere" else primitive


class Placed(NamedTuple):
    """Geoms in the frame of the camera; every array is [W, G] (worlds, geoms)."""

    a: Vector  # change of the scaled local ray direction with u
    b: Vector  # with v
    c: Vector  # the direction at u = v = 0
    o: Vector  # the camera in the scaled local frame
    scale: Vector  # metres per unit of the scaled frame
    half: jax.Array  # half length of the straight part in radii: 0 ellipsoid, inf cylinder
    ok: jax.Array  # bool: to be drawn
    centre: Vector  # metres, camera frame
    axes: tuple[Vector, Vector, Vector]  # half axes of the bounding box, metres, camera frame


def dot(p: Vector, q: Vector) -> jax.Array:
    """Sum of products of two vectors."""
    return p[0] * q[0] + (p[1] * q[1] + p[2] * q[2])


def cross(p: Vector, q: Vector) -> Vector:
    """Vector product."""
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )


def components(vectors: jax.Array) -> Vector:
    """[..., 3] as a tuple of three [...]."""
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def _axes(matrices: jax.Array) -> tuple[Vector, Vector, Vector]:
    """Columns of [..., 3, 3]."""
    return (
        components(matrices[..., 0]),
        components(matrices[..., 1]),
        components(matrices[..., 2]),
    )


def _sizes(kinds: Sequence[str], size: jax.Array) -> tuple[Vector, Vector, jax.Array]:
    """Scale of the local frame, half sizes of the bounding box, and half length in radii."""
    is_kind = {k: jnp.asarray([k == kind for kind in kinds]) for k in (*FAMILIES, "sphere")}
    x, y, z = components(jnp.maximum(size, _SMALLEST))
    round_ = is_kind["sphere"] | is_kind["capsule"]
    tube = round_ | is_kind["cylinder"]
    plane = is_kind["plane"]
    wide_x = jnp.where(plane & (size[..., 0] <= 0), _INFINITE, x)
    wide_y = jnp.where(tube, x, jnp.where(plane & (size[..., 1] <= 0), _INFINITE, y))
    deep = jnp.where(round_, x, jnp.where(is_kind["cylinder"], y, jnp.where(plane, 1.0, z)))
    half = jnp.where(is_kind["capsule"], jnp.maximum(size[..., 1], 0) / x, 0.0)
    half = jnp.where(is_kind["cylinder"], jnp.inf, half)
    reach = jnp.where(plane, 0.0, deep) + jnp.where(is_kind["capsule"], half * x, 0.0)
    return (wide_x, wide_y, deep), (wide_x, wide_y, reach), half


def used_sizes(kinds: Sequence[str]) -> jax.Array:
    """bool [G, 3]: the entries of a size that mean something for each type."""
    count = {"sphere": 1, "capsule": 2, "cylinder": 2, "plane": 2}
    return jnp.asarray([[i < count.get(k, 3) for i in range(3)] for k in kinds])


def place(
    kinds: Sequence[str],
    pos: jax.Array,
    mat: jax.Array,
    size: jax.Array,
    visible: jax.Array,
    intrinsics: jax.Array,
    cam_to_world: jax.Array,
) -> Placed:
    """Geoms (pos [W, G, 3], mat [W, G, 3, 3], size [W, G, 3]) as the camera ([W, 3, 3], [W, 4, 4]) sees them."""
    size = jnp.where(used_sizes(kinds), size, 1.0)
    camera_ok = jnp.isfinite(intrinsics).all((-1, -2)) & jnp.isfinite(cam_to_world).all((-1, -2))
    ok = (
        visible
        & jnp.isfinite(pos).all(-1)
        & jnp.isfinite(mat).all((-1, -2))
        & (jnp.isfinite(size) & (size >= 0)).all(-1)
        & camera_ok[:, None]
    )
    # What is not drawn gets a harmless pose: no NaN enters, also not in gradients.
    pos = jnp.where(ok[..., None], pos, 0.0)
    mat = jnp.where(ok[..., None, None], mat, jnp.eye(3))
    size = jnp.where(ok[..., None], size, 1.0)
    intrinsics = jnp.where(camera_ok[:, None, None], intrinsics, jnp.eye(3))
    cam_to_world = jnp.where(camera_ok[:, None, None], cam_to_world, jnp.eye(4))

    scale, reach, half = _sizes(kinds, size)
    camera = _axes(cam_to_world[:, None, :3, :3])
    fx, fy = intrinsics[:, None, 0, 0], intrinsics[:, None, 1, 1]
    skew = intrinsics[:, None, 0, 1]
    world = _axes(mat)
    away = components(pos - cam_to_world[:, None, :3, 3])
    # Row i of the geom's inverse frame, then through the camera's axes and the intrinsics.
    turn = [[dot(world[i], camera[k]) for k in range(3)] for i in range(3)]
    a = tuple(turn[i][0] / (scale[i] * fx) for i in range(3))
    b = tuple((turn[i][1] - turn[i][0] * (skew / fx)) / (scale[i] * fy) for i in range(3))
    c = tuple(turn[i][2] / scale[i] for i in range(3))
    o = tuple(-dot(world[i], away) / scale[i] for i in range(3))
    centre = tuple(dot(camera[k], away) for k in range(3))
    axes = tuple(tuple(turn[i][k] * reach[i] for k in range(3)) for i in range(3))
    return Placed(a, b, c, o, scale, half, ok, centre, axes)  # type: ignore[arg-type]


# -- nearest hit: columns per geom, then the test -------------------------------------------------------
#
# `columns` turns geoms into the numbers that `hit` reads; `hit` returns the depth of the ray's entry and
# whether it counts. NaN means a miss: every comparison with it is false.


def _line(p: Vector, q: Placed) -> list[jax.Array]:
    """Coefficients of p . direction, as a function of (u, v)."""
    return [dot(p, q.a), dot(p, q.b), dot(p, q.c)]


def _at(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> jax.Array:
    return p[0] * u + (p[1] * v + p[2])


def _directions(q: Placed, axes: Sequence[int] = (0, 1, 2)) -> list[jax.Array]:
    return [w[i] for i in axes for w in (q.a, q.b, q.c)]


def _smaller(p: jax.Array, q: jax.Array) -> jax.Array:
    return jnp.where(p < q, p, q)


def _larger(p: jax.Array, q: jax.Array) -> jax.Array:
    return jnp.where(p > q, p, q)


def _ellipsoid_columns(q: Placed) -> list[jax.Array]:
    # |direction|^2 and |direction|^2 - |o x direction|^2, the discriminant, are quadratic in (u, v).
    # The cross product loses no digits where the camera is far; b^2 - a c would.
    wa, wb, wc = cross(q.o, q.a), cross(q.o, q.b), cross(q.o, q.c)

    def quadratic(a: Vector, b: Vector, c: Vector) -> list[jax.Array]:
        return [dot(a, a), 2 * dot(a, b), 2 * dot(a, c), dot(b, b), 2 * dot(b, c), dot(c, c)]

    square, moment = quadratic(q.a, q.b, q.c), quadratic(wa, wb, wc)
    back = [-x for x in _line(q.o, q)]
    return [*square, *(s - m for s, m in zip(square, moment, strict=True)), *back]


def _quadratic_at(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> jax.Array:
    return (p[0] * u + (p[1] * v + p[2])) * u + ((p[3] * v + p[4]) * v + p[5])


def _ellipsoid_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> tuple:
    discriminant = _quadratic_at(p[6:], u, v)
    depth = (_at(p[12:], u, v) - jnp.sqrt(discriminant)) / _quadratic_at(p, u, v)
    return depth, discriminant >= 0


def _tube_columns(q: Placed) -> list[jax.Array]:
    """Of the infinite cylinder x^2 + y^2 = 1: direction in x and y, moment about the axis, -o . d."""
    ox, oy = q.o[0], q.o[1]
    moment = [ox * w[1] - oy * w[0] for w in (q.a, q.b, q.c)]
    back = [-(ox * w[0] + oy * w[1]) for w in (q.a, q.b, q.c)]
    return [*_directions(q, (0, 1)), *moment, *back]


def _tube(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> tuple:
    dx, dy = _at(p, u, v), _at(p[3:], u, v)
    square = jnp.maximum(dx * dx + dy * dy, _TINY)
    moment = _at(p[6:], u, v)
    return square, square - moment * moment, _at(p[9:], u, v)


def _cylinder_columns(q: Placed) -> list[jax.Array]:
    oz = q.o[2]
    return [*_tube_columns(q), *_directions(q, (2,)), -1 - oz, 1 - oz]


def _cylinder_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> tuple:
    square, discriminant, back = _tube(p, u, v)
    across = 1 / square
    reach, middle = jnp.sqrt(discriminant) * across, back * across
    along = 1 / _at(p[12:], u, v)
    low, high = p[15] * along, p[16] * along
    near = _larger(_smaller(low, high), middle - reach)
    far = _smaller(_larger(low, high), middle + reach)
    return near, (near <= far) & (discriminant >= 0)


def _capsule_columns(q: Placed) -> list[jax.Array]:
    return [*_tube_columns(q), *_directions(q, (2,)), q.o[2], q.half, dot(q.o, q.o) - q.o[2] ** 2 - 1]


def _capsule_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> tuple:
    # A ray that enters the infinite cylinder beyond an end can only enter through that end's ball.
    square, discriminant, back = _tube(p, u, v)
    dz, oz, half = _at(p[12:], u, v), p[15], p[16]
    side = (back - jnp.sqrt(discriminant)) / square
    z = oz + side * dz
    from_ball = oz - jnp.where(z > 0, half, -half)
    square3, back3 = square + dz * dz, back - from_ball * dz
    discriminant3 = back3 * back3 - square3 * (p[17] + from_ball * from_ball)
    ball = (back3 - jnp.sqrt(discriminant3)) / square3
    on_side = jnp.abs(z) <= half
    return jnp.where(on_side, side, ball), on_side | (discriminant3 >= 0)


def _box_columns(q: Placed) -> list[jax.Array]:
    ends = [end - q.o[i] for i in range(3) for end in (-1.0, 1.0)]
    return [*_directions(q), *ends]


def _box_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> tuple:
    near, far = [], []
    for i in range(3):
        inverse = 1 / _at(p[3 * i :], u, v)
        low, high = p[9 + 2 * i] * inverse, p[10 + 2 * i] * inverse
        near.append(_smaller(low, high))
        far.append(_larger(low, high))
    entry = _larger(_larger(near[0], near[1]), near[2])
    return entry, entry <= _smaller(_smaller(far[0], far[1]), far[2])


def _plane_columns(q: Placed) -> list[jax.Array]:
    return [*_directions(q), *q.o]


def _plane_hit(p: Sequence[jax.Array], u: jax.Array, v: jax.Array) -> tuple:
    dz = _at(p[6:], u, v)
    depth = -p[11] / dz
    x, y = p[9] + depth * _at(p, u, v), p[10] + depth * _at(p[3:], u, v)
    return depth, (dz < 0) & (jnp.abs(x) <= 1) & (jnp.abs(y) <= 1)


# -- shadow: does anything lie between p and p + limit * d? (scaled local frame) ---------------------------


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
    return _smaller(low, high), _larger(low, high)


def _cylinder_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    del half
    near, far = _tube_span(p, d)
    low, high = _slab_span(p[2], d[2])
    near, far = _larger(low, near), _smaller(high, far)
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
    near = _larger(_larger(spans[0][0], spans[1][0]), spans[2][0])
    far = _smaller(_smaller(spans[0][1], spans[1][1]), spans[2][1])
    return (near <= far) & (near > 0) & (near < limit)


def _plane_blocks(p: Vector, d: Vector, half: jax.Array, limit: float) -> jax.Array:
    del half
    s = -p[2] / d[2]
    x, y = p[0] + s * d[0], p[1] + s * d[1]
    # A thing that stands on a plane dips into it by a rounding error: a millimetre is no shadow.
    return (s > 0) & (jnp.abs(p[2]) > 1e-3) & (s < limit) & (jnp.abs(x) <= 1) & (jnp.abs(y) <= 1)


class Tests(NamedTuple):
    """The functions of one family."""

    columns: Callable[[Placed], list[jax.Array]]  # numbers per geom, [W, G] each
    hit: Callable[[Sequence[jax.Array], jax.Array, jax.Array], tuple]  # -> depth, counts
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

    `depth` (a constant for differentiation) is within about 1e-4 of the truth; one Newton step on the
    surface's equation f(o + t d) = 0 makes it exact to rounding and carries the derivatives of the geom's
    pose and size: dt = -df / (grad f . d). All families share one equation: x^2 + y^2 + (z beyond the
    straight part)^2 = 1 for the round ones, and the front face most in front for the flat ones.
    """
    depth = jax.lax.stop_gradient(depth)
    x, y, z = (o[i] + depth * d[i] for i in range(3))
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
