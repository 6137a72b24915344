"""Isolation against NumPy, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import palm_jax.align as pa

RNG = np.random.default_rng(3)
IMAGE = RNG.integers(1, 256, (40, 50, 3), dtype=np.uint8)
MASK = RNG.random((40, 50)) < 0.3


def expected(image: np.ndarray, mask: np.ndarray, pitch: int) -> np.ndarray:
    result = np.zeros_like(image)
    grey = 96 if image.dtype == np.uint8 else np.float32(96 / 255)
    result[::pitch] = grey
    result[:, ::pitch] = grey
    result[mask] = image[mask]
    return result


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_what_the_mask_shows_stays_on_a_grid(dtype: str) -> None:
    image = IMAGE if dtype == "uint8" else (IMAGE / np.float32(255)).astype(np.float32)
    for run in (pa.isolate, jax.jit(pa.isolate, static_argnames="pitch")):
        got = run(image, MASK, pitch=8)
        assert got.dtype == dtype
        np.testing.assert_array_equal(got, expected(image, MASK, 8))
    batch = jax.vmap(lambda i, m: pa.isolate(i, m, pitch=8))(
        jnp.stack([image, image]), jnp.stack([MASK, ~MASK])
    )
    np.testing.assert_array_equal(batch[1], expected(image, ~MASK, 8))


def test_bad_input_is_named() -> None:
    with pytest.raises(pa.ShapeError, match=r"mask: expected the image's \[40, 50\]"):
        pa.isolate(IMAGE, MASK.T)
    with pytest.raises(pa.OptionError, match="pitch"):
        pa.isolate(IMAGE, MASK, pitch=1)


def test_align_isolates_first() -> None:
    """The overlay lies on top, the grid is that of the camera's image."""
    camera = pa.Camera.from_fovy(40.0, 64, 64, jnp.eye(4))
    image = RNG.integers(1, 256, (64, 64, 3), dtype=np.uint8)
    mask = np.zeros((64, 64), bool)
    mask[20:40, 20:40] = True
    tcp = jnp.eye(4).at[2, 3].set(1.0)
    plain = pa.AlignSpec(crop=40, size=40, offset=(0, 0), axis_length=0.05)
    spec = pa.AlignSpec(crop=40, size=40, offset=(0, 0), axis_length=0.05, isolate=True)
    want = pa.align(pa.isolate(image, mask, pitch=32), camera, tcp, 1.0, plain)
    got = pa.align(image, camera, tcp, 1.0, spec, mask=mask)
    np.testing.assert_array_equal(got.image, want.image)
    with pytest.raises(pa.OptionError, match="mask: expected one if and only if"):
        pa.align(image, camera, tcp, 1.0, spec)
    with pytest.raises(pa.OptionError, match="mask: expected one if and only if"):
        pa.align(image, camera, tcp, 1.0, plain, mask=mask)
