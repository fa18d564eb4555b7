"""Whether a contract agrees with itself: its top with the task that it carries, and both with the data sheet."""

from __future__ import annotations

import math
from typing import Any

from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.task.reference import make_reference

_TOLERANCE = 1e-9
ASSUMED = ("control_step", "servo_latency", "control_latency", "servo_kp", "servo_kd", "voltage")
"""What a task may set by name, and the contract says again at its top."""


def contradiction(contract: Contract, robot: RobotDescription) -> str | None:
    """The first place where a contract contradicts its task or the robot's data sheet; None if there is none.

    Without a word in the task, the control step must be the data sheet's: it is the one assumption that the loop on the
    robot takes over. Latencies and gains are measured, or told by the robot.
    """
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
    return _bounds(contract) or _reference(contract) or _rest(contract, robot)


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


def _reference(contract: Contract) -> str | None:
    stated = contract.task.get("reference") or {}
    kind = stated.get("kind")
    found = None if contract.reference is None else contract.reference.get("kind")
    if kind is not None and (found or "none") != kind:
        return f"its reference is of kind {found or 'none'}; its task says {kind}"
    # A table's rows stand in the contract alone: its task may name a file that is somewhere else.
    if kind != "sine":
        return None
    try:
        expected = make_reference({key: stated[key] for key in ("kind", "swing", "extension")}, contract.leg_names)
        given = make_reference(contract.reference, contract.leg_names)
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
    return None
