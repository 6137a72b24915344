"""Aligning a whole file into a new one: checked first, resumable, whole or absent."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import platform
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palm_jax import __version__
from palm_jax.align import AlignSpec
from palm_jax.train.data import aligning, motion, output
from palm_jax.train.data.check import check_fit, reprojection
from palm_jax.train.data.errors import DataError, OutputError
from palm_jax.train.data.lerobot_writer import ENCODINGS, LeRobotWriter
from palm_jax.train.data.output import Partial, Writer
from palm_jax.train.data.recording import LEAST_IN_VIEW, Recording, Survey, check_view
from palm_jax.train.data.robomimic_writer import COMPRESSIONS, RobomimicWriter, writing
from palm_jax.train.files.metrics import plain

KEEP = ("numbers", "all", "none")
FORMATS = ("robomimic", "lerobot")


@dataclasses.dataclass(frozen=True)
class Options:
    """How the output is written.

    Attributes:
      format: "robomimic" or "lerobot"; None: the source's.
      keep: of the source: "numbers" (all but images), "all", or "none".
      compression: of images in HDF5: gzip (level 1), lzf or none.
      encoding: of images in LeRobot: png (exact, in the tables), h264 or av1 (an mp4 an episode).
      prefix: of the new keys.
      instead: new keys under the names that learners look for (`actions`; `action`,
        `observation.state`), the source's as source_*.
      transitions: see `aligning.labels`.
    """

    format: str | None = None
    keep: str = "numbers"
    compression: str = "gzip"
    encoding: str = "png"
    prefix: str = "palm"
    instead: bool = False
    transitions: int = 0

    def __post_init__(self) -> None:
        choices = {
            "format": (None, *FORMATS),
            "keep": KEEP,
            "compression": tuple(COMPRESSIONS),
            "encoding": ENCODINGS,
        }
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise OutputError(
                    f"{name}: expected one of {', '.join(map(str, known))}; got "
                    f"{getattr(self, name)!r}"
                )
        if re.fullmatch(r"[\w-]+", self.prefix) is None:
            raise OutputError(
                f"prefix: expected letters, digits, _ and -, got {self.prefix!r}; it begins the "
                "new keys"
            )


@dataclasses.dataclass(frozen=True)
class Result:
    """Of `align_file`."""

    path: Path
    episodes: int  # that are in the new file
    frames: int
    resumed: int  # episodes that an earlier call had finished
    in_view: float  # share of frames with the TCP in the image
    skipped: Mapping[str, str]  # keys of the source that the format cannot hold -> why


def preflight(recording: Recording, *, least: float = LEAST_IN_VIEW, trust: bool = False) -> Survey:
    """Everything that can be found wrong before an image is aligned.

    Args:
      recording: the data with its calibration.
      least: share of frames that must show the TCP.
      trust: do not look at the images, at measured pixels, nor at the gripper's range.

    Raises:
      DataError: see `Recording.trajectory`, `check_view`, `Recording.check_opening`, `check_fit`.
    """
    survey = recording.survey()
    check_view(recording, survey, least=least)
    if not trust:
        recording.check_opening(survey)
        check_fit(recording, motion.examine(recording), reprojection(recording))
    return survey


def recipe(recording: Recording, spec: AlignSpec, options: Options) -> dict[str, Any]:
    """How an output is made: what two calls must have in common to go on with each other."""
    packages = ("jax", "numpy", "h5py")
    content: dict[str, Any] = plain(
        {
            "versions": {
                "palm_jax": __version__,
                "python": platform.python_version(),
                **{name: importlib.metadata.version(name) for name in packages},
            },
            "source": recording.source.fingerprint(),
            "camera": recording.camera.name,
            "images": recording.image_key,
            "calibration_sha256": recording.calibration.sha256,
            "calibration": recording.calibration.to_json(),
            "robot": recording.keys,
            "spec": spec,
            "options": options,
        }
    )
    return content


def expected_bytes(recording: Recording, spec: AlignSpec, survey: Survey, options: Options) -> int:
    """About how large the output will be without compression."""
    numbers = 4 * (spec.proprio_size + 10 + 16 + 2)
    size = survey.frames * (3 * spec.size**2 + numbers)
    if options.keep == "all":
        size += sum(file.stat().st_size for file in recording.source.files())
    return size


def align_file(
    recording: Recording,
    spec: AlignSpec,
    out: Path,
    options: Options | None = None,
    *,
    least: float = LEAST_IN_VIEW,
    trust: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Writes every episode's aligned images, proprioception and labels into a new file.

    Goes on where an earlier call of the same kind stopped. `out` appears when it is complete.

    Args:
      recording: the data with its calibration.
      spec: what to do.
      out: of the new file or folder.
      options: how it is written.
      least, trust: see `preflight`.
      progress: called with the number of frames after each block.

    Raises:
      DataError: see `preflight`; `OutputError`, `DiskFullError`.
      KeyboardInterrupt: finished episodes are kept for the next call.
    """
    options = options or Options()
    options = dataclasses.replace(options, format=options.format or recording.source.format)
    output.check_free(out, recording.source.path)
    _check_spec(recording, spec, options)
    survey = preflight(recording, least=least, trust=trust)
    output.check_space(out, expected_bytes(recording, spec, survey, options))
    with writing(out), output.begun(out, recipe(recording, spec, options)) as partial:
        with _writer(recording, partial, options) as writer:
            written = _write(recording, spec, writer, options, progress or (lambda frames: None))
            assert list(written) == list(recording.source.episodes), "episodes are missing"
            content = writer.complete()
        partial.publish(content)
    frames = sum(written.values())
    return Result(out, len(written), frames, len(writer.done), survey.in_view, dict(writer.skipped))


def _check_spec(recording: Recording, spec: AlignSpec, options: Options) -> None:
    camera = recording.camera
    if spec.isolate:
        raise DataError("AlignSpec.isolate: expected false, got true; data files have no masks")
    if spec.crop is not None and spec.crop > min(camera.width, camera.height):
        raise DataError(
            f"--crop: expected at most the {camera.width} x {camera.height} pixels of the images, "
            f"got {spec.crop}"
        )
    if options.format == "lerobot" and options.encoding != "png" and spec.size % 2:
        raise OutputError(f"--size: expected an even number for video, got {spec.size}")


def _writer(recording: Recording, partial: Partial, options: Options) -> Writer:
    source = recording.source
    given = {"keep": options.keep, "prefix": options.prefix, "instead": options.instead}
    if options.format == "lerobot":
        return LeRobotWriter(partial, source, encoding=options.encoding, **given)  # type: ignore[arg-type]
    if options.keep == "all" and source.format != "robomimic":
        raise OutputError("--keep all copies images as they are stored: within one format only")
    return RobomimicWriter(partial, source, compression=options.compression, **given)  # type: ignore[arg-type]


def _write(
    recording: Recording,
    spec: AlignSpec,
    writer: Writer,
    options: Options,
    progress: Callable[[int], None],
) -> dict[str, int]:
    """Returns the frames of each episode that is in the output now."""
    written = {name: recording.source.length(name) for name in writer.done}
    left = [name for name in recording.source.episodes if name not in written]
    progress(sum(written.values()))
    episodes = aligning.stream(recording, spec, episodes=left, transitions=options.transitions)
    try:
        for name, trajectory, actions, blocks in episodes:
            known = {
                "actions": actions,
                "tcp": trajectory.tcp.astype(np.float32),
                "opening": trajectory.opening.astype(np.float32),
            }
            writer.begin(name, len(actions), known)
            written[name] = 0
            for image, proprio, valid in (
                (np.asarray(b.image), np.asarray(b.proprio), np.asarray(b.valid)) for b in blocks
            ):
                writer.add(image, {"proprio": proprio, "valid": valid})
                progress(len(image))
                written[name] += len(image)
            writer.end()
    finally:
        episodes.close()  # type: ignore[attr-defined]
    return written
