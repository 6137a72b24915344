"""Alignment: images a second of the operations in the hot paths, batches of 64 uint8 images."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import measure
from palm_jax import align

BATCH, SIDE, FRAME = 64, 84, 512


def run(*, repeats: int = 20) -> dict[str, Any]:
    """`images_per_second`: overlay and proprioception of a rendered window, as in rollouts."""
    rng, key = np.random.default_rng(0), jax.random.key(0)
    small = jnp.asarray(rng.integers(0, 256, (BATCH, SIDE, SIDE, 3), dtype=np.uint8))
    full = jnp.asarray(rng.integers(0, 256, (BATCH, FRAME, FRAME, 3), dtype=np.uint8))
    camera = align.Camera.from_fovy(40.0, FRAME, FRAME, jnp.eye(4))
    spec = align.AlignSpec(size=SIDE)
    view = spec.view_camera(camera)
    tcps = jnp.tile(jnp.eye(4), (BATCH, 1, 1)).at[:, 2, 3].set(1.2)
    tcps = tcps.at[:, :2, 3].set(rng.uniform(-0.2, 0.2, (BATCH, 2)))
    bank = jax.jit(align.procedural_bank, static_argnums=(1, 2))(key, 16, SIDE)

    def window(image: jax.Array, tcp: jax.Array) -> align.Aligned:
        origin, _ = align.window_origin(view, tcp, spec)
        return align.align_window(image, view, origin, tcp, 1.0, spec)

    def window_camera(tcp: jax.Array) -> align.Camera:
        origin, _ = align.window_origin(view, tcp, spec)
        return view.cropped(origin[::-1].astype(jnp.float32), SIDE, SIDE)

    def crop(image: jax.Array, tcp: jax.Array) -> jax.Array:
        uv, _ = align.project(camera, tcp[:3, 3])
        return align.tcp_crop(image, uv, 200, offset=(0, 40))

    floats = small.astype(jnp.float32) / 255
    operations = {
        "align_window": (jax.vmap(window), (small, tcps)),
        "align": (jax.vmap(lambda i, t: align.align(i, camera, t, 1.0, spec)), (full, tcps)),
        "tcp_crop": (jax.vmap(crop), (full, tcps)),
        "random_perspective": (lambda i: align.random_perspective(key, i), (floats,)),
        "random_turn": (
            lambda i, c, t: align.random_turn(key, i, c, t[:, :3, 3], probability=1.0)[0],
            (small, jax.vmap(window_camera)(tcps), tcps),
        ),
        "random_overlay": (lambda i: align.random_overlay(key, i, bank), (floats,)),
        "random_crop": (lambda i: align.random_crop(key, i, 76), (floats,)),
    }
    found = {
        name: _measure(jax.jit(function), arguments, repeats)
        for name, (function, arguments) in operations.items()
    }
    return {
        "images_per_second": found["align_window"]["per_second"],
        "operations": found,
        "batch": BATCH,
        "pixels": SIDE,
        "frame": FRAME,
    }


def _measure(function: Any, arguments: tuple[Any, ...], repeats: int) -> dict[str, float]:
    return measure(lambda: function(*arguments), repeats=repeats, items=BATCH)
