"""Recorded motion: its channels, the times of readings, and rejection of invalid logs."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.traces import deployed_motion, motion_from_trace, read_motion, trace_from_motion
from surefoot.robot import RobotDescription

DATA = Path(__file__).parents[3] / "data" / "pupper_v2"


def arrays(rows: int = 50, motors: int = 12) -> dict[str, np.ndarray]:
    time = 0.01 * np.arange(1, rows + 1)
    command = np.zeros((rows, motors))
    command[:, 1] = np.sin(time)
    return {"time": time, "command": command, "motor_angle": command + 0.1, "imu": np.zeros((rows, 4))}


def write(path: Path, **changes: np.ndarray) -> Path:
    np.savez(path, **{**arrays(), **changes})
    return path


def test_repeated_readings_have_the_time_of_the_first():
    time = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0])
    angle = np.array([[0.0], [5.0], [5.0], [5.0], [7.0], [9.0]])
    log = RecordedMotion("log", time, np.arange(6.0)[:, None], motor_angle=angle)
    # Readings are new in rows 0, 1, 4 and 5, so 1, 3 and 2 s apart (median 2 s). Each was taken half of the preceding
    # time step earlier.
    np.testing.assert_allclose(log.read_time, [0.0, 0.5, 0.5, 0.5, 3.5, 5.0])
    assert log.has_new_reading.tolist() == [True, True, False, False, True, True]
    timing = log.timing()
    assert timing["repeated_readings"] == pytest.approx(2 / 6)
    assert (timing["least_step"], timing["greatest_step"]) == (1.0, 2.0)


def test_times_may_repeat_and_are_counted():
    log = RecordedMotion("log", np.array([0.0, 0.0, 1.0]), np.arange(3.0)[:, None], motor_angle=np.zeros((3, 1)))
    assert log.timing()["repeated_times"] == 0.5


def moved(**channels: np.ndarray) -> RecordedMotion:
    """Return the motion of a knee that moves for half a second, in rows 10 ms apart, with the given channels."""
    rows = arrays(51)
    return RecordedMotion("log", rows["time"], rows["command"], **channels)


def test_a_log_that_is_still_at_first_is_named_and_cut_before_its_first_motion():
    time = 0.1 * np.arange(101)
    command = np.where(time > 5.05, 0.5, 0.0)[:, None]
    log = RecordedMotion("late.npz", time, command)
    with pytest.raises(SurefootError, match=r"log late\.npz, first 3 s: no command moves a joint by more than 0\.02"):
        log.first_seconds(3.0)
    moving = log.from_first_motion()
    assert moving.time[0] == pytest.approx(4.8)  # 0.3 s before the motion
    assert moving.first_seconds(3.0).moving_joints.tolist() == [True]


def test_channels_that_were_not_recorded_are_missing():
    motion = moved(motor_angle=np.ones((51, 12)))
    assert motion.missing() == ["motor_velocity", "motor_torque", "roll_pitch_yaw", "angular_velocity_base"]
    assert motion.imu.shape == (51, 4)
    assert np.isnan(motion.imu).all()
    assert motion.control_step == pytest.approx(0.01)
    part = motion.crop(0.095, 0.205)
    assert part.time.tolist() == pytest.approx((0.01 * np.arange(11, 22)).tolist())
    assert part.motor_torque.shape == (11, 12)
    with pytest.raises(SurefootError, match=r"--between 2 3 has 0 rows; the log is 0\.5 s long"):
        motion.crop(2.0, 3.0)


def test_a_log_is_the_same_as_a_trace_and_back(pupper: RobotDescription):
    torque, speed = np.full((51, 12), 2.0), np.full((51, 12), -0.5)
    angle, attitude = np.random.default_rng(1).standard_normal((51, 12)), np.full((51, 3), 0.1)
    motion = moved(motor_angle=angle, motor_velocity=speed, motor_torque=torque, roll_pitch_yaw=attitude)
    trace = trace_from_motion(motion, pupper)
    assert trace.is_imported
    assert trace.energy == pytest.approx(np.full(51, 12 * 1.0 * 0.01))
    again = motion_from_trace("log", trace)
    for name, value in vars(motion).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    # Without torques the energy is unknown.
    assert np.isnan(trace_from_motion(moved(motor_angle=angle), pupper).energy).all()
    with pytest.raises(SurefootError, match="log log: trace: motor_angle row 3 is inf"):
        trace_from_motion(moved(motor_angle=np.where(np.arange(51)[:, None] == 3, np.inf, angle)), pupper)


def test_a_deployment_sends_the_command_of_a_row_one_row_earlier(pupper: RobotDescription):
    trace = trace_from_motion(moved(motor_angle=np.zeros((51, 12))), pupper)
    motion = deployed_motion("run", trace)
    np.testing.assert_array_equal(motion.read_time, trace.time)
    np.testing.assert_allclose(motion.time, [0.0, *trace.time[:-1]], atol=1e-12)
    np.testing.assert_array_equal(motion.command, trace.target)


def test_the_published_logs_are_read(pupper: RobotDescription):
    log = read_motion(DATA / "right_side_1khz.npz", pupper)
    assert np.flatnonzero(log.moving_joints).tolist() == [1, 2, 7, 8]
    assert log.timing()["repeated_readings"] == pytest.approx(0.547, abs=0.001)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"command": np.zeros((50, 8))}, r"command has shape \(50, 8\).*pupper_v2 has 12 motors"),
        ({"time": 0.01 * np.arange(50)[::-1]}, "time goes backwards in row 1, from 0.49 to 0.48 s"),
        ({"command": np.full((50, 12), 0.3)}, "no command moves a joint by more than 0.02 rad"),
        ({"time": np.full(50, np.nan)}, "time has values that are not finite"),
        ({"imu": np.zeros((49, 4))}, r"imu has shape \(49, 4\).*one row per time"),
        ({"command": np.full((50, 12), "a")}, "command has type <U1; it must hold numbers"),
        ({"motor_angle": np.array([{}] * 50, object)}, "no file of arrays"),
    ],
)
def test_read_log_rejects_arrays_of_another_shape(
    tmp_path: Path, pupper: RobotDescription, changes: dict, message: str
):
    with pytest.raises(SurefootError, match=message):
        read_motion(write(tmp_path / "log.npz", **changes), pupper)


def test_read_log_lists_arrays_if_commands_are_missing(tmp_path: Path, pupper: RobotDescription):
    np.savez(tmp_path / "log.npz", time=np.arange(3.0), position=np.zeros((3, 12)))
    with pytest.raises(
        SurefootError, match=r"has no command.*It has position, time; with other names: surefoot identify import"
    ):
        read_motion(tmp_path / "log.npz", pupper)


def test_read_log_rejects_an_array_longer_than_its_file(tmp_path: Path, pupper: RobotDescription):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(tmp_path / "log.npz", "w") as archive:
        archive.writestr("time.npy", header.getvalue())
    with pytest.raises(SurefootError, match=r"an array of shape .* is longer than its file"):
        read_motion(tmp_path / "log.npz", pupper)


def test_read_log_rejects_a_missing_file(tmp_path: Path, pupper: RobotDescription):
    with pytest.raises(SurefootError, match="can't be read: No such file"):
        read_motion(tmp_path / "none.npz", pupper)
