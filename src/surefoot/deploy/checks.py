"""What must fit before a policy may move a robot: its contract, what the robot says of itself, and the data sheet.

Everything here is a pure function of the three; nothing is asked of the robot and nothing moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from surefoot.deploy.contract_task import (
    GAIN_TOLERANCE,
    contradiction,
    gains_of,
    near,
    other_gains,
    unreadable_observation,
)
from surefoot.deploy.findings import Finding, judged, refusal
from surefoot.deploy.wire.messages import Handshake
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.reference import make_reference

__all__ = ["Finding", "check_contract", "refusal"]

WATCHDOG_STEPS = 3
"""Control steps that the robot's watchdog must bear: a late command is held for two."""
_STEP_SHARE = 0.1
"""How far a control step may be from a whole number of servo periods, in servo periods."""
_ANGLE = 1e-4
"""Angles [rad] closer than this are the same: they travel as 32-bit numbers."""


@dataclass(frozen=True)
class _Given:
    contract: Contract
    handshake: Handshake
    robot: RobotDescription
    digest: str | None


def check_contract(
    contract: Contract, handshake: Handshake, robot: RobotDescription, digest: str | None = None
) -> list[Finding]:
    """Compare a policy's contract with the robot that answers and with its data sheet; one finding a rule.

    Args:
        contract: the policy's.
        handshake: what the robot says of itself.
        robot: the data sheet that the policy's task names.
        digest: `PolicyRuntime.digest`: what shows that network and contract belong together. A policy without one
            does not pass.
    """
    given = _Given(contract, handshake, robot, digest)
    return [check(given) for check in _CHECKS]


def _digest(given: _Given) -> Finding:
    name = "policy file"
    if given.digest is None:
        return Finding(
            name,
            False,
            "has no digest, so nothing shows that network and contract belong together",
            "export it again, or add the digest with `python -m surefoot.policy.digest FILE` if you know where the "
            "file comes from",
        )
    return Finding(name, True, "network and contract are those that were exported together", value=given.digest[:12])


def _robot(given: _Given) -> Finding:
    names = (given.contract.robot, given.handshake.robot, given.robot.name)
    if len(set(names)) == 1:
        return Finding("robot", True, f"{names[0]}, firmware '{given.handshake.firmware}'", value=names[1])
    return Finding(
        "robot",
        False,
        f"the policy is for '{names[0]}', the robot says '{names[1]}', the data sheet is of '{names[2]}'; all must be "
        "the same",
        f"run a policy that was trained for '{names[1]}', or connect the robot that this one is for",
        names[1],
    )


def _motors(given: _Given) -> Finding:
    who = {
        "policy": given.contract.motor_names,
        "robot": given.handshake.motor_names,
        "data sheet": given.robot.motor_names,
    }
    todo = "put the motors in the policy's order in the firmware, or train with a data sheet that has the robot's order"
    if len({len(names) for names in who.values()}) > 1:
        counts = ", ".join(f"{name}: {len(names)}" for name, names in who.items())
        return Finding("motors", False, f"their numbers differ ({counts}); all must have the same", todo)
    for index, names in enumerate(zip(*who.values(), strict=True)):
        if len(set(names)) > 1:
            told = ", ".join(f"'{name}' ({one})" for one, name in zip(who, names, strict=True))
            return Finding("motors", False, f"motor {index} is {told}; names and order must be the same", todo)
    return Finding("motors", True, f"{len(who['robot'])}, same names in the same order")


def _signs(given: _Given) -> Finding:
    signs = (given.contract.motor_signs, given.handshake.motor_signs, given.robot.motor_sign)
    todo = "set the sign in the firmware, or train with a data sheet that has the robot's signs"
    for name, *three in zip(given.contract.motor_names, *signs, strict=False):
        if len(set(map(float, three))) > 1:
            told = "{:+g} (policy), {:+g} (robot), {:+g} (data sheet)".format(*three)
            return Finding("motor signs", False, f"{name} has {told}; all must be the same", todo)
    return Finding("motor signs", True, "same for every motor")


def _legs(given: _Given) -> Finding:
    theirs, ours = given.contract.leg_names, given.robot.leg_names
    if theirs == ours:
        return Finding("legs", True, choices(ours))
    why = f"the policy's are {choices(theirs)}, the data sheet's {choices(ours)}; names and order must be the same"
    return Finding("legs", False, why, "export the policy again with the data sheet of this robot")


def _gains(given: _Given) -> Finding:
    contract, (kp, kd) = given.contract, (given.handshake.servo_kp, given.handshake.servo_kd)
    why = other_gains(contract, kp, kd)
    if why is None:
        return Finding("servo gains", True, gains_of(kp, kd), value=kp)
    asked = gains_of(contract.servo_kp, contract.servo_kd)
    todo = f"set {asked} in the firmware, or train with servo_kp {kp:g} and servo_kd {kd:g}"
    return Finding("servo gains", False, why, todo, kp)


def _servo_period(given: _Given) -> Finding:
    theirs, ours = given.handshake.servo_period, given.robot.timing.servo_step
    if near(theirs, ours):
        return Finding("servo period", True, f"{1e3 * theirs:g} ms", value=theirs)
    return Finding(
        "servo period",
        False,
        f"the robot's servos step every {1e3 * theirs:g} ms; the data sheet says {1e3 * ours:g} ms, and it must be "
        f"within {GAIN_TOLERANCE:.0%}",
        "set the firmware's servo rate, or train with a data sheet that has the robot's",
        theirs,
    )


def _control_step(given: _Given) -> Finding:
    step, servo = given.contract.control_step, given.handshake.servo_period
    least, most = given.handshake.command_period_min, given.handshake.command_period_max
    name, todo = "control step", "train with a control_step that this robot takes"
    if not least - 1e-9 <= step <= most + 1e-9:
        why = f"{1e3 * step:g} ms; the robot takes commands every {1e3 * least:g} to {1e3 * most:g} ms"
        return Finding(name, False, why, todo, step)
    periods = step / servo
    if round(periods) < 1 or abs(periods - round(periods)) > _STEP_SHARE:
        why = f"{1e3 * step:g} ms is {periods:.2f} servo periods of {1e3 * servo:g} ms; it must be a whole number"
        return Finding(name, False, why, todo, step)
    return Finding(name, True, f"{1e3 * step:g} ms, {round(periods)} servo periods", value=step)


def _watchdog(given: _Given) -> Finding:
    timeout, step = given.handshake.command_timeout, given.contract.control_step
    why = f"the robot damps its motors after {1e3 * timeout:g} ms without a command"
    rule = f"; it must bear {WATCHDOG_STEPS} control steps, {1e3 * WATCHDOG_STEPS * step:g} ms"
    passed = timeout >= WATCHDOG_STEPS * step - 1e-9
    return judged("watchdog", passed, why, rule, "raise the firmware's command timeout", timeout)


def _angles(given: _Given) -> Finding:
    contract, robot, handshake = given.contract, given.robot, given.handshake
    name, todo = "angle limits", "widen the firmware's limits if the legs allow it, or train with narrower feedback"
    if contract.leg_names != robot.leg_names or len(handshake.angle_low) != robot.num_motors:
        return Finding(name, None, "the policy's legs and motors are not the robot's", "mend that first")
    try:
        swing, extension = make_reference(contract.reference, robot.leg_names).extent()
    except SurefootError as error:
        return Finding(name, False, f"the policy's reference can't be read: {error}", "export the policy again")
    legs = len(robot.legs)
    bounds = np.array([contract.low, contract.high])
    spans = (
        (swing[0] + bounds[0, :legs].min(), swing[1] + bounds[1, :legs].max()),
        (extension[0] + bounds[0, legs:].min(), extension[1] + bounds[1, legs:].max()),
    )
    # Motor angles are sums and differences of swing and extension: their extremes are at the corners.
    poses = [
        robot.leg_to_motor_angles(np.full(legs, s), np.full(legs, e)) for s, e in (*product(*spans), contract.rest)
    ]
    least, most = np.min(poses, axis=0), np.max(poses, axis=0)
    room = np.minimum(least - handshake.angle_low, handshake.angle_high - most)
    worst = int(np.argmin(room))
    asked = f"{robot.motor_names[worst]} can be sent to {least[worst]:.3f} to {most[worst]:.3f} rad"
    allowed = f"the robot takes {handshake.angle_low[worst]:.3f} to {handshake.angle_high[worst]:.3f}"
    passed = bool(room[worst] >= -_ANGLE)
    return Finding(name, passed, f"{asked}; {allowed}", "" if passed else todo, float(room[worst]))


def _observation(given: _Given) -> Finding:
    why = unreadable_observation(given.contract, given.robot)
    if why is not None:
        return Finding("observation", False, why, "export the policy with a surefoot of this version")
    names = [part.name for part in given.contract.observation]
    return Finding("observation", True, f"{choices(names)}: all can be read from the robot's states")


def _consistent(given: _Given) -> Finding:
    why = contradiction(given.contract, given.robot)
    if why is None:
        return Finding("contract", True, "agrees with its task and the data sheet")
    return Finding("contract", False, why, "the contract was edited or is of another task: export the policy again")


_CHECKS: tuple[Callable[[_Given], Finding], ...] = (
    *(_digest, _robot, _motors, _signs, _legs, _observation, _consistent),
    *(_gains, _servo_period, _control_step, _watchdog, _angles),
)
