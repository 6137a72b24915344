"""Reading a folder of pictures, for the user's own backgrounds."""

import hashlib
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".webp"}
_FORMATS = ("PNG", "JPEG", "BMP", "WEBP")


MOST = 512  # pictures of a folder


def read_folder(folder: Path, size: int, *, most: int = MOST) -> np.ndarray:
    """Up to `most` pictures of a folder, by name, as uint8 [K, size, size, 3] (aspect ignored).

    Raises:
      ValueError: no picture in the folder, or one that cannot be read (it is named).
    """
    pictures = []
    for file in _files(folder, most):
        try:
            # Named, because Pillow starts Ghostscript for a file that is PostScript inside.
            with Image.open(file, formats=_FORMATS) as picture:
                pictures.append(np.asarray(picture.convert("RGB").resize((size, size))))
        except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
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
