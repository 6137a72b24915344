"""`python -m benchmarks.page FILE.json docs/performance.md`: a result of `bench all` as tables.

Replaces what stands between the page's two markers, and draws `cost.png` beside the page's images.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot
from matplotlib.figure import Figure

BEGIN, END = "<!-- measured: python -m benchmarks.page -->", "<!-- measured: end -->"
_OURS = "palm_jax"

Row = dict[str, dict[str, float]]  # package -> its figures


def _number(value: float | None, *, unit: str = "") -> str:
    if value is None:
        return "-"
    digits = 0 if value >= 100 else 1 if value >= 1 else 4
    return f"{value:,.{digits}f}".replace(",", " ") + unit


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _beside(what: str, rows: dict[str, Row]) -> str:
    """A row for each setting, a column for each package: medians of things a second."""
    packages = list(dict.fromkeys(name for row in rows.values() for name in row))
    body = [
        [name, *(_number(row.get(p, {}).get("per_second_median")) for p in packages)]
        for name, row in rows.items()
    ]
    return table([what, *packages], body)


def _render(found: dict[str, Any]) -> Iterator[str]:
    scene, alone = found["bench_lift_spam"], found["bench_render"]
    yield "### Rendering, frames a second"
    yield (
        f"Windows of 84 x 84 pixels round the TCP, `lift_spam` ({scene['geoms']} primitives, "
        f"{scene['lights']} lights), 64 worlds:"
    )
    windows = {**scene["windows"], "window, overlay and proprioception": scene["observations"]}
    yield table(
        ["", "frames a second"],
        [[name, _number(row["per_second_median"])] for name, row in windows.items()],
    )
    yield "Whole frames, the same model, camera and lights for everyone:"
    yield _beside("", scene["beside"])
    same = [
        figures["same_geom"]
        for row in scene["beside"].values()
        for name, figures in row.items()
        if name != _OURS
    ]
    if same:
        yield (
            "All show the same geom as ours in at least "
            f"{100 * min(same):.2f} % of the pixels away from edges."
        )
    yield f"A synthetic arm over a table, {alone['geoms']} primitives, 64 worlds, 84 x 84 windows:"
    names = ("rgb", "rgb_with_shadows", "rgb_depth_segmentation", "segmentation")
    yield table(
        ["", "frames a second", "compilation (s)", "temporary memory (MiB)"],
        [
            [
                name.replace("_", " "),
                _number(alone[name]["per_second_median"]),
                _number(alone[name]["compile_seconds"]),
                _number(alone[name].get("temporary_mib")),
            ]
            for name in names
        ],
    )
    if "scaling" in alone:
        yield "![What a frame costs](images/cost.png)"


def _physics(found: dict[str, Any]) -> Iterator[str]:
    physics = found["bench_physics"]
    yield "### Physics, steps of 5 ms a second"
    rows = []
    for robot, tasks in physics["robots"].items():
        for task, row in tasks.items():
            ours, theirs = (row[n]["per_second_median"] for n in ("mjx", "mujoco.rollout"))
            rows.append(
                [f"`{task}`, {robot}", _number(ours), _number(theirs), f"{theirs / ours:.1f}"]
            )
    worlds = f"{max(physics['by_worlds'], key=int)} worlds"
    yield table([worlds, _OURS, "C MuJoCo (`mujoco.rollout`)", "C is faster by"], rows)
    plain, compiled = physics["plain_mjx"]["per_second_median"], physics["compile"]
    yield (
        f"`jax.jit(jax.vmap(mjx.step))` with default options, one world: {_number(plain)} steps a "
        f"second. First reset and step of a process (`{compiled['task']}`, {compiled['worlds']} "
        f"worlds): {compiled['cold_seconds']:.0f} s, with cached programs "
        f"{compiled['warm_seconds']:.1f} s."
    )


def _align(found: dict[str, Any]) -> Iterator[str]:
    align = found["bench_align"]
    yield "### Alignment and augmentation, images a second"
    for batch, rows in align["operations"].items():
        yield _beside(f"batch of {batch}", rows)
    yield "Ours alone, batches of 64 images of 84 x 84 pixels:"
    yield table(
        ["", "images a second"],
        [[f"`{name}`", _number(row["per_second_median"])] for name, row in align["ours"].items()],
    )


def _train(found: dict[str, Any]) -> Iterator[str]:
    train = found["bench_train"]
    yield "### Training, samples a second"
    rows = {f"width {width}": row for width, row in train["steps"].items()}
    yield _beside(f"{train['pixels']} px, batch of {train['batch_size']}", rows)
    acts = ", ".join(
        f"{_number(row['per_second_median'])} with batches of {count}"
        for count, row in train["act"].items()
    )
    yield f"Width 16 acts at {acts} (images a second)."


def _eval(found: dict[str, Any]) -> Iterator[str]:
    result = found["bench_eval"]
    parts = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in result["parts"].items())
    yield "### Evaluation"
    yield (
        f"`{result['task']}`, {len(result['domains'])} domains x {result['scenes']} scenes x "
        f"{result['horizon']} steps, no episode solved: {result['seconds']:.0f} s after "
        f"compilation ({parts}); the first time, {result['first_call_seconds']:.0f} s more."
    )


SECTIONS = {
    "render": _render,
    "physics": _physics,
    "align": _align,
    "train": _train,
    "eval": _eval,
}


def text(result: dict[str, Any]) -> str:
    """What goes between the markers."""
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    load = "" if not result["load"] else f", load {result['load'][0]:.1f} before the first"
    parts = [
        f"{result['machine']}{load}, {result['date']}. {versions}. Medians of at least ten runs "
        "after a warm-up; packages take turns."
    ]
    for name, section in SECTIONS.items():
        if result["details"].get(name):
            parts += section(result["details"][name])
    return "\n\n".join(parts)


def draw(scaling: dict[str, dict[str, float]]) -> Figure:
    """Seconds a frame against worlds, pixels and primitives, log-log, with lines of slope one."""
    figure, axes = pyplot.subplots(1, len(scaling), figsize=(10, 3.2), layout="constrained")
    for panel, (what, seconds) in zip(axes, scaling.items(), strict=True):
        x = [float(count) for count in seconds]
        y = [1e3 * value for value in seconds.values()]
        panel.loglog(x, y, "o-", color="C0", label="measured")
        panel.loglog(x, [y[0] * value / x[0] for value in x], "--", color="0.6", label="linear")
        panel.set_xlabel(what)
        panel.set_xticks(x, [f"{value:g}" for value in x], minor=False)
        panel.minorticks_off()
    axes[0].set_ylabel("milliseconds a batch")
    axes[0].legend(frameon=False)
    return figure


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if len(words) != 2:
        print("usage: python -m benchmarks.page FILE.json PAGE.md", file=sys.stderr)
        return 2
    result, page = json.loads(Path(words[0]).read_text()), Path(words[1])
    before, begin, rest = page.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        print(f"{page}: expected the markers {BEGIN!r} and {END!r}; add them", file=sys.stderr)
        return 1
    page.write_text(f"{before}{BEGIN}\n\n{text(result)}\n\n{END}{after}")
    scaling = result["details"].get("render", {}).get("bench_render", {}).get("scaling")
    if scaling:
        images = page.parent / "images"
        images.mkdir(exist_ok=True)
        draw(scaling).savefig(images / "cost.png", dpi=140)
    return 0


if __name__ == "__main__":
    sys.exit(main())
