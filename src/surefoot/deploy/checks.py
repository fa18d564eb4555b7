"""What must fit before a policy may move a robot: its contract, what the robot says of itself, and the data sheet.

And whether a contract agrees with itself: its top with the task that it carries, and both with the data sheet.
Everything here is a pure function of the three; nothing is asked of the robot and nothing moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, judge, skipped
from surefoot.configuration import from_mapping
from surefoot.deploy.controller import action_kind, contract_gait
from surefoot.deploy.messages import Handshake
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandConfig
from surefoot.task.gait import action_names, narrowed_bounds
from surefoot.task.observation import PARTS, Observer
from surefoot.task.reference import FOLLOWING_GAINS, make_reference

Gains = float | Sequence[float] | Array
"""A gain of all motors, or one for each."""
WATCHDOG_STEPS = 3
"""Control steps that the robot's watchdog must bear: a late command is held for two."""
_STEP_SHARE = 0.1
"""How far a control step may be from a whole number of servo periods, in servo periods."""
_ANGLE = 1e-4
"""Angles [rad] closer than this are the same: they travel as 32-bit numbers."""
GAIN_TOLERANCE = 0.05
"""How far servo gains and servo period may be from what the policy was trained with, as a share."""
_TOLERANCE = 1e-9
ASSUMED = ("control_step", "servo_latency", "control_latency", "servo_kp", "servo_kd", "voltage")
"""What a task may set by name, and the contract says again at its top."""


def check_contract(
    contract: Contract, handshake: Handshake, robot: RobotDescription, digest: str | None = None
) -> list[CheckResult]:
    """Compare a policy's contract with the robot that answers and with its data sheet; one result a rule.

    Args:
        contract: the policy's.
        handshake: what the robot says of itself.
        robot: the data sheet that the policy's task names.
        digest: `PolicyRuntime.digest`: what shows that network and contract belong together. A policy without one
            does not pass.
    """
    return [
        _digest(digest),
        _robot(contract, handshake, robot),
        _motors(contract, handshake, robot),
        _signs(contract, handshake, robot),
        _legs(contract, robot),
        _observation(contract, robot),
        fail_if(
            "contract",
            contradiction(contract, robot),
            "agrees with its task and the data sheet",
            "the contract was edited or is of another task: export the policy again",
        ),
        _gains(contract, handshake),
        _servo_period(handshake, robot),
        _control_step(contract, handshake),
        _watchdog(contract, handshake),
        _angles(contract, handshake, robot),
    ]


def _digest(digest: str | None) -> CheckResult:
    return fail_if(
        "policy file",
        None if digest is not None else "has no digest, so nothing shows that network and contract belong together",
        "network and contract are those that were exported together",
        "export it again, or add the digest with `python -m surefoot.policy.digest FILE` if you know where the file "
        "comes from",
        digest and digest[:12],
    )


def _robot(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    policys, name, sheets = contract.robot, handshake.robot, robot.name
    why = (
        f"the policy is for '{policys}', the robot says '{name}', the data sheet is of '{sheets}'; all must be the same"
    )
    todo = f"run a policy that was trained for '{name}', or connect the robot that this one is for"
    same = policys == name == sheets
    return fail_if("robot", None if same else why, f"{name}, firmware '{handshake.firmware}'", todo, name)


def _motors(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    who = {"policy": contract.motor_names, "robot": handshake.motor_names, "data sheet": robot.motor_names}
    todo = "put the motors in the policy's order in the firmware, or train with a data sheet that has the robot's order"
    why = None
    if len({len(names) for names in who.values()}) > 1:
        counts = ", ".join(f"{name}: {len(names)}" for name, names in who.items())
        why = f"their numbers differ ({counts}); all must have the same"
    else:
        for index, names in enumerate(zip(*who.values(), strict=True)):
            if len(set(names)) > 1:
                told = ", ".join(f"'{name}' ({one})" for one, name in zip(who, names, strict=True))
                why = f"motor {index} is {told}; names and order must be the same"
                break
    return fail_if("motors", why, f"{len(robot.motor_names)}, same names in the same order", todo)


def _signs(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    signs = (contract.motor_signs, handshake.motor_signs, robot.motor_sign)
    todo = "set the sign in the firmware, or train with a data sheet that has the robot's signs"
    for name, *three in zip(contract.motor_names, *signs, strict=False):
        if len(set(map(float, three))) > 1:
            told = "{:+g} (policy), {:+g} (robot), {:+g} (data sheet)".format(*three)
            return CheckResult("motor signs", False, f"{name} has {told}; all must be the same", todo)
    return CheckResult("motor signs", True, "same for every motor")


def _legs(contract: Contract, robot: RobotDescription) -> CheckResult:
    theirs, ours = choices(contract.leg_names), choices(robot.leg_names)
    why = f"the policy's are {theirs}, the data sheet's {ours}; names and order must be the same"
    same = contract.leg_names == robot.leg_names
    return fail_if("legs", None if same else why, ours, "export the policy again with the data sheet of this robot")


def _observation(contract: Contract, robot: RobotDescription) -> CheckResult:
    names = choices(part.name for part in contract.observation)
    why = unreadable_observation(contract, robot)
    todo = "export the policy with a surefoot of this version"
    return fail_if("observation", why, f"{names}: all can be read from the robot's states", todo)


def _gains(contract: Contract, handshake: Handshake) -> CheckResult:
    kp, kd = handshake.servo_kp, handshake.servo_kd
    asked = gains_of(contract.servo_kp, contract.servo_kd)
    todo = f"set {asked} in the firmware, or train with the robot's, servo_kp and servo_kd of its data sheet"
    return fail_if("servo gains", other_gains(contract, kp, kd), gains_of(kp, kd), todo, float(np.mean(kp)))


def _servo_period(handshake: Handshake, robot: RobotDescription) -> CheckResult:
    theirs, ours = handshake.servo_period, robot.timing.servo_step
    why = (
        f"the robot's servos step every {1e3 * theirs:g} ms; the data sheet says {1e3 * ours:g} ms, and it must be "
        f"within {GAIN_TOLERANCE:.0%}"
    )
    todo = "set the firmware's servo rate, or train with a data sheet that has the robot's"
    return fail_if("servo period", None if near(theirs, ours) else why, f"{1e3 * theirs:g} ms", todo, theirs)


def _control_step(contract: Contract, handshake: Handshake) -> CheckResult:
    step, servo = contract.control_step, handshake.servo_period
    least, most = handshake.command_period_min, handshake.command_period_max
    name, todo = "control step", "train with a control_step that this robot takes"
    if not least - 1e-9 <= step <= most + 1e-9:
        why = f"{1e3 * step:g} ms; the robot takes commands every {1e3 * least:g} to {1e3 * most:g} ms"
        return CheckResult(name, False, why, todo, step)
    periods = step / servo if servo > 0 else 0.0
    whole = round(periods) >= 1 and abs(periods - round(periods)) <= _STEP_SHARE
    why = f"{1e3 * step:g} ms is {periods:.2f} servo periods of {1e3 * servo:g} ms; it must be a whole number"
    return fail_if(name, None if whole else why, f"{1e3 * step:g} ms, {round(periods)} servo periods", todo, step)


def _watchdog(contract: Contract, handshake: Handshake) -> CheckResult:
    timeout, least = handshake.command_timeout, WATCHDOG_STEPS * contract.control_step
    told = f"the robot damps its motors after {1e3 * timeout:g} ms without a command"
    rule = f"; it must bear {WATCHDOG_STEPS} control steps, {1e3 * least:g} ms"
    return judge("watchdog", timeout >= least - 1e-9, told, rule, "raise the firmware's command timeout", timeout)


def _angles(contract: Contract, handshake: Handshake, robot: RobotDescription) -> CheckResult:
    name = "angle limits"
    if contract.leg_names != robot.leg_names or len(handshake.angle_low) != robot.num_motors:
        return skipped([name], "the policy's legs and motors are not the robot's")[0]
    try:
        gait = contract_gait(contract, robot)
    except SurefootError as error:
        return CheckResult(name, False, f"the policy's reference can't be read: {error}", "export the policy again")
    rest = robot.pose_angles(*contract.rest)
    least, most = gait.angle_extent()
    least, most = np.minimum(least, rest), np.maximum(most, rest)
    room = np.minimum(least - handshake.angle_low, handshake.angle_high - most)
    worst = int(np.argmin(room))
    asked = f"{robot.motor_names[worst]} can be sent to {least[worst]:.3f} to {most[worst]:.3f} rad"
    allowed = f"; the robot takes {handshake.angle_low[worst]:.3f} to {handshake.angle_high[worst]:.3f}"
    todo = "widen the firmware's limits if the legs allow it, or train with narrower feedback"
    return judge(name, bool(room[worst] >= -_ANGLE), asked + allowed, "", todo, float(room[worst]))


def contradiction(contract: Contract, robot: RobotDescription) -> str | None:
    """The first place where a contract contradicts its task or the robot's data sheet; None if there is none.

    Without a word in the task, the control step must be the data sheet's: it is the one assumption that the loop on the
    robot takes over. Latencies and gains are measured, or told by the robot.
    """
    try:
        return _contradiction(contract, robot)
    except SurefootError as error:
        return str(error)
    except (TypeError, ValueError, AttributeError, KeyError, IndexError) as error:
        return f"its task can't be read: {' '.join(str(error).split())}"


def unreadable_observation(contract: Contract, robot: RobotDescription) -> str | None:
    """Why a policy's observation is not one that this robot's readings give; None if it is."""
    try:
        observer = Observer(robot, tuple(part.name for part in contract.observation), contract.action_names)
    except SurefootError as error:
        return str(error)
    if tuple(observer.columns) != contract.columns:
        pairs = zip(contract.columns, observer.columns, strict=False)
        index, (theirs, ours) = next(
            ((i, pair) for i, pair in enumerate(pairs) if pair[0] != pair[1]),
            (0, (f"{len(contract.columns)} columns", f"{len(observer.columns)} columns")),
        )
        return f"column {index} is '{theirs}' in the policy and '{ours}' on this robot; they must be the same"
    for part in contract.observation:
        theirs, ours = f"{part.unit}, {part.frame}", f"{PARTS[part.name].unit}, {PARTS[part.name].frame}"
        if theirs != ours:
            return f"'{part.name}' is in {theirs} for the policy and in {ours} here; they must be the same"
    return None


def gains_of(kp: Gains, kd: Gains) -> str:
    """Servo gains in words."""

    def shown(gain: Gains) -> str:
        least, most = float(np.min(gain)), float(np.max(gain))
        return f"{least:g}" if least == most else f"{least:g} to {most:g}"

    return f"kp {shown(kp)} and kd {shown(kd)}"


def other_gains(contract: Contract, kp: Gains, kd: Gains) -> str | None:
    """Why servos with these gains, of all motors or of each, are not those that a policy was trained with, or None.

    Where not all motors are alike, it names the first one that differs.
    """
    motors = len(contract.motor_names)
    stated = contract.servo_kp, contract.servo_kd
    try:
        ours, theirs = ([np.broadcast_to(gain, motors) for gain in pair] for pair in ((kp, kd), stated))
    except ValueError:
        return f"the robot states gains of {np.size(kp)} motors; the policy has {motors}"
    wrong = [m for m in range(motors) if not all(near(x[m], y[m]) for x, y in zip(ours, theirs, strict=True))]
    if not wrong:
        return None
    who, first = "the robot's servos have", wrong[0]
    if len(wrong) < motors or any(np.ptp(gain) for gain in (*ours, *theirs)):
        others = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        who = f"motor '{contract.motor_names[first]}'{others}: the robot's servo has"
        ours, theirs = ([gain[first] for gain in pair] for pair in (ours, theirs))
    return (
        f"{who} {gains_of(*ours)}; the policy was trained with {gains_of(*theirs)}, "
        f"and each must be within {GAIN_TOLERANCE:.0%}"
    )


def near(one: Gains, other: Gains) -> bool:
    """Whether a number, or each of several, is within `GAIN_TOLERANCE` of another one."""
    given, wanted = np.atleast_1d(one), np.atleast_1d(other)
    if 1 not in (len(given), len(wanted)) and len(given) != len(wanted):
        return False
    return bool(np.all(np.abs(given - wanted) <= GAIN_TOLERANCE * np.abs(wanted) + 1e-9))


def _contradiction(contract: Contract, robot: RobotDescription) -> str | None:
    task = contract.task
    params: dict[str, Any] = {"control_step": robot.timing.control_step, **(task.get("params") or {})}
    for name in ASSUMED:
        if name in params and not _same(getattr(contract, name), params[name]):
            where = "its task" if name in (task.get("params") or {}) else f"the data sheet of {robot.name}"
            return f"{name} is {getattr(contract, name)}; {where} says {params[name]}"
    names = [part.name for part in contract.observation]
    for name, stated in (("observations", names), ("history", contract.history)):
        if name in task and task[name] != stated:
            return f"{name} is {stated}; its task says {task[name]}"
    actions = tuple(action_names(robot, action_kind(contract)))
    if contract.action_names != actions:
        return f"its actions are {list(contract.action_names)}; of these legs they must be {list(actions)}"
    return (
        _commands(contract, robot) or _reference(contract, robot) or _bounds(contract, robot) or _rest(contract, robot)
    )


def _same(one: Gains, other: Gains) -> bool:
    given, wanted = np.atleast_1d(one), np.atleast_1d(other)
    return given.shape == wanted.shape and np.allclose(given, wanted, rtol=_TOLERANCE, atol=_TOLERANCE)


def _commands(contract: Contract, robot: RobotDescription) -> str | None:
    try:
        expected = from_mapping(CommandConfig, contract.task.get("commands") or {}, "commands").limits(robot)
    except SurefootError as error:
        return f"its task's commands can't be read: {error}"
    if expected != contract.commands:
        return "its commands are not those of its task"
    return None


def _bounds(contract: Contract, robot: RobotDescription) -> str | None:
    feedback = dict(contract.task.get("feedback") or {})
    if (contract.task.get("reference") or {}).get("relative") and all(part in feedback for part in robot.coordinates):
        reference = make_reference(contract.reference, robot, contract.commands)
        given = [tuple(feedback[part]) for part in robot.coordinates]
        feedback |= dict(zip(robot.coordinates, narrowed_bounds(given, reference, robot), strict=True))
    for action, low, high in zip(contract.action_names, contract.low, contract.high, strict=True):
        part = action.split(".")[0]
        stated = feedback.get(part)
        if stated is None:
            continue
        for name, value, expected in (("low", low, stated[0]), ("high", high, stated[1])):
            if not _same(value, expected):
                return f"{name} of {part} is {value:g}; its task says {expected:g}"
    return None


def _reference(contract: Contract, robot: RobotDescription) -> str | None:
    stated = contract.task.get("reference") or {}
    kind = stated.get("kind")
    found = None if contract.reference is None else contract.reference.get("kind")
    if kind is not None and (found or "none") != kind:
        return f"its reference is of kind {found or 'none'}; its task says {kind}"
    # A table's rows stand in the contract alone: its task may name a file that is somewhere else.
    foot = ("foot", "relative", "velocity_feedforward")
    parts = {"sine": robot.coordinates, "foot": foot, "follow": (*foot, *FOLLOWING_GAINS)}.get(str(kind))
    if parts is None:
        return None
    try:
        named = {key: stated[key] for key in ("kind", *parts) if key in stated}
        expected = make_reference(named, robot, contract.commands)
        given = make_reference(contract.reference, robot, contract.commands)
    except (SurefootError, KeyError) as error:
        return f"its reference can't be read: {error}"
    if expected.to_dict() != given.to_dict():
        return "its reference gait is not the one of its task"
    return None


def _rest(contract: Contract, robot: RobotDescription) -> str | None:
    if len(contract.rest) != len(robot.coordinates):
        return f"its pose at rest has {len(contract.rest)} numbers; {robot.name} has {choices(robot.coordinates)}"
    spans = list(zip(robot.leg_space.items(), robot.leg_geometry.units, strict=True))
    for ((name, (low, high)), unit), value in zip(spans, contract.rest, strict=True):
        if not low - _TOLERANCE <= value <= high + _TOLERANCE:
            return f"{name} at rest is {value:g} {unit}; a leg of {robot.name} allows {low:g} to {high:g}"
    stated, where = contract.task.get("rest"), "its task says"
    if stated is None:
        stated, where = contract_gait(contract, robot).rest, "the middle of its commands is"
    for ((name, _), unit), value, expected in zip(spans, contract.rest, stated, strict=True):
        if not _same(value, expected):
            return f"{name} at rest is {value:g} {unit}; {where} {expected:g} {unit}"
    return None
