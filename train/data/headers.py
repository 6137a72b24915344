"""What files say of themselves, checked once where it is read, so that nothing later stumbles.

Everything here takes what JSON or a table gave, and raises `FormatError` with the place, what was
expected and what came.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from palm_jax.train.data.errors import FormatError

ROW_NUMBERS = ("episode_index", "length", "data/chunk_index", "data/file_index",
               "dataset_from_index", "dataset_to_index")  # fmt: skip
VIDEO_NUMBERS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, and not a truth value."""
    known = isinstance(value, (int, float, np.integer, np.floating))
    # Whole numbers of JSON may be longer than any of NumPy's.
    return known and not isinstance(value, bool) and abs(value) < 2**63


def parsed(text: Any, where: str) -> dict[str, Any]:
    """The object that a text is, as JSON.

    Raises:
      FormatError: it is none.
    """
    try:
        content = json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise FormatError(f"{where}: expected JSON, got {_shown(text)} ({error})") from error
    return an_object(content, where)


def an_object(content: Any, where: str) -> dict[str, Any]:
    """`content`, if it is a JSON object.

    Raises:
      FormatError: it is none.
    """
    if not isinstance(content, dict):
        raise FormatError(f"{where}: expected an object {{...}}, got {_shown(content)}")
    return content


def rate(value: Any, where: str) -> float:
    """Frames a second.

    Raises:
      FormatError: not a number above 0.
    """
    if not is_number(value) or value <= 0:
        raise FormatError(f"{where}: expected frames a second, got {_shown(value)}")
    return float(value)


def count(value: Any, where: str) -> int:
    """How many there are of something.

    Raises:
      FormatError: not a whole number of at least 0.
    """
    if not is_number(value) or value < 0 or value != int(value):
        raise FormatError(f"{where}: expected a whole number of at least 0, got {_shown(value)}")
    return int(value)


def camera_info(text: Any, where: str) -> dict[str, dict[str, Any]]:
    """robosuite's matrices: camera name -> {"intrinsics": 3 x 3, "extrinsics": 4 x 4}.

    Raises:
      FormatError: something else.
    """
    content = parsed(text, where)
    for name, entry in content.items():
        an_object(entry, f"{where}: {name}")
        for key, size in (("intrinsics", 3), ("extrinsics", 4)):
            if not _is_matrix(entry.get(key), size):
                raise FormatError(
                    f"{where}: {name}: {key}: expected {size} x {size} finite numbers, got "
                    f"{_shown(entry.get(key))}"
                )
    return content


def _is_matrix(value: Any, size: int) -> bool:
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    return matrix.shape == (size, size) and bool(np.isfinite(matrix).all())


def lerobot_info(info: Mapping[str, Any], where: str) -> None:
    """Checks what is used of LeRobot's meta/info.json.

    Raises:
      FormatError: an entry is missing, or not what it should be.
    """
    rate(info.get("fps"), f"{where}: fps")
    features = an_object(info.get("features"), f"{where}: features")
    for key, entry in features.items():
        shape = an_object(entry, f"{where}: features: {key}").get("shape")
        sizes = isinstance(shape, list) and all(is_number(s) and s == int(s) > 0 for s in shape)
        if not sizes or not isinstance(entry.get("dtype"), str):
            raise FormatError(
                f"{where}: features: {key}: expected a dtype, and a shape of whole numbers, got "
                f"{_shown(entry)}"
            )
        an_object(entry.get("info") or {}, f"{where}: features: {key}: info")
    _path(info.get("data_path"), f"{where}: data_path")
    for key, entry in features.items():
        if entry["dtype"] == "video":
            _path(info.get("video_path"), f"{where}: video_path", video_key=key)


def _path(value: Any, where: str, **names: Any) -> None:
    """Checks a path with places for numbers, such as data/chunk-{chunk_index:03d}/..."""
    try:
        if isinstance(value, str):
            value.format(chunk_index=0, file_index=0, **names)
            return
    except (LookupError, ValueError, AttributeError, TypeError):
        pass
    raise FormatError(
        f"{where}: expected a path with {{chunk_index}} and {{file_index}}, got {_shown(value)}"
    )


def lerobot_rows(rows: Sequence[Mapping[str, Any]], videos: Sequence[str], where: str) -> None:
    """Checks what is used of LeRobot's meta/episodes.

    Args:
      rows: one an episode.
      videos: keys of features that are stored as videos.
      where: the rows are.

    Raises:
      FormatError: an entry is missing, or not what it should be; an episode that comes twice.
    """
    wanted = [*ROW_NUMBERS, *(f"videos/{key}/{name}" for key in videos for name in VIDEO_NUMBERS)]
    for number, row in enumerate(rows):
        for key in wanted:
            if not is_number(row.get(key)) or row[key] < 0:
                raise FormatError(
                    f"{where}: row {number}: {key}: expected a number of at least 0, got "
                    f"{_shown(row.get(key))}"
                )
    indices = [row["episode_index"] for row in rows]
    if len(set(indices)) < len(indices):
        raise FormatError(f"{where}: expected each episode_index once, got one of them twice")


def _shown(value: Any) -> str:
    """A value for a message."""
    if value is None:
        return "nothing"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
