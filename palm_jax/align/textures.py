"""Backgrounds for Random Overlay, made in jit: no downloads, no files.

Six families differ in what matters for the augmentation: colours, spatial frequencies, straight and
curved edges, smooth and flat regions. A family maps uniform random numbers to one [S, S, 3] image
of floats around [0, 1]; all numbers of a bank come from one draw, because compiling a draw costs
more than compiling a texture.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from palm_jax._checks import OptionError
from palm_jax.align.camera import matmul

# Numbers per image: what the hungriest family (a collage under a light) uses.
NUMBERS = 2600
# Images made at once: more would only hold more intermediates.
CHUNK = 16


class Numbers:
    """Hands out parts of a vector of uniform random numbers; each number once."""

    def __init__(self, values: jax.Array) -> None:
        self._values = values
        self._used = 0

    def take(self, *shape: int) -> jax.Array:
        """The next numbers, in [0, 1)."""
        start, self._used = self._used, self._used + math.prod(shape)
        if self._used > self._values.shape[0]:
            raise OptionError(f"NUMBERS: expected at least {self._used}, got {NUMBERS}")
        return self._values[start : self._used].reshape(shape)


Texture = Callable[[Numbers, int], jax.Array]


def _grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """x [1, S] and y [S, 1] in -1..1."""
    line = ((np.arange(size) + 0.5) / size * 2 - 1).astype(np.float32)
    return line[None, :], line[:, None]


def _turned(numbers: Numbers, size: int) -> tuple[jax.Array, jax.Array]:
    """The grid, turned by a random angle about a random point; both [S, S]."""
    angle, center = 2 * math.pi * numbers.take(), 2 * numbers.take(2) - 1
    x, y = _grid(size)
    x, y = x - center[0], y - center[1]
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x + s * y, c * y - s * x


def _spread(cells: int, size: int) -> np.ndarray:
    """[S, cells] weights of a smooth interpolation of a lattice of numbers."""
    position = (np.arange(size) + 0.5) / size * (cells - 1)
    first = np.minimum(position.astype(int), cells - 2)
    part = position - first
    part = part * part * (3 - 2 * part)
    weights = np.zeros((size, cells), np.float32)
    weights[np.arange(size), first] = 1 - part
    weights[np.arange(size), first + 1] = part
    return weights


def _noise(numbers: Numbers, size: int, channels: int, finest: int) -> list[jax.Array]:
    """Planes [S, S] of noise in about -1..1: octaves of 3, 6, ... lattice points up to `finest`."""
    total = jnp.zeros((channels, size, size))
    cells, weight = 3, 0.7
    while cells <= finest:
        lattice = 2 * numbers.take(channels, cells, cells) - 1
        spread = _spread(cells, size)
        total += weight * matmul(matmul(spread, lattice), spread.T)
        cells, weight = cells * 2, weight * 0.6
    return list(total)


def _between(weight: jax.Array, colors: jax.Array) -> jax.Array:
    """Blend two colours [2, 3] by weights [S, S] in 0..1."""
    return colors[0] + weight[..., None] * (colors[1] - colors[0])


def _clouds(numbers: Numbers, size: int) -> jax.Array:
    base, gain = numbers.take(3), 0.2 + 0.7 * numbers.take()
    return base + gain * jnp.stack(_noise(numbers, size, 3, 24), -1)


def _cells(numbers: Numbers, size: int, sites: int = 14) -> jax.Array:
    """Voronoi cells, darker towards their borders."""
    points, colors = 2.2 * numbers.take(sites, 2) - 1.1, numbers.take(sites, 3)
    shade = 1.5 * numbers.take()
    x, y = _grid(size)
    far = (x[..., None] - points[:, 0]) ** 2 + (y[..., None] - points[:, 1]) ** 2
    return colors[jnp.argmin(far, -1)] * (1 - shade * jnp.sqrt(far.min(-1)))[..., None]


def _bands(numbers: Numbers, size: int) -> jax.Array:
    """Stripes or, with a second direction, checks; waved by noise."""
    x, y = _turned(numbers, size)
    frequency, second, sharpness, wave = numbers.take(4)
    bend = 0.4 * wave * _noise(numbers, size, 1, 6)[0]
    frequency = 4 + 16 * frequency
    value = jnp.sin(frequency * (x + bend))
    value = jnp.where(second < 0.5, value, value * jnp.sin(frequency * y))
    weight = jax.nn.sigmoid(value * (1 + 20 * sharpness))
    return _between(weight, numbers.take(2, 3))


def _gradient(numbers: Numbers, size: int) -> jax.Array:
    """Linear or radial blend of two colours."""
    x, y = _turned(numbers, size)
    weight = jnp.where(numbers.take() < 0.5, jnp.sqrt(x * x + y * y), 0.5 + 0.5 * x)
    return _between(jnp.clip(weight, 0, 1), numbers.take(2, 3))


def _shapes(numbers: Numbers, size: int, count: int = 10) -> jax.Array:
    """Discs and boxes laid over one another, like objects on a table."""

    def lay(image: jax.Array, values: jax.Array) -> tuple[jax.Array, None]:
        own = Numbers(values)
        x, y = _turned(own, size)
        length, ratio, kind = own.take(3)
        length, ratio = 0.1 + 0.5 * length, 0.3 + 0.7 * ratio
        disc = x * x + (y / ratio) ** 2 < length**2
        box = (jnp.abs(x) < length) & (jnp.abs(y) < length * ratio)
        color = own.take(3) + 0.2 * (x / length)[..., None]
        return jnp.where(jnp.where(kind < 0.5, disc, box)[..., None], color, image), None

    start = jnp.broadcast_to(numbers.take(3), (size, size, 3))
    return lax.scan(lay, start, numbers.take(count, 9))[0]


def _collage(numbers: Numbers, size: int) -> jax.Array:
    """Two textures, one showing through where a noise is high."""
    mask = jax.nn.sigmoid(25 * _noise(numbers, size, 1, 12)[0])[..., None]
    return mask * _bands(numbers, size) + (1 - mask) * _clouds(numbers, size)


FAMILIES: tuple[Texture, ...] = (_clouds, _cells, _bands, _gradient, _shapes, _collage)


def _lit(texture: Texture, size: int, values: jax.Array) -> jax.Array:
    """One texture, more or less colourful, under uneven light, as uint8."""
    numbers = Numbers(values)
    light = 0.8 + 0.4 * numbers.take() + 0.3 * _noise(numbers, size, 1, 3)[0]
    saturation = 0.2 + 0.8 * numbers.take()
    image = texture(numbers, size)
    gray = image.mean(-1, keepdims=True)
    image = (gray + saturation * (image - gray)) * light[..., None]
    return (jnp.clip(image, 0, 1) * 255 + 0.5).astype(jnp.uint8)


@partial(jax.jit, static_argnums=(1, 2))
def _bank(key: jax.Array, count: int, size: int) -> jax.Array:
    values = jax.random.uniform(key, (count, NUMBERS))
    parts = []
    for index, texture in enumerate(FAMILIES):
        own = values[index :: len(FAMILIES)]
        share, chunk = own.shape[0], min(CHUNK, own.shape[0])
        if share == 0:
            continue
        full = jnp.pad(own, ((0, -share % chunk), (0, 0))).reshape(-1, chunk, NUMBERS)
        images = lax.map(jax.vmap(partial(_lit, texture, size)), full)
        parts.append(images.reshape(-1, size, size, 3)[:share])
    return jnp.concatenate(parts)


def procedural_bank(key: jax.Array, count: int, size: int) -> jax.Array:
    """Backgrounds for `random_overlay` (the paper uses 512 photographs).

    Args:
      key: PRNG key; the same key gives the same bank.
      count: number of backgrounds, shared out over the families (noise, cells, bands, gradients,
        shapes, collages), one family after the other. A Python int.
      size: pixels per side, a Python int.

    Returns:
      [count, size, size, 3] uint8.

    Raises:
      OptionError: count or size below 1.
    """
    if count < 1 or size < 1:
        raise OptionError(f"count, size: expected at least 1, got {count} and {size}")
    return _bank(key, count, size)
