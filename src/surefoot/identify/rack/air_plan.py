"""Plan of the air experiment: chirps of a hanging robot with joint actuators, for gains, friction and inertia.

The protocol of PACE (arXiv 2509.06342): the kinds of joints (hips, thighs, calves) follow a chirp one after another,
then all together. The slow part shows friction and the weight of the legs, the fast part inertia and delay; both
together separate damping from friction.
"""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.joint_kinds import joint_kind_name
from surefoot.identify.plan import ExperimentLimits, Phase, Plan, Signal, sweep, transition
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.actuator import JointActuatorData

AMPLITUDE = 0.35
"""Maximum amplitude of a joint [rad]."""
LIMIT_MARGIN = 0.15
"""Distance that joints keep from their limits [rad]."""
FREQUENCY_BAND = (0.2, 8.0)
"""First and last frequency of a chirp [Hz]."""
SINGLE_TIME, COMBINED_TIME, CHECK_TIME = 6.0, 10.0, 6.0
"""Duration of a chirp of one kind of joint, of all joints together, and of the held-out chirp [s]."""
SPEED_FRACTION = 0.3
"""Maximum commanded speed, relative to the speed limit of the motor."""
TORQUE_FRACTION = 0.5
"""Maximum torque demand of the servo at the fastest part of a chirp, relative to the torque limit of the motor."""
STOP_FRACTION = 0.9
"""Torque that ends the experiment, relative to the torque limit of the motor."""
COMBINED_FACTOR = 0.6
"""Amplitude when all joints move together, relative to one kind of joint at a time, so that legs do not collide."""
DEFAULT_SPEED_LIMIT = 20.0
"""Maximum speed [rad/s] for motors without a lower speed limit in the data sheet."""


def air_plan(robot: RobotDescription) -> Plan:
    """Return the plan: unfold, chirps of each kind of joint, a chirp of all joints, and a held-out chirp.

    Raises:
        SurefootError: the robot has other actuators or closed legs.
    """
    if not isinstance(robot.actuator, JointActuatorData) or robot.loops:
        raise SurefootError(f"air takes robots with joint actuators and serial legs; {robot.name} has others")
    middle = robot.resting_angles.copy()
    amplitude, speed = amplitudes(robot, robot.actuator, middle)
    (first, last), places = FREQUENCY_BAND, robot.leg_motor_index
    shift = np.zeros(robot.num_motors)
    for leg, motors in enumerate(places):
        # Phases differ between legs, to distinguish them by eye, and by a quarter turn between the joints of a leg, to
        # vary how they load each other.
        shift[motors] = 0.4 * leg + np.pi / 2 * np.arange(len(motors))
    phases = [transition("unfold", "all legs to the middle of the motion", 2.0, middle)]
    for place in range(places.shape[1]):
        single = np.zeros(robot.num_motors)
        single[places[:, place]] = amplitude[places[:, place]]
        kind = joint_kind_name(robot, place)
        what = f"{kind} {single.max():.2f} rad to both sides, from {first:g} to {last:g} Hz, less at high frequency"
        signal = _chirp(middle, single, speed, FREQUENCY_BAND, SINGLE_TIME, 0.0 * shift)
        phases.append(Phase(f"chirp of {kind}", what, SINGLE_TIME, signal))
        phases.append(transition("centre", "all legs back to the middle", 0.5, middle, 0.3))
    all_joints = COMBINED_FACTOR * amplitude
    what = f"all joints {all_joints.max():.2f} rad at most to both sides"
    phases += [
        Phase(
            "chirp of all", what, COMBINED_TIME, _chirp(middle, all_joints, speed, FREQUENCY_BAND, COMBINED_TIME, shift)
        ),
        transition("centre", "all legs back to the middle", 0.5, middle, 0.3),
        Phase(
            "chirp back",
            f"{what}, from fast to slow",
            CHECK_TIME,
            _chirp(middle, all_joints, speed, (FREQUENCY_BAND[1] / 2, FREQUENCY_BAND[0]), CHECK_TIME, shift[::-1]),
            use="check",
        ),
    ]
    # A blocked motor pushes with its own limit, so the experiment's has to be below it.
    torque = STOP_FRACTION * np.broadcast_to(np.asarray(robot.actuator.torque_limit, float), robot.num_motors)
    limits = ExperimentLimits(torque, angle_margin=0.5)
    return Plan("air", True, tuple(phases), middle - amplitude, middle + amplitude, 0.0, limits)


def amplitudes(robot: RobotDescription, actuator: JointActuatorData, middle: Array) -> tuple[Array, Array]:
    """Return the amplitude [rad] and the maximum commanded speed [rad/s] of each motor (M,).

    Amplitudes keep a distance from joint limits. At the fastest part of a chirp the error of the servo is about the
    amplitude of the command, and the demanded torque k_p times as much; so the amplitude decreases with frequency.
    """
    amplitude = np.full(robot.num_motors, AMPLITUDE)
    for motor, name in enumerate(robot.motor_names):
        limits = robot.urdf.joints[name].limits
        if limits is not None:
            low, high = sorted(robot.motor_sign[motor] * np.asarray(limits, float))
            amplitude[motor] = min(AMPLITUDE, middle[motor] - low - LIMIT_MARGIN, high - LIMIT_MARGIN - middle[motor])
    nominal = PhysicalParams.nominal(robot)
    speed = np.broadcast_to(np.asarray(actuator.speed_limit, float), robot.num_motors)
    fastest = 2 * np.pi * FREQUENCY_BAND[1] * TORQUE_FRACTION * nominal.torque_limit[0] / nominal.servo_kp[0]
    return np.maximum(amplitude, 0.0), np.minimum(SPEED_FRACTION * np.minimum(speed, DEFAULT_SPEED_LIMIT), fastest)


def _chirp(
    middle: Array, amplitude: Array, speed: Array, band: tuple[float, float], duration: float, phase: Array
) -> Signal:
    """Return chirps (rising or falling frequency) around the middle (M,), with an amplitude (M,) and a speed limit.

    At frequencies f where the amplitude would exceed `speed` (M,) [rad/s], it is reduced to `speed` / (2 pi f).
    """
    first, last = band

    def signal(t: float, start: Array) -> Array:
        angle, fade = sweep(t, first, last, duration)
        frequency = first * (last / first) ** (t / duration)
        size = np.minimum(amplitude, speed / (2 * np.pi * frequency))
        value: Array = middle + fade * size * np.sin(angle + phase)
        return value

    return signal
