"""Training on recordings of a robot: no simulator, checkpoints chosen on episodes held out.

`python -m palm_jax.train --data FILE --calibration C` comes here. What a policy is shown is made by
`palm_jax.train.data`, the same code as that of `python -m palm_jax data align`.
"""

import dataclasses
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from palm_jax.align import AlignSpec, Camera, window_origin
from palm_jax.train import (
    checkpoint,
    devices,
    figures,
    held_out,
    learner,
    locks,
    methods,
    paper,
    records,
    report,
    training,
    workspace,
)
from palm_jax.train import console as terminal
from palm_jax.train.config import ConfigError, Recorded, default_out
from palm_jax.train.data import aligning, job
from palm_jax.train.data.errors import disk_full
from palm_jax.train.data.recording import Recording, Survey, open_recording
from palm_jax.train.evaluate import VIEW
from palm_jax.train.metrics import plain, write_json

DEFAULT_SHARE = 0.1
"""Of the episodes, held out where neither the user nor the file says which."""

IN_MEMORY = 2**30
"""Bytes of images up to which they are kept in memory; more lie in a file of the run folder."""

_SPLIT_KEY = 0x5EED
_SHOWN = 6  # frames in the picture of what each policy sees


@dataclasses.dataclass(frozen=True)
class Split:
    """Which episodes train a policy and which choose its checkpoint."""

    train: tuple[str, ...]
    held_out: tuple[str, ...]
    how: str  # in words


def split_episodes(
    episodes: Sequence[str],
    share: float | None,
    given: tuple[Sequence[str], Sequence[str]] | None = None,
) -> Split:
    """Splits by episode: frames of one episode are too much alike to check each other.

    The same for all methods and seeds of a file.

    Args:
      episodes: names, in order.
      share: that is held out, at least one episode; 0 for none; None for the file's own split, or
        a tenth.
      given: the file's own split (train, held out).

    Raises:
      ConfigError: too few episodes.
    """
    if share is None and given is not None:
        return Split(tuple(given[0]), tuple(given[1]), "as the file says")
    if share == 0:
        return Split(tuple(episodes), (), "all for training; the last checkpoint is taken")
    if len(episodes) < 2:
        raise ConfigError(
            "validation: expected at least two episodes, to hold one out, got one; record more, or "
            "pass --validation 0, which takes the last checkpoint"
        )
    share = DEFAULT_SHARE if share is None else share
    count = min(max(1, round(share * len(episodes))), len(episodes) - 1)
    order = jax.random.permutation(jax.random.key(_SPLIT_KEY), len(episodes))
    chosen = {episodes[int(index)] for index in order[:count]}
    return Split(
        tuple(name for name in episodes if name not in chosen),
        tuple(name for name in episodes if name in chosen),
        f"{count} of {len(episodes)} episodes drawn at random",
    )


def make_spec(method: methods.Method, config: Recorded, height: int) -> AlignSpec:
    """What a method sees of frames with `height` rows.

    Raises:
      OptionError: a value that no image can satisfy.
    """
    fields: dict[str, Any] = {
        "size": config.image_size,
        "overlay": method.overlay,
        "layout": method.layout,
        "axis_length": config.axis_length,
    }
    if not method.crop:
        return aligning.paper_spec(height, **fields, crop=None, offset=(0, 0))
    if config.crop is not None:
        fields["crop"] = config.crop
    if config.offset is not None:
        fields["offset"] = config.offset
    return aligning.paper_spec(height, **fields)


def execute(config: Recorded, console: Console) -> Path:
    """Runs a whole command; returns its folder.

    Raises:
      ConfigError: the folder holds another run; too few episodes.
      DataError: see `open_recording`, `preflight`; images that find no room on the disk.
      OptionError: a spec that does not fit the images.
      Busy: another process works in the folder.
      Interrupted: stopped on request.
    """
    out = config.out or default_out(config)
    config = dataclasses.replace(config, out=out)
    devices.Split.over(jax.devices()).check(config.batch_size)
    assert config.data is not None and config.calibration is not None
    with (
        locks.claim(out),
        open_recording(config.data, config.calibration, camera=config.camera) as recording,
    ):
        return _execute(config, recording, out, console)


def _execute(config: Recorded, recording: Recording, out: Path, console: Console) -> Path:
    start = time.monotonic()
    source = recording.source
    survey = job.preflight(recording, least=config.least_in_view, trust=config.trust)
    split = split_episodes(source.episodes, config.validation, source.split())
    jobs = [
        _Job(config, method, make_spec(method, config, recording.camera.height), recording, split,
             out / method.name if len(config.method) > 1 else out)
        for method in map(methods.find, config.method)
    ]  # fmt: skip
    facts = _facts(recording, split)
    for each in jobs:
        workspace.begin_run(each.stored(facts), each.folder, resume=config.resume)
        workspace.bind_backgrounds(each.folder, config, each.method)
    terminal.header(console, "palm_jax", _header(config, recording, survey, split, out))
    found = {}
    for each in jobs:
        found[each.method.name] = each.perform(console)
    _picture(jobs, out)
    report.write_report(out)
    terminal.held_out(console, {name: entry for name, entry in found.items() if entry})
    console.print(
        f"Report: {out / 'report.html'}   ({terminal.duration(time.monotonic() - start)})",
        markup=False,
    )
    return out


def _header(
    config: Recorded, recording: Recording, survey: Survey, split: Split, out: Path
) -> dict[str, object]:
    return {
        "data": f"{recording.source.path} ({recording.source.format})",
        "episodes": f"{len(split.train)} for training, {len(split.held_out)} held out "
        f"({split.how}); {survey.frames} frames, TCP in the image in {survey.in_view:.1%}",
        "camera": f"{recording.camera.name}, {recording.camera.width} x {recording.camera.height}",
        "methods": ", ".join(config.method),
        "preset": config.preset,
        "device": devices.described(),
        "folder": out,
    }


def _facts(recording: Recording, split: Split) -> dict[str, Any]:
    """What config.json says of the data: the same for all methods."""
    source, camera = recording.source, recording.camera
    away = [_distances(recording, name) for name in split.train]
    facts: dict[str, Any] = plain(
        {
            "source": source.fingerprint(),
            "calibration_sha256": recording.calibration.sha256,
            "recorded_task": source.task(source.episodes[0]),
            "rate": source.fps,
            "camera_name": camera.name,
            "K": camera.K,
            "frame": [camera.height, camera.width],
            "distance": round(float(np.concatenate(away).mean()), 4),
            "held_out": list(split.held_out),
            "labels": "motion to the next recorded pose",
        }
    )
    return facts


def _distances(recording: Recording, episode: str) -> np.ndarray:
    """[T] metres from the camera to the TCP."""
    camera = np.asarray(recording.camera.camera(episode).cam_to_world)[:3, 3]
    return np.linalg.norm(recording.trajectory(episode).tcp[:, :3, 3] - camera, axis=1)


# ------------------------------------------------------------------------------------- one method


@dataclasses.dataclass(frozen=True)
class _Job:
    """One method's training on a recording."""

    config: Recorded
    method: methods.Method
    spec: AlignSpec
    recording: Recording
    split: Split
    folder: Path

    def stored(self, facts: Mapping[str, Any]) -> dict[str, Any]:
        """What config.json holds."""
        config = dataclasses.replace(
            self.config, task=self.config.task or str(facts["recorded_task"])
        )
        spec = dataclasses.asdict(self.spec)
        values: dict[str, Any] = plain(
            {
                "kind": workspace.RECORDED,
                **workspace.options(config),
                "method": self.method.name,
                **facts,
                "spec": spec,
            }
        )
        return values

    def perform(self, console: Console) -> dict[str, Any]:
        """Trains, and tells how good the chosen checkpoint is on what was held out; empty if
        nothing was."""
        name = self.method.name
        path = self.folder / records.HELD_OUT
        if path.exists():
            console.print(f"{name}: trained already")
            return records.load_json(path)
        with workspace.session(self.config, self.folder):
            step, found = self._train(console)
        # Written last: its presence says that the method is finished.
        write_json(path, {"step": step, "episodes": len(self.split.held_out), **found})
        return found

    def _train(self, console: Console) -> tuple[int, dict[str, Any]]:
        """The step of the checkpoint that was chosen, and how good it is."""
        model = learner.make_learner(
            self.config.learner(self.method), self.spec.proprio_size, (VIEW,)
        )
        with self._aligned("train", self.split.train, console) as data:
            with self._aligned("check", self.split.held_out, console) as checked:
                self._training(model, checked).train(data, console)
                step, best = workspace.best_checkpoint(self.folder)
                policy = model.policy_state(checkpoint.load(best, model.abstract_state()))
                found = held_out.measure(model, policy, checked) if len(checked.proprio) else {}
            self._note_views(data)
        return step, found

    def _training(self, model: learner.Learner, checked: learner.Batch) -> training.Training:
        def score(step: int, state: learner.TrainState) -> training.Score:
            if not len(checked.proprio):
                return training.Score(float(step), {})
            loss = held_out.loss(model, model.policy_state(state), checked)
            # A loss that is no number is worse than all others.
            return training.Score(
                -loss if math.isfinite(loss) else -math.inf, {"validation_loss": loss}
            )

        return training.Training(
            self.config, self.method.name, model, self.folder, score, self.method.augment
        )

    @contextmanager
    def _aligned(
        self, label: str, episodes: Sequence[str], console: Console
    ) -> Iterator[learner.Batch]:
        """The frames of some episodes that show the TCP, as the method sees them."""
        source = self.recording.source
        total = sum(source.length(name) for name in episodes)
        size, count = self.spec.size, 0
        numbers: dict[str, list[np.ndarray]] = {"proprio": [], "actions": [], "tcp": []}
        cameras: list[Camera] = []
        with _room((total, size, size, 3), self.folder) as images:
            with terminal.ProgressBar(
                console, total, f"align {self.method.name}, {label}", unit="frame"
            ) as bar:
                for episode in aligning.aligned_episodes(
                    self.recording,
                    self.spec,
                    episodes=episodes,
                    transitions=self.config.transitions,
                ):
                    shown = episode.valid
                    images[count : count + shown.sum()] = episode.images[shown]
                    count += int(shown.sum())
                    numbers["proprio"].append(episode.proprio[shown])
                    numbers["actions"].append(episode.actions[shown])
                    numbers["tcp"].append(episode.tcp[shown, :3, 3])
                    cameras.append(_window_cameras(episode.camera, episode.tcp[shown], self.spec))
                    bar.advance(len(shown))
            yield _batch(images[:count], numbers, cameras, self.spec)

    def _note_views(self, data: learner.Batch) -> None:
        """A few of the images that the policy is trained with, for the report."""
        rows = np.linspace(0, len(data.proprio) - 1, _SHOWN).astype(int)
        views = {f"frame {row}": np.asarray(data.images[VIEW][row]) for row in rows}
        records.save_arrays(self.folder / "views.npz", views)


def _batch(
    images: np.ndarray,
    numbers: Mapping[str, Sequence[np.ndarray]],
    cameras: Sequence[Camera],
    spec: AlignSpec,
) -> learner.Batch:
    widths = {"proprio": spec.proprio_size, "actions": learner.ACTION_DIM, "tcp": 3}
    # With nothing held out there is nothing to join.
    whole = {
        name: np.concatenate([np.zeros((0, widths[name]), np.float32), *parts])
        for name, parts in numbers.items()
    }
    joined = (
        {VIEW: jax.tree.map(lambda *leaves: np.concatenate(leaves), *cameras)} if cameras else {}
    )
    return learner.Batch(
        {VIEW: images}, whole["proprio"], whole["actions"], cameras=joined, tcp=whole["tcp"]
    )


def _window_cameras(camera: Camera, tcp: np.ndarray, spec: AlignSpec) -> Camera:
    """The cameras (leaves [T, ...]) of the images that `align` makes of the camera's at the TCP
    poses [T, 4, 4]."""
    if spec.crop is None:
        view = spec.view_camera(camera)
        return jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], len(tcp), 0), view)
    crop, scale = spec.crop, spec.scale
    # The window is cut in the camera's own pixels, and resized after that.
    own = dataclasses.replace(spec, size=crop)

    def one(pose: jax.Array) -> Camera:
        origin, _ = window_origin(camera, pose, own)
        window = camera.cropped(origin[::-1].astype(jnp.float32), crop, crop)
        return window.scaled(scale)

    return jax.tree.map(np.asarray, jax.vmap(one)(jnp.asarray(tcp)))


@contextmanager
def _room(shape: tuple[int, ...], folder: Path) -> Iterator[np.ndarray]:
    """Space for images: memory, or a nameless file of the folder, which ends with the process.

    Raises:
      DiskFullError: no room for the file.
    """
    count = math.prod(shape)
    if count <= IN_MEMORY:
        yield np.empty(shape, np.uint8)
        return
    with disk_full(folder, "make room for the aligned images, or choose another --out"):
        file = workspace.nameless_file(folder, count)
    with file:
        yield np.memmap(file, np.uint8, "r+", shape=shape)


def _picture(jobs: Sequence[_Job], out: Path) -> None:
    """What each policy is shown, a row each."""
    rows, names = [], []
    for each in jobs:
        path = each.folder / "views.npz"
        if path.exists():
            rows.append(list(records.load_arrays(path).values())[:_SHOWN])
            names.append(paper.method_label(each.method.name))
    rows = [row for row in rows if len(row) == _SHOWN]
    if rows:
        sheet = figures.picture_grid(rows, names, [""] * _SHOWN)
        figures.save(sheet, out / "figures" / "inputs.png")
