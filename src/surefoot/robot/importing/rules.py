"""Rules for numbers of actuators that a robot's file does not state, and where the numbers of a sheet come from."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.configuration import read_toml
from surefoot.robot.archive import SHEET
from surefoot.robot.description import RobotDescription
from surefoot.robot.sheet import GRAVITY

GUESS_PREFIX = "guessed: "
"""Beginning of the comment of a number in a sheet that a rule gave."""
WARNING_PREFIX = "# likely wrong: "
"""Beginning of a line of a sheet about what is likely wrong in the file that it was made from."""
MIN_REPORTED_FACTOR = 1.5
"""Ratio from which on a file's number and the rule's are said to differ."""
_ANNOTATED_LINE = re.compile(r"^(?P<key>[a-z_]+) = (?P<value>[^#\n]+?) *# *(?P<comment>[^\n]+)$", re.MULTILINE)
_TABLES = ("motors", "leg_space", "actuator", "timing", "contact")
"""Tables of a sheet whose numbers' origins are told."""


class Rule(NamedTuple):
    """A number that follows from a robot's mass m [kg] and the length l [m] of its straight legs."""

    value: float
    text: str
    unit: str


def actuator_rules(mass: float, length: float) -> dict[str, Rule]:
    """Return the rules for joint actuators by key of the sheet; `damping_rule` has that for kd.

    The stiffness lets the untrained reference walk: at m g l two legs sink in so far that feet that swing drag.
    """
    stiffness = mass * GRAVITY * length
    return {
        "kp": Rule(1.5 * stiffness, "1.5 m g l, the stiffness with which two legs carry the robot", "N m/rad"),
        "torque_limit": Rule(0.4 * stiffness, ".4 m g l", "N m"),
        "speed_limit": Rule(6 * math.sqrt(GRAVITY / length), "6 sqrt(g / l)", "rad/s"),
        "rotor_inertia": Rule(0.005 * mass * length**2, ".005 m l^2: gear ratio squared times the rotor's", "kg m2"),
    }


def damping_rule(kp: float, length: float) -> Rule:
    """Return the rule for the damping that belongs to a stiffness [N m/rad]."""
    return Rule(0.2 * kp * math.sqrt(length / GRAVITY), ".2 kp sqrt(l / g)", "N m s/rad")


def one_line(text: str) -> str:
    """Return a text as a comment of a sheet can hold it: names in files may have line ends and control characters."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


def factor_between(values: ArrayLike, rule: float) -> float:
    """Return the greatest ratio of values over 0 to a rule's, or its inverse: 1 or more."""
    numbers: Array = np.asarray(values, float).ravel()
    numbers = numbers[numbers > 0]
    return float(np.exp(np.abs(np.log(numbers / rule))).max(initial=1.0)) if rule > 0 else 1.0


def describe_origins(robot: RobotDescription) -> Iterator[tuple[bool, str]]:
    """Yield for each number of a sheet whether a rule gave it, and key, value and origin as text.

    Where the sheet states a number of a joint actuator, and the rule's differs by more than `MIN_REPORTED_FACTOR`, the text
    says so.
    """
    path = robot.folder / SHEET
    data, text = read_toml(path)[0], path.read_text(encoding="utf-8")
    length, rules = robot.leg_geometry.length, {}
    if robot.actuator.kind == "joint":
        rules = actuator_rules(robot.urdf.total_mass, length)
        rules["kd"] = damping_rule(float(np.mean(robot.actuator.kp)), length)
    for table in _TABLES:
        start = text.find(f"\n[{table}]\n")
        part = text[start + 1 :].split("\n[", 1)[0] if start >= 0 else ""
        for found in _ANNOTATED_LINE.finditer(part):
            key, comment = found["key"], found["comment"]
            if key not in data.get(table, {}):
                continue
            where = f"{table}.{key} = {_shorten(data[table][key])}"
            if comment.startswith(GUESS_PREFIX):
                yield True, f"{where}: {comment.removeprefix(GUESSED)}"
                continue
            rule = rules.get(key) if table == "actuator" else None
            yield False, f"{where}: {comment}{_difference(data[table][key], rule)}"


def read_warnings(robot: RobotDescription) -> list[str]:
    """Return what a robot's sheet holds about its file's likely errors."""
    lines = (robot.folder / SHEET).read_text(encoding="utf-8").splitlines()
    return [line.removeprefix(WARNING_PREFIX) for line in lines if line.startswith(WARNING_PREFIX)]


def _difference(values: ArrayLike, rule: Rule | None) -> str:
    """Return the end of a line that says by how much a stated number and the rule's differ; empty if not clearly."""
    if rule is None or (factor := factor_between(values, rule.value)) <= MIN_REPORTED_FACTOR:
        return ""
    text = rule.text.partition(",")[0].partition(":")[0]
    return f"; the rule ({text}) gives {rule.value:.3g}, which differs by a factor of {factor:.2g}"


def _shorten(value: object) -> str:
    """Return a value of a sheet as text; one line, and long lists by their first items."""
    if isinstance(value, list) and len(value) > 3:
        distinct = list(dict.fromkeys(map(str, value)))
        return f"[{', '.join(distinct[:3])}{', ...' if len(distinct) > 3 else ''}]"
    return json.dumps(value)
