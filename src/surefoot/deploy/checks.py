"""Checks that compare a policy, a robot's handshake and a data sheet. Nothing is sent to the robot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, judge
from surefoot.deploy.messages import Handshake
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.observation import PARTS, Observer
from surefoot.task.policy_plugins import check_plugins

Gains = float | Sequence[float] | Array
"""A gain of all motors, or one for each."""
WATCHDOG_STEPS = 3
"""Control steps that the robot's watchdog must allow: a late command is held for two."""
_STEP_TOLERANCE = 0.1
"""Greatest difference of a control step from a whole number of servo periods, in servo periods."""
_ANGLE_TOLERANCE = 1e-4
"""Tolerance of angles [rad]: they travel as 32-bit numbers."""
GAIN_TOLERANCE = 0.05
"""Greatest relative difference of servo gains and servo period from those in training."""


def check_policy(contract: Contract, robot: RobotDescription) -> None:
    """Refuse a policy that does not fit the description of a robot.

    Raises:
        SurefootError: another robot, other motors, legs or observations, or a gait that the legs do not allow.
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
                    f"'{part.name}' is in {units[0]} for the policy and in {units[1]} here; they must be the same"
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
    """Refuse a policy that sees the ground without the port of its map, or that could not stand without one.

    Raises:
        SurefootError: no port, or one that is not needed; a policy without commands.
    """
    if contract.height_map is None:
        if port is not None:
            raise SurefootError(f"--height-map is given; policy '{contract.name}' sees no map of heights")
    elif port is None:
        raise SurefootError(
            f"policy '{contract.name}' sees the ground; give --height-map PORT, to which a program sends its heights"
        )
    elif contract.commands is None:
        raise SurefootError(
            f"policy '{contract.name}' sees the ground and follows no commands; it could not stand while a map is late"
        )


def check_handshake(handshake: Handshake, robot: RobotDescription) -> list[CheckResult]:
    """Compare the robot that answers with its data sheet; one result a rule."""
    same_robot = handshake.robot == robot.name
    period, nominal = handshake.servo_period, robot.timing.servo_step
    return [
        fail_if(
            "robot",
            None if same_robot else f"it is '{handshake.robot}', the data sheet is of '{robot.name}'",
            f"{robot.name}, firmware '{handshake.firmware}'",
            "connect the robot that the policy is for, or run a policy that was trained for this robot",
            robot.name,
        ),
        fail_if(
            "motors",
            _names_error("motor", handshake.motor_names, robot.motor_names, "robot"),
            f"{robot.num_motors}, same names in the same order",
            "put the motors in the data sheet's order in the firmware, or train with a data sheet that has the robot's",
        ),
        fail_if(
            "motor signs",
            _signs_error(robot, handshake.motor_signs, "robot"),
            "same for every motor",
            "set the sign in the firmware, or train with a data sheet that has the robot's signs",
        ),
        judge(
            "servo period",
            near(period, nominal),
            f"{1e3 * period:g} ms",
            f"; the data sheet says {1e3 * nominal:g} ms, and it must be within {GAIN_TOLERANCE:.0%}",
            "set the firmware's servo rate, or train with a data sheet that has the robot's",
            period,
        ),
    ]


def check_contract(contract: Contract, handshake: Handshake, robot: RobotDescription) -> list[CheckResult]:
    """Compare a policy with the robot that answers; one result a rule.

    Args:
        contract: the policy's, which fits the robot's description.
        handshake: the robot's.
        robot: its data sheet.
    """
    return [
        *check_handshake(handshake, robot),
        _check_gains(contract, handshake),
        _check_control_step(contract, handshake),
        _check_watchdog(contract, handshake),
        _check_angle_limits(contract, handshake, robot),
    ]


def near(value: float, target: float) -> bool:
    """Return whether a number is within `GAIN_TOLERANCE` of another one."""
    return bool(abs(value - target) <= GAIN_TOLERANCE * abs(target) + 1e-9)


def format_gains(kp: Gains, kd: Gains) -> str:
    """Return servo gains in words."""

    def span(gain: Gains) -> str:
        least, greatest = float(np.min(gain)), float(np.max(gain))
        return f"{least:g}" if least == greatest else f"{least:g} to {greatest:g}"

    return f"kp {span(kp)} and kd {span(kd)}"


def _names_error(what: str, names: Sequence[str], nominal: Sequence[str], source: str) -> str | None:
    """Return the first difference between names of a policy or robot and those of the data sheet."""
    if len(names) != len(nominal):
        return f"there are {len(names)} {what}s ({source}), {len(nominal)} (data sheet); all must be the same"
    for index, (name, expected) in enumerate(zip(names, nominal, strict=True)):
        if name != expected:
            return f"{what} {index} is '{name}' ({source}), '{expected}' (data sheet); names and order must be the same"
    return None


def _grid_error(contract: Contract, robot: RobotDescription, needs_height_map: bool) -> str | None:
    """Return how the grid of a policy's map, which it has if it `needs_height_map`, differs from the robot's own."""
    grid = contract.height_map
    if (grid is not None) != needs_height_map:
        return (
            "height_map is the grid of height_scan or of footholds; it must be there with one of these, and only then"
        )
    if grid is None:
        return None
    for what, places, expected in zip(("ahead", "left"), (grid.ahead, grid.left), POLICY_GRID.scale(robot), strict=True):
        if len(places) != len(expected) or not np.allclose(places, expected, atol=1e-4):
            return f"the {len(places)} places {what} of its map are not the {len(expected)} of {robot.name} here"
    return None


def _signs_error(robot: RobotDescription, signs: Sequence[float] | Array, source: str) -> str | None:
    for name, sign, nominal in zip(robot.motor_names, signs, robot.motor_sign, strict=False):
        if sign != nominal:
            return f"{name} has {sign:+g} ({source}), {nominal:+g} (data sheet); they must be the same"
    return None


def _check_gains(contract: Contract, handshake: Handshake) -> CheckResult:
    kp, kd = handshake.servo_kp, handshake.servo_kd
    trained = format_gains(contract.servo_kp, contract.servo_kd)
    remedy = f"set {trained} in the firmware, or train with the robot's, servo_kp and servo_kd of its data sheet"
    return fail_if("servo gains", _gains_error(contract, kp, kd), format_gains(kp, kd), remedy, float(np.mean(kp)))


def _gains_error(contract: Contract, kp: Array, kd: Array) -> str | None:
    """Compare the robot's gains with those in training. The message names the first motor, if not all are alike."""
    motors = len(contract.motor_names)
    robot, trained = (kp, kd), [np.broadcast_to(gain, motors) for gain in (contract.servo_kp, contract.servo_kd)]
    wrong = [m for m in range(motors) if not all(near(x[m], y[m]) for x, y in zip(robot, trained, strict=True))]
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
    least, greatest = handshake.command_period_min, handshake.command_period_max
    name, remedy = "control step", "train with a control_step that this robot takes"
    if not least - 1e-9 <= step <= greatest + 1e-9:
        error = f"{1e3 * step:g} ms; the robot takes commands every {1e3 * least:g} to {1e3 * greatest:g} ms"
        return CheckResult(name, False, error, remedy, step)
    periods = step / servo if servo > 0 else 0.0
    whole = round(periods) >= 1 and abs(periods - round(periods)) <= _STEP_TOLERANCE
    error = f"{1e3 * step:g} ms is {periods:.2f} servo periods of {1e3 * servo:g} ms; it must be a whole number"
    return fail_if(name, None if whole else error, f"{1e3 * step:g} ms, {round(periods)} servo periods", remedy, step)


def _check_watchdog(contract: Contract, handshake: Handshake) -> CheckResult:
    timeout, least = handshake.command_timeout, WATCHDOG_STEPS * contract.control_step
    message = f"the robot damps its motors after {1e3 * timeout:g} ms without a command"
    rule = f"; it must allow {WATCHDOG_STEPS} control steps, {1e3 * least:g} ms"
    return judge("watchdog", timeout >= least - 1e-9, message, rule, "raise the firmware's command timeout", timeout)


def _check_angle_limits(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    rest = robot.pose_angles(*contract.rest)
    least, greatest = task_from_contract(contract, robot).gait(robot).angle_extent()
    least, greatest = np.minimum(least, rest), np.maximum(greatest, rest)
    room = np.minimum(least - handshake.angle_low, handshake.angle_high - greatest)
    worst = int(np.argmin(room))
    message = (
        f"{robot.motor_names[worst]} can be sent to {least[worst]:.3f} to {greatest[worst]:.3f} rad; "
        f"the robot takes {handshake.angle_low[worst]:.3f} to {handshake.angle_high[worst]:.3f}"
    )
    remedy = "widen the firmware's limits if the legs allow it, or train with narrower feedback"
    return judge("angle limits", bool(room[worst] >= -_ANGLE_TOLERANCE), message, "", remedy, float(room[worst]))
