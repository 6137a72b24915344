"""Insert Peg: put a square ring over a square peg (RLBench's insert_onto_square_peg with one peg).

The ring's hole is 0.030 m wide, the peg 0.025 m: 5 mm of clearance in all. The peg's tip tapers
over its last 0.03 m, as guide pins do: a ring let go of around it slides and turns into place, and
a camera of four millimetres a pixel is enough to put it there. Solved when the ring
lies around the peg: its centre within 0.012 m of the peg's axis and under 0.05 m above the table,
tilted by less than 25 degrees. RLBench's four detectors around the peg say the same; nor does it
ask whether the hand has let go.
"""

import math

from palm_jax.envs.tasks.fingers import rests
from palm_jax.envs.tasks.pick_place import Item, PickPlaceTask, stages_of

_RING = Item(
    body="ring",
    goal="peg",
    object_geoms=("ring_bar0", "ring_bar1", "ring_bar2", "ring_bar3"),
    goal_geoms=("peg_body", *(f"peg_tip{i}" for i in range(4))),
    grasp_geom="ring_collision",
    grasp_site="ring_grasp",
    grasp_width=0.05,
    period=math.pi / 2,
    rest_height=0.005,
    goal_height=0.08,
    pick_start=(0.10, 0.15),
    place_start=(0.165, 0.19),
    release_height=0.132,
    goal_period=math.pi / 2,
    precision=(0.006, 0.25),
    placed_radius=0.012,
    placed_height=0.05,
    placed_upright=0.9,
    close_height=0.005,  # the ring is 10 mm high
)
_EDGES = tuple(f"peg_{part}{i}" for part in ("edge", "slope") for i in range(4))
_BARS = tuple(f"ring_rail{i}" for i in range(4))
_PEG_FRICTION = 0.1  # polished: the ring slides down its tip and turns to fit
_CORNERS = tuple(f"ring_corner{i}" for i in range(4))

INSERT_PEG = PickPlaceTask(
    name="insert_peg",
    asset="insert_peg.xml",
    stages=stages_of([_RING]),
    movable=("ring",),
    crop=160,
    horizon=200,
    items=(_RING,),
    mocap=("peg",),
    slots=((0.0, 0.0), (0.17, 0.0)),
    shuffled=False,
    jitter=0.02,
    spins=(True,),
    supports=(
        *(rests(corner, "table") for corner in _CORNERS),
        *(rests(corner, "base_collision") for corner in _CORNERS),
        *(rests(bar, edge, _PEG_FRICTION) for bar in _BARS for edge in _EDGES),
    ),
    tip_obstacles=("peg_collision",),
    release=False,
)
