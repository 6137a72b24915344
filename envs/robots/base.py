"""What the environments must know of a robot beyond its MJCF."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot arm with a two-finger gripper.

    Every robot MJCF has the base body `robot_base`, the sites `flange` and `tcp` (origin between
    the finger pads, z the approach direction, y the opening axis) and position actuators, first
    the arm's, then the gripper's.

    Attributes:
      name: key in `ROBOTS`.
      asset: MJCF file name inside `assets/robots/`.
      arm_joints: names of the arm's hinge joints, from the base to the flange.
      velocity_limits: of the arm's joints (rad/s), the maker's; large moves are slowed to them.
      gripper_joints: names of the finger joints.
      gripper_closed: finger joint positions of the closed gripper (metres or radians).
      gripper_open: finger joint positions of the open gripper.
      gripper_speed: largest change of the opening (0..1) commanded in one control step.
      pads: the collision geoms of the two finger pads.
      tips: small collision spheres at the finger tips, which meet the table and flat lids.
      home: arm joint positions (radians) of the raised pose that an episode starts from: out of the
        front camera's line of sight to the table.
      max_width: distance between the pads of the open gripper (metres).
    """

    name: str
    asset: str
    arm_joints: tuple[str, ...]
    velocity_limits: tuple[float, ...]
    gripper_joints: tuple[str, ...]
    gripper_closed: tuple[float, ...]
    gripper_open: tuple[float, ...]
    gripper_speed: float
    pads: tuple[str, str]
    tips: tuple[str, ...]
    home: tuple[float, ...]
    max_width: float
