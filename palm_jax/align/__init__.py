"""Perception alignment: pure functions that make a policy see the same thing after a shift.

Conventions, here once for all functions:

- One example, no batch axis; batch with `jax.vmap`. (Frames of 512 pixels on a CPU: `jax.lax.map`
  with `batch_size=8` is two to three times as fast.) Augmentation takes batches. Everything runs
  under `jax.jit`; NumPy arrays are accepted. `key` comes first, options are keyword-only.
- Images are HWC, uint8 at rest, float32 in [0, 1] in arithmetic; an op keeps the dtype it is given.
- Camera axes are OpenCV's (x right, y down, z forward), `cam_to_world` is the camera's pose. The
  point (u, v) is in pixels, u right, v down; pixel (row i, column j) has its centre at
  (j + 0.5, i + 0.5).
- The TCP's origin lies between the finger pads, z is the approach direction, y the opening axis.
- Metres, radians, world z up. 6D rotation: the first two columns of the matrix, concatenated.
- Bad shapes, dtypes and options raise always; bad values raise where they are concrete, and have a
  documented result under jit and vmap.

Example::

    spec = AlignSpec(crop=200, size=84)
    image, proprio = align(frame, camera, tcp, opening, spec)
"""

from palm_jax._checks import (
    CameraError,
    DtypeError,
    OptionError,
    PoseError,
    ProjectionError,
    ShapeError,
)
from palm_jax.align.actions import (
    achieved_deltas,
    apply_delta,
    encode_delta,
    gripper_labels,
    overwrite_transitions,
)
from palm_jax.align.augment import (
    center_crop,
    overlay_blend,
    perspective_warp,
    random_crop,
    random_overlay,
    random_perspective,
    random_turn,
    subpixel_crop,
    turn_view,
)
from palm_jax.align.camera import Camera, project, unproject, unproject_to_height
from palm_jax.align.crop import resize, tcp_crop
from palm_jax.align.isolate import isolate
from palm_jax.align.lens import distort_points, undistort, undistort_points
from palm_jax.align.overlay import tcp_overlay
from palm_jax.align.pipeline import Aligned, AlignSpec, align, align_window, window_origin
from palm_jax.align.proprio import matrix_from_6d, proprio, rotation_6d
from palm_jax.align.reframe import align_like, reframe
from palm_jax.align.textures import procedural_bank

__all__ = [
    "AlignSpec",
    "Aligned",
    "Camera",
    "CameraError",
    "DtypeError",
    "OptionError",
    "PoseError",
    "ProjectionError",
    "ShapeError",
    "achieved_deltas",
    "align",
    "align_like",
    "align_window",
    "apply_delta",
    "center_crop",
    "distort_points",
    "encode_delta",
    "gripper_labels",
    "isolate",
    "matrix_from_6d",
    "overlay_blend",
    "overwrite_transitions",
    "perspective_warp",
    "procedural_bank",
    "project",
    "proprio",
    "random_crop",
    "random_overlay",
    "random_perspective",
    "random_turn",
    "reframe",
    "resize",
    "rotation_6d",
    "subpixel_crop",
    "tcp_crop",
    "tcp_overlay",
    "turn_view",
    "undistort",
    "undistort_points",
    "unproject",
    "unproject_to_height",
    "window_origin",
]
