"""From what a pixel sees to depth, id and colour: the differentiable half of the renderer."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from palm_jax.render import shading
from palm_jax.render.intersect import Kind, Vector, dot, each, surface
from palm_jax.render.nearest import NOTHING, Seen, pixel_coordinates, slot_mask
from palm_jax.render.scene import Scene
from palm_jax.render.tables import (
    GeomTable,
    Options,
    TileTable,
    slot_order,
    slot_ranges,
    texture_kinds,
)

PLANES = {
    "rgb": {"rgb": jnp.uint32},
    "radiance": {"red": jnp.float32, "green": jnp.float32, "blue": jnp.float32},
    "depth": {"depth": jnp.float32},
    "segmentation": {"segmentation": jnp.int32},
}
"""What `resolve` returns for each output, a number per pixel each; `rgb` is packed, red lowest."""


class _Hit(NamedTuple):
    """The visible surface at every pixel, [N, 144] each."""

    hit: jax.Array  # bool
    row: jax.Array  # int32 row of the geom table
    depth: jax.Array
    point: Vector  # in the scaled frame of the geom
    normal: Vector  # outward, camera frame, any length
    ray: Vector  # direction with z = 1, camera frame


def resolve(
    options: Options,
    scene: Scene,
    tiles: TileTable,
    world: jax.Array,
    geoms: GeomTable,
    seen: Seen,
) -> dict[str, jax.Array]:
    """The `PLANES` of all outputs for N tiles, [N, 144] each.

    Args:
      options, scene: of the scene, only static fields are read.
      tiles, world, geoms: see `Tables`; `world` is int32 [N].
      seen: what each pixel sees.
    """
    types = scene.types
    hit = seen.key < NOTHING
    slot = jnp.minimum(seen.key & slot_mask(types), len(types) - 1)
    planes = {}
    if "segmentation" in options.outputs:
        ids = jnp.asarray([scene.ids[i] for i in slot_order(types)], jnp.int32)
        planes["segmentation"] = jnp.where(hit, ids.at[slot].get(mode="promise_in_bounds"), -1)
    if options.outputs == ("segmentation",):
        return planes
    at = _surface(options, scene, tiles, geoms, seen.key, hit, slot, world)
    if "depth" in options.outputs:
        planes["depth"] = jnp.where(hit, at.depth, jnp.inf)
    if options.coloured:
        colour = _colour(scene, tiles, geoms, at, seen.shadows)
        if "radiance" in options.outputs:
            planes |= dict(zip(PLANES["radiance"], colour, strict=True))
        if "rgb" in options.outputs:
            red, green, blue = (jnp.floor(x * 255 + 0.5).astype(jnp.uint32) for x in colour)
            planes["rgb"] = red | (green << 8) | (blue << 16)
    return planes


def _surface(
    options: Options,
    scene: Scene,
    tiles: TileTable,
    geoms: GeomTable,
    key: jax.Array,
    hit: jax.Array,
    slot: jax.Array,
    world: jax.Array,
) -> _Hit:
    row = world[:, None] * len(scene.types) + slot
    u, v = pixel_coordinates(tiles, options.stride)
    a, b, c, eye = (geoms.vector(name, row) for name in ("a", "b", "c", "eye"))
    ranges = slot_ranges(scene.types)

    def is_family(name: str) -> jax.Array:
        slots = ranges.get(name, range(0))
        return (slot >= slots.start) & (slot < slots.stop)

    kind = Kind(is_family("cylinder"), is_family("box"), is_family("plane"))
    rough = lax.bitcast_convert_type(key & ~slot_mask(scene.types), jnp.float32)
    depth, point, gradient = surface(
        jnp.where(hit, rough, 1.0),
        eye,
        each(lambda i: a[i] * u + (b[i] * v + c[i])),
        geoms.look_up("half", row),
        kind,
    )
    # The gradient's covector goes back to the camera's frame through the same a, b, c.
    fx, fy, skew = tiles["fx"], tiles["fy"], tiles["skew"]
    along_a = dot(a, gradient)
    normal = fx * along_a, fy * dot(b, gradient) + skew * along_a, dot(c, gradient)
    y = v / fy
    return _Hit(hit, row, depth, point, normal, ((u - skew * y) / fx, y, jnp.ones_like(y)))


def _colour(
    scene: Scene, tiles: TileTable, geoms: GeomTable, at: _Hit, shadows: jax.Array | None
) -> Vector:
    """Colour in 0..1 of surface or sky; not-a-number becomes 0."""
    up = tiles.vector("up")
    lit = shading.lit(
        _albedo(scene, tiles, geoms, at),
        geoms.look_up("specular", at.row),
        geoms.look_up("shininess", at.row),
        shading.normalised(at.normal),
        shading.normalised(each(lambda i: -at.ray[i])),
        up,
        tiles.vector("ambient"),
        _lights(scene, tiles, at, shadows),
    )
    sky = shading.sky(tiles.vector("horizon"), tiles.vector("zenith"), up, at.ray)

    def final(i: int) -> jax.Array:
        value = jnp.where(at.hit, lit[i], sky[i])
        return jnp.where(value > 0, jnp.minimum(value, 1.0), 0.0)

    return each(final)


def _albedo(scene: Scene, tiles: TileTable, geoms: GeomTable, at: _Hit) -> Vector:
    rgb = geoms.vector("rgb", at.row)
    kinds = texture_kinds(scene)
    if kinds == ("none",):
        return rgb
    grid = geoms.vector("grid", at.row)
    # A little inside, so that a face on the border of two squares belongs to one of them.
    local = each(lambda i: (1 - 1e-4) * at.point[i] * grid[i])
    footprint = at.depth * geoms.look_up("frequency", at.row) / tiles["fx"]
    weight = shading.textured(kinds, geoms.look_up("texture", at.row), local, footprint)
    return shading.mix(rgb, geoms.vector("second", at.row), weight)


def _from_point(place: Vector, at: _Hit) -> Vector:
    return each(lambda i: place[i] - at.depth * at.ray[i])


def _lights(
    scene: Scene, tiles: TileTable, at: _Hit, shadows: jax.Array | None
) -> Sequence[shading.Light]:
    lights = []
    for i, directional in enumerate(scene.lights.directional):
        towards = tiles.vector(f"light{i}")
        if not directional:
            towards = shading.normalised(_from_point(towards, at))
        shadowed = None
        if shadows is not None and scene.lights.casts_shadow[i]:
            shadowed = (shadows & (1 << i)) != 0
        lights.append(
            shading.Light(
                towards, tiles.vector(f"diffuse{i}"), tiles.vector(f"specular{i}"), shadowed
            )
        )
    return lights
