"""Binning of episodes and sweeps, with counts made by hand."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from palm_jax.train.files.records import DomainRecord, StrengthSweep, Sweep
from palm_jax.train.reporting import grids

REGIONS = grids.Regions()


def record(
    xy: list[tuple[float, float]], angles: Sequence[float], success: list[int], nan: list[int]
) -> DomainRecord:
    """Episodes with angles in degrees; as float32, as they come from disk."""
    return DomainRecord(
        np.array(success, bool),
        np.array(nan, bool),
        np.array(xy, np.float32).reshape(-1, 2),
        np.radians(np.array(angles)).astype(np.float32),
        np.full(len(success), 10, np.int32),
        np.ones(len(success), np.int32),
    )


def test_angle_bins_of_ten_degrees() -> None:
    degrees = [-30, -29, -11, -8, -0.5, 0, 5, 9, 12, 30, 31]
    success = [1, 0, 1, 1, 1, 1, 0, 1, 1, 1, 1]
    nan = [0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]
    one = record([(0.2, 0.0)] * 11, degrees, success, nan)
    edges, good, total = grids.angle_bins([one], REGIONS)
    np.testing.assert_allclose(np.degrees(edges), [-30, -20, -10, 0, 10, 20, 30], atol=1e-9)
    # 31 degrees is outside, +-30 (in float32) are not; the episode at 9 degrees went NaN.
    assert total.tolist() == [2, 1, 2, 3, 1, 1]
    assert good.tolist() == [1, 1, 2, 1, 1, 1]


def test_angle_bins_pool_records_and_accept_none() -> None:
    one = record([(0.2, 0.0)], [15], [1], [0])
    _, good, total = grids.angle_bins([one, one], REGIONS)
    assert total.tolist() == [0, 0, 0, 0, 2, 0] and good.tolist() == total.tolist()
    _, good, total = grids.angle_bins([], REGIONS)
    assert not good.any() and not total.any()


def test_curve_of_records_sits_at_bin_centres() -> None:
    curve = grids.curve_of_records([record([(0.2, 0.0)], [15], [1], [0])], REGIONS)
    np.testing.assert_allclose(np.degrees(curve.at), [-25, -15, -5, 5, 15, 25])
    assert curve.episodes.tolist() == [0, 0, 0, 0, 1, 0]


def test_grid_of_records() -> None:
    # x in [.05, .45] in 2 cells, y in [-.35, .35] in 2 cells; the last lies outside.
    xy = [(0.1, -0.2), (0.1, 0.2), (0.12, 0.3), (0.4, 0.1), (0.7, 0.0)]
    one = record(xy, [0] * 5, [1, 0, 1, 1, 1], [0] * 5)
    grid = grids.grid_of_records([one], REGIONS, cells=(2, 2))
    assert grid.episodes.tolist() == [[1, 2], [0, 1]]
    assert grid.successes.tolist() == [[1, 1], [0, 1]]
    np.testing.assert_allclose(grid.x_edges, [0.05, 0.25, 0.45])
    np.testing.assert_allclose(grid.centres[1], [-0.175, 0.175])


@pytest.fixture
def sweep() -> Sweep:
    """2 angles, 2 x, 3 y, 4 episodes; successes placed one by one."""
    success = np.zeros((2, 2, 3, 4), bool)
    success[0, 1, 2] = [1, 1, 1, 0]
    success[1, 1, 2] = [1, 0, 0, 0]
    success[1, 0, 0] = [0, 0, 1, 1]
    nan = np.zeros_like(success)
    nan[1, 0, 0, 3] = True
    return Sweep(
        np.radians([-15.0, 15.0]), np.array([0.1, 0.3]), np.array([-0.2, 0, 0.2]), success, nan
    )


def test_grid_of_sweep_pools_angles(sweep: Sweep) -> None:
    grid = grids.grid_of_sweep(sweep)
    assert grid.successes.tolist() == [[1, 0, 0], [0, 0, 4]]
    assert grid.episodes.tolist() == [[8] * 3] * 2
    np.testing.assert_allclose(grid.x_edges, [0.0, 0.2, 0.4], atol=1e-12)
    np.testing.assert_allclose(grid.y_edges, [-0.3, -0.1, 0.1, 0.3], atol=1e-12)


def test_curve_of_sweep_pools_positions(sweep: Sweep) -> None:
    curve = grids.curve_of_sweep(sweep)
    assert curve.successes.tolist() == [3, 2]
    assert curve.episodes.tolist() == [24, 24]
    np.testing.assert_allclose(np.degrees(curve.at), [-15, 15])


def test_curve_of_strengths() -> None:
    success = np.array([[1, 1, 0], [1, 0, 0]], bool)
    nan = np.array([[0, 1, 0], [0, 0, 0]], bool)
    curve = grids.curve_of_strengths(StrengthSweep("fog", np.array([0.0, 1]), success, nan))
    assert curve.at.tolist() == [0, 1]
    assert curve.successes.tolist() == [1, 1] and curve.episodes.tolist() == [3, 3]


def test_a_sweep_of_one_cell_still_has_an_area() -> None:
    one = Sweep(np.zeros(1), np.array([0.25]), np.array([0.0]), np.ones((1, 1, 1, 2), bool),
                np.zeros((1, 1, 1, 2), bool))  # fmt: skip
    grid = grids.grid_of_sweep(one)
    assert (np.diff(grid.x_edges) > 0).all() and (np.diff(grid.y_edges) > 0).all()
    assert grid.successes.item() == 2


def test_regions_hold_the_design_values() -> None:
    # Training: 0.2 x 0.2 m about (0.25, 0); borders belong to it, also after float32 rounding.
    x = np.float32([0.15, 0.35, 0.25, 0.36, 0.14])
    assert REGIONS.in_training(x, np.float32([-0.1, 0.1, 0, 0, 0])).tolist() == [1, 1, 1, 0, 0]
    assert math.degrees(REGIONS.test_angle) == pytest.approx(30)
