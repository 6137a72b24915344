"""The policy server: answers, refusals, other clients, and its end."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import msgpack
import numpy as np
import pytest
import tiny
import websockets.sync.client
import websockets.sync.server
from serving import raw, serving
from websockets.exceptions import ConnectionClosed, InvalidStatus

from palm_jax import policy_client, wire
from palm_jax.align import ProjectionError
from palm_jax.policy_client import PolicyClient, PolicyServerError
from palm_jax.train import serve
from palm_jax.train.policy import Decision, load

ROOT = Path(__file__).resolve().parents[2]
IMAGE = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
K = np.array([[25.0, 0, 15], [0, 25, 10], [0, 0, 1]])
CAMERA = np.diag([1.0, -1, -1, 1])
TCP = np.diag([1.0, -1, -1, 1])
CAMERA[2, 3], TCP[2, 3] = 1.9, 0.9
REQUEST: dict[str, Any] = {
    "image": IMAGE, "K": K, "cam_to_world": CAMERA, "tcp": TCP, "opening": 0.25
}  # fmt: skip


def decide(image: Any, K: Any, cam_to_world: Any, tcp: Any, opening: Any, mask: Any) -> Decision:
    """Stands in for a policy: lifts the hand by the opening. An opening of 7 is a bug."""
    if opening == 7:
        raise ZeroDivisionError("a bug")
    if tcp[2, 3] < 0:
        raise ProjectionError("tcp: expected the TCP inside the image")
    if np.asarray(image).dtype == np.float32:
        raise TypeError("image: expected uint8")
    target = np.array(tcp, np.float32)
    target[2, 3] += opening
    coverage = 1.0 if mask is None else float(np.mean(mask))
    return Decision(target, 1.0, np.arange(10, dtype=np.float32), coverage)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with serving(decide, {"method": "palm", "rate": 20.0}) as port:
        yield port


def test_a_client_of_the_convention_is_served(port: int) -> None:
    """Metadata first, then a map for a map, in MessagePack written by hand."""
    with raw(port) as plain:
        assert msgpack.unpackb(plain.recv(timeout=10)) == {"method": "palm", "rate": 20.0}
        request = {
            name: {
                b"__ndarray__": True,
                b"data": np.asarray(value).tobytes(),
                b"dtype": np.asarray(value).dtype.str,
                b"shape": np.asarray(value).shape,
            }
            for name, value in REQUEST.items()
            if name != "opening"
        }
        plain.send(msgpack.packb({**request, "opening": 0.25, "prompt": "lift the lid"}))
        answer = msgpack.unpackb(plain.recv(timeout=10))
    assert set(answer) == {"actions", "target_pose", "gripper", "coverage", "server_timing"}
    actions, pose = answer["actions"], answer["target_pose"]
    assert actions[b"shape"] == [1, 10] and actions[b"dtype"] == "<f4"
    np.testing.assert_array_equal(np.frombuffer(actions[b"data"], "<f4"), np.arange(10))
    np.testing.assert_allclose(np.frombuffer(pose[b"data"], "<f4").reshape(4, 4)[2, 3], 1.15)
    assert answer["gripper"] == 1.0 and answer["server_timing"]["infer_ms"] >= 0


def test_the_client(port: int) -> None:
    with PolicyClient("127.0.0.1", port) as client:
        assert client.metadata["method"] == "palm" and client.latency == "no calls yet"
        client.reset()
        target, gripper = client.act(**REQUEST)
        np.testing.assert_allclose(target[2, 3], 0.9 + 0.25)
        target[2, 3] = 0  # its own array, to be written to
        assert gripper == 1.0 and "on the server" in client.latency
        answer = client.infer({**REQUEST, "mask": np.ones((20, 30), bool)})
        assert answer["coverage"] == 1.0


BAD: list[tuple[str | bytes, str]] = [
    ("hello", "RequestError: expected a binary MessagePack message, got text"),
    (b"\xc1", "WireError: not a MessagePack message"),
    (b"", "WireError: not a MessagePack"),
    (wire.pack([1, 2]), "RequestError: expected a map, got a list"),
    (wire.pack({}), "missing image, K, cam_to_world, tcp, opening"),
    (wire.pack({**REQUEST, "tcp": TCP, "openning": 1} | {"K": K}), ""),
    (wire.pack({name: REQUEST[name] for name in ("image", "K")}), "missing cam_to_world, tcp"),
    (wire.pack({**REQUEST, "image": b"x" * 12_000}), "RequestError: expected a message of at most"),
    (wire.pack({**REQUEST, "tcp": -TCP}), "ProjectionError: tcp: expected the TCP inside"),
    (wire.pack({**REQUEST, "image": np.float32([1])}), "TypeError: image: expected uint8"),
    (wire.pack({**REQUEST, "tcp": None}), "TypeError"),
    (
        msgpack.packb(
            {"image": {b"__ndarray__": True, b"dtype": "|O", b"data": b"", b"shape": []}}
        ),
        "WireError: arrays of '|O' do not travel",
    ),
]  # fmt: skip


def test_bad_messages_are_answered_in_words_and_cost_nobody_the_connection(port: int) -> None:
    with raw(port) as bad, PolicyClient("127.0.0.1", port) as good:
        bad.recv(timeout=10)
        for message, words in BAD:
            bad.send(message)
            answer = bad.recv(timeout=10)
            if words:
                assert isinstance(answer, str) and words in answer, (message[:80], answer)
            good.act(**REQUEST)
        bad.send(wire.pack(REQUEST))
        assert isinstance(bad.recv(timeout=10), bytes)


def test_bugs_are_told_without_their_insides(port: int, caplog: pytest.LogCaptureFixture) -> None:
    with PolicyClient("127.0.0.1", port) as client:
        with pytest.raises(PolicyServerError, match=r"internal error \(ZeroDivisionError\)"):
            client.act(**{**REQUEST, "opening": 7.0})
        client.act(**REQUEST)
    assert "a bug" in caplog.text  # on the server's side


def test_refusals_reach_the_caller_and_the_next_call_works(port: int) -> None:
    with PolicyClient("127.0.0.1", port) as client:
        with pytest.raises(PolicyServerError, match="ProjectionError: tcp: expected"):
            client.act(**{**REQUEST, "tcp": -TCP})
        with pytest.raises(wire.WireError, match="do not travel"):
            client.infer({**REQUEST, "image": np.array([None])})
        client.act(**REQUEST)


def test_messages_far_too_big_close_that_connection_alone(port: int) -> None:
    with PolicyClient("127.0.0.1", port) as other, PolicyClient("127.0.0.1", port) as client:
        with pytest.raises(PolicyServerError, match="too big for the server, which closed"):
            client.act(**{**REQUEST, "image": np.zeros((600, 800, 3), np.uint8)})
        with pytest.raises(PolicyServerError, match="too big|closed"):
            client.act(**REQUEST)
        other.act(**REQUEST)
    with PolicyClient("127.0.0.1", port) as client:
        client.act(**REQUEST)


def test_clients_that_vanish_disturb_nobody(port: int) -> None:
    with PolicyClient("127.0.0.1", port) as client:
        for _ in range(3):
            with raw(port) as gone:
                gone.send(wire.pack(REQUEST))
                gone.socket.shutdown(socket.SHUT_RDWR)
        target, gripper = client.act(**REQUEST)
        assert target.shape == (4, 4) and 0 <= gripper <= 1


def test_pages_in_a_browser_are_not_let_in(port: int) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        raw(port, origin="https://example.org").__enter__()


def test_health(port: int) -> None:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(f"http://127.0.0.1:{port}/healthz", timeout=10) as answer:
        assert (answer.status, answer.read()) == (200, b"OK\n")


def test_nobody_there() -> None:
    with pytest.raises(PolicyServerError, match="no policy server at .*python -m palm_jax serve"):
        PolicyClient("127.0.0.1", 9, timeout=2)


def test_somebody_else_there() -> None:
    def greet(connection: Any) -> None:
        connection.send("welcome")
        with contextlib.suppress(ConnectionClosed):
            connection.recv()

    with websockets.sync.server.serve(greet, "127.0.0.1", 0) as other:
        thread = threading.Thread(target=other.serve_forever)
        thread.start()
        with pytest.raises(PolicyServerError, match="is no policy server: welcome"):
            PolicyClient("127.0.0.1", other.socket.getsockname()[1])
        other.shutdown()
        thread.join(10)


def test_answers_that_do_not_come_in_time_end_the_connection() -> None:
    free = threading.Event()

    def slow(*arguments: Any, mask: Any) -> Decision:
        free.wait(20)
        return decide(*arguments, mask)

    with serving(slow, {}) as port, PolicyClient("127.0.0.1", port, timeout=0.3) as client:
        with pytest.raises(PolicyServerError, match="no answer within 0.3 s; closed"):
            client.act(**REQUEST)
        free.set()
        with pytest.raises(PolicyServerError, match="closed"):
            client.act(**REQUEST)


def test_a_served_policy_answers_what_it_does_here() -> None:
    """All of it: a run, the server, the client."""
    policy = load(tiny.run(), image_size=(20, 30))
    with (
        serving(policy.decide, serve.metadata_of(policy)) as port,
        PolicyClient("127.0.0.1", port) as client,
    ):
        expected, gripper = policy.act(**REQUEST)
        got = client.act(**REQUEST)
        np.testing.assert_array_equal(got[0], expected)
        assert got[1] == gripper
        assert client.metadata["spec"]["crop"] == 160 and "mask" not in client.metadata["request"]
        assert client.metadata["heights"] == pytest.approx(tiny.HEIGHTS)
        with pytest.raises(PolicyServerError, match="OutsideTrainingError: tcp: expected a height"):
            client.act(**{**REQUEST, "tcp": CAMERA})
        assert client.act(**{**REQUEST, "opening": 1})[1] in (0.0, 1.0)


@pytest.mark.slow
def test_ctrl_c_ends_the_command_in_order() -> None:
    words = [str(tiny.run()), "--port", "0", "--image-size", "20", "30"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    if cache := jax.config.jax_compilation_cache_dir:
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"
    process = subprocess.Popen(
        [sys.executable, "-m", "palm_jax", "serve", *words],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "Ctrl-C" in line:
                break
        address = re.search(r"ws://127.0.0.1:(\d+)", "".join(lines))
        assert address, lines
        with PolicyClient("127.0.0.1", int(address[1])) as client:
            client.act(**REQUEST)
            process.send_signal(signal.SIGINT)
            rest, errors = process.communicate(timeout=60)
            with pytest.raises(PolicyServerError, match="the connection is closed"):
                client.act(**REQUEST)
    finally:
        process.kill()
    assert process.returncode == 0, errors
    assert "Stopped. Actions: median" in rest and "Traceback" not in errors


def test_commands_that_cannot_be_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert serve.main([str(tmp_path)]) == 2
    assert "no run here" in capsys.readouterr().err
    with raw_listener() as taken:
        words = [str(tiny.run()), "--port", str(taken), "--image-size", "20", "30"]
        assert serve.main(words) == 2
    assert "address already in use" in capsys.readouterr().err


@contextlib.contextmanager
def raw_listener() -> Iterator[int]:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


def test_the_client_is_what_the_loop_example_uses() -> None:
    assert {"act", "reset", "latency"} <= set(dir(policy_client.PolicyClient))
