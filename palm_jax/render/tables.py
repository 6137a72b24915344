"""What the kernels read, computed once per frame: numbers per tile and numbers per geom.

A kernel that reads fifty arrays is not vectorised, one that reads fifty columns of two tables is; so
everything a pixel needs of its world, its tile and the geom it sees is packed here.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.render.intersect import FAMILIES, Placed, Vector, components, dot, family, place
from palm_jax.render.scene import TEXTURES, Scene
from palm_jax.render.shading import normalised

TILE = 12
"""Side of a tile in pixels: 144 is a multiple of every vector width, so no ray is a scalar remainder."""


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
    """float32 [N, C]: a row per tile, columns by name."""

    values: jax.Array
    names: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    def __getitem__(self, name: str) -> jax.Array:
        """Column [N, 1]."""
        index = self.names.index(name)
        return self.values[:, index : index + 1]

    def vector(self, name: str) -> Vector:
        """Columns `name`0 .. `name`2."""
        return self[f"{name}0"], self[f"{name}1"], self[f"{name}2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GeomTable:
    """float32 [F * W * G]: per field, all geoms of all worlds in slot order."""

    values: jax.Array
    count: int = dataclasses.field(metadata={"static": True})  # W * G
    names: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    def look_up(self, name: str, index: jax.Array) -> jax.Array:
        """The field of geom `index` (world * G + slot), any shape."""
        start = self.names.index(name) * self.count
        return self.values.at[start + index].get(mode="promise_in_bounds")

    def vector(self, name: str, index: jax.Array) -> Vector:
        """Fields `name`0 .. `name`2."""
        x, y, z = (self.look_up(f"{name}{i}", index) for i in range(3))
        return x, y, z


class Tables(NamedTuple):
    """Input of the kernels; W worlds of G geoms, N = W * rows * columns tiles."""

    placed: Placed  # [W, G] in slot order
    intrinsics: jax.Array  # [W, 3, 3], finite
    left: jax.Array  # float32 [W, columns] first pixel column of each column of tiles
    top: jax.Array  # float32 [W, rows]
    tiles: TileTable
    world: jax.Array  # int32 [N]
    geoms: GeomTable


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
    order = np.asarray(slot_order(scene.types))
    placed = place(
        [scene.types[i] for i in order],
        scene.pos[:, order],
        scene.mat[:, order],
        scene.size[:, order],
        scene.visible[:, order],
        inputs.intrinsics,
        inputs.cam_to_world,
    )
    intrinsics = jnp.where(jnp.isfinite(inputs.intrinsics), inputs.intrinsics, 1.0)
    # Whole numbers and halves are exact in float32: a pixel's ray does not depend on its tile.
    step = TILE * options.stride
    left = (inputs.origin[:, 1:] + step * jnp.arange(options.columns)).astype(jnp.float32)
    top = (inputs.origin[:, :1] + step * jnp.arange(options.rows)).astype(jnp.float32)
    shape = (left.shape[0], options.rows, options.columns)

    def spread(value: jax.Array) -> jax.Array:
        return jnp.broadcast_to(value, shape).reshape(-1)

    columns = {"left": spread(left[:, None, :]), "top": spread(top[:, :, None])}
    for name, value in _world_columns(options, inputs, intrinsics).items():
        columns[name] = spread(value[:, None, None])
    fields = _geom_fields(options, scene, order, placed)
    return Tables(
        placed,
        intrinsics,
        left,
        top,
        TileTable(jnp.stack(list(columns.values()), -1), tuple(columns)),
        spread(jnp.arange(shape[0])[:, None, None]),
        GeomTable(
            jnp.stack([field.reshape(-1) for field in fields.values()]).reshape(-1),
            placed.ok.size,
            tuple(fields),
        ),
    )


def _named(name: str, vector: Sequence[jax.Array]) -> dict[str, jax.Array]:
    return {f"{name}{i}": value for i, value in enumerate(vector)}


def _world_columns(options: Options, inputs: Inputs, k: jax.Array) -> dict[str, jax.Array]:
    """Numbers [W] that all pixels of a world share; directions and places in the camera's frame."""
    columns = {
        "fx": k[:, 0, 0],
        "fy": k[:, 1, 1],
        "cx": k[:, 0, 2],
        "cy": k[:, 1, 2],
        "skew": k[:, 0, 1],
    }
    if not options.coloured:
        return columns
    scene, lights = inputs.scene, inputs.scene.lights
    rotation = inputs.cam_to_world[:, :3, :3]
    axes = [components(rotation[:, :, k]) for k in range(3)]

    def to_camera(vectors: jax.Array) -> Vector:
        x, y, z = (dot(components(vectors), axis) for axis in axes)
        return x, y, z

    columns |= _named("up", components(rotation[:, 2, :]))
    columns |= _named("ambient", components(lights.ambient))
    columns |= _named("horizon", components(scene.background[:, 0]))
    columns |= _named("zenith", components(scene.background[:, 1]))
    for i, directional in enumerate(lights.directional):
        if directional:
            towards = normalised(to_camera(-lights.dir[:, i]))
        else:
            towards = to_camera(lights.pos[:, i] - inputs.cam_to_world[:, :3, 3])
        columns |= _named(f"light{i}_", towards)
        columns |= _named(f"diffuse{i}_", components(lights.diffuse[:, i]))
        columns |= _named(f"specular{i}_", components(lights.specular[:, i]))
    return columns


def _geom_fields(
    options: Options, scene: Scene, order: np.ndarray, placed: Placed
) -> dict[str, jax.Array]:
    """Numbers [W, G] of the geom that a pixel sees."""
    fields = {}
    for name in ("a", "b", "c", "o"):
        fields |= _named(name, getattr(placed, name))
    fields["half"] = placed.half
    if not options.coloured:
        return fields
    fields |= _named("rgb", components(scene.rgb[:, order]))
    fields["specular"] = scene.specular[:, order]
    fields["shininess"] = scene.shininess[:, order]
    kinds = texture_kinds(scene)
    if len(kinds) > 1:
        frequency = 1 / jnp.maximum(scene.texture_scale[:, order], 1e-6)
        code = np.asarray([kinds.index(scene.textures[i]) for i in order], np.float32)
        fields |= _named("second", components(scene.rgb2[:, order]))
        fields |= _named("grid", [scale * frequency for scale in placed.scale])
        fields["frequency"] = frequency
        fields["texture"] = jnp.broadcast_to(code, frequency.shape)
    return fields
