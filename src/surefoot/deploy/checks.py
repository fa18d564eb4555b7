"""Compatibility checks of policy, handshake of the robot, and data sheet. Nothing is sent to the robot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, pass_if
from surefoot.deploy.messages import Handshake
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.observation import PARTS, Observer
from surefoot.task.policy_plugins import check_plugins

Gains = float | Sequence[float] | Array
"""Servo gain of all motors, or of each motor."""
WATCHDOG_STEPS = 3
"""Minimum timeout of the robot's watchdog [control steps]: a late command is held for two."""
_STEP_TOLERANCE = 0.1
"""Maximum difference of a control step from a whole number of servo periods [servo periods]."""
_ANGLE_TOLERANCE = 1e-4
"""Tolerance of angles, which are sent as 32-bit floats [rad]."""
GAINS_CHECK = "servo gains"
"""Name of the check of the servos' gains."""
GAIN_TOLERANCE = 0.05
"""Maximum relative difference of servo gains and servo period from their values in training."""


def check_policy(contract: Contract, robot: RobotDescription) -> None:
    """Check that a policy matches the description of a robot.

    Raises:
        SurefootError: another robot, other motors, legs or observations, or a gait beyond the limits of the legs.
    """
    check_plugins(contract)
    with prefix_errors(f"policy '{contract.name}' must not run on {robot.name}"):
        if contract.robot != robot.name:
            raise SurefootError(f"it is for robot '{contract.robot}'")
        if (error := _signs_error(robot, contract.motor_signs, "policy")) is not None:
            raise SurefootError(error)
        observer = Observer(robot, tuple(part.name for part in contract.observation), contract.action_names)
        for what, names, nominal in (
            ("motor", contract.motor_names, robot.motor_names),
            ("leg", contract.leg_names, robot.leg_names),
            ("column", contract.columns, observer.columns),
        ):
            if (error := _names_error(what, names, nominal, "policy")) is not None:
                raise SurefootError(error)
        for part in contract.observation:
            units = [f"{p.unit}, {p.frame}" for p in (part, PARTS[part.name])]
            if units[0] != units[1]:
                raise SurefootError(
                    f"'{part.name}' is in {units[0]} in the policy and in {units[1]} here; they must be the same"
                )
        task = task_from_contract(contract, robot)
        if (error := _grid_error(contract, robot, task.needs_height_map)) is not None:
            raise SurefootError(error)
        task.gait(robot)
        if len(contract.rest) != len(robot.coordinates):
            raise SurefootError(f"rest has {len(contract.rest)} numbers; {robot.name} has {choices(robot.coordinates)}")
        for (name, (low, high)), unit, value in zip(
            robot.leg_space.items(), robot.leg_geometry.units, contract.rest, strict=True
        ):
            for number in np.atleast_1d(value):
                if not low - 1e-9 <= number <= high + 1e-9:
                    raise SurefootError(
                        f"{name} at rest is {number:g} {unit}; a leg of {robot.name} allows {low:g} to {high:g}"
                    )


def check_map(contract: Contract, port: int | None) -> None:
    """Check that a perceptive policy has a port for height maps and can stand without one, and that others have none.

    Raises:
        SurefootError: no port, a port that is not needed, or a perceptive policy without velocity commands.
    """
    if contract.height_map is None:
        if port is not None:
            raise SurefootError(f"--height-map is given; policy '{contract.name}' uses no height map")
    elif port is None:
        raise SurefootError(
            f"policy '{contract.name}' needs a height map; give --height-map PORT, to which a program sends it"
        )
    elif contract.commands is None:
        raise SurefootError(
            f"policy '{contract.name}' needs a height map but follows no commands; it cannot stand when a map is late"
        )


def check_handshake(handshake: Handshake, robot: RobotDescription) -> list[CheckResult]:
    """Compare the handshake of a robot with its data sheet; one result per rule."""
    same_robot = handshake.robot == robot.name
    period, nominal = handshake.servo_period, robot.timing.servo_step
    return [
        fail_if(
            "robot",
            None if same_robot else f"it is '{handshake.robot}'; the data sheet is for '{robot.name}'",
            f"{robot.name}, firmware '{handshake.firmware}'",
            "connect the robot that the policy is for, or run a policy that was trained for this robot",
            robot.name,
        ),
        fail_if(
            "motors",
            _names_error("motor", handshake.motor_names, robot.motor_names, "robot"),
            f"{robot.num_motors}, same names in the same order",
            "use the data sheet's motor order in the firmware, or train with a data sheet that has the robot's",
        ),
        fail_if(
            "motor signs",
            _signs_error(robot, handshake.motor_signs, "robot"),
            "same for every motor",
            "set the sign in the firmware, or train with a data sheet that has the robot's signs",
        ),
        pass_if(
            "servo period",
            is_within_tolerance(period, nominal),
            f"{1e3 * period:g} ms",
            f"; the data sheet says {1e3 * nominal:g} ms, and it must be within {GAIN_TOLERANCE:.0%}",
            "set the firmware's servo rate, or train with a data sheet that has the robot's",
            period,
        ),
    ]


def check_contract(contract: Contract, handshake: Handshake, robot: RobotDescription) -> list[CheckResult]:
    """Compare the contract of a policy with the handshake of a robot; one result per rule.

    Args:
        contract: contract of a policy that matches the robot's description.
        handshake: handshake of the robot.
        robot: description of the robot.
    """
    return [
        *check_handshake(handshake, robot),
        _check_gains(contract, handshake),
        _check_control_step(contract, handshake),
        _check_watchdog(contract, handshake),
        _check_angle_limits(contract, handshake, robot),
    ]


def is_within_tolerance(value: float, target: float) -> bool:
    """Return whether a value is within `GAIN_TOLERANCE` of a target."""
    return bool(abs(value - target) <= GAIN_TOLERANCE * abs(target) + 1e-9)


def format_gains(kp: Gains, kd: Gains) -> str:
    """Return servo gains as text."""

    def span(gain: Gains) -> str:
        low, high = float(np.min(gain)), float(np.max(gain))
        return f"{low:g}" if low == high else f"{low:g} to {high:g}"

    return f"kp {span(kp)} and kd {span(kd)}"


def _names_error(what: str, names: Sequence[str], nominal: Sequence[str], source: str) -> str | None:
    """Return the first difference between the names in a policy or robot and in the data sheet, or None."""
    if len(names) != len(nominal):
        return f"there are {len(names)} {what}s ({source}), {len(nominal)} (data sheet); they must be the same"
    for index, (name, expected) in enumerate(zip(names, nominal, strict=True)):
        if name != expected:
            return f"{what} {index} is '{name}' ({source}), '{expected}' (data sheet); names and order must be the same"
    return None


def _grid_error(contract: Contract, robot: RobotDescription, perceptive: bool) -> str | None:
    """Return how the height-map grid of a policy differs from the robot's own, or None."""
    grid = contract.height_map
    if (grid is not None) != perceptive:
        return "height_map is the grid of height_scan and footholds; it must be there with these, and only then"
    if grid is None:
        return None
    for what, places, expected in zip(
        ("ahead", "left"), (grid.ahead, grid.left), POLICY_GRID.scale(robot), strict=True
    ):
        if len(places) != len(expected) or not np.allclose(places, expected, atol=1e-4):
            return f"its height map has {len(places)} other points {what} than the {len(expected)} of {robot.name} here"
    return None


def _signs_error(robot: RobotDescription, signs: Sequence[float] | Array, source: str) -> str | None:
    for name, sign, nominal in zip(robot.motor_names, signs, robot.motor_sign, strict=False):
        if sign != nominal:
            return f"{name} has {sign:+g} ({source}), {nominal:+g} (data sheet); they must be the same"
    return None


def _check_gains(contract: Contract, handshake: Handshake) -> CheckResult:
    kp, kd = handshake.servo_kp, handshake.servo_kd
    trained = format_gains(contract.servo_kp, contract.servo_kd)
    remedy = f"set {trained} in the firmware, or set the robot's gains in its data sheet and train again"
    return fail_if(GAINS_CHECK, _gains_error(contract, kp, kd), format_gains(kp, kd), remedy, float(np.mean(kp)))


def _gains_error(contract: Contract, kp: Array, kd: Array) -> str | None:
    """Compare servo gains with their values in training; the message names the first motor unless all are alike."""
    motors = len(contract.motor_names)
    robot, trained = (kp, kd), [np.broadcast_to(gain, motors) for gain in (contract.servo_kp, contract.servo_kd)]
    pairs = list(zip(robot, trained, strict=True))
    wrong = [m for m in range(motors) if not all(is_within_tolerance(x[m], y[m]) for x, y in pairs)]
    if not wrong:
        return None
    subject, motor = "the robot's servos have", slice(None)
    if len(wrong) < motors or any(np.ptp(gain) for gain in (*robot, *trained)):
        others = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        subject = f"motor '{contract.motor_names[wrong[0]]}'{others}: the robot's servo has"
        motor = slice(wrong[0], wrong[0] + 1)
    return (
        f"{subject} {format_gains(kp[motor], kd[motor])}; the policy was trained with "
        f"{format_gains(*(gain[motor] for gain in trained))}, and each must be within {GAIN_TOLERANCE:.0%}"
    )


def _check_control_step(contract: Contract, handshake: Handshake) -> CheckResult:
    step, servo = contract.control_step, handshake.servo_period
    shortest, longest = handshake.command_period_min, handshake.command_period_max
    name, remedy = "control step", "train with a control_step that this robot accepts"
    if not shortest - 1e-9 <= step <= longest + 1e-9:
        error = f"{1e3 * step:g} ms; the robot accepts commands every {1e3 * shortest:g} to {1e3 * longest:g} ms"
        return CheckResult(name, False, error, remedy, step)
    periods = step / servo if servo > 0 else 0.0
    whole = round(periods) >= 1 and abs(periods - round(periods)) <= _STEP_TOLERANCE
    error = f"{1e3 * step:g} ms is {periods:.2f} servo periods of {1e3 * servo:g} ms; it must be a whole number"
    return fail_if(name, None if whole else error, f"{1e3 * step:g} ms, {round(periods)} servo periods", remedy, step)


def _check_watchdog(contract: Contract, handshake: Handshake) -> CheckResult:
    timeout, minimum = handshake.command_timeout, WATCHDOG_STEPS * contract.control_step
    message = f"the robot damps its motors after {1e3 * timeout:g} ms without a command"
    rule = f"; it must allow {WATCHDOG_STEPS} control steps, {1e3 * minimum:g} ms"
    return pass_if(
        "watchdog", timeout >= minimum - 1e-9, message, rule, "raise the firmware's command timeout", timeout
    )


def _check_angle_limits(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    rest = robot.pose_angles(*contract.rest)
    low, high = task_from_contract(contract, robot).gait(robot).angle_extent()
    low, high = np.minimum(low, rest), np.maximum(high, rest)
    margin = np.minimum(low - handshake.angle_low, handshake.angle_high - high)
    worst = int(np.argmin(margin))
    message = (
        f"{robot.motor_names[worst]} can be commanded to {low[worst]:.3f} to {high[worst]:.3f} rad; "
        f"the robot accepts {handshake.angle_low[worst]:.3f} to {handshake.angle_high[worst]:.3f}"
    )
    remedy = "widen the firmware's limits if the legs allow it, or train with narrower feedback"
    return pass_if("angle limits", bool(margin[worst] >= -_ANGLE_TOLERANCE), message, "", remedy, float(margin[worst]))
