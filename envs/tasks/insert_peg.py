"""Insert Peg: put a square ring over a square peg (RLBench's insert_onto_square_peg with one peg).

The ring's hole is 0.030 m wide, the peg 0.025 m: 5 mm of clearance in all. Solved when the ring
lies around the peg: its centre within 0.012 m of the peg's axis and under 0.05 m above the table,
tilted by less than 25 degrees. RLBench's four detectors around the peg say the same; nor does it
ask whether the hand has let go.
"""

import math

from palm_jax.envs.tasks.pick_place import Item, PickPlaceTask, stages_of

_RING = Item(
    body="ring",
    goal="peg",
    object_geoms=("ring_bar0", "ring_bar1", "ring_bar2", "ring_bar3"),
    goal_geoms=("peg_body",),
    grasp_geom="ring_collision",
    grasp_site="ring_grasp",
    grasp_width=0.05,
    period=math.pi / 2,
    rest_height=0.005,
    goal_height=0.08,
    pick_start=(0.10, 0.15),
    place_start=(0.165, 0.19),
    release_height=0.147,
    goal_period=math.pi / 2,
    precision=(0.004, 0.12),
    placed_radius=0.012,
    placed_height=0.05,
    placed_upright=0.9,
    close_height=0.005,  # the ring is 10 mm high
)
_EDGES = tuple(f"peg_edge{i}" for i in range(4))
_BARS = tuple(f"ring_rail{i}" for i in range(4))
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
        *((corner, "table") for corner in _CORNERS),
        *((corner, "base_collision") for corner in _CORNERS),
        *((bar, edge) for bar in _BARS for edge in _EDGES),
    ),
    tip_obstacles=("peg_collision",),
    release=False,
)
