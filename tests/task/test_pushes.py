"""Random pushes: timing, force and direction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from surefoot.errors import SurefootError
from surefoot.task.pushes import PushConfig, Pusher

STEP = 0.006


def make_pusher(config: PushConfig, num_envs: int, seed: int) -> Pusher:
    """Return the pusher of robots with a weight of 100 N."""
    return Pusher(config, num_envs, seed, 100.0)


def forces(pusher: Pusher, steps: int, first: int = 0) -> np.ndarray:
    """Return the force in each control step (steps, N, 3), at the time of the step's start."""
    path = []
    for k in range(first, first + steps):
        pusher.update(np.full(len(pusher.force), k * STEP))
        path.append(pusher.force.copy())
    return np.array(path)


def test_a_push_comes_every_200_steps_and_keeps_its_force_for_10_steps():
    path = forces(make_pusher(PushConfig(enabled=True), 2, seed=1), 1000)
    expected = [k for k in range(1000) if k >= 200 and k % 200 < 10]
    for robot in range(2):
        assert np.flatnonzero(path[:, robot].any(axis=1)).tolist() == expected
    for start in (200, 400, 600):
        assert np.all(path[start : start + 10] == path[start])
    assert not np.allclose(path[200], path[400])
    assert not np.allclose(path[200, 0], path[200, 1])


def test_pushes_are_uniform_in_size_and_direction():
    many = forces(make_pusher(PushConfig(enabled=True), 2000, seed=3), 1, first=200)[0]
    size = np.linalg.norm(many, axis=1)
    assert size.min() >= 130
    assert size.max() <= 220
    assert stats.kstest(size, "uniform", (130, 90)).pvalue > 0.01
    unit = many / size[:, None]
    # On a sphere, the heading and each coordinate are uniform (Archimedes).
    heading = np.arctan2(unit[:, 1], unit[:, 0])
    assert stats.kstest(heading, "uniform", (-np.pi, 2 * np.pi)).pvalue > 0.01
    for axis in range(3):
        assert stats.kstest(unit[:, axis], "uniform", (-1, 2)).pvalue > 0.01


def test_horizontal_pushes_have_their_whole_force_in_the_plane():
    config = PushConfig(enabled=True, direction="horizontal", force=(60.0, 60.0))
    many = forces(make_pusher(config, 2000, seed=3), 1, first=200)[0]
    assert not many[:, 2].any()
    np.testing.assert_allclose(np.linalg.norm(many, axis=1), 60.0)
    assert stats.kstest(np.arctan2(many[:, 1], many[:, 0]), "uniform", (-np.pi, 2 * np.pi)).pvalue > 0.01


def test_a_ramp_scales_a_robots_first_pushes_over_all_its_episodes():
    pusher = make_pusher(PushConfig(enabled=True, force=(100.0, 100.0), ramp=4), 1, seed=1)
    sizes = []
    for _ in range(3):  # episodes with two pushes each
        path = forces(pusher, 500)[:, 0]
        sizes += np.linalg.norm(path[[200, 400]], axis=1).tolist()
        pusher.restart(np.array([0]))
    assert sizes == pytest.approx([25, 50, 75, 100, 100, 100])


def test_evaluations_use_every_push_with_full_force():
    trained = PushConfig(probability=0.05, ramp=30, force=(1.0, 2.0))
    assert trained.for_evaluation(True) == PushConfig(enabled=True, force=(1.0, 2.0))
    assert trained.for_evaluation(False) == PushConfig(enabled=False, force=(1.0, 2.0))
    assert trained.for_evaluation(False, (20.0, 40.0)) == PushConfig(
        enabled=True, force=(20.0, 40.0), direction="horizontal"
    )


def test_relative_forces_are_in_units_of_weight():
    config = PushConfig(enabled=True, relative=True, force=(0.5, 0.5))
    pushed = forces(make_pusher(config, 1, seed=1), 1, first=200)
    np.testing.assert_allclose(np.linalg.norm(pushed), 50.0)
    assert config.for_evaluation(True, (20.0, 40.0)).force_range(100.0) == (20.0, 40.0)


@pytest.mark.parametrize("probability", [0.0, 0.3, 1.0])
def test_pushes_happen_with_their_probability(probability: float):
    pusher = make_pusher(PushConfig(enabled=True, probability=probability), 2000, seed=3)
    is_pushed = forces(pusher, 10, first=200).any(axis=2)
    assert is_pushed[0].mean() == pytest.approx(probability, abs=0.03)
    assert np.all(is_pushed == is_pushed[0])  # one draw per push, not per step


@pytest.mark.parametrize(("seed", "same"), [(5, True), (6, False)])
def test_pushes_depend_on_the_seed_and_not_on_the_batch(seed, same):
    few = forces(make_pusher(PushConfig(enabled=True), 2, seed=5), 450)
    many = forces(make_pusher(PushConfig(enabled=True), 9, seed=seed), 450)
    assert np.array_equal(few, many[:, :2]) == same


def test_a_reset_restarts_the_timing_and_ends_a_push():
    pusher = make_pusher(PushConfig(enabled=True), 2, seed=1)
    forces(pusher, 203)
    assert pusher.force.any(axis=1).all()
    pusher.restart(np.array([1]))
    assert pusher.force.any(axis=1).tolist() == [True, False]
    # Robot 1 is at the start of its episode: its next push comes 200 steps later.
    time = np.array([203 * STEP, 0.0])
    for k in range(200):
        pusher.update(time + k * STEP)
        assert not pusher.force[1].any()
    pusher.update(time + 200 * STEP)
    assert pusher.force[1].any()


@pytest.mark.parametrize("step", [0.003, 0.0045, 0.02])
def test_any_control_step_gets_every_push(step):
    pusher = make_pusher(PushConfig(enabled=True), 1, seed=1)
    started = 0
    for k in range(round(6.1 / step)):
        before = pusher.force.any()
        pusher.update(np.array([k * step]))
        started += bool(pusher.force.any() and not before)
    assert started == 5


@pytest.mark.parametrize(
    ("values", "piece"),
    [
        ({"duration": 0.0}, "pushes.duration is 0 s"),
        ({"duration": 1.2}, "below pushes.period 1.2 s"),
        ({"force": (220.0, 130.0)}, "pushes.force is [220.0, 130.0]; the lower bound must come first"),
        ({"probability": 1.5}, "pushes.probability is 1.5; it must be 1 or less"),
        ({"force": (-1.0, 130.0)}, "pushes.force[0] is -1; it must be 0 or more"),
        ({"ramp": -1}, "pushes.ramp is -1; it must be 0 or more"),
        ({"period": float("nan")}, "pushes.period is nan; it must be a finite number"),
    ],
)
def test_pushes_out_of_bounds_are_rejected(values, piece):
    with pytest.raises(SurefootError) as caught:
        PushConfig(**values)
    assert piece in str(caught.value)
