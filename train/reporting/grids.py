"""From episodes and sweeps to counts per cell of the table, camera angle or strength."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palm_jax.train.files.records import DomainRecord, StrengthSweep, Sweep

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Regions:
    """Where objects may start, metres in the world frame, and the camera angles, radians."""

    train_x: tuple[float, float] = (0.15, 0.35)
    train_y: tuple[float, float] = (-0.10, 0.10)
    test_x: tuple[float, float] = (0.05, 0.45)
    test_y: tuple[float, float] = (-0.35, 0.35)
    train_angle: float = 0.0
    test_angle: float = math.radians(30.0)

    def in_training(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Whether positions lie in the training region (borders included)."""
        x, y = np.asarray(x), np.asarray(y)
        tolerance = 1e-6
        return (
            (x >= self.train_x[0] - tolerance)
            & (x <= self.train_x[1] + tolerance)
            & (y >= self.train_y[0] - tolerance)
            & (y <= self.train_y[1] + tolerance)
        )


@dataclass(frozen=True)
class Grid:
    """Counts over cells of the table: edges [X + 1], [Y + 1] in metres, counts [X, Y]."""

    x_edges: Array
    y_edges: Array
    successes: Array
    episodes: Array

    @property
    def centres(self) -> tuple[Array, Array]:
        """Cell centres, [X] and [Y]."""
        return (
            (self.x_edges[1:] + self.x_edges[:-1]) / 2,
            (self.y_edges[1:] + self.y_edges[:-1]) / 2,
        )


@dataclass(frozen=True)
class Curve:
    """Counts along one axis of shift: [A] camera angles in radians, or strengths."""

    at: Array
    successes: Array
    episodes: Array


def _edges(centres: ArrayLike, fallback: float) -> Array:
    """Borders half-way between neighbouring cell centres; a lone centre gets `fallback` width."""
    centres = np.asarray(centres, float)
    if len(centres) == 1:
        return np.array([centres[0] - fallback / 2, centres[0] + fallback / 2])
    middles = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middles[0], 2 * centres[-1] - middles[-1]
    return np.concatenate([[first], middles, [last]])


def grid_of_sweep(sweep: Sweep) -> Grid:
    """Success over object position, pooled over the sweep's camera angles."""
    solved = sweep.solved
    per_cell = solved.shape[0] * solved.shape[3]
    counts = solved.sum(axis=(0, 3)).astype(float)
    return Grid(
        _edges(sweep.xs, 0.1), _edges(sweep.ys, 0.1), counts, np.full(counts.shape, float(per_cell))
    )


def curve_of_sweep(sweep: Sweep) -> Curve:
    """Success over camera angle, pooled over the sweep's object positions."""
    solved = sweep.solved
    counts = solved.sum(axis=(1, 2, 3)).astype(float)
    return Curve(sweep.angles, counts, np.full(counts.shape, float(solved[0].size)))


def curve_of_strengths(sweep: StrengthSweep) -> Curve:
    """Success over the strength of a shift."""
    counts = sweep.solved.sum(axis=1).astype(float)
    return Curve(sweep.strengths, counts, np.full(counts.shape, float(sweep.success.shape[1])))


def positions(records: Iterable[DomainRecord]) -> tuple[Array, NDArray[np.bool_]]:
    """Object positions [N, 2] and successes [N] of several domains, one after the other."""
    records = list(records)
    xy = np.concatenate([np.zeros((0, 2)), *(record.object_xy for record in records)])
    return xy, np.concatenate([np.zeros(0, bool), *(record.solved for record in records)])


def grid_of_records(
    records: Iterable[DomainRecord], regions: Regions, *, cells: tuple[int, int] = (4, 7)
) -> Grid:
    """Bin single episodes into equal cells of the test region: cells = (along x, along y)."""
    xy, solved = positions(records)
    edges = (
        np.linspace(*regions.test_x, cells[0] + 1),
        np.linspace(*regions.test_y, cells[1] + 1),
    )
    episodes, *_ = np.histogram2d(xy[:, 0], xy[:, 1], bins=edges)
    successes, *_ = np.histogram2d(xy[solved, 0], xy[solved, 1], bins=edges)
    return Grid(edges[0], edges[1], successes, episodes)


def angle_bins(
    records: Iterable[DomainRecord], regions: Regions, *, width: float = math.radians(10.0)
) -> tuple[Array, Array, Array]:
    """Count episodes in bins of the camera angle that cover the test range.

    Args:
      records: the domains to pool.
      regions: gives the test range, +-test_angle.
      width: of a bin, radians.

    Returns:
      edges [B + 1] in radians, successes [B], episodes [B]. Angles on the outermost edge count.
    """
    records = list(records)
    angles = np.concatenate([np.zeros(0), *(record.camera_angle for record in records)])
    solved = np.concatenate([np.zeros(0, bool), *(record.solved for record in records)])
    half = max(1, round(regions.test_angle / width))
    edges = np.linspace(-half * width, half * width, 2 * half + 1)
    # float32 records may lie one rounding step outside of the outermost edge.
    inside = np.abs(angles) <= edges[-1] + 1e-5
    angles = np.clip(angles.astype(float), edges[0], edges[-1])
    episodes, _ = np.histogram(angles[inside], bins=edges)
    successes, _ = np.histogram(angles[inside & solved], bins=edges)
    return edges, successes.astype(float), episodes.astype(float)


def curve_of_records(records: Iterable[DomainRecord], regions: Regions) -> Curve:
    """Success over camera angle from single episodes, in bins of ten degrees."""
    edges, successes, episodes = angle_bins(records, regions)
    return Curve((edges[1:] + edges[:-1]) / 2, successes, episodes)
