"""`render`: which geom every pixel sees (`nearest`), then its depth, normal and colour.

Only the second half is differentiated. On CPUs both run over blocks of tiles that fit the caches; the tiles
are sorted by how many geoms can touch them, so that a block's loops are no longer than its tiles need.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap

from palm_jax.render import shading
from palm_jax.render.intersect import Kind, Vector, dot, surface
from palm_jax.render.nearest import (
    NOTHING,
    hit_rows,
    nearest_fused,
    nearest_tiled,
    pixel_coordinates,
    slot_mask,
    touching,
    words,
)
from palm_jax.render.scene import (
    OUTPUTS,
    CameraLike,
    Frame,
    Scene,
    Window,
    check_names,
    check_shape,
)
from palm_jax.render.tables import (
    TILE,
    Inputs,
    Options,
    Tables,
    TileTable,
    GeomTable,
    make_tables,
    slot_order,
    slot_ranges,
    texture_kinds,
)

_BLOCK = 512  # tiles taken together; 74 k pixels
_BACKENDS = ("auto", "tiled", "fused")


def render(
    scene: Scene,
    camera: CameraLike,
    window: Window | None = None,
    *,
    outputs: Sequence[str] = ("rgb",),
    shadows: bool = False,
    backend: str = "auto",
) -> Frame:
    """Draws `scene` as `camera` sees it; one world, batch with `jax.vmap`.

    Under `vmap` any of the scene's arrays, the camera and the window's origin may be batched or shared, and
    all worlds run in one loop; nested `vmap`s are flattened. A pixel depends on its ray alone: a window has
    the same bits as that part of the full frame, and a world the same bits in any batch.

    Differentiable in every floating-point leaf (reverse and forward): `depth` and `radiance` carry the
    derivatives of what each pixel sees; the jumps at silhouettes and shadow edges have none.

    Args:
      scene: what to draw.
      camera: `K` [3, 3], `cam_to_world` [4, 4] (x right, y down, z forward), static `height`, `width`.
        A camera with non-finite entries sees nothing.
      window: pixels of the camera's image to draw; by default all.
      outputs: names out of `OUTPUTS`; the others are None in the result and cost nothing.
      shadows: hard shadows of the lights with `casts_shadow`; about twice the work.
      backend: "tiled" (CPU) or "fused" (accelerators); "auto" takes the one for the platform it runs on.

    Returns:
      `Frame` with H, W of the window. `depth` is planar (along the camera's z), inf where nothing is hit;
      `segmentation` holds `scene.ids`, -1 where nothing is hit. Surfaces closer together than about 1e-5 of
      their depth (for up to 64 geoms; twice that with every doubling) count as equal, and the geom whose
      family comes first in `intersect.FAMILIES` shows.

    Raises:
      ValueError: an unknown type, texture, output or backend, or a field of the wrong shape.
    """
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    check_names(outputs, OUTPUTS, "output")
    check_names((backend,), _BACKENDS, "backend")
    if not outputs:
        raise ValueError(f"outputs is empty; name at least one of: {', '.join(OUTPUTS)}")
    scene.check()
    check_shape("Camera.K", camera.K, (3, 3))
    check_shape("Camera.cam_to_world", camera.cam_to_world, (4, 4))
    if window is None:
        window = Window(jnp.zeros(2, jnp.int32), camera.height, camera.width)
    window.check()
    named = tuple(name for name in OUTPUTS if name in outputs)
    options = Options(window.height, window.width, window.stride, named, bool(shadows), backend)
    inputs = Inputs(
        jax.tree.map(_as_leaf, scene),
        _as_leaf(camera.K),
        _as_leaf(camera.cam_to_world),
        jnp.asarray(window.origin, jnp.int32),
    )
    images = _drawer(options)(jax.tree.map(lambda leaf: leaf[None], inputs))
    return Frame(**{name: image[0] for name, image in images.items()})


def _as_leaf(value: Any) -> jax.Array:
    array = jnp.asarray(value)
    return array if array.dtype == bool else array.astype(jnp.float32)


# -- batching and derivatives -------------------------------------------------------------------------------


def _flattening(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`function` of arrays with a leading axis of worlds, such that `vmap` makes that axis longer.

    JAX's own batching of a loop with a data-dependent trip count would mask every iteration.
    """
    batched = custom_vmap(function)

    @batched.def_vmap
    def rule(size: int, is_batched: tuple, inputs: Any) -> tuple[Any, Any]:
        def widen(leaf: jax.Array, has_axis: bool) -> jax.Array:
            full = leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape))
            return full.reshape(size * full.shape[1], *full.shape[2:])

        def split(leaf: jax.Array) -> jax.Array:
            return leaf.reshape(size, leaf.shape[0] // size, *leaf.shape[1:])

        out = batched(jax.tree.map(widen, inputs, is_batched[0]))
        return jax.tree.map(split, out), jax.tree.map(lambda _: True, out)

    return batched


@functools.lru_cache(maxsize=None)
def _drawer(options: Options) -> Callable[[Inputs], dict[str, jax.Array]]:
    """The images as a function of the inputs, with its rules for `vmap` and for derivatives."""
    draw_fast = _flattening(functools.partial(_draw, options))
    find = _flattening(functools.partial(_find, options))

    def draw_smooth(inputs: Inputs) -> dict[str, jax.Array]:
        # What a pixel sees is piecewise constant: no derivative flows through the loops.
        key = find(lax.stop_gradient(inputs))
        tables = make_tables(options, inputs)
        values = _resolve(options, inputs.scene, tables.tiles, tables.world, tables.geoms, key)
        return _images(options, values)

    @jax.custom_jvp
    def draw(inputs: Inputs) -> dict[str, jax.Array]:
        return draw_fast(inputs)

    @draw.defjvp
    def jvp(primals: tuple[Inputs], tangents: tuple[Inputs]) -> tuple[Any, Any]:
        return jax.jvp(draw_smooth, primals, tangents)

    return draw


def _by_platform(
    options: Options, tiled: Callable[[Inputs], Any], fused: Callable[[Inputs], Any], inputs: Inputs
) -> Any:
    if options.backend == "auto":
        return lax.platform_dependent(inputs, cpu=tiled, default=fused)
    return (tiled if options.backend == "tiled" else fused)(inputs)


def _draw(options: Options, inputs: Inputs) -> dict[str, jax.Array]:
    """Images [W, H, W, ...] of W worlds."""

    def tiled(inputs: Inputs) -> dict[str, jax.Array]:
        def kernel(tables: Tables, tiles: TileTable, world: jax.Array, key: jax.Array) -> dict:
            return _resolve(options, inputs.scene, tiles, world, tables.geoms, key)

        return _in_blocks(options, inputs, kernel)

    def fused(inputs: Inputs) -> dict[str, jax.Array]:
        tables = make_tables(options, inputs)
        key = nearest_fused(inputs.scene.types, options.stride, tables)
        return _resolve(options, inputs.scene, tables.tiles, tables.world, tables.geoms, key)

    return _images(options, _by_platform(options, tiled, fused, inputs))


def _find(options: Options, inputs: Inputs) -> jax.Array:
    """Keys int32 [W, tiles, 144]."""

    def tiled(inputs: Inputs) -> jax.Array:
        return _in_blocks(options, inputs, lambda tables, tiles, world, key: key)

    def fused(inputs: Inputs) -> jax.Array:
        return nearest_fused(inputs.scene.types, options.stride, make_tables(options, inputs))

    key = _by_platform(options, tiled, fused, inputs)
    return key.reshape(inputs.origin.shape[0], -1, key.shape[-1])


def _in_blocks(
    options: Options,
    inputs: Inputs,
    kernel: Callable[[Tables, TileTable, jax.Array, jax.Array], Any],
) -> Any:
    """`kernel(tables, tiles, world, key)` of all tiles, block by block; its arrays are [tiles, ...]."""
    types = inputs.scene.types
    tables = make_tables(options, inputs)
    rows = hit_rows(types, tables.placed)
    lists = words(types, touching(options, tables))
    length = jnp.sum(lax.population_count(lists), -1).astype(jnp.int32)
    tiles = length.shape[0]
    blocks = -(-tiles // _BLOCK)
    size = -(-tiles // blocks)
    order = jnp.argsort(-length)
    # The last block is filled up with copies of the last tile.
    padded = jnp.minimum(jnp.arange(blocks * size), tiles - 1)
    source = (tables.tiles, tables.world, lists)
    source = jax.tree.map(lambda leaf: leaf[order[padded]], source)

    def block(i: jax.Array, out: Any) -> Any:
        def cut(leaf: jax.Array) -> jax.Array:
            return lax.dynamic_slice_in_dim(leaf, i * size, size)

        part, world, part_lists = jax.tree.map(cut, source)
        key = nearest_tiled(types, options.stride, part, world, part_lists, rows)
        values = kernel(tables, part, world, key)
        return jax.tree.map(
            lambda all_, value: lax.dynamic_update_slice_in_dim(all_, value, i * size, 0), out, values
        )

    spec = jax.eval_shape(
        kernel,
        tables,
        *jax.tree.map(lambda leaf: leaf[:size], source[:2]),
        jnp.zeros((size, TILE * TILE), jnp.int32),
    )
    start = jax.tree.map(lambda s: jnp.zeros((blocks * size, *s.shape[1:]), s.dtype), spec)
    # The compiler must not know that this is `blocks`: a loop of one round would be dissolved, and its
    # arithmetic merged, and rounded differently, with what surrounds it.
    rounds = blocks + jnp.minimum(length[0], 0)
    out = lax.fori_loop(0, rounds, block, start)
    place = jnp.argsort(order)
    return jax.tree.map(lambda leaf: leaf[place], out)


# -- depth, normal, colour of what was found -----------------------------------------------------------------


def _resolve(
    options: Options,
    scene: Scene,
    tiles: TileTable,
    world: jax.Array,
    geoms: GeomTable,
    key: jax.Array,
) -> dict[str, jax.Array]:
    """Outputs per pixel, [N, 144]; rgb as packed uint32, radiance as three channels."""
    order = slot_order(scene.types)
    mask = slot_mask(scene.types)
    key = key.reshape(-1, key.shape[-1])
    hit = key < NOTHING
    slot = jnp.minimum(key & mask, len(order) - 1)
    out: dict[str, Any] = {}
    if "segmentation" in options.outputs:
        ids = jnp.asarray([scene.ids[i] for i in order], jnp.int32)
        out["segmentation"] = jnp.where(hit, ids[slot], -1)
    if options.outputs == ("segmentation",):
        return out
    index = world[:, None] * len(order) + slot
    u, v = pixel_coordinates(tiles, options.stride)
    a, b, c, o = (geoms.vector(name, index) for name in "abco")
    d = tuple(a[i] * u + (b[i] * v + c[i]) for i in range(3))
    ranges = slot_ranges(scene.types)

    def is_family(name: str) -> jax.Array:
        slots = ranges.get(name, range(0))
        return (slot >= slots.start) & (slot < slots.stop)

    kind = Kind(is_family("cylinder"), is_family("box"), is_family("plane"))
    near = lax.bitcast_convert_type(key & ~mask, jnp.float32)
    near = jnp.where(hit, near, 1.0)
    depth, point, gradient = surface(near, o, d, geoms.look_up("half", index), kind)
    if "depth" in options.outputs:
        out["depth"] = jnp.where(hit, depth, jnp.inf)
    if not options.coloured:
        return out
    fx, fy, skew = tiles["fx"], tiles["fy"], tiles["skew"]
    y = v / fy
    x = (u - skew * y) / fx
    one = jnp.ones_like(x)
    ray = (x, y, one)
    ga = dot(a, gradient)
    normal = shading.normalised((fx * ga, fy * dot(b, gradient) + skew * ga, dot(c, gradient)))
    to_eye = shading.normalised((-x, -y, -one))
    up = tiles.vector("up")
    rgb = geoms.vector("rgb", index)
    kinds = texture_kinds(scene)
    if len(kinds) > 1:
        grid = geoms.vector("grid", index)
        local = tuple((1 - 1e-4) * point[i] * grid[i] for i in range(3))
        footprint = depth * geoms.look_up("frequency", index) / fx
        weight = shading.textured(kinds, geoms.look_up("texture", index), local, footprint)
        rgb = shading.mix(rgb, geoms.vector("second", index), weight)
    lights = []
    for i, directional in enumerate(scene.lights.directional):
        towards = tiles.vector(f"light{i}_")
        if not directional:
            towards = shading.normalised(tuple(towards[j] - depth * ray[j] for j in range(3)))
        lights.append((towards, tiles.vector(f"diffuse{i}_"), tiles.vector(f"specular{i}_"), None))
    colour = shading.lit(
        rgb,
        geoms.look_up("specular", index),
        geoms.look_up("shininess", index),
        normal,
        to_eye,
        up,
        tiles.vector("ambient"),
        lights,
    )
    sky = shading.sky(tiles.vector("horizon"), tiles.vector("zenith"), up, ray)
    final = [jnp.where(hit, colour[i], sky[i]) for i in range(3)]
    final = [jnp.where(f > 0, jnp.minimum(f, 1.0), 0.0) for f in final]
    if "radiance" in options.outputs:
        out["radiance"] = tuple(final)
    if "rgb" in options.outputs:
        r, g, b_ = (jnp.floor(f * 255 + 0.5).astype(jnp.uint32) for f in final)
        out["rgb"] = r | (g << 8) | (b_ << 16)
    return out


def _images(options: Options, values: dict[str, Any]) -> dict[str, jax.Array]:
    """[N, 144] -> [W, H, W, ...]."""

    def image(tiles: jax.Array) -> jax.Array:
        grid = tiles.reshape(-1, options.rows, options.columns, TILE, TILE)
        grid = grid.transpose(0, 1, 3, 2, 4)
        grid = grid.reshape(-1, options.rows * TILE, options.columns * TILE)
        return grid[:, : options.height, : options.width]

    images = {name: jax.tree.map(image, value) for name, value in values.items()}
    if "rgb" in images:
        images["rgb"] = lax.bitcast_convert_type(images["rgb"], jnp.uint8)[..., :3]
    if "radiance" in images:
        images["radiance"] = jnp.stack(images["radiance"], -1)
    return images
