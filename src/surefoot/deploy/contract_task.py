"""Whether a contract agrees with itself: its top with the task that it carries, and both with the data sheet."""

from __future__ import annotations

import math
from typing import Any

from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.gait import HybridGait
from surefoot.task.observation import PARTS, Observer
from surefoot.task.reference import make_reference

GAIN_TOLERANCE = 0.05
"""How far servo gains and servo period may be from what the policy was trained with, as a share."""
_TOLERANCE = 1e-9
ASSUMED = ("control_step", "servo_latency", "control_latency", "servo_kp", "servo_kd", "voltage")
"""What a task may set by name, and the contract says again at its top."""


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
        observer = Observer(robot, tuple(part.name for part in contract.observation))
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


def gains_of(kp: float, kd: float) -> str:
    """Servo gains in words."""
    return f"kp {kp:g} and kd {kd:g}"


def other_gains(contract: Contract, kp: float, kd: float) -> str | None:
    """Why servos with these gains are not those that a policy was trained with; None if they are."""
    if near(kp, contract.servo_kp) and near(kd, contract.servo_kd):
        return None
    return (
        f"the robot's servos have {gains_of(kp, kd)}; the policy was trained with "
        f"{gains_of(contract.servo_kp, contract.servo_kd)}, and each must be within {GAIN_TOLERANCE:.0%}"
    )


def near(one: float, other: float) -> bool:
    """Whether a number is within `GAIN_TOLERANCE` of another one."""
    return abs(one - other) <= GAIN_TOLERANCE * abs(other) + 1e-9


def _contradiction(contract: Contract, robot: RobotDescription) -> str | None:
    task = contract.task
    params: dict[str, Any] = {"control_step": robot.timing.control_step, **(task.get("params") or {})}
    for name in ASSUMED:
        if name in params and not _same(getattr(contract, name), params[name]):
            where = "its task" if name in (task.get("params") or {}) else f"the data sheet of {robot.name}"
            return f"{name} is {getattr(contract, name):g}; {where} says {params[name]:g}"
    names = [part.name for part in contract.observation]
    for name, stated in (("observations", names), ("history", contract.history)):
        if name in task and task[name] != stated:
            return f"{name} is {stated}; its task says {task[name]}"
    actions = tuple(f"{part}.{leg}" for part in ("swing", "extension") for leg in contract.leg_names)
    if contract.action_names != actions:
        return f"its actions are {list(contract.action_names)}; of these legs they must be {list(actions)}"
    return _bounds(contract) or _reference(contract, robot) or _rest(contract, robot)


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE)


def _bounds(contract: Contract) -> str | None:
    legs = len(contract.leg_names)
    for part, start in (("swing", 0), ("extension", legs)):
        stated = (contract.task.get("feedback") or {}).get(part)
        if stated is None:
            continue
        for name, bounds, expected in (("low", contract.low, stated[0]), ("high", contract.high, stated[1])):
            for value in bounds[start : start + legs]:
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
    parts = {"sine": ("swing", "extension"), "foot": ("foot",)}.get(str(kind))
    if parts is None:
        return None
    try:
        expected = make_reference({key: stated[key] for key in ("kind", *parts)}, robot)
        given = make_reference(contract.reference, robot)
    except (SurefootError, KeyError) as error:
        return f"its reference can't be read: {error}"
    if expected.to_dict() != given.to_dict():
        return "its reference gait is not the one of its task"
    return None


def _rest(contract: Contract, robot: RobotDescription) -> str | None:
    spans = (("swing", robot.swing_range), ("extension", robot.extension_range))
    for (name, (low, high)), value in zip(spans, contract.rest, strict=True):
        if not low - _TOLERANCE <= value <= high + _TOLERANCE:
            return f"{name} at rest is {value:g} rad; a leg of {robot.name} allows {low:g} to {high:g}"
    stated, where = contract.task.get("rest"), "its task says"
    if stated is None:
        legs = len(contract.leg_names)
        bounds = [(min(contract.low[part]), max(contract.high[part])) for part in (slice(legs), slice(legs, None))]
        reference = make_reference(contract.reference, robot)
        stated, where = HybridGait(robot, reference, bounds[0], bounds[1]).rest, "the middle of its commands is"
    for (name, _), value, expected in zip(spans, contract.rest, stated, strict=True):
        if not _same(value, expected):
            return f"{name} at rest is {value:g} rad; {where} {expected:g} rad"
    return None
