"""Messages to a policy server that no client of ours would send."""

import contextlib
import random
import socket
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
from faults.cases import Outcome, case
from faults.fuzz import SECONDS, SHORT, mutate
from serving import LIMIT, raw, serving
from websockets.exceptions import ConnectionClosed

from palm_jax import wire
from palm_jax.train.policy import Decision

REQUEST: dict[str, Any] = {
    "image": np.zeros((20, 30, 3), np.uint8), "K": np.eye(3), "cam_to_world": np.eye(4),
    "tcp": np.eye(4), "opening": 0.25,
}  # fmt: skip


def _decide(*observation: Any, mask: Any) -> Decision:
    """Stands in for a policy that checks what it is given."""
    image, _, _, tcp, opening = map(np.asarray, observation)
    if image.dtype != np.uint8 or image.shape != (20, 30, 3) or tcp.shape != (4, 4):
        raise ValueError("image, tcp: expected other shapes")
    return Decision(np.eye(4, dtype=np.float32), float(opening), np.zeros(10, np.float32), 1.0)


def _served(client: Any) -> None:
    """A right request is answered with an action."""
    client.send(wire.pack(REQUEST))
    answer = wire.unpack(client.recv(timeout=10))
    assert answer["actions"].shape == (1, 10) and answer["gripper"] == 0.25


def _array(data: bytes, dtype: str, shape: list[Any]) -> dict[bytes, Any]:
    return {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}


def _with(name: str, value: Any) -> bytes:
    return wire.pack({**REQUEST, name: value})


_PICKLE = b"cos\nsystem\n(S'true'\ntR."
_WRONG: dict[str, tuple[str | bytes, str]] = {
    "is a text": ("act!", "expected a binary MessagePack message"),
    "is no MessagePack": (b"\xc1\x00", "not a MessagePack message"),
    "is cut in half": (wire.pack(REQUEST)[:1000], "not a MessagePack message"),
    "is a list": (wire.pack([1, 2]), "expected a map, got a list"),
    "lacks an entry": (wire.pack({"image": 0}), "missing K, cam_to_world, tcp, opening"),
    "has a few bytes too many": (b"\x00" * (LIMIT + 1), f"at most {LIMIT} bytes"),
    "says that it has 2^32 entries": (b"\xdf\xff\xff\xff\xff\xa1a", "not a MessagePack message"),
    "is nested without end": (b"\x91" * 9_000, "not a MessagePack message"),
    "has an array of other bytes than its shape": (
        _with("tcp", _array(bytes(8), "<f8", [4, 4])), "does not have 8 bytes"
    ),
    "has an array of 2^80 numbers": (_with("tcp", _array(b"", "<f8", [2**40, 2**40])), "an array"),
    "has an array of objects, a pickle": (
        _with("tcp", _array(_PICKLE, "|O", [1])), "do not travel"
    ),
    "has an image of another size": (
        _with("image", np.zeros((2, 2, 3), np.uint8)), "expected other shapes"
    ),
}  # fmt: skip


for _name, (_message, _words) in _WRONG.items():

    @case("server", f"a message {_name}", message=_message, words=_words)
    def _wrong(folder: Path, message: str | bytes, words: str) -> Outcome:
        with serving(_decide, {"method": "palm"}) as port, raw(port) as client:
            client.recv(timeout=10)
            client.send(message)
            answer = client.recv(timeout=10)
            assert isinstance(answer, str) and words in answer, answer
            _served(client)
        return Outcome("answered in words; the connection stays")


@case("server", "a message is many times too large")
def _far_too_large(folder: Path) -> Outcome:
    with serving(_decide, {"method": "palm"}) as port, raw(port) as other:
        other.recv(timeout=10)
        with raw(port) as client:
            client.recv(timeout=10)
            try:
                client.send(bytes(100 * LIMIT))
                client.recv(timeout=10)
            except ConnectionClosed:
                pass
            else:
                raise AssertionError("it was read")
        _served(other)
    return Outcome("its connection is closed unread, the others stay", "that connection")


_UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
_BYTES = {
    "no HTTP": b"\x00\xff" * 100,
    "headers without end": b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 20_000,
    "half a request": b"GET / HTTP/1.1\r\nHost: x\r\n",
    "a frame that says that it has 2^40 bytes": (
        _UPGRADE + b"\x82\xff" + struct.pack(">Q", 2**40) + b"mask"
    ),
}

for _name, _content in _BYTES.items():

    @case("server", f"the connection brings {_name}", content=_content)
    def _bytes(folder: Path, content: bytes) -> Outcome:
        with serving(_decide, {"method": "palm"}) as port, raw(port) as other:
            other.recv(timeout=10)
            bad = socket.create_connection(("127.0.0.1", port))
            with contextlib.closing(bad), contextlib.suppress(ConnectionError):
                bad.sendall(content)
                _served(other)
            _served(other)
        return Outcome("ends by itself; the others are served", "that connection")


for _long in (False, True):

    @case("fuzzing", f"a server's messages, for {SECONDS if _long else SHORT:g} s", long=_long,
          seconds=SECONDS if _long else SHORT)  # fmt: skip
    def _fuzzed(folder: Path, seconds: float) -> Outcome:
        good, rng = wire.pack(REQUEST), random.Random(1)
        with serving(_decide, {"method": "palm"}) as port, raw(port) as client:
            client.recv(timeout=10)
            end, tried = time.monotonic() + seconds, 0
            while time.monotonic() < end or tried < 20:
                client.send(mutate(good, rng))
                tried += 1
                answer = client.recv(timeout=10)
                assert not isinstance(answer, str) or "internal error" not in answer, answer
            _served(client)
        return Outcome("answered, in words or with an action")
