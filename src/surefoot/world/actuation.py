"""Actuation shared by all simulated worlds: sensors, delays, servos and motors between two physics steps.

In each servo step of a robot, an engine calls `compute_torque`, applies `state.torque` for the step, increments
`state.ticks`, writes the robot's new state to `state.sample` and calls `record_sample`.

Timing, with the servo step dt, servo latency L_s, control latency L_c and control step T:

    time       event
    n dt       the engine's current state is appended to the history
    n dt       the servo reads angles and speeds of n dt - L_s and sets the duty; back-EMF uses the current speed
    n dt       torque acts on the robot until (n + 1) dt
    k T        the policy reads the state of k T - L_c, and its command holds from k T to (k + 1) T
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from surefoot.actuator.compiled import kernel
from surefoot.actuator.delay import push_kernel, read_kernel
from surefoot.actuator.motor import (
    constraint_speed_kernel,
    constraint_torque_kernel,
    joint_limit_kernel,
    joint_torque_kernel,
    motor_current_kernel,
    motor_friction_kernel,
    motor_torque_kernel,
    overheat_kernel,
    presliding_kernel,
    servo_duty_kernel,
)
from surefoot.arrays import Array
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.actuator import HEAT_LOSS, DcMotorData
from surefoot.rotations import quat_rpy, rpy_quat
from surefoot.world.interface import WorldConfig

Quat = tuple[Any, Any, Any, Any]
Vector = tuple[float, float, float]

RACK_HEIGHT = 1.0
"""Height [m] of the base on a rack."""
SPEED_LIMIT = 1e5
"""Generalized speed [m/s, rad/s] above which a simulation counts as diverged, before the engine itself reports it."""
_SATURATION_FRACTION = 0.999
"""Fraction of its maximum torque above which a constraint motor is at its limit, as solvers find torques
iteratively."""
SHARED_ARRAYS = ("table_current", "table_torque", "constants", "constraint", "joint", "joint_limits")
"""Arrays of `ActuationState` that all robots share, without one row per robot."""
CONTACT_PARAMS = ("contact_friction", "contact_stiffness", "contact_spinning_friction", "contact_shear_ratio")
"""Physical parameters of the foot contact."""
MASS_RATIOS = ("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio")
"""Physical parameters of masses and inertias."""
_PARAM_ARRAYS = {
    **{
        name: name
        for name in (
            *("torque_constant", "resistance", "voltage", "servo_latency", "load_friction", "speed_filter"),
            *("presliding", "motor_offset", "torque_lag", "voltage_clip"),
        )
    },
    **{name: f"servo_{name}" for name in ("kp", "kd")},
    "max_torque": "torque_limit",
    **{"strength": "motor_strength", "friction": "motor_friction", "viscous": "motor_viscous_friction"},
}
"""Arrays of `ActuationState` that contain a physical parameter, with the parameter's name."""
_ROBOT_ARRAYS = (
    *("torque_constant", "resistance", "voltage", "voltage_clip", "servo_latency", "speed_filter"),
    *("torque_lag", "energy"),
)
"""Arrays of `ActuationState` with one value per robot."""
_MOTOR_ARRAYS = (
    *("strength", "friction", "viscous", "kp", "kd", "load_friction", "target", "duty", "torque", "constraint_speed"),
    *("constraint_torque", "motor_torque", "heat", "overheated_time", "filtered_speed"),
    *("max_torque", "presliding", "friction_stretch", "motor_offset", "limit_ticks"),
)
"""Arrays of `ActuationState` with one value per motor."""
IMU_WIDTH = 6
"""IMU columns of a reading: roll, pitch, yaw [rad], and angular velocity in the base frame [rad/s]."""
_rpy_quat = njit(cache=True)(rpy_quat)
roll_pitch_yaw = kernel(quat_rpy)


class ActuationState(NamedTuple):
    """State of servos, motors and sensors, for N robots with M motors and L legs and a history of H samples."""

    strength: Array  # (N, M)
    friction: Array  # (N, M) N m, Coulomb
    viscous: Array  # (N, M) N m s/rad, friction too
    torque_constant: Array  # (N,)
    resistance: Array  # (N,)
    voltage: Array  # (N,)
    voltage_clip: Array  # (N,) V, limit of the net voltage
    kp: Array  # (N, M) duty/rad of DC motors, N m/rad of joint actuators
    kd: Array  # (N, M) per speed
    servo_latency: Array  # (N,) s
    load_friction: Array  # (N, M) of joint actuators
    speed_filter: Array  # (N,) s, time constant, of joint actuators
    torque_lag: Array  # (N,) s, time constant, of joint actuators
    max_torque: Array  # (N, M) N m at low speed, of joint actuators
    presliding: Array  # (N, M) rad, of joint actuators
    motor_offset: Array  # (N, M) rad, readings of encoders minus the true angles
    table_current: Array  # (points,) A, all robots
    table_torque: Array  # (points,) N m, all robots
    joint: NDArray[np.bool_]  # (1,) all robots: whether motors are joint actuators instead of DC motors
    joint_limits: Array  # (3, M) all robots: maximum speed at full torque, no-load speed, overheat torque
    constants: Array  # (3,) all robots: overheat torque N m and time s (inf: off), servo step s
    constraint: NDArray[np.bool_]  # (1,) all robots: whether motors are constraints instead of DC motors
    ticks: NDArray[np.int64]  # (N,) servo steps since reset
    times: Array  # (N, H) s, times of the history
    history: Array  # (N, H, 2 M + 6) past samples
    torque_history: Array  # (N, H, M) N m, motor torques at these times; (N, 0, M) if nobody reads them
    sample: Array  # (N, 2 M + 6) encoder angles, speeds, roll, pitch, yaw, angular velocity in the base frame
    servo_sample: Array  # (N, 2 M) delayed angles and speeds for the servo
    target: Array  # (N, M) rad
    duty: Array  # (N, M) added to the servo's duty: 0 in simulations, set by the PWM commands of an emulated robot
    torque: Array  # (N, M) N m on the motor shaft, friction included
    constraint_speed: Array  # (N, M) rad/s, target of constraint motors at the step's end
    constraint_torque: Array  # (N, M) N m, maximum of constraint motors
    motor_torque: Array  # (N, M) N m of the motor, without friction
    energy: Array  # (N,) J, integral of |tau . qdot| since the last reset to zero
    heat: Array  # (N, M) J, of windings since the last reset to zero; 0 for constraint motors, which have no current
    overheated_time: Array  # (N, M) s
    filtered_speed: Array  # (N, M) rad/s, filtered speeds for joint actuators
    friction_stretch: Array  # (N, M) rad, elastic deflection of sticking friction in joint actuators
    switched_off: NDArray[np.bool_]  # (N, M) by thermal protection
    contact_ticks: Array  # (N, L) servo steps with foot contact since the last reset to zero
    limit_ticks: Array  # (N, M) servo steps with the motor at its limit since the last reset to zero


def new_actuation(robot: RobotDescription, num_envs: int, history: int, config: WorldConfig) -> ActuationState:
    """Return the state of `num_envs` robots with nominal parameters and an empty history.

    Args:
        robot: the robot.
        num_envs: number of robots N.
        history: number of samples H in the history.
        config: configuration of the world.
    """
    motors, data = robot.num_motors, robot.actuator
    width = 2 * motors + IMU_WIDTH
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(_ROBOT_ARRAYS, ()),
        **dict.fromkeys(_MOTOR_ARRAYS, (motors,)),
        "times": (history,),
        "history": (history, width),
        "torque_history": (history if config.torque_readings else 0, motors),
        "sample": (width,),
        "servo_sample": (2 * motors,),
        "contact_ticks": (len(robot.legs),),
    }
    current, torque, hot_torque, joint_limits = np.zeros(1), np.zeros(1), 0.0, np.zeros((3, motors))
    if isinstance(data, DcMotorData):
        (current, torque), hot_torque = robot.torque_table, data.overheat_torque
    else:
        each = (data.full_torque_speed, data.speed_limit, data.overheat_torque)
        joint_limits = np.array([np.broadcast_to(values, motors) for values in each], float)
    overheat_time = data.overheat_time if config.thermal_protection else math.inf
    state = ActuationState(
        **{name: np.zeros((num_envs, *shape)) for name, shape in shapes.items()},
        table_current=current,
        table_torque=torque,
        joint=np.array([robot.actuator.kind == "joint"]),
        joint_limits=joint_limits,
        constants=np.array([hot_torque, overheat_time, robot.timing.servo_step]),
        constraint=np.array([config.actuator == "constraint"]),
        ticks=np.zeros(num_envs, np.int64),
        switched_off=np.zeros((num_envs, motors), np.bool_),
    )
    set_actuation_params(state, np.arange(num_envs), PhysicalParams.nominal(robot, num_envs))
    return state


def set_actuation_params(state: ActuationState, index: NDArray[np.int64], params: PhysicalParams) -> None:
    """Set the parameters of servos and motors of the robots at `index`, one row per robot."""
    for name, parameter in _PARAM_ARRAYS.items():
        getattr(state, name)[index] = getattr(params, parameter)


def bases_on_rack(num_envs: int) -> Array:
    """Return the base states (N, 10) of robots on a rack, as `Engine.base` does: level, at `RACK_HEIGHT`, at rest."""
    return np.tile([0.0, 0.0, RACK_HEIGHT, 1.0, *[0.0] * 6], (num_envs, 1))


@njit(cache=True, inline="always")
def quat_product(a: Quat, b: Quat) -> Quat:
    """Return the product of two quaternions w x y z. Outside compiled code, components may be arrays."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@kernel
def rotate_inverse(quat: Quat, vector: Vector) -> Vector:
    """Rotate a vector from the world frame to a body frame, given the body's unit quaternion w x y z.

    Uses the conjugate q* = (w, -u): v - 2 u x (w v - u x v).
    """
    (w, x, y, z), (vx, vy, vz) = quat, vector
    cx, cy, cz = w * vx - (y * vz - z * vy), w * vy - (z * vx - x * vz), w * vz - (x * vy - y * vx)
    return vx - 2 * (y * cz - z * cy), vy - 2 * (z * cx - x * cz), vz - 2 * (x * cy - y * cx)


@kernel
def record_sample(state: ActuationState, i: int) -> None:
    """Append the current sample of robot `i` to its history, with the robot's own time."""
    push_kernel(
        state.times[i],
        state.history[i],
        state.ticks[i],
        state.ticks[i] * state.constants[2],
        state.sample[i],
    )
    size = state.torque_history.shape[1]
    if size > 0:
        for m in range(state.motor_torque.shape[1]):
            state.torque_history[i, state.ticks[i] % size, m] = state.motor_torque[i, m]


@kernel
def protect_motor(state: ActuationState, i: int, m: int, torque: float, hot_torque: float) -> float:
    """Return a motor's torque [N m] after thermal protection, which switches it off; also stored as `motor_torque`."""
    _, hot_limit, dt = state.constants
    if hot_limit < math.inf:
        hot = overheat_kernel(torque, state.overheated_time[i, m], dt, hot_torque)
        state.overheated_time[i, m] = hot
        if hot > hot_limit:
            state.switched_off[i, m] = True
        if state.switched_off[i, m]:
            torque = 0.0
    state.motor_torque[i, m] = torque
    return torque


@kernel
def compute_joint_torque(state: ActuationState, i: int) -> None:
    """Compute `state.torque` of robot `i` with joint actuators, from the delayed angles and speeds."""
    motors = state.target.shape[1]
    dt = state.constants[2]
    follow = dt / (state.speed_filter[i] + dt)
    power = 0.0
    for m in range(motors):
        speed = state.sample[i, motors + m]
        state.filtered_speed[i, m] += follow * (state.servo_sample[i, motors + m] - state.filtered_speed[i, m])
        desired = joint_torque_kernel(
            state.target[i, m],
            state.servo_sample[i, m],
            state.filtered_speed[i, m],
            state.kp[i, m],
            state.kd[i, m],
        )
        full, none, hot_torque = state.joint_limits[:, m]
        limit = state.max_torque[i, m]
        desired += state.duty[i, m] * limit
        torque = joint_limit_kernel(desired, speed, limit, full, none)
        if torque != desired:
            state.limit_ticks[i, m] += 1.0
        torque *= state.strength[i, m]
        if state.torque_lag[i] > 0.0:
            last = state.motor_torque[i, m]
            torque = last + dt / (state.torque_lag[i] + dt) * (torque - last)
        torque = protect_motor(state, i, m, torque, hot_torque)
        power += torque * speed
        state.heat[i, m] += dt * HEAT_LOSS * full * torque * torque / limit
        coulomb = state.friction[i, m] + state.load_friction[i, m] * abs(torque)
        if state.presliding[i, m] > 0.0:
            stretch = presliding_kernel(state.friction_stretch[i, m] + speed * dt, state.presliding[i, m])
            state.friction_stretch[i, m] = stretch
            torque -= coulomb * stretch / state.presliding[i, m]
            coulomb = 0.0
        state.torque[i, m] = torque + motor_friction_kernel(speed, coulomb, state.viscous[i, m])
    state.energy[i] += dt * abs(power)


@kernel
def compute_torque(state: ActuationState, i: int) -> None:
    """Compute `state.torque` of robot `i` from servo and motor models and the state in the history.

    For constraint motors this is only the friction. Their target speed is written to `state.constraint_speed`; the
    engine solves for their torque, up to `state.constraint_torque`, and `add_constraint_work` uses it after the step.
    """
    motors = state.target.shape[1]
    if state.constraint[0]:
        for m in range(motors):
            state.constraint_speed[i, m] = constraint_speed_kernel(
                state.target[i, m],
                state.sample[i, m],
                state.kp[i, m],
                state.kd[i, m],
                state.constants[2],
            )
            if state.joint[0]:
                state.constraint_torque[i, m] = state.max_torque[i, m] * state.strength[i, m]
            else:
                state.constraint_torque[i, m] = constraint_torque_kernel(
                    state.voltage[i],
                    state.torque_constant[i],
                    state.resistance[i],
                    state.strength[i, m],
                )
            state.torque[i, m] = motor_friction_kernel(
                state.sample[i, motors + m], state.friction[i, m], state.viscous[i, m]
            )
        return
    hot_torque, _, dt = state.constants
    time = state.ticks[i] * dt
    read_at = time - state.servo_latency[i]
    read_kernel(state.times[i], state.history[i], state.ticks[i] + 1, read_at, 2 * motors, -1, state.servo_sample[i])
    if state.joint[0]:
        compute_joint_torque(state, i)
        return
    power = 0.0
    for m in range(motors):
        speed = state.sample[i, motors + m]
        duty = servo_duty_kernel(
            state.target[i, m],
            state.servo_sample[i, m],
            state.servo_sample[i, motors + m],
            state.kp[i, m],
            state.kd[i, m],
        )
        duty += state.duty[i, m]
        if abs(duty) >= 1.0:
            state.limit_ticks[i, m] += 1.0
            duty = math.copysign(1.0, duty)
        current = motor_current_kernel(
            duty, speed, state.voltage[i], state.torque_constant[i], state.resistance[i], state.voltage_clip[i]
        )
        torque = motor_torque_kernel(current, state.strength[i, m], state.table_current, state.table_torque)
        torque = protect_motor(state, i, m, torque, hot_torque)
        power += torque * speed
        if not state.switched_off[i, m]:
            state.heat[i, m] += dt * state.resistance[i] * current * current
        state.torque[i, m] = torque + motor_friction_kernel(speed, state.friction[i, m], state.viscous[i, m])
    state.energy[i] += dt * abs(power)


@kernel
def add_constraint_work(state: ActuationState, i: int) -> None:
    """Add the work of the constraint motors of robot `i` in the last step to its energy.

    The engine has set `state.motor_torque`, and `state.sample` with the speeds at the end of the step. Positions change
    by these speeds, so the work is torque times speed times step.
    """
    motors = state.target.shape[1]
    power = 0.0
    for m in range(motors):
        power += state.motor_torque[i, m] * state.sample[i, motors + m]
        if abs(state.motor_torque[i, m]) >= _SATURATION_FRACTION * state.constraint_torque[i, m]:
            state.limit_ticks[i, m] += 1.0
    state.energy[i] += state.constants[2] * abs(power)


@njit(cache=True)
def read_delayed(state: ActuationState, latency: Array, out: Array) -> None:
    """Write the samples of `latency` (N,) [s] ago to `out` (N, width)."""
    for i in range(len(latency)):
        at = state.ticks[i] * state.constants[2] - latency[i]
        width = out.shape[1]  # the last six: roll, pitch, yaw and angular velocity
        read_kernel(state.times[i], state.history[i], state.ticks[i] + 1, at, width, width - 4, out[i])


@njit(cache=True)
def read_torque(state: ActuationState, latency: Array, out: Array) -> None:
    """Write the motor torques of `latency` (N,) [s] ago to `out` (N, M)."""
    for i in range(len(latency)):
        at = state.ticks[i] * state.constants[2] - latency[i]
        read_kernel(state.times[i], state.torque_history[i], state.ticks[i] + 1, at, out.shape[1], -1, out[i])


def read_imu(attitude: Array, rates: Array, time: Array, params: PhysicalParams, rows: Any = slice(None)) -> None:
    """Convert attitudes and angular velocities of bases to IMU readings: mounting, bias and drift, without noise.

    Args:
        attitude: roll, pitch and yaw (N, 3) [rad]; modified in place.
        rates: angular velocity in the base frame (N, 3) [rad/s]; modified in place.
        time: time since the last reset of each robot (N,) [s].
        params: physical parameters with mounting, bias and drift.
        rows: rows of `params`, N of them.
    """
    mount = params.imu_mount[rows]
    if mount.any():
        rotate_to_imu(attitude, rates, mount)
    attitude[:, :2] += params.imu_bias[rows]
    drift = params.imu_yaw_drift[rows]
    if drift.any():
        attitude[:, 2] += drift * time
        rates[:, 2] += drift


@njit(cache=True)
def rotate_to_imu(attitude: Array, rates: Array, mount: Array) -> None:
    """Transform attitudes and angular velocities of bases to readings of IMUs with other orientations.

    With the rotation R_b of the base in the world and R_m of the IMU in the base, the attitude of the IMU is R_b R_m,
    and it reads the angular velocity R_m^T w.

    Args:
        attitude: roll, pitch and yaw (N, 3) [rad]; yaw about z, then pitch about y, then roll about x. Modified in
            place.
        rates: angular velocity w in the base frame (N, 3) [rad/s]. Modified in place.
        mount: roll, pitch and yaw of the IMU in the base frame (N, 3) [rad].
    """
    for i in range(len(attitude)):
        base = _rpy_quat(attitude[i, 0], attitude[i, 1], attitude[i, 2])
        imu = _rpy_quat(mount[i, 0], mount[i, 1], mount[i, 2])
        attitude[i, 0], attitude[i, 1], attitude[i, 2] = roll_pitch_yaw(*quat_product(base, imu))
        rates[i, 0], rates[i, 1], rates[i, 2] = rotate_inverse(imu, (rates[i, 0], rates[i, 1], rates[i, 2]))
