"""Lift Lid: take the lid off a saucepan by its knob (RLBench's take_lid_off_saucepan, simplified).

Solved when the knob is held and has risen by 0.105 m within 0.05 m of where it was: RLBench's
detector is a box of 0.10 x 0.10 x 0.05 m whose bottom is 0.115 m above the knob's initial centre,
which the top of the knob enters after 0.105 m.
"""

from palm_jax.envs.tasks.base import TABLE_HEIGHT, Stage
from palm_jax.envs.tasks.lift import LiftTask

LIFT_LID = LiftTask(
    name="lift_lid",
    asset="lift_lid.xml",
    stages=(Stage(("lid_plate", "lid_dome", "lid_knob"), TABLE_HEIGHT + 0.070, (0.19, 0.24)),),
    movable=("lid",),
    crop=160,
    horizon=120,
    body="lid",
    mocap=(("pan", TABLE_HEIGHT),),
    grasp_geom="knob_collision",
    grasp_site="lid_grasp",
    grasp_width=0.06,
    supports=tuple((f"lid_foot{i}", "pan_collision") for i in range(4)),
    tip_obstacles=("plate_collision",),
    rest_height=TABLE_HEIGHT + 0.077,
    lift_height=0.105,
    lateral_limit=0.05,
    period=None,
)
