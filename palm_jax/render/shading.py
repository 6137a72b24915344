"""Colours: procedural textures, lights, sky. Elementwise on tuples of arrays, as in `intersect`.

Only additions, products, quotients, square roots, comparisons and integer mixing: each is correctly
rounded, so a pixel gets the same bits wherever it sits in a vector register. (Sines and powers are
not.)
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from palm_jax.render.intersect import Vector, dot, each


def normalised(p: Vector) -> Vector:
    """Unit vector; zero stays zero."""
    # Not 1 / sqrt: the compiler makes that an approximate instruction, and no vector of it.
    inverse = jnp.sqrt(1 / jnp.maximum(dot(p, p), 1e-20))
    return p[0] * inverse, p[1] * inverse, p[2] * inverse


def mix(p: Vector, q: Vector, weight: jax.Array) -> Vector:
    """p where weight is 0, q where it is 1."""
    return each(lambda i: p[i] + weight * (q[i] - p[i]))


# -- textures: local coordinates in units of the texture -> weight of the second colour ------------


def _hashed(x: jax.Array, y: jax.Array) -> jax.Array:
    """A number in [0, 1) that looks random, for whole numbers x, y."""
    n = x.astype(jnp.int32) * 374761393 + y.astype(jnp.int32) * 668265263
    n = (n ^ ((n >> 13) & 0x7FFFF)) * 1274126177
    return ((n ^ (n >> 16)) & 0xFFFF).astype(jnp.float32) * (1 / 65536)


def value_noise(x: jax.Array, y: jax.Array) -> jax.Array:
    """Smooth noise in [0, 1) with one blob per unit."""
    left, low = jnp.floor(x), jnp.floor(y)
    s, t = x - left, y - low
    s, t = s * s * (3 - 2 * s), t * t * (3 - 2 * t)
    a, b = _hashed(left, low), _hashed(left + 1, low)
    c, d = _hashed(left, low + 1), _hashed(left + 1, low + 1)
    below, above = a + s * (b - a), c + s * (d - c)
    return below + t * (above - below)


def checker(p: Vector) -> jax.Array:
    """Cubes of alternating colour."""
    count = jnp.floor(p[0]) + jnp.floor(p[1]) + jnp.floor(p[2] + 0.5)
    return count - 2 * jnp.floor(0.5 * count)


def wood(p: Vector) -> jax.Array:
    """Planks along x, one per unit of y, each with its own tone, grain and a dark joint."""
    across = p[1] + 0.61 * p[2]
    plank = jnp.floor(across)
    inside = across - plank
    tone = _hashed(plank, jnp.zeros_like(plank))
    # Grain: noise stretched along the plank, shifted so that neighbours differ.
    warp = value_noise(0.35 * p[0] + 17 * tone, 2.5 * across)
    fibre = value_noise(1.3 * p[0] + 31 * tone, 11 * across + 3 * warp)
    edge = jnp.minimum(inside, 1 - inside)
    joint = jnp.where(edge < 0.03, 0.45, 0.0)
    return jnp.clip(0.45 * tone + 0.35 * warp + 0.3 * fibre - 0.15 + joint, 0, 1)


def noise(p: Vector) -> jax.Array:
    """Blotches of two sizes."""
    x, y = p[0] + 0.73 * p[2], p[1] - 0.57 * p[2]
    coarse, fine = value_noise(x, y), value_noise(2.7 * x + 5.2, 2.7 * y + 1.3)
    return jnp.clip(1.6 * (0.65 * coarse + 0.35 * fine - 0.5) + 0.5, 0, 1)


PATTERNS = {"checker": checker, "wood": wood, "noise": noise}


def textured(kinds: Sequence[str], kind: jax.Array, p: Vector, footprint: jax.Array) -> jax.Array:
    """Weight of the second colour.

    Args:
      kinds: the textures that occur in the scene, "none" first.
      kind: index into `kinds` per pixel, as float32.
      p: local coordinates in texture units.
      footprint: how many texture units one pixel covers; far away, patterns fade into their mean.
    """
    weight = jnp.zeros_like(p[0])
    for index, name in enumerate(kinds):
        if name != "none":
            weight = jnp.where(kind == index, PATTERNS[name](p), weight)
    sharp = jnp.clip(1.5 - 2 * footprint, 0, 1)
    return jnp.where(kind > 0, 0.4 + sharp * (weight - 0.4), 0.0)


# -- light -----------------------------------------------------------------------------------------


class Light(NamedTuple):
    """One light as a pixel sees it."""

    towards: Vector  # unit
    diffuse: Vector
    specular: Vector
    shadowed: jax.Array | None  # bool; None where shadows are off


def highlight(cosine: jax.Array, shininess: jax.Array) -> jax.Array:
    """About cosine ** (128 * shininess), as the square of Schlick's quotient x / (n - n x + x)."""
    x = jnp.maximum(cosine, 0)
    n = jnp.maximum(64 * shininess, 0.5)
    quotient = x / (n - n * x + x)
    return quotient * quotient


def lit(
    albedo: Vector,
    specular: jax.Array,
    shininess: jax.Array,
    normal: Vector,
    to_eye: Vector,
    up: Vector,
    ambient: Vector,
    lights: Sequence[Light],
) -> Vector:
    """Blinn-Phong colour; all vectors unit, in one frame.

    Args:
      albedo: colour of the surface.
      specular, shininess: of the surface.
      normal, to_eye, up: directions.
      ambient: light from everywhere, 0.6 times as strong from below as from above.
      lights: those that shine.
    """
    sky = 0.8 + 0.2 * dot(normal, up)
    result = [albedo[i] * (ambient[i] * sky) for i in range(3)]
    n_eye = dot(normal, to_eye)
    for towards, diffuse, gloss, shadowed in lights:
        n_light, eye_light = dot(normal, towards), dot(to_eye, towards)
        facing = n_light > 0
        if shadowed is not None:
            facing = facing & ~shadowed
        # The half vector is eye + light; its length follows from their cosine.
        inverse = jnp.sqrt(1 / jnp.maximum(2 + 2 * eye_light, 1e-6))
        shine = specular * highlight((n_light + n_eye) * inverse, shininess)
        for i in range(3):
            gain = diffuse[i] * n_light * albedo[i] + gloss[i] * shine
            result[i] = result[i] + jnp.where(facing, gain, 0.0)
    return result[0], result[1], result[2]


def sky(horizon: Vector, zenith: Vector, up: Vector, ray: Vector) -> Vector:
    """Background along `ray` (any length): `horizon` there and below, towards `zenith` above."""
    rise = jnp.clip(dot(up, ray) * jnp.sqrt(1 / dot(ray, ray)), 0, 1)
    return mix(horizon, zenith, rise * (2 - rise))
