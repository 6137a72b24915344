"""Isolation: only what a mask shows, on a black grid (ARRO's inputs).

Pixels outside the mask become black with thin grey lines, the same at every frame, so that nothing
of a scene but the gripper and the objects can be learnt from, or be missed.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from palm_jax._checks import OptionError, ShapeError, as_image

GRID = 32.0
"""Pixels of a camera's image between two lines of the grid."""

_LINE = 96 / 255  # grey of the lines


def isolate(image: ArrayLike, mask: ArrayLike, *, pitch: float = GRID) -> jax.Array:
    """Keep the masked pixels, put a black grid behind them (the input of ARRO).

    Args:
      image: [H, W, 3] uint8 or float32 in [0, 1].
      mask: bool [H, W], True where the image is kept.
      pitch: pixels from one line, a pixel wide, to the next.

    Returns:
      [H, W, 3], dtype of the image.

    Raises:
      ShapeError, DtypeError: image not [H, W, 3] of uint8 or float; mask not its [H, W].
      OptionError: a pitch of less than 2 pixels.
    """
    image = as_image(image, "image", rgb=True)
    mask = jnp.asarray(mask, bool)
    if mask.shape != image.shape[:2]:
        raise ShapeError(
            f"mask: expected the image's {list(image.shape[:2])}, got {list(mask.shape)}"
        )
    if not pitch >= 2:
        raise OptionError(f"pitch: expected at least 2 pixels, got {pitch}")
    rows, columns = (_on_line(jnp.arange(size), pitch) for size in mask.shape)
    line = rows[:, None] | columns[None, :]
    grey = 255 * _LINE if image.dtype == jnp.uint8 else _LINE
    grid = jnp.where(line, jnp.asarray(grey, image.dtype), jnp.zeros((), image.dtype))
    return jnp.where(mask[..., None], image, grid[..., None])


def _on_line(index: jax.Array, pitch: float) -> jax.Array:
    """bool, like `index`: the pixel in which a multiple of the pitch begins."""
    return jnp.floor(index / pitch) != jnp.floor((index - 1) / pitch)
