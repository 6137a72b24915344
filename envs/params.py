"""What can shift: `EnvParams`, its defaults' regions, and the check that they are possible.

Every field is a leaf, so a sweep is a `vmap` over params and a distribution shift is a pure
function `EnvParams -> EnvParams` (`palm_jax.envs.shifts`).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax._checks import ROTATION_TOLERANCE, is_concrete
from palm_jax.envs.tasks.base import TABLE_HEIGHT, WORKSPACE_CENTRE
from palm_jax.envs.world import DISTRACTORS

TEST_LOW, TEST_HIGH = np.array([0.05, -0.35]), np.array([0.45, 0.35])
"""Corners of the test region: x and y of the target object in metres."""

TABLE_LOW, TABLE_HIGH = np.array([-0.40, -0.75]), np.array([0.70, 0.75])
"""Corners of the table top: x and y in metres."""

MAX_DISTRACTORS = len(DISTRACTORS)

# Where no camera may be: a cylinder round the workspace centre that holds the test region, the hand
# at its highest start and the objects. A cylinder, because cameras are turned about its axis.
_WORKSPACE_RADIUS, _WORKSPACE_HEIGHT = 0.42, 0.35


class ParamsError(ValueError):
    """`EnvParams` that contradict themselves or describe no possible world."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class EnvParams:
    """What can shift. Every field is a leaf (arrays without a batch axis; `vmap` for more)."""

    # The camera that took the picture.
    camera_to_world: jax.Array  # [4, 4] nominal camera pose (OpenCV axes)
    camera_fovy: jax.Array  # [] degrees, of the 512-pixel frame
    camera_angle: jax.Array  # [2] range of the camera's turn about the workspace centre, radians
    camera_radius: jax.Array  # [2] range of the factor on its distance from the workspace centre
    # How far the camera that a policy believes in is off (zeros: perfectly calibrated).
    calibration_pixels: jax.Array  # [2] of the principal point, (u, v) pixels of the 512 frame
    calibration_rotation: jax.Array  # [3] rotation vector in camera axes, radians
    calibration_translation: jax.Array  # [3] in camera axes (right, down, forward), metres
    # The objects.
    object_low: jax.Array  # [2] lower xy corner of the target object's region, metres
    object_high: jax.Array  # [2] upper corner
    object_yaw: jax.Array  # [2] range of the object's yaw in the world, radians
    area_low: jax.Array  # [2] lower xy corner of where all other objects may stand, metres
    area_high: jax.Array  # [2] upper corner
    distractors: jax.Array  # [] objects on the table that no task is about, 0..MAX_DISTRACTORS
    # The hand's start.
    start_radius: jax.Array  # [] the hand starts this near the located target, per axis, metres
    start_height: jax.Array  # [S, 2] each stage's range of the TCP's height above the table, metres
    start_yaw: jax.Array  # [2] range of the hand's yaw, radians
    align_hand: jax.Array  # [] 1: the hand's initial yaw turns with the camera, 0: it does not
    # Looks.
    light_ambient: jax.Array  # [3]
    light_diffuse: jax.Array  # [L, 3]
    light_direction: jax.Array  # [L, 3] direction the light travels in
    geom_rgb: jax.Array  # [R, 3] colours of the rendered geoms, 0..1 (the table top has its own)
    object_hue: jax.Array  # [] by which the colours of the task's objects are turned, radians
    table_rgb: jax.Array  # [3] first colour of the table top's planks, 0..1
    table_rgb2: jax.Array  # [3] second colour
    table_scale: jax.Array  # [] width of a plank, metres
    robot_visible: jax.Array  # [] 1: drawn, 0: hidden in rendering (physics unchanged)


def repeat_params(params: EnvParams, count: int) -> EnvParams:
    """`params` of one world with a leading axis [count]."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), params)


def take_params(params: EnvParams, rows: np.ndarray) -> EnvParams:
    """The worlds `rows` [n] of params with a leading axis."""
    return jax.tree.map(lambda leaf: leaf[rows], params)


# -- the check -------------------------------------------------------------------------------------

_SHAPES: dict[str, tuple[int | str, ...]] = {
    "camera_to_world": (4, 4),
    "camera_fovy": (),
    "camera_angle": (2,),
    "camera_radius": (2,),
    "calibration_pixels": (2,),
    "calibration_rotation": (3,),
    "calibration_translation": (3,),
    "object_low": (2,),
    "object_high": (2,),
    "object_yaw": (2,),
    "area_low": (2,),
    "area_high": (2,),
    "distractors": (),
    "start_radius": (),
    "start_height": ("S", 2),
    "start_yaw": (2,),
    "align_hand": (),
    "light_ambient": (3,),
    "light_diffuse": ("L", 3),
    "light_direction": ("L", 3),
    "geom_rgb": ("R", 3),
    "object_hue": (),
    "table_rgb": (3,),
    "table_rgb2": (3,),
    "table_scale": (),
    "robot_visible": (),
}
"""Shape of each field of one world; a letter stands for any length."""


def check_params(params: EnvParams) -> None:
    """Raises where `params` contradict themselves; on the host, a millisecond or two a batch.

    Args:
      params: of one world, or with leading axes that all fields share. Traced params pass: inside
        `jax.jit` nobody can look.

    Raises:
      ParamsError: names the field (and the world), what was expected, what came, what to do.
    """
    if not is_concrete(params):
        return
    host = jax.device_get(params)
    values = {name: np.asarray(getattr(host, name)) for name in _SHAPES}
    lead = values["camera_fovy"].shape
    for name, shape in _SHAPES.items():
        _check_shape(name, values[name].shape, lead, shape)
    check = _Check(values, lead)
    for name, value in values.items():
        check(name, np.isfinite(value), "finite numbers", "look for a division by zero before it")
    _check_camera(check)
    _check_regions(check)
    _check_ranges(check)
    _check_looks(check)


class _Check:
    """Fields by name, and what to say about one that is wrong."""

    def __init__(self, values: dict[str, np.ndarray], lead: tuple[int, ...]) -> None:
        self.values = values
        self._lead = lead

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]

    def __call__(self, name: str, ok: np.ndarray, expected: str, advice: str) -> None:
        """Raises ParamsError for the first world in which not all of `ok` [lead..., ...] is true.

        `expected` and `advice` may name other fields in braces: their values are filled in.
        """
        if ok.all():
            return
        bad = ~ok.reshape(*self._lead, -1).all(-1)
        world = tuple(int(i) for i in np.argwhere(bad)[0]) if self._lead else ()
        here = {other: _shown(value[world]) for other, value in self.values.items()}
        where = f" (world {', '.join(map(str, world))})" if world else ""
        raise ParamsError(
            f"EnvParams.{name}{where}: expected {expected.format(**here)}, got {here[name]}; "
            f"{advice.format(**here)}"
        )


def _shown(value: np.ndarray) -> str:
    return str(np.round(value.astype(np.float64), 4).tolist())


def _check_shape(
    name: str, got: tuple[int, ...], lead: tuple[int, ...], shape: tuple[int | str, ...]
) -> None:
    expected = (*lead, *shape)
    if len(got) != len(expected) or any(
        isinstance(size, int) and size != found for size, found in zip(expected, got, strict=True)
    ):
        sizes = ", ".join(map(str, expected))
        raise ParamsError(
            f"EnvParams.{name}: expected shape [{sizes}], got {list(got)}; leading axes are those "
            "of all fields (see repeat_params), change single values with dataclasses.replace"
        )


def _check_camera(check: _Check) -> None:
    pose = check["camera_to_world"].astype(np.float64)
    rotation, position = pose[..., :3, :3], pose[..., :3, 3]
    check(
        "camera_to_world",
        np.abs(pose[..., 3, :] - (0.0, 0.0, 0.0, 1.0)) <= ROTATION_TOLERANCE,
        "the last row (0, 0, 0, 1)",
        "the translation is the last column",
    )
    gram = np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)
    orthonormal = (np.abs(gram) <= ROTATION_TOLERANCE).all((-1, -2))
    check(
        "camera_to_world",
        orthonormal & (np.linalg.det(rotation) > 0),
        "an orthonormal, right-handed rotation in its first three columns",
        "columns are the camera's axes in the world: x right, y down, z forward",
    )
    check(
        "camera_fovy",
        (check["camera_fovy"] >= 1) & (check["camera_fovy"] <= 170),
        "1 to 170 degrees",
        "convert radians, the paper's camera has 40",
    )
    check(
        "camera_radius",
        check["camera_radius"] > 0,
        "positive factors",
        "(1, 1) keeps the nominal distance",
    )
    _ordered(check, "camera_radius")
    off = position - np.asarray(WORKSPACE_CENTRE)
    for radius in np.moveaxis(check["camera_radius"], -1, 0):
        x, y, height = np.moveaxis(radius[..., None] * off, -1, 0)
        inside = (np.hypot(x, y) < _WORKSPACE_RADIUS) & (height < _WORKSPACE_HEIGHT)
        check(
            "camera_to_world",
            height > 0,
            f"a camera above the table (z = {TABLE_HEIGHT} m)",
            "the position is the last column, metres in the world",
        )
        check(
            "camera_to_world",
            ~inside,
            f"a camera outside the workspace (within {_WORKSPACE_RADIUS} m of "
            f"{WORKSPACE_CENTRE[:2]} and less than {_WORKSPACE_HEIGHT} m above the table) at "
            "camera_radius {camera_radius}",
            "move it away, or raise camera_radius",
        )
    check(
        "calibration_rotation",
        np.linalg.norm(check["calibration_rotation"], axis=-1) <= np.pi / 2,
        "a rotation vector of at most pi / 2 radians",
        "convert degrees",
    )


def _check_regions(check: _Check) -> None:
    for region in ("object", "area"):
        low, high = f"{region}_low", f"{region}_high"
        check(
            low,
            check[low] <= check[high],
            f"at most {high} = {{{high}}} in x and in y",
            "swap the corners: low is the nearer to the robot and to -y",
        )
        for name in (low, high):
            check(
                name,
                (check[name] >= TABLE_LOW) & (check[name] <= TABLE_HIGH),
                f"a place on the table, x {TABLE_LOW[0]} to {TABLE_HIGH[0]} and y {TABLE_LOW[1]} "
                f"to {TABLE_HIGH[1]} m",
                "coordinates are metres in the world, the robot stands at x < 0",
            )
    count = check["distractors"]
    check(
        "distractors",
        (count >= 0) & (count <= MAX_DISTRACTORS) & (count == np.round(count)),
        f"a whole number from 0 to {MAX_DISTRACTORS}",
        "round it; more bodies would have to be added to assets/table.xml",
    )


def _ordered(check: _Check, name: str) -> None:
    low, high = check[name][..., 0], check[name][..., 1]
    check(name, low <= high, "(low, high) with low at most high", "swap the two")


def _check_ranges(check: _Check) -> None:
    for name in ("camera_angle", "object_yaw", "start_yaw"):
        _ordered(check, name)
        turn = np.abs(check[name]) <= 2 * np.pi
        check(name, turn, "radians, at most a whole turn", "convert degrees")
    _ordered(check, "start_height")
    check(
        "start_height",
        check["start_height"] >= 0,
        "heights above the table of at least 0 m",
        "they count from the table top, not from the floor",
    )
    check("start_radius", check["start_radius"] >= 0, "at least 0 m", "0 starts at the target")
    for name in ("align_hand", "robot_visible"):
        switch = (check[name] >= 0) & (check[name] <= 1)
        check(name, switch, "0 (no) to 1 (yes)", "it is a switch")


def _check_looks(check: _Check) -> None:
    for name in ("light_ambient", "light_diffuse"):
        check(name, check[name] >= 0, "intensities of at least 0", "0 is a light that is off")
    check(
        "light_direction",
        np.linalg.norm(check["light_direction"], axis=-1) > 1e-6,
        "directions of any length above 0",
        "switch a light off by light_diffuse",
    )
    for name in ("geom_rgb", "table_rgb", "table_rgb2"):
        unit = (check[name] >= 0) & (check[name] <= 1)
        check(name, unit, "colours from 0 to 1", "divide by 255, or clip")
    check("table_scale", check["table_scale"] > 0, "a width above 0 m", "planks have 0.09 m")
