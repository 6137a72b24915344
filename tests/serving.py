"""A policy server for tests, in a thread of its own, and any program's connection to it."""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import websockets.sync.client

from palm_jax.train import serve
from palm_jax.train.policy import Decision

LIMIT = 10_000
"""Bytes of a message that the server takes."""


@contextlib.contextmanager
def serving(decide: Callable[..., Decision], metadata: dict[str, Any]) -> Iterator[int]:
    """The server's port. It must end in order."""
    ready: list[Any] = []
    up = threading.Event()

    async def run() -> None:
        stop = asyncio.Event()

        def started(port: int) -> None:
            ready[:] = [port, stop, asyncio.get_running_loop()]
            up.set()

        server = serve.Server(decide, metadata, max_bytes=LIMIT)
        await server.run("127.0.0.1", 0, started=started, stop=stop)

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    assert up.wait(20)
    port, stop, loop = ready
    try:
        yield port
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join(20)
        assert not thread.is_alive()


def raw(port: int, **options: Any) -> contextlib.AbstractContextManager[Any]:
    """A connection as any program may open it."""
    return websockets.sync.client.connect(
        f"ws://127.0.0.1:{port}", max_size=None, proxy=None, compression=None, **options
    )
