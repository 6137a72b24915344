"""Films: which frames of which world are drawn, with the params of its scene."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from palm_jax.align import AlignSpec
from palm_jax.train.reporting import films

WORLDS, STEPS = 4, 6
SPEC = AlignSpec(crop=None, size=8)


class Projector:
    """A runner whose pictures show the joint position and the light of the state they are of."""

    worlds = WORLDS

    def restore(self, qpos: Any, pos: Any, quat: Any, camera: Any, params: Any) -> Any:
        # Everything but the joints is that of the one world.
        assert np.ptp(pos) == np.ptp(camera) == 0 and len(quat) == WORLDS
        return SimpleNamespace(qpos=qpos, shelf=pos[:, 0, 0])

    def observe(self, state: Any, params: Any, spec: AlignSpec, *, frame: int) -> Any:
        assert spec is SPEC and frame == 512
        return SimpleNamespace(image=picture(state.qpos[:, 0], params["light"], state.shelf))

    def render(self, state: Any, params: Any, size: int) -> Any:
        assert size == films.FULL_SIZE
        return picture(state.qpos[:, 0] + 100, params["light"], state.shelf)


def picture(*channels: Any) -> np.ndarray:
    return np.stack([np.asarray(c) for c in channels], -1).astype(np.uint8)[:, None, None]


def trace(solved_at: int | None) -> films.Trace:
    """World w is at 10 w + t at time t; world 2 solves the task."""
    found = films.Trace()
    worlds = jnp.arange(WORLDS)
    for t in range(STEPS):
        data = SimpleNamespace(
            qpos=(10 * worlds + t)[:, None],
            mocap_pos=jnp.tile(worlds[:, None, None] + 7, (1, 1, 3)),
            mocap_quat=jnp.zeros((WORLDS, 1, 4)),
        )
        success = (worlds == 2) & (solved_at is not None and t >= solved_at)
        camera = jnp.zeros((WORLDS, 4, 4))
        state: Any = SimpleNamespace(data=data, success=success, camera_to_world=camera)
        found(state)
    return found


def camera() -> films.Camera:
    projector: Any = Projector()
    params: Any = {"light": jnp.arange(WORLDS) + 50}
    return films.Camera(projector, params, SPEC, 512)


@pytest.mark.parametrize(("world", "solved_at"), [(1, None), (2, 4), (2, 0), (3, 2)])
def test_a_film_shows_one_world_until_it_is_solved(world: int, solved_at: int | None) -> None:
    film = camera().film(trace(solved_at), world)
    solved = world == 2
    length = solved_at + 1 if solved and solved_at is not None else STEPS
    assert film.success == solved and len(film.inputs) == len(film.frames) == length
    times = 10 * world + np.arange(length)
    np.testing.assert_array_equal(film.inputs[:, 0, 0, 0], times)
    np.testing.assert_array_equal(film.frames[:, 0, 0, 0], times + 100)
    # The light of the world's own scene, and the objects that stand where it has them.
    assert set(film.inputs[:, 0, 0, 1].tolist()) == {50 + world}
    assert set(film.frames[:, 0, 0, 2].tolist()) == {7 + world}


def test_the_first_view_is_that_of_scene_0() -> None:
    image, frame = camera().first(trace(None))
    assert image[0, 0].tolist() == [0, 50, 7] and frame[0, 0].tolist() == [100, 50, 7]
