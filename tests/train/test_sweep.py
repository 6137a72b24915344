"""Sweeps: what is asked for, in which order it runs, and where its results end up."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from palm_jax.envs import make, shifts
from palm_jax.envs.base import EnvParams
from palm_jax.envs.rollout import Episodes
from palm_jax.train import sweep
from palm_jax.train.evaluate import Evaluator
from palm_jax.train.methods import find


@pytest.mark.parametrize(
    ("text", "degrees"),
    [("-30:30:5", [-30, -15, 0, 15, 30]), ("12.5", [12.5]), ("-7", [-7]), ("0:10:1", [0])],
)
def test_angles(text: str, degrees: list[float]) -> None:
    np.testing.assert_allclose(np.degrees(sweep.angles_of(text)), degrees, atol=1e-9)


@pytest.mark.parametrize("text", ["", "a", "1:2", "1:2:0", "1:2:x", "1:2:3:4", "--1", "1.2.3:4:5"])
def test_angles_that_are_none(text: str) -> None:
    with pytest.raises(ValueError):
        sweep.angles_of(text)


def test_cells_are_centres_of_the_test_region() -> None:
    xs, ys = sweep.cells_of("2x7")
    np.testing.assert_allclose(xs, [0.15, 0.35])
    np.testing.assert_allclose(ys, [-0.3, -0.2, -0.1, 0, 0.1, 0.2, 0.3], atol=1e-9)


@pytest.mark.parametrize("text", ["", "3", "3x", "0x3", "3x0", "-1x3", "3 x 3", "3x3x3"])
def test_cells_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="COLUMNSxROWS"):
        sweep.cells_of(text)


ANGLES, XS, YS = np.array([-0.2, 0.1]), np.array([0.1, 0.2, 0.3]), np.array([-0.1, 0.0, 0.1, 0.2])


@pytest.fixture(scope="module")
def default() -> EnvParams:
    return make("lift_spam").default_params()


def test_cell_params_pin_angle_and_object(default: EnvParams) -> None:
    cells = sweep.cell_params(default, ANGLES, XS, YS, 2)
    count = 2 * 3 * 4 * 2
    for field in dataclasses.fields(EnvParams):
        cell, base = getattr(cells, field.name), getattr(default, field.name)
        assert cell.shape == (count, *base.shape) and cell.dtype == base.dtype, field.name
        if field.name not in ("camera_angle", "object_low", "object_high"):
            np.testing.assert_array_equal(cell, np.broadcast_to(base, cell.shape))
    np.testing.assert_array_equal(cells.object_low, cells.object_high)
    np.testing.assert_array_equal(cells.camera_angle[:, 0], cells.camera_angle[:, 1])
    row = np.ravel_multi_index((1, 2, 3, 0), (2, 3, 4, 2))
    np.testing.assert_allclose(cells.object_low[row], [XS[2], YS[3]])
    np.testing.assert_allclose(cells.camera_angle[row], ANGLES[1])


class Room:
    """A runner without physics: an episode is a function of its params and its key."""

    def __init__(self, worlds: int) -> None:
        self.env, self.worlds = make("lift_spam"), worlds
        self.batches: list[np.ndarray] = []

    def run(
        self, key: Any, keys: jax.Array, params: EnvParams, act: Any, spec: Any, **options: Any
    ) -> Episodes:
        del key, act, spec, options
        assert len(keys) == len(params.object_low) == self.worlds
        self.batches.append(np.asarray(jax.random.key_data(keys)))
        x, y = np.asarray(params.object_low).T
        angle = np.asarray(params.camera_angle)[:, 0]
        flat = np.zeros(self.worlds)
        return Episodes(
            success=jnp.asarray((x > 0.15) & (y < 0.15) & (angle < 0)),
            nan=jnp.asarray(y > 0.15),
            seen=jnp.asarray(flat == 0),
            length=jnp.asarray(flat.astype(np.int32)),
            object_xy=jnp.asarray(np.stack([x, y], -1)),
            object_yaw=jnp.asarray(np.asarray(params.align_hand)),
            camera_angle=jnp.asarray(angle),
        )


def evaluator(worlds: int) -> tuple[Evaluator, Room]:
    room: Any = Room(worlds)
    learner: Any = type("Idle", (), {"jitted_act": None})()
    return Evaluator(room, find("palm"), learner, 84), room


POLICY: Any = None


@pytest.mark.parametrize("worlds", [5, 48, 64])
def test_every_result_lands_in_its_cell(worlds: int) -> None:
    """Whatever the batch: axes are angle, x, y, episode."""
    runs, room = evaluator(worlds)
    finished: list[int] = []
    found = sweep.sweep(
        runs,
        POLICY,
        angles=ANGLES,
        xs=XS,
        ys=YS,
        episodes=2,
        seed=0,
        aligned=True,
        progress=finished.append,
    )
    angle, x, y, _ = np.meshgrid(ANGLES, XS, YS, range(2), indexing="ij")
    np.testing.assert_array_equal(found.success, (x > 0.15) & (y < 0.15) & (angle < 0))
    np.testing.assert_array_equal(found.nan, y > 0.15)
    assert sum(finished) == 48 and len(room.batches) == -(-48 // worlds)
    keys = np.concatenate(room.batches)[:48]
    assert len(np.unique(keys, axis=0)) == 48  # every episode is a scene of its own


@pytest.mark.parametrize("count", [1, 7, 8, 9, 20])
def test_an_evaluation_has_as_many_episodes_as_it_was_asked_for(count: int) -> None:
    """The last batch is filled up and cut; a scene's key does not depend on the count."""
    runs, room = evaluator(8)
    record = runs.domain(POLICY, "workspace", seed=3, count=count, aligned=False)
    assert record.success.shape == record.nan.shape == record.length.shape == (count,)
    assert record.object_xy.shape == (count, 2)
    longer, other = evaluator(8)
    longer.domain(POLICY, "workspace", seed=3, count=24, aligned=False)
    mine, theirs = np.concatenate(room.batches), np.concatenate(other.batches)
    np.testing.assert_array_equal(mine, theirs[: len(mine)])
    moved, third = evaluator(8)
    moved.domain(POLICY, "viewpoint", seed=3, count=count, aligned=False)
    assert (np.concatenate(third.batches) != mine).any(-1).all()  # other domain, other scenes


@pytest.mark.parametrize("aligned", [False, True])
def test_the_hand_follows_the_camera_only_where_it_is_asked_to(aligned: bool) -> None:
    runs, room = evaluator(4)
    seen: list[float] = []
    inner = room.run

    def spy(key: Any, keys: Any, params: EnvParams, *rest: Any, **options: Any) -> Episodes:
        seen.extend(np.asarray(params.align_hand).tolist())
        return inner(key, keys, params, *rest, **options)

    room.run = spy  # type: ignore[method-assign]
    runs.domain(POLICY, shifts.DOMAINS[-1], seed=0, count=4, aligned=aligned)
    assert set(seen) == {float(aligned)}
