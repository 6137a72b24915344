"""The robot's side of a policy server: `PolicyClient`, on NumPy, msgpack and websockets alone.

    client = PolicyClient("127.0.0.1", 8000)
    client.reset()
    target, gripper = client.act(image, K, cam_to_world, tcp, opening)

The calls are those of `palm_jax.policy.Policy`, for a process that has no JAX. The server is
`python -m palm_jax serve RUN`.
"""

import contextlib
import statistics
from types import TracebackType
from typing import Any, Self

import numpy as np
import websockets.exceptions
import websockets.sync.client
from numpy.typing import ArrayLike, NDArray

from palm_jax import wire

TOO_BIG = 1009  # WebSocket close code


class PolicyServerError(RuntimeError):
    """The server refused an observation, or did not answer; the message says why."""


class PolicyClient:
    """A policy behind a server. A context manager; one call at a time.

    Attributes:
      metadata: what the server says of its policy, see docs/deploy.md.
      server_ms: milliseconds that the server took for each of the calls so far.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8000, *, timeout: float = 10.0) -> None:
        """Connect.

        Args:
          host, port: of the server.
          timeout: seconds for the connection and for each answer. The first image of a size that
            the server was not told of takes it seconds.

        Raises:
          PolicyServerError: nobody answers there, or somebody else.
        """
        self._timeout, self._open = timeout, contextlib.ExitStack()
        uri = f"ws://{host}:{port}"
        try:
            self._socket = self._open.enter_context(
                websockets.sync.client.connect(
                    uri, compression=None, max_size=None, open_timeout=timeout, proxy=None
                )
            )
        except (OSError, websockets.exceptions.WebSocketException) as error:
            raise PolicyServerError(
                f"no policy server at {uri} ({error}); start one: python -m palm_jax serve RUN"
            ) from error
        self.server_ms: list[float] = []
        try:
            self.metadata: dict[str, Any] = self._receive()
        except (PolicyServerError, wire.WireError) as error:
            self.close()
            raise PolicyServerError(f"{uri} is no policy server: {error}") from error

    def reset(self) -> None:
        """Begin an episode. Nothing is to be done: a served policy remembers nothing."""

    def act(
        self,
        image: ArrayLike,
        K: ArrayLike,
        cam_to_world: ArrayLike,
        tcp: ArrayLike,
        opening: ArrayLike,
        *,
        mask: ArrayLike | None = None,
    ) -> tuple[NDArray[np.float32], float]:
        """The next target of the TCP: arguments and results as of `palm_jax.policy.Policy.act`.

        Raises:
          PolicyServerError: the server refused the input, and its message says why; or it did not
            answer in time.
        """
        answer = self.infer(
            {
                "image": np.asarray(image),
                "K": np.asarray(K),
                "cam_to_world": np.asarray(cam_to_world),
                "tcp": np.asarray(tcp),
                "opening": float(np.asarray(opening)),
                **({} if mask is None else {"mask": np.asarray(mask)}),
            }
        )
        self.server_ms.append(float(answer["server_timing"]["infer_ms"]))
        return np.array(answer["target_pose"]), float(answer["gripper"])

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """The server's whole answer to a request, see docs/deploy.md.

        Raises:
          PolicyServerError: see `act`.
          WireError: something in the observation does not travel.
        """
        message = wire.pack(observation)
        try:
            self._socket.send(message)
        except websockets.exceptions.ConnectionClosed as error:
            raise _lost(error) from error
        return self._receive()

    @property
    def latency(self) -> str:
        """How long the server took, in words."""
        if not self.server_ms:
            return "no calls yet"
        return f"median {statistics.median(self.server_ms):.1f} ms on the server"

    def close(self) -> None:
        """End the connection."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _receive(self) -> dict[str, Any]:
        try:
            answer = self._socket.recv(timeout=self._timeout)
        except TimeoutError as error:
            self.close()  # or the late answer would be taken for that to the next request
            raise PolicyServerError(f"no answer within {self._timeout:g} s; closed") from error
        except websockets.exceptions.ConnectionClosed as error:
            raise _lost(error) from error
        if isinstance(answer, str):
            raise PolicyServerError(answer)
        message = wire.unpack(answer)
        if not isinstance(message, dict):
            raise PolicyServerError(f"expected a map, got a {type(message).__name__}")
        return message


def _lost(error: websockets.exceptions.ConnectionClosed) -> PolicyServerError:
    if error.rcvd is not None and error.rcvd.code == TOO_BIG:
        return PolicyServerError(
            "the message is too big for the server, which closed the connection; send a smaller "
            "image (with its K), or start the server with a larger --max-megabytes"
        )
    return PolicyServerError(f"the connection is closed: {error}")
