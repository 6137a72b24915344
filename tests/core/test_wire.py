"""Messages: the convention of openpi-style clients, and what is refused."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from palm_jax import wire

ROOT = Path(__file__).resolve().parents[2]
ARRAYS = [
    np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
    np.float32([[1.5, -2]]).T,
    np.array(True),
    np.zeros((0, 3), np.int64),
    np.float64([np.nan, np.inf]),
    np.arange(6.0).reshape(2, 3).T,  # not contiguous
    np.arange(3, dtype=">i2"),
]


def plain(value: Any) -> Any:
    """What other programs of the convention put on the wire, from its description."""
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": list(value.shape),
        }
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    return value


@pytest.mark.parametrize("array", ARRAYS, ids=lambda a: f"{a.dtype}{list(a.shape)}")
def test_arrays_are_written_and_read_as_others_do(array: np.ndarray) -> None:
    message = {"image": array, "state": {"tcp": array}, "prompt": "lift the lid", "n": 3}
    theirs = msgpack.packb(plain(message))
    assert wire.pack(message) == theirs
    got = wire.unpack(theirs)
    for found in (got["image"], got["state"]["tcp"]):
        np.testing.assert_array_equal(found, array)
        assert found.dtype == array.dtype and found.shape == array.shape
    assert (got["prompt"], got["n"]) == ("lift the lid", 3)


@pytest.mark.parametrize("value", [np.float32(0.1), np.int64(-3), np.bool_(True), np.uint8(255)])
def test_scalars(value: np.generic) -> None:
    packed = wire.pack({"x": value})
    entry = msgpack.unpackb(packed)["x"]
    assert entry == {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    got = wire.unpack(packed)["x"]
    assert got == value and got.dtype == value.dtype


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.array([object()]), "arrays of object do not travel"),
        (np.array(["text"]), "only numbers"),
        (np.zeros(2, [("a", "f4")]), "do not travel"),
        (np.complex64(1j), "complex64"),
        (np.zeros(2, "M8[s]"), "do not travel"),
        (object(), "a object does not travel"),
        (2**70, "cannot pack"),
    ],
)
def test_what_does_not_travel(value: Any, words: str) -> None:
    with pytest.raises(wire.WireError, match=words):
        wire.pack({"x": value})


GOOD = plain(np.float32([1, 2]))


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({**GOOD, b"dtype": "|O"}, r"'\|O' do not travel"),
        ({**GOOD, b"dtype": "<U1"}, "do not travel"),
        ({**GOOD, b"dtype": "<f4,<f4"}, "do not travel"),
        ({**GOOD, b"dtype": "nonsense"}, "do not travel"),
        ({**GOOD, b"dtype": 4}, "do not travel"),
        ({**GOOD, b"dtype": "f" * 10_000}, "do not travel"),
        ({**GOOD, b"shape": [3]}, "does not have 8 bytes"),
        ({**GOOD, b"shape": [-1]}, "whole numbers from 0"),
        ({**GOOD, b"shape": [2.0]}, "whole numbers"),
        ({**GOOD, b"shape": [True, 2]}, "whole numbers"),
        ({**GOOD, b"shape": [2**40, 2**40, 0]}, "does not have 8 bytes"),
        ({**GOOD, b"shape": [1] * 9 + [2]}, "up to 8 sizes"),
        ({**GOOD, b"shape": None}, "up to 8 sizes"),
        ({**GOOD, b"data": "text"}, "needs bytes"),
        ({b"__ndarray__": True}, "do not travel"),
        ({b"__npgeneric__": True, b"dtype": "<f4"}, "needs a number"),
        ({b"__npgeneric__": True, b"data": "1", b"dtype": "<f4"}, "needs a number"),
        ({b"__npgeneric__": True, b"data": 1, b"dtype": "|O"}, "do not travel"),
        ({b"__npgeneric__": True, b"data": 300, b"dtype": "|u1"}, "uint8 cannot be 300"),
        ({b"__npgeneric__": True, b"data": float("inf"), b"dtype": "<i8"}, "cannot be inf"),
        ({b"__npgeneric__": True, b"data": float("nan"), b"dtype": "<i8"}, "cannot be nan"),
    ],
)
def test_arrays_that_are_none(entry: dict[bytes, Any], words: str) -> None:
    with pytest.raises(wire.WireError, match=words):
        wire.unpack(msgpack.packb({"x": entry}))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x81\xa1x",  # ends early
        wire.pack({"x": 1}) + b"\x00",
        b"\xa2\xff\xfe",  # not UTF-8
        msgpack.packb({1: 2}),
        msgpack.packb([0] * 5000),  # an array's worth of objects
        bytes([0x91]) * 3000 + b"\x00",  # nested without end
        b"\xdd\xff\xff\xff\xff",  # four thousand million entries, says the head
        b"\x80\x04\x95\x0b\x00",  # how a pickle begins
    ],
    ids=range(10),
)
def test_messages_that_are_none(data: bytes) -> None:
    with pytest.raises(wire.WireError, match="not a MessagePack message"):
        wire.unpack(data)


def test_the_clients_process_has_no_jax() -> None:
    code = (
        "import sys, palm_jax.policy_client as c; c.PolicyClient; "
        "print(sorted({'jax', 'jaxlib', 'flax', 'mujoco', 'palm_jax.train', 'palm_jax.align'} "
        "& set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.strip() == "[]", run.stderr
