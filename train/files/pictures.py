"""Reading pictures: the one place where Pillow opens what somebody else has made."""

import hashlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".webp"}
FORMATS = ("PNG", "JPEG", "BMP", "WEBP")
"""All that is read. Pillow goes by the content and knows many more; for PostScript, whatever the
file's name, it starts Ghostscript, which runs the program that such a file is."""


def rgb(source: Path | BinaryIO, size: int | None = None) -> np.ndarray:
    """A picture as uint8 [H, W, 3].

    Args:
      source: its file, or its bytes as a file.
      size: height and width to resize to (aspect ignored); None for its own.

    Raises:
      ValueError: it is of none of the `FORMATS`, damaged or too large; the message says which, not
        where.
    """
    try:
        with Image.open(source, formats=FORMATS) as picture:
            found = picture.convert("RGB")
            return np.asarray(found if size is None else found.resize((size, size)))
    # Damaged PNG files end in a SyntaxError; too many pixels in an error, or a warning first.
    except (
        OSError, ValueError, SyntaxError, Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ) as error:  # fmt: skip
        words = f"not a whole picture of the kinds {', '.join(FORMATS)} ({error})"
        raise ValueError(words) from error


MOST = 512  # pictures of a folder


def read_folder(folder: Path, size: int, *, most: int = MOST) -> np.ndarray:
    """Up to `most` pictures of a folder, by name, as uint8 [K, size, size, 3] (aspect ignored).

    Raises:
      ValueError: no picture in the folder, or one that cannot be read (it is named).
    """
    pictures = []
    for file in _files(folder, most):
        try:
            pictures.append(rgb(file, size))
        except ValueError as error:
            raise ValueError(f"{file} cannot be read as a picture: {error}") from error
    return np.stack(pictures)


def digest(folder: Path, *, most: int = MOST) -> str:
    """SHA-256 of the pictures that `read_folder` reads, in their order.

    Raises:
      ValueError: no picture in the folder.
    """
    found = hashlib.sha256()
    for file in _files(folder, most):
        content = file.read_bytes()
        found.update(f"{len(content)} ".encode() + content)
    return found.hexdigest()


def _files(folder: Path, most: int) -> list[Path]:
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in _SUFFIXES)[:most]
    if not files:
        raise ValueError(f"{folder} holds no picture ({', '.join(sorted(_SUFFIXES))})")
    return files
