"""Run folders: what is written into them, and how a finished one is opened again."""

import dataclasses
import datetime
import hashlib
import json
import os
import platform
import shlex
import subprocess
import tempfile
import time
import types
import typing
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import jax

from palm_jax.envs import shifts
from palm_jax.envs.registry import TASKS
from palm_jax.train import checkpoint, methods
from palm_jax.train.config import AnyConfig, Config, ConfigError, Learning, command
from palm_jax.train.evaluate import VIEW, Evaluator, Runners
from palm_jax.train.files import pictures, records, versions
from palm_jax.train.files.metrics import write_json
from palm_jax.train.learner import Learner, PolicyState, make_learner

_FREE = ("out", "resume", "data", "calibration", "sweep", "videos", "method")
"""Fields in which a resumed command may differ from the one that began."""

RECORDED = "recorded"
"""What config.json says under "kind" of a run on recordings; nothing of one in the simulator."""

DIGESTS = "digests"
"""Where config.json has the SHA-256 of the data that the run was begun with, by what they are."""

DEMONSTRATIONS = "demonstrations"
"""One of them."""

_NOT_STORED = ("distributed", "take_over", "other_versions")
"""Fields of one session alone: no run folder holds them."""


def options(config: Learning) -> dict[str, Any]:
    """Those of a command that a run folder holds."""
    return {name: getattr(config, name) for name in _stored_names(type(config))}


def _stored_names(kind: type[Learning]) -> list[str]:
    return [f.name for f in dataclasses.fields(kind) if f.name not in _NOT_STORED]


def stored(config: Config, method: str) -> dict[str, Any]:
    """What `config.json` of one method's run folder holds."""
    low, high = shifts.TEST_LOW, shifts.TEST_HIGH
    regions = {
        "train_x": (0.15, 0.35),
        "train_y": (-0.1, 0.1),
        "test_x": (low[0], high[0]),
        "test_y": (low[1], high[1]),
        "test_angle": shifts.MAX_CAMERA_ANGLE,
    }
    return {
        **options(config),
        "other_robot": config.second_robot,
        "method": method,
        "frame": f"{methods.find(method).frame} px",
        "labels": "commanded deltas relative to the measured pose",
        "regions": regions,
    }


def begin(config: Config, folder: Path, method: str) -> None:
    """`begin_run` for a run in the simulator."""
    begin_run(stored(config, method), folder, resume=config.resume)


def begin_run(values: Mapping[str, Any], folder: Path, *, resume: bool) -> None:
    """Writes `config.json`; on a resume checks that it says the same.

    Args:
      values: see `stored`.
      folder: of the run.
      resume: whether to go on with a run that is there.

    Raises:
      ConfigError: the folder holds another run, or holds one and `resume` was not asked for.
    """
    path, fresh = folder / "config.json", json.loads(json.dumps(values, default=str))
    assert isinstance(fresh, dict)
    if path.exists():
        try:
            old = records.load_json(path)
        except records.RecordError as error:
            raise ConfigError(
                f"{error}: move it away and call again with the options that the run began with; "
                "checkpoints of other options are not used"
            ) from error
        if not resume:
            raise ConfigError(
                f"{folder} holds a run already: add --resume to go on, or choose another --out"
            )
        if DIGESTS in old:
            fresh[DIGESTS] = old[DIGESTS]  # compared when the data are opened: `bind_data`
        for name in sorted(set(old) | set(fresh)):
            if name not in _FREE and old.get(name) != fresh.get(name):
                raise ConfigError(
                    f"{folder} was begun with {name} = {old.get(name)!r}, but now {name} = "
                    f"{fresh.get(name)!r}: resume with the old value, or choose another --out"
                )
    write_json(path, fresh)


def bind_data(folder: Path, name: str, digest: str, path: Path | None) -> None:
    """Notes in `config.json` what a run is trained on, or checks that it is the same as before.

    Args:
      folder: of the run.
      name: what the data are.
      digest: SHA-256 of them.
      path: where they are, for the message.

    Raises:
      ConfigError: the run was begun with others.
    """
    values = records.load_json(folder / "config.json")
    found = values.get(DIGESTS)
    known = found if isinstance(found, dict) else {}
    if known.get(name, digest) != digest:
        raise ConfigError(
            f"{folder} was begun with {name} of SHA-256 {str(known[name])[:12]}, but {path} has "
            f"{digest[:12]}: resume with the old ones, or choose another --out"
        )
    if name not in known:
        write_json(folder / "config.json", {**values, DIGESTS: {**known, name: digest}})


def bind_backgrounds(folder: Path, config: Learning, method: methods.Method) -> None:
    """`bind_data` for the user's own backgrounds, where the method has any use of them."""
    if config.backgrounds is not None and method.augment:
        digest = pictures.digest(config.backgrounds)
        bind_data(folder, "backgrounds", digest, config.backgrounds)


def fingerprints(folder: Path) -> tuple[str, ...]:
    """What a run's checkpoints are told by from others': a hash of all that a run must keep, as
    config.json has it. After the run's own comes that of one whose data were not noted."""
    values = records.load_json(folder / "config.json")
    kept = {name: value for name, value in values.items() if name not in _FREE}
    kept["method"] = values.get("method")
    old = {name: value for name, value in kept.items() if name != DIGESTS}
    return tuple(
        hashlib.sha256(json.dumps(each, sort_keys=True).encode()).hexdigest()
        for each in (kept, old)
    )


@contextmanager
def session(config: Learning, folder: Path) -> Iterator[dict[str, Any]]:
    """Around work in a run folder: adds an entry to `env.json` that says where, when and with what.

    Yields the entry; what is put into it is noted at the end. One without `wall_s` is of a process
    that was killed.
    """
    path, start = folder / "env.json", time.monotonic()
    try:
        earlier = records.load_sessions(path) if path.exists() else []
    except records.RecordError:
        earlier = []  # no result rests on it
    now = environment(config)
    write_json(path, {"sessions": [*earlier, now]})
    try:
        yield now
    finally:
        now["wall_s"] = round(time.monotonic() - start, 1)
        write_json(path, {"sessions": [*earlier, now]})


def check_versions(where: object, noted: Any, *, allowed: bool, instead: str) -> None:
    """What was begun under other versions is not gone on with, unless that is `allowed`.

    Args:
      where: what was begun.
      noted: what it says of its versions.
      instead: what else can be done.

    Raises:
      ConfigError: the first package that differs is named.
    """
    found = None if allowed else versions.difference(noted, versions.current())
    if found:
        name, old, new = found
        raise ConfigError(
            f"{where} was begun with {name} {old}, now it is {new}: install the old version, "
            f"{instead}, or go on with --other-versions, which env.json or the header then tells"
        )


def environment(config: Learning) -> dict[str, Any]:
    """An entry of `env.json`."""
    return {
        "command": shlex.join(command(config)),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "devices": [str(device) for device in jax.devices()],
        "versions": versions.current(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "commit": commit(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def commit() -> str | None:
    """The commit of this very code, "-dirty" behind it if it was changed; None outside of git."""
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


def nameless_file(folder: Path, size: int) -> IO[bytes]:
    """A file of `size` bytes in a folder that has no name: it ends with the process.

    Raises:
      OSError: no room for it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = tempfile.TemporaryFile(dir=folder)
    try:
        # Space is taken now: a mapped page without any would end the process when it is written.
        os.posix_fallocate(file.fileno(), 0, size)
    except OSError:
        file.close()
        raise
    return file


def stored_config(folder: Path) -> Config:
    """The configuration of a run folder, as the command saw it.

    Raises:
      ConfigError: it is that of a run on recordings, which nothing can simulate.
    """
    if records.load_json(folder / "config.json").get("kind") == RECORDED:
        raise ConfigError(
            f"{folder}: a policy trained on recordings: expected one of the simulator; it can be "
            "loaded with palm_jax.policy.load and served, but not evaluated here"
        )
    return config_in(folder, Config)


def config_in(folder: Path, kind: type[AnyConfig]) -> AnyConfig:
    """What `config.json` holds, as the command saw it.

    Raises:
      RecordError: it cannot be read.
      ConfigError: a field is missing, or says what no command can; the message names it.
    """
    path = folder / "config.json"
    values = records.load_json(path)
    names = _stored_names(kind)
    missing = sorted(set(names) - set(values))
    if missing:
        raise ConfigError(f"{path} lacks {', '.join(missing)}: another version's run")
    chosen = {name: values[name] for name in names} | {"method": [values["method"]]}
    hints = typing.get_type_hints(kind)
    for name, value in chosen.items():
        if not _fits(value, hints[name]):
            raise ConfigError(f"{path}: {name}: expected {_words(hints[name])}, got {value!r:.80}")
    for name in ("out", "data", "backgrounds", "calibration"):
        if chosen.get(name) is not None:
            chosen[name] = Path(chosen[name])
    chosen = {name: tuple(v) if isinstance(v, list) else v for name, v in chosen.items()}
    config = kind(**chosen)
    try:
        # Pictures that were there then need not be there now.
        dataclasses.replace(config, backgrounds=None).check()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value of a JSON file can be one of a configuration's field."""
    inner = typing.get_args(hint)
    if isinstance(hint, types.UnionType):
        return any(_fits(value, one) for one in inner)
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list):
            return False
        kinds = inner[:1] * len(value) if inner[-1] is Ellipsis else inner
        return len(value) == len(kinds) and all(map(_fits, value, kinds))
    if hint in (int, float):
        wanted = int if hint is int else (int, float)
        whole = isinstance(value, wanted) and not isinstance(value, bool)
        return whole and abs(value) < 2**63
    if hint is Path:
        return isinstance(value, str) and "\0" not in value
    return isinstance(value, hint)


def _words(hint: Any) -> str:
    return getattr(hint, "__name__", "") if isinstance(hint, type) else str(hint)


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
    """Parameters of the best checkpoint of a run.

    Raises:
      ConfigError: there is none.
    """
    _, path = best_checkpoint(folder)
    return learner.policy_state(checkpoint.load(path, learner.abstract_state()))


def best_checkpoint(folder: Path) -> tuple[int, Path]:
    """(step, path) of the checkpoint of a run with the best in-domain success.

    Raises:
      ConfigError: there is none.
    """
    best = checkpoint.best(folder / "checkpoints", fingerprints=fingerprints(folder))
    if not best:
        raise ConfigError(f"{folder}/checkpoints holds no whole, scored checkpoint: train first")
    return best[0]


def quoted_variant(folder: Path) -> str:
    """Which variant of the hand's initial yaw `eval.json` quotes."""
    path = folder / "eval_variants.json"
    return str(records.load_json(path)["quoted"]) if path.exists() else "aligned"
