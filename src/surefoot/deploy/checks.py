"""What must fit before a policy may move a robot: its contract, what the robot says of itself, and the data sheet.

Everything here is a pure function of the three; nothing is asked of the robot and nothing moves.
"""

from __future__ import annotations

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
from surefoot.deploy.findings import Finding, compared, judged, undone
from surefoot.deploy.poses import pose
from surefoot.deploy.wire.messages import Handshake
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.reference import make_reference

WATCHDOG_STEPS = 3
"""Control steps that the robot's watchdog must bear: a late command is held for two."""
_STEP_SHARE = 0.1
"""How far a control step may be from a whole number of servo periods, in servo periods."""
_ANGLE = 1e-4
"""Angles [rad] closer than this are the same: they travel as 32-bit numbers."""


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
    return [
        _digest(digest),
        _robot(contract, handshake, robot),
        _motors(contract, handshake, robot),
        _signs(contract, handshake, robot),
        _legs(contract, robot),
        _observation(contract, robot),
        compared(
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


def _digest(digest: str | None) -> Finding:
    return compared(
        "policy file",
        None if digest is not None else "has no digest, so nothing shows that network and contract belong together",
        "network and contract are those that were exported together",
        "export it again, or add the digest with `python -m surefoot.policy.digest FILE` if you know where the file "
        "comes from",
        digest and digest[:12],
    )


def _robot(contract: Contract, handshake: Handshake, robot: RobotDescription) -> Finding:
    policys, name, sheets = contract.robot, handshake.robot, robot.name
    why = (
        f"the policy is for '{policys}', the robot says '{name}', the data sheet is of '{sheets}'; all must be the same"
    )
    todo = f"run a policy that was trained for '{name}', or connect the robot that this one is for"
    same = policys == name == sheets
    return compared("robot", None if same else why, f"{name}, firmware '{handshake.firmware}'", todo, name)


def _motors(contract: Contract, handshake: Handshake, robot: RobotDescription) -> Finding:
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
    return compared("motors", why, f"{len(robot.motor_names)}, same names in the same order", todo)


def _signs(contract: Contract, handshake: Handshake, robot: RobotDescription) -> Finding:
    signs = (contract.motor_signs, handshake.motor_signs, robot.motor_sign)
    todo = "set the sign in the firmware, or train with a data sheet that has the robot's signs"
    for name, *three in zip(contract.motor_names, *signs, strict=False):
        if len(set(map(float, three))) > 1:
            told = "{:+g} (policy), {:+g} (robot), {:+g} (data sheet)".format(*three)
            return Finding("motor signs", False, f"{name} has {told}; all must be the same", todo)
    return Finding("motor signs", True, "same for every motor")


def _legs(contract: Contract, robot: RobotDescription) -> Finding:
    theirs, ours = choices(contract.leg_names), choices(robot.leg_names)
    why = f"the policy's are {theirs}, the data sheet's {ours}; names and order must be the same"
    same = contract.leg_names == robot.leg_names
    return compared("legs", None if same else why, ours, "export the policy again with the data sheet of this robot")


def _observation(contract: Contract, robot: RobotDescription) -> Finding:
    names = choices(part.name for part in contract.observation)
    why = unreadable_observation(contract, robot)
    todo = "export the policy with a surefoot of this version"
    return compared("observation", why, f"{names}: all can be read from the robot's states", todo)


def _gains(contract: Contract, handshake: Handshake) -> Finding:
    kp, kd = handshake.servo_kp, handshake.servo_kd
    asked = gains_of(contract.servo_kp, contract.servo_kd)
    todo = f"set {asked} in the firmware, or train with servo_kp {kp:g} and servo_kd {kd:g}"
    return compared("servo gains", other_gains(contract, kp, kd), gains_of(kp, kd), todo, kp)


def _servo_period(handshake: Handshake, robot: RobotDescription) -> Finding:
    theirs, ours = handshake.servo_period, robot.timing.servo_step
    why = (
        f"the robot's servos step every {1e3 * theirs:g} ms; the data sheet says {1e3 * ours:g} ms, and it must be "
        f"within {GAIN_TOLERANCE:.0%}"
    )
    todo = "set the firmware's servo rate, or train with a data sheet that has the robot's"
    return compared("servo period", None if near(theirs, ours) else why, f"{1e3 * theirs:g} ms", todo, theirs)


def _control_step(contract: Contract, handshake: Handshake) -> Finding:
    step, servo = contract.control_step, handshake.servo_period
    least, most = handshake.command_period_min, handshake.command_period_max
    name, todo = "control step", "train with a control_step that this robot takes"
    if not least - 1e-9 <= step <= most + 1e-9:
        why = f"{1e3 * step:g} ms; the robot takes commands every {1e3 * least:g} to {1e3 * most:g} ms"
        return Finding(name, False, why, todo, step)
    periods = step / servo if servo > 0 else 0.0
    whole = round(periods) >= 1 and abs(periods - round(periods)) <= _STEP_SHARE
    why = f"{1e3 * step:g} ms is {periods:.2f} servo periods of {1e3 * servo:g} ms; it must be a whole number"
    return compared(name, None if whole else why, f"{1e3 * step:g} ms, {round(periods)} servo periods", todo, step)


def _watchdog(contract: Contract, handshake: Handshake) -> Finding:
    timeout, least = handshake.command_timeout, WATCHDOG_STEPS * contract.control_step
    told = f"the robot damps its motors after {1e3 * timeout:g} ms without a command"
    rule = f"; it must bear {WATCHDOG_STEPS} control steps, {1e3 * least:g} ms"
    return judged("watchdog", timeout >= least - 1e-9, told, rule, "raise the firmware's command timeout", timeout)


def _angles(contract: Contract, handshake: Handshake, robot: RobotDescription) -> Finding:
    name = "angle limits"
    if contract.leg_names != robot.leg_names or len(handshake.angle_low) != robot.num_motors:
        return undone([name], "the policy's legs and motors are not the robot's")[0]
    try:
        swing, extension = make_reference(contract.reference, robot).extent()
    except SurefootError as error:
        return Finding(name, False, f"the policy's reference can't be read: {error}", "export the policy again")
    legs = len(robot.legs)
    bounds = np.array([contract.low, contract.high])
    spans = (
        (swing[0] + bounds[0, :legs].min(), swing[1] + bounds[1, :legs].max()),
        (extension[0] + bounds[0, legs:].min(), extension[1] + bounds[1, legs:].max()),
    )
    # Motor angles are sums and differences of swing and extension: their extremes are at the corners.
    poses = [pose(robot, s, e) for s, e in (*product(*spans), contract.rest)]
    least, most = np.min(poses, axis=0), np.max(poses, axis=0)
    room = np.minimum(least - handshake.angle_low, handshake.angle_high - most)
    worst = int(np.argmin(room))
    asked = f"{robot.motor_names[worst]} can be sent to {least[worst]:.3f} to {most[worst]:.3f} rad"
    allowed = f"; the robot takes {handshake.angle_low[worst]:.3f} to {handshake.angle_high[worst]:.3f}"
    todo = "widen the firmware's limits if the legs allow it, or train with narrower feedback"
    return judged(name, bool(room[worst] >= -_ANGLE), asked + allowed, "", todo, float(room[worst]))
