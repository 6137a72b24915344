"""Videos of episodes: what the policy sees, enlarged, beside the camera's frame, with a caption."""

import functools
import io
import math
import shutil
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import imageio_ffmpeg
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from palm_jax.train.files.metrics import write_atomic
from palm_jax.train.reporting import paper
from palm_jax.train.reporting.figures import look

ImageArray = NDArray[np.uint8]


@functools.lru_cache(maxsize=8)
def _font(size: int, bold: bool = False) -> Any:
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", name)), size)


def _scaled(image: ImageArray, height: int) -> Image.Image:
    """Enlarge by a whole factor where possible, else to `height`, without smoothing."""
    source = Image.fromarray(np.ascontiguousarray(image))
    if source.height == height:
        return source
    width = round(source.width * height / source.height)
    return source.resize((width, height), Image.Resampling.NEAREST)


def compose_frame(
    policy_input: ImageArray,
    full_frame: ImageArray,
    *,
    method: str,
    domain: str,
    step: int,
    steps: int | None = None,
    success: bool | None = None,
    task: str = "",
    height: int = 336,
) -> ImageArray:
    """One video frame: what the policy sees, enlarged, beside the camera's frame, with a caption.

    Args:
      policy_input: uint8 [h, w, 3], enlarged without smoothing so that its pixels show.
      full_frame: uint8 [H, W, 3] for the human.
      method, domain, task: for the caption.
      step: control step; with `steps` it reads "12 / 120".
      success: None while it is open, then the outcome.
      height: of both pictures, pixels.

    Returns:
      uint8 [height + caption, width, 3], both even (what H.264 needs).
    """
    for name, image in (("policy_input", policy_input), ("full_frame", full_frame)):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(
                f"{name}: expected uint8 [height, width, 3], got {image.dtype} {image.shape}"
            )
    left, right = _scaled(policy_input, height), _scaled(full_frame, height)
    gap, caption = 6, 60
    width = left.width + gap + right.width
    canvas = Image.new("RGB", (width + width % 2, height + caption + height % 2), "#15171a")
    canvas.paste(left, (0, 0))
    canvas.paste(right, (left.width + gap, 0))
    draw = ImageDraw.Draw(canvas)
    edge, first, second = 16, height + 21, height + 43
    draw.rectangle([(0, height), (6, canvas.height)], fill=look(method).colour)
    draw.text(
        (edge, first), paper.method_label(method), font=_font(17, True), fill="white", anchor="lm"
    )
    state, tint = _state(step, steps, success)
    draw.text((canvas.width - 14, first), state, font=_font(15, True), fill=tint, anchor="rm")
    words = " · ".join(
        word for word in (paper.task_label(task), paper.domain_title(domain)) if word
    )
    draw.text(
        (edge, second),
        _shortened(draw, words, canvas.width - 2 * edge),
        font=_font(13),
        fill="#c9cdd3",
        anchor="lm",
    )
    if success is not None:
        # The outcome also as a bar, to be seen from afar.
        draw.rectangle([(0, height), (canvas.width, height + 3)], fill=tint)
    return np.asarray(canvas)


def _state(step: int, steps: int | None, success: bool | None) -> tuple[str, str]:
    where = f"step {step}" + (f" / {steps}" if steps else "")
    if success is None:
        return where, "#c9cdd3"
    return (f"success, {where}", "#5cc8ff") if success else (f"failure, {where}", "#ff9a5c")


def _shortened(draw: ImageDraw.ImageDraw, text: str, room: float) -> str:
    if draw.textlength(text, font=_font(14)) <= room:
        return text
    while text and draw.textlength(text + "…", font=_font(14)) > room:
        text = text[:-1]
    return text.rstrip() + "…" if text else ""


def episode_frames(
    policy_inputs: Sequence[ImageArray] | ImageArray,
    full_frames: Sequence[ImageArray] | ImageArray,
    *,
    method: str,
    domain: str,
    success: bool,
    task: str = "",
    height: int = 336,
    hold: int = 12,
) -> list[ImageArray]:
    """All frames of one episode; the last is shown `hold` frames longer, with the outcome.

    Args:
      policy_inputs, full_frames: T pictures each, uint8 [T, h, w, 3].
      method, domain, success, task, height: as in `compose_frame`.
      hold: frames to stay on the end.
    """
    if len(policy_inputs) != len(full_frames):
        raise ValueError(
            f"expected as many policy inputs as full frames, got {len(policy_inputs)} and "
            f"{len(full_frames)}"
        )
    total = len(full_frames)
    frames = [
        compose_frame(
            policy_inputs[i],
            full_frames[i],
            method=method,
            domain=domain,
            task=task,
            step=i + 1,
            steps=total,
            success=success if i == total - 1 else None,
            height=height,
        )
        for i in range(total)
    ]
    return frames + frames[-1:] * hold


def side_by_side(
    videos: Sequence[Sequence[ImageArray]], *, columns: int = 2, gap: int = 8
) -> Iterator[ImageArray]:
    """Play several videos in one picture; shorter ones stay on their last frame.

    Args:
      videos: lists of equally sized uint8 frames.
      columns: per row.
      gap: pixels between them.
    """
    if not videos or not all(len(video) for video in videos):
        raise ValueError("expected at least one video, and no empty one")
    height = max(video[0].shape[0] for video in videos)
    width = max(video[0].shape[1] for video in videos)
    columns = min(columns, len(videos))
    rows = math.ceil(len(videos) / columns)
    for time in range(max(map(len, videos))):
        sheet = np.full(
            (rows * height + (rows - 1) * gap, columns * width + (columns - 1) * gap, 3),
            255,
            np.uint8,
        )
        for index, video in enumerate(videos):
            frame = video[min(time, len(video) - 1)]
            top = (index // columns) * (height + gap)
            left = (index % columns) * (width + gap)
            sheet[top : top + frame.shape[0], left : left + frame.shape[1]] = frame
        yield sheet


def write_video(path: Path, frames: Iterable[ImageArray], *, fps: int = 20) -> Path:
    """Write frames as MP4 (H.264, yuv420p: what every browser plays), whole or not at all.

    Without a working ffmpeg an animated GIF is written instead, at half the rate and size, with a
    warning; pip installs an ffmpeg with `imageio[ffmpeg]`, which this package depends on, so that
    is for platforms without a binary.

    Args:
      path: RUN/videos/name.mp4.
      frames: equally sized uint8 [H, W, 3]; odd sizes lose their last row or column.
      fps: frames a second; 20 is real time at the package's control rate.

    Returns:
      the file written: `path`, or the same with `.gif`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = (frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames)
    if not has_ffmpeg():
        warnings.warn(
            "no ffmpeg found, writing a GIF: `pip install imageio-ffmpeg` for MP4", stacklevel=2
        )
        return _write_gif(path.with_suffix(".gif"), frames, fps=fps)
    temporary = path.with_name("." + path.stem + ".tmp.mp4")
    writer = imageio.get_writer(
        temporary,
        format="FFMPEG",
        fps=fps,
        codec="libx264",
        pixelformat="yuv420p",  # type: ignore[arg-type]
        macro_block_size=2,
        quality=None,
        ffmpeg_log_level="error",
        output_params=["-crf", "23", "-preset", "medium", "-movflags", "+faststart"],
    )
    with warnings.catch_warnings():
        # The child of this fork runs ffmpeg at once: none of JAX's threads can be missed in it.
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        try:
            for frame in frames:
                writer.append_data(frame)
        finally:
            writer.close()
    temporary.replace(path)
    return path


def has_ffmpeg() -> bool:
    """Whether an ffmpeg binary is there: imageio-ffmpeg's own, or one on the PATH."""
    try:
        return bool(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError:
        return shutil.which("ffmpeg") is not None


def _write_gif(path: Path, frames: Iterable[ImageArray], *, fps: int) -> Path:
    pictures = [
        Image.fromarray(np.ascontiguousarray(frame[::2, ::2]))
        for index, frame in enumerate(frames)
        if index % 2 == 0
    ]
    content = io.BytesIO()
    pictures[0].save(
        content,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        loop=0,
        duration=round(2000 / fps),
    )
    return write_atomic(path, content.getvalue())
