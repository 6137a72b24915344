"""What the benchmark of the worlds counts, on made-up episodes whose answer is known."""

import jax
import numpy as np
import pytest

from benchmarks import bench_worlds, replay, soundness
from palm_jax.align import apply_delta
from palm_jax.envs import make

T, W = 7, 2
ENV = make("lift_spam")
PADS = [ENV.mj_model.geom(name).id for name in ENV.robot.pads]
TABLE, TIP, CAN = (ENV.mj_model.geom(n).id for n in ("table", ENV.robot.tips[0], "spam_collision"))


def episode() -> soundness.Seen:
    """World 0: from step 1 both pads hold the can, which is carried from step 3 on (10 mm a step)
    and slips by 1 mm a step; at step 6 one pad lets go. World 1: nothing touches anything."""
    tcp = np.tile(np.eye(4), (T, W, 1, 1))
    tcp[:, :, :3, :3] = np.diag([1.0, -1.0, -1.0])
    tcp[:, 0, 2, 3] = 0.8 + np.array([0, 0, 0, 0.01, 0.02, 0.03, 0.04])
    position = np.zeros((T, W, 1, 3))
    position[:, 0, 0] = tcp[:, 0, :3, 3]
    position[:, 0, 0, 0] += 0.001 * np.arange(T)
    geoms = np.full((T, W, 4, 2), -1)
    geoms[..., 0, :], geoms[..., 1, :] = (PADS[0], CAN), (CAN, PADS[1])
    geoms[..., 2, :] = (TABLE, CAN)
    distance = np.full((T, W, 4), 0.01)
    distance[1:, 0, 0], distance[1:6, 0, 1] = -0.002, -0.001
    distance[:3, 0, 2] = -0.0004
    distance[:, 1, 2], distance[:, :, 3] = -0.03, -0.5  # the last row is filling
    flags = np.zeros((T, W), bool)
    success = flags.copy()
    success[5:, 0] = True
    return soundness.Seen(tcp, position, geoms, distance, success, flags)


def test_held_is_touched_by_both_pads() -> None:
    held = soundness.held(ENV, episode())
    assert held.shape == (T, W, 1)
    np.testing.assert_array_equal(held[:, 0, 0], [0, 1, 1, 1, 1, 1, 0])
    assert not held[:, 1].any()


def test_slip_counts_from_where_the_hand_alone_carries_to_the_end() -> None:
    length = np.array([6, 6])
    slip = soundness.largest_slip(ENV, episode(), length, np.array([0]))
    assert slip == pytest.approx(0.002)  # steps 3, 4, 5
    assert soundness.largest_slip(ENV, episode(), length, np.array([1])) == 0.0
    early = soundness.largest_slip(ENV, episode(), np.array([4, 6]), np.array([0]))
    assert early == pytest.approx(0.001)  # solved after step 4: what follows does not count


def test_slip_is_that_in_the_hand_and_not_of_the_hand() -> None:
    """A hand that turns and moves with what it holds."""
    seen = episode()
    offset = np.array([0.0, 0.01, 0.02])
    for t in range(T):
        cos, sin = np.cos(0.3 * t), np.sin(0.3 * t)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        seen.tcp[t, 0, :3, :3] = rotation
        seen.tcp[t, 0, :3, 3] = (0.1 * t, 0.0, 0.8 + 0.02 * t)
        seen.position[t, 0, 0] = seen.tcp[t, 0, :3, 3] + rotation @ offset
    assert soundness.largest_slip(ENV, seen, np.array([6, 6]), np.array([0])) < 1e-12


def test_depths_by_category_of_the_chosen_worlds() -> None:
    found = soundness.deepest(ENV, episode(), np.array([6, 6]), np.array([0]))
    assert set(found) == {"finger-object", "object-support"}
    assert found["finger-object"]["depth_m"] == pytest.approx(0.002)
    assert set(found["finger-object"]["pair"]) == {ENV.robot.pads[0], "spam_collision"}
    assert found["object-support"]["depth_m"] == pytest.approx(0.0004)
    both = soundness.deepest(ENV, episode(), np.array([6, 6]), np.array([0, 1]))
    assert both["object-support"]["depth_m"] == pytest.approx(0.03)


@pytest.mark.parametrize("kind", soundness.RANDOM)
def test_random_actions_are_as_small_as_they_say(kind: str) -> None:
    steps = np.stack(
        [
            soundness._random_actions(jax.random.key(3), np.int32(t), count=64, kind=kind)
            for t in range(20)
        ]
    )
    assert np.abs(steps[..., 6:9]).max() <= 0.015
    assert set(np.unique(steps[..., 9])) == {0.0, 1.0}
    flat = steps.reshape(-1, 10)[:, :9]
    rotation = np.asarray(jax.vmap(lambda delta: apply_delta(np.eye(4), delta))(flat))[:, :3, :3]
    angle = np.arccos(np.clip((np.trace(rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert 0.05 < angle.max() < 0.1 * np.sqrt(3) + 0.01
    drift = np.linalg.norm(steps[..., 6:9].sum(0), axis=-1).mean()
    assert (drift > 0.1) == (kind == "pushing")  # random ones wander by 4 cm only


def test_agreement_of_two_executions() -> None:
    def steps(success: list[int | None], x: float) -> replay.Steps:
        solved = np.array([[s is not None and t >= s for s in success] for t in range(4)])
        tcp = np.zeros((4, 3, 3))
        tcp[..., 0] = x * np.arange(4)[:, None] * np.array([1, 2, 3])
        return replay.Steps(tcp, solved, np.zeros((4, 3), bool))

    found = replay.compare([(steps([1, 3, None], 0.0), steps([2, None, None], 0.001))])
    assert (found["both"], found["only_mjx"], found["only_c"], found["neither"]) == (1, 1, 0, 1)
    # Ends at steps 1, 3, 3: distances of 1, 6 and 9 mm.
    assert found["drift_median_m"] == pytest.approx(0.006)
    assert found["drift_worst_m"] == pytest.approx(0.009)


def test_cells_count_over_the_test_region() -> None:
    xy = np.array([[0.06, -0.34], [0.06, -0.34], [0.44, 0.34]])
    cells = bench_worlds._cells(xy, np.array([True, False, True]))
    episodes, solved = np.array(cells["episodes"]), np.array(cells["solved"])
    assert episodes.shape == bench_worlds.CELLS and episodes.sum() == 3 and solved.sum() == 2
    assert (episodes[0, 0], solved[0, 0], solved[-1, -1]) == (2, 1, 1)


def test_options_are_checked(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["--tasks", "lift_pot"], ["--scenes", "0"], ["--random", "-1"]):
        with pytest.raises(SystemExit):
            bench_worlds.main(words)
    error = capsys.readouterr().err
    assert "lift_pot" in error and "lift_spam" in error and "at least 1 scene" in error
