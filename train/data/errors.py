"""What can be wrong with a user's data, each case an error of its own.

A message says what was expected, what came, and what to do. The commands print `NAME: message` and
end with exit code 2; nothing half-written is left and the input is never touched.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class DataError(ValueError):
    """Something about a data file, a calibration or an option; see the subclasses."""


class FormatError(DataError):
    """Not a file of a known format, or one that lacks what its format demands."""


class TruncatedError(FormatError):
    """A file that ends too early: an interrupted copy, download or recording."""


class KeyMissingError(DataError):
    """A key that is not in the file."""


class ExtraMissingError(DataError):
    """A format whose libraries are not installed."""


class CalibrationError(DataError):
    """A calibration that is missing, unreadable, or describes no camera."""


class CameraNameError(CalibrationError):
    """A camera that is not in the calibration, or has no images in the file."""


class ImageSizeError(CalibrationError):
    """Intrinsics for another resolution than that of the images."""


class EulerAmbiguityError(CalibrationError):
    """Three angles, or four numbers of a quaternion, without the order in which to read them."""


class TcpBehindCameraError(CalibrationError):
    """The TCP lies behind the camera: extrinsics inverted, or axes of another convention."""


class TcpOutOfViewError(CalibrationError):
    """The TCP lies outside of the image in too many frames."""


class ImageOrientationError(CalibrationError):
    """The images are mirrored, upside down or turned against the calibration."""


class ReprojectionError(CalibrationError):
    """The TCP is computed elsewhere than it was measured in the images."""


class PoseDataError(DataError):
    """Poses that are not finite or not rigid."""


class OpeningError(DataError):
    """A gripper whose range is not known."""


class EpisodeLengthError(DataError):
    """An episode with a single frame, or with arrays of different lengths."""


class OutputError(DataError):
    """An output that exists already, or was begun by another command."""


class DiskFullError(DataError):
    """No space for the output."""


NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_disk_full(error: BaseException) -> bool:
    """Whether the system had no space left, also where HDF5 only says so in its message."""
    if isinstance(error, OSError) and error.errno in NO_SPACE:
        return True
    text = str(error)
    return any(f"errno = {code}," in text for code in NO_SPACE)


@contextmanager
def disk_full(path: Path, advice: str) -> Iterator[None]:
    """Turns a failure for want of space into a `DiskFullError`.

    Args:
      path: what was being written.
      advice: what is left and what to do, for the message.
    """
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, DataError) or not is_disk_full(error):
            raise
        raise DiskFullError(f"{path}: no space left on the device; {advice}") from error
