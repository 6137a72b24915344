"""Franka Emika Panda with its hand."""

import math

from palm_jax.envs.robots.base import Robot

PANDA = Robot(
    name="panda",
    asset="panda.xml",
    arm_joints=tuple(f"joint{i}" for i in range(1, 8)),
    velocity_limits=(2.175,) * 4 + (2.61,) * 3,
    gripper_joints=("left_finger", "right_finger"),
    gripper_closed=(0.0, 0.0),
    gripper_open=(0.04, 0.04),
    gripper_speed=0.15,
    pads=("left_pad", "right_pad"),
    tips=("left_tip", "right_tip"),
    home=(0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4),
    max_width=0.08,
)
