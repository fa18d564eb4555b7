"""Rules that estimate missing actuator data of imported robots, and the origins of numbers in a data sheet."""

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
from surefoot.robot.archive import DATA_SHEET
from surefoot.robot.data_sheet import GRAVITY
from surefoot.robot.description import RobotDescription

GUESS_PREFIX = "guessed: "
"""Prefix of a data sheet's comment on a number that was estimated by a rule."""
WARNING_PREFIX = "# likely wrong: "
"""Prefix of a line in a data sheet that describes a likely error of the imported file."""
MIN_REPORTED_FACTOR = 1.5
"""Minimum ratio between a file's number and the rule's estimate for which the difference is reported."""
_ANNOTATED_LINE = re.compile(r"^(?P<key>[a-z_]+) = (?P<value>[^#\n]+?) *# *(?P<comment>[^\n]+)$", re.MULTILINE)
_ANNOTATED_TABLES = ("motors", "leg_space", "actuator", "timing", "contact")
"""Tables of a data sheet whose numbers have comments on their origin."""


class Rule(NamedTuple):
    """A number that is estimated from a robot's mass m [kg] and the length l [m] of its straight legs."""

    value: float
    text: str
    unit: str


def actuator_rules(mass: float, length: float) -> dict[str, Rule]:
    """Return the rules for joint actuators by key of the data sheet, except kd; see `damping_rule`.

    With this stiffness the untrained reference gait can walk: at m g l two legs yield so much that swing feet drag.
    """
    stiffness = mass * GRAVITY * length
    return {
        "kp": Rule(1.5 * stiffness, "1.5 m g l, so that two legs can carry the robot", "N m/rad"),
        "torque_limit": Rule(0.4 * stiffness, "0.4 m g l", "N m"),
        "speed_limit": Rule(6 * math.sqrt(GRAVITY / length), "6 sqrt(g / l)", "rad/s"),
        "rotor_inertia": Rule(0.005 * mass * length**2, "0.005 m l^2: rotor's times gear ratio squared", "kg m2"),
    }


def damping_rule(kp: float, length: float) -> Rule:
    """Return the rule for the damping kd of a controller with stiffness kp [N m/rad]."""
    return Rule(0.2 * kp * math.sqrt(length / GRAVITY), "0.2 kp sqrt(l / g)", "N m s/rad")


def one_line(text: str) -> str:
    """Return a text without line ends and control characters, which names in files may have, for a comment."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())


def factor_between(values: ArrayLike, rule: float) -> float:
    """Return the maximum factor (1 or more) by which positive values differ from a rule's estimate."""
    numbers: Array = np.asarray(values, float).ravel()
    numbers = numbers[numbers > 0]
    return float(np.exp(np.abs(np.log(numbers / rule))).max(initial=1.0)) if rule > 0 else 1.0


def describe_origins(robot: RobotDescription) -> Iterator[tuple[bool, str]]:
    """Yield for each commented number of a data sheet whether it is estimated, and key, value and origin as text.

    If a joint actuator's number from a file and the rule's estimate differ by more than `MIN_REPORTED_FACTOR`, the text
    says so.
    """
    path = robot.folder / DATA_SHEET
    data, text = read_toml(path)[0], path.read_text(encoding="utf-8")
    length, rules = robot.leg_geometry.length, {}
    if robot.actuator.kind == "joint":
        rules = actuator_rules(robot.urdf.total_mass, length)
        rules["kd"] = damping_rule(float(np.mean(robot.actuator.kp)), length)
    for table in _ANNOTATED_TABLES:
        start = text.find(f"\n[{table}]\n")
        part = text[start + 1 :].split("\n[", 1)[0] if start >= 0 else ""
        for match in _ANNOTATED_LINE.finditer(part):
            key, comment = match["key"], match["comment"]
            if key not in data.get(table, {}):
                continue
            where = f"{table}.{key} = {_shorten(data[table][key])}"
            if comment.startswith(GUESS_PREFIX):
                yield True, f"{where}: {comment.removeprefix(GUESS_PREFIX)}"
                continue
            rule = rules.get(key) if table == "actuator" else None
            yield False, f"{where}: {comment}{_difference(data[table][key], rule)}"


def read_warnings(robot: RobotDescription) -> list[str]:
    """Return the likely errors of the imported file that a robot's data sheet lists."""
    lines = (robot.folder / DATA_SHEET).read_text(encoding="utf-8").splitlines()
    return [line.removeprefix(WARNING_PREFIX) for line in lines if line.startswith(WARNING_PREFIX)]


def _difference(values: ArrayLike, rule: Rule | None) -> str:
    """Return a text on the difference between stated values and the rule's estimate, or "" if it is small."""
    if rule is None or (factor := factor_between(values, rule.value)) <= MIN_REPORTED_FACTOR:
        return ""
    text = rule.text.partition(",")[0].partition(":")[0]
    return f"; the rule ({text}) gives {rule.value:.3g}, which differs by a factor of {factor:.2g}"


def _shorten(value: object) -> str:
    """Return a value of a data sheet as one line of text; long lists are abbreviated."""
    if isinstance(value, list) and len(value) > 3:
        distinct = list(dict.fromkeys(map(str, value)))
        return f"[{', '.join(distinct[:3])}{', ...' if len(distinct) > 3 else ''}]"
    return json.dumps(value)
