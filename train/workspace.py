"""Run folders: what is written into them, and how a finished one is opened again."""

import dataclasses
import datetime
import json
import os
import platform
import shlex
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from palm_jax.envs import shifts
from palm_jax.envs.registry import TASKS
from palm_jax.train import checkpoint, methods, records
from palm_jax.train.config import Config, ConfigError, command
from palm_jax.train.evaluate import VIEW, Evaluator, Runners
from palm_jax.train.learner import Learner, PolicyState, make_learner
from palm_jax.train.metrics import write_json

_PACKAGES = (
    "palm_jax",
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "orbax-checkpoint",
    "mujoco",
    "mujoco-mjx",
    "numpy",
)
_FREE = ("out", "resume", "data", "sweep", "videos", "method")
"""Fields in which a resumed command may differ from the one that began."""

_NOT_STORED = ("distributed",)
"""Fields of the machines alone: no run folder holds them."""


def _stored_fields() -> list[str]:
    return [f.name for f in dataclasses.fields(Config) if f.name not in _NOT_STORED]


def stored(config: Config, method: str) -> dict[str, Any]:
    """What `config.json` of one method's run folder holds."""
    values = {name: getattr(config, name) for name in _stored_fields()}
    low, high = shifts.TEST_LOW, shifts.TEST_HIGH
    regions = {
        "train_x": (0.15, 0.35),
        "train_y": (-0.1, 0.1),
        "test_x": (low[0], high[0]),
        "test_y": (low[1], high[1]),
        "test_angle": shifts.MAX_CAMERA_ANGLE,
    }
    return {
        **values,
        "other_robot": config.second_robot,
        "method": method,
        "frame": f"{methods.find(method).frame} px",
        "labels": "commanded deltas relative to the measured pose",
        "regions": regions,
    }


def begin(config: Config, folder: Path, method: str) -> None:
    """Writes `config.json`; on a resume checks that it says the same.

    Raises:
      ConfigError: the folder holds another run, or holds one and `resume` was not asked for.
    """
    path, fresh = folder / "config.json", stored(config, method)
    if path.exists():
        old = records.load_json(path)
        if not config.resume:
            raise ConfigError(
                f"{folder} holds a run already: add --resume to go on, or choose another --out"
            )
        now = json.loads(json.dumps(fresh, default=str))
        for name in sorted(set(old) | set(now)):
            if name not in _FREE and old.get(name) != now.get(name):
                raise ConfigError(
                    f"{folder} was begun with {name} = {old.get(name)!r}, but now {name} = "
                    f"{now.get(name)!r}: resume with the old value, or choose another --out"
                )
    write_json(path, json.loads(json.dumps(fresh, default=str)))


def environment(config: Config, *, wall_s: float) -> dict[str, Any]:
    """What `env.json` holds: where, when and with what."""
    return {
        "command": shlex.join(command(config)),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "devices": [str(device) for device in jax.devices()],
        "versions": versions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "commit": _commit(),
        "wall_s": round(wall_s, 1),
    }


def versions() -> dict[str, str]:
    """Those of Python and of the packages that decide what comes out."""
    found = {name: metadata.version(name) for name in _PACKAGES if _installed(name)}
    return found | {"python": platform.python_version()}


def _installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    try:
        # Without cwd and close_fds Python spawns instead of forking, which JAX's threads forbid.
        found = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"],
            capture_output=True,
            text=True,
            check=True,
            close_fds=False,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def stored_config(folder: Path) -> Config:
    """The configuration of a run folder, as the command saw it."""
    values = records.load_json(folder / "config.json")
    names = _stored_fields()
    missing = sorted(set(names) - set(values))
    if missing:
        raise ConfigError(f"{folder}/config.json lacks {', '.join(missing)}: another version's run")
    chosen = {name: values[name] for name in names}
    for name in ("out", "data", "backgrounds"):
        chosen[name] = None if chosen[name] is None else Path(chosen[name])
    chosen["method"] = (chosen["method"],)
    chosen["domains"] = tuple(chosen["domains"])
    return Config(**chosen)


def make_evaluator(config: Config, method: methods.Method, runners: Runners) -> Evaluator:
    """The evaluator of a method under a configuration."""
    size = method.spec(TASKS[config.task], config.image_size).proprio_size
    learner = make_learner(config.learner(method), size, (VIEW,))
    return Evaluator(runners, method, learner, config.image_size)


def load_policy(folder: Path, runners: Runners) -> tuple[Evaluator, PolicyState]:
    """The policy of a finished run: its best checkpoint by in-domain success.

    Raises:
      ConfigError: no whole, scored checkpoint in the folder.
    """
    config = stored_config(folder)
    evaluator = make_evaluator(config, methods.find(config.method[0]), runners)
    return evaluator, best_policy(folder, evaluator.learner)


def best_policy(folder: Path, learner: Learner) -> PolicyState:
    """Parameters of the best checkpoint in `folder/checkpoints`.

    Raises:
      ConfigError: there is none.
    """
    best = checkpoint.best(folder / "checkpoints")
    if not best:
        raise ConfigError(f"{folder}/checkpoints holds no whole, scored checkpoint: train first")
    return learner.policy_state(checkpoint.load(best[0][1], learner.abstract_state()))


def quoted_variant(folder: Path) -> str:
    """Which variant of the hand's initial yaw `eval.json` quotes."""
    path = folder / "eval_variants.json"
    return str(records.load_json(path)["quoted"]) if path.exists() else "aligned"
