"""Motion of a robot on the ground: recorded readings resampled to common times, smoothed and differentiated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from surefoot.actuator.motor import motor_current, motor_friction, motor_torque, servo_duty
from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.ground.inverse_dynamics import Forces, InverseDynamics, Motion
from surefoot.identify.plan import Use
from surefoot.identify.recording import CLOCK_RESOLUTION, Recording, interpolate_columns
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

STEP = 0.002
"""Time between two samples before subsampling [s]."""
SUBSAMPLE_STRIDE = 5
"""Every fifth sample is kept, because neighbouring smoothed samples are nearly equal."""
SMOOTHING_WINDOW = 15
"""Samples in the window of the cubic smoothing filter (Savitzky and Golay 1964): 30 ms, which passes up to 20 Hz."""
TILT_TIME_CONSTANT = 2.0
"""Time constant [s] of the complementary filter that corrects integrated gyro rates by the IMU's noisy angles."""
MAX_TILT = 0.3
"""Roll or pitch [rad] above which a robot does not count as standing."""
BLOCK = 0.5
"""Length [s] of the time blocks within which errors may be correlated."""
_USES: tuple[Use, ...] = ("fit", "check")


@dataclass(frozen=True)
class GroundMotion:
    """Smoothed motion of a robot on the ground at T times, with the phase of the experiment at each time."""

    time: Array
    """Time on the robot's clock (T,) [s]."""
    phase: NDArray[np.int64]
    """Index of the phase (T,)."""
    motion: Motion
    names: tuple[str, ...]
    """Name of each phase."""
    uses: tuple[str, ...]
    """Use of each phase: fit, check or transition."""

    @property
    def blocks(self) -> NDArray[np.int64]:
        """Index of the time block of each sample (T,)."""
        return (self.time / BLOCK).astype(np.int64)

    def during(self, *names: str, uses: tuple[Use, ...] = ("fit",)) -> NDArray[np.bool_]:
        """Return a mask (T,) of the samples in phases with the given names (default: all) and uses."""
        phases = [k for k, name in enumerate(self.names) if name in (names or self.names) and self.uses[k] in uses]
        return np.isin(self.phase, phases)


def ground_motion(
    robot: RobotDescription, recording: Recording, params: PhysicalParams, sensors: dict[str, Any]
) -> GroundMotion:
    """Return the motion of a recording on the ground.

    Args:
        robot: robot description.
        recording: recording of an experiment on the ground.
        params: prior parameters, one row.
        sensors: `Identification.sensors` of earlier experiments.

    Raises:
        SurefootError: the robot fell or never stood up, or a motor never moves.
    """
    if still := sorted(recording.still_motors):
        name = robot.motor_names[still[0]]
        raise SurefootError(f"{name} never moves, but foot forces need the readings of all motors: run it again")
    fitted = np.isin(recording.sent_phase, recording.phases(*_USES))
    times, age = recording.time, max(float(params.control_latency[0]) - float(recording.meta["lead"]), 0.0)
    first, last = recording.arrival[fitted][[0, -1]]
    grid = np.arange(max(first, times[0]), min(last, times[-1] - age - STEP), STEP)

    def at(values: Array, shift: float = age) -> Array:
        return interpolate_columns(grid + shift, times, values)

    gains = 1 + np.asarray(sensors.get("torque_gain", np.zeros(robot.num_motors)))
    velocity = at(recording.motor_velocity)
    torque = at(recording.motor_torque / gains + _torque_excess(robot, recording, params, age), recording.period / 2)
    torque = torque + motor_friction(velocity, params.motor_friction[0], params.motor_viscous_friction[0])
    rate = at(recording.angular_velocity_base) - recording.angular_velocity_base[recording.resting].mean(axis=0)
    motion = Motion(
        motor_angle=_smooth(at(recording.motor_angle)),
        motor_velocity=_smooth(velocity),
        motor_acceleration=_smooth(velocity, 1),
        motor_torque=_smooth(torque),
        roll_pitch=_filter_tilt(at(recording.roll_pitch_yaw[:, :2]) - params.imu_bias[0], rate[:, :2]),
        angular_velocity=_smooth(rate),
        angular_acceleration=_smooth(rate, 1),
    )
    place = np.clip(np.searchsorted(recording.arrival, grid, side="right") - 1, 0, None)
    phases = recording.meta["phases"]
    standing = GroundMotion(
        grid[::SUBSAMPLE_STRIDE],
        recording.sent_phase[place][::SUBSAMPLE_STRIDE].astype(np.int64),
        Motion(**{name: values[::SUBSAMPLE_STRIDE] for name, values in vars(motion).items()}),
        tuple(phase["name"] for phase in phases),
        tuple(phase["use"] for phase in phases),
    )
    tilt = float(np.percentile(np.abs(standing.motion.roll_pitch[standing.during(uses=_USES)]), 99))
    if tilt > MAX_TILT:
        raise SurefootError(f"the robot tilts by {tilt:.2f} rad; at most {MAX_TILT:g} while it stands: run it again")
    return standing


def check_feet(standing: GroundMotion, forces: Forces, dynamics: InverseDynamics) -> None:
    """Reject a robot that does not stand on its feet only.

    Raises:
        SurefootError: the feet carry less than the weight of the legs.
    """
    carried = float(forces.force[standing.during(uses=_USES), :, 1].sum(axis=1).mean()) / GRAVITY
    legs = dynamics.mass - dynamics.base_mass
    if not carried > legs:
        raise SurefootError(
            f"the feet carry {carried:.2f} kg on average, less than the mass of the legs, {legs:.2f} kg: the robot "
            "must stand on its feet; run it again"
        )


def _torque_excess(robot: RobotDescription, recording: Recording, params: PhysicalParams, age: float) -> Array:
    """Return the mean motor torque since the previous state minus the reported torque (T, M) [N m].

    A state reports the torque of the last servo step only. Torques jump when a command arrives and decay as the motor
    follows, so that the reported torque is biased. The servo and motor model gives the difference.
    """
    dt, times = float(recording.meta["servo_period"]), recording.time
    steps = []
    for back in range(max(round(recording.period / dt), 1), 0, -1):
        begins = times - back * dt
        command = np.clip(np.searchsorted(recording.arrival, begins + CLOCK_RESOLUTION, side="right") - 1, 0, None)
        read = begins - params.servo_latency[0] + age
        duty = servo_duty(
            recording.sent_value[command],
            interpolate_columns(read, times, recording.motor_angle),
            interpolate_columns(read, times, recording.motor_velocity),
            params.servo_kp[0],
            params.servo_kd[0],
        )
        current = motor_current(
            duty,
            interpolate_columns(begins + age, times, recording.motor_velocity),
            recording.voltage[:, None],
            params.torque_constant[0],
            params.resistance[0],
            params.voltage_clip[0],
        )
        steps.append(motor_torque(current, params.motor_strength[0], *robot.torque_table))
    return np.asarray(np.mean(steps, axis=0) - steps[-1])


def _smooth(values: Array, derivative: int = 0) -> Array:
    return np.asarray(savgol_filter(values, SMOOTHING_WINDOW, 3, deriv=derivative, delta=STEP, axis=0))


def _filter_tilt(tilt: Array, rate: Array) -> Array:
    """Return roll and pitch (T, 2) [rad] from a complementary filter of IMU angles and rates, for small angles."""
    out = np.empty_like(tilt)
    now = tilt[: max(int(0.2 / STEP), 1)].mean(axis=0)
    for k in range(len(tilt)):
        now = now + STEP * rate[k]
        now = now + (tilt[k] - now) * STEP / TILT_TIME_CONSTANT
        out[k] = now
    # A constant gyro bias causes a constant error of the angles; the IMU's angles have none on average.
    return out + (tilt - out).mean(axis=0)


def block_deviation(values: Array, blocks: NDArray[np.int64]) -> float:
    """Return the standard deviation of the mean of values (T,) that are correlated within blocks."""
    numbers = np.unique(blocks)
    if len(numbers) < 2:
        return float("inf")
    means = np.array([values[blocks == number].mean() for number in numbers])
    return float(means.std(ddof=1) / np.sqrt(len(numbers)))


def regress(columns: Array, values: Array, blocks: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the least-squares solution (n,) of values (T,) on columns (T, n), and its covariance by blocks (n, n)."""
    inverse = np.linalg.pinv(columns.T @ columns, hermitian=True)
    solution = inverse @ (columns.T @ values)
    residuals = values - columns @ solution
    numbers = np.unique(blocks)
    gradients = np.array([columns[blocks == n].T @ residuals[blocks == n] for n in numbers])
    factor = len(numbers) / max(len(numbers) - columns.shape[1], 1)
    return solution, inverse @ (gradients.T @ gradients * factor) @ inverse
