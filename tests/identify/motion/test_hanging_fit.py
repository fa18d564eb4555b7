"""Fits to logs of a hanging Go2: known and unknown gains, and parameters that a log does not determine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit
from surefoot.identify.motion import start_search
from surefoot.identify.motion.ambiguities import describe_ambiguities
from surefoot.identify.motion.expected_accuracy import predict_accuracy
from surefoot.identify.motion.priors import default_names, gains_are_commanded, robot_priors
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import replay_motion
from surefoot.identify.motion.robot_estimates import robot_estimates
from surefoot.identify.motion.robot_fit import fit_robot
from surefoot.identify.motion.robot_unknowns import CLOCK, considered_unknowns, robot_params, robot_unknowns
from surefoot.identify.replay import Replayer, segment_from_motion
from surefoot.identify.result import Identification, ignore_progress
from surefoot.identify.robot_params_file import check_new_logs, merge_estimates, read_gains
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import ParamsFile

KP, KD = 20.0, 1.5
LOW = np.array([-0.1, 1.2, -2.4, 0.1, 1.2, -2.4] * 2)
HIGH = np.array([-0.5, 0.6, -1.4, 0.5, 0.6, -1.4] * 2)


@pytest.fixture(scope="module")
def go2() -> RobotDescription:
    return RobotDescription.load("go2")


@pytest.fixture(scope="module")
def nominal(go2: RobotDescription) -> PhysicalParams:
    return PhysicalParams.nominal(go2)


@pytest.fixture(scope="module")
def truth(go2: RobotDescription, nominal: PhysicalParams) -> PhysicalParams:
    return nominal.with_values(go2, servo_kp=KP, servo_kd=KD, control_latency=0.004)


@pytest.fixture(scope="module")
def hanging(go2: RobotDescription, truth: PhysicalParams) -> RecordedMotion:
    """Four seconds of a Go2 that starts at rest, with its joints pulled down by gravity, and follows triangle waves."""
    draw = np.random.default_rng(1)
    time = 0.01 * np.arange(401) + draw.uniform(0, 4e-4, 401)
    phase = np.maximum(time - 0.3, 0) * (0.4 + 0.2 * np.maximum(time - 0.3, 0))
    command = LOW + (1 - np.abs(2 * (phase[:, None] % 1.0) - 1)) * (HIGH - LOW)
    rest = RecordedMotion("rest", 0.01 * np.arange(301.0), np.tile(LOW, (301, 1)), 0.01 * np.arange(301.0), rack=True)
    replayer = Replayer(go2, 1, torques=False)
    sagged = replayer.run(segment_from_motion(replace(rest, motor_angle=np.tile(LOW, (301, 1))), go2), truth)
    blank = RecordedMotion("hanging.npz", time, command, time, rack=True)
    begin = replace(blank, motor_angle=np.tile(sagged.motor_angle[0, -1], (401, 1)))
    readings = replayer.run(segment_from_motion(begin, go2), truth)
    return replace(blank, motor_angle=readings.motor_angle[0] + draw.normal(0, 1e-4, (401, 12)))


@pytest.fixture(scope="module")
def unknown_gains(go2: RobotDescription, nominal: PhysicalParams, hanging: RecordedMotion) -> Identification:
    return fit_robot(go2, [hanging], [], None, nominal)


def test_a_replay_on_a_rack_begins_at_the_first_reading(
    go2: RobotDescription, truth: PhysicalParams, hanging: RecordedMotion
):
    # Before the log begins, gravity pulls the joints some hundredths of a radian away from their commands.
    assert np.abs(hanging.motor_angle[0] - LOW).max() > 0.03
    errors = replay_motion(hanging, go2, truth, Replayer(go2, 1, torques=False)).motor_angle
    assert np.abs(errors[:20]).max() < 0.002
    assert np.abs(errors).max() < 0.004
    # A log that starts while joints move starts with their speed.
    cut = hanging.crop(1.0, 4.0)
    first = replay_motion(cut, go2, truth, Replayer(go2, 1, torques=False)).motor_angle[:20]
    assert np.abs(first).max() < 0.01


def test_intervals_of_unknown_gains_contain_the_true_gains(unknown_gains: Identification):
    for name, value in {"servo_kp": KP, "servo_kd": KD}.items():
        item = unknown_gains.estimate(name)
        assert item.interval[0] < value < item.interval[1], name
        assert item.interval[1] - item.interval[0] < 1.2 * value, name
        assert not item.of_robot
    assert any(
        "these logs do not separate servo_kd and motor_viscous_friction: their sum is 1." in note
        for note in unknown_gains.notes
    )


def test_undetermined_parameters_keep_their_values_and_are_not_written(
    go2: RobotDescription, nominal: PhysicalParams, unknown_gains: Identification
):
    file = merge_estimates(ParamsFile(nominal, ()), unknown_gains, go2)
    # A hanging robot shows neither torque limits nor feet, and gains that are sent with commands are not a property of
    # the robot.
    assert {"torque_limit", "contact_stiffness", "contact_shear_ratio", "servo_kp", "servo_kd"}.isdisjoint(file.names)
    assert "contact_stiffness" not in file.tables["intervals"]
    np.testing.assert_array_equal(file.params.torque_limit, nominal.torque_limit)
    np.testing.assert_array_equal(file.params.servo_kp, nominal.servo_kp)
    # Hips, thighs and calves have separate values.
    kinds = file.params.motor_friction[0].reshape(4, 3).mean(axis=0)
    assert kinds[2] > 2 * kinds[0]
    # Replays of logs without stated gains use the fitted gains.
    assert read_gains(file)["servo_kp"] == pytest.approx([KP] * 12, rel=0.2)
    assert file.tables["gains"]["stated"] == []


def test_known_gains_are_kept(go2: RobotDescription, nominal: PhysicalParams, hanging: RecordedMotion):
    prior = nominal.with_values(go2, servo_kp=KP, servo_kd=KD)
    short = hanging.first_seconds(2.0)
    result = fit_robot(go2, [short], [hanging], None, prior, known=("servo_kp", "servo_kd"))
    assert {"servo_kp", "servo_kd"}.isdisjoint(item.name for item in result.estimates)
    assert result.gains == {"servo_kp": [KP] * 12, "servo_kd": [KD] * 12}
    assert result.stated_gains == ("servo_kp", "servo_kd")
    fitted, held_out = result.checks
    assert (fitted.what, fitted.fitted) == ("hanging.npz, fitted: 2.0 of 2.0 s", True)
    assert (held_out.what, held_out.fitted) == ("hanging.npz, held out", False)
    assert result.checks_title == "RMS error of replayed logs, fitted and held out"
    assert held_out.after < 0.004
    assert not result.failure


def test_the_same_log_is_not_fitted_twice(
    go2: RobotDescription, nominal: PhysicalParams, unknown_gains: Identification, tmp_path
):
    file = merge_estimates(ParamsFile(nominal, ()), unknown_gains, go2)
    assert list(file.tables["identified"]["logs"]["logs"].values()) == ["hanging.npz"]
    with pytest.raises(SurefootError, match=r"b.toml was already fitted to again.npz; logs that count twice"):
        check_new_logs(tmp_path / "b.toml", file, {"again.npz": unknown_gains.log_digests["hanging.npz"]})
    check_new_logs(tmp_path / "b.toml", file, {"other.npz": "1" * 64})
    # Fitting another log does not remove the first one from the file.
    again = merge_estimates(file, replace(unknown_gains, log_digests={"other.npz": "1" * 64}), go2)
    assert list(again.tables["identified"]["logs"]["logs"].values()) == ["hanging.npz", "other.npz"]
    # Older files have one digest of all logs.
    old = replace(file, tables={"identified": {"logs": {"data": unknown_gains.digest}}})
    with pytest.raises(SurefootError, match=r"was already fitted to hanging.npz"):
        check_new_logs(tmp_path / "b.toml", old, dict(unknown_gains.log_digests), unknown_gains.digest)


def test_a_fit_without_the_rack_option_fails_with_a_hint(
    go2: RobotDescription, nominal: PhysicalParams, hanging: RecordedMotion
):
    standing = replace(hanging.first_seconds(1.5), rack=False)
    names = ("servo_kp", "servo_kd", "motor_friction")
    result = fit_robot(go2, [standing], [], names, nominal)
    reason, *hints = result.failure
    assert "the fitted robot does not reproduce these logs: its error is 0." in reason
    assert "did the robot hang? add --rack hanging" in hints


def test_priors_belong_to_robots(go2: RobotDescription, pupper: RobotDescription):
    assert gains_are_commanded(go2)
    assert not gains_are_commanded(pupper)
    # The gains of a Pupper are fixed on its board; the gains of a Go2 are unknown.
    assert (robot_priors(pupper)["servo_kp"].deviation, robot_priors(go2)["servo_kp"].deviation) == (0.1, 1.0)
    assert "damping_ratio" in default_names(pupper, False)
    assert "servo_kd" not in default_names(pupper, False)
    assert {"servo_kd", "viscous_ratio", "inertia_ratio"} <= set(default_names(go2, True))
    assert not {"contact_friction", "base_offset", "damping_ratio"} & set(default_names(go2, True))
    wrong = replace(go2, priors={"servo_kpp": 1.0})
    with pytest.raises(SurefootError, match=r"priors.servo_kpp of go2 is unknown; did you mean servo_kp"):
        robot_priors(wrong)


def test_kinds_of_joints_share_a_value_and_motors_have_ratios(go2: RobotDescription, nominal: PhysicalParams):
    unknowns = robot_unknowns(go2, nominal, ["motor_friction", "friction_ratio", "servo_kp"], rack=True)
    assert [u.label for u in unknowns[:3]] == [f"motor_friction of {kind} joints" for kind in ("hip", "thigh", "calf")]
    assert unknowns[5].label == "friction_ratio of FR_calf_joint"
    values = np.array([u.start for u in unknowns])
    values[2], values[5], values[-1] = 0.8, 1.5, 35.0
    params = robot_params(nominal, unknowns, values[None])
    np.testing.assert_allclose(params.motor_friction[0].reshape(4, 3), [[0.22, 0.20, 1.2], *[[0.22, 0.20, 0.8]] * 3])
    np.testing.assert_allclose(params.servo_kp, 35.0)
    # Legs on a rack do not affect each other, so one candidate perturbs a joint of every leg.
    assert len({u.colour for u in unknowns if u.colour is not None}) == 3


def test_computed_times_widen_the_intervals(go2: RobotDescription, nominal: PhysicalParams, hanging: RecordedMotion):
    even = replace(hanging, time=0.01 * np.arange(401))
    assert not hanging.computed_clock
    assert even.computed_clock
    names = [[u.name for u in considered_unknowns(go2, nominal, [motion], [])] for motion in (hanging, even)]
    assert CLOCK not in names[0]
    assert CLOCK in names[1]


def test_a_parameter_that_is_fitted_is_not_considered_as_well(
    go2: RobotDescription, nominal: PhysicalParams, hanging: RecordedMotion
):
    unknowns = robot_unknowns(go2, nominal, ["presliding"], rack=True)
    considered = considered_unknowns(go2, nominal, [hanging], unknowns)
    assert [unknown.name for unknown in considered] == ["servo_latency"]
    values, covariance = np.array([0.05, 0.002]), np.diag([1e-6, 1e-6])
    fit = Fit((*unknowns, *considered), values, covariance, np.zeros(1), np.zeros((1, 2)), np.array([False, True]), 1)
    params = robot_params(nominal, fit.unknowns, values[None])
    np.testing.assert_array_equal(params.presliding, 0.05)
    (estimate,) = robot_estimates(go2, nominal, params, fit)
    assert (estimate.name, estimate.value, estimate.identifiable) == ("presliding", 0.05, True)


def test_the_search_for_gains_scales_the_gains_of_all_kinds_of_joints(
    go2: RobotDescription, hanging: RecordedMotion, monkeypatch: pytest.MonkeyPatch
):
    prior = PhysicalParams.nominal(go2).with_values(go2, servo_kp=[20.0, 20.0, 30.0] * 4)
    unknowns = robot_unknowns(go2, prior, ["servo_kp", "servo_kd"], rack=True)
    prior.servo_kd[:] = 1.0
    assert [(one.name, len(one.motors)) for one in unknowns] == [("servo_kp", 4)] * 3 + [("servo_kd", 0)]

    class Model:
        def residuals(self, candidates: np.ndarray) -> np.ndarray:
            return candidates - [40.0, 40.0, 60.0, 40.0 * 0.02]

    monkeypatch.setattr(start_search, "robot_model", lambda *_: Model())
    start = start_search.find_gains(go2, [hanging], unknowns, prior, ignore_progress)
    # Of the grid's damping times 13.2 ms gives 0.62 N m s/rad, nearer to 0.8 than 21.4 ms, which gives 1.0.
    assert start == pytest.approx([40, 40, 60, 0.005 * 2**1.4 * (40 + 40 + 60) / 3])


def test_the_predicted_accuracy_is_the_accuracy_of_a_fit(
    go2: RobotDescription, truth: PhysicalParams, hanging: RecordedMotion
):
    short = hanging.first_seconds(2.0)
    unknown, known = (predict_accuracy(go2, [short], truth, names) for names in ((), ("servo_kp", "servo_kd")))
    kd = next(item for item in unknown.estimates if item.name == "servo_kd")
    assert kd.interval[0] < KD < kd.interval[1]
    assert any("do not separate servo_kd and motor_viscous_friction" in text for text in unknown.sentences)
    assert not any("servo_kd" in text for text in known.sentences)


def test_a_known_gain_replaces_the_damping_ratio_of_the_data_sheet(pupper: RobotDescription):
    time = 0.01 * np.arange(51)
    command = np.tile([0.0, 0.6, -1.2] * 4, (len(time), 1))
    command[:, 1] += 0.3 * np.sin(9 * time)
    motion = RecordedMotion("plan", time, command, time, rack=True)
    unknown, known = (
        predict_accuracy(pupper, [motion], PhysicalParams.nominal(pupper), names) for names in ((), ("servo_kd",))
    )
    assert {"servo_kp", "servo_kd"} <= {item.name for item in unknown.estimates}
    names = {item.name for item in known.estimates}
    assert "servo_kp" in names
    assert "servo_kd" not in names


def test_inseparable_parameters_are_named_with_their_sum(go2: RobotDescription, nominal: PhysicalParams):
    unknowns = tuple(robot_unknowns(go2, nominal, ["servo_kd", "motor_viscous_friction"], rack=True))
    values = np.array([1.5, 0.2, 0.2, 0.2])
    # The errors of kd and viscous friction are opposite; their sum has a standard deviation of 0.01.
    direction = np.array([-1.0, 1.0, 1.0, 1.0])
    covariance = 0.09 * np.outer(direction, direction) + np.diag([1e-4, 0, 0, 0])
    fit = Fit(unknowns, values, covariance, np.zeros(1), np.zeros((1, 4)))
    params = robot_params(nominal, unknowns, values[None])
    (text,) = describe_ambiguities(fit, nominal, params)
    assert text.startswith(
        "these logs do not separate servo_kd and motor_viscous_friction: their sum is 1.7 (1.68 to 1.72) N m s/rad"
    )
    # Other pairs are named if their errors are correlated.
    unknowns = tuple(robot_unknowns(go2, nominal, ["rotor_inertia", "control_latency"], rack=True))
    values, covariance = np.array([u.start for u in unknowns]), np.diag([1e-4] * 4)
    apart = Fit(unknowns, values, covariance, np.zeros(1), np.zeros((1, 4)))
    params = robot_params(nominal, unknowns, values[None])
    assert describe_ambiguities(apart, nominal, params) == ()
    exchanged = covariance - 0.99e-4 * np.outer([1, 1, 1, 0], [0, 0, 0, 1]) * np.sqrt(1 / 3)
    exchanged[3] = exchanged[:, 3]
    (text,) = describe_ambiguities(replace(apart, covariance=exchanged), nominal, params)
    assert text.startswith(
        "rotor_inertia and control_latency are hardly distinguishable from these logs (correlation -0.99)"
    )
