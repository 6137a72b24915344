"""Success in each domain, as bars."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from palm_jax.train.reporting import paper
from palm_jax.train.reporting.figures.style import (
    FAINT,
    INK,
    domain_name,
    error_bars,
    look,
    only_text,
    percent_axis,
    styled,
)
from palm_jax.train.reporting.stats import success_rate, wilson_interval


@styled
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
        return only_text("no evaluation to draw")
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
        axes.set_xticks(range(len(shown)), [domain_name(name) for name in shown])
        axes.tick_params(axis="x", length=0, labelsize=9, labelcolor=INK)
        percent_axis(axes)
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
                label="implied by the paper's Table I (its 4 tasks)",
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
        yerr=error_bars(rate, lower, upper),
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
