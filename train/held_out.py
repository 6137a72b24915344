"""How well a policy foretells the actions of demonstrations that it was not trained on.

No success rate: small errors add up in a closed loop, and some of them do not matter. It finds what
is wrong before a robot moves, and chooses checkpoints where nothing can be simulated.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from palm_jax.train import learner, loop

ACTION_NAMES = ("r1x", "r1y", "r1z", "r2x", "r2y", "r2z", "x", "y", "z", "gripper")
"""Of the action's ten numbers: the rotation's two columns, the translation, the gripper."""


def loss(model: learner.Learner, policy: learner.PolicyState, data: learner.Batch) -> float:
    """Mean square error over all ten numbers, normalised units, without augmentation and noise: the
    training's loss on other data."""
    predicted, labels = predictions(model, policy, data)
    return float(np.square(predicted - labels).mean(dtype=np.float64))


def measure(
    model: learner.Learner, policy: learner.PolicyState, data: learner.Batch
) -> dict[str, Any]:
    """Errors of the policy on every frame, beside those of a policy that never moves and never
    changes the gripper.

    Returns:
      frames, loss (see `loss`); r2: name of an action's number -> coefficient of determination,
      None where the label is constant; translation_mm and rotation_deg: median error, and
      "standing_still": median motion; gripper: share of frames with the right command, and
      "constant": that of the better constant command.
    """
    predicted, labels = predictions(model, policy, data)
    ranges = policy.normalizer.action
    actions = np.asarray(learner.to_action(ranges.denormalize(jnp.asarray(predicted))))
    wanted = np.asarray(data.actions, np.float32)
    r2 = determination(predicted, labels)
    gripper, opens = actions[:, learner.GRIPPER], wanted[:, learner.GRIPPER] > 0.5
    return {
        "frames": len(wanted),
        "loss": float(np.square(predicted - labels).mean(dtype=np.float64)),
        "r2": {
            name: None if np.isnan(value) else float(value)
            for name, value in zip(ACTION_NAMES, r2, strict=True)
        },
        "translation_mm": {
            "median_error": 1e3 * _median_norm(actions[:, 6:9] - wanted[:, 6:9]),
            "standing_still": 1e3 * _median_norm(wanted[:, 6:9]),
        },
        "rotation_deg": {
            "median_error": float(np.median(_angles(_matrices(actions), _matrices(wanted)))),
            "standing_still": float(np.median(_angles(_matrices(wanted), np.eye(3)))),
        },
        "gripper": {
            "right": float(((gripper > 0.5) == opens).mean()),
            "constant": float(max(opens.mean(), 1 - opens.mean())),
        },
    }


def predictions(
    model: learner.Learner,
    policy: learner.PolicyState,
    data: learner.Batch,
    *,
    rows: ArrayLike | None = None,
    batch_size: int = 256,
) -> tuple[np.ndarray, np.ndarray]:
    """What a policy makes of labelled samples, without augmentation and noise.

    Args:
      model: from `learner.make_learner`.
      policy: from `model.policy_state`.
      data: labelled samples in host memory.
      rows: indices of the n samples to use; all by default.
      batch_size: samples per call.

    Returns:
      prediction and label, [n, 10] each, normalised units.
    """
    indices = np.arange(len(data.proprio)) if rows is None else np.asarray(rows)
    chunks = []
    for start in range(0, len(indices), batch_size):
        # Always a full batch, so that there is one compilation; the surplus is cut off.
        chunk = np.resize(indices[start : start + batch_size], batch_size)
        part = loop.take(data, chunk)
        prediction, _ = model.jitted_predict(policy, part.images, part.proprio)
        chunks.append(np.asarray(prediction))
    labels = policy.normalizer.action.normalize(jnp.asarray(data.actions[indices]))
    return np.concatenate(chunks)[: len(indices)], np.asarray(labels)


def determination(predicted: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """[D] coefficient of determination of each column of [n, D]; NaN where labels are constant."""
    residual = np.square(labels - predicted).sum(axis=0)
    spread = np.square(labels - labels.mean(axis=0)).sum(axis=0)
    return 1 - residual / np.where(spread > 0, spread, np.nan)


def action_r2(
    model: learner.Learner,
    policy: learner.PolicyState,
    data: learner.Batch,
    *,
    rows: ArrayLike | None = None,
    batch_size: int = 256,
) -> np.ndarray:
    """Coefficient of determination of each action dimension, [10]; NaN where the label is constant.

    A low mean loss can hide that nothing was learnt sideways; look at this on the frames where the
    gripper is open. Arguments as of `predictions`.
    """
    return determination(*predictions(model, policy, data, rows=rows, batch_size=batch_size))


def _median_norm(vectors: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))


def _matrices(actions: np.ndarray) -> np.ndarray:
    """[N, 3, 3] of actions [N, 10] whose two columns are orthonormal."""
    first, second = actions[:, 0:3], actions[:, 3:6]
    return np.stack([first, second, np.cross(first, second)], -1)


def _angles(rotations: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Degrees between rotations [N, 3, 3] and [3, 3] or [N, 3, 3]; small ones to full precision."""
    apart = np.linalg.norm(rotations - others, axis=(-2, -1)) / np.sqrt(8)
    return np.degrees(2 * np.arcsin(np.clip(apart, 0, 1)))
