"""What may touch what, in every task: fingers and what they hold, objects and what they rest on."""

from collections.abc import Sequence

from palm_jax.envs.robots import Robot
from palm_jax.envs.world import Contact

PAD_FRICTION = 1.5
OBJECT_FRICTION = 0.3  # metal or plastic on wood: a finger that arrives first shifts the object


def pad_contacts(robot: Robot, grasped: Sequence[str]) -> tuple[Contact, ...]:
    """Both pads with every geom that they close on (names)."""
    return tuple(
        Contact(pad, geom, PAD_FRICTION, stiff=True) for pad in robot.pads for geom in grasped
    )


def tip_contacts(robot: Robot, obstacles: Sequence[str]) -> tuple[Contact, ...]:
    """The finger tips with the table and with other geoms that they may push on (names)."""
    return tuple(
        Contact(tip, geom, OBJECT_FRICTION, stiff=True)
        for tip in robot.tips
        for geom in ("table", *obstacles)
    )


def rests(first: str, second: str, friction: float = OBJECT_FRICTION) -> Contact:
    """An object's geom on, or against, another (names)."""
    return Contact(first, second, friction, stiff=True)
