"""Read tensors from `.safetensors`, `.pth` and `.pt` files without torch, executing nothing.

A `.pth` file is a pickle, and a pickle is a program. The unpickler here knows a handful of names
(an ordered dict, the torch storages, the function that makes a tensor out of one) and refuses every
other, so that a file can at worst fail to load. Both of torch's layouts are read: the zip archive
(since torch 1.6) and the older stream of pickles.
"""

import collections
import dataclasses
import hashlib
import io
import json
import math
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_STORAGES = {
    "FloatStorage": np.dtype("<f4"),
    "DoubleStorage": np.dtype("<f8"),
    "HalfStorage": np.dtype("<f2"),
    "BFloat16Storage": np.dtype(ml_dtypes.bfloat16),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("<i1"),
    "ByteStorage": np.dtype("<u1"),
    "BoolStorage": np.dtype(bool),
}
_SAFETENSORS = {
    "F64": np.dtype("<f8"),
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "BF16": np.dtype(ml_dtypes.bfloat16),
    "I64": np.dtype("<i8"),
    "I32": np.dtype("<i4"),
    "I16": np.dtype("<i2"),
    "I8": np.dtype("<i1"),
    "U8": np.dtype("<u1"),
    "BOOL": np.dtype(bool),
}


def read_tensors(path: str | Path) -> tuple[dict[str, np.ndarray], str]:
    """All tensors of a flat state dict, and the file's SHA-256.

    Args:
      path: a `.safetensors` file, or a state dict written by `torch.save`.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: not one of these formats, damaged, or a pickle that asks for more than tensors.
    """
    data = Path(path).read_bytes()
    digest = hashlib.sha256(data).hexdigest()
    read: Callable[[bytes], dict[str, np.ndarray]]
    if Path(path).suffix == ".safetensors":
        read = _read_safetensors
    elif data[:4] == b"PK\x03\x04":
        read = _read_zip
    else:
        read = _read_legacy
    try:
        return read(data), digest
    # Damaged bytes make pickle and zipfile raise all of these; the last is zipfile's word for a
    # compression or an encryption that it does not know.
    except (
        ValueError, KeyError, IndexError, TypeError, AttributeError, EOFError,
        RecursionError, MemoryError, OverflowError, UnicodeDecodeError,
        pickle.UnpicklingError, zipfile.BadZipFile, NotImplementedError,
    ) as error:  # fmt: skip
        raise ValueError(f"{path}: not a readable state dict: {error}") from error


def _read_safetensors(data: bytes) -> dict[str, np.ndarray]:
    length = int.from_bytes(data[:8], "little")
    if not 2 <= length <= len(data) - 8:
        raise ValueError(f"header of {length} bytes in a file of {len(data)}")
    header = json.loads(data[8 : 8 + length])
    body = data[8 + length :]
    tensors = {}
    for name, entry in header.items():
        if name == "__metadata__":
            continue
        if entry["dtype"] not in _SAFETENSORS:
            raise ValueError(f"{name} has the unsupported type {entry['dtype']}")
        dtype = _SAFETENSORS[entry["dtype"]]
        begin, end = entry["data_offsets"]
        shape = tuple(entry["shape"])
        if not (0 <= begin <= end <= len(body)) or end - begin != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{name}: bytes {begin}..{end} do not hold shape {shape}")
        tensors[name] = np.frombuffer(body[begin:end], dtype).reshape(shape)
    return tensors


@dataclasses.dataclass(frozen=True)
class _Storage:
    key: str
    dtype: np.dtype
    count: int


@dataclasses.dataclass(frozen=True)
class _Tensor:
    """What a pickle says about a tensor; its numbers lie elsewhere in the file."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def resolve(self, raw: bytes) -> np.ndarray:
        """Copy the tensor out of its storage's bytes; every index is checked to lie inside."""
        if len(raw) != self.storage.count * self.storage.dtype.itemsize:
            raise ValueError(
                f"storage {self.storage.key} has {len(raw)} bytes, expected {self.storage.count} "
                f"numbers of {self.storage.dtype.itemsize}"
            )
        numbers = np.frombuffer(raw, self.storage.dtype)
        if len(self.strides) != len(self.shape) or min((*self.shape, *self.strides, 0)) < 0:
            raise ValueError(f"tensor of shape {self.shape} with strides {self.strides}")
        reach = sum((n - 1) * s for n, s in zip(self.shape, self.strides, strict=True))
        size = math.prod(self.shape)
        if size and not 0 <= self.offset <= self.offset + reach < len(numbers):
            raise ValueError(f"tensor of shape {self.shape} reaches beyond its storage")
        if size > len(numbers):
            raise ValueError(f"tensor of shape {self.shape} is larger than its storage")
        view = np.lib.stride_tricks.as_strided(
            numbers[self.offset :] if size else numbers[:0],
            self.shape,
            tuple(s * numbers.itemsize for s in self.strides),
        )
        return view.copy()


def _rebuild_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *unused: Any) -> _Tensor:
    del unused  # requires_grad, hooks, metadata
    if not isinstance(storage, _Storage):
        raise pickle.UnpicklingError("a tensor without a storage")
    return _Tensor(
        storage, int(offset), tuple(int(n) for n in shape), tuple(int(n) for n in strides)
    )


def _rebuild_parameter(tensor: Any, *unused: Any) -> Any:
    del unused
    return tensor


_ALLOWED: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
    **{("torch", name): name for name in _STORAGES},
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(
                f"the file asks for {module}.{name}, which a plain state dict does not need; "
                "refused, because unpickling it could run code. Save model.state_dict() instead"
            )
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> _Storage:
        kind, storage_type, key, _, count, *view = pid
        if kind != "storage" or storage_type not in _STORAGES or any(view):
            raise pickle.UnpicklingError(f"unsupported storage {pid!r}")
        return _Storage(str(key), _STORAGES[storage_type], int(count))


def _flat_tensors(loaded: Any) -> dict[str, _Tensor]:
    if not isinstance(loaded, dict):
        raise ValueError(f"expected a dict of tensors, got {type(loaded).__name__}")
    if set(loaded) >= {"state_dict"} and isinstance(loaded["state_dict"], dict):
        loaded = loaded["state_dict"]
    wrong = [str(k) for k, v in loaded.items() if not isinstance(v, _Tensor)]
    if wrong:
        raise ValueError(f"these entries are not tensors: {', '.join(wrong[:5])}")
    return {str(name): tensor for name, tensor in loaded.items()}


def _read_zip(data: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = archive.namelist()
        # torch.save compresses nothing: what unpacks to more than the file is no state dict.
        if sum(entry.file_size for entry in archive.infolist()) > len(data):
            raise ValueError("the archive unpacks to more than its own size")
        pickles = [name for name in names if name.split("/")[1:] == ["data.pkl"]]
        if len(pickles) != 1:
            raise ValueError("the archive has no data.pkl: not written by torch.save")
        root = pickles[0].split("/")[0]
        if f"{root}/byteorder" in names and archive.read(f"{root}/byteorder") != b"little":
            raise ValueError("written on a big-endian machine, which is not supported")
        tensors = _flat_tensors(_Unpickler(io.BytesIO(archive.read(pickles[0]))).load())
        return {
            name: tensor.resolve(archive.read(f"{root}/data/{tensor.storage.key}"))
            for name, tensor in tensors.items()
        }


def _read_legacy(data: bytes) -> dict[str, np.ndarray]:
    stream = io.BytesIO(data)
    if _Unpickler(stream).load() != LEGACY_MAGIC:
        raise ValueError("not written by torch.save, and not a .safetensors file")
    _Unpickler(stream).load()  # protocol version
    _Unpickler(stream).load()  # sizes of the writer's types
    tensors = _flat_tensors(_Unpickler(stream).load())
    sizes = {t.storage.key: t.storage.dtype.itemsize for t in tensors.values()}
    storages = {}
    for key in _Unpickler(stream).load():
        count = int.from_bytes(stream.read(8), "little", signed=True)
        storages[key] = stream.read(count * sizes[key])
    return {name: tensor.resolve(storages[tensor.storage.key]) for name, tensor in tensors.items()}
