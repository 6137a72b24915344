"""Figures show the numbers they are given: read back from the drawn artists, not from the code."""

import io
import math
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, QuadMesh
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image
from scipy import stats as scipy_stats

from palm_jax.train.files import records
from palm_jax.train.files.records import DomainRecord
from palm_jax.train.reporting import figures, grids

REGIONS = grids.Regions()


def texts(figure: Figure) -> list[str]:
    return [item.get_text() for item in figure.findobj(matplotlib.text.Text) if item.get_text()]


def panel() -> grids.Grid:
    """2 x 3 cells; the middle column holds the training region, one cell is empty."""
    return grids.Grid(
        np.array([0.15, 0.25, 0.35]),
        np.array([-0.3, -0.1, 0.1, 0.3]),
        np.array([[1.0, 3, 0], [2, 6, 0]]),
        np.array([[4.0, 4, 4], [4, 8, 0]]),
    )


def test_heatmap_shows_percent_counts_and_regions() -> None:
    figure = figures.heatmaps({"palm": panel(), "bc": panel()}, REGIONS, title="Lift")
    left = figure.axes[0]
    shown = [item.get_text() for item in left.texts]
    # 1/4 3/4 0/4 and 2/4 6/8; the empty cell has no number.
    assert shown == [
        "25", "1/4", "75", "3/4", "0", "0/4", "50", "2/4", "75", "6/8",
        "training region 75 %, outside 25 %",
    ]  # fmt: skip
    (mesh,) = left.findobj(QuadMesh)
    values = np.ma.filled(mesh.get_array(), -1).ravel()
    assert values.tolist() == [0.25, 0.75, 0.0, 0.5, 0.75, -1]
    assert (mesh.norm.vmin, mesh.norm.vmax) == (0, 1)
    assert figure.axes[1].get_title(loc="left") == "BC"
    assert "Lift" in texts(figure)


def test_heatmap_outlines_the_training_region_in_world_axes() -> None:
    figure = figures.heatmaps({"palm": panel()}, REGIONS)
    axes = figure.axes[0]
    boxes = [p for p in axes.patches if isinstance(p, Rectangle) and not p.get_hatch()]
    assert len(boxes) == 2  # a light one below the dashed one
    for box in boxes:
        # Horizontal is y in [-.1, .1], vertical is x in [.15, .35].
        np.testing.assert_allclose(box.get_bbox().extents, [-0.1, 0.15, 0.1, 0.35], atol=1e-12)
    (hatched,) = [p for p in axes.patches if p.get_hatch()]
    np.testing.assert_allclose(hatched.get_bbox().extents, [0.1, 0.25, 0.3, 0.35], atol=1e-12)
    low, high = axes.get_ylim()
    assert low > high, "x grows downwards, towards the camera"


def error_bars(axes: Axes) -> list[np.ndarray]:
    """[N, 2] (low, high) of each errorbar on the axes."""
    found = []
    for container in axes.containers:
        if hasattr(container, "has_yerr") and container.has_yerr:
            (bars,) = [c for c in container.lines[2] if isinstance(c, LineCollection)]
            found.append(np.array([segment[:, 1] for segment in bars.get_segments()]))
    return found


def scipy_wilson(good: Any, total: Any) -> np.ndarray:
    tests = [scipy_stats.binomtest(int(k), int(n)) for k, n in zip(good, total, strict=True)]
    limits = [test.proportion_ci(method="wilson") for test in tests]
    return np.array([[limit.low, limit.high] for limit in limits])


def test_angle_curve_points_and_intervals() -> None:
    angles = np.radians([-30.0, 0.0, 30.0])
    curves = {
        "palm": grids.Curve(angles, np.array([8.0, 10, 10]), np.full(3, 10.0)),
        "bc": grids.Curve(angles, np.array([0.0, 9, 5]), np.array([10.0, 10, 0]) + [0, 0, 10]),
    }
    axes = figures.angle_curves(curves, REGIONS).axes[0]
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_allclose(lines["PALM"].get_ydata(), [0.8, 1.0, 1.0])
    np.testing.assert_allclose(lines["BC"].get_ydata(), [0.0, 0.9, 0.5])
    for line in (lines["PALM"], lines["BC"]):
        np.testing.assert_allclose(line.get_xdata(), [-30, 0, 30], atol=0.5)
    palm, bc = error_bars(axes)
    np.testing.assert_allclose(palm, scipy_wilson([8, 10, 10], [10] * 3), atol=1e-12)
    np.testing.assert_allclose(bc, scipy_wilson([0, 9, 5], [10] * 3), atol=1e-12)


def test_angle_curve_leaves_out_angles_without_scenes() -> None:
    curve = grids.Curve(np.radians([-10.0, 10.0]), np.array([0.0, 2]), np.array([0.0, 4]))
    axes = figures.angle_curves({"palm": curve}, REGIONS).axes[0]
    line = next(line for line in axes.lines if line.get_label() == "PALM")
    np.testing.assert_allclose(line.get_ydata(), [0.5])


def test_strength_curves_have_a_panel_for_each_shift() -> None:
    at = np.array([-1.0, 0.0, 1.0])
    palm = grids.Curve(at, np.array([4.0, 8, 6]), np.full(3, 8.0))
    bc = grids.Curve(at, np.array([0.0, 8, 0]), np.array([8.0, 8, 0]))
    figure = figures.strength_curves(
        {"lighting": {"palm": palm, "bc": bc}, "object_color": {"palm": palm}, "fog": {}}
    )
    first, second = figure.axes
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["lighting", "object color"]
    lines = {line.get_label(): line for line in first.lines}
    np.testing.assert_allclose(lines["PALM"].get_ydata(), [0.5, 1, 0.75])
    np.testing.assert_allclose(lines["BC"].get_ydata(), [0, 1])  # a strength without scenes
    np.testing.assert_allclose(lines["PALM"].get_xdata(), at, atol=0.1)
    np.testing.assert_allclose(lines["BC"].get_xdata(), at[:2], atol=0.1)
    drawn = error_bars(second)[0]
    np.testing.assert_allclose(drawn, scipy_wilson([4, 8, 6], [8] * 3), atol=1e-12)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["PALM", "BC"]


def records_of(n: int, seed: int) -> DomainRecord:
    rng = np.random.default_rng(seed)
    return DomainRecord(
        rng.random(n) < 0.6,
        rng.random(n) < 0.1,
        rng.uniform((0.05, -0.35), (0.45, 0.35), (n, 2)).astype(np.float32),
        rng.uniform(-0.52, 0.52, n).astype(np.float32),
        np.full(n, 9, np.int32),
        np.ones(n, np.int32),
    )


def test_sample_distribution_marks_every_scene_once() -> None:
    domains = {"ID": records_of(7, 1), "workspace": records_of(9, 2), "V": records_of(20, 3)}
    figure = figures.sample_distribution({"bc": domains}, REGIONS)
    above, below = figure.axes
    drawn = {True: np.zeros((0, 2)), False: np.zeros((0, 2))}
    for marks in above.findobj(PathCollection):
        solved = to_hex(marks.get_facecolor()[0][:3]) == figures.GOOD.lower()
        drawn[solved] = np.concatenate([drawn[solved], np.asarray(marks.get_offsets())])
    for solved in (True, False):
        expected = np.concatenate(
            [r.object_xy[(r.success & ~r.nan) == solved][:, ::-1] for r in
             (domains["ID"], domains["workspace"])]
        )  # fmt: skip
        np.testing.assert_allclose(
            np.sort(drawn[solved], axis=0), np.sort(expected, axis=0), atol=1e-6
        )
    # 6 bins of successes, then 6 of failures on top; together every scene of V.
    heights = [bar.get_height() for bar in below.patches]
    view = domains["V"]
    assert len(heights) == 12 and sum(heights) == 20
    assert sum(heights[:6]) == (view.success & ~view.nan).sum()
    index = np.clip((np.degrees(view.camera_angle) + 30) // 10, 0, 5).astype(int)
    totals = np.bincount(index, minlength=6)
    np.testing.assert_array_equal(np.add(heights[:6], heights[6:]), totals)
    assert "camera angle   (V: 20 episodes)" in texts(figure)
    assert "y (m)   (ID and W: 16 episodes)" in texts(figure)


def test_scenes_that_only_some_policies_solved_have_a_mark_of_their_own() -> None:
    one, two = records_of(3, 1), records_of(3, 1)
    one.nan[:] = two.nan[:] = False
    one.success[:], two.success[:] = (True, False, True), (True, False, False)
    both = records.joined([one, two])
    figure = figures.sample_distribution({"bc": {"ID": both, "V": both}}, REGIONS)
    never, some, always = figure.axes[0].findobj(PathCollection)
    for marks, scene in ((always, 0), (never, 1), (some, 2)):
        np.testing.assert_allclose(marks.get_offsets(), one.object_xy[[scene]][:, ::-1], atol=1e-6)
    assert to_hex(some.get_facecolor()[0]) == "#ffffff"
    labels = [entry.get_text() for entry in figure.legends[0].get_texts()]
    assert labels[:3] == ["success", "of some seeds", "failure"]


COUNTS = {
    "palm": {"ID": {"successes": 24, "episodes": 24}, "W+V": {"successes": 18, "episodes": 24}},
    "bc": {"ID": {"successes": 12, "episodes": 24}, "W+V": {"successes": 0, "episodes": 24}},
    "mine": {"ID": {"successes": 6, "episodes": 24}},
}


def test_bars_intervals_and_the_papers_marks() -> None:
    axes = figures.domain_bars(COUNTS).axes[0]
    bars = [bar for bar in axes.patches if isinstance(bar, Rectangle)]
    assert [round(bar.get_height(), 6) for bar in bars] == [1.0, 0.75, 0.5, 0.0, 0.25]
    assert [to_hex(bar.get_facecolor()) for bar in bars[:4]] == ["#0072b2"] * 2 + ["#d55e00"] * 2
    centres = [bar.get_x() + bar.get_width() / 2 for bar in bars]
    np.testing.assert_allclose(centres, [-0.28, 0.72, 0, 1, 0.28], atol=1e-9)
    drawn = np.concatenate(error_bars(axes))
    expected = scipy_wilson([24, 18, 12, 0, 6], [24] * 5)
    np.testing.assert_allclose(drawn, expected, atol=1e-12)
    marks = [line for line in axes.lines if line.get_marker() == "D"]
    # Table I: PALM .72 and .72 * (1 - .00); BC .52 and .52 * (1 - .65).
    np.testing.assert_allclose(marks[0].get_ydata(), [0.72, 0.72])
    np.testing.assert_allclose(marks[1].get_ydata(), [0.52, 0.182])
    assert len(marks) == 2, "a method that is not in the paper has no mark"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["ID", "W+V"]


def test_long_domain_names_are_broken_into_lines() -> None:
    entry = {"successes": 1, "episodes": 2}
    counts = {"palm": {"in_domain": entry, "object_color+viewpoint": entry}}
    labels = [t.get_text() for t in figures.domain_bars(counts).axes[0].get_xticklabels()]
    assert labels == ["ID", "object color\n+ viewpoint"]


def test_many_methods_break_the_bars_into_two_rows() -> None:
    entry = {"successes": 1, "episodes": 2}
    counts = {f"m{i}": {d: entry for d in ("ID", "W", "V", "E", "WVE")} for i in range(5)}
    figure = figures.domain_bars(counts)
    names = [[t.get_text() for t in axes.get_xticklabels()] for axes in figure.axes]
    assert names == [["ID", "W", "V"], ["E", "All"]]


def test_training_curves_pick_what_is_there() -> None:
    log = [{"step": s, "loss": 1.0 / (s + 1), "grad_norm": None} for s in (0, 10, 20)]
    log += [{"step": 20, "loss": 0.5}, {"step": 30, "loss": math.nan}, {"loss": 7.0}]
    log += [{"step": 20, "success": 0.25}]
    figure = figures.training_curves({"palm": log, "bc": []})
    assert [axes.get_title(loc="left") for axes in figure.axes] == [
        "training loss",
        "in-domain success (%)",
    ]
    (line,) = figure.axes[0].lines
    np.testing.assert_allclose(line.get_xdata(), [0, 10, 20])
    np.testing.assert_allclose(line.get_ydata(), [1.0, 1 / 11, 0.5])  # the last record of a step


def test_long_logs_get_a_running_median() -> None:
    values = np.where(np.arange(200) % 7 == 0, 100.0, 1.0)  # spikes that a median ignores
    log = [{"step": i, "loss": float(v)} for i, v in enumerate(values)]
    faint, strong = figures.training_curves({"palm": log}).axes[0].lines
    np.testing.assert_array_equal(faint.get_ydata(), values)
    assert set(np.asarray(strong.get_ydata())[2:-2]) == {1.0}


def test_gallery_places_every_image() -> None:
    rng = np.random.default_rng(0)
    images = {
        m: {d: rng.integers(0, 255, (6, 6, 3), np.uint8) for d in ("W", "ID")}
        for m in ("palm", "bc")
    }
    frames = {"ID": rng.integers(0, 255, (12, 12, 3), np.uint8)}
    figure = figures.gallery(images, frames=frames)
    grid = np.array(figure.axes).reshape(3, 2)
    np.testing.assert_array_equal(grid[0, 0].images[0].get_array(), frames["ID"])
    assert not grid[0, 1].images
    for row, method in ((1, "palm"), (2, "bc")):
        for column, domain in ((0, "ID"), (1, "W")):
            shown = grid[row, column].images[0]
            np.testing.assert_array_equal(shown.get_array(), images[method][domain])
            assert shown.get_interpolation() == "nearest"


@pytest.mark.parametrize(
    "figure",
    [
        lambda: figures.heatmaps({}, REGIONS),
        lambda: figures.angle_curves({}, REGIONS),
        lambda: figures.strength_curves({"lighting": {}}),
        lambda: figures.sample_distribution({}, REGIONS),
        lambda: figures.domain_bars({"palm": {}}),
        lambda: figures.training_curves({"palm": []}),
        lambda: figures.gallery({}),
    ],
)
def test_nothing_to_draw_is_said(figure: Any) -> None:
    (message,) = texts(figure())
    assert message.startswith("no ") and message.endswith(" to draw")


def test_saving_is_repeatable_and_leaves_global_style_alone(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    first = figures.save(figures.domain_bars(COUNTS), tmp_path / "new" / "a.png", dpi=100)
    second = figures.save(figures.domain_bars(COUNTS), tmp_path / "new" / "b.png", dpi=100)
    assert first.read_bytes() == second.read_bytes()
    assert dict(matplotlib.rcParams) == before
    assert sorted(p.name for p in first.parent.iterdir()) == ["a.png", "b.png"]
    pixels = np.asarray(Image.open(io.BytesIO(first.read_bytes())).convert("RGB"))
    blue = (np.abs(pixels.astype(int) - [0, 0x72, 0xB2]).max(axis=-1) < 3).sum()
    assert blue > 2000, "PALM's bars are on the picture"


# Machado, Oliveira, Fernandes (2009), severity 1, on linear RGB.
_DEFICIENCIES = {
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
               [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
               [-0.011820, 0.042940, 0.968881]],
}  # fmt: skip


@pytest.mark.parametrize("kind", list(_DEFICIENCIES))
def test_the_pairs_that_matter_stay_apart_without_red_green_vision(kind: str) -> None:
    def seen(colour: str) -> np.ndarray:
        rgb = np.array(to_rgb(colour))
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        return np.clip(np.array(_DEFICIENCIES[kind]) @ linear, 0, 1)

    palm, bc = figures.look("palm").colour, figures.look("bc").colour
    for one, other in ((palm, bc), (figures.GOOD, figures.BAD)):
        assert np.linalg.norm(seen(one) - seen(other)) > 0.3


def test_every_method_is_told_apart_by_more_than_colour() -> None:
    from palm_jax.train.reporting.paper import METHODS

    looks = [figures.look(method) for method in METHODS]
    assert len({look.colour for look in looks}) == len(METHODS)
    assert len({look.marker for look in looks}) == len(METHODS)
    assert figures.look("mine") == figures.look("mine")


def test_picture_grid_shows_each_picture_in_its_place() -> None:
    def flat(level: int) -> np.ndarray:
        return np.full((4, 4, 3), level, np.uint8)

    pictures = [[flat(10), None, flat(30)], [flat(40), flat(50), flat(60)]]
    figure = figures.picture_grid(pictures, ["lift lid\nur5", "b"], ["x", "y", "z"], title="All")
    assert {"lift lid\nur5", "b", "x", "y", "z", "All"} <= set(texts(figure))
    at = {}
    for axes in figure.axes:
        box = axes.get_position()
        shown = [int(np.asarray(image.get_array())[0, 0, 0]) for image in axes.images]
        at[round(box.x0, 3), round(box.y0, 3)] = shown
    lefts = sorted({x for x, _ in at})
    top, bottom = sorted({y for _, y in at}, reverse=True)
    assert [at[x, top] for x in lefts] == [[10], [], [30]]
    assert [at[x, bottom] for x in lefts] == [[40], [50], [60]]


def test_labels_of_a_picture_grid_lie_inside_the_figure() -> None:
    picture = np.zeros((4, 4, 3), np.uint8)
    name = "calibration translation"
    figure = figures.picture_grid([[picture]], [name], ["workspace +\nviewpoint"], title="a\nb")
    figure.draw_without_rendering()
    for item in figure.findobj(matplotlib.text.Text):
        if item.get_text() in (name, "workspace +\nviewpoint"):
            box = item.get_window_extent()
            assert box.x0 >= 0 and box.y1 <= figure.bbox.y1
            assert box.x1 <= figure.bbox.x1 and box.y0 >= 0


def test_picture_grid_refuses_rows_of_another_length() -> None:
    with pytest.raises(ValueError, match=r"expected 2 rows of 1 pictures, got rows of \[1, 2\]"):
        figures.picture_grid([[None], [None, None]], ["a", "b"], ["x"])
