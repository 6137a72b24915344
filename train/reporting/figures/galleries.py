"""Pictures in rows and columns: what policies see, and what the worlds look like."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from palm_jax.train.reporting import paper
from palm_jax.train.reporting.figures.style import (
    INK,
    ImageArray,
    domain_name,
    only_text,
    styled,
)


@styled
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
        return only_text("no images to draw")
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
                axes.set_title(domain_name(domain), loc="center", pad=4)
            if j == 0:
                words = _wrapped(name)
                size = 8.5 if max(map(len, words.split("\n"))) <= 15 else 7.0
                axes.set_ylabel(words, fontsize=size, fontweight="bold", color=INK)
    if title:
        figure.suptitle(title + "\n", x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _wrapped(name: str) -> str:
    return name.replace(" w/o ", "\nw/o ") if len(name) > 12 else name


@styled
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
        return only_text("no pictures to draw")
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
