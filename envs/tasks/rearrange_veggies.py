"""Rearrange Veggies: a carrot and a bell pepper, each to its plate, past other things on the table.

The paper gives no geometry for this task. Solved when both lie on the plate of their colour, within
0.04 m of its middle, and the hand has let go. A tin and a salt shaker stand in between.
"""

import math

from palm_jax.envs.tasks.fingers import rests
from palm_jax.envs.tasks.pick_place import Item, PickPlaceTask, stages_of

_CARROT = Item(
    body="carrot",
    goal="orange_plate",
    object_geoms=("carrot_root", "carrot_tip", "carrot_leaf0", "carrot_leaf1"),
    goal_geoms=("orange_plate_rim", "orange_plate_well"),
    grasp_geom="carrot_collision",
    grasp_site="carrot_grasp",
    grasp_width=0.034,
    period=math.pi,
    rest_height=0.017,
    goal_height=0.004,
    pick_start=(0.11, 0.16),
    place_start=(0.11, 0.15),
    release_height=0.020,
    goal_period=None,
    precision=(0.008, 0.2),
    placed_radius=0.04,
    placed_height=0.035,
)
_PEPPER = Item(
    body="pepper",
    goal="green_plate",
    object_geoms=("pepper_body", "pepper_lobe0", "pepper_lobe1", "pepper_lobe2", "pepper_stem"),
    goal_geoms=("green_plate_rim", "green_plate_well"),
    grasp_geom="pepper_collision",
    grasp_site="pepper_grasp",
    grasp_width=0.052,
    period=math.pi / 2,
    rest_height=0.026,
    goal_height=0.004,
    pick_start=(0.11, 0.16),
    place_start=(0.11, 0.15),
    release_height=0.029,
    goal_period=None,
    precision=(0.008, 0.2),
    placed_radius=0.04,
    placed_height=0.045,
)
_CLUTTER = ("tin_collision", "shaker_collision")
_CORES = ("carrot_core", "pepper_core")

REARRANGE_VEGGIES = PickPlaceTask(
    name="rearrange_veggies",
    asset="rearrange_veggies.xml",
    stages=stages_of([_CARROT, _PEPPER]),
    movable=("carrot", "pepper"),
    crop=160,
    horizon=300,
    items=(_CARROT, _PEPPER),
    mocap=("orange_plate", "green_plate", "tin", "shaker"),
    slots=tuple((0.125 * column, 0.125 * row) for column in range(3) for row in range(2)),
    shuffled=True,
    jitter=0.006,
    spins=(False, False, True, True),
    supports=(
        rests("carrot_collision", "table"),
        rests("pepper_collision", "table"),
        rests("carrot_core", "pepper_core"),
        *(rests(core, thing) for core in _CORES for thing in _CLUTTER),
    ),
    tip_obstacles=_CLUTTER,
    release=True,
)
