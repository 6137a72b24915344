"""Curves: success over the camera angle or a shift's strength, and a training."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from palm_jax.train.reporting import paper
from palm_jax.train.reporting.figures.style import (
    MUTED,
    Array,
    degree_label,
    error_bars,
    look,
    only_text,
    percent_axis,
    styled,
)
from palm_jax.train.reporting.grids import Curve, Regions
from palm_jax.train.reporting.stats import success_rate, wilson_interval


@styled
def angle_curves(curves: Mapping[str, Curve], regions: Regions, *, title: str = "") -> Figure:
    """Success against the camera angle, methods overlaid, with intervals.

    Args:
      curves: method -> counts at camera angles.
      regions: marks the training angle and the test range.
      title: above the axes.
    """
    if not curves:
        return only_text("no camera angles to draw")
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
    axes.set_xticks(ticks, [degree_label(tick) for tick in ticks])
    axes.set_xlabel("camera angle about the workspace centre   (shaded: test range)")
    _curve_legend(figure, curves)
    if title:
        axes.set_title(title, pad=14)
    return figure


@styled
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
        return only_text("no strengths to draw")
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
            yerr=error_bars(rate, lower, upper),
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
    percent_axis(axes)


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


# Which metrics get a panel: title -> accepted names, best first; the scale of the axis.
_PANELS: dict[str, tuple[tuple[str, ...], str]] = {
    "training loss": (("loss", "train/loss", "train_loss"), "log"),
    "validation loss": (("val_loss", "val/loss", "validation_loss"), "log"),
    "in-domain success (%)": (("in_domain_success", "success", "eval/success"), "percent"),
    "gradient norm": (("grad_norm", "train/grad_norm", "norm/grads"), "log"),
    "learning rate": (("learning_rate", "lr", "train/lr"), "linear"),
    "R² per action": (("r2", "r2_mean"), "linear"),
}


@styled
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
        return only_text("no metrics to draw")
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
            percent_axis(axes)
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
