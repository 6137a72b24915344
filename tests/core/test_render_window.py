"""A pixel depends on its ray alone: windows, strides, batches, other programs, bit for bit."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from render_worlds import camera_at, random_model, scene_of

from palm_jax.align import tcp_crop
from palm_jax.render import Window, make_lights, render

OUTPUTS = ("rgb", "depth", "segmentation")
HEIGHT, WIDTH = 61, 75
CAMERA = camera_at([2.1, 1.7, 1.6], [0.0, 0.0, 0.5], HEIGHT, WIDTH)


@functools.cache
def scene():
    model, data = random_model(3, per_type=3)
    rng = np.random.default_rng(0)
    kinds = ("none", "checker", "wood", "noise")
    return scene_of(
        model,
        data,
        rgb=rng.uniform(0.2, 1.0, (model.ngeom, 3)),
        textures=[kinds[i % 4] for i in range(model.ngeom)],
        lights=make_lights(dir=[0.4, 0.2, -1], pos=[0.5, -1, 2], diffuse=0.4, specular=0.3),
    )


@functools.cache
def windowed(height, width, stride=1):
    """Compiled: the origin is an argument."""
    return jax.jit(
        lambda s, c, origin: render(s, c, Window(origin, height, width, stride), outputs=OUTPUTS)
    )


@functools.cache
def full():
    """The whole frame, by an eager call."""
    return jax.tree.map(np.asarray, render(scene(), CAMERA, outputs=OUTPUTS))


def assert_same_bits(frame, other):
    for name in OUTPUTS:
        left, right = np.asarray(getattr(frame, name)), np.asarray(getattr(other, name))
        assert left.shape == right.shape and left.dtype == right.dtype, name
        np.testing.assert_array_equal(left.view(np.uint8), right.view(np.uint8), err_msg=name)


def cut(frame, row, column, height, width, stride=1):
    rows, columns = row + stride * np.arange(height), column + stride * np.arange(width)
    return jax.tree.map(lambda x: np.ascontiguousarray(x[np.ix_(rows, columns)]), frame)


def test_the_full_frame_is_worth_comparing():
    frame = full()
    assert len(np.unique(frame.segmentation)) > 10
    assert len(np.unique(frame.rgb.reshape(-1, 3), axis=0)) > 500


@pytest.mark.parametrize("size", [(24, 36, 1), (13, 5, 3)])
@given(data=st.data())
def test_window_is_that_part_of_the_frame(size, data):
    height, width, stride = size
    row = data.draw(st.integers(0, HEIGHT - 1 - (height - 1) * stride))
    column = data.draw(st.integers(0, WIDTH - 1 - (width - 1) * stride))
    frame = windowed(*size)(scene(), CAMERA, jnp.array([row, column]))
    assert_same_bits(frame, cut(full(), row, column, *size))


def test_window_is_the_tcp_crop_of_the_frame():
    uv = jnp.array([41.3, 29.8])
    crop = tcp_crop(full().rgb, uv, 24)
    inside = [
        (row, column)
        for row, column in itertools.product(range(15, 22), range(26, 33))
        if np.array_equal(full().rgb[row : row + 24, column : column + 24], crop)
    ]
    assert len(inside) == 1
    frame = windowed(24, 36)(scene(), CAMERA, jnp.array(inside[0]))
    np.testing.assert_array_equal(frame.rgb[:, :24], crop)


def test_rays_go_on_outside_the_frame():
    # The same camera with 20 more columns on the left and 10 more rows on top.
    shift = np.array([[0, 0, 20], [0, 0, 10], [0, 0, 0]], np.float32)
    wide = dataclasses.replace(CAMERA, K=CAMERA.K + shift)
    inside = windowed(24, 36)(scene(), wide, jnp.array([0, 0]))
    outside = windowed(24, 36)(scene(), CAMERA, jnp.array([-10, -20]))
    np.testing.assert_array_equal(inside.segmentation, outside.segmentation)
    np.testing.assert_allclose(inside.depth, outside.depth, rtol=1e-5)


WORLDS = 3


def worlds():
    """Scenes, cameras and origins with a leading axis."""
    key = jax.random.key(1)
    moved = scene().pos + 0.05 * jax.random.normal(key, (WORLDS, *scene().pos.shape))
    scenes = jax.tree.map(lambda x: jnp.stack([x] * WORLDS), scene())
    poses = [
        camera_at([2.1, 1.7 + 0.2 * i, 1.6], [0, 0, 0.5], HEIGHT, WIDTH) for i in range(WORLDS)
    ]
    cameras = jax.tree.map(lambda *x: jnp.stack(x), *poses)
    origins = jnp.array([[0, 0], [37, 39], [11, 6]])
    return dataclasses.replace(scenes, pos=moved), cameras, origins


def at(tree, *index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


def test_a_world_is_the_same_in_a_batch():
    _, cameras, origins = worlds()
    batch = jax.jit(jax.vmap(windowed(24, 36), (None, 0, 0)))(scene(), cameras, origins)
    for i in range(WORLDS):
        assert_same_bits(at(batch, i), windowed(24, 36)(scene(), at(cameras, i), origins[i]))


def test_nested_vmap_is_one_batch():
    scenes, _, origins = worlds()
    over_origins = jax.vmap(windowed(24, 36), (None, None, 0))
    nested = jax.jit(jax.vmap(over_origins, (0, None, None)))(scenes, CAMERA, origins)
    assert nested.rgb.shape == (WORLDS, WORLDS, 24, 36, 3)
    for i, j in ((0, 2), (2, 1)):
        assert_same_bits(at(nested, i, j), windowed(24, 36)(at(scenes, i), CAMERA, origins[j]))


def test_the_surrounding_program_changes_nothing():
    origin = jnp.array([11, 6])

    @jax.jit
    def inside(factor):
        moved = dataclasses.replace(scene(), pos=scene().pos * factor + 0.01)
        return windowed(24, 36)(moved, CAMERA, origin), moved

    frame, moved = inside(jnp.float32(1.02))
    assert_same_bits(frame, windowed(24, 36)(moved, CAMERA, origin))
