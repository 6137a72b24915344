"""Many devices, many processes: how an update is shared, and which process writes.

Training is data-parallel in JAX's own way: one program over all devices of all processes, in which
the batch is split by rows and everything else is on every device. The global batch stays what the
configuration says, and so do the draws of every row: N devices compute what one computes, up to
the order of the sums. With one device nothing is split and the program is the plain one.

Processes run the same command (`connect`). The first of them writes every file and every line, and
evaluates; the others take part in the updates and wait (`wait`) where the first is busy. What must
be the same everywhere comes from the first (`from_first`), byte by byte.
"""

import dataclasses
import functools
import ipaddress
import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from orbax.checkpoint import multihost

from palm_jax.train.host import interrupts

AXIS = "data"
AGREE_EVERY = 25  # updates between two agreements to stop; each costs all processes a round trip
_LONGEST_WAIT = 14 * 24 * 3600  # seconds; a dead process is noticed long before, by its heartbeat
_PARTING = 60  # seconds that an ending process waits for the others to end
_barriers = itertools.count()


class DeviceError(ValueError):
    """The devices or processes do not fit what was asked for; the message says what to do."""


# -------------------------------------------------------------------------------------- processes


class Address(NamedTuple):
    """Where the first of several processes listens, and which of them this one is."""

    coordinator: str  # host:port
    processes: int
    process: int


def address_of(text: str) -> Address | None:
    """What `--distributed` says; None for `auto`.

    Raises:
      DeviceError: neither `auto` nor HOST:PORT,COUNT,INDEX with INDEX from 0 to COUNT - 1.
    """
    if text == "auto":
        return None
    match = re.fullmatch(r"([^\s,]+:\d{1,5}),(\d{1,6}),(\d{1,6})", text)
    if match and int(match[3]) < int(match[2]):
        return Address(match[1], int(match[2]), int(match[3]))
    raise DeviceError(
        "distributed: expected auto, or HOST:PORT,COUNT,INDEX with INDEX from 0 to COUNT - 1, e.g. "
        f"node0:12345,2,0 for the first of two processes; got {text!r}"
    )


def connect(text: str) -> None:
    """Joins the other processes; must come before the first JAX computation.

    Args:
      text: see `address_of`. `auto` asks Slurm, Open MPI, Kubernetes or a TPU's metadata.

    Raises:
      DeviceError: it is neither form, or nothing here tells `auto` who the others are.
    """
    where = address_of(text)
    # JAX's own handler of SIGTERM only sets a flag; ours saves (palm_jax.train.run).
    jax.config.update("jax_enable_preemption_service", False)
    try:
        if where is None:
            jax.distributed.initialize(shutdown_timeout_seconds=_PARTING)
        else:
            jax.distributed.initialize(
                where.coordinator,
                where.processes,
                where.process,
                cluster_detection_method="deactivate",
                shutdown_timeout_seconds=_PARTING,
                coordinator_bind_address=where.coordinator if _loopback(where) else None,
            )
    except ValueError as error:
        raise DeviceError(
            f"distributed: {error} With auto, start the processes by srun, mpirun or a Kubernetes "
            "job with an index; anywhere else say --distributed HOST:PORT,COUNT,INDEX"
        ) from error


def _loopback(where: Address) -> bool:
    """Processes of one machine: nothing has to listen to the network."""
    host = where.coordinator.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_first() -> bool:
    """Whether this is the process that writes, the only one there is as a rule."""
    return jax.process_index() == 0


def alone() -> bool:
    """Whether there is no other process."""
    return jax.process_count() == 1


def leave(status: int) -> int:
    """The exit status of a process that fails, which does not wait for the others to end: JAX ends
    them when it is gone, where an orderly exit would wait for them for minutes."""
    if not alone():
        interrupts.end(status)
    return status


def wait() -> None:
    """Returns when every process has come here; all must come by the same sequence of calls.

    For hours, if need be: unlike a collective operation it occupies no device.
    """
    if not alone():
        multihost.sync_global_processes(
            f"palm_jax-{next(_barriers)}",
            processes=set(range(jax.process_count())),
            timeout=_LONGEST_WAIT,
        )


def from_first(tree: Any) -> Any:
    """The first process's tree of arrays and numbers, on the host of every process.

    Args:
      tree: of the same structure, shapes and dtypes everywhere; its values count on the first only.
    """
    if alone():
        return tree
    wait()  # the others may have been waiting for long
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(leaf) for leaf in leaves]
    # As bytes: the broadcast is a sum, which would turn -0.0 into 0.0.
    pieces = [np.ascontiguousarray(array).reshape(-1).view(np.uint8) for array in arrays]
    joined = np.asarray(multihost_utils.broadcast_one_to_all(np.concatenate(pieces)))
    parts = np.split(joined, np.cumsum([piece.size for piece in pieces])[:-1])
    found = [
        part.view(array.dtype).reshape(array.shape)
        for part, array in zip(parts, arrays, strict=True)
    ]
    return jax.tree.unflatten(structure, found)


class Together:
    """A request to stop that all processes follow after the same update, whoever got it.

    Call it before every update. With one process it asks at once, with several every `AGREE_EVERY`
    calls: an update needs all of them, so that none may leave alone.
    """

    def __init__(self, asked: Callable[[], bool]) -> None:
        self._asked = asked
        self._calls = itertools.count()
        self._heard = False

    def __call__(self) -> bool:
        if not alone() and not self._heard and next(self._calls) % AGREE_EVERY == 0:
            asked = multihost_utils.process_allgather(np.asarray(self._asked()))
            self._heard = bool(np.any(asked))
        return self.agreed

    @property
    def agreed(self) -> bool:
        """Whether to stop, as far as is known: asks nobody."""
        return self._asked() if alone() else self._heard


# ---------------------------------------------------------------------------------------- devices


def local_for(worlds: int) -> list[jax.Device]:
    """As many of this process's devices as divide `worlds` evenly, at least one.

    Fewer devices, not more worlds: what is drawn for a scene must not depend on the machine.
    """
    found = jax.local_devices()
    count = max(n for n in range(1, len(found) + 1) if worlds % n == 0)
    return found[:count]


def described() -> str:
    """The devices in words."""
    found = jax.devices()
    if len(found) == 1:
        return str(found[0])
    processes = jax.process_count()
    kinds = ", ".join(sorted({device.device_kind for device in found}))
    return f"{len(found)} x {kinds}" + (f" in {processes} processes" if processes > 1 else "")


@dataclasses.dataclass(frozen=True)
class Split:
    """How updates are shared by devices: rows of the batch are split, all else is everywhere.

    Attributes:
      mesh: of the axis `AXIS`; None for one device, where arrays and programs stay plain.
    """

    mesh: Mesh | None

    @classmethod
    def over(cls, devices: Sequence[jax.Device]) -> "Split":
        """Over these devices, of one or several processes."""
        if len(devices) == 1:
            return cls(None)
        axes = (AxisType.Auto,)
        return cls(jax.make_mesh((len(devices),), (AXIS,), axis_types=axes, devices=devices))

    @property
    def count(self) -> int:
        """Devices."""
        return 1 if self.mesh is None else self.mesh.size

    def check(self, batch_size: int) -> None:
        """Raises DeviceError if the devices do not divide the batch evenly."""
        if batch_size % self.count:
            raise DeviceError(
                f"batch_size {batch_size} cannot be split over {self.count} devices: choose a "
                f"multiple of {self.count}, or show fewer devices (CUDA_VISIBLE_DEVICES, on CPUs "
                "JAX_NUM_CPU_DEVICES)"
            )

    def compiled(self, step: Callable[..., Any], **options: Any) -> Callable[..., Any]:
        """`jax.jit` of an update (key, state, batch, ...), whose results are on every device."""
        return jax.jit(step, out_shardings=NamedSharding(self._mesh, PartitionSpec()), **options)

    def everywhere(self, tree: Any) -> Any:
        """The first process's arrays, on every device; typed keys may be among them."""
        if self.mesh is None:
            return tree
        leaves, structure = jax.tree.flatten(tree)
        hosts = from_first([jax.random.key_data(x) if _is_key(x) else x for x in leaves])
        found = [self._replicated(np.asarray(host)) for host in hosts]
        return jax.tree.unflatten(
            structure, [self._key(x, like) for x, like in zip(found, leaves, strict=True)]
        )

    def rows(self, data: Any, indices: np.ndarray) -> Any:
        """The rows `indices` of a data set in host memory, split over the devices.

        Args:
          data: arrays with one leading axis; every process has all of them.
          indices: [B]; each device gets B / count of the rows, and no process reads others'.
        """
        if self.mesh is None:
            return jax.tree.map(lambda x: x[indices], data)
        sharding = NamedSharding(self.mesh, PartitionSpec(AXIS))

        def split(x: np.ndarray) -> jax.Array:
            def part(at: Any) -> np.ndarray:
                return x[indices[at[0]]]

            return jax.make_array_from_callback((len(indices), *x.shape[1:]), sharding, part)

        return jax.tree.map(split, data)

    def on_one(self, tree: Any) -> Any:
        """What is on every device, on this process's first alone: for all that is not an update."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda x: jnp.array(np.asarray(x)), tree)

    def _replicated(self, host: np.ndarray) -> jax.Array:
        sharding = NamedSharding(self._mesh, PartitionSpec())
        return jax.make_array_from_callback(host.shape, sharding, lambda at: host[at])

    def _key(self, data: jax.Array, like: Any) -> jax.Array:
        """`data` as a key if `like` is one."""
        if not _is_key(like):
            return data
        wrap = functools.partial(jax.random.wrap_key_data, impl=jax.random.key_impl(like))
        return jax.jit(wrap, out_shardings=NamedSharding(self._mesh, PartitionSpec()))(data)

    @property
    def _mesh(self) -> Mesh:
        assert self.mesh is not None
        return self.mesh


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", np.float32), jax.dtypes.prng_key)
