"""Frames of mp4 files, through PyAV (extra `lerobot`)."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from palm_jax.train.data.errors import ExtraMissingError, FormatError, TruncatedError


def extra(name: str) -> ModuleType:
    """A module of the extra `lerobot`.

    Raises:
      ExtraMissingError: not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExtraMissingError(
            f"LeRobot data sets need {name.partition('.')[0]!r}, which is not installed: "
            "pip install 'palm-jax[lerobot]'"
        ) from error


def _opened(path: Path) -> Any:
    """A video to read. FFmpeg is not left to guess: a playlist under a video's name makes it open
    the files that are listed there, and a name like "concat:..." is no file to it."""
    return extra("av").open(str(path.resolve()), format="mp4")


def read(path: Path, start: float, fps: float, count: int, size: int) -> Iterator[np.ndarray]:
    """Frames of a video from a time on, decoded in order: uint8 [n, H, W, 3], `size` at a time.

    Args:
      path: the video.
      start: seconds, of the first frame.
      fps: of the data set. Frame i is the one shown at start + i / fps.
      count: how many.
      size: of a block.

    Raises:
      TruncatedError: the video ends before, or has a gap.
      FormatError: not a readable video.
      ExtraMissingError: without PyAV.
    """
    av = extra("av")
    block: list[np.ndarray] = []
    found = 0
    try:
        with _opened(path) as container:
            for image in _from(container, start, fps, count):
                block.append(image)
                found += 1
                if len(block) == size:
                    yield np.stack(block)
                    block = []
    except av.FFmpegError as error:
        raise FormatError(f"{path}: not a readable video ({error}); copy it again") from error
    if block:
        yield np.stack(block)
    if found < count:
        raise TruncatedError(
            f"{path}: expected {count} frames from {start:.3f} s on, found {found}; the video is "
            "incomplete or does not belong to this table: copy it again, or save the whole "
            "episodes with `data repair`"
        )


def count(path: Path, start: float, fps: float, frames: int) -> int:
    """How many of an episode's frames a video has, without decoding them.

    Raises:
      FormatError, ExtraMissingError: see `read`.
    """
    av = extra("av")
    found = set()
    try:
        with _opened(path) as container:
            stream = container.streams.video[0]
            for packet in container.demux(stream):
                if packet.pts is not None:
                    place = round((float(packet.pts * stream.time_base) - start) * fps)
                    if 0 <= place < frames:
                        found.add(place)
    except av.FFmpegError as error:
        raise FormatError(f"{path}: not a readable video ({error}); copy it again") from error
    return len(found)


def _from(container: Any, start: float, fps: float, count: int) -> Iterator[np.ndarray]:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    if start > 0:
        # To the key frame before; half a frame earlier, since times are rounded.
        container.seek(int(max(0.0, start - 0.5 / fps) / stream.time_base), stream=stream)
    index = 0
    for frame in container.decode(stream):
        if frame.time is None:
            continue
        place = round((frame.time - start) * fps)
        if place < index:
            continue  # between the key frame and the start
        if place > index:
            return  # a gap: the caller counts
        yield frame.to_ndarray(format="rgb24")
        index += 1
        if index == count:
            return


class VideoWriter:
    """One mp4 file, frame by frame.

    Args:
      path: the file.
      fps: frames a second.
      codec: "h264" or "av1".
    """

    ENCODERS = {
        "h264": ("libx264", {"crf": "18", "preset": "veryfast", "g": "10"}),
        "av1": ("libsvtav1", {"crf": "30", "preset": "10", "g": "2"}),
    }

    def __init__(self, path: Path, fps: float, codec: str = "h264"):
        self._av = extra("av")
        self.path, self.fps, self.codec = path, fps, codec
        self.frames = 0
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = self._av.open(str(path), "w")
        self._stream: Any = None

    def write(self, images: np.ndarray) -> None:
        """Append uint8 [n, H, W, 3], H and W even."""
        if self._stream is None:
            encoder, options = self.ENCODERS[self.codec]
            rate = Fraction(self.fps).limit_denominator(1000)
            self._stream = self._container.add_stream(encoder, rate=rate, options=options)
            self._stream.height, self._stream.width = images.shape[1:3]
            self._stream.pix_fmt = "yuv420p"
        for image in images:
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts = self.frames
            frame.time_base = 1 / Fraction(self.fps).limit_denominator(1000)
            self._container.mux(self._stream.encode(frame))
            self.frames += 1

    def close(self) -> None:
        """Finish the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()
