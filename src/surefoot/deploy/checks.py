"""Checks that compare a policy's contract, a robot's handshake and its data sheet. Nothing is sent to the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, judge, skipped
from surefoot.deploy.messages import Handshake
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.gait import HybridGait
from surefoot.task.observation import PARTS, Observer

Gains = float | Sequence[float] | Array
"""A gain of all motors, or one for each."""
WATCHDOG_STEPS = 3
"""Control steps that the robot's watchdog must allow: a late command is held for two."""
_STEP_SHARE = 0.1
"""Greatest difference of a control step from a whole number of servo periods, in servo periods."""
_ANGLE = 1e-4
"""Tolerance of angles [rad]: they travel as 32-bit numbers."""
GAIN_TOLERANCE = 0.05
"""Greatest relative difference of servo gains and servo period from those in training."""


def check_contract(
    contract: Contract, handshake: Handshake, robot: RobotDescription, digest: str | None
) -> list[CheckResult]:
    """Compare a policy with the robot that answers and with its data sheet; one result a rule.

    Args:
        contract: the policy's.
        handshake: the robot's.
        robot: the data sheet that the contract names.
        digest: `PolicyRuntime.digest`; a policy without one does not pass.
    """
    return [
        _check_digest(digest),
        *check_identity(robot, contract, handshake),
        *_check_interface(contract, robot),
        _check_gains(contract, handshake),
        check_servo_period(robot, handshake),
        _check_control_step(contract, handshake),
        _check_watchdog(contract, handshake),
        _check_angle_limits(contract, handshake, robot),
    ]


def check_description(contract: Contract, robot: RobotDescription) -> list[CheckResult]:
    """Compare a policy with the description of a robot, for simulation."""
    return [*check_identity(robot, contract), *_check_interface(contract, robot)]


def check_identity(
    robot: RobotDescription, contract: Contract | None = None, handshake: Handshake | None = None
) -> list[CheckResult]:
    """Compare robot, motors and signs of a policy, a robot and a data sheet, as far as they are given."""
    names: dict[str, str] = {}
    motors: dict[str, Sequence[str]] = {}
    signs: dict[str, Sequence[float] | Array] = {}
    if contract is not None:
        names["policy"], motors["policy"], signs["policy"] = contract.robot, contract.motor_names, contract.motor_signs
    if handshake is not None:
        names["robot"], motors["robot"], signs["robot"] = handshake.robot, handshake.motor_names, handshake.motor_signs
    names["data sheet"], motors["data sheet"], signs["data sheet"] = robot.name, robot.motor_names, robot.motor_sign
    firmware = "" if handshake is None else f", firmware '{handshake.firmware}'"
    return [
        fail_if(
            "robot",
            f"is {_by_source(names)}; all must be the same" if len(set(names.values())) > 1 else None,
            f"{robot.name}{firmware}",
            "connect the robot that the policy is for, or run a policy that was trained for this robot",
            robot.name,
        ),
        fail_if(
            "motors",
            _motors_error(motors),
            f"{len(robot.motor_names)}, same names in the same order",
            "put the motors in the policy's order in the firmware, or train with a data sheet that has the robot's",
        ),
        fail_if(
            "motor signs",
            _signs_error(robot.motor_names, signs),
            "same for every motor",
            "set the sign in the firmware, or train with a data sheet that has the robot's signs",
        ),
    ]


def _by_source(values: Mapping[str, object]) -> str:
    return ", ".join(f"'{value}' ({source})" for source, value in values.items())


def _motors_error(motors: Mapping[str, Sequence[str]]) -> str | None:
    if len({len(names) for names in motors.values()}) > 1:
        counts = ", ".join(f"{len(names)} ({source})" for source, names in motors.items())
        return f"their numbers differ: {counts}; all must have the same"
    for index, names in enumerate(zip(*motors.values(), strict=True)):
        if len(set(names)) > 1:
            of_each = _by_source(dict(zip(motors, names, strict=True)))
            return f"motor {index} is {of_each}; names and order must be the same"
    return None


def _signs_error(motor_names: Sequence[str], signs: Mapping[str, Sequence[float] | Array]) -> str | None:
    for name, *of_motor in zip(motor_names, *signs.values(), strict=False):
        if len(set(map(float, of_motor))) > 1:
            of_each = ", ".join(f"{sign:+g} ({source})" for source, sign in zip(signs, of_motor, strict=True))
            return f"{name} has {of_each}; all must be the same"
    return None


def _check_digest(digest: str | None) -> CheckResult:
    return fail_if(
        "policy file",
        None if digest is not None else "has no digest, so nothing shows that network and contract belong together",
        "network and contract are those that were exported together",
        "export it again, or add the digest with `python -m surefoot.policy.digest FILE` if you know where the file "
        "comes from",
        digest and digest[:12],
    )


def _check_interface(contract: Contract, robot: RobotDescription) -> list[CheckResult]:
    """Compare a policy's legs, observation and gait with what the robot's description allows."""
    theirs, ours = choices(contract.leg_names), choices(robot.leg_names)
    return [
        fail_if(
            "legs",
            None
            if contract.leg_names == robot.leg_names
            else f"the policy has {theirs}, the data sheet {ours}; names and order must be the same",
            ours,
            "export the policy again with the data sheet of this robot",
        ),
        fail_if(
            "observation",
            _observation_error(contract, robot),
            f"{choices(part.name for part in contract.observation)}: all can be read from the robot's states",
            "export the policy with a surefoot of this version",
        ),
        fail_if(
            "gait",
            _gait_error(contract, robot),
            "reference, feedback and rest are within the legs' range",
            "export the policy again with the data sheet of this robot",
        ),
    ]


def _observation_error(contract: Contract, robot: RobotDescription) -> str | None:
    try:
        observer = Observer(robot, tuple(part.name for part in contract.observation), contract.action_names)
    except SurefootError as error:
        return str(error)
    if len(contract.columns) != observer.width:
        return f"the policy has {len(contract.columns)} columns, this robot {observer.width}; they must be the same"
    for index, (theirs, ours) in enumerate(zip(contract.columns, observer.columns, strict=True)):
        if theirs != ours:
            return f"column {index} is '{theirs}' in the policy and '{ours}' on this robot; they must be the same"
    for part in contract.observation:
        theirs, ours = f"{part.unit}, {part.frame}", f"{PARTS[part.name].unit}, {PARTS[part.name].frame}"
        if theirs != ours:
            return f"'{part.name}' is in {theirs} for the policy and in {ours} here; they must be the same"
    return None


def _gait_error(contract: Contract, robot: RobotDescription) -> str | None:
    try:
        _contract_gait(contract, robot)
    except SurefootError as error:
        return str(error)
    if len(contract.rest) != len(robot.coordinates):
        return f"rest has {len(contract.rest)} numbers; {robot.name} has {choices(robot.coordinates)}"
    for (name, (low, high)), unit, value in zip(
        robot.leg_space.items(), robot.leg_geometry.units, contract.rest, strict=True
    ):
        if not low - 1e-9 <= value <= high + 1e-9:
            return f"{name} at rest is {value:g} {unit}; a leg of {robot.name} allows {low:g} to {high:g}"
    return None


def _contract_gait(contract: Contract, robot: RobotDescription) -> HybridGait:
    return task_from_contract(contract, robot).gait(robot)


def _check_gains(contract: Contract, handshake: Handshake) -> CheckResult:
    kp, kd = handshake.servo_kp, handshake.servo_kd
    trained = format_gains(contract.servo_kp, contract.servo_kd)
    remedy = f"set {trained} in the firmware, or train with the robot's, servo_kp and servo_kd of its data sheet"
    return fail_if("servo gains", _gains_error(contract, kp, kd), format_gains(kp, kd), remedy, float(np.mean(kp)))


def format_gains(kp: Gains, kd: Gains) -> str:
    """Return servo gains in words."""

    def span(gain: Gains) -> str:
        least, greatest = float(np.min(gain)), float(np.max(gain))
        return f"{least:g}" if least == greatest else f"{least:g} to {greatest:g}"

    return f"kp {span(kp)} and kd {span(kd)}"


def _gains_error(contract: Contract, kp: Gains, kd: Gains) -> str | None:
    """Compare the robot's gains with those in training. The message names the first motor, if not all are alike."""
    motors = len(contract.motor_names)
    try:
        robot = [np.broadcast_to(gain, motors) for gain in (kp, kd)]
    except ValueError:
        return f"the robot states gains of {np.size(kp)} motors; the policy has {motors}"
    trained = [np.broadcast_to(gain, motors) for gain in (contract.servo_kp, contract.servo_kd)]
    wrong = [m for m in range(motors) if not all(near(x[m], y[m]) for x, y in zip(robot, trained, strict=True))]
    if not wrong:
        return None
    subject, first = "the robot's servos have", wrong[0]
    if len(wrong) < motors or any(np.ptp(gain) for gain in (*robot, *trained)):
        others = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        subject = f"motor '{contract.motor_names[first]}'{others}: the robot's servo has"
        robot, trained = ([gain[first] for gain in pair] for pair in (robot, trained))
    return (
        f"{subject} {format_gains(*robot)}; the policy was trained with {format_gains(*trained)}, "
        f"and each must be within {GAIN_TOLERANCE:.0%}"
    )


def near(value: float, target: float) -> bool:
    """Return whether a number is within `GAIN_TOLERANCE` of another one."""
    return bool(abs(value - target) <= GAIN_TOLERANCE * abs(target) + 1e-9)


def check_servo_period(robot: RobotDescription, handshake: Handshake) -> CheckResult:
    """Compare the time between two steps of the robot's servos with the data sheet."""
    period, nominal = handshake.servo_period, robot.timing.servo_step
    return judge(
        "servo period",
        near(period, nominal),
        f"{1e3 * period:g} ms",
        f"; the data sheet says {1e3 * nominal:g} ms, and it must be within {GAIN_TOLERANCE:.0%}",
        "set the firmware's servo rate, or train with a data sheet that has the robot's",
        period,
    )


def _check_control_step(contract: Contract, handshake: Handshake) -> CheckResult:
    step, servo = contract.control_step, handshake.servo_period
    least, greatest = handshake.command_period_min, handshake.command_period_max
    name, remedy = "control step", "train with a control_step that this robot takes"
    if not least - 1e-9 <= step <= greatest + 1e-9:
        error = f"{1e3 * step:g} ms; the robot takes commands every {1e3 * least:g} to {1e3 * greatest:g} ms"
        return CheckResult(name, False, error, remedy, step)
    periods = step / servo if servo > 0 else 0.0
    whole = round(periods) >= 1 and abs(periods - round(periods)) <= _STEP_SHARE
    error = f"{1e3 * step:g} ms is {periods:.2f} servo periods of {1e3 * servo:g} ms; it must be a whole number"
    return fail_if(name, None if whole else error, f"{1e3 * step:g} ms, {round(periods)} servo periods", remedy, step)


def _check_watchdog(contract: Contract, handshake: Handshake) -> CheckResult:
    timeout, least = handshake.command_timeout, WATCHDOG_STEPS * contract.control_step
    message = f"the robot damps its motors after {1e3 * timeout:g} ms without a command"
    rule = f"; it must allow {WATCHDOG_STEPS} control steps, {1e3 * least:g} ms"
    return judge("watchdog", timeout >= least - 1e-9, message, rule, "raise the firmware's command timeout", timeout)


def _check_angle_limits(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    name = "angle limits"
    alike = contract.leg_names == robot.leg_names and len(handshake.angle_low) == robot.num_motors
    if not alike or _gait_error(contract, robot) is not None:
        return skipped([name], "the policy's legs, motors or gait are not the robot's")[0]
    rest = robot.pose_angles(*contract.rest)
    least, greatest = _contract_gait(contract, robot).angle_extent()
    least, greatest = np.minimum(least, rest), np.maximum(greatest, rest)
    room = np.minimum(least - handshake.angle_low, handshake.angle_high - greatest)
    worst = int(np.argmin(room))
    message = (
        f"{robot.motor_names[worst]} can be sent to {least[worst]:.3f} to {greatest[worst]:.3f} rad; "
        f"the robot takes {handshake.angle_low[worst]:.3f} to {handshake.angle_high[worst]:.3f}"
    )
    remedy = "widen the firmware's limits if the legs allow it, or train with narrower feedback"
    return judge(name, bool(room[worst] >= -_ANGLE), message, "", remedy, float(room[worst]))
