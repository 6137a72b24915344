"""Does a calibration fit the images? Reprojects the TCP, and finds the mistake if it does not."""

from __future__ import annotations

import dataclasses
import io
import shlex
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from palm_jax.align import AlignSpec, Camera, tcp_overlay, undistort
from palm_jax.train.data import motion, output
from palm_jax.train.data.calibration import CameraCalibration
from palm_jax.train.data.errors import (
    DataError,
    FormatError,
    ImageOrientationError,
    KeyMissingError,
    OutputError,
    ReprojectionError,
    TcpOutOfViewError,
)
from palm_jax.train.data.motion import Motion, Reading
from palm_jax.train.data.recording import (
    LEAST_IN_VIEW,
    Recording,
    Survey,
    check_view,
    inside,
    projected,
)
from palm_jax.train.data.source import Source
from palm_jax.train.files.metrics import write_atomic

PANELS, COLUMNS, PANEL, CAPTION = 12, 4, 320, 22

_PNG = b"\x89PNG\r\n\x1a\n"

LEAST_PIXELS, PIXELS_SHARE = 3.0, 0.01
"""How far from measured pixels the TCP may be computed, in pixels, and as a share of the image's
larger side: more than the error of a careful measurement, less than any mistake."""


@dataclasses.dataclass(frozen=True)
class Reprojection:
    """Distance in pixels between where the TCP is computed and where it was seen."""

    frames: int
    mean: float
    median: float
    most: float
    key: str


@dataclasses.dataclass(frozen=True)
class Report:
    """What `check` found.

    Attributes:
      survey: where the TCP appears.
      motion: whether the images move with it.
      reprojection: against measured pixels, if the file has them.
      problem: the error that the calibration amounts to, or None.
    """

    survey: Survey
    motion: Motion
    reprojection: Reprojection | None
    problem: DataError | None


def check(
    recording: Recording, *, least: float = LEAST_IN_VIEW, pixels: str | None = None
) -> Report:
    """Surveys the poses and looks at a few hundred frames.

    Args:
      recording: the data with its calibration.
      least: share of frames that must show the TCP.
      pixels: key of measured pixels [T, 2] of the TCP, in the images as stored; None:
        CAMERA_tcp_uv, if the file has it.

    Raises:
      DataError: what keeps a recording from being read at all.
    """
    survey = recording.survey()
    evidence = motion.examine(recording)
    found = reprojection(recording, pixels)
    problem: DataError | None = None
    try:
        check_view(recording, survey, least=least)
        recording.check_opening(survey)
        check_fit(recording, evidence, found)
    except DataError as error:
        problem = error
    return Report(survey, evidence, found, problem)


def check_fit(recording: Recording, evidence: Motion, found: Reprojection | None) -> None:
    """Raises where the images, or pixels measured in them, contradict the calibration.

    Measured pixels weigh more: what the motion of the images advises must fit them.

    Raises:
      ImageOrientationError, TcpOutOfViewError: see `check_orientation`.
      ReprojectionError: see `check_reprojection`.
    """
    if evidence.wrong and found is not None:
        mended = reprojection(recording, found.key, evidence.best.reading)
        if mended is not None and mended.median > _most_pixels(recording.camera):
            check_reprojection(recording, found)
    check_orientation(recording, evidence)
    check_reprojection(recording, found)


def check_orientation(recording: Recording, evidence: Motion) -> None:
    """Raises where the images move at another place than the TCP.

    Raises:
      ImageOrientationError: another flip fits clearly better.
      TcpOutOfViewError: another reading of the camera's pose does.
    """
    if not evidence.wrong:
        return
    best, camera = evidence.best, recording.camera
    where = f"{recording.source.path} with camera {camera.name!r}"
    kind = ImageOrientationError if best.reading.flip != camera.flip else TcpOutOfViewError
    raise kind(
        f"{where}: the images move elsewhere than the TCP (correlation "
        f"{evidence.as_is.score:.2f}), but fit if {told(best.reading, camera.flip)} "
        f"({best.score:.2f}, {best.better:.0f} standard errors better). "
        f"{remedy(best.reading, camera.name)}; "
        "look at the sheet of `data check` (--trust if you know better)"
    )


def told(reading: Reading, flip: str = "none") -> str:
    """A reading in words."""
    words = []
    turns = {
        "none": "the images are upright as stored",
        "ud": "the stored images are upside down (mirrored top to bottom)",
        "lr": "the stored images are mirrored left to right",
        "180": "the stored images are turned by half a turn",
        "cw": "the stored images must be turned clockwise",
        "ccw": "the stored images must be turned counter-clockwise",
    }
    if reading.flip != flip:
        words.append(turns[reading.flip])
    if reading.inverse:
        words.append("the pose is inverted (it maps the base into the camera)")
    if reading.axes == "opengl":
        words.append("the camera's axes are OpenGL's or MuJoCo's (y up, looking along -z)")
    if reading.axes == "coppelia":
        words.append("the camera's axes are CoppeliaSim's (x left, y up)")
    if reading.euler:
        words.append(f"the camera's three angles read as {reading.euler!r}")
    return " and ".join(words) or "the calibration is taken as it is"


def remedy(reading: Reading, name: str) -> str:
    """What mends the calibration of a camera: a command, or the options to import it with."""
    options = f"--flip {reading.flip}"
    options += f" --axes {reading.axes}" if reading.axes != "opencv" else ""
    options += " --inverse" if reading.inverse else ""
    if reading.euler:
        return f"Import the camera again with --euler {reading.euler} {options}"
    return (
        f"`data calibrate --from palm --file C --camera {shlex.quote(name)} {options} --out NEW` "
        "mends it"
    )


def reprojection(
    recording: Recording, pixels: str | None = None, reading: Reading | None = None
) -> Reprojection | None:
    """Distances to measured pixels, or None where the file has none.

    Args:
      recording: the data with its calibration.
      pixels: see `check`.
      reading: of the calibration; None: as it is.

    Raises:
      KeyMissingError: `pixels` is not a key of the file.
      FormatError: the key holds something else.
    """
    source, camera = recording.source, recording.camera
    reading = reading or Reading(camera.flip)
    try:
        key = source.resolve(pixels or f"{camera.name}_tcp_uv")
    except KeyMissingError:
        if pixels is not None:
            raise
        return None
    computed, measured = [], []
    for name in source.episodes:
        points = recording.trajectory(name).tcp[:, :3, 3]
        uv, _ = projected(motion.camera_as(camera, name, reading), points)
        computed.append(uv)
        measured.append(_measured(source, name, key, len(uv)))
    stored = motion.seen_uv(camera, np.concatenate(computed), reading.flip)
    every = np.linalg.norm(stored - np.concatenate(measured), axis=1)
    seen = every[np.isfinite(every)]
    if not len(seen):
        return None
    return Reprojection(
        len(seen), float(seen.mean()), float(np.median(seen)), float(seen.max()), key
    )


def _measured(source: Source, episode: str, key: str, length: int) -> np.ndarray:
    """[length, 2] pixels.

    Raises:
      FormatError: the key holds something else.
    """
    values = source.numbers(episode, key)
    if values.shape != (length, 2):
        raise FormatError(
            f"{source.path}: {episode}: expected {length} x 2 measured pixels in {key}, got "
            f"{' x '.join(map(str, values.shape))}; name another key: --pixels, or --trust"
        )
    return values


def _most_pixels(camera: CameraCalibration) -> float:
    return max(LEAST_PIXELS, PIXELS_SHARE * max(camera.width, camera.height))


def check_reprojection(recording: Recording, found: Reprojection | None) -> None:
    """Raises where the TCP is computed elsewhere than it was measured.

    Raises:
      ReprojectionError: with the distance and what can be the reason.
    """
    camera, most = recording.camera, _most_pixels(recording.camera)
    if found is None or found.median <= most:
        return
    raise ReprojectionError(
        f"{recording.source.path} with camera {camera.name!r}: expected the TCP within {most:.1f} "
        f"px of the measured pixels {found.key}, got {found.median:.1f} px (median of "
        f"{found.frames} frames): K belongs to another resolution or lens, the camera stood "
        "elsewhere, or the pixels are of something else (--trust if you know better)"
    )


# -- the sheet -------------------------------------------------------------------------------------


def check_sheet(path: Path, source: Path) -> None:
    """Raises where a sheet would replace anything but an older one.

    Args:
      path: of the sheet.
      source: the data.

    Raises:
      OutputError: no PNG; in the source's folder.
    """
    output.check_outside(path, source)
    if path.exists() and not _is_png(path):
        raise OutputError(
            f"{path} exists and is no PNG; a sheet replaces only an older sheet: choose another "
            "--out"
        )


def _is_png(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_PNG)) == _PNG


def sheet(recording: Recording, report: Report, spec: AlignSpec, path: Path) -> Path:
    """Draws frames from all over the file with the overlay and the crop, as PNG.

    Where another reading fits better, the same frames follow as that reading has them.

    Args:
      recording: the data.
      report: of `check`.
      spec: its crop is drawn.
      path: of the picture, written atomically.
    """
    camera = recording.camera
    title = f"{recording.source.path.name}, camera {camera.name!r}, as calibrated: {_line(report)}"
    count = PANELS if not report.motion.wrong else 2 * COLUMNS
    parts = [_panels(recording, Reading(camera.flip), spec, title, count)]
    if report.motion.wrong:
        best = report.motion.best
        text = f"What fits better ({best.score:.2f}): {told(best.reading, camera.flip)}"
        parts.append(_panels(recording, best.reading, spec, text, count))
    width = max(part.width for part in parts)
    whole = Image.new("RGB", (width, sum(part.height for part in parts)), "white")
    top = 0
    for part in parts:
        whole.paste(part, (0, top))
        top += part.height
    content = io.BytesIO()
    whole.save(content, "PNG")
    return write_atomic(path, content.getvalue())


def _line(report: Report) -> str:
    text = f"TCP in {report.survey.in_view:.0%} of the frames"
    if report.motion.tells:
        text += f", moves with the images: {report.motion.as_is.score:.2f}"
    return text


def _panels(
    recording: Recording, reading: Reading, spec: AlignSpec, title: str, count: int
) -> Image.Image:
    chosen = _chosen(recording, count)
    panels = [_panel(recording, reading, spec, name, index) for name, index in chosen]
    rows = -(-len(panels) // COLUMNS)
    width = min(COLUMNS, len(panels)) * panels[0].width
    result = Image.new("RGB", (width, CAPTION + rows * panels[0].height), "white")
    ImageDraw.Draw(result).text((6, 4), title, "black", font=ImageFont.load_default(13))
    for number, panel in enumerate(panels):
        place = (number % COLUMNS * panel.width, CAPTION + number // COLUMNS * panel.height)
        result.paste(panel, place)
    return result


def _chosen(recording: Recording, count: int) -> list[tuple[str, int]]:
    """Frames from all over the file."""
    source = recording.source
    lengths = [source.length(name) for name in source.episodes]
    ends = np.cumsum(lengths)
    frames = np.unique(np.linspace(0, ends[-1] - 1, min(count, int(ends[-1]))).astype(int))
    chosen = []
    for frame in frames:
        episode = int(np.searchsorted(ends, frame, side="right"))
        chosen.append((source.episodes[episode], int(frame - ends[episode] + lengths[episode])))
    return chosen


def _panel(
    recording: Recording, reading: Reading, spec: AlignSpec, name: str, index: int
) -> Image.Image:
    calibrated = dataclasses.replace(recording.camera, flip=reading.flip)
    camera = motion.camera_as(calibrated, name, reading)
    stored = recording.source.image(name, recording.image_key, index)
    image = np.ascontiguousarray(calibrated.upright(stored))
    if recording.camera.dist is not None:
        image = np.asarray(undistort(image, camera.K, recording.camera.dist))
    tcp = recording.trajectory(name).tcp[index]
    scale = PANEL / camera.width
    size = (PANEL, round(camera.height * scale))
    large = np.asarray(Image.fromarray(image).resize(size))
    view = dataclasses.replace(camera.scaled(scale), height=size[1], width=size[0])
    drawn = np.asarray(_overlay(spec.axis_length)(large, view, tcp.astype(np.float32)))
    panel = Image.new("RGB", (PANEL, size[1] + CAPTION), "white")
    panel.paste(Image.fromarray(drawn), (0, 0))
    draw = ImageDraw.Draw(panel)
    uv, depth = projected(camera, tcp[None, :3, 3])
    if spec.crop is not None and np.isfinite(uv).all():
        draw.rectangle(_window(camera, uv[0], spec, scale), outline="yellow")
    caption = f"{name} frame {index}: {_place(camera, uv, float(depth[0]))}"
    if np.isfinite(uv).all():  # a white dot on a white table is none
        u, v = uv[0] * scale
        draw.ellipse([u - 5, v - 5, u + 5, v + 5], outline="black")
    draw.text((4, size[1] + 4), caption, "black", font=ImageFont.load_default(12))
    return panel


def _place(camera: Camera, uv: np.ndarray, depth: float) -> str:
    if depth <= 1e-4:
        return "TCP BEHIND THE CAMERA"
    text = f"({uv[0, 0]:.0f}, {uv[0, 1]:.0f}), {depth:.2f} m"
    return text if inside(camera, uv)[0] else f"OUTSIDE: {text}"


@cache
def _overlay(axis_length: float) -> Callable[..., jax.Array]:
    draw = partial(
        tcp_overlay, axis_length=axis_length, thickness=2, arrow_length=8, arrow_width=8,
        dot_radius=3,
    )  # fmt: skip
    return jax.jit(draw)


def _window(camera: Camera, uv: np.ndarray, spec: AlignSpec, scale: float) -> list[float]:
    """Left, top, right, bottom of the crop in a panel."""
    assert spec.crop is not None
    corner = np.floor(uv + spec.offset - spec.crop // 2)
    if spec.border == "shift":
        corner = np.clip(corner, 0, [camera.width - spec.crop, camera.height - spec.crop])
    return [*(corner * scale), *((corner + spec.crop) * scale - 1)]
