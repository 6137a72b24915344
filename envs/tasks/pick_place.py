"""Tasks of another kind: pick objects one after the other and put each in its place.

Stage 2i picks item i, stage 2i + 1 puts it down. The stage follows from the state: an object that
is held and has risen is to be put down; one that lies in its place, let go of, is done; one that
was dropped elsewhere is to be picked again.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from palm_jax.envs.control import yaw_quaternion
from palm_jax.envs.robots import Robot
from palm_jax.envs.tasks.base import TABLE_HEIGHT, Command, Placement, Stage, Task
from palm_jax.envs.tasks.fingers import pad_contacts, tip_contacts
from palm_jax.envs.tasks.skills import CLOSE_HEIGHT, Hold, both_touch, hold, pick, put, turn_to
from palm_jax.envs.world import Contact

_PICKED = 0.03  # metres that a held object has risen when the global policy takes over
_OPEN = 0.95  # opening (0..1) from which the hand has let go
_LAYOUTS = 24  # arrangements of the other objects drawn, of which the one that fits best is taken


@dataclasses.dataclass(frozen=True)
class Item:
    """An object and its place.

    Attributes:
      body: the free body.
      goal: the mocap body that marks its place.
      object_geoms, goal_geoms: rendered geoms whose masks the global policy looks for.
      grasp_geom: its collision geom that the pads close on.
      grasp_site: where the TCP should be when the gripper closes.
      grasp_width: width of the object between the pads (metres).
      period: yaw (radians) after which the object looks the same to two fingers; None if it always
        does.
      rest_height: height of the body's origin above the table at rest (metres).
      goal_height: height above the table (metres) of the centre of the goal's mask.
      pick_start, place_start: (low, high) height of the TCP above the table as the stages begin.
      release_height: height of the body's origin above the table at which the expert lets go.
      goal_period: yaw (radians) after which the place looks the same to the object; None if it
        does not matter how the object lies.
      precision: (metres, radians) from its place within which the expert goes down with it.
      placed_radius: horizontal distance from the goal's origin (metres) within which it is in its
        place...
      placed_height: ...if its origin is at most this high above the table...
      placed_upright: ...and the cosine of its tilt at least this (-1: however it lies).
      close_height: height of the TCP above the grasp (metres) at which the expert closes the hand.
    """

    body: str
    goal: str
    object_geoms: tuple[str, ...]
    goal_geoms: tuple[str, ...]
    grasp_geom: str
    grasp_site: str
    grasp_width: float
    period: float | None
    rest_height: float
    goal_height: float
    pick_start: tuple[float, float]
    place_start: tuple[float, float]
    release_height: float
    goal_period: float | None
    precision: tuple[float, float]
    placed_radius: float
    placed_height: float
    placed_upright: float = -1.0
    close_height: float = CLOSE_HEIGHT


def stages_of(items: Sequence[Item]) -> tuple[Stage, ...]:
    """The stages of a task that picks and puts down `items` in this order."""
    stages = []
    for item in items:
        pick_height = TABLE_HEIGHT + item.rest_height
        stages.append(Stage(item.object_geoms, pick_height, item.pick_start))
        goal_height = TABLE_HEIGHT + item.goal_height
        stages.append(Stage(item.goal_geoms, goal_height, item.place_start, open_hand=False))
    return tuple(stages)


class ItemIds(NamedTuple):
    """Ids in the compiled model of one item."""

    body: int
    qpos: int  # address of the free joint in qpos
    grasp_site: int
    grasp_geom: int
    goal: int
    hold: Hold


class PickPlaceIds(NamedTuple):
    """Ids in the compiled model that the task needs."""

    items: tuple[ItemIds, ...]
    pads: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class PickPlaceTask(Task):
    """Solved when every item lies in its place and the hand has let go.

    Attributes:
      items: in the order in which they are handled.
      mocap: every mocap body of the task, in the order of the MJCF, goals first.
      slots: [K][2] where things stand relative to each other (metres): the first item's, the other
        items', then the mocap bodies'. The whole is turned at random.
      shuffled: whether all but the first change places at random.
      jitter: metres, per axis, by which each is moved.
      spins: which of the mocap bodies are turned at random about z.
      supports: what objects rest on or bump into.
      tip_obstacles: geoms besides the table and the items that the finger tips may push on.
      release: whether the hand must have let go of everything for success.
    """

    items: tuple[Item, ...]
    mocap: tuple[str, ...]
    slots: tuple[tuple[float, float], ...]
    shuffled: bool
    jitter: float
    spins: tuple[bool, ...]
    supports: tuple[Contact, ...]
    tip_obstacles: tuple[str, ...]
    release: bool

    def contacts(self, robot: Robot) -> tuple[Contact, ...]:
        grasped = tuple(item.grasp_geom for item in self.items)
        tips = tip_contacts(robot, (*grasped, *self.tip_obstacles))
        return (*pad_contacts(robot, grasped), *self.supports, *tips)

    def bind(self, model: mujoco.MjModel, robot: Robot) -> PickPlaceIds:
        left, right = (model.geom(name).id for name in robot.pads)
        items = []
        for item in self.items:
            body = model.body(item.body).id
            items.append(
                ItemIds(
                    body=body,
                    qpos=int(model.jnt_qposadr[model.body_jntadr[body]]),
                    grasp_site=model.site(item.grasp_site).id,
                    grasp_geom=model.geom(item.grasp_geom).id,
                    goal=model.body(item.goal).id,
                    hold=hold(robot, item.grasp_width),
                )
            )
        return PickPlaceIds(tuple(items), (left, right))

    # -- start -------------------------------------------------------------------------------------

    def place(
        self,
        ids: PickPlaceIds,
        key: jax.Array,
        qpos: jax.Array,
        xy: jax.Array,
        yaw: jax.Array,
        area: jax.Array,
    ) -> Placement:
        layout_key, turn_key = jax.random.split(key)
        where = self._layout(layout_key, xy, area)
        others = len(self.items) - 1
        turns = jax.random.uniform(turn_key, (others + len(self.mocap),), minval=-0.5, maxval=0.5)
        yaws = jnp.append(yaw, turns[:others])
        for item, found, at, turn in zip(self.items, ids.items, where, yaws, strict=False):
            height = jnp.array([TABLE_HEIGHT + item.rest_height])
            pose = jnp.concatenate([at, height, yaw_quaternion(turn)])
            qpos = jax.lax.dynamic_update_slice(qpos, pose, (found.qpos,))
        marks = where[len(self.items) :]
        spins = jnp.where(jnp.asarray(self.spins), turns[others:], 0.0)
        return Placement(
            qpos=qpos,
            mocap_pos=jnp.column_stack([marks, jnp.full(len(marks), TABLE_HEIGHT)]),
            mocap_quat=jax.vmap(yaw_quaternion)(spins),
        )

    def _layout(self, key: jax.Array, xy: jax.Array, area: jax.Array) -> jax.Array:
        """[K, 2] positions, the first item's at `xy` [2], the others inside of `area` [2, 2].

        Of a number of arrangements, turned and shuffled at random, the first that lies inside; if
        none does, the one that leaves by least.
        """
        slots = jnp.asarray(self.slots)

        def draw(key: jax.Array) -> jax.Array:
            angle_key, order_key, jitter_key = jax.random.split(key, 3)
            order = jax.random.permutation(order_key, len(slots))
            placed = slots[order] if self.shuffled else slots
            angle = jax.random.uniform(angle_key, (), minval=-jnp.pi, maxval=jnp.pi)
            cos, sin = jnp.cos(angle), jnp.sin(angle)
            relative = placed - placed[0]
            turned = relative @ jnp.stack([cos, sin, -sin, cos]).reshape(2, 2)
            jitter = jax.random.uniform(jitter_key, turned.shape, minval=-1.0, maxval=1.0)
            return xy + turned + self.jitter * jitter.at[0].set(0.0)

        drawn = jax.vmap(draw)(jax.random.split(key, _LAYOUTS))
        outside = jnp.maximum(area[0] - drawn, drawn - area[1])[:, 1:].clip(min=0.0)
        return drawn[jnp.argmin(jnp.max(outside, axis=(1, 2)))]

    # -- during an episode -------------------------------------------------------------------------

    def object_position(self, ids: PickPlaceIds, data: mjx.Data) -> jax.Array:
        return data.xpos[ids.items[0].body]

    def held(self, ids: PickPlaceIds, data: mjx.Data) -> jax.Array:
        return jnp.stack([both_touch(data, ids.pads, item.grasp_geom) for item in ids.items])

    def placed(self, ids: PickPlaceIds, data: mjx.Data) -> jax.Array:
        """bool [M]: which items are where they belong, whether held or not."""
        result = []
        for item, found in zip(self.items, ids.items, strict=True):
            offset = data.xpos[found.body] - data.xpos[found.goal]
            near = jnp.linalg.norm(offset[:2]) <= item.placed_radius
            low = data.xpos[found.body, 2] <= TABLE_HEIGHT + item.placed_height
            upright = data.xmat[found.body, 2, 2] >= item.placed_upright
            result.append(near & low & upright)
        return jnp.stack(result)

    def next_stage(
        self, ids: PickPlaceIds, data: mjx.Data, stage: jax.Array, opening: jax.Array
    ) -> jax.Array:
        item, placing = stage // 2, stage % 2 == 1
        held, placed = self.held(ids, data)[item], self.placed(ids, data)[item]
        rest = TABLE_HEIGHT + jnp.array([i.rest_height for i in self.items])
        height = data.xpos[np.array([i.body for i in ids.items]), 2] - rest
        picked = ~placing & held & (height[item] > _PICKED)
        let_go = placing & ~held & (opening > _OPEN)
        finished = let_go & placed & (item < len(self.items) - 1)
        # Not in its place and lying about, neither held nor falling: pick it again.
        dropped = placing & ~held & ~placed & (height[item] < 0.5 * _PICKED)
        step = jnp.where(picked | finished, 1, jnp.where(dropped, -1, 0))
        return (stage + step).astype(stage.dtype)

    def success(
        self, ids: PickPlaceIds, data: mjx.Data, start: jax.Array, opening: jax.Array
    ) -> jax.Array:
        del start
        placed = jnp.all(self.placed(ids, data))
        if not self.release:
            return placed
        return placed & (opening > _OPEN) & ~jnp.any(self.held(ids, data))

    def expert(
        self,
        ids: PickPlaceIds,
        data: mjx.Data,
        tcp: jax.Array,
        opening: jax.Array,
        start: jax.Array,
        stage: jax.Array,
    ) -> Command:
        del start
        commands = [
            command
            for item, found in zip(self.items, ids.items, strict=True)
            for command in (
                self._pick(item, found, data, tcp, opening),
                self._put(item, found, data, tcp, opening),
            )
        ]
        stacked: Command = jax.tree.map(lambda *leaves: jnp.stack(leaves), *commands)
        chosen: Command = jax.tree.map(lambda leaf: leaf[stage], stacked)
        return chosen

    def _pick(
        self, item: Item, found: ItemIds, data: mjx.Data, tcp: jax.Array, opening: jax.Array
    ) -> Command:
        grasp = data.site_xpos[found.grasp_site]
        yaw = jnp.arctan2(tcp[1, 0], tcp[0, 0])
        rest = TABLE_HEIGHT + item.rest_height
        return pick(
            tcp,
            opening,
            grasp,
            turn_to(data.xmat[found.body], yaw, item.period),
            hold=found.hold,
            bottom=rest + (grasp[2] - data.xpos[found.body, 2]),
            rise=2 * _PICKED,
            close_height=item.close_height,
        )

    def _put(
        self, item: Item, found: ItemIds, data: mjx.Data, tcp: jax.Array, opening: jax.Array
    ) -> Command:
        body, goal = data.xmat[found.body], data.xpos[found.goal]
        yaw = jnp.arctan2(body[1, 0], body[0, 0])
        radius, angle = item.precision
        return put(
            tcp,
            opening,
            data.xpos[found.body],
            jnp.append(goal[:2], TABLE_HEIGHT + item.release_height),
            turn_to(data.xmat[found.goal], yaw, item.goal_period),
            hold=found.hold,
            radius=radius,
            angle=angle,
        )
