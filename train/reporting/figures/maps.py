"""Success over the table, and the sample distribution: where objects lay, how cameras stood."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import matplotlib
import numpy as np
from matplotlib import patheffects
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from palm_jax.train.files.records import DomainRecord
from palm_jax.train.reporting import paper
from palm_jax.train.reporting.figures.style import (
    BAD,
    GOOD,
    INK,
    MUTED,
    TEST_REGION,
    Array,
    degree_label,
    map_axes,
    only_text,
    outline,
    styled,
)
from palm_jax.train.reporting.grids import Grid, Regions, angle_bins, positions
from palm_jax.train.reporting.stats import success_rate


@styled
def heatmaps(
    panels: Mapping[str, Grid], regions: Regions, *, title: str = "", columns: int = 3
) -> Figure:
    """Success over the object's start position, one panel per method, one colour scale.

    Cells show the success in percent; with room also successes/episodes. Cells without episodes
    are hatched. The training region is outlined.

    Args:
      panels: method (or any label) -> counts.
      regions: gives the training region.
      title: above the figure.
      columns: most panels in a row.
    """
    if not panels:
        return only_text("no sweep to draw")
    columns = min(columns, len(panels))
    rows = math.ceil(len(panels) / columns)
    first = next(iter(panels.values()))
    shape = (first.x_edges[-1] - first.x_edges[0]) / (first.y_edges[-1] - first.y_edges[0])
    width = 3.35
    height = 0.86 * width * min(max(shape, 0.35), 1.3) + 0.72
    figure = Figure(
        figsize=(columns * width + 0.9, rows * height + 0.6 + 0.3 * bool(title)),
        layout="constrained",
    )
    grid = figure.subplots(rows, columns, squeeze=False)
    image = None
    for index, (method, panel) in enumerate(panels.items()):
        axes = grid.flat[index]
        image = _heatmap(axes, panel, regions)
        axes.set_title(paper.method_label(method), pad=18)
        inside = regions.in_training(*np.meshgrid(*panel.centres, indexing="ij"))
        axes.text(
            0,
            1.025,
            "training region "
            + _share(panel.successes[inside], panel.episodes[inside])
            + ", outside "
            + _share(panel.successes[~inside], panel.episodes[~inside]),
            transform=axes.transAxes,
            fontsize=8,
            color=MUTED,
        )
        map_axes(axes, left=index % columns == 0, bottom=index + columns >= len(panels))
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    assert image is not None
    bar = figure.colorbar(image, ax=list(grid.flat), shrink=0.9, aspect=28, pad=0.015)
    bar.set_ticks([0, 0.25, 0.5, 0.75, 1], labels=["0", "25", "50", "75", "100"])
    bar.set_label("success (%)")
    bar.outline.set_visible(False)  # type: ignore[operator]
    figure.supxlabel(
        "as the front camera sees the table: robot at the top, camera at the bottom"
        + ("\n" if columns == 1 else "   ·   ")
        + "dashed: training region",
        fontsize=8,
        color=MUTED,
    )
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _heatmap(axes: Axes, panel: Grid, regions: Regions) -> Any:
    rate = success_rate(panel.successes, panel.episodes)
    colours = matplotlib.colormaps["cividis"]
    image = axes.pcolormesh(
        panel.y_edges,
        panel.x_edges,
        np.ma.masked_invalid(rate),
        cmap=colours,
        vmin=0,
        vmax=1,
        edgecolors="white",
        linewidth=0.6,
    )
    outline(axes, regions.train_x, regions.train_y, edgecolor="white", linewidth=2.6)
    outline(
        axes, regions.train_x, regions.train_y, edgecolor=INK, linewidth=1.3, linestyle=(0, (4, 2))
    )
    xs, ys = panel.centres
    small = max(1.3 * len(xs), len(ys)) > 10
    # Counts as a second line where they differ from cell to cell.
    with_counts = not small and np.unique(panel.episodes[panel.episodes > 0]).size > 1
    for i, j in np.ndindex(*rate.shape):
        if not panel.episodes[i, j]:
            _hatch(axes, panel, i, j)
            continue
        colour = "white" if rate[i, j] < 0.55 else INK
        # The numbers lie on top of the outline; a halo in the cell's colour keeps them legible.
        halo = [patheffects.withStroke(linewidth=2.2, foreground=colours(rate[i, j]))]
        lines = [(f"{100 * rate[i, j]:.0f}", 3.0 if with_counts else 0.0, 6.0 if small else 8.0)]
        if with_counts:
            counts = f"{panel.successes[i, j]:.0f}/{panel.episodes[i, j]:.0f}"
            lines.append((counts, -6.0, 5.5))
        for text, offset, size in lines:
            axes.annotate(
                text,
                (ys[j], xs[i]),
                xytext=(0, offset),
                textcoords="offset points",
                ha="center",
                va="center",
                fontsize=size,
                color=colour,
                zorder=5,
                path_effects=halo,
            )
    return image


def _hatch(axes: Axes, panel: Grid, i: int, j: int) -> None:
    corner = (float(panel.y_edges[j]), float(panel.x_edges[i]))
    width = float(panel.y_edges[j + 1] - panel.y_edges[j])
    height = float(panel.x_edges[i + 1] - panel.x_edges[i])
    axes.add_patch(
        Rectangle(
            corner,
            width,
            height,
            facecolor="#f1f3f5",
            hatch="////",
            edgecolor="#c3c8cf",
            linewidth=0,
        )
    )


def _share(successes: Array, episodes: Array) -> str:
    total = episodes.sum()
    return f"{100 * successes.sum() / total:.0f} %" if total else "no scenes"


@styled
def sample_distribution(
    records: Mapping[str, Mapping[str, DomainRecord]],
    regions: Regions,
    *,
    position_domains: Sequence[str] = ("ID", "W"),
    angle_domains: Sequence[str] = ("V",),
    title: str = "",
) -> Figure:
    """Where each method succeeds: object positions above, camera angles below.

    The upper row shows one mark per episode over the table, the lower row counts episodes in bins
    of ten degrees with the success in percent on top. One column per method.

    Args:
      records: method -> domain -> episodes (the arrays of eval.npz).
      regions: training and test bounds.
      position_domains, angle_domains: the domains pooled in each row, any spelling.
      title: above the figure.
    """
    if not records:
        return only_text("no episodes to draw")
    count = len(records)
    figure = Figure(figsize=(3.5 * count + 0.4, 5.1), layout="constrained")
    grid = figure.subplots(2, count, squeeze=False, height_ratios=[1.35, 1])
    tallest = 1.0
    for column, (method, domains) in enumerate(records.items()):
        above, below = grid[0, column], grid[1, column]
        placed = _pick(domains, position_domains)
        _scatter(above, placed, regions)
        above.set_title(paper.method_label(method))
        map_axes(above, left=column == 0)
        turned = _pick(domains, angle_domains)
        tallest = max(tallest, _angle_histogram(below, turned, regions))
        episodes = sum(record.episodes for record in turned)
        below.set_xlabel(f"camera angle   ({_names(angle_domains)}: {episodes} episodes)")
        episodes = sum(record.episodes for record in placed)
        above.set_xlabel(f"y (m)   ({_names(position_domains)}: {episodes} episodes)")
        if column == 0:
            below.set_ylabel("episodes")
    for axes in grid[1]:
        axes.set_ylim(0, 1.22 * tallest)
    several = any(
        len(_scenes(record)[0]) < record.episodes
        for domains in records.values()
        for record in _pick(domains, position_domains)
    )
    handles = _sample_handles(several=several)
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles) if len(records) > 1 else 2,  # one column of axes is too narrow for all
    )
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _sample_handles(*, several: bool) -> list[Artist]:
    """What the marks mean; `several` policies in the same scenes may come to different ends."""
    mark = partial(Line2D, [], [], linestyle="", markersize=5)
    some = mark(color=GOOD, marker="o", markerfacecolor="white", label="of some seeds")
    return [
        mark(color=GOOD, marker="o", label="success"),
        *([some] if several else []),
        mark(color=BAD, marker="x", label="failure"),
        Patch(fill=False, edgecolor=INK, linestyle=(0, (4, 2)), label="training bounds"),
        Patch(fill=False, edgecolor=TEST_REGION, label="test bounds"),
    ]


def _names(domains: Sequence[str]) -> str:
    return " and ".join(paper.domain_label(name) for name in domains)


def _pick(domains: Mapping[str, DomainRecord], wanted: Sequence[str]) -> list[DomainRecord]:
    keys = {paper.domain_key(name) for name in wanted}
    return [record for name, record in domains.items() if paper.domain_key(name) in keys]


def _scenes(record: DomainRecord) -> tuple[Array, Array]:
    """Where the object of each scene lay [S, 2], and the share of the policies that were tried
    there which solved it [S]: seeds that are joined share their scenes."""
    xy, scene = np.unique(record.object_xy.astype(float), axis=0, return_inverse=True)
    scene = scene.reshape(-1)
    return xy, np.bincount(scene, weights=record.solved) / np.bincount(scene)


def _scatter(axes: Axes, records: list[DomainRecord], regions: Regions) -> None:
    for record in records:
        xy, share = _scenes(record)
        never, always = share == 0, share == 1
        styles: list[tuple[NDArray[np.bool_], dict[str, Any]]] = [
            (never, {"marker": "x", "color": BAD, "linewidth": 1.1}),
            (
                ~never & ~always,
                {"marker": "o", "facecolor": "white", "edgecolors": GOOD, "linewidth": 1.1},
            ),
            (always, {"marker": "o", "color": GOOD, "linewidth": 0.4, "edgecolors": "white"}),
        ]
        for chosen, style in styles:
            axes.scatter(xy[chosen, 1], xy[chosen, 0], s=20, zorder=3, **style)
    outline(axes, regions.test_x, regions.test_y, edgecolor=TEST_REGION, linewidth=1.5)
    outline(
        axes, regions.train_x, regions.train_y, edgecolor=INK, linewidth=1.4, linestyle=(0, (4, 2))
    )
    margin = 0.05
    axes.set_xlim(regions.test_y[0] - margin, regions.test_y[1] + margin)
    axes.set_ylim(regions.test_x[0] - margin, regions.test_x[1] + margin)
    every, good = positions(records)
    inside = regions.in_training(every[:, 0], every[:, 1])
    axes.text(
        0.985,
        0.975,
        f"inside {good[inside].sum()}/{inside.sum()}   "
        f"outside {good[~inside].sum()}/{(~inside).sum()}",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=7.5,
        color=MUTED,
    )


def _angle_histogram(axes: Axes, records: list[DomainRecord], regions: Regions) -> float:
    edges, successes, episodes = angle_bins(records, regions)
    degrees = np.degrees(edges)
    centres, width = (degrees[1:] + degrees[:-1]) / 2, np.diff(degrees) * 0.86
    axes.bar(centres, successes, width=width, color=GOOD)
    axes.bar(
        centres,
        episodes - successes,
        width=width,
        bottom=successes,
        facecolor="#fbe3d6",
        edgecolor=BAD,
        linewidth=0.7,
        hatch="//////",
    )
    for centre, good, total in zip(centres, successes, episodes, strict=True):
        if total:
            axes.annotate(
                f"{100 * good / total:.0f} %",
                (centre, total),
                xytext=(0, 2),
                textcoords="offset points",
                ha="center",
                fontsize=7.5,
            )
    axes.axvline(math.degrees(regions.train_angle), color=INK, linewidth=1.4, dashes=(4, 2))
    for bound in (-regions.test_angle, regions.test_angle):
        axes.axvline(math.degrees(bound), color=TEST_REGION, linewidth=1.5)
    axes.set_xticks(degrees, [degree_label(value) for value in degrees])
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.grid(True, axis="y")
    return float(episodes.max(initial=0.0))
