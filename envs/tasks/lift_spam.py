"""Lift Spam: pick a rectangular can across its short side and lift it 0.10 m.

The paper gives no geometry for this task; the can has the size of the potted meat can of the YCB
set, and success follows Lift Lid: held by both fingers, above a height.
"""

import dataclasses
import math

from palm_jax.envs.tasks.base import TABLE_HEIGHT, Stage
from palm_jax.envs.tasks.lift import LiftTask

LIFT_SPAM = LiftTask(
    name="lift_spam",
    asset="lift_spam.xml",
    stages=(
        Stage(
            ("spam_can", "spam_label", "spam_lid", "spam_rim"), TABLE_HEIGHT + 0.04, (0.15, 0.20)
        ),
    ),
    movable=("spam",),
    crop=200,
    horizon=120,
    body="spam",
    mocap=(),
    grasp_geom="spam_collision",
    grasp_site="spam_grasp",
    grasp_width=0.05,
    supports=(("spam_collision", "table"),),
    tip_obstacles=("spam_collision",),
    rest_height=TABLE_HEIGHT + 0.04,
    lift_height=0.10,
    lateral_limit=0.20,
    period=math.pi,
)

LIFT_SPAM_INVISIBLE = dataclasses.replace(
    LIFT_SPAM, name="lift_spam_invisible", robot_visible=False
)
"""The same with a robot that is not drawn (paper, Q4): no picture shows where the hand is."""
