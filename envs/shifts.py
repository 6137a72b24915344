"""Distribution shifts: pure functions `EnvParams -> EnvParams`, and the domains made of them.

Three kinds. `SHIFTS` widen what an episode is drawn from: workspace and viewpoint, at a strength
from 0 (none) to 1 (the paper's). `AXES` set one thing to a value, at a strength from -1 to 1: a
curve over an axis is a `vmap` over strengths, and `scenes` draws a strength for every scene. The
embodiment is no parameter but another environment, the same task with another robot; domains name
it like the rest (`other_robot`).

Sweeps that want one fixed value set equal bounds instead (`at_camera_angle`, `at_object`).
"""

import dataclasses
import zlib
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax._checks import Vector, is_concrete
from palm_jax.envs.params import MAX_DISTRACTORS, EnvParams, repeat_params
from palm_jax.envs.params import TEST_HIGH as TEST_HIGH
from palm_jax.envs.params import TEST_LOW as TEST_LOW

Shift = Callable[..., EnvParams]
Strength = float | jax.Array  # an array of shape []

MAX_CAMERA_ANGLE = float(np.radians(30.0))
"""Largest turn of the camera about the workspace's vertical, as in the paper."""

RADIUS_RANGE = (0.8, 1.2)
"""Factors on the camera's distance from the workspace centre in the viewpoint cone."""

_LIGHT_GAIN, _LIGHT_TURN = 0.5, np.radians(60.0)
_TABLES = {  # first and second colour at strength -1 (dark stone) and +1 (bleached wood)
    -1: ((0.24, 0.29, 0.36), (0.12, 0.15, 0.20)),
    1: ((0.88, 0.86, 0.80), (0.66, 0.66, 0.66)),
}
_HUE = np.radians(120.0)
_ZOOM = 0.2
_PIXELS = 20.0 / np.sqrt(2) * np.ones(2)
_ROTATION = np.radians(3.0) / np.sqrt(3) * np.ones(3)
_TRANSLATION = 0.03 / np.sqrt(3) * np.ones(3)


def _towards(start: jax.Array, end: Vector, strength: Strength) -> jax.Array:
    """`start` at strength 0, bit for bit; `end` at strength 1."""
    return start + strength * (jnp.asarray(end, jnp.float32) - start)


# -- what widens -----------------------------------------------------------------------------------


def workspace(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The target, and all other objects, anywhere in the test region: seven times the training
    region's area."""
    strength = _checked(workspace, strength)
    return dataclasses.replace(
        params,
        object_low=_towards(params.object_low, TEST_LOW, strength),
        object_high=_towards(params.object_high, TEST_HIGH, strength),
        area_low=_towards(params.area_low, TEST_LOW, strength),
        area_high=_towards(params.area_high, TEST_HIGH, strength),
    )


def viewpoint(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The camera turned by up to 30 degrees either way about the workspace centre."""
    strength = _checked(viewpoint, strength)
    bounds = (-MAX_CAMERA_ANGLE, MAX_CAMERA_ANGLE)
    return dataclasses.replace(params, camera_angle=_towards(params.camera_angle, bounds, strength))


def viewpoint_cone(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """`viewpoint`, and the camera 0.8 to 1.2 times as far from the workspace centre."""
    strength = _checked(viewpoint_cone, strength)
    radius = _towards(params.camera_radius, RADIUS_RANGE, strength)
    return dataclasses.replace(viewpoint(params, strength=strength), camera_radius=radius)


# -- axes ------------------------------------------------------------------------------------------


def lighting(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """Lights and ambient light half (-1) to one and a half times (1) as bright, and the lights
    turned by up to 60 degrees about the vertical: what is dim comes from one side, what is bright
    from the other."""
    strength = _checked(lighting, strength)
    gain, angle = 1.0 + _LIGHT_GAIN * strength, _LIGHT_TURN * strength
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y, z = jnp.moveaxis(params.light_direction, -1, 0)
    return dataclasses.replace(
        params,
        light_ambient=gain * params.light_ambient,
        light_diffuse=gain * params.light_diffuse,
        light_direction=jnp.stack([cos * x - sin * y, sin * x + cos * y, z], -1),
    )


def table_texture(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The table top from dark blue-grey with planks half as wide (-1) to nearly white with planks
    twice as wide (1)."""
    strength = _checked(table_texture, strength)
    first, second = jnp.where(strength < 0, np.array(_TABLES[-1]), np.array(_TABLES[1]))
    return dataclasses.replace(
        params,
        table_rgb=_towards(params.table_rgb, first, jnp.abs(strength)),
        table_rgb2=_towards(params.table_rgb2, second, jnp.abs(strength)),
        table_scale=params.table_scale * jnp.exp2(strength),
    )


def object_color(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """Hues of the task's objects turned by up to 120 degrees either way; brightness stays."""
    strength = _checked(object_color, strength)
    return dataclasses.replace(params, object_hue=params.object_hue + _HUE * strength)


def field_of_view(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The camera's field of view 20 % narrower (-1: all is larger) to 20 % wider (1)."""
    strength = _checked(field_of_view, strength)
    return dataclasses.replace(params, camera_fovy=params.camera_fovy * (1.0 + _ZOOM * strength))


def distractors(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """Up to `MAX_DISTRACTORS` objects on the table that the task is not about; strength from 0."""
    strength = _checked(distractors, strength)
    count = jnp.round(_towards(params.distractors, MAX_DISTRACTORS, strength))
    return dataclasses.replace(params, distractors=count)


def calibration_pixels(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The policy's camera off by up to 20 pixels of the 512 frame, right and down in equal parts
    (negative: left and up)."""
    strength = _checked(calibration_pixels, strength)
    off = params.calibration_pixels + strength * jnp.asarray(_PIXELS, jnp.float32)
    return dataclasses.replace(params, calibration_pixels=off)


def calibration_rotation(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The policy's camera off by up to 3 degrees: tilt, pan and roll in equal parts."""
    strength = _checked(calibration_rotation, strength)
    off = params.calibration_rotation + strength * jnp.asarray(_ROTATION, jnp.float32)
    return dataclasses.replace(params, calibration_rotation=off)


def calibration_translation(params: EnvParams, *, strength: Strength = 1.0) -> EnvParams:
    """The policy's camera off by up to 3 cm: right, down and forward in equal parts."""
    strength = _checked(calibration_translation, strength)
    off = params.calibration_translation + strength * jnp.asarray(_TRANSLATION, jnp.float32)
    return dataclasses.replace(params, calibration_translation=off)


# -- one fixed value -------------------------------------------------------------------------------


def aligned_hand(params: EnvParams) -> EnvParams:
    """The hand's initial yaw turns with the camera, as the authors' code does for PALM policies."""
    return dataclasses.replace(params, align_hand=jnp.ones_like(params.align_hand))


def at_camera_angle(params: EnvParams, angle: jax.Array) -> EnvParams:
    """The camera turned by exactly `angle` [] radians."""
    return dataclasses.replace(params, camera_angle=jnp.stack([angle, angle]))


def at_object(params: EnvParams, xy: jax.Array) -> EnvParams:
    """The target at exactly `xy` [2] metres."""
    return dataclasses.replace(params, object_low=xy, object_high=xy)


# -- by name ---------------------------------------------------------------------------------------

SHIFTS: dict[str, Shift] = {
    shift.__name__: shift for shift in (workspace, viewpoint, viewpoint_cone)
}
"""Every shift that widens, by name; strengths from 0 to 1."""

AXES: dict[str, Shift] = {
    axis.__name__: axis
    for axis in (
        lighting,
        table_texture,
        object_color,
        field_of_view,
        distractors,
        calibration_pixels,
        calibration_rotation,
        calibration_translation,
    )
}
"""Every axis by name; strengths from -1 to 1, of `distractors` from 0."""

EMBODIMENT = "embodiment"
"""The shift to another robot: another environment, not other params."""

IN_DOMAIN = "in_domain"

DOMAINS: tuple[str, ...] = (
    IN_DOMAIN,
    "workspace",
    "viewpoint",
    EMBODIMENT,
    "workspace+viewpoint",
    "workspace+embodiment",
    "viewpoint+embodiment",
    "workspace+viewpoint+embodiment",
)
"""The evaluation domains of the paper: in-domain, each shift, and their products."""


def strength_range(name: str) -> tuple[float, float]:
    """Strengths (low, high) that the shift or axis `name` takes."""
    return (0.0 if name in SHIFTS or name == distractors.__name__ else -1.0), 1.0


def _checked(shift: Shift, strength: Strength) -> Strength:
    """`strength`, if it may be one of `shift`'s; traced strengths pass."""
    if is_concrete(strength):
        low, high = strength_range(shift.__name__)
        value = np.asarray(strength)
        if value.shape != () or not low <= value <= high:
            raise ValueError(
                f"{shift.__name__}: expected a strength from {low:g} to {high:g}, got "
                f"{value.tolist()}; several strengths at once are a jax.vmap"
            )
    return strength


def parts(domain: str) -> tuple[str, ...]:
    """Names of the shifts that a domain is made of; () for `in_domain`.

    Raises:
      ValueError: an unknown name (the message lists the known ones), one named twice, or
        `in_domain` together with others.
    """
    if domain == IN_DOMAIN:
        return ()
    names = tuple(domain.split("+"))
    known = (*SHIFTS, EMBODIMENT, *AXES)
    for name in names:
        if name == IN_DOMAIN:
            raise ValueError(f"domain {domain!r}: {IN_DOMAIN} is no shift and stands alone")
        if name not in known:
            listed = ", ".join((IN_DOMAIN, *known))
            raise ValueError(f"unknown shift {name!r} in domain {domain!r}; known: {listed}")
        if names.count(name) > 1:
            raise ValueError(f"domain {domain!r} names {name!r} twice; name every shift once")
    return names


def other_robot(domain: str) -> bool:
    """Whether a domain is evaluated on another robot than the demonstrations'."""
    return EMBODIMENT in parts(domain)


def shifted(params: EnvParams, domain: str, *, strength: Strength = 1.0) -> EnvParams:
    """`params` under a domain: `in_domain`, or names of `SHIFTS` and `AXES` joined by `+`.

    `embodiment` may be among the names and changes nothing here, see `other_robot`.

    Args:
      params: of one world.
      domain: its name.
      strength: of every part, see `strength_range`.

    Raises:
      ValueError: see `parts`; a concrete strength that a part does not take.
    """
    for name in parts(domain):
        if name != EMBODIMENT:
            params = (SHIFTS | AXES)[name](params, strength=strength)
    return params


def scenes(
    key: jax.Array, params: EnvParams, domain: str, count: int, *, strength: float = 1.0
) -> EnvParams:
    """Params of `count` scenes of a domain: every scene has its own place on the domain's axes.

    Args:
      key: of the strengths. Each axis draws for itself: other parts of the domain do not matter.
      params: of one world.
      domain: see `shifted`.
      count: scenes.
      strength: 0 to 1. `SHIFTS` have it; the strengths of `AXES` are drawn uniformly from their
        range times it.

    Returns:
      `EnvParams` with the leading axis [count].

    Raises:
      ValueError: see `parts`; a strength or a count outside its range.
    """
    if count < 1:
        raise ValueError(f"scenes: expected a count of at least 1, got {count}")
    if not 0.0 <= strength <= 1.0:
        raise ValueError(f"scenes: expected a strength from 0 to 1, got {strength}")
    names = parts(domain)
    for name in names:
        if name in SHIFTS:
            params = SHIFTS[name](params, strength=strength)
    batch = repeat_params(params, count)
    for name in names:
        if name in AXES:
            low, high = strength_range(name)
            name_key = jax.random.fold_in(key, zlib.crc32(name.encode()))
            drawn = strength * jax.random.uniform(name_key, (count,), minval=low, maxval=high)
            axis = AXES[name]
            batch = jax.vmap(lambda p, s, axis=axis: axis(p, strength=s))(batch, drawn)
    return batch
