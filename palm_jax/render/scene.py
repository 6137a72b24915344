"""What is drawn: primitives, materials, lights, background; and the window of pixels to draw.

Everything that can shift between worlds is a pytree leaf; what shapes the compiled program (types,
ids, texture kinds, which lights are directional, image sizes) is static. Single-example semantics:
no batch axis anywhere; batch with `jax.vmap`.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from palm_jax._checks import DtypeError, OptionError, ShapeError

Values = ArrayLike | Sequence[Any]

PRIMITIVES = ("sphere", "ellipsoid", "capsule", "cylinder", "box", "plane")
"""Names of the primitive types, as MuJoCo spells them."""

TEXTURES = ("none", "checker", "wood", "noise")
"""Names of the procedural textures; each mixes a geom's `rgb` and `rgb2`."""

OUTPUTS = ("rgb", "radiance", "depth", "segmentation")
"""Names of what `render` can return."""


def _static(**options: Any) -> Any:
    return dataclasses.field(metadata={"static": True}, **options)


class CameraLike(Protocol):
    """What `render` reads of a camera; `palm_jax.align.Camera` is one."""

    @property
    def K(self) -> ArrayLike:
        """[3, 3] intrinsics, pixels."""

    @property
    def cam_to_world(self) -> ArrayLike:
        """[4, 4] pose, axes x right, y down, z forward."""

    @property
    def height(self) -> int:
        """Rows of the full frame."""

    @property
    def width(self) -> int:
        """Columns of the full frame."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lights:
    """Light sources; make them with `make_lights`.

    Each light has a position and a direction and uses one of the two: a directional light its `dir`
    (the way the light travels, world frame), a point light its `pos` (metres). Light does not fall
    off with distance.
    """

    pos: jax.Array  # [L, 3] metres
    dir: jax.Array  # [L, 3] any length > 0
    diffuse: jax.Array  # [L, 3]
    specular: jax.Array  # [L, 3]
    ambient: jax.Array  # [3] from everywhere, dimmer from below
    directional: tuple[bool, ...] = _static()
    casts_shadow: tuple[bool, ...] = _static()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """G primitives with poses, materials and ids, lights and a sky; make it with `make_scene`.

    Sizes follow MuJoCo: sphere (radius, -, -), capsule and cylinder (radius, half length, -) along
    the local z axis, ellipsoid and box half sizes, plane (half width in x, in y, -) with 0 for
    infinite. A plane is z = 0 of its frame and is seen from the +z side only. The others are seen
    from outside only: a camera inside one looks through it. Nothing is seen nearer than 1 mm to the
    camera's plane. A geom with a non-finite pose or size, or with a negative size, is not seen;
    zero sizes count as 10 micrometres.
    """

    pos: jax.Array  # [G, 3] metres, world
    mat: jax.Array  # [G, 3, 3] columns are the geom's axes in the world
    size: jax.Array  # [G, 3] metres
    rgb: jax.Array  # [G, 3] 0..1
    rgb2: jax.Array  # [G, 3] 0..1, second colour of a texture
    texture_scale: jax.Array  # [G] metres per checker square, plank or blob
    specular: jax.Array  # [G] 0..1
    shininess: jax.Array  # [G] 0..1: MuJoCo's, 128 times this is the exponent
    visible: jax.Array  # bool [G]
    lights: Lights
    background: jax.Array  # [2, 3] sky colours: horizon (and all below it), zenith
    types: tuple[str, ...] = _static()
    ids: tuple[int, ...] = _static()
    textures: tuple[str, ...] = _static()

    def check(self) -> None:
        """Raises OptionError where a name is unknown, ShapeError where a shape is wrong."""
        for names, known, what in (
            (self.types, PRIMITIVES, "primitive type"),
            (self.textures, TEXTURES, "texture"),
        ):
            check_names(names, known, what)
        count = len(self.types)
        if count == 0:
            raise OptionError("Scene.types is empty; draw at least one geom (it may be invisible)")
        _check_length("Scene.ids", self.ids, count, "Scene.types")
        _check_length("Scene.textures", self.textures, count, "Scene.types")
        shapes = {
            "pos": (count, 3),
            "mat": (count, 3, 3),
            "size": (count, 3),
            "rgb": (count, 3),
            "rgb2": (count, 3),
            "texture_scale": (count,),
            "specular": (count,),
            "shininess": (count,),
            "visible": (count,),
            "background": (2, 3),
        }
        for name, shape in shapes.items():
            check_shape(f"Scene.{name}", getattr(self, name), shape)
        lamps = len(self.lights.directional)
        _check_length("Lights.casts_shadow", self.lights.casts_shadow, lamps, "Lights.directional")
        for name in ("pos", "dir", "diffuse", "specular"):
            check_shape(f"Lights.{name}", getattr(self.lights, name), (lamps, 3))
        check_shape("Lights.ambient", self.lights.ambient, (3,))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Window:
    """Which pixels of the virtual full frame to draw.

    Pixel (i, j) of the result is pixel (origin[0] + stride * i, origin[1] + stride * j) of the
    frame. The window may lie partly or wholly outside the frame: the camera's rays simply go on.
    """

    origin: jax.Array  # int32 [2] (row, column)
    height: int = _static()
    width: int = _static()
    stride: int = _static(default=1)

    def check(self) -> None:
        """Raises ShapeError, DtypeError or OptionError where a field is wrong."""
        check_shape("Window.origin", self.origin, (2,))
        if not jnp.issubdtype(jnp.result_type(self.origin), jnp.integer):
            raise DtypeError(
                f"Window.origin holds whole pixels: expected an integer dtype, got "
                f"{jnp.result_type(self.origin)}; round it and cast to int32"
            )
        for name in ("height", "width", "stride"):
            _check_positive(f"Window.{name}", getattr(self, name))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Frame:
    """What `render` returns; None where an output was not asked for."""

    rgb: jax.Array | None = None  # uint8 [H, W, 3]
    radiance: jax.Array | None = None  # float32 [H, W, 3] in 0..1: `rgb` before rounding
    depth: jax.Array | None = None  # float32 [H, W] metres along the camera's z; inf: nothing there
    segmentation: jax.Array | None = None  # int32 [H, W] geom id; -1: nothing there


def make_lights(
    *,
    dir: Values | None = None,
    pos: Values | None = None,
    diffuse: Values = 0.7,
    specular: Values = 0.3,
    ambient: Values = 0.3,
    casts_shadow: bool | Sequence[bool] = True,
) -> Lights:
    """Directional lights, then point lights.

    Args:
      dir: [D, 3] or [3] directions in which light travels (world); with neither `dir` nor `pos`
        there is one light from above.
      pos: [P, 3] or [3] positions of point lights, metres.
      diffuse, specular: [], [3] or [D + P, 3] intensities.
      ambient: [] or [3].
      casts_shadow: for all lights or for each; matters with `render(..., shadows=True)` only.

    Returns:
      `Lights` with L = D + P.

    Raises:
      ShapeError: a shape that does not fit.
    """
    if dir is None and pos is None:
        dir = [0.3, 0.5, -1.0]
    directions = _vectors("dir", dir)
    positions = _vectors("pos", pos)
    sun, lamp = directions.shape[0], positions.shape[0]
    casts = (casts_shadow,) * (sun + lamp) if isinstance(casts_shadow, bool) else casts_shadow
    filler = jnp.array([0.0, 0.0, -1.0], jnp.float32)
    return Lights(
        pos=jnp.concatenate([jnp.zeros((sun, 3), jnp.float32), positions]),
        dir=jnp.concatenate([directions, jnp.broadcast_to(filler, (lamp, 3))]),
        diffuse=_filled("diffuse", diffuse, (sun + lamp, 3)),
        specular=_filled("specular", specular, (sun + lamp, 3)),
        ambient=_filled("ambient", ambient, (3,)),
        directional=(True,) * sun + (False,) * lamp,
        casts_shadow=tuple(bool(c) for c in casts),
    )


def make_scene(
    types: Sequence[str],
    pos: Values,
    mat: Values,
    size: Values,
    rgb: Values,
    *,
    ids: Sequence[int] | None = None,
    textures: Sequence[str] | None = None,
    rgb2: Values | None = None,
    texture_scale: Values = 0.1,
    specular: Values = 0.3,
    shininess: Values = 0.4,
    visible: Values = True,
    lights: Lights | None = None,
    background: Values = ((0.80, 0.86, 0.92), (0.36, 0.52, 0.74)),
) -> Scene:
    """A `Scene` with defaults filled in, checked.

    Args:
      types: G names out of `PRIMITIVES`.
      pos: [G, 3]. mat: [G, 3, 3]. size: [G, 3] (see `Scene`). rgb: [G, 3] in 0..1.
      ids: G numbers for the segmentation; by default 0 .. G-1.
      textures: G names out of `TEXTURES`; by default none.
      rgb2: [G, 3], [3] or []; by default 0.6 times `rgb`.
      texture_scale, specular, shininess, visible: [] or [G].
      lights: see `make_lights`; by default one directional light from above.
      background: [2, 3] sky colours at the horizon and at the zenith.

    Raises:
      OptionError: an unknown type or texture, or no geom at all.
      ShapeError: a shape that does not fit.
    """
    count = len(types)
    colours = jnp.asarray(rgb, jnp.float32)
    scene = Scene(
        pos=jnp.asarray(pos, jnp.float32),
        mat=jnp.asarray(mat, jnp.float32),
        size=jnp.asarray(size, jnp.float32),
        rgb=colours,
        rgb2=0.6 * colours if rgb2 is None else _filled("rgb2", rgb2, (count, 3)),
        texture_scale=_filled("texture_scale", texture_scale, (count,)),
        specular=_filled("specular", specular, (count,)),
        shininess=_filled("shininess", shininess, (count,)),
        visible=jnp.broadcast_to(jnp.asarray(visible, bool), (count,)),
        lights=make_lights() if lights is None else lights,
        background=jnp.asarray(background, jnp.float32),
        types=tuple(types),
        ids=tuple(range(count)) if ids is None else tuple(int(i) for i in ids),
        textures=("none",) * count if textures is None else tuple(textures),
    )
    scene.check()
    return scene


def check_names(names: Sequence[str], known: Sequence[str], what: str) -> None:
    """Raises OptionError, listing the known names, where one of `names` is not among them."""
    for name in names:
        if name not in known:
            raise OptionError(f"unknown {what} {name!r}; known: {', '.join(known)}")


def check_shape(name: str, value: ArrayLike, shape: tuple[int, ...]) -> None:
    """Raises ShapeError where the field `name` has another shape."""
    got = jnp.shape(value)
    if got != shape:
        raise ShapeError(
            f"{name}: expected shape {list(shape)}, got {list(got)}; "
            "render takes one world, batch with jax.vmap"
        )


def _check_positive(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise OptionError(f"{name}: expected a Python int of at least 1, got {value!r}")


def _check_length(name: str, values: Sequence[object], count: int, like: str) -> None:
    if len(values) != count:
        raise ShapeError(f"{name}: expected {count} entries as in {like}, got {len(values)}")


def _vectors(name: str, value: Values | None) -> jax.Array:
    if value is None:
        return jnp.zeros((0, 3), jnp.float32)
    array = jnp.asarray(value, jnp.float32)
    if array.ndim not in (1, 2) or array.shape[-1] != 3:
        raise ShapeError(f"{name}: expected shape [3] or [n, 3], got {list(array.shape)}")
    return array.reshape(-1, 3)


def _filled(name: str, value: Values, shape: tuple[int, ...]) -> jax.Array:
    array = jnp.asarray(value, jnp.float32)
    if not _broadcasts(array.shape, shape):
        raise ShapeError(
            f"{name}: expected a shape that broadcasts to {list(shape)}, got {list(array.shape)}"
        )
    return jnp.broadcast_to(array, shape)


def _broadcasts(got: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    matching = zip(reversed(got), reversed(shape), strict=False)
    return len(got) <= len(shape) and all(a in (1, b) for a, b in matching)
