"""Which geom each pixel sees, as one int32 key per pixel; and which lights its point does not see.

A key is the bits of the ray's depth (order-preserving for positive floats) with the low bits
replaced by the geom's slot: "nearest" is a plain minimum, and a loop carries a single array. The
depth lost by that is found again by `intersect.surface`.

Tiled form (CPU): bounding boxes tell which geoms can touch a tile, one bit each; a loop per family
takes every tile through its own bits, as often as the longest list of the block needs. Fused form
(accelerators): every ray meets every geom, a few in each round, which the compiler keeps in
registers between reading and writing the carry. Neither stores anything of size rays x geoms.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from palm_jax.render.intersect import (
    NEAR,
    TESTS,
    Placed,
    Vector,
    components,
    dot,
    each,
    larger,
    smaller,
    turned,
)
from palm_jax.render.scene import Scene
from palm_jax.render.tables import TILE, Options, Tables, TileTable, pixel_offsets, slot_ranges

NOTHING = 0x7F7FFFFF
"""Bits of the largest float32: a key beyond every hit."""

_WORD = 32  # geoms per bit mask
_AT_ONCE = 4  # geoms in each round of the fused loops


def slot_mask(types: Sequence[str]) -> int:
    """The low bits of a key that hold the slot."""
    return (1 << max(1, (len(types) - 1).bit_length())) - 1


def pixel_coordinates(tiles: TileTable, stride: int) -> tuple[jax.Array, jax.Array]:
    """Pixel centres relative to the principal point, [N, 144] each."""
    du, dv = pixel_offsets(stride)
    return (tiles["left"] + du) - tiles["cx"], (tiles["top"] + dv) - tiles["cy"]


# -- which geoms can touch which tiles -------------------------------------------------------------


def touching(options: Options, tables: Tables) -> jax.Array:
    """bool [N, G]: may the geom show in the tile? (Bounding box against the tile's four planes.)"""
    k, placed = tables.intrinsics[:, None, None], tables.placed
    # Centre and half axes of the bounding box, [W, G, 4] per component.
    axes = placed.turn * placed.reach[..., None]
    x, y, z = components(jnp.concatenate([placed.centre[..., None, :], axes], -2))
    last = float((TILE - 1) * options.stride)

    def between(first: jax.Array, centre: jax.Array, along: jax.Array) -> jax.Array:
        # A plane through the camera and the pixel line u = e has the normal (fx, skew, cx - e).
        def outermost(edge: jax.Array, sign: float) -> jax.Array:
            value = along[:, None] + (centre - edge[:, :, None, None]) * z[:, None]
            spread = [jnp.abs(value[..., i]) for i in (1, 2, 3)]
            return sign * value[..., 0] + (spread[0] + (spread[1] + spread[2]))

        # From the first pixel's centre to the last one's, and a tenth of a pixel for rounding.
        return (outermost(first + 0.4, 1.0) >= 0) & (outermost(first + last + 0.6, -1.0) >= 0)

    in_column = between(tables.left, k[..., 0, 2, None], k[..., 0, 0] * x + k[..., 0, 1] * y)
    in_row = between(tables.top, k[..., 1, 2, None], k[..., 1, 1] * y)
    depths = jnp.abs(z)
    deepest = z[..., 0] + (depths[..., 1] + (depths[..., 2] + depths[..., 3]))
    ahead = placed.ok & (deepest > NEAR)
    flags = in_row[:, :, None] & in_column[:, None] & ahead[:, None, None]
    return flags.reshape(-1, flags.shape[-1])


class Group(NamedTuple):
    """Up to 32 geoms of one family."""

    family: str
    slots: range


def groups(types: Sequence[str]) -> list[Group]:
    """The families, cut so that each fits a word."""
    return [
        Group(name, slots[start : start + _WORD])
        for name, slots in slot_ranges(types).items()
        for start in range(0, len(slots), _WORD)
    ]


def words(types: Sequence[str], flags: jax.Array) -> jax.Array:
    """bool [N, G] -> uint32 [N, groups], a geom per bit."""

    def word(slots: range) -> jax.Array:
        bits = jnp.left_shift(jnp.uint32(1), jnp.arange(len(slots), dtype=jnp.uint32))
        part = flags[:, slots.start : slots.stop]
        return jnp.sum(jnp.where(part, bits, jnp.uint32(0)), -1, dtype=jnp.uint32)

    return jnp.stack([word(group.slots) for group in groups(types)], -1)


def _rows(columns: jax.Array) -> jax.Array:
    """[W, g, F] -> rows [W * (g + 1), F]; a world's last row is NaN, which nothing hits."""
    rows = jnp.pad(columns, ((0, 0), (0, 1), (0, 0)), constant_values=jnp.nan)
    return rows.reshape(-1, rows.shape[-1])


def _part(placed: Placed, slots: range) -> Placed:
    return jax.tree.map(lambda x: x[:, slots.start : slots.stop], placed)


def _over_lists(
    lists: jax.Array,
    groups: Sequence[Group],
    body: Callable[[int, jax.Array, jax.Array], jax.Array],
    start: jax.Array,
) -> jax.Array:
    """Runs `body(group number, index, carry)` over the set bits of each tile's words.

    `index` int32 [N] counts within the group, and is the group's size for tiles whose bits are used
    up. A group has as many rounds as its fullest word has bits.
    """
    longest = jnp.max(lax.population_count(lists), 0).astype(jnp.int32)
    carry = start
    for number, group in enumerate(groups):

        def step(
            number: int, count: int, _: jax.Array, state: tuple[jax.Array, jax.Array]
        ) -> tuple[jax.Array, jax.Array]:
            carry, left = state
            lowest = lax.population_count(~left & (left - 1)).astype(jnp.int32)
            return body(number, jnp.minimum(lowest, count), carry), left & (left - 1)

        one = functools.partial(step, number, len(group.slots))
        carry, _ = lax.fori_loop(0, longest[number], one, (carry, lists[:, number]))
    return carry


def _numbers(rows: jax.Array) -> list[jax.Array]:
    return [rows[:, i : i + 1] for i in range(rows.shape[1])]


# -- the nearest geom ------------------------------------------------------------------------------


class Seen(NamedTuple):
    """What each pixel sees, [N, 144] each."""

    key: jax.Array  # int32: depth bits and slot, `NOTHING` where there is no geom
    shadows: jax.Array | None  # int32: bit i is set where light i does not reach


class Search(NamedTuple):
    """What the tiled loops read besides the tiles."""

    hit_rows: list[jax.Array]  # per group [W * (g + 1), F]
    shadow_rows: dict[int, list[jax.Array]]  # the same for every light that casts shadows
    boxes: jax.Array  # [W, G, 15] bounding boxes, camera frame: centre, unit axes, half sizes
    ok: jax.Array  # bool [W, G]


def prepare_tiled(
    options: Options, scene: Scene, tables: Tables
) -> tuple[jax.Array, jax.Array, Search]:
    """Lists uint32 [N, groups] of geoms per tile, their lengths int32 [N], and the loops' input."""
    placed = tables.placed
    lists = words(scene.types, touching(options, tables))
    length = jnp.sum(lax.population_count(lists), -1).astype(jnp.int32)
    hits = [_rows(TESTS[g.family].columns(_part(placed, g.slots))) for g in groups(scene.types)]
    shadows = {}
    if options.shadowed:
        for i, casts in enumerate(scene.lights.casts_shadow):
            if casts:
                columns = _shadow_columns(placed, tables, i, scene.lights.directional[i])
                shadows[i] = [
                    _rows(columns[:, g.slots.start : g.slots.stop]) for g in groups(scene.types)
                ]
    axes = placed.turn.reshape(*placed.half.shape, 9)
    boxes = jnp.concatenate([placed.centre, axes, placed.reach], -1)
    return lists, length, Search(hits, shadows, boxes, placed.ok)


def seen_tiled(
    options: Options,
    scene: Scene,
    search: Search,
    tiles: TileTable,
    world: jax.Array,
    lists: jax.Array,
) -> Seen:
    """What the pixels of N tiles see; `lists` uint32 [N, groups] names the geoms to try."""
    key = _nearest_tiled(options, scene.types, search, tiles, world, lists)
    if not options.shadowed:
        return Seen(key, None)
    return Seen(key, _shadows_tiled(options, scene, search, tiles, world, key))


def seen_fused(options: Options, scene: Scene, tables: Tables) -> Seen:
    """What all pixels of all worlds see, by trying every geom; a fixed number of operations."""
    key = _nearest_fused(options, scene.types, tables)
    if not options.shadowed:
        return Seen(key, None)
    return Seen(key, _shadows_fused(options, scene, tables, key))


def _packed(depth: jax.Array, counts: jax.Array, slot: jax.Array, mask: int) -> jax.Array:
    bits = lax.bitcast_convert_type(depth, jnp.int32)
    return jnp.where(counts & (depth > NEAR), (bits & ~mask) | slot, NOTHING)


def _nearest_tiled(
    options: Options,
    types: Sequence[str],
    search: Search,
    tiles: TileTable,
    world: jax.Array,
    lists: jax.Array,
) -> jax.Array:
    parts = groups(types)

    def closer(number: int, index: jax.Array, best: jax.Array) -> jax.Array:
        group, rows = parts[number], search.hit_rows[number]
        u, v = pixel_coordinates(tiles, options.stride)
        numbers = _numbers(rows[world * (len(group.slots) + 1) + index])
        depth, counts = TESTS[group.family].hit(numbers, u, v)
        slot = index[:, None] + group.slots.start
        return jnp.minimum(best, _packed(depth, counts, slot, slot_mask(types)))

    nothing = jnp.full((lists.shape[0], TILE * TILE), NOTHING, jnp.int32)
    return _over_lists(lists, parts, closer, nothing)


def _over_all(
    columns: jax.Array,
    ok: jax.Array,
    body: Callable[[Sequence[jax.Array], jax.Array, jax.Array], jax.Array],
    start: jax.Array,
) -> jax.Array:
    """Runs `body(numbers, index, carry)` over all g geoms of a family, `_AT_ONCE` in each round.

    Args:
      columns: [W, g, F]; `numbers` are F arrays [W, 1]. ok: bool [W, g], which geoms are drawn.
      body: sees numbers of a geom that nothing hits in place of one that is not drawn.
      start: carry.
    """
    rounds = -(-columns.shape[1] // _AT_ONCE)
    missing = rounds * _AT_ONCE - columns.shape[1]
    rows = jnp.where(ok[..., None], columns, jnp.nan)
    rows = jnp.pad(rows, ((0, 0), (0, missing), (0, 0)), constant_values=jnp.nan)

    def step(k: jax.Array, carry: jax.Array) -> jax.Array:
        part = lax.dynamic_slice_in_dim(rows, k * _AT_ONCE, _AT_ONCE, axis=1)
        for j in range(_AT_ONCE):
            carry = body(_numbers(part[:, j]), k * _AT_ONCE + j, carry)
        return carry

    return lax.fori_loop(0, rounds, step, start)


def _nearest_fused(options: Options, types: Sequence[str], tables: Tables) -> jax.Array:
    u, v = pixel_coordinates(tables.tiles, options.stride)
    worlds = tables.left.shape[0]
    u_row, v_row = u.reshape(worlds, -1), v.reshape(worlds, -1)
    best = jnp.full(u_row.shape, NOTHING, jnp.int32)
    for name, slots in slot_ranges(types).items():

        def closer(
            group: Group, numbers: Sequence[jax.Array], index: jax.Array, best: jax.Array
        ) -> jax.Array:
            depth, counts = TESTS[group.family].hit(numbers, u_row, v_row)
            slot = index + group.slots.start
            return jnp.minimum(best, _packed(depth, counts, slot, slot_mask(types)))

        part = _part(tables.placed, slots)
        body = functools.partial(closer, Group(name, slots))
        best = _over_all(TESTS[name].columns(part), part.ok, body, best)
    return best.reshape(u.shape)


# -- shadows ---------------------------------------------------------------------------------------
#
# From the point that a pixel sees towards each light. The point's own geom is left out: it is
# convex, so it never shades the side that faces the light, and no margin for rounding is needed.


def _shadow_columns(placed: Placed, tables: Tables, light: int, directional: bool) -> jax.Array:
    """[W, G, 16]: rays and eye as in `Placed`, the light in the local frame, half length."""
    k = tables.intrinsics[:, None, None]
    a, b, c = (placed.ray[..., i, :] for i in range(3))
    frame = jnp.stack([a * k[..., 0, 0], b * k[..., 1, 1] + a * k[..., 0, 1], c], -2)
    local = turned(tables.lights[:, None, light], frame)
    if not directional:
        local = local + placed.eye
    rays = placed.ray.reshape(*placed.half.shape, 9)
    return jnp.concatenate([rays, placed.eye, local, placed.half[..., None]], -1)


def _blocked(
    family: str,
    directional: bool,
    numbers: Sequence[jax.Array],
    u: jax.Array,
    v: jax.Array,
    depth: jax.Array,
) -> jax.Array:
    """Does the geom lie between the point at `depth` and the light?"""

    def point(i: int) -> jax.Array:
        direction = numbers[i] * u + (numbers[3 + i] * v + numbers[6 + i])
        return numbers[9 + i] + depth * direction

    p, light = each(point), each(lambda i: numbers[12 + i])
    if directional:
        return TESTS[family].blocks(p, light, numbers[15], float("inf"))
    return TESTS[family].blocks(p, _minus(light, p), numbers[15], 1.0)


def _split_key(types: Sequence[str], key: jax.Array) -> tuple[jax.Array, jax.Array]:
    mask = slot_mask(types)
    return lax.bitcast_convert_type(key & ~mask, jnp.float32), key & mask


def _shadows_tiled(
    options: Options,
    scene: Scene,
    search: Search,
    tiles: TileTable,
    world: jax.Array,
    key: jax.Array,
) -> jax.Array:
    parts = groups(scene.types)
    depth, slot = _split_key(scene.types, key)

    def shade(light: int, number: int, index: jax.Array, bits: jax.Array) -> jax.Array:
        group, rows = parts[number], search.shadow_rows[light][number]
        u, v = pixel_coordinates(tiles, options.stride)
        numbers = _numbers(rows[world * (len(group.slots) + 1) + index])
        directional = scene.lights.directional[light]
        blocked = _blocked(group.family, directional, numbers, u, v, depth)
        blocked &= slot != index[:, None] + group.slots.start
        return bits | jnp.where(blocked, 1 << light, 0)

    bits = jnp.zeros_like(key)
    for light in search.shadow_rows:
        directional = scene.lights.directional[light]
        flags = _between(options, search, tiles, world, key, slot, light, directional)
        lists = words(scene.types, flags)
        bits = _over_lists(lists, parts, functools.partial(shade, light), bits)
    return bits


def _between(
    options: Options,
    search: Search,
    tiles: TileTable,
    world: jax.Array,
    key: jax.Array,
    slot: jax.Array,
    light: int,
    directional: bool,
) -> jax.Array:
    """bool [N, G]: may the geom lie between some point that the tile shows and the light?

    The segment from the middle of the tile's points to the light, against the geom's bounding box
    grown by that of the points. A geom that is all that the tile shows does not shade itself.
    """
    middle, points = _points(options, tiles, key)
    towards = tiles.vector(f"light{light}")
    if not directional:
        towards = _minus(towards, middle)
    box = search.boxes[world]
    from_box = _minus(middle, components(box))
    near, far = jnp.zeros(()), jnp.asarray(jnp.inf if directional else 1.0)
    for i in range(3):
        axis = components(box[..., 3 + 3 * i : 6 + 3 * i])
        start, step = dot(axis, from_box), dot(axis, towards)
        inverse = 1 / jnp.where(jnp.abs(step) < 1e-9, 1e-9, step)
        wide = dot((jnp.abs(axis[0]), jnp.abs(axis[1]), jnp.abs(axis[2])), points)
        half = 1.001 * (box[..., 12 + i] + wide) + 1e-4
        low, high = (-half - start) * inverse, (half - start) * inverse
        near, far = larger(smaller(low, high), near), smaller(larger(low, high), far)
    hit = key < NOTHING
    first = jnp.min(jnp.where(hit, slot, NOTHING), -1, keepdims=True)
    last = jnp.max(jnp.where(hit, slot, -1), -1, keepdims=True)
    only = (first == last) & (np.arange(box.shape[1], dtype=np.int32) == first)
    return (near <= far) & search.ok[world] & (last >= 0) & ~only


def _points(options: Options, tiles: TileTable, key: jax.Array) -> tuple[Vector, Vector]:
    """Middle and half sizes of a box round the points that a tile shows, camera frame."""
    depth, hit = lax.bitcast_convert_type(key, jnp.float32), key < NOTHING
    near = jnp.min(jnp.where(hit, depth, jnp.inf), -1, keepdims=True)
    far = jnp.max(jnp.where(hit, depth, 0.0), -1, keepdims=True)
    last = (TILE - 1) * options.stride
    top = tiles["top"] + 0.5 - tiles["cy"]
    left = tiles["left"] + 0.5 - tiles["cx"]
    y = top / tiles["fy"], (top + last) / tiles["fy"]
    tilt = jnp.maximum(jnp.abs(y[0]), jnp.abs(y[1])) * jnp.abs(tiles["skew"])
    x = (left - tilt) / tiles["fx"], (left + (last + tilt)) / tiles["fx"]
    middle, half = [], []
    for low, high in (x, y, (1.0, 1.0)):
        first, second = jnp.minimum(low * near, low * far), jnp.maximum(high * near, high * far)
        middle.append(0.5 * (first + second))
        half.append(0.5 * (second - first))
    return (middle[0], middle[1], middle[2]), (half[0], half[1], half[2])


def _minus(p: Vector, q: Vector) -> Vector:
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


def _shadows_fused(options: Options, scene: Scene, tables: Tables, key: jax.Array) -> jax.Array:
    worlds = tables.left.shape[0]
    planes = (*_split_key(scene.types, key), *pixel_coordinates(tables.tiles, options.stride))
    depth, seen, u, v = (x.reshape(worlds, -1) for x in planes)
    bits = jnp.zeros(u.shape, jnp.int32)
    for light, casts in enumerate(scene.lights.casts_shadow):
        if not casts:
            continue
        directional = scene.lights.directional[light]
        columns = _shadow_columns(tables.placed, tables, light, directional)
        for name, slots in slot_ranges(scene.types).items():

            def shade(
                group: Group,
                light: int,
                directional: bool,
                numbers: Sequence[jax.Array],
                index: jax.Array,
                bits: jax.Array,
            ) -> jax.Array:
                blocked = _blocked(group.family, directional, numbers, u, v, depth)
                blocked &= seen != index + group.slots.start
                return bits | jnp.where(blocked, 1 << light, 0)

            part = slice(slots.start, slots.stop)
            body = functools.partial(shade, Group(name, slots), light, directional)
            bits = _over_all(columns[:, part], tables.placed.ok[:, part], body, bits)
    return bits.reshape(key.shape)
