"""The experiment of a robot with joint actuators that hangs in the air: chirps that tell gains, friction and inertia.

The protocol of PACE (arXiv 2509.06342): kinds of joints follow a chirp one after another, then all together. A slow
part shows friction and the legs' weight, a fast one inertia and delay; both together tell damping from friction.
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
"""Greatest amplitude of a joint [rad]."""
LIMIT_MARGIN = 0.15
"""Distance that joints keep from their limits [rad]."""
FREQUENCY_BAND = (0.2, 8.0)
"""Frequencies of a chirp, first and last [Hz]."""
SINGLE_TIME, TOGETHER, CHECK_TIME = 6.0, 10.0, 6.0
"""Length of a chirp of one kind of joint, of all together, and of the one that is not fitted [s]."""
SPEED_FRACTION = 0.3
"""Greatest speed that a command asks for, over the speed limit of the motor."""
TORQUE_FRACTION = 0.5
"""Torque that the servo may ask for at the fastest part of a chirp, over the motor's limit."""
COMBINED_FACTOR = 0.6
"""Amplitude of all joints together, over that of one kind: legs do not meet."""
DEFAULT_SPEED_LIMIT = 20.0
"""Speed limit [rad/s] of motors whose sheet has none."""


def air_plan(robot: RobotDescription) -> Plan:
    """Return the plan: unfold, chirps of each kind of joint, of all together, and one that is not fitted.

    Raises:
        SurefootError: a robot with other actuators.
    """
    if not isinstance(robot.actuator, JointActuatorData) or robot.loops:
        raise SurefootError(f"air takes robots with joint actuators and serial legs; {robot.name} has others")
    middle = robot.resting_angles.copy()
    amplitude, speed = amplitudes(robot, robot.actuator, middle)
    places = robot.leg_motor_index
    shift = np.zeros(robot.num_motors)
    for leg, motors in enumerate(places):
        # Legs differ, to be distinguishable by eye; joints of a leg a quarter turn apart load each other differently.
        shift[motors] = 0.4 * leg + np.pi / 2 * np.arange(len(motors))
    phases = [transition("unfold", "all legs to the middle of the motion", 2.0, middle)]
    for place in range(places.shape[1]):
        own = np.zeros(robot.num_motors)
        own[places[:, place]] = amplitude[places[:, place]]
        kind = joint_kind_name(robot, place)
        what = f"{kind} {own.max():.2f} rad to both sides, from {FREQUENCY_BAND[0]:g} to {FREQUENCY_BAND[1]:g} Hz, less as they get faster"
        phases.append(Phase(f"chirp of {kind}", what, SINGLE_TIME, _chirp(middle, own, speed, FREQUENCY_BAND, SINGLE_TIME, 0.0 * shift)))
        phases.append(transition("centre", "all legs back to the middle", 0.5, middle, 0.3))
    all_joints = COMBINED_FACTOR * amplitude
    what = f"all joints {all_joints.max():.2f} rad at most to both sides"
    phases += [
        Phase("chirp of all", what, TOGETHER, _chirp(middle, all_joints, speed, FREQUENCY_BAND, TOGETHER, shift)),
        transition("centre", "all legs back to the middle", 0.5, middle, 0.3),
        Phase(
            "chirp back",
            f"{what}, from fast to slow",
            CHECK_TIME,
            _chirp(middle, all_joints, speed, (FREQUENCY_BAND[1] / 2, FREQUENCY_BAND[0]), CHECK_TIME, shift[::-1]),
            use="check",
        ),
    ]
    limits = ExperimentLimits(float(np.max(robot.actuator.torque_limit)), angle_margin=0.5)
    return Plan("air", True, tuple(phases), middle - amplitude, middle + amplitude, 0.0, limits)


def amplitudes(robot: RobotDescription, actuator: JointActuatorData, middle: Array) -> tuple[Array, Array]:
    """Return the amplitude [rad] and the greatest commanded speed [rad/s] of each motor (M,), within limits.

    An amplitude stays clear of the joint's limits. A servo asks for k_p times its error at most, which at the fastest
    part of a chirp is the command's amplitude: commands get smaller as they get faster.
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
    """Return sines of growing or falling frequency around the middle (M,), of constant amplitude (M,) up to a speed.

    Where the amplitude at a frequency f would ask for more than `speed` (M,) [rad/s], it is `speed` / (2 pi f).
    """
    first, last = band

    def signal(t: float, start: Array) -> Array:
        angle, fade = sweep(t, first, last, duration)
        frequency = first * (last / first) ** (t / duration)
        size = np.minimum(amplitude, speed / (2 * np.pi * frequency))
        value: Array = middle + fade * size * np.sin(angle + phase)
        return value

    return signal
