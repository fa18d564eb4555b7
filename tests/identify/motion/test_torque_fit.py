"""Motor and delay parameters from recorded runs of robots with known parameters, and rejection of unsuitable traces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.fitting import forward_jacobian
from surefoot.identify.model import ReplayModel, Unknown
from surefoot.identify.motion import torque_fit
from surefoot.identify.motion.torque_model import DEFAULT_NAMES, NAMES, VOLTAGE_CHANGE, torque_observations
from surefoot.identify.motion.torque_rows import MotorMotion, TorqueRows, torque_timings, usable_rows
from surefoot.identify.motion.traces import deployed_motion, motion_from_trace
from surefoot.identify.motion.walking_mass import walking_mass
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.trace import EpisodeTrace
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

ROBOT = RobotDescription.load("minitaur")
NOMINAL = PhysicalParams.nominal(ROBOT)
STRENGTHS = (1.1, 0.85, 1.0, 0.9, 1.15, 0.95, 1.05, 0.8)
HIDDEN = NOMINAL.with_values(
    ROBOT,
    motor_strength=np.array(STRENGTHS)[None],
    torque_constant=0.101,
    resistance=0.175,
    voltage=15.0,
    servo_latency=0.0041,
    control_latency=0.0124,
    motor_friction=0.02,
)
BATTERY_KNOWN = tuple(name for name in DEFAULT_NAMES if name != "voltage")
AT_15_V = NOMINAL.with_values(ROBOT, voltage=15.0)


def fit_torques(
    robot: RobotDescription, traces: list[EpisodeTrace], names: tuple[str, ...] | None, prior: PhysicalParams
) -> Identification:
    return torque_fit.fit_torques(robot, [deployed_motion("", trace) for trace in traces], names, prior)


def swinging(time: float, legs: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return swing and extension of legs that move smoothly at different rates, fast enough to saturate motors."""
    phase = 2 * np.pi * time * (4.0 + 0.5 * np.arange(legs)) + np.arange(legs)
    return 0.8 * np.sin(phase), 1.8 + 0.6 * np.cos(1.7 * phase)


def trotting(time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return swing and extension of a trot on the ground."""
    turn = 2 * np.pi * 3.0 * time + np.pi * np.array([0, 1, 1, 0])
    return 0.3 * np.sin(turn), 1.6 + 0.25 * np.cos(turn)


def record(
    params: PhysicalParams = HIDDEN,
    seconds: float = 4.0,
    moves: Callable[[float], tuple[np.ndarray, np.ndarray]] = swinging,
    rack: bool = True,
    start: float = 0.0,
    **meta: Any,
) -> EpisodeTrace:
    """Return the trace of a simulated robot that follows motor angles, recorded as in `evaluation.rollout`."""
    world = SimWorld(ROBOT, 1, params, config=WorldConfig(rack=rack, thermal_protection=False))
    step = float(params.control_step[0])
    rows: dict[str, list[np.ndarray]] = {}
    for k in range(round(seconds / step)):
        target = ROBOT.pose_angles(*moves(start + k * step))
        readings, truth = world.step(target[None]), world.truth()
        row = {
            "time": readings.time,
            "roll_pitch_yaw": readings.roll_pitch_yaw,
            "angular_velocity_base": readings.angular_velocity_base,
            "motor_angle": readings.motor_angle,
            "motor_velocity": readings.motor_velocity,
            "motor_torque": truth.motor_torque,
            "target": target[None],
            "energy": truth.energy,
        }
        for name, value in row.items():
            rows.setdefault(name, []).append(value[0].copy())
    count = len(rows["time"])
    unknown = {"base_position_world": (count + 1, 3), "base_quat_world": (count + 1, 4), "foot_contact": (count, 4)}
    return EpisodeTrace(
        **{name: np.array(values) for name, values in rows.items()},
        **{name: np.full(shape, np.nan) for name, shape in unknown.items()},
        observation=np.zeros((count, 1)),
        feedback=np.zeros((count, 8)),
        meta={
            "robot": "minitaur",
            "world": "mujoco",
            "control_step": step,
            "leg_names": list(ROBOT.leg_names),
            "motor_names": list(ROBOT.motor_names),
            "observation_names": ["none"],
            "ended": "time",
            **meta,
        },
    )


def add_noise(trace: EpisodeTrace, seed: int) -> EpisodeTrace:
    """Return a trace with the emulator's noise; seeds with the same hundreds have the same torque gains."""
    rng, gains = np.random.default_rng(seed), np.random.default_rng(seed // 100)
    shape, encoder = trace.motor_angle.shape, 2 * np.pi / 2**14
    return replace(
        trace,
        motor_angle=np.round(trace.motor_angle / encoder) * encoder,
        motor_velocity=trace.motor_velocity + 0.05 * rng.standard_normal(shape),
        motor_torque=trace.motor_torque * (1 + 0.01 * gains.standard_normal(shape[1]))
        + 0.02 * rng.standard_normal(shape),
    )


@lru_cache(maxsize=1)
def clean() -> EpisodeTrace:
    """Return a trace without noise."""
    return record()


def cut(trace: EpisodeTrace, *kept: slice) -> EpisodeTrace:
    """Return some rows of a trace with their original times."""
    rows = np.r_[tuple(slice(*part.indices(trace.num_steps)) for part in kept)]
    arrays = {name: array for name, array in vars(trace).items() if name != "meta"}
    selected = {name: array[rows] for name, array in arrays.items() if len(array) == trace.num_steps}
    return replace(
        trace,
        **selected,
        base_position_world=trace.base_position_world[: len(rows) + 1],
        base_quat_world=trace.base_quat_world[: len(rows) + 1],
    )


@lru_cache(maxsize=1)
def clean_result() -> Identification:
    """Return the identification from the trace without noise."""
    return fit_torques(ROBOT, [clean()], BATTERY_KNOWN, AT_15_V)


def errors_of(result: Identification, params: PhysicalParams = HIDDEN) -> dict[str, float]:
    """Return the relative error of each estimate, by label."""
    errors = {}
    for item in result.estimates:
        truth = getattr(params, item.name)[0]
        (one,) = set(np.atleast_1d(truth if item.index is None else truth[item.index]).tolist())
        errors[item.label] = item.value / one - 1
    return errors


def test_clean_traces_give_the_true_parameters() -> None:
    result = clean_result()
    errors = errors_of(result)
    assert len(errors) == 12
    assert all(item.identifiable for item in result.estimates)
    assert max(map(abs, errors.values())) < 0.01, errors
    check = result.checks[0]
    assert check.after < 0.01 < 0.1 < check.before
    params = result.params(ROBOT, AT_15_V)
    assert params.motor_strength[0] == pytest.approx(STRENGTHS, rel=0.01)
    assert params.voltage[0] == 15.0
    assert len(result.digest) == 64


def test_gains_are_identified_when_named() -> None:
    hidden = HIDDEN.with_values(ROBOT, servo_kp=1.2, servo_kd=0.018)
    names = ("motor_strength", "servo_kp", "servo_kd")
    prior = hidden.with_values(ROBOT, servo_kp=1.0, servo_kd=0.015, motor_strength=1.0)
    result = fit_torques(ROBOT, [record(hidden)], names, prior)
    assert max(map(abs, errors_of(result, hidden).values())) < 0.01
    assert result.identified_names() == names


def test_intervals_contain_the_true_values_of_noisy_runs_on_the_ground() -> None:
    hidden = HIDDEN.with_values(ROBOT, base_mass_ratio=1.15, contact_friction=0.7)
    traces = [
        add_noise(record(hidden, 4.0, trotting, rack=False, start=0.1 * k, date=f"2026-11-2{k}"), 700 + k)
        for k in range(3)
    ]
    result = fit_torques(ROBOT, traces, None, NOMINAL)
    for item in result.estimates:
        truth = getattr(hidden, item.name)[0]
        low, high = item.interval
        assert low < float(truth if item.index is None else truth[item.index]) < high, item
    # Without a known voltage only ratios to it are identifiable, and a note reports this.
    assert not result.estimate("voltage").identifiable
    assert any("voltage of 16 V" in note for note in result.notes)
    ratio = result.estimate("torque_constant").value / result.estimate("resistance").value
    assert ratio == pytest.approx(0.101 / 0.175, rel=0.05)
    assert result.estimate("resistance").deviation > 0.03 * 0.175
    assert result.estimate("servo_latency").deviation < 0.001
    assert result.date == "2026-11-22"
    assert result.checks[0].after < 0.03
    from_known_battery = fit_torques(ROBOT, traces, BATTERY_KNOWN, AT_15_V)
    assert from_known_battery.estimate("resistance").deviation < 0.02 * 0.175
    assert all(item.identifiable for item in from_known_battery.estimates)


def test_intervals_of_strengths_include_errors_of_torque_reports() -> None:
    result = fit_torques(ROBOT, [clean()], ("motor_strength",), HIDDEN.with_values(ROBOT, motor_strength=1.0))
    for item in result.estimates:
        assert item.deviation >= 0.01 * item.value
        assert item.value == pytest.approx(STRENGTHS[item.index or 0], rel=0.005)


def test_a_motor_that_never_moves_is_not_identifiable() -> None:
    def one_leg_still(time: float) -> tuple[np.ndarray, np.ndarray]:
        swing, extension = swinging(time)
        return np.where(np.arange(4) == 1, 0.0, swing), np.where(np.arange(4) == 1, 2.0, extension)

    trace = record(moves=one_leg_still)
    # The start is left out, until the legs have settled.
    result = fit_torques(ROBOT, [cut(trace, slice(100, None))], BATTERY_KNOWN, AT_15_V)
    still = {int(k) for k in ROBOT.leg_motor_index[1]}
    for motor in range(8):
        item = result.estimate("motor_strength", motor)
        assert item.identifiable == (motor not in still)
        if motor in still:
            assert item.value == 1.0
            assert item.deviation > 0.15
            assert any(ROBOT.motor_names[motor] in note and "never moves" in note for note in result.notes)
    assert result.estimate("resistance").value == pytest.approx(0.175, rel=0.01)


def test_a_motor_at_its_limit_identifies_only_its_strength() -> None:
    trace = clean()
    target, torque = trace.target.copy(), trace.motor_torque.copy()
    target[:, 0], torque[:, 0] = 9.0, 3.5 * 1.1
    result = fit_torques(ROBOT, [replace(trace, target=target, motor_torque=torque)], BATTERY_KNOWN, AT_15_V)
    assert any(f"{ROBOT.motor_names[0]} is at its maximum torque in 100 %" in note for note in result.notes)
    assert sum("maximum torque" in note for note in result.notes) == 1
    assert max(map(abs, errors_of(result).values())) < 0.01


def test_a_part_of_one_trace_or_whole_traces_are_held_out() -> None:
    both = fit_torques(ROBOT, [clean(), record(start=2.0)], BATTERY_KNOWN, AT_15_V)
    assert max(map(abs, errors_of(both).values())) < 0.01
    single = clean_result()
    assert single.series[0].x[0] > 0.7 * 4.0
    assert both.series[0].x[0] < 0.2
    assert both.digest != single.digest


def test_rows_around_gaps_are_left_out_and_noted() -> None:
    whole = clean()
    joined = replace(cut(whole, slice(200), slice(203, None)), meta={**whole.meta, "missed_steps": [300]})
    result = fit_torques(ROBOT, [joined], BATTERY_KNOWN, AT_15_V)
    assert max(map(abs, errors_of(result).values())) < 0.01
    for message in ("time jumps 1 times, first at 1.20 s", "1 control steps were missed"):
        assert any(message in note for note in result.notes)
    assert not set(usable_rows(deployed_motion("", joined), 0.012, 0.024)) & {*range(194, 204), *range(294, 305)}


@pytest.mark.parametrize(
    ("change", "names", "message"),
    [
        ({}, ("motor_strength", "imu_bias"), "traces can't identify .imu_bias.; choices: motor_strength"),
        ({}, (), "no parameter is to be identified; choices: "),
        ({"robot": "other"}, None, "trace 1 of 1: is of robot 'other', not of 'minitaur'"),
        ({"dry_run": True}, None, "trace 1 of 1: is a dry run"),
        ({"world": "log"}, None, "trace 1 of 1: is an imported log; only runs that surefoot recorded can be fitted"),
        ({"actuator": "constraint"}, None, "motors of kind 'constraint'; only DC motors"),
    ],
)
def test_fit_rejects_unknown_names_and_foreign_traces(
    change: dict[str, Any], names: tuple[str, ...] | None, message: str
) -> None:
    trace = replace(clean(), meta={**clean().meta, **change})
    with pytest.raises(SurefootError, match=message):
        fit_torques(ROBOT, [trace], names, NOMINAL)


def test_rows_that_hold_the_readings_of_later_steps_are_not_replayed() -> None:
    trace = replace(clean(), meta={**clean().meta, "missed_steps": [40, 41, 60]})
    angle = motion_from_trace("run", trace).motor_angle
    assert np.flatnonzero(np.isnan(angle).any(axis=1)).tolist() == [39, 40, 59]
    whole = motion_from_trace("run", clean()).motor_angle
    assert np.isfinite(whole).all()
    np.testing.assert_array_equal(angle[41:59], whole[41:59])


def test_fit_rejects_short_traces_and_motors_at_rest() -> None:
    with pytest.raises(SurefootError, match="there are no traces"):
        fit_torques(ROBOT, [], None, NOMINAL)
    with pytest.raises(SurefootError, match=r"1\.\d+ s without gaps, out of 1\.98 s; at least 2 s"):
        fit_torques(ROBOT, [cut(clean(), slice(330))], None, NOMINAL)
    with pytest.raises(SurefootError, match=r"0\.00 s without gaps"):
        fit_torques(ROBOT, [cut(clean(), slice(2))], None, NOMINAL)
    still = record(moves=lambda _: (np.zeros(4), np.full(4, 2.0)), rack=False)
    with pytest.raises(SurefootError, match=r"no motor moves by 0\.03 rad"):
        fit_torques(ROBOT, [cut(still, slice(100, None))], None, NOMINAL)


def test_a_walk_identifies_the_mass_of_the_base() -> None:
    ratio = 1.3
    hidden = HIDDEN.with_values(ROBOT, base_mass_ratio=ratio, leg_mass_ratio=1.1)
    prior = AT_15_V.with_values(ROBOT, leg_mass_ratio=1.1)
    walk = record(hidden, 6.0, trotting, rack=False)
    result = fit_torques(ROBOT, [add_noise(walk, 300)], NAMES, prior)
    mass = result.estimate("base_mass_ratio")
    low, high = mass.interval
    assert low < ratio < high
    assert mass.deviation < 0.04
    assert any("weighs" in note and "leg_mass_ratio is 1.1" in note for note in result.notes)
    # The mass can be the only parameter.
    single = fit_torques(ROBOT, [walk], ("base_mass_ratio",), hidden)
    assert single.identified_names() == ("base_mass_ratio",)
    assert single.estimate("base_mass_ratio").value == pytest.approx(ratio, rel=0.04)


def test_a_walk_with_a_gap_has_an_interval_of_its_mass() -> None:
    walk, step = record(HIDDEN, 6.0, trotting, rack=False), float(HIDDEN.control_step[0])
    gap = deployed_motion("gap", cut(walk, slice(0, round(3.0 / step)), slice(round(4.2 / step), None)))
    bounds = {name: (float(getattr(HIDDEN, name)[0]),) * 2 for name in torque_fit.LATENCIES}
    segments = torque_fit.make_segments(ROBOT, [gap], bounds, 0)
    total, ratio, deviation = walking_mass(ROBOT, segments, HIDDEN)
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert 0 < deviation < 0.1 < total


def test_mass_needs_long_walks_on_the_ground() -> None:
    with pytest.raises(SurefootError, match=r"base_mass_ratio: no trace has 3 s upright"):
        fit_torques(ROBOT, [record(seconds=3.0)], ("base_mass_ratio",), HIDDEN)
    walk = record(seconds=6.0)
    fallen = replace(walk, roll_pitch_yaw=walk.roll_pitch_yaw + np.where(walk.time > 3.5, 1.0, 0.0)[:, None])
    with pytest.raises(SurefootError, match=r"base_mass_ratio: no trace has 3 s upright"):
        fit_torques(ROBOT, [fallen], ("base_mass_ratio",), HIDDEN)
    with pytest.raises(SurefootError, match=r"base_mass_ratio: the feet carry -?\d\.\d\d kg"):
        fit_torques(ROBOT, [walk], ("base_mass_ratio",), HIDDEN)


def test_motion_between_readings_is_a_polynomial() -> None:
    trace = cut(clean(), slice(20))
    turns = np.polynomial.Polynomial([0.3, 2.0, -40.0, 300.0])
    half = 0.5 * ROBOT.timing.servo_step
    ones = np.ones(8)
    trace = replace(
        trace,
        motor_angle=turns(trace.time)[:, None] * ones,
        motor_velocity=turns.deriv()(trace.time - half)[:, None] * ones,
    )
    at = np.array([0.0301, 0.0333, 0.06, 0.0999])
    angle, speed = MotorMotion(ROBOT, deployed_motion("", trace)).at(at)
    assert angle[:, 3] == pytest.approx(turns(at), abs=1e-9)
    assert speed[:, 3] == pytest.approx(turns.deriv()(at - half), abs=1e-6)


def test_timing_of_torques_in_real_time_is_estimated() -> None:
    late_trace = replace(clean(), meta={**clean().meta, "lead": 0.005})
    simulated, real_time = (deployed_motion("", trace) for trace in (clean(), late_trace))
    assert [timing.age for timing in torque_timings(ROBOT, simulated)] == [0.001]
    assert [timing.age for timing in torque_timings(ROBOT, real_time)] == pytest.approx([0.001, 0.0065])
    late = TorqueRows(
        real_time, MotorMotion(ROBOT, real_time), np.array([10, 11]), 0, torque_timings(ROBOT, real_time)[1]
    )
    assert np.array_equal(late.target, real_time.command[[9, 10]])
    # The data show the timing; these torques are from the end of the control step.
    result = fit_torques(ROBOT, [late_trace], BATTERY_KNOWN, AT_15_V)
    assert max(map(abs, errors_of(result).values())) < 0.01


def test_coloured_unknowns_affect_only_their_motor_or_trace() -> None:
    motions = [deployed_motion("", trace) for trace in (clean(), record(seconds=1.0))]
    segments = [
        TorqueRows(motion, MotorMotion(ROBOT, motion), np.arange(20, 60), number, torque_timings(ROBOT, motion)[0])
        for number, motion in enumerate(motions)
    ]
    unknowns = [
        Unknown("motor_strength", 1.0, 0.0, 2.0, 1e-6, motor, colour=0, affects=("motor", motor)) for motor in range(8)
    ]
    unknowns.append(Unknown(VOLTAGE_CHANGE, 0.0, -3.0, 3.0, 1e-5, 1, colour=1, affects=("trace", 1)))
    values = np.array([u.start for u in unknowns])
    observations = [torque_observations(ROBOT, segment, np.ones(8, np.bool_)) for segment in segments]
    together, apart = (
        ReplayModel(group, AT_15_V, observations) for group in (unknowns, [replace(u, colour=None) for u in unknowns])
    )
    residuals = together.residuals(values[None])[0]
    assert np.array_equal(forward_jacobian(together, values, residuals), forward_jacobian(apart, values, residuals))
    assert len(residuals) == len(together.blocks) == 2 * 40 * 8
