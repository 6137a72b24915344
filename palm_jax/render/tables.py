"""What the kernels read, computed once per frame: numbers per tile and numbers per geom.

A kernel that reads fifty arrays is not vectorised, one that reads fifty columns of two tables is:
everything a pixel needs of its world, its tile and the geom it sees is packed here.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.render.intersect import FAMILIES, Placed, Vector, components, family, place, turned
from palm_jax.render.scene import TEXTURES, Scene

TILE = 12
"""Side of a tile in pixels. 144 is a multiple of all vector widths: no ray is a remainder."""


class Options(NamedTuple):
    """What is static besides the scene's own static fields."""

    height: int
    width: int
    stride: int
    outputs: tuple[str, ...]
    shadows: bool
    backend: str

    @property
    def rows(self) -> int:
        """Rows of tiles."""
        return -(-self.height // TILE)

    @property
    def columns(self) -> int:
        """Columns of tiles."""
        return -(-self.width // TILE)

    @property
    def coloured(self) -> bool:
        """Whether anything is shaded."""
        return "rgb" in self.outputs or "radiance" in self.outputs

    @property
    def shadowed(self) -> bool:
        """Whether shadow rays are cast."""
        return self.shadows and self.coloured


class Inputs(NamedTuple):
    """Arrays of W worlds; every leaf has a leading axis W."""

    scene: Scene
    intrinsics: jax.Array  # [W, 3, 3]
    cam_to_world: jax.Array  # [W, 4, 4]
    origin: jax.Array  # int32 [W, 2]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TileTable:
    """A row per tile: what all its pixels share. Columns by name, [N, 1] each."""

    values: jax.Array  # float32 [N, C]
    layout: tuple[tuple[str, int], ...] = dataclasses.field(metadata={"static": True})

    def __getitem__(self, name: str) -> jax.Array:
        """The column `name`, [N, 1]."""
        start = _starts(self.layout)[name]
        return self.values[:, start : start + 1]

    def vector(self, name: str) -> Vector:
        """The three columns of `name`."""
        start = _starts(self.layout)[name]
        x, y, z = (self.values[:, i : i + 1] for i in range(start, start + 3))
        return x, y, z


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GeomTable:
    """A row per geom of each world, in slot order; row world * G + slot."""

    values: jax.Array  # float32 [W * G * F], flat: a look-up is one gather of single numbers
    layout: tuple[tuple[str, int], ...] = dataclasses.field(metadata={"static": True})

    def look_up(self, name: str, row: jax.Array, part: int = 0) -> jax.Array:
        """Number `part` of field `name` for every entry of `row`."""
        width = sum(count for _, count in self.layout)
        at = row * width + (_starts(self.layout)[name] + part)
        return self.values.at[at].get(mode="promise_in_bounds")

    def vector(self, name: str, row: jax.Array) -> Vector:
        """The three numbers of field `name`."""
        x, y, z = (self.look_up(name, row, i) for i in range(3))
        return x, y, z


def _starts(layout: Sequence[tuple[str, int]]) -> dict[str, int]:
    starts, at = {}, 0
    for name, width in layout:
        starts[name] = at
        at += width
    return starts


class Tables(NamedTuple):
    """Input of the kernels; W worlds of G geoms, N = W * rows * columns tiles."""

    placed: Placed  # [W, G] in slot order
    intrinsics: jax.Array  # [W, 3, 3], finite
    left: jax.Array  # float32 [W, columns] first pixel column of each column of tiles
    top: jax.Array  # float32 [W, rows]
    tiles: TileTable
    world: jax.Array  # int32 [N]
    geoms: GeomTable
    lights: jax.Array  # [W, L, 3] camera frame: unit vector towards a directional light, else place


def slot_order(types: Sequence[str]) -> list[int]:
    """Geoms in drawing order, that is, grouped by family."""
    return sorted(range(len(types)), key=lambda i: (FAMILIES.index(family(types[i])), i))


def slot_ranges(types: Sequence[str]) -> dict[str, range]:
    """Slots of each family that occurs."""
    ordered = [family(types[i]) for i in slot_order(types)]
    return {
        name: range(ordered.index(name), ordered.index(name) + ordered.count(name))
        for name in FAMILIES
        if name in ordered
    }


def texture_kinds(scene: Scene) -> tuple[str, ...]:
    """Textures that occur, "none" first."""
    return tuple(name for name in TEXTURES if name == "none" or name in scene.textures)


def pixel_offsets(stride: int) -> tuple[jax.Array, jax.Array]:
    """Centres of a tile's pixels (column, row) from its corner, float32 [144] each."""
    pixel = np.arange(TILE * TILE)
    column, row = (pixel % TILE) * stride + 0.5, (pixel // TILE) * stride + 0.5
    return jnp.asarray(column, jnp.float32), jnp.asarray(row, jnp.float32)


def make_tables(options: Options, inputs: Inputs) -> Tables:
    """Everything the kernels read."""
    scene = inputs.scene
    kinds, geoms = _in_slot_order(scene)
    placed = place(
        kinds,
        geoms["pos"],
        geoms["mat"].reshape(*geoms["pos"].shape, 3),
        geoms["size"],
        geoms["visible"][..., 0] > 0,
        inputs.intrinsics,
        inputs.cam_to_world,
    )
    intrinsics = jnp.where(jnp.isfinite(inputs.intrinsics), inputs.intrinsics, 1.0)
    # Whole numbers and halves are exact in float32: a pixel's ray does not depend on its tile.
    step = TILE * options.stride
    left = (inputs.origin[:, 1:] + step * np.arange(options.columns)).astype(jnp.float32)
    top = (inputs.origin[:, :1] + step * np.arange(options.rows)).astype(jnp.float32)
    worlds, shape = left.shape[0], (left.shape[0], options.rows, options.columns)
    lights = _lights(inputs)
    shared, layout = _joined(_world_columns(options, inputs, intrinsics, lights))
    corners = jnp.stack(
        [
            jnp.broadcast_to(left[:, None, :], shape),
            jnp.broadcast_to(top[:, :, None], shape),
        ],
        -1,
    )
    shared = jnp.broadcast_to(shared[:, None, None, :], (*shape, shared.shape[-1]))
    tiles = jnp.concatenate([corners, shared], -1)
    world = np.repeat(np.arange(worlds, dtype=np.int32), options.rows * options.columns)
    fields, geom_layout = _joined(_geom_fields(options, scene, geoms, placed))
    return Tables(
        placed,
        intrinsics,
        left,
        top,
        TileTable(tiles.reshape(-1, tiles.shape[-1]), (("left", 1), ("top", 1), *layout)),
        jnp.asarray(world),
        GeomTable(fields.reshape(-1), geom_layout),
        lights,
    )


def _joined(parts: dict[str, jax.Array]) -> tuple[jax.Array, tuple[tuple[str, int], ...]]:
    """Arrays [..., n] side by side, and their names and widths."""
    return jnp.concatenate(list(parts.values()), -1), tuple(
        (name, part.shape[-1]) for name, part in parts.items()
    )


def _lights(inputs: Inputs) -> jax.Array:
    """[W, L, 3]: unit vectors towards directional lights, places of point lights; camera frame."""
    lights = inputs.scene.lights
    sun = np.asarray(lights.directional, bool)[:, None]
    camera = inputs.cam_to_world[:, None]
    towards = turned(
        jnp.where(sun, -lights.dir, lights.pos - camera[..., :3, 3]), camera[..., :3, :3]
    )
    squares = components(towards * towards)
    length = jnp.maximum(squares[0] + (squares[1] + squares[2]), 1e-20)[..., None]
    return jnp.where(sun, towards * jnp.sqrt(1 / length), towards)


def _world_columns(
    options: Options, inputs: Inputs, k: jax.Array, lights: jax.Array
) -> dict[str, jax.Array]:
    """Numbers [W, n] that all pixels of a world share."""
    columns = {
        "fx": k[:, 0, :1],
        "fy": k[:, 1, 1:2],
        "cx": k[:, 0, 2:],
        "cy": k[:, 1, 2:],
        "skew": k[:, 0, 1:2],
    }
    if not options.coloured:
        return columns
    scene = inputs.scene
    columns["up"] = inputs.cam_to_world[:, 2, :3]
    columns["ambient"] = scene.lights.ambient
    columns["horizon"], columns["zenith"] = scene.background[:, 0], scene.background[:, 1]
    for i in range(lights.shape[1]):
        columns[f"light{i}"] = lights[:, i]
        columns[f"diffuse{i}"] = scene.lights.diffuse[:, i]
        columns[f"specular{i}"] = scene.lights.specular[:, i]
    return columns


def _in_slot_order(scene: Scene) -> tuple[list[str], dict[str, jax.Array]]:
    """Types and leaves [W, G, n] of the geoms, in slot order; one gather for all of them."""
    order = slot_order(scene.types)
    leaves = {}
    for name in (
        "pos",
        "mat",
        "size",
        "rgb",
        "rgb2",
        "texture_scale",
        "specular",
        "shininess",
        "visible",
    ):
        leaf = getattr(scene, name)
        leaves[name] = leaf.reshape(*leaf.shape[:2], -1).astype(jnp.float32)
    joined, layout = _joined(leaves)
    joined = joined[:, np.asarray(order)]
    starts = _starts(layout)
    parts = {name: joined[..., starts[name] : starts[name] + width] for name, width in layout}
    return [scene.types[i] for i in order], parts


def _geom_fields(
    options: Options, scene: Scene, geoms: dict[str, jax.Array], placed: Placed
) -> dict[str, jax.Array]:
    """Numbers [W, G, n] of the geom that a pixel sees."""
    a, b, c = (placed.ray[..., i, :] for i in range(3))
    fields = {"a": a, "b": b, "c": c, "eye": placed.eye, "half": placed.half[..., None]}
    if not options.coloured:
        return fields
    for name in ("rgb", "specular", "shininess"):
        fields[name] = geoms[name]
    kinds = texture_kinds(scene)
    if len(kinds) > 1:
        frequency = 1 / jnp.maximum(geoms["texture_scale"], 1e-6)
        code = [kinds.index(scene.textures[i]) for i in slot_order(scene.types)]
        fields["second"] = geoms["rgb2"]
        fields["grid"] = placed.scale * frequency
        fields["frequency"] = frequency
        fields["texture"] = jnp.broadcast_to(np.asarray(code, np.float32)[:, None], frequency.shape)
    return fields
