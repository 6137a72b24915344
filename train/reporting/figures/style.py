"""What all figures have in common: colours, how a method is drawn, axes, saving."""

import functools
import io
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from palm_jax.train.files.metrics import write_atomic
from palm_jax.train.reporting import paper

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
    "roviaug-ultra": Look("#6B5E00", "p", (0, (3, 1, 1, 1))),
    "arro": Look("#4D4D4D", ">", (0, (1, 1))),
}
_SPARE = [Look("#882255", "h", "-."), Look("#117733", "p", "-."), Look("#332288", "*", "-.")]


def look(method: str) -> Look:
    """Colour, marker and dash of a method; an unknown name always gets the same spare look."""
    return _LOOKS.get(method) or _SPARE[sum(method.encode()) % len(_SPARE)]


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
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


def percent_axis(axes: Axes, *, label: str = "success", top: float = 1.04) -> None:
    """A y axis for shares from 0 to 1, in percent."""
    axes.set_ylim(0, top)
    axes.set_yticks(np.linspace(0, 1, 6), [f"{value:.0f}" for value in np.linspace(0, 100, 6)])
    axes.set_ylabel(f"{label} (%)")
    axes.grid(True, axis="y")


def outline(axes: Axes, x: tuple[float, float], y: tuple[float, float], **style: Any) -> Rectangle:
    """A rectangle over world x and y on a map whose axes are (y, x)."""
    box = Rectangle((y[0], x[0]), y[1] - y[0], x[1] - x[0], fill=False, **style)
    axes.add_patch(box)
    return box


def map_axes(axes: Axes, *, left: bool, bottom: bool = True) -> None:
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


def only_text(message: str) -> Figure:
    """A small figure that says why there is no other."""
    figure = Figure(figsize=(5.0, 1.2))
    figure.text(0.5, 0.5, message, ha="center", va="center", color=MUTED)
    return figure


def degree_label(value: float) -> str:
    """An angle in degrees as on an axis: with its sign, in whole degrees."""
    return f"{value:+.0f}°".replace("-", "−") if abs(value) > 0.5 else "0°"


def error_bars(rate: Array, lower: Array, upper: Array) -> Array:
    """Distances for `errorbar`; rounding must not make one negative."""
    return np.maximum(np.stack([rate - lower, upper - rate]), 0.0)


def domain_name(domain: str) -> str:
    """A domain's short label; one that is long in lines that fit into a column."""
    return textwrap.fill(paper.domain_label(domain), 12, break_long_words=False)
