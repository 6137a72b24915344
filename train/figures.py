"""Figures of a run: plain functions from records and counts to a Matplotlib `Figure`.

Nothing here reads a run folder (that is `palm_jax.train.report`), and nothing touches Matplotlib's
global state: figures are `matplotlib.figure.Figure` objects drawn by the Agg back end, so they work
without a display and in any thread. Colours come from the Okabe-Ito palette and from cividis, both
readable with any colour vision; no figure relies on colour alone.

Maps of the table are drawn as the front camera sees it: world y to the right, world x downwards,
the robot at the top. Angles are radians in arguments and degrees on axes. Every interval is a
Wilson 95 % interval.
"""

import functools
import io
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec

import matplotlib
import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, MultipleLocator, NullLocator
from numpy.typing import NDArray

from palm_jax.train import paper
from palm_jax.train.grids import Curve, Grid, Regions, angle_bins, positions
from palm_jax.train.metrics import write_atomic
from palm_jax.train.records import DomainRecord
from palm_jax.train.stats import success_rate, wilson_interval

Array = NDArray[np.float64]
ImageArray = NDArray[np.uint8]
P = ParamSpec("P")

INK, MUTED, FAINT = "#1b1b1f", "#5f6368", "#d9dce1"
GOOD, BAD = "#0072B2", "#D55E00"  # blue and vermilion: apart for every kind of colour vision
TEST_REGION = "#009E73"

_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#8a8f98",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": False,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "text.parse_math": False,  # names come from files: a dollar sign is one
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.6,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


class Look(NamedTuple):
    """How one method is drawn everywhere."""

    colour: str
    marker: str
    dash: Any


_LOOKS = {
    "palm": Look("#0072B2", "o", "-"),
    "bc": Look("#D55E00", "s", "-"),
    "palm-paper-frame": Look("#003F7F", "d", (0, (3, 1, 1, 1))),
    "palm-crop": Look("#56B4E9", "^", (0, (4, 1.5))),
    "palm-overlay": Look("#009E73", "v", (0, (4, 1.5))),
    "palm-aug": Look("#CC79A7", "D", (0, (4, 1.5))),
    "palm-prop": Look("#8C6BB1", "P", (0, (4, 1.5))),
    "mirrorduo": Look("#E69F00", "X", (0, (1, 1))),
    "roviaug": Look("#A08C00", "<", (0, (1, 1))),
    "arro": Look("#4D4D4D", ">", (0, (1, 1))),
}
_SPARE = [Look("#882255", "h", "-."), Look("#117733", "p", "-."), Look("#332288", "*", "-.")]


def look(method: str) -> Look:
    """Colour, marker and dash of a method; an unknown name always gets the same spare look."""
    return _LOOKS.get(method) or _SPARE[sum(method.encode()) % len(_SPARE)]


# ---------------------------------------------------------------------------------------------
# Drawing helpers


def _styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Run a drawing function under this module's style, and attach a canvas."""

    @functools.wraps(draw)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with matplotlib.rc_context(_RC):
            figure = draw(*args, **kwargs)
            FigureCanvasAgg(figure)
            return figure

    return wrapper


def save(figure: Figure, path: Path, *, dpi: int = 160) -> Path:
    """Write a figure as PNG, whole or not at all, with the same bytes for the same content."""
    content = io.BytesIO()
    with matplotlib.rc_context(_RC):
        figure.savefig(content, format="png", dpi=dpi, metadata={"Software": None})
    return write_atomic(path, content.getvalue())


def _percent_axis(axes: Axes, *, label: str = "success", top: float = 1.04) -> None:
    axes.set_ylim(0, top)
    axes.set_yticks(np.linspace(0, 1, 6), [f"{value:.0f}" for value in np.linspace(0, 100, 6)])
    axes.set_ylabel(f"{label} (%)")
    axes.grid(True, axis="y")


def _outline(axes: Axes, x: tuple[float, float], y: tuple[float, float], **style: Any) -> Rectangle:
    """A rectangle over world x and y on a map whose axes are (y, x)."""
    box = Rectangle((y[0], x[0]), y[1] - y[0], x[1] - x[0], fill=False, **style)
    axes.add_patch(box)
    return box


def _map_axes(axes: Axes, *, left: bool, bottom: bool = True) -> None:
    """Axes of a map as the front camera sees the table."""
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.yaxis.set_major_locator(MultipleLocator(0.1))
    axes.xaxis.set_major_formatter("{x:.1f}")
    axes.yaxis.set_major_formatter("{x:.1f}")
    if bottom:
        axes.set_xlabel("y (m)")
    if left:
        axes.set_ylabel("x (m)")
    axes.spines[["top", "right"]].set_visible(True)


def _empty(message: str) -> Figure:
    figure = Figure(figsize=(5.0, 1.2))
    figure.text(0.5, 0.5, message, ha="center", va="center", color=MUTED)
    return figure


def _share(successes: Array, episodes: Array) -> str:
    total = episodes.sum()
    return f"{100 * successes.sum() / total:.0f} %" if total else "no scenes"


# ---------------------------------------------------------------------------------------------
# (a) Success over the table


@_styled
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
        return _empty("no sweep to draw")
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
        _map_axes(axes, left=index % columns == 0, bottom=index + columns >= len(panels))
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
    _outline(axes, regions.train_x, regions.train_y, edgecolor="white", linewidth=2.6)
    _outline(
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


# ---------------------------------------------------------------------------------------------
# (b) Success over the camera angle


@_styled
def angle_curves(curves: Mapping[str, Curve], regions: Regions, *, title: str = "") -> Figure:
    """Success against the camera angle, methods overlaid, with intervals.

    Args:
      curves: method -> counts at camera angles.
      regions: marks the training angle and the test range.
      title: above the axes.
    """
    if not curves:
        return _empty("no camera angles to draw")
    figure = Figure(figsize=(6.2, 3.3), layout="constrained")
    axes = figure.subplots()
    limit = math.degrees(regions.test_angle)
    every = np.concatenate([np.degrees(curve.at) for curve in curves.values()])
    reach = max(limit, float(np.abs(every).max())) * 1.08
    axes.axvspan(-limit, limit, color="#f4f6f8", zorder=0, linewidth=0)
    axes.axvline(math.degrees(regions.train_angle), color=MUTED, linewidth=1, dashes=(4, 2))
    axes.annotate(
        "training view",
        (math.degrees(regions.train_angle), 1.0),
        xytext=(4, 2),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        color=MUTED,
        fontsize=7.5,
        va="bottom",
    )
    _curve_lines(axes, curves, np.degrees, spread=0.9)
    axes.set_xlim(-reach, reach)
    ticks = np.arange(-math.floor(reach / 10) * 10, reach, 10)
    axes.set_xticks(ticks, [_degrees(tick) for tick in ticks])
    axes.set_xlabel("camera angle about the workspace centre   (shaded: test range)")
    _curve_legend(figure, curves)
    if title:
        axes.set_title(title, pad=14)
    return figure


@_styled
def strength_curves(
    panels: Mapping[str, Mapping[str, Curve]], *, title: str = "", columns: int = 3
) -> Figure:
    """Success against the strength of shifts: a panel per shift, methods overlaid, intervals.

    Args:
      panels: shift -> method -> counts at strengths; at 0 nothing is shifted.
      title: above the figure.
      columns: most panels in a row.
    """
    panels = {shift: curves for shift, curves in panels.items() if curves}
    if not panels:
        return _empty("no strengths to draw")
    rows = math.ceil(len(panels) / columns)
    columns = math.ceil(len(panels) / rows)
    width = 4.4 if len(panels) == 1 else 3.4
    figure = Figure(
        figsize=(columns * width + 0.3, 2.6 * rows + 0.5 + 0.3 * bool(title)), layout="constrained"
    )
    grid = figure.subplots(rows, columns, squeeze=False)
    methods: dict[str, Curve] = {}
    for index, (shift, curves) in enumerate(panels.items()):
        axes = grid.flat[index]
        every = np.concatenate([curve.at for curve in curves.values()])
        room = 0.06 * max(float(np.ptp(every)), 0.1)
        axes.axvline(0.0, color=MUTED, linewidth=1, dashes=(4, 2))
        _curve_lines(axes, curves, np.asarray, spread=room / 4)
        axes.set_xlim(every.min() - room, every.max() + room)
        axes.set_title(paper.domain_title(shift))
        axes.set_xlabel("strength   (dashed: none)")
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter("{x:g}")
        if index % columns:
            axes.set_ylabel("")
        methods |= curves
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    _curve_legend(figure, methods)
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _curve_lines(
    axes: Axes,
    curves: Mapping[str, Curve],
    scale: Callable[[Array], Array],
    *,
    spread: float,
) -> None:
    """Success with intervals over `scale(curve.at)`, methods apart by up to `spread` in all."""
    few = len(curves) <= 3
    for index, (method, curve) in enumerate(curves.items()):
        style = look(method)
        seen = curve.episodes > 0
        good, total = curve.successes[seen], curve.episodes[seen]
        rate, (lower, upper) = success_rate(good, total), wilson_interval(good, total)
        # A little sideways, so that bars do not hide each other.
        shift = spread * (index / (len(curves) - 1) - 0.5) if len(curves) > 1 else 0.0
        at = scale(curve.at[seen]) + shift
        if few:
            axes.fill_between(at, lower, upper, color=style.colour, alpha=0.13, linewidth=0)
        # With many methods the bars of all but the two protagonists step back.
        front = few or method in ("palm", "bc")
        axes.errorbar(
            at,
            rate,
            yerr=_bars(rate, lower, upper),
            fmt="none",
            ecolor=style.colour,
            elinewidth=1,
            capsize=2 if front else 0,
            alpha=1 if front else 0.3,
            zorder=3 if front else 2,
        )
        axes.plot(
            at,
            rate,
            color=style.colour,
            marker=style.marker,
            markersize=4.5,
            linestyle=style.dash,
            linewidth=1.9 if front else 1.2,
            zorder=4 if front else 3,
            clip_on=False,
            label=paper.method_label(method),
        )
    _percent_axis(axes)


def _curve_legend(figure: Figure, curves: Mapping[str, Curve]) -> None:
    """One entry per method above the axes."""
    figure.legend(
        handles=[
            Line2D(
                [],
                [],
                color=look(method).colour,
                marker=look(method).marker,
                markersize=4.5,
                linestyle=look(method).dash,
                label=paper.method_label(method),
            )
            for method in curves
        ],
        loc="outside upper center",
        ncols=min(len(curves), 3 if len(curves) > 4 else 4),
    )


def _degrees(value: float) -> str:
    return f"{value:+.0f}°".replace("-", "−") if abs(value) > 0.5 else "0°"


def _bars(rate: Array, lower: Array, upper: Array) -> Array:
    """Distances for `errorbar`; rounding must not make one negative."""
    return np.maximum(np.stack([rate - lower, upper - rate]), 0.0)


# ---------------------------------------------------------------------------------------------
# (c) The sample distribution


@_styled
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
        return _empty("no episodes to draw")
    count = len(records)
    figure = Figure(figsize=(3.5 * count + 0.4, 5.1), layout="constrained")
    grid = figure.subplots(2, count, squeeze=False, height_ratios=[1.35, 1])
    tallest = 1.0
    for column, (method, domains) in enumerate(records.items()):
        above, below = grid[0, column], grid[1, column]
        placed = _pick(domains, position_domains)
        _scatter(above, placed, regions)
        above.set_title(paper.method_label(method))
        _map_axes(above, left=column == 0)
        turned = _pick(domains, angle_domains)
        tallest = max(tallest, _angle_histogram(below, turned, regions))
        scenes = sum(record.episodes for record in turned)
        below.set_xlabel(f"camera angle   ({_names(angle_domains)}: {scenes} scenes)")
        scenes = sum(record.episodes for record in placed)
        above.set_xlabel(f"y (m)   ({_names(position_domains)}: {scenes} scenes)")
        if column == 0:
            below.set_ylabel("episodes")
    for axes in grid[1]:
        axes.set_ylim(0, 1.22 * tallest)
    figure.legend(
        handles=[
            Line2D([], [], color=GOOD, marker="o", linestyle="", markersize=5, label="success"),
            Line2D([], [], color=BAD, marker="x", linestyle="", markersize=5, label="failure"),
            Patch(fill=False, edgecolor=INK, linestyle=(0, (4, 2)), label="training bounds"),
            Patch(fill=False, edgecolor=TEST_REGION, label="test bounds"),
        ],
        loc="outside lower center",
        ncols=4 if len(records) > 1 else 2,  # one column of axes is too narrow for four
    )
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _names(domains: Sequence[str]) -> str:
    return " and ".join(paper.domain_label(name) for name in domains)


def _pick(domains: Mapping[str, DomainRecord], wanted: Sequence[str]) -> list[DomainRecord]:
    keys = {paper.domain_key(name) for name in wanted}
    return [record for name, record in domains.items() if paper.domain_key(name) in keys]


def _scatter(axes: Axes, records: list[DomainRecord], regions: Regions) -> None:
    for record in records:
        xy, solved = record.object_xy, record.solved
        axes.scatter(
            xy[~solved, 1], xy[~solved, 0], s=20, marker="x", color=BAD, linewidth=1.1, zorder=3
        )
        axes.scatter(
            xy[solved, 1],
            xy[solved, 0],
            s=20,
            marker="o",
            color=GOOD,
            alpha=0.85,
            linewidth=0.4,
            edgecolors="white",
            zorder=3,
        )
    _outline(axes, regions.test_x, regions.test_y, edgecolor=TEST_REGION, linewidth=1.5)
    _outline(
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
    axes.set_xticks(degrees, [_degrees(value) for value in degrees])
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.grid(True, axis="y")
    return float(episodes.max(initial=0.0))


# ---------------------------------------------------------------------------------------------
# (d) Success per domain


@_styled
def domain_bars(
    counts: Mapping[str, Mapping[str, Mapping[str, int]]],
    *,
    with_paper: bool = True,
    title: str = "",
) -> Figure:
    """Success per domain and method with intervals, and the paper's number as a mark.

    Args:
      counts: method -> domain -> {"successes", "episodes"} (the content of eval.json).
      with_paper: mark what Table I of the paper implies, where it has the method.
      title: above the axes.
    """
    domains = paper.ordered_domains(
        list(dict.fromkeys(paper.domain_key(name) for entry in counts.values() for name in entry))
    )
    if not domains:
        return _empty("no evaluation to draw")
    methods = list(counts)
    # Many methods: two rows, so that the figure stays as wide as a page.
    rows = 2 if len(methods) > 4 and len(domains) > 4 else 1
    columns = math.ceil(len(domains) / rows)
    figure = Figure(
        figsize=(max(5.2, 1.2 + columns * (0.3 + 0.2 * len(methods))), 0.6 + 2.7 * rows),
        layout="constrained",
    )
    grid = figure.subplots(rows, 1, squeeze=False)[:, 0]
    marked = False
    for row, axes in enumerate(grid):
        shown = domains[row * columns : (row + 1) * columns]
        for index, method in enumerate(methods):
            by_domain = {paper.domain_key(name): entry for name, entry in counts[method].items()}
            slot = (index, len(methods))
            marked |= _method_bars(axes, method, by_domain, shown, slot, with_paper)
        for border in np.arange(len(shown) - 1) + 0.5:
            axes.axvline(border, color=FAINT, linewidth=0.8)
        axes.set_xlim(-0.5, columns - 0.5)
        axes.set_xticks(range(len(shown)), [_domain_name(name) for name in shown])
        axes.tick_params(axis="x", length=0, labelsize=9, labelcolor=INK)
        _percent_axis(axes)
    handles: list[Any] = [
        Patch(color=look(method).colour, label=paper.method_label(method)) for method in methods
    ]
    if marked:
        handles.append(
            Line2D(
                [],
                [],
                linestyle="",
                marker="D",
                markersize=5,
                markerfacecolor="white",
                markeredgecolor=INK,
                label="paper (mean of its 4 tasks)",
            )
        )
    figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 5))
    if title:
        grid[0].set_title(title)
    return figure


def _method_bars(
    axes: Axes,
    method: str,
    by_domain: Mapping[str, Mapping[str, int]],
    domains: Sequence[str],
    slot: tuple[int, int],
    with_paper: bool,
) -> bool:
    """One method's bars in slot (index, count) of each domain; whether the paper has a number."""
    index, count = slot
    width = 0.84 / count
    present = [i for i, domain in enumerate(domains) if domain in by_domain]
    good = np.array([by_domain[domains[i]]["successes"] for i in present], float)
    total = np.array([by_domain[domains[i]]["episodes"] for i in present], float)
    rate, (lower, upper) = success_rate(good, total), wilson_interval(good, total)
    place = np.array(present) + (index - (count - 1) / 2) * width
    axes.bar(place, rate, width=0.9 * width, color=look(method).colour)
    axes.errorbar(
        place,
        rate,
        yerr=_bars(rate, lower, upper),
        fmt="none",
        ecolor=INK,
        elinewidth=0.9,
        capsize=min(2.5, 12 * width),
    )
    theirs = [paper.implied_success(method, domains[i]) for i in present]
    points = [(x, y) for x, y in zip(place, theirs, strict=True) if y is not None]
    if not with_paper or not points:
        return False
    x, y = zip(*points, strict=True)
    axes.plot(
        x,
        y,
        linestyle="",
        marker="D",
        markersize=4.5,
        markerfacecolor="white",
        markeredgecolor=INK,
        markeredgewidth=1,
        zorder=5,
    )
    return True


# ---------------------------------------------------------------------------------------------
# (e) Training curves

# Which metrics get a panel: title -> accepted names, best first; the scale of the axis.
_PANELS: dict[str, tuple[tuple[str, ...], str]] = {
    "training loss": (("loss", "train/loss", "train_loss"), "log"),
    "validation loss": (("val_loss", "val/loss", "validation_loss"), "log"),
    "in-domain success (%)": (("in_domain_success", "success", "eval/success"), "percent"),
    "gradient norm": (("grad_norm", "train/grad_norm", "norm/grads"), "log"),
    "learning rate": (("learning_rate", "lr", "train/lr"), "linear"),
    "R² per action": (("r2", "r2_mean"), "linear"),
}


@_styled
def training_curves(
    runs: Mapping[str, Sequence[Mapping[str, Any]]], *, title: str = "", panels: int = 3
) -> Figure:
    """Metrics over steps, methods overlaid, one panel per metric that the runs have.

    Args:
      runs: method -> the records of metrics.jsonl; those without "step" are skipped.
      title: above the figure.
      panels: how many at most, taken in this module's order of interest.
    """
    found = []
    for name, (keys, scale) in _PANELS.items():
        lines = {method: _series(records, keys) for method, records in runs.items()}
        lines = {method: line for method, line in lines.items() if len(line[0]) > 0}
        if lines:
            found.append((name, scale, lines))
    found = found[:panels]
    if not found:
        return _empty("no metrics to draw")
    figure = Figure(figsize=(3.3 * len(found) + 0.2, 2.8), layout="constrained")
    for axes, (name, scale, lines) in zip(
        figure.subplots(1, len(found), squeeze=False)[0], found, strict=True
    ):
        for method, (steps, values) in lines.items():
            _trace(axes, method, steps, values, scale)
        axes.set_title(name)
        axes.set_xlabel("step")
        axes.margins(x=0.01)
        axes.grid(True, axis="y")
        axes.ticklabel_format(axis="x", style="plain")
        if scale == "log":
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_locator(NullLocator())
        elif scale == "percent":
            _percent_axis(axes)
            axes.set_ylabel("")
    methods = [method for method in runs if any(method in lines for _, _, lines in found)]
    figure.legend(
        handles=[
            Line2D(
                [], [], color=look(m).colour, linestyle=look(m).dash, label=paper.method_label(m)
            )
            for m in methods
        ],
        loc="outside lower center",
        ncols=min(len(methods), 5),
    )
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _series(records: Sequence[Mapping[str, Any]], keys: tuple[str, ...]) -> tuple[Array, Array]:
    """Steps and values of the first of `keys` that the records have; a rerun step's last wins."""
    for key in keys:
        points = {
            float(record["step"]): float(record[key])
            for record in records
            if isinstance(record.get("step"), (int, float))
            and isinstance(record.get(key), (int, float))
        }
        points = {step: value for step, value in points.items() if math.isfinite(value)}
        if points:
            steps = np.array(sorted(points))
            return steps, np.array([points[step] for step in steps])
    return np.zeros(0), np.zeros(0)


def _trace(axes: Axes, method: str, steps: Array, values: Array, scale: str) -> None:
    style = look(method)
    if scale == "log" and len(values) >= 40:
        # The raw record faint, a running median strong: single batches are noisy.
        axes.plot(steps, values, color=style.colour, alpha=0.25, linewidth=0.7)
        values = _running_median(values, max(5, len(values) // 40))
    marker = style.marker if len(values) <= 15 else None
    axes.plot(
        steps,
        values,
        color=style.colour,
        linestyle=style.dash,
        marker=marker,
        markersize=4,
        label=paper.method_label(method),
    )


def _running_median(values: Array, width: int) -> Array:
    """Median of a centred window that shrinks at the ends."""
    half = width // 2
    padded = np.pad(values, half, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    return np.nanmedian(windows, axis=-1)


# ---------------------------------------------------------------------------------------------
# (f) What the policies see


@_styled
def gallery(
    images: Mapping[str, Mapping[str, ImageArray]],
    *,
    frames: Mapping[str, ImageArray] | None = None,
    title: str = "",
) -> Figure:
    """A strip of policy inputs: one row per method, one column per domain.

    Args:
      images: method -> domain -> uint8 [h, w, 3], what the policy gets.
      frames: domain -> uint8 [H, W, 3], the full camera frame, as a first row.
      title: above the figure.
    """
    rows: list[tuple[str, Mapping[str, ImageArray]]] = []
    if frames:
        rows.append(("camera frame", frames))
    rows += [(paper.method_label(method), strip) for method, strip in images.items()]
    domains = paper.ordered_domains(list(dict.fromkeys(name for _, row in rows for name in row)))
    if not domains:
        return _empty("no images to draw")
    cell = 1.28
    figure = Figure(
        figsize=(cell * len(domains) + 0.45, cell * len(rows) + (0.7 if title else 0.3)),
        layout=ConstrainedLayoutEngine(w_pad=0.02, h_pad=0.02, wspace=0, hspace=0),
    )
    grid = figure.subplots(len(rows), len(domains), squeeze=False)
    for i, (name, row) in enumerate(rows):
        for j, domain in enumerate(domains):
            axes = grid[i, j]
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
            if domain in row:
                axes.imshow(row[domain], interpolation="nearest")
            else:
                axes.set_facecolor("#f1f3f5")
                axes.set_aspect("equal")
            if i == 0:
                axes.set_title(_domain_name(domain), loc="center", pad=4)
            if j == 0:
                words = _wrapped(name)
                size = 8.5 if max(map(len, words.split("\n"))) <= 15 else 7.0
                axes.set_ylabel(words, fontsize=size, fontweight="bold", color=INK)
    if title:
        figure.suptitle(title + "\n", x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _domain_name(domain: str) -> str:
    """A domain's short label; one that is long in lines that fit into a column."""
    return textwrap.fill(paper.domain_label(domain), 12, break_long_words=False)


def _wrapped(name: str) -> str:
    return name.replace(" w/o ", "\nw/o ") if len(name) > 12 else name


# ---------------------------------------------------------------------------------------------
# (g) What the worlds look like


@_styled
def picture_grid(
    pictures: Sequence[Sequence[ImageArray | None]],
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    title: str = "",
) -> Figure:
    """A contact sheet: pictures in rows and columns that have names.

    Args:
      pictures: [row][column] uint8 [h, w, 3], or None for an empty cell.
      rows, columns: their names; a line break starts a new line.
      title: above the figure.

    Raises:
      ValueError: the pictures are not as many as the names.
    """
    shape = [len(row) for row in pictures]
    if shape != [len(columns)] * len(rows):
        raise ValueError(
            f"expected {len(rows)} rows of {len(columns)} pictures, got rows of {shape}"
        )
    if not pictures or not columns:
        return _empty("no pictures to draw")
    cell, gap = 1.28, 0.04
    left = 0.22 + 0.072 * max(len(line) for name in rows for line in name.split("\n"))
    head = 0.16 + 0.16 * max(name.count("\n") + 1 for name in columns)
    top = head + (0.08 + 0.19 * (title.count("\n") + 1) if title else 0.0)
    width, height = left + cell * len(columns), top + cell * len(rows)
    figure = Figure(figsize=(width, height))
    for i, row in enumerate(pictures):
        for j, picture in enumerate(row):
            corner = (left + cell * j, height - top - cell * (i + 1) + gap)
            side = (cell - gap) / width, (cell - gap) / height
            axes = figure.add_axes((corner[0] / width, corner[1] / height, *side))
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
            if picture is None:
                axes.set_facecolor("#f1f3f5")
            else:
                axes.imshow(picture, interpolation="nearest", aspect="equal")
            if i == 0:
                axes.set_title(columns[j], loc="center", pad=4)
        middle = (height - top - cell * (i + 0.5)) / height
        figure.text(
            (left - 0.1) / width, middle, rows[i], ha="right", va="center", fontweight="bold"
        )
    if title:
        figure.suptitle(title, x=0.01, y=1 - 0.06 / height, ha="left", va="top",
                        fontweight="bold", fontsize=11)  # fmt: skip
    return figure
