"""Reading a folder of pictures, for the user's own backgrounds."""

from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".webp"}
FORMATS = ("PNG", "JPEG", "BMP", "WEBP")
"""Named to Pillow, which starts Ghostscript for a file that is PostScript inside."""


def read_folder(folder: Path, size: int, *, most: int = 512) -> np.ndarray:
    """Up to `most` pictures of a folder, by name, as uint8 [K, size, size, 3] (aspect ignored).

    Raises:
      ValueError: no picture in the folder, or one that cannot be read (it is named).
    """
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in _SUFFIXES)[:most]
    if not files:
        raise ValueError(f"{folder} holds no picture ({', '.join(sorted(_SUFFIXES))})")
    pictures = []
    for file in files:
        try:
            with Image.open(file, formats=FORMATS) as picture:
                pictures.append(np.asarray(picture.convert("RGB").resize((size, size))))
        except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
            raise ValueError(f"{file} cannot be read as a picture: {error}") from error
    return np.stack(pictures)
