"""`python -m palm_jax serve RUN`: a policy behind a websocket, for robots whose process has no JAX.

The messages are those of openpi-style policy servers (`palm_jax.wire`). On connecting a client is
sent the policy's metadata; to each request, a map of arrays, it gets a map with the answer, or a
text with what is wrong with the request. An error ends neither the connection nor the server.
"""

import asyncio
import concurrent.futures
import dataclasses
import http
import ipaddress
import logging
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
import websockets.asyncio.server as ws
from rich.console import Console
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from palm_jax import wire
from palm_jax.train.policy import IMAGE_SIZE, Decision, Policy, PolicyError, describe, load
from palm_jax.train.reporting import console as terminal

REQUIRED = ("image", "K", "cam_to_world", "tcp", "opening")
"""Entries of a request; `mask` besides for policies that isolate. Others are not looked at."""

_HARD_LIMIT = 2  # times the limit of a message: beyond it the connection is closed unread
_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class ServeConfig:
    """Serve the policy of a finished run over a websocket.

    Attributes:
      run: the run folder.
      host: address to listen on; others than this machine can connect only if it is not a loopback
        address. There is no authentication and no encryption.
      port: 0 for any free one.
      image_size: rows and columns of the images to come; others work, the first one slowly.
      zoom: see palm_jax.policy.load.
      off_centre: see palm_jax.policy.load.
      dist: lens coefficients of the camera, 4, 5 or 8; its images are then sent as they are.
      max_megabytes: the largest message that is read.
    """

    run: Annotated[Path, tyro.conf.Positional]
    host: str = "127.0.0.1"
    port: int = 8000
    image_size: tuple[int, int] = IMAGE_SIZE
    zoom: float = 1.0
    off_centre: float = 0.15
    dist: tuple[float, ...] = ()
    max_megabytes: float = 32.0


class RequestError(ValueError):
    """A message that is no request."""


class Server:
    """Answers requests with a policy; one at a time, whoever asks."""

    def __init__(
        self,
        decide: Callable[..., Decision],
        metadata: dict[str, Any],
        *,
        max_bytes: int = 32_000_000,
    ) -> None:
        """Server of a policy.

        Args:
          decide: as `Policy.decide`.
          metadata: sent to every client first.
          max_bytes: the largest message that is answered. One of up to twice that is refused in
            words, a larger one by closing the connection before it is read.
        """
        self._decide, self._hello, self._max_bytes = decide, wire.pack(metadata), max_bytes
        # One thread: calls do not overlap, and the loop stays free for the other clients.
        self._worker = concurrent.futures.ThreadPoolExecutor(1, "policy")

    def answer(self, message: str | bytes) -> bytes:
        """The answer to a request.

        Raises:
          RequestError, WireError: no request.
          ValueError, TypeError: what `decide` raises.
        """
        start = time.perf_counter()
        request = self._request(message)
        observation = [request[name] for name in REQUIRED]
        decision = self._decide(*observation, mask=request.get("mask"))
        took = 1e3 * (time.perf_counter() - start)
        return wire.pack(
            {
                "actions": decision.action[None],
                "target_pose": decision.target,
                "gripper": decision.gripper,
                "coverage": decision.coverage,
                "server_timing": {"infer_ms": took},
            }
        )

    def _request(self, message: str | bytes) -> dict[str, Any]:
        if isinstance(message, str):
            raise RequestError("expected a binary MessagePack message, got text")
        if len(message) > self._max_bytes:
            raise RequestError(
                f"expected a message of at most {self._max_bytes} bytes, got {len(message)}; send "
                "a smaller image (with its K), or start the server with a larger --max-megabytes"
            )
        request = wire.unpack(message)
        if not isinstance(request, dict):
            raise RequestError(f"expected a map, got a {type(request).__name__}")
        missing = [name for name in REQUIRED if name not in request]
        if missing:
            raise RequestError(
                f"missing {', '.join(missing)}: expected a map with {', '.join(REQUIRED)}, got "
                f"{', '.join(sorted(map(str, request))) or 'an empty one'}"
            )
        return request

    async def handle(self, connection: ws.ServerConnection) -> None:
        """Serves one client until it leaves."""
        loop = asyncio.get_running_loop()
        try:
            await connection.send(self._hello)
            async for message in connection:
                try:
                    reply: str | bytes = await loop.run_in_executor(
                        self._worker, self.answer, message
                    )
                except (ValueError, TypeError) as error:
                    reply = f"{type(error).__name__}: {error}"
                except Exception as error:
                    _log.exception("a request failed")
                    reply = f"internal error ({type(error).__name__}); see the server's output"
                await connection.send(reply)
        except ConnectionClosed:
            pass

    async def run(
        self,
        host: str,
        port: int,
        *,
        started: Callable[[int], None] | None = None,
        stop: asyncio.Event | None = None,
    ) -> None:
        """Listens until `stop` is set, or SIGINT or SIGTERM comes; then closes all connections.

        Args:
          host, port: where; port 0 for any free one.
          started: told the port once clients can connect.
          stop: by default only signals end it.

        Raises:
          OSError: the address cannot be listened on.
        """
        stop = stop or asyncio.Event()
        async with ws.serve(
            self.handle,
            host,
            port,
            compression=None,
            max_size=_HARD_LIMIT * self._max_bytes,
            max_queue=1,
            origins=[None],  # no pages in a browser: they could reach a loopback address
            process_request=_health,
            logger=_log,
        ) as server:
            if started:
                started(next(iter(server.sockets)).getsockname()[1])
            with _signals(stop):
                await stop.wait()
        self._worker.shutdown()


class _signals:
    """While entered, SIGINT and SIGTERM set an event; outside of the main thread, nothing does."""

    def __init__(self, event: asyncio.Event) -> None:
        self._event, self._loop = event, asyncio.get_running_loop()
        self._added: list[signal.Signals] = []

    def __enter__(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._loop.add_signal_handler(number, self._event.set)
            except (NotImplementedError, RuntimeError, ValueError):
                continue  # Windows, or not the main thread: Ctrl-C then ends the server by itself
            self._added.append(number)

    def __exit__(self, *_: object) -> None:
        for number in self._added:
            self._loop.remove_signal_handler(number)


def _health(connection: ws.ServerConnection, request: Request) -> Response | None:
    """GET /healthz is answered with OK; all else is a client."""
    if request.path == "/healthz":
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None


def metadata_of(policy: Policy) -> dict[str, Any]:
    """What a client is told of a policy: its contract, and the entries of requests and answers."""
    wanted = (*REQUIRED, "mask") if policy.contract.spec.isolate else REQUIRED
    return {
        "server": "palm_jax",
        "request": list(wanted),
        "answer": ["actions", "target_pose", "gripper", "coverage", "server_timing"],
        **describe(policy),
    }


def _loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns the exit code."""
    config = tyro.cli(ServeConfig, args=argv, prog="python -m palm_jax serve")
    console = terminal.make_console()
    try:
        return _main(config, console)
    except KeyboardInterrupt:  # before there is anything to end
        return 130
    except (PolicyError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _main(config: ServeConfig, console: Console) -> int:
    console.print(f"Loading {config.run} ...", markup=False)
    policy = load(
        config.run,
        image_size=None,
        zoom=config.zoom,
        off_centre=config.off_centre,
        dist=config.dist or None,
    )
    took = policy.warm_up(*config.image_size)
    server = Server(policy.decide, metadata_of(policy), max_bytes=round(1e6 * config.max_megabytes))

    def started(port: int) -> None:
        height, width = config.image_size
        contract = policy.contract
        terminal.header(
            console,
            "palm_jax serve",
            {
                "policy": f"{contract.method}, {contract.task}, step {contract.step}",
                "images": f"{height} x {width}",
                "an action": f"{took:.1f} ms",
                "address": f"ws://{config.host}:{port}",
            },
        )
        if not _loopback(config.host):
            console.print(
                f"Anyone who reaches {config.host}:{port} can use this server: there is no "
                "authentication."
            )
        console.print("Ctrl-C ends it.")

    asyncio.run(server.run(config.host, config.port, started=started))
    console.print(f"Stopped. Actions: {policy.latency}", markup=False)
    return 0
