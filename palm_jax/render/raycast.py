"""`render`: finds what every pixel sees (`nearest`), then its depth, id, colour (`pixels`).

On CPUs both run over blocks of tiles that fit the caches. The tiles are sorted by how many geoms
can touch them, so that a block's loops are no longer than its own tiles need.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from palm_jax._checks import OptionError
from palm_jax.render.nearest import (
    Seen,
    prepare_tiled,
    seen_fused,
    seen_tiled,
)
from palm_jax.render.pixels import PLANES, resolve
from palm_jax.render.scene import (
    OUTPUTS,
    CameraLike,
    Frame,
    Scene,
    Window,
    check_names,
    check_shape,
)
from palm_jax.render.tables import TILE, Inputs, Options, Tables, TileTable, make_tables

_BLOCK = 256  # tiles taken together: 37 thousand pixels
_BACKENDS = ("auto", "tiled", "fused")

Planes = dict[str, jax.Array]


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

    Under `vmap` any of the scene's arrays, the camera and the window's origin may be batched or
    shared, and all worlds run in one loop; nested `vmap`s are flattened. On CPUs a pixel depends on
    its ray alone, to the last bit: a window equals that part of the full frame, a world is the same
    in any batch.

    Differentiable in every floating-point leaf (reverse and forward), with a fixed number of
    operations: `depth` and `radiance` carry the derivatives of what each pixel sees; the jumps at
    silhouettes and shadow edges have none.

    Args:
      scene: what to draw.
      camera: `palm_jax.align.Camera`, or anything with `K` [3, 3], `cam_to_world` [4, 4] (x right,
        y down, z forward) and static `height`, `width`. Under jit a camera with non-finite entries
        sees nothing.
      window: pixels of the camera's image to draw; by default all.
      outputs: names out of `OUTPUTS`; the others are None in the result and cost nothing.
      shadows: hard shadows of the lights with `casts_shadow`; about three times the work.
      backend: "tiled" (CPU) or "fused" (accelerators); "auto" takes the one for the platform.

    Returns:
      `Frame` with H, W of the window. `depth` is planar (along the camera's z), inf where nothing
      is hit; `segmentation` holds `scene.ids`, -1 where nothing is hit. Surfaces closer together
      than about 1e-5 of their depth (for up to 64 geoms; twice that with every doubling) count as
      equal, and the geom whose family comes first in `intersect.FAMILIES` shows.

    Raises:
      OptionError: an unknown type, texture, output or backend.
      ShapeError: a field of the wrong shape.
      DtypeError: a window origin that is not integer.
      CameraError, PoseError: concrete values of a `Camera` that cannot be one.
    """
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    check_names(outputs, OUTPUTS, "output")
    check_names((backend,), _BACKENDS, "backend")
    if not outputs:
        raise OptionError(f"outputs is empty; name at least one of: {', '.join(OUTPUTS)}")
    scene.check()
    check_shape("Camera.K", camera.K, (3, 3))
    check_shape("Camera.cam_to_world", camera.cam_to_world, (4, 4))
    check_values = getattr(camera, "check", None)
    if check_values is not None:
        check_values()
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
    planes = _drawer(options)(jax.tree.map(lambda leaf: leaf[None], inputs))
    return _frame(jax.tree.map(lambda plane: plane[0], planes))


def _as_leaf(value: Any) -> jax.Array:
    array = jnp.asarray(value)
    return array if array.dtype == bool else array.astype(jnp.float32)


def _frame(planes: Planes) -> Frame:
    """Images [H, W] to the outputs."""
    radiance = [planes[name] for name in PLANES["radiance"] if name in planes]
    rgb = None
    if "rgb" in planes:
        rgb = lax.bitcast_convert_type(planes["rgb"], jnp.uint8)[..., :3]
    return Frame(
        rgb=rgb,
        radiance=jnp.stack(radiance, -1) if radiance else None,
        depth=planes.get("depth"),
        segmentation=planes.get("segmentation"),
    )


# -- batching and derivatives ----------------------------------------------------------------------


def _flattening(function: Callable[[Inputs], Any]) -> Callable[[Inputs], Any]:
    """`function` of arrays with a leading axis of worlds, such that `vmap` makes that axis longer.

    JAX's own batching of a loop with a data-dependent trip count would mask every iteration.
    """
    batched = custom_vmap(function)

    @batched.def_vmap
    def rule(size: int, is_batched: tuple, inputs: Inputs) -> tuple[Any, Any]:
        def widen(leaf: jax.Array, has_axis: bool) -> jax.Array:
            full = leaf if has_axis else jnp.broadcast_to(leaf, (size, *leaf.shape))
            return full.reshape(size * full.shape[1], *full.shape[2:])

        def split(leaf: jax.Array) -> jax.Array:
            return leaf.reshape(size, leaf.shape[0] // size, *leaf.shape[1:])

        out = batched(jax.tree.map(widen, inputs, is_batched[0]))
        return jax.tree.map(split, out), jax.tree.map(lambda _: True, out)

    return batched


@functools.cache
def _drawer(options: Options) -> Callable[[Inputs], Planes]:
    """Planes [worlds, H, W] as a function of the inputs; knows `vmap` and derivatives."""
    draw_fast = _flattening(functools.partial(_draw, options))
    find = _flattening(functools.partial(_find, options))

    def draw_smooth(inputs: Inputs) -> Planes:
        # What a pixel sees is piecewise constant: no derivative flows through the loops.
        seen = jax.tree.map(_tiles_first, find(lax.stop_gradient(inputs)))
        return _images(options, _resolve_all(options, inputs, make_tables(options, inputs), seen))

    @jax.custom_jvp
    def draw(inputs: Inputs) -> Planes:
        return draw_fast(inputs)

    @draw.defjvp
    def jvp(primals: tuple[Inputs], tangents: tuple[Inputs]) -> tuple[Any, Any]:
        return jax.jvp(draw_smooth, primals, tangents)

    return jax.jit(draw)


def _tiles_first(array: jax.Array) -> jax.Array:
    """[W, tiles, 144] -> [N, 144]."""
    return array.reshape(-1, array.shape[-1])


def _draw(options: Options, inputs: Inputs) -> Planes:
    def tiled(inputs: Inputs) -> Planes:
        def kernel(tables: Tables, tiles: TileTable, world: jax.Array, seen: Seen) -> Planes:
            return resolve(options, inputs.scene, tiles, world, tables.geoms, seen)

        dtypes = {k: v for name in options.outputs for k, v in PLANES[name].items()}
        return _in_blocks(options, inputs, kernel, dtypes)

    def fused(inputs: Inputs) -> Planes:
        tables = make_tables(options, inputs)
        return _resolve_all(options, inputs, tables, seen_fused(options, inputs.scene, tables))

    return _images(options, _by_platform(options, tiled, fused, inputs))


def _find(options: Options, inputs: Inputs) -> Seen:
    """What each pixel sees, [W, tiles, 144] each."""

    def tiled(inputs: Inputs) -> Seen:
        names = ("key", "shadows") if options.shadowed else ("key",)
        planes = _in_blocks(
            options,
            inputs,
            lambda tables, tiles, world, seen: {name: getattr(seen, name) for name in names},
            dict.fromkeys(names, jnp.int32),
        )
        return Seen(planes["key"], planes.get("shadows"))

    def fused(inputs: Inputs) -> Seen:
        return seen_fused(options, inputs.scene, make_tables(options, inputs))

    worlds = inputs.origin.shape[0]
    seen = _by_platform(options, tiled, fused, inputs)
    return jax.tree.map(lambda x: x.reshape(worlds, -1, x.shape[-1]), seen)


def _by_platform(
    options: Options, tiled: Callable[[Inputs], Any], fused: Callable[[Inputs], Any], inputs: Inputs
) -> Any:
    # Without an accelerator the other form is not even traced: half the time to trace.
    if options.backend == "auto" and jax.default_backend() != "cpu":
        return lax.platform_dependent(inputs, cpu=tiled, default=fused)
    return (fused if options.backend == "fused" else tiled)(inputs)


def _resolve_all(options: Options, inputs: Inputs, tables: Tables, seen: Seen) -> Planes:
    return resolve(options, inputs.scene, tables.tiles, tables.world, tables.geoms, seen)


def _in_blocks(
    options: Options,
    inputs: Inputs,
    kernel: Callable[[Tables, TileTable, jax.Array, Seen], Planes],
    dtypes: dict[str, Any],
) -> Planes:
    """`kernel(tables, tiles, world, seen)` of all tiles, block by block; [N, 144] each."""
    worlds = inputs.origin.shape[0]
    if worlds == 1:
        # The compiler drops an axis of length one, then fuses and rounds the set-up differently.
        inputs = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), inputs)
    # Nor may it fold a constant scene, or merge what made the scene, with other roundings.
    inputs = lax.optimization_barrier(inputs)
    tables = make_tables(options, inputs)
    lists, length, search = prepare_tiled(options, inputs.scene, tables)
    tiles = worlds * options.rows * options.columns
    lists, length = lists[:tiles], length[:tiles]
    blocks = -(-tiles // _BLOCK)
    size = -(-tiles // blocks)
    order = jnp.argsort(-length)
    # The last block is filled up with copies of the last tile.
    source = order[jnp.minimum(jnp.arange(blocks * size), tiles - 1)]
    everything = jax.tree.map(lambda leaf: leaf[source], (tables.tiles, tables.world, lists))

    def block(i: jax.Array, planes: Planes) -> Planes:
        part, world, part_lists = jax.tree.map(
            lambda leaf: lax.dynamic_slice_in_dim(leaf, i * size, size), everything
        )
        seen = seen_tiled(options, inputs.scene, search, part, world, part_lists)
        return jax.tree.map(
            lambda plane, new: lax.dynamic_update_slice_in_dim(plane, new, i * size, 0),
            planes,
            kernel(tables, part, world, seen),
        )

    start = {name: jnp.zeros((blocks * size, TILE * TILE), dtype) for name, dtype in dtypes.items()}
    # The compiler must not know that this is `blocks`: it would dissolve a loop of one round, and
    # merge its arithmetic, rounded differently, with what surrounds it.
    rounds = blocks + jnp.minimum(length[0], 0)
    planes = lax.fori_loop(0, rounds, block, start)
    place = jnp.argsort(order)
    return jax.tree.map(lambda plane: plane[place], planes)


def _images(options: Options, planes: Planes) -> Planes:
    """[N, 144] -> [W, H, W]."""

    def image(plane: jax.Array) -> jax.Array:
        grid = plane.reshape(-1, options.rows, options.columns, TILE, TILE)
        grid = grid.transpose(0, 1, 3, 2, 4)
        grid = grid.reshape(-1, options.rows * TILE, options.columns * TILE)
        return grid[:, : options.height, : options.width]

    return jax.tree.map(image, planes)
