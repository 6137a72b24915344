"""Alignment and augmentation: images a second, beside OpenCV, torchvision and kornia.

Two kinds of rows. `operations` do the same to the same images in every package (`difference`: the
mean distance of their pictures from ours, as a share of the whole range). `ours` are the operations
of the hot paths that draw their randomness themselves, and the batch of windows that a renderer has
already cut.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import headline, measure, side_by_side
from benchmarks.peers import align as others
from palm_jax import align

BATCHES = (64, 512)
SIDE, FRAME = 84, 512
SPEC = align.AlignSpec(size=SIDE)
FRAMES, SMALL = 8, 64
"""Images of 512 and of 84 pixels that are worked on together."""


def run(*, repeats: int = 20) -> dict[str, Any]:
    """`images_per_second` of the whole `align` of 512-pixel frames in batches of 64."""
    tables = {str(batch): _same_work(batch, repeats) for batch in BATCHES}
    return {
        **headline(tables[str(BATCHES[0])]["align"], "images_per_second"),
        "operations": tables,
        "ours": _ours(repeats),
        "pixels": SIDE,
        "frame": FRAME,
    }


# -- the same work in every package ----------------------------------------------------------------


def _camera() -> align.Camera:
    return align.Camera.from_fovy(40.0, FRAME, FRAME, jnp.eye(4))


def _tcps(batch: int) -> jax.Array:
    """TCP poses [B, 4, 4] in front of a camera at the world's origin, windows inside its image."""
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.normal(size=(batch, 3, 3)))[0]
    poses = np.tile(np.eye(4), (batch, 1, 1))
    poses[:, :3, :3] = turns * np.linalg.det(turns)[:, None, None]
    poses[:, :2, 3], poses[:, 2, 3] = rng.uniform(-0.15, 0.15, (batch, 2)), 1.2
    return jnp.asarray(poses, jnp.float32)


def inputs(batch: int) -> others.Inputs:
    """Images of noise smoothed to the scale of an object's features, and where the TCP is."""
    rng, camera, tcps = np.random.default_rng(1), _camera(), _tcps(batch)
    coarse = rng.integers(0, 256, (batch, FRAME // 16, FRAME // 16, 3), dtype=np.uint8)
    enlarge = jax.jit(jax.vmap(lambda image: align.resize(image, FRAME)))
    shrink = jax.jit(jax.vmap(lambda image: align.resize(image, SIDE)))
    frames = np.concatenate([np.asarray(enlarge(part)) for part in np.array_split(coarse, 8)])
    small = np.asarray(shrink(jnp.asarray(coarse[:, ::2, ::2]))) / np.float32(255)
    steps = SPEC.axis_length * np.asarray(tcps)[:, :3, :3].transpose(0, 2, 1)
    tips = np.asarray(tcps)[:, None, :3, 3] + np.concatenate([np.zeros((batch, 1, 3)), steps], 1)
    points, _ = jax.vmap(jax.vmap(lambda point: align.project(camera, point)))(jnp.asarray(tips))
    crop = SPEC.crop or FRAME
    corner = np.floor(np.asarray(points[:, 0]) + np.array(SPEC.offset) - crop // 2).astype(int)
    inwards = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], np.float32)
    return others.Inputs(
        frames=frames,
        small=small,
        backgrounds=small[::-1].copy(),
        corners=others.outer_corners(SIDE)
        + inwards * rng.integers(0, 9, (batch, 4, 2)).astype(np.float32),
        points=np.asarray(points),
        rotation=np.asarray(tcps)[:, :3, :3],
        height=np.asarray(tcps)[:, 2, 3],
        origin=np.clip(corner[:, ::-1], 0, FRAME - crop),
        crop=crop,
        size=SIDE,
    )


def _operations(data: others.Inputs) -> dict[str, Callable[[], Any]]:
    """Ours, on the same inputs."""
    camera, tcps = _camera(), _tcps(len(data.frames))
    frames, small, backgrounds = map(jnp.asarray, (data.frames, data.small, data.backgrounds))
    corners, points = jnp.asarray(data.corners), jnp.asarray(data.points)
    crop = _in_blocks(lambda i, uv: align.tcp_crop(i, uv, data.crop, offset=SPEC.offset), FRAMES)
    whole = _in_blocks(lambda i, t: tuple(align.align(i, camera, t, 1.0, SPEC)), FRAMES)
    warp = _in_blocks(align.perspective_warp, SMALL)
    blend = _in_blocks(lambda i, b: align.overlay_blend(i, b, 0.5), SMALL)
    return {
        "tcp_crop": lambda: crop(frames, points[:, 0]),
        "align": lambda: whole(frames, tcps),
        "perspective": lambda: warp(small, corners),
        "overlay": lambda: blend(small, backgrounds),
    }


def _in_blocks(function: Callable[..., Any], size: int) -> Callable[..., Any]:
    """`function` of a batch, so many images at a time: what is in between stays in the caches."""
    return jax.jit(
        lambda *arrays: jax.lax.map(lambda each: function(*each), arrays, batch_size=size)
    )


def _same_work(batch: int, repeats: int) -> dict[str, Any]:
    data = inputs(batch)
    calls = {"palm_jax": _operations(data), **others.peers(data)}
    found: dict[str, Any] = {}
    for name in calls["palm_jax"]:
        able = {package: table[name] for package, table in calls.items() if name in table}
        found[name] = side_by_side(able, repeats=repeats, items=batch)
        pictures = {package: _pictures(call()) for package, call in able.items()}
        for package, picture in pictures.items():
            found[name][package]["difference"] = _difference(picture, pictures["palm_jax"])
    return found


def _pictures(result: Any) -> np.ndarray:
    """[B, H, W, 3] of what an operation returns."""
    images = np.asarray(result[0] if isinstance(result, tuple) else result)
    return images.transpose(0, 2, 3, 1) if images.shape[1] == 3 else images


def _difference(one: np.ndarray, other: np.ndarray) -> float:
    """Mean distance of two batches of pictures, as a share of the whole range."""
    whole = 255.0 if one.dtype == np.uint8 else 1.0
    return float(np.abs(one.astype(np.float32) - other.astype(np.float32)).mean() / whole)


# -- ours alone ------------------------------------------------------------------------------------


def _ours(repeats: int) -> dict[str, Any]:
    batch = BATCHES[0]
    rng, key = np.random.default_rng(0), jax.random.key(0)
    small = jnp.asarray(rng.integers(0, 256, (batch, SIDE, SIDE, 3), dtype=np.uint8))
    view, tcps = SPEC.view_camera(_camera()), _tcps(batch)
    bank = jax.jit(align.procedural_bank, static_argnums=(1, 2))(key, 16, SIDE)

    def window(image: jax.Array, tcp: jax.Array) -> align.Aligned:
        origin, _ = align.window_origin(view, tcp, SPEC)
        return align.align_window(image, view, origin, tcp, 1.0, SPEC)

    def window_camera(tcp: jax.Array) -> align.Camera:
        origin, _ = align.window_origin(view, tcp, SPEC)
        return view.cropped(origin[::-1].astype(jnp.float32), SIDE, SIDE)

    def augment(images: jax.Array) -> jax.Array:
        first, second = jax.random.split(key)
        return align.random_overlay(second, align.random_perspective(first, images), bank)

    floats = small.astype(jnp.float32) / 255
    operations = {
        "align_window": (jax.vmap(window), (small, tcps)),
        "random_perspective": (lambda i: align.random_perspective(key, i), (floats,)),
        "random_turn": (
            lambda i, c, t: align.random_turn(key, i, c, t[:, :3, 3], probability=1.0)[0],
            (small, jax.vmap(window_camera)(tcps), tcps),
        ),
        "random_overlay": (lambda i: align.random_overlay(key, i, bank), (floats,)),
        "random_perspective_and_overlay": (augment, (floats,)),
        "random_crop": (lambda i: align.random_crop(key, i, 76), (floats,)),
    }
    return {
        name: _measure(jax.jit(function), arguments, repeats)
        for name, (function, arguments) in operations.items()
    }


def _measure(function: Any, arguments: tuple[Any, ...], repeats: int) -> dict[str, float]:
    return measure(lambda: function(*arguments), repeats=repeats, items=BATCHES[0])
