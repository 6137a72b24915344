"""One table of methods: what a policy sees, and how its training images are augmented."""

import dataclasses

from palm_jax.align import AlignSpec
from palm_jax.envs.base import PAPER_FRAME, WIDE_FRAME
from palm_jax.envs.tasks import Task


@dataclasses.dataclass(frozen=True)
class Method:
    """A row of `METHODS`.

    Attributes:
      name: key.
      title: one line for people.
      layout: proprioception, see `palm_jax.align.proprio`.
      crop: whether the image is cropped around the TCP.
      overlay: whether the TCP axes are drawn.
      augment: whether Random Overlay and perspective run in training.
      frame: side in pixels of the virtual full image that a crop is clamped to.
      hand: evaluations under a turned camera: "aligned" (the hand's initial yaw turns with the
        camera, as in the authors' code for PALM), or "both": with and without, the better one
        quoted.
    """

    name: str
    title: str
    layout: str
    crop: bool
    overlay: bool
    augment: bool
    frame: int
    hand: str

    def spec(self, task: Task, size: int) -> AlignSpec:
        """The alignment for a task's crop at `size` x `size` pixels."""
        return AlignSpec(
            crop=task.crop if self.crop else None,
            offset=(0, 40) if self.crop else (0, 0),
            size=size,
            overlay=self.overlay,
            layout=self.layout,
        )


METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            name="palm",
            title="PALM: TCP crop, axes overlay, camera-frame proprioception, augmentation",
            layout="cam6d_z",
            crop=True,
            overlay=True,
            augment=True,
            frame=WIDE_FRAME,
            hand="aligned",
        ),
        Method(
            name="palm-paper-frame",
            title="PALM with the crop clamped to the paper's 512-pixel frame",
            layout="cam6d_z",
            crop=True,
            overlay=True,
            augment=True,
            frame=PAPER_FRAME,
            hand="aligned",
        ),
        Method(
            name="bc",
            title="plain behaviour cloning: full image, world-frame pose",
            layout="world6d_xyz",
            crop=False,
            overlay=False,
            augment=False,
            frame=PAPER_FRAME,
            hand="both",
        ),
    )
}


def find(name: str) -> Method:
    """A method by name.

    Raises:
      ValueError: unknown; the message lists the known ones.
    """
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}; known: {', '.join(METHODS)}")
    return METHODS[name]
