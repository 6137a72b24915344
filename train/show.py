"""`python -m palm_jax show`: pictures of every world, as PNG.

* `worlds.png`: the start of an episode, every task on every robot under every domain;
* `robots.png`: every robot from several sides, and as a policy sees its hand;
* `TASK.png`: the expert's episode on every robot, with the moments before each change of stage;
* `axes.png`: each single shift from its least to its greatest strength, for one task;
* `methods.png`: what every method sees of that task's scene in each of the paper's domains, those
  with another robot on the second of the robots.
"""

import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from palm_jax.align import AlignSpec
from palm_jax.envs import registry, shifts
from palm_jax.envs.base import Env, EnvParams, State
from palm_jax.envs.rollout import Runner
from palm_jax.envs.tasks import Stage
from palm_jax.train import methods
from palm_jax.train.reporting import console as terminal
from palm_jax.train.reporting import figures

T = TypeVar("T")
Seen = dict[str, list[figures.ImageArray]]
"""Who sees a scene -> a picture for each domain."""

DOMAINS = (
    "in_domain",
    "workspace",
    "viewpoint",
    "workspace+viewpoint",
    "lighting",
    "table_texture",
    "object_color",
    "field_of_view",
    "distractors",
)
"""Columns of `worlds.png`. The robots are its rows, so no domain needs the embodiment."""

STRENGTHS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_CALIBRATION = "calibration"  # axes that begin so change what a policy sees, not what a camera does
_WINDOW = 84

_SEEN = (
    ("in_domain", "workspace", "viewpoint", "workspace+viewpoint"),
    (
        "embodiment", "workspace+embodiment", "viewpoint+embodiment",
        "workspace+viewpoint+embodiment",
    ),
)  # fmt: skip
"""Columns of `methods.png`: with the first robot, with the second."""

VIEWS = {
    "from the front": ((1.3, 0.1, 1.45), (0.0, 0.0, 1.05)),
    "from the left": ((0.15, 1.35, 1.25), (0.1, 0.0, 1.05)),
    "from the right": ((0.85, -0.95, 1.5), (0.05, 0.0, 1.05)),
    "the hand": ((0.75, 0.2, 1.1), (0.25, 0.0, 1.0)),
}
"""Columns of `robots.png` but the last: where the camera is and what it looks at, metres."""


@dataclasses.dataclass(frozen=True)
class ShowConfig:
    """Pictures of the worlds: worlds, robots, axes, methods and one more PNG for each task.

    Attributes:
      tasks: names; all of them if empty.
      robots: names; all of them if empty.
      domains: columns of worlds.png; those without the embodiment and one for each axis if empty.
      out: folder for the PNG files.
      size: side of each picture in pixels.
      seed: of the scene, the same in every column.
    """

    tasks: tuple[str, ...] = ()
    robots: tuple[str, ...] = ()
    domains: tuple[str, ...] = ()
    out: Path = Path("docs/images")
    size: int = 192
    seed: int = 0


class ShowError(ValueError):
    """A command that cannot be run."""


def checked(config: ShowConfig) -> ShowConfig:
    """`config` with every list filled in.

    Raises:
      ShowError: an unknown task, robot or domain (the message lists the known ones), or a size of
        no pixels.
    """
    for kind, names, known in (
        ("task", config.tasks, registry.TASKS),
        ("robot", config.robots, registry.ROBOTS),
    ):
        for name in names:
            if name not in known:
                raise ShowError(f"unknown {kind} {name!r}; known: {', '.join(known)}")
    for domain in config.domains:
        try:
            elsewhere = shifts.other_robot(domain)
        except ValueError as error:
            raise ShowError(str(error)) from error
        if elsewhere:
            raise ShowError(f"domain {domain!r}: the robots are rows here; see --robots")
    if config.size < 16:
        raise ShowError(f"expected pictures of at least 16 pixels, got --size {config.size}")
    return dataclasses.replace(
        config,
        tasks=config.tasks or tuple(registry.TASKS),
        robots=config.robots or tuple(registry.ROBOTS),
        domains=config.domains or DOMAINS,
    )


# -- one world -------------------------------------------------------------------------------------


class Studio:
    """Takes pictures of one task on one robot.

    Args:
      env: the environment.
      worlds: pictures taken at once.
      size: their side in pixels.
    """

    def __init__(self, env: Env, worlds: int, size: int) -> None:
        self.env, self.runner = env, Runner(env, worlds)

        def picture(state: State, params: EnvParams) -> jax.Array:
            rgb = env.render(state, params, size).rgb
            assert rgb is not None
            return rgb

        self._picture = jax.jit(jax.vmap(picture))

    def starts(
        self, seed: int, params: Sequence[EnvParams], *, seen_by: methods.Method | None = None
    ) -> list[figures.ImageArray]:
        """The start of one and the same scene under each of `params`.

        Args:
          seed: of the scene.
          params: of one world each.
          seen_by: whose policy's image to show instead of the frame.
        """
        worlds, taken = self.runner.worlds, []
        keys = jnp.broadcast_to(jax.random.key(seed), (worlds,))
        for batch in _batches(params, worlds):
            stacked = _stack(batch)
            state = self.runner.reset(keys, stacked)
            if seen_by:
                spec = seen_by.spec(self.env.task, _WINDOW)
                images = self.runner.observe(state, stacked, spec, frame=seen_by.frame).image
            else:
                images = self._picture(state, stacked)
            taken += list(np.asarray(images))
        return taken[: len(params)]

    def expert(self, seed: int) -> tuple[list[figures.ImageArray], list[str]]:
        """Pictures of an episode of the expert in the training region, and what they show.

        Of the episodes that it tries, the first one solved.
        """
        worlds, runner = self.runner.worlds, self.runner
        params = _stack([self.env.default_params()] * worlds)
        state = runner.reset(jax.random.split(jax.random.key(seed), worlds), params)
        states = [state]
        for _ in range(self.env.task.horizon):
            state = runner.step(state, runner.expert(state), params)
            states.append(state)
            if bool(np.all(state.success | state.nan)):
                break
        world = int(np.argmax(np.asarray(state.success & ~state.nan)))
        success = [bool(state.success[world]) for state in states]
        end = success.index(True) if any(success) else len(states) - 1
        stage = [int(state.stage[world]) for state in states[: end + 1]]
        steps, labels = moments(stage, self.env.task.stages)
        taken = []
        for batch in _batches(steps, worlds):
            rows = [jax.tree.map(lambda leaf: leaf[world], states[step]) for step in batch]
            taken += list(np.asarray(self._picture(_stack(rows), params)))
        return taken[: len(steps)], labels

    def portraits(self, seed: int) -> list[figures.ImageArray]:
        """The start of a scene in each of `VIEWS`, and what PALM sees of it."""
        worlds, runner, method = self.runner.worlds, self.runner, methods.PALM
        params = _stack([self.env.default_params()] * worlds)
        state = runner.reset(jnp.broadcast_to(jax.random.key(seed), (worlds,)), params)
        one = jax.tree.map(lambda leaf: leaf[0], state)
        taken = []
        for batch in _batches([looking_at(*view) for view in VIEWS.values()], worlds):
            rows = [dataclasses.replace(one, camera_to_world=jnp.asarray(pose)) for pose in batch]
            taken += list(np.asarray(self._picture(_stack(rows), params)))
        spec = method.spec(self.env.task, _WINDOW)
        seen = runner.observe(state, params, spec, frame=method.frame).image
        return [*taken[: len(VIEWS)], np.asarray(seen[0])]

    def close(self) -> None:
        """Forgets all compiled programs, so that many worlds take no more memory than one."""
        jax.clear_caches()


def moments(stage: Sequence[int], stages: Sequence[Stage]) -> tuple[list[int], list[str]]:
    """Which steps of an episode to show, and what to call them.

    The start, the last moment of every stage but the final one, the end; of a task with one stage
    the middle instead.

    Args:
      stage: after each of the steps, the start first.
      stages: the task's; of more than one, picking and placing take turns.
    """
    end = len(stage) - 1
    if len(stages) == 1:
        return [0, end // 2, end], ["start", "middle", "end"]
    steps, labels = [0], ["start"]
    several = len(stages) > 2
    for index in range(len(stages) - 1):
        if index + 1 in stage:
            steps.append(stage.index(index + 1) - 1)
            what = "picked" if stages[index].open_hand else "placed"
            labels.append(f"{what} {index // 2 + 1}" if several else what)
    return [*steps, end], [*labels, "end"]


def looking_at(eye: Sequence[float], target: Sequence[float]) -> np.ndarray:
    """Pose [4, 4] of a level camera at `eye` that has `target` in its middle."""
    forward = np.subtract(target, eye)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right = right / np.linalg.norm(right)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
    pose[:3, 3] = eye
    return pose


def _batches(items: Sequence[T], size: int) -> Iterator[list[T]]:
    """Lists of `size`, the last one filled up with its last item."""
    for first in range(0, len(items), size):
        part = list(items[first : first + size])
        yield part + part[-1:] * (size - len(part))


def _stack(trees: Sequence[T]) -> T:
    """Pytrees of one world as one with a leading axis."""
    stacked: T = jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
    return stacked


# -- the files -------------------------------------------------------------------------------------


def show(config: ShowConfig, console: terminal.Console) -> list[Path]:
    """Writes all of the pictures; returns their files. `config` is a `checked` one."""
    rows: list[str] = []
    starts: list[list[figures.ImageArray | None]] = []
    files: list[Path] = []
    portraits: dict[str, list[figures.ImageArray]] = {}
    seen: dict[str, Seen] = {}
    total = len(config.tasks) * len(config.robots) + 1
    with terminal.ProgressBar(console, total, "pictures", unit="world") as bar:
        for task in config.tasks:
            strips = {}
            for robot in config.robots:
                studio = Studio(registry.make(task, robot), len(config.domains), config.size)
                params = studio.env.default_params()
                shifted = [shifts.shifted(params, domain) for domain in config.domains]
                starts.append([*studio.starts(config.seed, shifted)])
                rows.append(f"{_words(task)}\n{robot}")
                strips[robot] = studio.expert(config.seed)
                if robot not in portraits:
                    portraits[robot] = studio.portraits(config.seed)
                if task == config.tasks[0] and len(seen) < len(_SEEN):
                    seen[robot] = _seen(studio, config.seed, _SEEN[len(seen)])
                if not files:
                    files.append(_axes(studio, config))
                    bar.advance()
                studio.close()
                bar.advance()
            files.append(_episodes(task, strips, config.out))
    files.append(_methods(seen, config.tasks[0], config.out))
    columns = [_words(domain) for domain in config.domains]
    title = "One scene of every task on every robot, under shifts at full strength"
    figure = figures.picture_grid(starts, rows, columns, title=title)
    worlds = figures.save(figure, config.out / "worlds.png")
    return [worlds, _robots(portraits, config.out), *files]


def _robots(portraits: Mapping[str, Sequence[figures.ImageArray]], out: Path) -> Path:
    """`robots.png` from each robot's pictures."""
    figure = figures.picture_grid(
        list(portraits.values()), list(portraits), [*VIEWS, "PALM sees"], title="The robots"
    )
    return figures.save(figure, out / "robots.png")


def _episodes(
    task: str, strips: Mapping[str, tuple[list[figures.ImageArray], list[str]]], out: Path
) -> Path:
    """`TASK.png` from each robot's pictures and their labels."""
    labels = max((labels for _, labels in strips.values()), key=len)
    pictures = [
        [taken[had.index(label)] if label in had else None for label in labels]
        for taken, had in strips.values()
    ]
    title = f"{_words(task).capitalize()}: the expert"
    figure = figures.picture_grid(pictures, list(strips), labels, title=title)
    return figures.save(figure, out / f"{task}.png")


def _axes(studio: Studio, config: ShowConfig) -> Path:
    """`axes.png`: one scene of one task at every strength of every single shift."""
    pictures: list[list[figures.ImageArray | None]] = []
    default = studio.env.default_params()
    names = (*shifts.SHIFTS, *shifts.AXES)
    for name in names:
        low, high = shifts.strength_range(name)
        allowed = [low <= strength <= high for strength in STRENGTHS]
        params = [
            shifts.shifted(default, name, strength=strength)
            for strength, fits in zip(STRENGTHS, allowed, strict=True)
            if fits
        ]
        seen_by = methods.PALM if name.startswith(_CALIBRATION) else None
        taken = iter(studio.starts(config.seed, params, seen_by=seen_by))
        pictures.append([next(taken) if fits else None for fits in allowed])
    task = _words(studio.env.task.name)
    figure = figures.picture_grid(
        pictures,
        [_words(name) for name in names],
        [f"{strength:+g}" if strength else "0" for strength in STRENGTHS],
        title=f"Every single shift by strength: one scene of {task}, {studio.env.robot.name}\n"
        "(calibration: the policy's window with its overlay)",
    )
    return figures.save(figure, config.out / "axes.png")


def _seen(studio: Studio, seed: int, domains: Sequence[str]) -> Seen:
    """One scene as the camera and all methods see it; methods that see the same share an entry."""
    default, task = studio.env.default_params(), studio.env.task
    params = [shifts.shifted(default, domain) for domain in domains]
    alike: dict[tuple[AlignSpec, int], list[methods.Method]] = {}
    for method in methods.METHODS.values():
        # How the rest of the input looks does not show.
        spec = dataclasses.replace(method.spec(task, _WINDOW), layout="z")
        alike.setdefault((spec, method.frame), []).append(method)
    seen = {"the camera": studio.starts(seed, params)}
    for row in alike.values():
        name = "\n".join(method.name for method in row)
        seen[name] = studio.starts(seed, params, seen_by=row[0])
    return seen


def _methods(seen: Mapping[str, Seen], task: str, out: Path) -> Path:
    """`methods.png`, from what is seen with the first robot and, if there is one, the second."""
    columns: list[str] = []
    rows: dict[str, list[figures.ImageArray | None]] = {}
    for domains, (robot, by_row) in zip(_SEEN, seen.items(), strict=False):
        columns += [f"{_words(domain)}\n({robot})" for domain in domains]
        for name, pictures in by_row.items():
            rows.setdefault(name, []).extend(pictures)
    title = f"What methods see: one scene of {_words(task)}"
    figure = figures.picture_grid(list(rows.values()), list(rows), columns, title=title)
    return figures.save(figure, out / "methods.png")


def _words(name: str) -> str:
    """`in_domain` -> `in domain`, `a+b` in two lines."""
    return name.replace("_", " ").replace("+", " +\n")


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    config = tyro.cli(ShowConfig, args=argv, prog="python -m palm_jax show")
    console = terminal.make_console()
    try:
        for file in show(checked(config), console):
            console.print(str(file), markup=False)
    except (ShowError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
