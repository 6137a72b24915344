"""Universal Robots UR5 (CB3 series) with a Robotiq 2F-85 gripper."""

import math

from palm_jax.envs.robots.base import Robot

UR5 = Robot(
    name="ur5",
    asset="ur5.xml",
    arm_joints=(
        "shoulder_pan_joint",
        "shoulder_lift_joint",
        "elbow_joint",
        "wrist_1_joint",
        "wrist_2_joint",
        "wrist_3_joint",
    ),
    velocity_limits=(math.pi,) * 6,  # 180 degrees a second
    gripper_joints=("left_finger", "right_finger"),
    gripper_closed=(0.0, 0.0),
    gripper_open=(0.0425, 0.0425),
    gripper_speed=0.15,
    pads=("left_pad", "right_pad"),
    tips=("left_tip", "right_tip"),
    home=tuple(math.radians(angle) for angle in (0, -115, 100, -75, -90, 0)),
    max_width=0.085,
)
