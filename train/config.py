"""What a training command is told: a frozen dataclass, a preset and the command line."""

import abc
import dataclasses
import difflib
import math
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Self, TypeVar

import tyro

from palm_jax.envs.registry import ROBOTS, TASKS
from palm_jax.envs.shifts import AXES, DOMAINS, EMBODIMENT, SHIFTS, parts
from palm_jax.train import methods
from palm_jax.train.data.recording import LEAST_IN_VIEW
from palm_jax.train.learner import LearnerConfig

AnyConfig = TypeVar("AnyConfig", bound="Learning")

SELECTION_SEED = 500
"""Of the scenes that score checkpoints: never those of an evaluation."""


class ConfigError(ValueError):
    """A command that cannot be run; the message says what was expected, what came, what to do."""


@dataclasses.dataclass(frozen=True)
class Learning(abc.ABC):
    """What a training is told whatever its data are.

    Attributes:
      task: what to learn.
      method: one or more methods; with several, each gets a folder of its own inside `out`.
      preset: where the defaults come from: quick, cpu or paper.
      seed: of training. Demonstrations and evaluation scenes have seeds of their own.
      out: the run folder; by default one in runs/ that is named after the main options.
      resume: go on with the run in `out`.
      take_over: also if a process on another machine has claimed `out`: only if it is gone.
      other_versions: also where packages have other versions than when it was begun.
      data: demonstrations to use (made if the file does not exist); by default inside `out`. With
        --calibration: recordings of any robot, a robomimic file or a LeRobot folder.
      image_size: side of the policy's image in pixels, before the random crop.
      random_crop: side of the random crop in pixels (centre crop when acting).
      width: base width of the ResNet-18; the paper's is 64.
      norm: group or batch.
      steps: updates, if epochs is not given.
      epochs: passes over the demonstrations: as many updates, whatever a method makes of them.
      batch_size: samples an update.
      learning_rate: of Adam, after the warm-up.
      schedule: cosine or constant.
      warmup_steps: updates of linear warm-up.
      weight_decay: decoupled; 0 for none.
      ema: decay of the averaged parameters that act; 0 for none.
      overlay_warmup: updates before Random Overlay starts.
      perspective: distortion of the random perspective; the paper's is 0.2.
      turn: largest pan and tilt (degrees) of the random camera turn, another perspective that the
        rotation input follows; 0 0 for none, as in the paper.
      backgrounds: a folder of your own images for Random Overlay; procedural textures by default.
      checkpoint_every: updates between checkpoints.
      keep: checkpoints kept, by score.
    """

    task: str = "lift_lid"
    method: tuple[str, ...] = ("palm", "bc")
    preset: str = "quick"
    seed: int = 0
    out: Path | None = None
    resume: bool = False
    take_over: bool = False
    other_versions: bool = False
    data: Path | None = None
    image_size: int = 64
    random_crop: int = 58
    width: int = 16
    norm: str = "group"
    steps: int = 2400
    epochs: float | None = None
    batch_size: int = 32
    learning_rate: float = 1e-3
    schedule: str = "cosine"
    warmup_steps: int = 100
    weight_decay: float = 0.0
    ema: float = 0.99
    overlay_warmup: int = 800
    perspective: float = 0.2
    turn: tuple[float, float] = (0.0, 0.0)
    backgrounds: Path | None = None
    checkpoint_every: int = 600
    keep: int = 3

    def on(self, samples: int) -> Self:
        """What this says of a training on so many demonstrated samples: `epochs` become `steps`."""
        if self.epochs is None:
            return self
        steps = max(1, math.ceil(self.epochs * samples / self.batch_size))
        return dataclasses.replace(self, steps=steps, epochs=None)

    def learner(self, method: methods.Method) -> LearnerConfig:
        """The learner's configuration for a method: the same for all, but for augmentation."""
        return LearnerConfig(
            width=self.width,
            norm=self.norm,
            crop=self.random_crop,
            batch_size=self.batch_size,
            steps=self.steps,
            learning_rate=self.learning_rate,
            schedule=self.schedule,
            warmup_steps=self.warmup_steps,
            weight_decay=self.weight_decay,
            ema=self.ema,
            overlay_fraction=0.5 if method.augment else 0.0,
            overlay_warmup_steps=self.overlay_warmup,
            perspective_distortion=self.perspective,
            perspective_probability=0.5 if method.augment else 0.0,
            turn=(math.radians(self.turn[0]), math.radians(self.turn[1]))
            if method.augment
            else (0.0, 0.0),
            turn_proprio=method.layout.startswith("cam6d"),
        )

    def check(self) -> None:
        """Raises ConfigError for values that cannot work."""
        for method in self.method:
            _known("method", method.split("+"), methods.METHODS)
        for name in ("steps", "checkpoint_every", "keep"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.epochs is not None and not 0 < self.epochs < math.inf:
            raise ConfigError(f"epochs: expected more than 0, got {self.epochs}")
        if self.random_crop > self.image_size:
            raise ConfigError(
                f"random_crop: expected at most image_size = {self.image_size}, "
                f"got {self.random_crop}"
            )
        if self.backgrounds is not None and not self.backgrounds.is_dir():
            raise ConfigError(f"backgrounds: {self.backgrounds} is not a folder")
        if not all(0 <= angle <= 80 for angle in self.turn):
            raise ConfigError(f"turn: expected degrees from 0 to 80, got {self.turn}")
        try:
            for method in self.method:
                self.learner(methods.find(method))
        except ValueError as error:
            raise ConfigError(str(error)) from error

    @abc.abstractmethod
    def folder_name(self) -> str:
        """Of the run folder in runs/ where none is given."""


@dataclasses.dataclass(frozen=True)
class Config(Learning):
    """Train policies in the simulator and evaluate them under distribution shift.

    With --calibration FILE the data are recordings of a robot, and nothing is simulated: see
    --calibration FILE --help.

    Attributes:
      robot: which arm demonstrates.
      other_robot: the arm of `embodiment` domains; by default the first other one there is.
      demos: number of demonstrations.
      demo_seed: of the demonstrations.
      demo_noise: disturbance while demonstrating, metres (standard deviation).
      select_from: share of the training after which checkpoints are scored in-domain.
      select_scenes: in-domain scenes that score a checkpoint.
      scenes: evaluation scenes in each domain.
      eval_seed: of the evaluation scenes.
      domains: evaluation domains: in_domain, and shifts joined by +.
      videos: episodes filmed for each outcome (success, failure) and method.
      sweep: draw the success heatmaps and camera-angle curves after training.
      distributed: train in several processes: auto, or HOST:PORT,COUNT,INDEX (docs/scaling.md).
    """

    robot: str = "panda"
    other_robot: str = ""
    demos: int = 100
    demo_seed: int = 0
    demo_noise: float = 0.004
    select_from: float = 0.7
    select_scenes: int = 24
    scenes: int = 24
    eval_seed: int = 1000
    domains: tuple[str, ...] = DOMAINS
    videos: int = 1
    sweep: bool = True
    distributed: str = ""

    @property
    def second_robot(self) -> str:
        """The robot of `embodiment` domains, `other_robot` resolved."""
        return self.other_robot or next(name for name in ROBOTS if name != self.robot)

    def check(self) -> None:
        """Raises ConfigError for values that cannot work."""
        _known("task", [self.task], TASKS)
        _known("robot", [self.robot], ROBOTS)
        super().check()
        if self.other_robot:
            _known("robot", [self.other_robot], ROBOTS)
        if self.other_robot == self.robot:
            raise ConfigError(
                f"other_robot: expected another robot than robot = {self.robot!r}, e.g. "
                f"{dataclasses.replace(self, other_robot='').second_robot!r}"
            )
        _check_domains(self.domains)
        if self.eval_seed == SELECTION_SEED:
            raise ConfigError(
                f"eval_seed: {SELECTION_SEED} is that of the scenes by which checkpoints are "
                "chosen; an evaluation there would flatter, take another one"
            )
        for name in ("demos", "scenes", "select_scenes"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name}: expected at least 1, got {getattr(self, name)}")

    def folder_name(self) -> str:
        """PRESET-TASK-METHODS-sSEED."""
        return f"{'-'.join((self.preset, self.task, *self.method))}-s{self.seed}"


@dataclasses.dataclass(frozen=True)
class Recorded(Learning):
    """Train policies on recordings of a robot, without a simulator (docs/your_data.md).

    Checkpoints are chosen by their loss on episodes that are held out, as the paper does for its
    real robot.

    Attributes:
      task: what is done, in words; by default what the data say.
      calibration: calibration.json of the cameras (`python -m palm_jax data calibrate`).
      camera: name; by default the only one with images.
      crop: pixels per side of the TCP-centred window, in the camera's image; by default the
        paper's 200 of 512 rows.
      offset: pixels from the TCP to the window's middle, right and down; by default the paper's 40
        of 512 rows, down.
      axis_length: of the overlay, metres.
      transitions: frames with so many largest motions of an episode get the label "stay", as in
        the authors' code; for recordings in which the hand is moved between two stages.
      validation: share of the episodes that is held out, 0 for none (the last checkpoint is then
        taken); by default the file's own split (robomimic's filter keys train and valid), else a
        tenth.
      least_in_view: share of frames that must show the TCP.
      trust: skip looking at the images, at pixels measured in them and at the gripper's range for a
        wrong calibration.
    """

    task: str = ""
    calibration: Path | None = None
    camera: str | None = None
    crop: int | None = None
    offset: tuple[int, int] | None = None
    axis_length: float = 0.1
    transitions: int = 0
    validation: float | None = None
    least_in_view: float = LEAST_IN_VIEW
    trust: bool = False

    def check(self) -> None:
        """Raises ConfigError for values that cannot work."""
        super().check()
        if self.data is None or self.calibration is None:
            raise ConfigError(
                "expected --data FILE with --calibration C: recordings, and where their camera is "
                "(python -m palm_jax data calibrate)"
            )
        for name in self.method:
            method = methods.find(name)
            if method.transform or method.isolate:
                raise ConfigError(
                    f"method {name!r} needs the simulator ({method.title}); on recordings: "
                    + ", ".join(RECORDED_METHODS)
                )
        if self.validation is not None and not 0 <= self.validation < 1:
            raise ConfigError(f"validation: expected a share from 0 to 1, got {self.validation}")
        if self.transitions < 0:
            raise ConfigError(f"transitions: expected 0 or more, got {self.transitions}")

    def folder_name(self) -> str:
        """DATA-METHODS-sSEED."""
        stem = self.data.stem if self.data else "recorded"
        return f"{'-'.join((stem, *self.method))}-s{self.seed}"


RECORDED_METHODS = tuple(
    name for name, method in methods.METHODS.items() if not (method.transform or method.isolate)
)
"""Methods that need nothing but images, poses and a calibration."""


def _check_domains(domains: Sequence[str]) -> None:
    """Raises ConfigError for what is no domain, for one given twice, and without in_domain."""
    given: dict[frozenset[str], str] = {}
    for domain in domains:
        _known("domain", domain.split("+"), ("in_domain", *SHIFTS, *AXES, EMBODIMENT))
        try:
            shifts = frozenset(parts(domain))
        except ValueError as error:
            raise ConfigError(f"domains: {error}") from error
        if shifts in given:
            raise ConfigError(f"domains: {given[shifts]} and {domain} are the same: give one")
        given[shifts] = domain
    if "in_domain" not in domains:
        raise ConfigError("domains must contain in_domain: degradation is relative to it")


def _known(what: str, names: Iterable[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, list(known), n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise ConfigError(f"unknown {what} {name!r}{hint}; known: {', '.join(known)}")


def quick() -> Config:
    """`python -m palm_jax.train`: PALM beside BC on one task, about ten minutes on two cores."""
    return Config()


_UNSEEN = 2026
"""Scenes of the main table. Those of the default, 1000, were looked at while presets were tuned."""


def cpu() -> Config:
    """`python -m palm_jax.train --preset cpu --task lift_spam`: 50 scenes a domain."""
    return dataclasses.replace(
        Config(),
        preset="cpu",
        demos=200,
        image_size=84,
        random_crop=76,
        epochs=20.0,
        checkpoint_every=1600,
        select_from=0.6,
        select_scenes=50,
        scenes=50,
        eval_seed=_UNSEEN,
        overlay_warmup=1500,
        perspective=0.1,
        turn=(30.0, 10.0),
    )


def paper() -> Config:
    """`python -m palm_jax.train --preset paper`: the paper's network and schedule; wants a GPU.

    Width 64 from scratch (no ImageNet weights are shipped, so the encoder's rate is not scaled
    down), batch norm, Adam 1e-4 without schedule, batch 64, 600 epochs.
    """
    return dataclasses.replace(
        Config(),
        preset="paper",
        demos=200,
        image_size=84,
        random_crop=76,
        width=64,
        batch_size=64,
        norm="batch",
        learning_rate=1e-4,
        schedule="constant",
        warmup_steps=0,
        ema=0.0,
        epochs=600.0,
        checkpoint_every=7_800,
        select_from=0.0,
        select_scenes=50,
        scenes=50,
        eval_seed=_UNSEEN,
        overlay_warmup=1_600,
        perspective=0.2,
    )


PRESETS = {"quick": quick, "cpu": cpu, "paper": paper}
"""Defaults by name; the command line overrides single fields."""


def defaults(kind: type[AnyConfig], preset: str) -> AnyConfig:
    """What a preset says of a kind of training."""
    if kind is Config:
        return PRESETS[preset]()  # type: ignore[return-value]
    learning = {f.name for f in dataclasses.fields(Learning)} - {"task"}
    return kind(**{name: getattr(PRESETS[preset](), name) for name in learning})


def parse(argv: Sequence[str]) -> Config | Recorded:
    """The configuration of a command line: the preset's, with what is given instead. With
    --calibration it is that of a training on recordings.

    Raises:
      ConfigError: an unknown preset, task, method, robot or domain, or an impossible value.
      SystemExit: `--help`, or an unknown option (the known ones are printed).
    """
    recorded = any(word.split("=")[0] == "--calibration" for word in argv)
    return _parsed(argv, Recorded) if recorded else _parsed(argv, Config)


def _parsed(argv: Sequence[str], kind: type[AnyConfig]) -> AnyConfig:
    name = _preset(argv)
    _known("preset", [name], PRESETS)
    fields = {f"--{f.name.replace('_', '-')}" for f in dataclasses.fields(kind)}
    for word in argv:
        option = word.split("=")[0].replace("_", "-")
        plain = option.replace("--no-", "--", 1)
        if option.startswith("--") and plain not in fields | {"--help"}:
            near = difflib.get_close_matches(option, fields, n=1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise ConfigError(f"unknown option {option}{hint}; known: {', '.join(sorted(fields))}")
    base = defaults(kind, name)
    steps = any(word.split("=")[0] == "--steps" for word in argv)
    if steps:  # instead of the preset's epochs
        base = dataclasses.replace(base, epochs=None)
    config: AnyConfig = tyro.cli(
        kind, args=list(argv), default=base, prog="python -m palm_jax.train"
    )
    if steps and config.epochs is not None:
        raise ConfigError(f"steps and epochs = {config.epochs}: give one of them")
    config.check()
    return config


def _preset(argv: Sequence[str]) -> str:
    for index, word in enumerate(argv):
        if word.startswith("--preset="):
            return word.partition("=")[2]
        if word == "--preset" and index + 1 < len(argv):
            return argv[index + 1]
    return "quick"


def default_out(config: Learning) -> Path:
    """Where a run goes that was not told where."""
    return Path("runs") / config.folder_name()


def command(config: Learning, *, resume: bool = False) -> list[str]:
    """The command line that gives this configuration again."""
    base, words = defaults(type(config), config.preset), ["python", "-m", "palm_jax.train"]
    words += ["--preset", config.preset]
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in ("preset", "resume", "take_over") or value == getattr(base, field.name):
            continue
        flag = f"--{field.name.replace('_', '-')}"
        if isinstance(value, bool):
            words.append(flag if value else flag.replace("--", "--no-", 1))
        elif isinstance(value, tuple):
            words += [flag, *map(str, value)]
        else:
            words += [flag, str(value)]
    return [*words, "--resume"] if resume else words


def resume_command(config: Learning) -> list[str]:
    """The command line that goes on with a run."""
    out = config.out or default_out(config)
    return command(dataclasses.replace(config, out=out), resume=True)
