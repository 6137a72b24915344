"""Actions: the TCP's motion in its own frame, and the labels made from recorded frames.

A delta is nine numbers: the 6D rotation (two columns), then x, y, z, all in the TCP's own (body)
frame; the executed target is `tcp @ delta`. A tenth number, the gripper command (1 open, 0 close),
follows it in the policy's action. Metres, float32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from palm_jax._checks import OptionError, ShapeError, as_float, check_pose
from palm_jax.align.camera import matmul
from palm_jax.align.proprio import _rotation_6d, matrix_from_6d

IDENTITY_DELTA = np.array([1, 0, 0, 0, 1, 0, 0, 0, 0], np.float32)


def encode_delta(tcp: ArrayLike, target: ArrayLike) -> jax.Array:
    """inv(tcp) target as [..., 9]: 6D rotation, then xyz, in the TCP's frame.

    Args:
      tcp: [..., 4, 4] pose the motion starts from.
      target: [..., 4, 4] pose it leads to.

    Raises:
      ShapeError: last axes not [4, 4].
      PoseError: concrete values that are not rigid poses.
    """
    tcp, target = as_float(tcp, "tcp", (4, 4)), as_float(target, "target", (4, 4))
    check_pose(tcp, "tcp")
    check_pose(target, "target")
    return _encode_delta(tcp, target)


@jax.jit
def _encode_delta(tcp: jax.Array, target: jax.Array) -> jax.Array:
    inverse = jnp.swapaxes(tcp[..., :3, :3], -1, -2)
    rotation = matmul(inverse, target[..., :3, :3])
    offset = matmul(inverse, (target[..., :3, 3] - tcp[..., :3, 3])[..., None])[..., 0]
    return jnp.concatenate([_rotation_6d(rotation), offset], -1)


def apply_delta(tcp: ArrayLike, delta: ArrayLike) -> jax.Array:
    """tcp @ delta: the pose [..., 4, 4] that a delta [..., 9] leads to.

    The delta's rotation is made orthonormal first (`matrix_from_6d`), so a network's output may be
    passed as it is, without the gripper.

    Raises:
      ShapeError: tcp not [..., 4, 4]; delta not [..., 9].
      PoseError: a concrete tcp that is not a rigid pose.
    """
    tcp = as_float(tcp, "tcp", (4, 4))
    check_pose(tcp, "tcp")
    if jnp.shape(delta)[-1:] == (10,):
        raise ShapeError(
            "delta: expected 9 numbers (6D, xyz), got 10; drop the gripper command: action[..., :9]"
        )
    return _apply_delta(tcp, as_float(delta, "delta", (9,)))


@jax.jit
def _apply_delta(tcp: jax.Array, delta: jax.Array) -> jax.Array:
    base = tcp[..., :3, :3]
    rotation = matmul(base, matrix_from_6d(delta[..., :6]))
    position = tcp[..., :3, 3] + matmul(base, delta[..., 6:, None])[..., 0]
    top = jnp.concatenate([rotation, position[..., None]], -1)
    bottom = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0]), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], -2)


def achieved_deltas(tcp: ArrayLike) -> jax.Array:
    """Labels from what was achieved: the delta from each recorded pose to the next.

    Args:
      tcp: [T, 4, 4] poses of an episode.

    Returns:
      [T, 9]; the last row is the identity (the paper's labels).

    Raises:
      ShapeError, PoseError: see `encode_delta`.
    """
    tcp = as_float(tcp, "tcp", (4, 4))
    return encode_delta(tcp, jnp.concatenate([tcp[1:], tcp[-1:]]))


def overwrite_transitions(deltas: ArrayLike, count: int) -> jax.Array:
    """Replace the `count` largest translations of an episode by the identity.

    Those are the frames in which the global policy carries the hand from one subtask to the next
    (the reference's subtask-transition overwrite: 1 for peg insertion, 3 for the vegetables).

    Args:
      deltas: [T, 9].
      count: how many, a Python int up to T.

    Raises:
      ShapeError: deltas not [..., 9].
      OptionError: count outside 0..T.
    """
    deltas = as_float(deltas, "deltas", (9,))
    if not 0 <= count <= deltas.shape[0]:
        raise OptionError(f"count: expected 0 to {deltas.shape[0]} frames, got {count}")
    if count == 0:
        return deltas
    _, frames = lax.top_k((deltas[:, 6:] ** 2).sum(-1), count)
    return deltas.at[frames].set(IDENTITY_DELTA)


def gripper_labels(opening: ArrayLike, *, threshold: float = 0.02) -> jax.Array:
    """Gripper commands recovered from a recorded opening (the reference's labels).

    Args:
      opening: [T] opening of each frame, 0..1.
      threshold: change from one frame to the next that counts as a command.

    Returns:
      [T] 1 (open) or 0 (close): 1 after a rise, 0 after a fall, else as in the frame before; at
      first 1 if the opening exceeds 0.9; the last frame repeats the one before it.

    Raises:
      ShapeError: opening not [T] with at least two frames.
    """
    opening = jnp.asarray(opening, jnp.float32)
    if opening.ndim != 1 or opening.shape[0] < 2:
        raise ShapeError(
            f"opening: expected [T] with at least 2 frames, got {list(opening.shape)}; "
            "batch episodes of one length with jax.vmap"
        )
    return _gripper_labels(opening, jnp.asarray(threshold, jnp.float32))


@jax.jit
def _gripper_labels(opening: jax.Array, threshold: jax.Array) -> jax.Array:
    change = jnp.diff(opening)
    frames = jnp.arange(change.shape[0])
    latest = lax.cummax(jnp.where(jnp.abs(change) > threshold, frames, -1))
    labels = jnp.where(latest < 0, opening[0] > 0.9, change[jnp.maximum(latest, 0)] > 0)
    return jnp.concatenate([labels, labels[-1:]]).astype(jnp.float32)
