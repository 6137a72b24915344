"""Which geom each pixel sees, as one int32 key per pixel; and which lights its point does not see.

A key is the bits of the ray's depth (order-preserving for positive floats) with the low bits replaced by the
geom's slot: "nearest" is a plain minimum, and a loop carries a single array. The depth lost by that is found
again by `intersect.surface`.

Tiled form (CPU): bounding boxes tell which geoms can touch a tile, one bit each; a loop per family takes
every tile through its own bits, as often as the longest list of the block needs. Fused form (accelerators):
one broadcast and one minimum per family, which the compiler keeps in registers. Neither stores anything of
size rays x geoms.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from palm_jax.render.intersect import NEAR, TESTS, Placed, Vector
from palm_jax.render.tables import Options, Tables, TileTable, pixel_offsets, slot_ranges, TILE

NOTHING = 0x7F7FFFFF
"""Bits of the largest float32: a key beyond every hit."""

_WORD = 32  # geoms per bit mask


def slot_mask(types: Sequence[str]) -> int:
    """The low bits of a key that hold the slot."""
    return (1 << max(1, (len(types) - 1).bit_length())) - 1


def pixel_coordinates(tiles: TileTable, stride: int) -> tuple[jax.Array, jax.Array]:
    """Pixel centres relative to the principal point, [N, 144] each."""
    du, dv = pixel_offsets(stride)
    return (tiles["left"] + du) - tiles["cx"], (tiles["top"] + dv) - tiles["cy"]


# -- which geoms can touch which tiles ----------------------------------------------------------------------


def touching(options: Options, tables: Tables) -> jax.Array:
    """bool [N, G]: may the geom show in the tile? Its bounding box against the tile's four planes."""
    k, placed = tables.intrinsics, tables.placed
    skew = k[:, 0, 1, None]
    last = float((TILE - 1) * options.stride)

    def between(first: jax.Array, centre: jax.Array, along: Callable[[Vector], jax.Array]) -> jax.Array:
        # A plane through the camera and the pixel line u = e has the normal (fx, skew, cx - e).
        def outermost(edge: jax.Array, sign: float) -> jax.Array:
            slope = (centre[:, None] - edge)[:, :, None]
            value = sign * (along(placed.centre)[:, None] + slope * placed.centre[2][:, None])
            for axis in placed.axes:
                value += jnp.abs(along(axis)[:, None] + slope * axis[2][:, None])
            return value

        # From first pixel's centre to the last one's, and a tenth of a pixel for rounding.
        return (outermost(first + 0.4, 1.0) >= 0) & (outermost(first + last + 0.6, -1.0) >= 0)

    in_column = between(
        tables.left, k[:, 0, 2], lambda p: k[:, 0, 0, None] * p[0] + skew * p[1]
    )
    in_row = between(tables.top, k[:, 1, 2], lambda p: k[:, 1, 1, None] * p[1])
    deepest = placed.centre[2] + sum(jnp.abs(axis[2]) for axis in placed.axes)
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


def _rows(columns: Sequence[jax.Array]) -> jax.Array:
    """[W, g] columns -> rows [W * (g + 1), F]; a world's last row is NaN, which nothing hits."""
    rows = jnp.stack(columns, -1)
    rows = jnp.pad(rows, ((0, 0), (0, 1), (0, 0)), constant_values=jnp.nan)
    return rows.reshape(-1, len(columns))


def _part(placed: Placed, slots: range) -> Placed:
    return jax.tree.map(lambda x: x[:, slots.start : slots.stop], placed)


def hit_rows(types: Sequence[str], placed: Placed) -> list[jax.Array]:
    """Per group, what its intersection test reads."""
    return [_rows(TESTS[g.family].columns(_part(placed, g.slots))) for g in groups(types)]


def _over_lists(
    word: jax.Array, count: int, body: Callable[[jax.Array, jax.Array], jax.Array], start: jax.Array
) -> jax.Array:
    """Runs `body(index, carry)` over the set bits of each tile's word; index [N] is `count` where none is left."""

    def step(_: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        carry, left = state
        lowest = lax.population_count(~left & (left - 1)).astype(jnp.int32)
        return body(jnp.minimum(lowest, count), carry), left & (left - 1)

    longest = jnp.max(lax.population_count(word)).astype(jnp.int32)
    return lax.fori_loop(0, longest, step, (start, word))[0]


def _packed(depth: jax.Array, counts: jax.Array, slot: jax.Array, mask: int) -> jax.Array:
    bits = lax.bitcast_convert_type(depth, jnp.int32)
    return jnp.where(counts & (depth > NEAR), (bits & ~mask) | slot, NOTHING)


def nearest_tiled(
    types: Sequence[str],
    stride: int,
    tiles: TileTable,
    world: jax.Array,
    lists: jax.Array,
    rows: Sequence[jax.Array],
) -> jax.Array:
    """Keys int32 [N, 144] of N tiles with the geoms of `lists` uint32 [N, groups]."""
    du, dv = pixel_offsets(stride)
    mask = slot_mask(types)
    best = jnp.full((lists.shape[0], du.shape[0]), NOTHING, jnp.int32)
    for i, (group, table) in enumerate(zip(groups(types), rows, strict=True)):
        count = len(group.slots)

        def closer(
            index: jax.Array, best: jax.Array, table=table, count=count, group=group
        ) -> jax.Array:
            row = table[world * (count + 1) + index]
            u, v = (tiles["left"] + du) - tiles["cx"], (tiles["top"] + dv) - tiles["cy"]
            hit = TESTS[group.family].hit
            depth, counts = hit([row[:, j : j + 1] for j in range(row.shape[1])], u, v)
            return jnp.minimum(best, _packed(depth, counts, index[:, None] + group.slots.start, mask))

        best = _over_lists(lists[:, i], count, closer, best)
    return best


def nearest_fused(types: Sequence[str], stride: int, tables: Tables) -> jax.Array:
    """Keys int32 [N, 144] of all tiles: one broadcast over a family's geoms, one minimum."""
    u, v = pixel_coordinates(tables.tiles, stride)
    worlds = tables.left.shape[0]
    u_row, v_row = (x.reshape(worlds, 1, -1) for x in (u, v))
    best = jnp.full((worlds, u_row.shape[-1]), NOTHING, jnp.int32)
    for name, slots in slot_ranges(types).items():
        part = _part(tables.placed, slots)
        columns = [x[:, :, None] for x in TESTS[name].columns(part)]
        depth, counts = TESTS[name].hit(columns, u_row, v_row)
        slot = jnp.asarray(slots)[None, :, None]
        key = _packed(depth, counts & part.ok[:, :, None], slot, slot_mask(types))
        best = jnp.minimum(best, jnp.min(key, axis=1))
    return best.reshape(u.shape)
