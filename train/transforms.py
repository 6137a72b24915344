"""What a method makes of the demonstrations before it trains: more of them, seen otherwise.

A transform takes the training set that was rendered for a method and gives another. It knows the
demonstrations behind it, so that it can render once more.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from palm_jax.align import AlignSpec, Camera, align_window, apply_delta, encode_delta, resize
from palm_jax.envs import control
from palm_jax.envs.rollout import Runner, take_params
from palm_jax.train import demos as demonstrations
from palm_jax.train.learner import Batch


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a training set of N frames comes from."""

    runner: Runner
    demos: demonstrations.Demos
    spec: AlignSpec
    frame: int
    view: str  # the name of its images in the batch


Transform = Callable[[jax.Array, Source, Batch], Batch]
"""(key, source, batch of N samples in the order of the demonstrations' frames) -> a batch of any
number of samples."""

NovelViews = Callable[[jax.Array, Source, np.ndarray], np.ndarray]
"""(key, source, camera_to_world [N, 4, 4]) -> images [N, size, size, 3] uint8 of the frames of the
demonstrations as cameras at these poses would have taken them."""


def _joined(first: Batch, second: Batch) -> Batch:
    def join(one: Any, other: Any) -> np.ndarray:
        return np.concatenate([np.asarray(one), np.asarray(other)])

    joined: Batch = jax.tree.map(join, first, second)
    return joined


def _by_pieces(function: Callable[..., Any], size: int, *trees: Any) -> Any:
    """`function` of leading axes [N], `size` rows at a time: one compilation, little memory."""
    count = len(jax.tree.leaves(trees[0])[0])
    parts = []
    for first in range(0, count, size):
        rows = np.minimum(np.arange(first, first + size), count - 1)
        part = function(*jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], trees))
        parts.append(jax.tree.map(np.asarray, part))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)


# -- MirrorDuo: every demonstration once more, as in a mirror --------------------------------------

_ACROSS = np.diag([-1.0, 1.0, 1.0, 1.0]).astype(np.float32)  # of the camera: left is right
_OPENING = np.diag([1.0, -1.0, 1.0, 1.0]).astype(np.float32)  # of the TCP: which finger is which


def mirrored(key: jax.Array, source: Source, batch: Batch) -> Batch:
    """MirrorDuo: the batch and its mirror images, [2 N].

    Images are flipped left to right. A TCP pose X in the camera's frame becomes E X E', with E the
    mirror at the camera's vertical plane and E' that at the TCP's x-z plane, which keeps the frame
    right-handed and the same fingers on the same axis; a delta in the TCP's frame becomes E' d E'.
    The world is symmetric under this as far as the camera stands in its plane of symmetry, but for
    the lights and the table's grain. Where the method draws an overlay it is drawn anew: its
    colours tell the axes apart.
    """
    del key
    images, cameras = batch.images[source.view], batch.cameras[source.view]
    if source.spec.overlay:
        plain = dataclasses.replace(source.spec, overlay=False)
        images, _, cameras = demonstrations.render_observations(
            source.runner, source.demos, plain, frame=source.frame
        )
    poses = source.demos.tcp.astype(np.float32)
    opening = source.demos.opening.astype(np.float32)
    flip = jax.jit(jax.vmap(lambda *each: _flipped(*each, spec=_unmasked(source.spec))))
    seen, proprio, tcp, action, camera = _by_pieces(
        flip, source.runner.worlds, images, cameras, poses, opening, batch.actions
    )
    other = Batch(
        images={source.view: seen},
        proprio=proprio,
        actions=action,
        cameras={source.view: camera},
        tcp=tcp[:, :3, 3],
    )
    return _joined(batch, other)


def _unmasked(spec: AlignSpec) -> AlignSpec:
    """For images that are isolated already."""
    return dataclasses.replace(spec, isolate=False)


def _flipped(
    image: jax.Array,
    camera: Camera,
    tcp: jax.Array,
    opening: jax.Array,
    action: jax.Array,
    *,
    spec: AlignSpec,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, Camera]:
    """Image [size, size, 3], proprioception [P], TCP pose [4, 4], action [10] and camera in the
    mirror."""
    pose = jnp.asarray(camera.cam_to_world)
    seen = control.inverse(pose) @ tcp
    mirror = pose @ (_ACROSS @ seen @ _OPENING)
    K = jnp.asarray(camera.K)
    other = dataclasses.replace(camera, K=K.at[0, 2].set(camera.width - K[0, 2]))
    aligned = align_window(image[:, ::-1], other, jnp.zeros(2, jnp.int32), mirror, opening, spec)
    delta = jnp.concatenate(
        [
            encode_delta(jnp.eye(4), _OPENING @ apply_delta(jnp.eye(4), action[:9]) @ _OPENING),
            action[9:],
        ]
    )
    return aligned.image, aligned.proprio, mirror, delta, other


# -- RoVi-Aug: every demonstration once more, from another place -----------------------------------


class Reach(NamedTuple):
    """How far a novel view may be from the camera, uniformly drawn."""

    translation: tuple[float, float, float]  # metres along the camera's axes: right, down, forward
    rotation: float  # radians about each of them


LOWER = Reach((0.1, 0.1, 0.1), 0.05)
ULTRA = Reach((0.4, 0.1, 0.4), 0.1)
"""The narrowest and the widest of the ranges that RoVi-Aug publishes, its scene units taken as
metres."""

_DETAIL = 2  # a reconstruction has the detail of pixels of this size...
_NOISE = 0.03  # ...and is off by this much of the whole range, in patches of that size


def novel_views(model: NovelViews, reach: Reach = LOWER) -> Transform:
    """RoVi-Aug, viewpoints only: the batch, and every frame from a camera moved at random, [2 N].

    Proprioception and actions stay as they are. The cameras of frames are drawn independently of
    each other, as there.

    Args:
      model: makes the pictures; a diffusion model for novel views would be one. `rerendered`, the
        default of `roviaug`, is a surrogate.
      reach: how far the cameras are moved.
    """

    def transform(key: jax.Array, source: Source, batch: Batch) -> Batch:
        pose_key, model_key = jax.random.split(key)
        old = source.demos.camera_to_world[source.demos.episode]
        poses = (old @ np.asarray(_moves(pose_key, len(old), reach))).astype(np.float32)
        other = dataclasses.replace(
            batch,
            images={source.view: model(model_key, source, poses)},
            cameras={source.view: _cameras(source, poses)},
        )
        return _joined(batch, other)

    return transform


def _moves(key: jax.Array, count: int, reach: Reach) -> jax.Array:
    """[count, 4, 4] random motions of a camera in its own frame."""
    shift, turn = jax.random.uniform(key, (2, count, 3), minval=-1.0, maxval=1.0)
    x, y, z = (reach.rotation * turn).T
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)

    def about(axis: int, angle: jax.Array) -> jax.Array:
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        rows = [[one, zero, zero], [zero, cos, -sin], [zero, sin, cos]]
        order = [(i - axis) % 3 for i in range(3)]
        return jnp.stack([jnp.stack([rows[i][j] for j in order], -1) for i in order], -2)

    poses = jnp.tile(jnp.eye(4), (count, 1, 1))
    poses = poses.at[:, :3, :3].set(about(2, z) @ about(1, y) @ about(0, x))
    return poses.at[:, :3, 3].set(jnp.asarray(reach.translation) * shift)


def _moved(demos: demonstrations.Demos, camera_to_world: np.ndarray) -> demonstrations.Demos:
    """The same frames, each with a camera of its own [N, 4, 4]: N episodes of one frame."""
    episode = demos.episode
    return dataclasses.replace(
        demos,
        camera_to_world=camera_to_world,
        episode=np.arange(len(episode)),
        mocap_pos=demos.mocap_pos[episode],
        mocap_quat=demos.mocap_quat[episode],
        params=take_params(demos.params, episode),
    )


def _cameras(source: Source, camera_to_world: np.ndarray) -> Camera:
    """Who takes the images of the method's spec at these poses, leaves [N, ...]."""
    found = [
        source.runner.window_camera(state, params, source.spec, frame=source.frame)
        for state, params in demonstrations.states(
            source.runner, _moved(source.demos, camera_to_world)
        )
    ]
    count = len(camera_to_world)
    joined: Camera = jax.tree.map(lambda *x: np.concatenate(x)[:count], *found)
    return joined


def rerendered(key: jax.Array, source: Source, camera_to_world: np.ndarray) -> np.ndarray:
    """A surrogate for a novel-view model: the renderer itself, with a reconstruction's faults.

    The picture is averaged over patches of 2 x 2 pixels, which get noise; the geometry is exact,
    which a diffusion model's is not.
    """
    images, _, _ = demonstrations.render_observations(
        source.runner, _moved(source.demos, camera_to_world), source.spec, frame=source.frame
    )
    keys = jax.random.split(key, len(images))
    bits = np.asarray(jax.random.key_data(keys))
    degrade = jax.jit(
        jax.vmap(lambda bits, image: _degraded(jax.random.wrap_key_data(bits), image))
    )
    worse: np.ndarray = _by_pieces(degrade, source.runner.worlds, bits, images)
    return worse


def _degraded(key: jax.Array, image: jax.Array) -> jax.Array:
    """uint8 [size, size, 3] as a reconstruction might have it."""
    size = image.shape[0]
    small = resize(image.astype(jnp.float32) / 255, max(size // _DETAIL, 1))
    noisy = small + _NOISE * jax.random.normal(key, small.shape)
    blurred = resize(jnp.clip(noisy, 0.0, 1.0), size)
    return (255 * blurred + 0.5).astype(jnp.uint8)
