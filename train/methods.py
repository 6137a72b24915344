"""One table of methods: what a policy sees, what is made of the demonstrations, how training images
are augmented.

Parts compose: `find("palm+mirrorduo")` is PALM on the demonstrations of MirrorDuo.
"""

import dataclasses

from palm_jax.align import AlignSpec
from palm_jax.envs.base import PAPER_FRAME, WIDE_FRAME
from palm_jax.envs.tasks import Task
from palm_jax.train.transforms import ULTRA, Transform, mirrored, novel_views, rerendered


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
      isolate: whether only the gripper and the task's objects are shown.
      transform: of the training set, if any; see `palm_jax.train.transforms`.
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
    isolate: bool = False
    transform: Transform | None = None

    def spec(self, task: Task, size: int) -> AlignSpec:
        """The alignment for a task's crop at `size` x `size` pixels."""
        return AlignSpec(
            crop=task.crop if self.crop else None,
            offset=(0, 40) if self.crop else (0, 0),
            size=size,
            overlay=self.overlay,
            layout=self.layout,
            isolate=self.isolate,
        )


PALM = Method(
    name="palm",
    title="PALM: TCP crop, axes overlay, camera-frame proprioception, augmentation",
    layout="cam6d_z",
    crop=True,
    overlay=True,
    augment=True,
    frame=WIDE_FRAME,
    hand="aligned",
)
BC = Method(
    name="bc",
    title="plain behaviour cloning: full image, world-frame pose",
    layout="world6d_xyz",
    crop=False,
    overlay=False,
    augment=False,
    frame=PAPER_FRAME,
    hand="both",
)

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        PALM,
        dataclasses.replace(
            PALM,
            name="palm-paper-frame",
            title="PALM with the crop clamped to the paper's 512-pixel frame",
            frame=PAPER_FRAME,
        ),
        dataclasses.replace(
            PALM,
            name="palm-crop",
            title="PALM without the crop: the full image",
            crop=False,
            frame=PAPER_FRAME,
        ),
        dataclasses.replace(
            PALM, name="palm-overlay", title="PALM without the axes overlay", overlay=False
        ),
        dataclasses.replace(
            PALM, name="palm-aug", title="PALM without augmentation", augment=False
        ),
        dataclasses.replace(
            PALM,
            name="palm-prop",
            title="PALM with BC's world-frame pose",
            layout="world6d_xyz",
            hand="both",  # as BC: in the world's frame a turned hand is a yaw never seen
        ),
        BC,
        dataclasses.replace(
            BC,
            name="mirrorduo",
            title="MirrorDuo: BC, and every demonstration in the mirror",
            transform=mirrored,
        ),
        dataclasses.replace(
            BC,
            name="roviaug",
            title="RoVi-Aug, viewpoints only: BC, and every frame from a moved camera (surrogate: "
            "rendered again and degraded)",
            transform=novel_views(rerendered),
        ),
        dataclasses.replace(
            BC,
            name="roviaug-ultra",
            title="RoVi-Aug, viewpoints only, as far away as it publishes (surrogate, as roviaug)",
            transform=novel_views(rerendered, ULTRA),
        ),
        dataclasses.replace(
            BC,
            name="arro",
            title="ARRO: BC on the gripper and the task's objects alone, true masks",
            isolate=True,
        ),
    )
}


def find(name: str) -> Method:
    """A method by name; "palm+mirrorduo" is PALM with what the baselines behind it add.

    Raises:
      ValueError: unknown (the message lists the known ones), a part that adds nothing, or a second
        one that makes more of the demonstrations: those it makes are none that can be rendered.
    """
    first, *rest = name.split("+")
    for part in (first, *rest):
        if part not in METHODS:
            raise ValueError(f"unknown method {part!r}; known: {', '.join(METHODS)}")
    method = METHODS[first]
    for part in rest:
        method = _with(method, METHODS[part])
    return dataclasses.replace(method, name=name)


def _with(method: Method, other: Method) -> Method:
    """`method` with the transform and the isolation of `other`."""
    if not other.transform and (method.isolate or not other.isolate):
        adding = [each.name for each in METHODS.values() if each.transform or each.isolate]
        raise ValueError(
            f"{other.name} adds nothing to {method.name}; behind a + can stand {', '.join(adding)}"
        )
    if method.transform and other.transform:
        several = [each.name for each in METHODS.values() if each.transform]
        raise ValueError(
            f"{method.name}+{other.name}: of {', '.join(several)} a method can have one"
        )
    return dataclasses.replace(
        method,
        title=f"{method.title}; with {other.title}",
        isolate=method.isolate or other.isolate,
        transform=method.transform or other.transform,
    )
