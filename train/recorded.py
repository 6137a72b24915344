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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from palm_jax.align import AlignSpec, Camera, window_origin
from palm_jax.train import checkpoint, held_out, learner, methods, report, training, workspace
from palm_jax.train.config import ConfigError, Recorded, default_out
from palm_jax.train.data import aligning, job
from palm_jax.train.data.errors import TcpOutOfViewError, disk_full
from palm_jax.train.data.recording import Recording, Survey, open_recording
from palm_jax.train.evaluate import VIEW
from palm_jax.train.files import locks, records
from palm_jax.train.files.metrics import plain, write_json
from palm_jax.train.host import devices
from palm_jax.train.reporting import console as terminal
from palm_jax.train.reporting import figures, paper

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
        locks.claim(out, take_over=config.take_over),
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
    terminal.held_out(console, {n: entry for n, entry in found.items() if "loss" in entry})
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
        """Trains, and gives what `held_out.json` holds: how good the chosen checkpoint is on what
        was held out."""
        name = self.method.name
        path = self.folder / records.HELD_OUT
        if path.exists():
            console.print(f"{name}: trained already")
            return records.load_json(path)
        with workspace.session(self.config, self.folder):
            step, found = self._train(console)
        # Written last: its presence says that the method is finished.
        values = {"step": step, "episodes": len(self.split.held_out), **found}
        write_json(path, values)
        return values

    def _train(self, console: Console) -> tuple[int, dict[str, Any]]:
        """The step of the checkpoint that was chosen, and how good it is."""
        with self._aligned("train", self.split.train, console) as data:
            config = self.config.on(len(data.proprio))
            model = learner.make_learner(
                config.learner(self.method), self.spec.proprio_size, (VIEW,)
            )
            with self._aligned("check", self.split.held_out, console) as checked:
                self._training(config, model, checked).train(data, console)
                step, best = workspace.best_checkpoint(self.folder)
                policy = model.policy_state(checkpoint.load(best, model.abstract_state()))
                found = held_out.measure(model, policy, checked) if len(checked.proprio) else {}
            self._note_views(data)
        return step, found

    def _training(
        self, config: Recorded, model: learner.Learner, checked: learner.Batch
    ) -> training.Training:
        def score(step: int, state: learner.TrainState) -> training.Score:
            if not len(checked.proprio):
                return training.Score(float(step), {})
            loss = held_out.loss(model, model.policy_state(state), checked)
            # A loss that is no number is worse than all others.
            return training.Score(
                -loss if math.isfinite(loss) else -math.inf, {"validation_loss": loss}
            )

        return training.Training(
            config, self.method.name, model, self.folder, score, self.method.augment
        )

    @contextmanager
    def _aligned(
        self, label: str, episodes: Sequence[str], console: Console
    ) -> Iterator[learner.Batch]:
        """The frames of some episodes that show the TCP, as the method sees them."""
        source = self.recording.source
        total = sum(source.length(name) for name in episodes)
        size, count = self.spec.size, 0
        parts: list[_Numbers] = []
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
                    parts.append(_Numbers.of(episode))
                    bar.advance(len(shown))
            if episodes and not count:
                raise TcpOutOfViewError(
                    f"{source.path}: no frame of {', '.join(episodes[:5])} shows the TCP; another "
                    "--validation share, or leave these episodes out"
                )
            yield self._batch(images[:count], parts)

    def _batch(self, images: np.ndarray, parts: Sequence["_Numbers"]) -> learner.Batch:
        if not parts:
            empty = np.zeros((0, self.spec.proprio_size), np.float32)
            actions = np.zeros((0, learner.ACTION_DIM), np.float32)
            return learner.Batch({VIEW: images}, empty, actions)
        whole = _Numbers(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))
        if not self.config.learner(self.method).turns:
            return learner.Batch({VIEW: images}, whole.proprio, whole.actions)
        frames = self.recording.camera.camera()
        cameras = window_cameras(frames, whole.cam_to_world, whole.tcp, self.spec)
        return learner.Batch(
            {VIEW: images},
            whole.proprio,
            whole.actions,
            cameras={VIEW: cameras},
            tcp=whole.tcp[:, :3, 3],
        )

    def _note_views(self, data: learner.Batch) -> None:
        """A few of the images that the policy is trained with, for the report."""
        rows = np.linspace(0, len(data.proprio) - 1, _SHOWN).astype(int)
        views = {f"frame {row}": np.asarray(data.images[VIEW][row]) for row in rows}
        records.save_arrays(self.folder / "views.npz", views)


class _Numbers(NamedTuple):
    """Of the frames that show the TCP, [T, ...] float32 each."""

    proprio: np.ndarray
    actions: np.ndarray
    tcp: np.ndarray  # [T, 4, 4]
    cam_to_world: np.ndarray  # [T, 4, 4]

    @classmethod
    def of(cls, episode: aligning.AlignedEpisode) -> "_Numbers":
        shown = episode.valid
        pose = np.asarray(episode.camera.cam_to_world, np.float32)
        poses = np.broadcast_to(pose, (int(shown.sum()), 4, 4))
        return cls(episode.proprio[shown], episode.actions[shown], episode.tcp[shown], poses)


def window_cameras(
    camera: Camera, cam_to_world: np.ndarray, tcp: np.ndarray, spec: AlignSpec
) -> Camera:
    """The cameras of the images that `palm_jax.align.align` makes.

    Args:
      camera: K and size of the frames.
      cam_to_world: [N, 4, 4] its poses.
      tcp: [N, 4, 4] TCP poses.
      spec: what was done.

    Returns:
      Camera of size x size pixels with NumPy leaves [N, ...].
    """
    crop, scale = spec.crop, spec.scale

    def one(pose: jax.Array, hand: jax.Array) -> Camera:
        posed = dataclasses.replace(camera, cam_to_world=pose)
        if crop is None:
            return spec.view_camera(posed)
        # The window is cut in the camera's own pixels, and resized after that.
        origin, _ = window_origin(posed, hand, dataclasses.replace(spec, size=crop))
        return posed.cropped(origin[::-1].astype(jnp.float32), crop, crop).scaled(scale)

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(cam_to_world, tcp))


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
            rows.append(list(records.load_views(path).values())[:_SHOWN])
            names.append(paper.method_label(each.method.name))
    rows = [row for row in rows if len(row) == _SHOWN]
    if rows:
        sheet = figures.picture_grid(rows, names, [""] * _SHOWN)
        figures.save(sheet, out / "figures" / "inputs.png")
