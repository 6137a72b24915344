"""UFACTORY xArm 7 with the xArm gripper."""

import math

from palm_jax.envs.robots.base import Robot

XARM7 = Robot(
    name="xarm7",
    asset="xarm7.xml",
    arm_joints=tuple(f"joint{i}" for i in range(1, 8)),
    velocity_limits=(math.pi,) * 7,  # 180 degrees a second
    gripper_joints=("left_finger", "right_finger"),
    gripper_closed=(0.0, 0.0),
    gripper_open=(0.0425, 0.0425),
    gripper_speed=0.15,
    pads=("left_pad", "right_pad"),
    tips=("left_tip", "right_tip"),
    home=tuple(math.radians(angle) for angle in (0, -30, 0, 60, 0, 90, 0)),
    max_width=0.085,
)
