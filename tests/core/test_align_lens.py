"""Lens distortion: against the model written out point by point, and frozen numbers of OpenCV."""

from functools import partial

import jax
import numpy as np
import oracles
import pytest
from contracts import check_op

from palm_jax.align import (
    OptionError,
    ShapeError,
    distort_points,
    undistort,
    undistort_points,
)

K = np.array([[260.0, 0.0, 161.3], [0.0, 255.0, 118.2], [0.0, 0.0, 1.0]])
FOUR = (-0.3, 0.1, 0.001, -0.002)
FIVE = (*FOUR, 0.02)
EIGHT = (0.2, -0.1, 0.003, 0.002, 0.01, 0.05, -0.02, 0.01)

# cv2.undistortPoints of OpenCV 5.0.0, its pixel centres moved by half a pixel.
SEEN = [[10.0, 8.0], [160.0, 120.0], [250.5, 199.25], [315.0, 5.0]]
OPENCV = {
    FOUR: [[-20.1085, -14.5069], [160.0001, 120.0], [257.394, 205.3159], [349.9931, -20.6435]],
    FIVE: [[-17.7618, -12.7754], [160.0001, 120.0], [257.3551, 205.2808], [346.809, -18.3047]],
    EIGHT: [[16.668, 12.6795], [160.0, 119.9999], [247.7686, 196.7098], [307.0085, 10.3483]],
}
# cv2.undistort of `picture()`: (row, column) -> colour.
SMALL_K = np.array([[30.0, 0.0, 20.4], [0.0, 28.0, 15.1], [0.0, 0.0, 1.0]])
PINCUSHION = (0.3, *FIVE[1:])
PIXELS = {
    FIVE: {
        (0, 0): (18, 18, 1), (3, 5): (39, 34, 5), (15, 20): (120, 120, 60),
        (29, 39): (216, 215, 193), (10, 33): (193, 82, 66), (25, 2): (25, 190, 19),
        (0, 20): (120, 9, 4),
    },
    PINCUSHION: {
        (0, 0): (0, 0, 0), (3, 5): (17, 11, 0), (15, 20): (120, 120, 60), (29, 39): (0, 0, 0),
        (10, 33): (203, 78, 66), (25, 2): (0, 0, 0), (0, 20): (0, 0, 0),
    },
}  # fmt: skip


def picture() -> np.ndarray:
    y, x = np.mgrid[:30, :40]
    return np.stack([x * 6, y * 8, x * y // 5], -1).astype(np.uint8)


def distorted(uv: np.ndarray, intrinsics: np.ndarray, dist: tuple) -> np.ndarray:
    """OpenCV's formula for one point, as its documentation has it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*dist, *[0.0] * (8 - len(dist)))
    y = (uv[1] - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (uv[0] - intrinsics[0, 2]) / intrinsics[0, 0]
    r = np.hypot(x, y)
    scale = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    scale /= 1 + k4 * r**2 + k5 * r**4 + k6 * r**6
    u = x * scale + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    v = y * scale + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return np.array([u, v]) * np.diag(intrinsics)[:2] + intrinsics[:2, 2]


@pytest.mark.parametrize("dist", [FOUR, FIVE, EIGHT])
def test_points_as_opencv_has_them(dist: tuple) -> None:
    np.testing.assert_allclose(undistort_points(SEEN, K, dist), OPENCV[dist], atol=2e-3)
    np.testing.assert_allclose(distort_points(OPENCV[dist], K, dist), SEEN, atol=2e-3)


@pytest.mark.parametrize("dist", [FOUR, EIGHT])
def test_distort_points(dist: tuple) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0), (320, 240), (4, 2)).astype(np.float32)
    op = partial(distort_points, K=K, dist=dist)
    check_op(op, lambda uv: distorted(uv, K, dist), [(uv,) for uv in points], atol=2e-3)
    back = partial(undistort_points, K=K, dist=dist)
    seen = [np.float32(distorted(uv, K, dist)) for uv in points]
    expected = dict(zip(map(bytes, seen), points, strict=True))
    check_op(back, lambda uv: expected[bytes(uv)], [(uv,) for uv in seen], atol=5e-3)


@pytest.mark.parametrize("dist", [FIVE, PINCUSHION])
def test_undistort(dist: tuple) -> None:
    def oracle(image: np.ndarray) -> np.ndarray:
        out = np.zeros(image.shape)
        for i in range(image.shape[0]):
            for j in range(image.shape[1]):
                u, v = distorted(np.array([j + 0.5, i + 0.5]), SMALL_K, dist)
                out[i, j] = oracles.bilinear(image, u - 0.5, v - 0.5)
        return out

    noise = np.random.default_rng(1).integers(0, 256, (30, 40, 3), np.uint8)
    examples = [(picture(),), (noise,)]
    op = partial(undistort, K=SMALL_K, dist=dist)
    check_op(op, oracle, examples, atol=0.51)
    floats = [(image.astype(np.float32) / 255,) for (image,) in examples]
    check_op(op, oracle, floats, atol=1e-4)
    got = np.asarray(op(picture())).astype(int)
    for place, colour in PIXELS[dist].items():
        # OpenCV interpolates at 32nds of a pixel.
        np.testing.assert_allclose(got[place], colour, atol=1.5)


def test_without_distortion_nothing_changes() -> None:
    np.testing.assert_array_equal(undistort(picture(), SMALL_K, [0.0] * 5), picture())


@pytest.mark.parametrize("count", [3, 6, 12, 14])
def test_other_numbers_of_coefficients(count: int) -> None:
    with pytest.raises(OptionError, match="expected 4, 5, 8 coefficients"):
        undistort_points(SEEN, K, np.zeros(count))


def test_shapes() -> None:
    with pytest.raises(OptionError, match=r"flatten OpenCV's \[1, n\]"):
        undistort(picture(), SMALL_K, np.zeros((1, 5)))
    with pytest.raises(ShapeError, match="last axes"):
        distort_points(np.zeros(3), K, FOUR)
    assert jax.jit(undistort)(picture(), SMALL_K, np.zeros(4)).dtype == np.uint8
