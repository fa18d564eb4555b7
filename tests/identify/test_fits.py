"""Fits of short experiments on emulated robots with hidden parameters."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from short_experiments import short_plan

from surefoot.errors import SurefootError
from surefoot.identify.rack.model import fit_on_rack, moving_legs, pwm_readings, rack_estimates, rack_unknowns
from surefoot.identify.recording import Recording
from surefoot.identify.registry import EXPERIMENTS
from surefoot.identify.replay import segment_from_recording
from surefoot.identify.result import Identification, ignore_progress
from surefoot.robot import PhysicalParams, RobotDescription

pytestmark = pytest.mark.slow
RACK = {
    "motor_strength": 0.9,
    "motor_friction": 0.02,
    "motor_viscous_friction": 0.002,
    "torque_constant": 0.09,
    "resistance": 0.2,
    "servo_latency": 0.004,
    "control_latency": 0.0173,
    "leg_mass_ratio": 1.1,
    "leg_inertia_ratio": 1.2,
}
GROUND = {
    "base_mass_ratio": 1.15,
    "base_inertia_ratio": 1.3,
    "contact_friction": 1.2,
    "contact_stiffness": 2000.0,
    "motor_strength": 0.8,
}
"""A heavy robot with weak motors on a floor with high friction, so that its feet are hard to drag."""
Record = Callable[..., list[Recording]]


@pytest.fixture(scope="module")
def rack(robot: RobotDescription, record: Record) -> tuple[Recording, Recording]:
    """Parts of the motor and of the latency experiment."""
    one, other = record(RACK, *(short_plan(EXPERIMENTS[name], robot) for name in ("motor", "latency")))
    return one, other


@pytest.fixture(scope="module")
def grounded(robot: RobotDescription, record: Record) -> Recording:
    """Most of both experiments on the ground."""
    mass, contact = (short_plan(EXPERIMENTS[name], robot) for name in ("mass", "contact"))
    rest = (phase for phase in mass.phases if phase.use != "transition")
    return record(GROUND, replace(mass, phases=(*contact.phases, *rest)))[0]


@pytest.fixture(scope="module")
def motors(robot: RobotDescription, rack: tuple[Recording, Recording], nominal: PhysicalParams) -> Identification:
    return EXPERIMENTS["motor"].fit(robot, rack[0], nominal)


def test_motor_experiment_identifies_the_true_parameters(motors: Identification, rack: tuple[Recording, Recording]):
    within = {
        "torque_constant": 2e-3, "resistance": 2e-3, "leg_mass_ratio": 5e-3, "leg_inertia_ratio": 5e-3,
        "motor_strength": 1e-3, "servo_latency": 0.01, "control_latency": 1e-3, "motor_friction": 0.02,
        "motor_viscous_friction": 0.05,
    }  # fmt: skip
    for name, tolerance in within.items():
        result = [item for item in motors.estimates if item.name == name]
        assert len(result) == (8 if name.startswith("motor") else 1)
        for item in result:
            assert item.value == pytest.approx(RACK[name], rel=tolerance), item.label
            assert item.interval[0] < RACK[name] < item.interval[1], item.label
            assert item.identifiable
    assert motors.estimate("servo_kp").value == pytest.approx(1.0, rel=2e-3)
    assert motors.estimate("servo_kd").value == pytest.approx(0.015, rel=2e-3)
    assert motors.estimate("voltage").value == pytest.approx(16.0, abs=1e-3)
    assert (motors.experiment, motors.robot, motors.digest) == ("motor", "minitaur", rack[0].digest)


def test_motor_experiment_identifies_a_limit_of_the_current(
    robot: RobotDescription, record: Record, nominal: PhysicalParams, motors: Identification
):
    true = {**RACK, "voltage_clip": 4.0}
    (recording,) = record(true, short_plan(EXPERIMENTS["motor"], robot))
    limited = EXPERIMENTS["motor"].fit(robot, recording, nominal)
    for name in ("voltage_clip", "resistance", "torque_constant"):
        estimate = limited.estimate(name)
        assert estimate.value == pytest.approx(true[name], rel=5e-3), name
        assert estimate.identifiable
        assert estimate.interval[0] < true[name] < estimate.interval[1]
    for item in (item for item in limited.estimates if item.name == "motor_strength"):
        assert item.value == pytest.approx(true["motor_strength"], rel=5e-3)
    assert any("above a net voltage of 4.0 V" in note for note in limited.notes)
    # With a lead of the readings the same speeds belong to the same torques.
    led = replace(recording, meta={**recording.meta, "lead": 0.005})
    segment, late = segment_from_recording(recording, 1, 2), segment_from_recording(led, 1, 2)
    indices, latency = np.arange(robot.num_motors), float(nominal.control_latency[0])
    speed = pwm_readings(robot, recording, segment, indices, latency)[2]
    np.testing.assert_allclose(pwm_readings(robot, led, late, indices, latency + 0.005)[2], speed, atol=1e-9)
    assert not any("description allows" in note for note in limited.notes)
    # For a robot without a limit the recording says up to where there is none.
    assert "voltage_clip" not in [item.name for item in motors.estimates]
    assert any(re.search(r"no net voltage above \d\.\d V was recorded.* 16\.0 V at full duty", n) for n in motors.notes)


def test_a_note_names_estimates_at_the_highest_value_that_the_robot_allows(
    robot: RobotDescription, rack: tuple[Recording, Recording], nominal: PhysicalParams
):
    weaker = replace(robot, allowed={**robot.allowed, "motor_strength": (0.0, 0.85)})  # the motors have 0.9
    bounded = EXPERIMENTS["motor"].fit(weaker, rack[0], nominal.with_values(weaker, motor_strength=0.8))
    assert any(note.startswith("motor_strength at the highest value") for note in bounded.notes)


def test_estimates_reduce_errors_on_held_out_phases(motors: Identification):
    assert [check.what for check in motors.checks] == ["motor angles", "motor speeds", "motor torques"]
    for check in motors.checks:
        assert check.after < 0.05 * check.before
    # The torque curve of the robot is the curve of the data sheet.
    curve = motors.series[-1]
    assert curve.points
    assert len(curve.x) > 5
    np.testing.assert_allclose(curve.measured, curve.after, atol=0.05)


def test_motor_experiment_reports_torque_gains(motors: Identification):
    np.testing.assert_allclose(motors.sensors["torque_gain"], 0.0, atol=2e-3)
    assert motors.sensors["torque_accuracy"] == pytest.approx(0.01 / 8**0.5)


def test_a_leg_with_a_motor_that_never_moves_is_not_identifiable(
    robot: RobotDescription, rack: tuple[Recording, Recording], nominal: PhysicalParams
):
    angle, velocity = rack[0].motor_angle.copy(), rack[0].motor_velocity.copy()
    angle[:, 3], velocity[:, 3] = 1.7, 0.0
    recording = replace(rack[0], motor_angle=angle, motor_velocity=velocity)
    assert recording.still_motors == {3}
    prior = nominal.with_values(robot, **RACK)
    assert not [u for u in rack_unknowns(robot, prior, 0.0173, moving_legs(robot, recording)) if u.index in (2, 3)]
    # Motors 2 and 3 belong to the back left leg.
    fit = fit_on_rack(robot, recording, segment_from_recording(recording, 1, 2), prior, ignore_progress)
    assert fit.misfit < 1.2
    estimates = rack_estimates(robot, fit, prior)
    unidentifiable = [item for item in estimates if not item.identifiable and item.index is not None]
    names = ("motor_strength", "motor_friction", "motor_viscous_friction")
    assert [(item.name, item.index) for item in unidentifiable] == [(name, motor) for motor in (2, 3) for name in names]
    # Prior values are kept, and estimates of the other motors do not change.
    assert [item.value for item in unidentifiable] == [0.9, 0.02, 0.002] * 2
    # Only servo motion was recorded, which does not change if all these parameters are scaled together.
    value = {item.name: item.value for item in estimates if item.index is None}
    scaled = ["torque_constant", "resistance", "servo_kp", "servo_kd"]
    assert [item.name for item in estimates if not item.identifiable and item.index is None] == scaled
    for name, true in zip(scaled, (0.09, 0.2, 1.0, 0.015), strict=True):
        assert value[name] / value["resistance"] == pytest.approx(true / 0.2, rel=0.02)
    assert any({"resistance", "servo_kp"} <= set(pair) for pair in fit.fit.strongest_correlations())
    assert len(estimates) == 8 + 3 * 8
    for motor in (0, 1, 4, 5, 6, 7):
        (strength,) = [item for item in estimates if (item.name, item.index) == ("motor_strength", motor)]
        assert strength.identifiable
        assert strength.value == pytest.approx(0.9, rel=0.01)


def test_latency_experiment_identifies_latencies_by_spikes_and_by_replay(
    robot: RobotDescription, rack: tuple[Recording, Recording], motors: Identification, nominal: PhysicalParams
):
    message: list[str] = []
    prior = motors.params(robot, nominal)
    result = EXPERIMENTS["latency"].fit(robot, rack[1], prior, motors.sensors, lambda text, cost: message.append(text))
    assert result.estimate("control_latency").value == pytest.approx(RACK["control_latency"], abs=5e-5)
    assert result.estimate("servo_latency").value == pytest.approx(RACK["servo_latency"], abs=5e-5)
    # In its first step, the engine moves a motor as far as it should move in 1.4 steps.
    for name in ("spike_at_robot", "spike_at_host"):
        assert result.estimate(name).value == pytest.approx(RACK["control_latency"], abs=1e-3)
    assert set(result.identified_names()) == {"control_latency", "servo_latency", "voltage"}
    assert message[0].startswith("starting from a control latency of")
    assert any("responses are clear" in note for note in result.notes)


def test_latency_experiment_rejects_a_recording_without_responses(
    robot: RobotDescription, rack: tuple[Recording, Recording], nominal: PhysicalParams
):
    weak = replace(rack[1], meta={**rack[1].meta, "phases": [dict(phase) for phase in rack[1].meta["phases"]]})
    for phase in weak.meta["phases"]:
        phase["name"] = phase["name"].replace("spikes", "silence")
    with pytest.raises(SurefootError, match="only 0 of 0 responses to spikes are clear; at least 8"):
        EXPERIMENTS["latency"].fit(robot, weak, nominal)


def test_mass_experiment_identifies_mass_inertia_and_centre(
    robot: RobotDescription, grounded: Recording, nominal: PhysicalParams
):
    result = EXPERIMENTS["mass"].fit(robot, grounded, nominal.with_values(robot, motor_strength=0.8))
    assert result.estimate("base_mass_ratio").value == pytest.approx(1.15, rel=0.02)
    base = sum(robot.urdf.links[name].mass for name in robot.urdf.fixed_to(robot.base))
    total = robot.urdf.total_mass + 0.15 * base
    weight = result.estimate("total_mass")
    assert weight.value == pytest.approx(total, rel=0.01)
    assert weight.interval[0] < total < weight.interval[1]
    inertia = result.estimate("base_inertia_ratio")
    assert inertia.identifiable
    assert inertia.value == pytest.approx(1.3, rel=0.05)
    # The body has 3.353 of the base's 5.993 kg, with its centre 50 mm in front of the base's origin; front and back
    # legs are equal.
    assert result.estimate("centre_of_mass_x").value == pytest.approx(0.05 * 3.353 * 1.15 / total, abs=2e-3)
    assert result.estimate("centre_of_mass_y").value == pytest.approx(0.0, abs=2e-3)
    assert [check.what for check in result.checks] == ["weight on the feet", "moment about y"]
    assert all(check.after < check.before for check in result.checks)
    assert any("the motors were not identified before" in note for note in result.notes)
    assert set(result.identified_names()) == {"base_mass_ratio", "base_inertia_ratio"}


def weighed(robot: RobotDescription, nominal: PhysicalParams) -> PhysicalParams:
    """Return the parameters after the motor and mass experiments, as the contact experiment needs them."""
    return nominal.with_values(robot, **{name: GROUND[name] for name in GROUND if not name.startswith("contact")})


def test_contact_experiment_identifies_friction_and_stiffness(
    robot: RobotDescription, grounded: Recording, nominal: PhysicalParams
):
    result = EXPERIMENTS["contact"].fit(robot, grounded, weighed(robot, nominal))
    friction, stiffness = result.estimate("contact_friction"), result.estimate("contact_stiffness")
    assert friction.value == pytest.approx(1.2, rel=0.05)
    assert stiffness.value == pytest.approx(2000.0, rel=0.08)
    assert result.estimate("contact_damping").value == pytest.approx(100.0, rel=0.3)
    for item, true in ((friction, 1.2), (stiffness, 2000.0)):
        assert item.identifiable
        assert item.interval[0] < true < item.interval[1]
    assert set(result.identified_names()) == {"contact_friction", "contact_stiffness"}


def test_friction_of_feet_that_do_not_slide_is_not_identifiable(
    robot: RobotDescription, grounded: Recording, nominal: PhysicalParams, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("surefoot.identify.ground.fits.SLIDING_SPEED", 10.0)
    result = EXPERIMENTS["contact"].fit(robot, grounded, weighed(robot, nominal))
    friction = result.estimate("contact_friction")
    assert not friction.identifiable
    assert friction.value == nominal.contact_friction[0]
    assert friction.interval == (0.05, 3.0)
    assert "the dragged feet did not slide: friction is not identifiable" in result.notes
    assert set(result.identified_names()) == {"contact_stiffness"}


@pytest.mark.parametrize("name", ["mass", "contact"])
@pytest.mark.parametrize(
    ("array", "change", "message"),
    [
        (
            "roll_pitch_yaw",
            lambda x: x + np.array([1.4, 0, 0]),
            r"tilts by 1\.\d\d rad; at most 0\.3 while it stands",
        ),
        # The belly rests on something, so the motors carry nothing.
        ("motor_torque", lambda x: 0.02 * x, "feet carry"),
    ],
)
def test_ground_experiments_reject_a_robot_that_does_not_stand(
    name: str,
    array: str,
    change: Callable[[np.ndarray], np.ndarray],
    message: str,
    robot: RobotDescription,
    grounded: Recording,
    nominal: PhysicalParams,
):
    lying = replace(grounded, **{array: change(getattr(grounded, array))})
    with pytest.raises(SurefootError, match=message):
        EXPERIMENTS[name].fit(robot, lying, nominal)
