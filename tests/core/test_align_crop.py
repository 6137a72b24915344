"""TCP-centric crop and resize."""

from functools import partial

import jax
import numpy as np
import oracles
import pytest
from contracts import check_op
from hypothesis import given
from hypothesis import strategies as st

from palm_jax.align import resize, tcp_crop

# Inside, on each side, in a corner: (u, v) in a 60 x 80 image.
PLACES = [(40.3, 30.7), (2.2, 30.0), (79.5, 31.9), (41.0, 0.4), (39.0, 59.1), (0.0, 59.9)]


def images(count, height=60, width=80, dtype=np.uint8):
    rng = np.random.default_rng(count)
    values = rng.integers(0, 256, (count, height, width, 3), np.uint8)
    return values if dtype == np.uint8 else values.astype(np.float32) / 255


@pytest.mark.parametrize("border", ["shift", "edge", "constant"])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_tcp_crop(border, dtype):
    examples = [
        (image, np.float32(uv)) for image, uv in zip(images(6, dtype=dtype), PLACES, strict=True)
    ]
    op = partial(tcp_crop, size=24, offset=(0, 5), border=border)
    check_op(op, lambda image, uv: oracles.crop(image, uv, 24, (0, 5), border), examples)
    assert op(*examples[0]).dtype == dtype


@pytest.mark.parametrize("border", ["shift", "edge", "constant"])
def test_traced_points_outside_follow_the_border(border):
    image = images(1)[0]
    op = jax.jit(partial(tcp_crop, size=24, border=border))
    for uv in [(-70.0, 20.0), (500.0, 700.0), (-1e6, -1e6), (20.0, -13.0)]:
        if uv[0] > -1e5:
            np.testing.assert_array_equal(op(image, uv), oracles.crop(image, uv, 24, border=border))
    assert op(image, np.array([np.nan, np.inf])).shape == (24, 24, 3)


@given(st.floats(0, 79.99), st.floats(0, 59.99), st.sampled_from([1, 24, 57]))
def test_unclamped_crop_keeps_the_tcp_at_its_pixel(u, v, size):
    image = np.zeros((60, 80, 1), np.uint8)
    u, v = np.float32(u), np.float32(v)
    image[int(v), int(u)] = 255
    crop = np.asarray(tcp_crop(image, (u, v), size, border="constant"))
    assert crop[size // 2, size // 2] == 255 and crop.sum() == 255


@pytest.mark.parametrize("size", [80, 160, 200, 240])
def test_crop_and_resize_golden(size):
    golden, image = oracles.golden_align(), oracles.golden_image()
    for uv, expected in zip(golden["uv"], golden[f"crop{size}"], strict=False):
        got = np.asarray(resize(tcp_crop(image, uv, size, offset=(0, 40)), 84))
        off = np.abs(got.astype(int) - expected)
        assert off.max() <= 1 and (off > 0).mean() <= 0.02


def test_resize_full_frame_golden():
    got = np.asarray(resize(oracles.golden_image(), 84))
    off = np.abs(got.astype(int) - oracles.golden_align()["full84"])
    assert off.max() <= 1 and (off > 0).mean() <= 0.02


@pytest.mark.parametrize("size", [(21, 17), (100, 96), (60, 80)])
def test_resize(size):
    float_images = images(2, dtype=np.float32)
    op = partial(resize, size=size)
    check_op(
        op, lambda image: oracles.resize(image, *size), [(i,) for i in float_images], atol=1e-5
    )


def test_resize_truncates_bytes():
    def compare(got, expected):
        assert got.dtype == np.uint8
        # At a whole number, float32 may fall on either side.
        assert (got >= np.floor(expected - 1e-3)).all() and (got <= expected + 1e-3).all()

    check_op(
        partial(resize, size=31),
        lambda image: oracles.resize(image, 31, 31),
        [(i,) for i in images(2)],
        compare=compare,
    )


def test_resize_keeps_flat_images_flat():
    flat = np.full((512, 512, 3), 200, np.uint8)
    np.testing.assert_array_equal(resize(flat, 84), flat[:84, :84])
