"""Messages with NumPy arrays as MessagePack, in the convention of openpi-style policy servers.

An array is a map of four entries whose names are bytes: `__ndarray__` (true), `data` (its bytes, C
order), `dtype` (NumPy's short name with the byte order, such as "<f4") and `shape`; a NumPy scalar
one of `__npgeneric__`, `data` (its value) and `dtype`. Only numbers and booleans travel: nothing is
pickled, and what is received can at worst be refused.
"""

import math
from typing import Any

import msgpack
import numpy as np

KINDS = "biuf"  # of dtypes: bool, integers, floats
MAX_DIMS = 8
MAX_ENTRIES = 4096  # of a list or a map: what is longer is an array, or no message of ours


class WireError(ValueError):
    """A message that cannot be packed, or that is not one."""


def pack(message: Any) -> bytes:
    """A message of dicts, lists, strings, numbers, booleans, None and NumPy arrays as bytes.

    Raises:
      WireError: something else in it, which is named, or an array of objects.
    """
    try:
        packed: bytes = msgpack.packb(message, default=_encode)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"cannot pack this message: {error}") from error
    return packed


def unpack(data: bytes) -> Any:
    """The message; its arrays are read-only views of `data`.

    Raises:
      WireError: not MessagePack, or an array that is none, or of another kind than numbers.
    """
    try:
        return msgpack.unpackb(
            data, object_hook=_decode, max_array_len=MAX_ENTRIES, max_map_len=MAX_ENTRIES
        )
    except WireError:
        raise
    except (ValueError, TypeError, msgpack.UnpackException, RecursionError) as error:
        raise WireError(f"not a MessagePack message: {error or type(error).__name__}") from error


def _encode(value: Any) -> dict[bytes, Any]:
    if isinstance(value, (np.ndarray, np.generic)):
        if value.dtype.kind not in KINDS:
            raise TypeError(f"arrays of {value.dtype} do not travel, only numbers and booleans")
        if isinstance(value, np.generic):
            return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    raise TypeError(f"a {type(value).__name__} does not travel")


def _decode(entry: dict[Any, Any]) -> Any:
    if b"__npgeneric__" in entry:
        value = entry.get(b"data")
        if not isinstance(value, (bool, int, float)):
            raise WireError(f"a scalar needs a number, got a {type(value).__name__}")
        dtype = _dtype(entry)
        try:
            return dtype.type(value)
        except (OverflowError, ValueError) as error:
            raise WireError(f"a scalar of {dtype} cannot be {value!r}") from error
    if b"__ndarray__" not in entry:
        return entry
    dtype, data, shape = _dtype(entry), entry.get(b"data"), entry.get(b"shape")
    if not isinstance(data, bytes) or not isinstance(shape, list) or len(shape) > MAX_DIMS:
        raise WireError(f"an array needs bytes and up to {MAX_DIMS} sizes, got shape {shape!r}")
    if not all(type(size) is int and size >= 0 for size in shape):
        raise WireError(f"an array's sizes are whole numbers from 0, got {shape!r}")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise WireError(f"an array {shape} of {dtype} does not have {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape)


def _dtype(entry: dict[Any, Any]) -> np.dtype[Any]:
    name = entry.get(b"dtype")
    try:
        dtype = np.dtype(name) if isinstance(name, str) and len(name) <= 8 else None
    except TypeError:
        dtype = None
    if dtype is None or dtype.kind not in KINDS:
        raise WireError(f"arrays of {name!r} do not travel, only numbers and booleans")
    return dtype
