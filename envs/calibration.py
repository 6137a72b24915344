"""A camera's calibration error: the camera that a policy believes in, from the true one."""

import dataclasses

import jax
import jax.numpy as jnp

from palm_jax.align import Camera
from palm_jax.align.camera import matmul
from palm_jax.envs.control import rotation_matrix


def miscalibrated(
    camera: Camera, pixels: jax.Array, rotation: jax.Array, translation: jax.Array
) -> Camera:
    """`camera` with errors in its principal point and its pose; zeros change no bit.

    Args:
      camera: the true one.
      pixels: [2] (u, v) by which the believed principal point, and with it every projected point,
        is off, pixels of `camera`.
      rotation: [3] rotation vector in the true camera's axes, radians.
      translation: [3] in the true camera's axes (right, down, forward), metres.
    """
    error = jnp.eye(4).at[:3, :3].set(rotation_matrix(rotation)).at[:3, 3].set(translation)
    return dataclasses.replace(
        camera,
        K=jnp.asarray(camera.K).at[:2, 2].add(pixels),
        cam_to_world=matmul(camera.cam_to_world, error),
    )
