"""Residuals of a replayed robot on its rack."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit
from surefoot.identify.model import TORQUE_GAIN, ReplayModel, Unknown, candidate_params
from surefoot.identify.rack.model import NOISE, RackFit, moving_legs, rack_estimates, rack_observations, rank_latencies
from surefoot.identify.recording import Recording
from surefoot.identify.replay import Replayer, Segment, segment_from_recording
from surefoot.robot import PhysicalParams, RobotDescription

UNKNOWNS = [
    Unknown("resistance", 0.186, 0.02, 5.0, 1e-6),
    Unknown("motor_strength", 1.0, 0.0, 2.0, 1e-6, 0, colour=0, affects=("leg", 0)),
    Unknown("motor_friction", 0.0, 0.0, 0.5, 1e-6, 7, colour=0, affects=("leg", 3)),
    Unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, 1e-4, 2, 0.01, colour=1, affects=("leg", 1)),
]
START = np.array([[u.start for u in UNKNOWNS]])


@pytest.fixture(scope="module")
def replayer(robot: RobotDescription) -> Replayer:
    return Replayer(robot, 2)


@pytest.fixture(scope="module")
def segment(recorded: Recording) -> Segment:
    """Sweep, steps, transition back and duties, without the start, when the robot still moved."""
    whole = segment_from_recording(recorded, 1, 4)
    settled = whole.state_time > 0.4
    return replace(whole, state_time=whole.state_time[settled], states=whole.states[settled])


@pytest.fixture(scope="module")
def model(
    robot: RobotDescription, recorded: Recording, nominal: PhysicalParams, replayer: Replayer, segment: Segment
) -> ReplayModel:
    """Residual model of the recording of a nominal robot with noisy sensors."""
    return ReplayModel(UNKNOWNS, nominal, [rack_observations(robot, recorded, segment, replayer)], replayer.num_envs)


def test_each_candidate_has_one_row_of_parameters(nominal: PhysicalParams):
    values = np.array([[0.2, 0.8, 0.01, 0.3], [0.3, 0.9, 0.02, 0.3]])
    params = candidate_params(nominal, UNKNOWNS, values)
    np.testing.assert_array_equal(params.resistance, [0.2, 0.3])
    np.testing.assert_array_equal(params.motor_strength[:, 0], [0.8, 0.9])
    np.testing.assert_array_equal(params.motor_strength[:, 1:], 1.0)
    np.testing.assert_array_equal(params.motor_friction[:, 7], [0.01, 0.02])
    np.testing.assert_array_equal(params.motor_friction[:, :7], 0.0)
    # One for all motors.
    every = candidate_params(nominal, [Unknown("motor_friction", 0.0, 0.0, 0.5, 1e-6)], np.array([[0.04]]))
    np.testing.assert_array_equal(every.motor_friction, np.full((1, 8), 0.04))
    np.testing.assert_array_equal(nominal.motor_friction, 0.0)


@pytest.mark.parametrize(("errors", "unmodelled"), [(1.0, 0.0), (2.0, 0.5), (3.0, 1.0), (8.0, 1.0)])
def test_intervals_are_wider_for_robots_that_do_not_repeat_their_models_motion(
    robot: RobotDescription, nominal: PhysicalParams, errors: float, unmodelled: float
):
    """A fit without uncertainty: what is left are the accuracy of the simulator, and what the model lacks."""
    names = {"resistance": 0.2, "servo_kd": 0.02, "motor_friction": 0.05, "motor_viscous_friction": 0.001}
    unknowns = tuple(
        Unknown(name, value, 0.0, 1.0, 1e-6, 0 if name.startswith("motor") else None) for name, value in names.items()
    )
    fit = RackFit(
        Fit(unknowns, np.array([*names.values()]), np.zeros((4, 4)), np.zeros(9), np.eye(9, 4)), errors * NOISE
    )
    assert fit.misfit == pytest.approx(errors)
    deviations = {one.name: one.deviation for one in rack_estimates(robot, fit, nominal) if one.identifiable}
    more = unmodelled
    assert deviations == pytest.approx(
        {
            "resistance": 0.005 * 0.2,
            "servo_kd": np.hypot(0.005, more * 0.03) * 0.02,
            "motor_friction": np.sqrt((0.005 * 0.05) ** 2 + 2e-4**2 + (more * 0.06 * 0.05) ** 2),
            "motor_viscous_friction": np.sqrt((0.005 * 1e-3) ** 2 + 1e-4**2 + more**2 * (4e-4**2 + 4e-4**2)),
        }
    )


def test_residuals_of_the_true_robot_are_noise(model: ReplayModel):
    angle, velocity, torque = np.sqrt(np.mean(model.residuals(START).reshape(3, -1) ** 2, axis=1))
    # Angles are quantized in steps of 2 pi / 2^14, a standard deviation of 1.1e-4 rad.
    assert angle == pytest.approx(1.1e-4 / NOISE[0], rel=0.2)
    assert velocity == pytest.approx(1.0, rel=0.15)
    assert torque == pytest.approx(1.0, rel=0.5)
    assert model.blocks.shape == model.residuals(START)[0].shape


def test_a_motor_affects_only_the_residuals_of_its_leg(model: ReplayModel, robot: RobotDescription):
    values = np.tile(START, (4, 1))
    values[1, 1], values[2, 2], values[3, 3] = 0.9, 0.02, 0.1
    still, *moved = model.residuals(values)
    for k, residuals in zip((1, 2, 3), moved, strict=True):
        # The engine solves for all loops together, so other legs change by rounding errors, 1e-5 of the noise.
        affected, changed = model.affected(k), np.abs(residuals - still) > 1e-5
        np.testing.assert_array_equal(changed & ~affected, False)
        by_motor = changed.reshape(3, -1, 8).any(axis=1)
        pair = next(p for p in robot.leg_motor_index.tolist() if UNKNOWNS[k].index in p)
        if UNKNOWNS[k].name == TORQUE_GAIN:
            # Only the report changes, not the motion of the robot.
            assert np.argwhere(by_motor).tolist() == [[2, 2]]
        else:
            assert by_motor[:, pair].all()
            assert affected.reshape(3, -1, 8)[0, 0].nonzero()[0].tolist() == sorted(pair)
    assert model.affected(0) is None


def test_a_leg_whose_motor_never_moves_is_left_out(
    model: ReplayModel, robot: RobotDescription, replayer: Replayer, recorded: Recording, segment: Segment
):
    def stuck(*motors: int) -> Recording:
        angle = recorded.motor_angle.copy()
        angle[:, motors] = 1.7
        return replace(recorded, motor_angle=angle)

    # Motors 2 and 3 belong to the back left leg.
    assert moving_legs(robot, recorded).tolist() == list(range(8))
    assert moving_legs(robot, stuck(3)).tolist() == [0, 1, 4, 5, 6, 7]
    less = ReplayModel(UNKNOWNS, model.prior, [rack_observations(robot, stuck(3), segment, replayer)])
    whole = model.residuals(START).reshape(3, -1, 8)
    np.testing.assert_array_equal(less.residuals(START).reshape(3, -1, 6), whole[:, :, [0, 1, 4, 5, 6, 7]])
    np.testing.assert_array_equal(less.blocks.reshape(3, -1, 6)[0, :, 0], model.blocks.reshape(3, -1, 8)[0, :, 0])
    assert not less.affected(3).any()
    assert less.affected(1).reshape(3, -1, 6).any(axis=(0, 1)).tolist() == [True, True, False, False, False, False]
    with pytest.raises(SurefootError, match="every leg has a motor that never moves"):
        moving_legs(robot, stuck(0, 2, 4, 6))


def test_candidates_of_several_batches_are_independent(model: ReplayModel):
    values = np.tile(START, (3, 1))
    values[:, 0] = [0.186, 0.2, 0.25]
    together = model.residuals(values)
    for row in range(3):
        np.testing.assert_array_equal(model.residuals(values[row : row + 1])[0], together[row])


def test_the_true_latency_is_ranked_first(
    robot: RobotDescription, recorded: Recording, segment: Segment, nominal: PhysicalParams
):
    assert rank_latencies(robot, recorded, segment, nominal, 3)[0] == pytest.approx(0.020)
