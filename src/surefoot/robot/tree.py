"""A quadruped with serial legs as a tree: what a description of any format comes to, and surefoot's own from it.

All places and directions are in one frame, that of the base with all joints at zero, x forward and z up.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, accessible, check_name
from surefoot.files import whole_file
from surefoot.robot.description import GRAVITY
from surefoot.robot.rigid_body import RigidBody
from surefoot.rotations import matrix_rpy

LEGS = ("front_left", "front_right", "back_left", "back_right")
"""Names of the legs, in the order of a tree's."""
Knees = Literal["forward", "backward", "inward", "outward"]
"""Where knees point: all forward or backward, or front and back ones towards each other or apart."""
PLACEHOLDER = 5.0
"""A torque limit beyond this many m g l is a placeholder: no motor lifts the robot by five legs' lengths."""


@dataclass(frozen=True)
class MotorJoint:
    """A hinge of a leg, as the file has it."""

    name: str
    place: Array
    """A point on its axis (3,) [m]."""
    axis: Array
    """Its direction (3,), of length 1."""
    limits: tuple[float, float] | None
    """Least and greatest angle [rad]."""
    torque: float | None
    """Greatest torque [N m]."""
    speed: float | None
    """Greatest speed [rad/s]."""
    damping: float
    """N m s/rad"""
    friction: float
    """Coulomb friction [N m]."""
    rotor_inertia: float
    """kg m2"""


@dataclass(frozen=True)
class ImportedLeg:
    """A chain of hinges from the base to a foot."""

    joints: tuple[MotorJoint, ...]
    bodies: tuple[RigidBody, ...]
    """What each joint turns, up to the next one; in the base's frame."""
    foot: Array
    """Centre of the foot (3,) [m]."""
    foot_radius: float
    """[m]"""
    foot_from: str = ""
    """What the foot was found by."""


@dataclass(frozen=True)
class Tree:
    """A quadruped as a file describes it."""

    name: str
    path: Path
    base: RigidBody
    base_box: tuple[Array, Array]
    """Centre and half of the sides (3,) [m] of a box around the base."""
    legs: tuple[ImportedLeg, ...]
    """Front left, front right, back left, back right."""
    forward: str
    """Direction in the file's frame that is forward."""
    notes: tuple[str, ...] = field(default=())
    """What was guessed or left out."""

    @property
    def mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.base.mass + sum(body.mass for leg in self.legs for body in leg.bodies)

    @property
    def length(self) -> float:
        """Mean length of the straight legs [m]."""
        return float(np.mean([sum(_lengths(leg)) for leg in self.legs]))

    def knee_signs(self, knees: Knees | None) -> tuple[list[int], bool]:
        """Return 1 for each leg whose knee points forward, -1 backward; and whether the joints' limits say so."""
        if knees is not None:
            front = {"forward": 1, "backward": -1, "inward": -1, "outward": 1}[knees]
            back = {"forward": 1, "backward": -1, "inward": 1, "outward": -1}[knees]
            return [front, front, back, back], True
        found = [_bend(leg) for leg in self.legs]
        return [sign or -1 for sign in found], all(found)


def _lengths(leg: ImportedLeg) -> tuple[float, float]:
    hip, knee = (joint.place for joint in leg.joints[-2:])
    return float(np.linalg.norm((knee - hip)[[0, 2]])), float(np.linalg.norm((leg.foot - knee)[[0, 2]]))


def _straight(leg: ImportedLeg) -> float:
    """Return the angle about +y [rad] of the lower link from the upper one at zero."""
    hip, knee = (joint.place for joint in leg.joints[-2:])
    upper, lower = knee - hip, leg.foot - knee
    angle = math.atan2(-lower[0], -lower[2]) - math.atan2(-upper[0], -upper[2])
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _bends(leg: ImportedLeg) -> tuple[float, float] | None:
    """Return the least and greatest bend beta of the knee [rad] by its limits; see `serial_leg`."""
    knee = leg.joints[-1]
    if knee.limits is None or knee.limits[1] - knee.limits[0] > 2 * math.pi:
        return None
    low, high = sorted(knee.axis[1] * limit + _straight(leg) for limit in knee.limits)
    return low, high


def _bend(leg: ImportedLeg) -> int:
    """Return the sign of the middle of the knee's bend; 0 where its limits do not say."""
    bends = _bends(leg)
    if bends is None or abs(sum(bends)) < 0.2:
        return 0
    return 1 if sum(bends) > 0 else -1


def write_robot(tree: Tree, folder: Path, name: str, knees: Knees | None = None) -> list[str]:
    """Write a robot's folder: `robot.urdf` with shapes of its own, and `robot.toml` with a comment where it guesses.

    Args:
        tree: the robot.
        folder: an empty or new one.
        name: the robot's.
        knees: where knees point; by the joints' limits, if not given.

    Returns:
        The guesses, a line each.

    Raises:
        SurefootError: a name that is none, a folder that holds a robot, or one that can't be written.
    """
    check_name("name", name)
    if (folder / "robot.toml").exists():
        raise SurefootError(f"{folder}: holds a robot; give another --out, or move it away")
    sheet = _Sheet(tree, name, knees)
    text = sheet.text()
    with accessible(folder, "made"):
        folder.mkdir(parents=True, exist_ok=True)
    for file_name, content in (("robot.urdf", _urdf(tree, name)), ("robot.toml", text)):
        with accessible(folder / file_name, "written"), whole_file(folder / file_name) as file:
            file.write(content.encode())
    return list(dict.fromkeys([*tree.notes, *sheet.guesses]))


def shorten_step(folder: Path, step: float) -> str:
    """Give the sheet of a robot that was just written a shorter physics step [s]; return the guess as a line."""
    path, why = folder / "robot.toml", "s, the longest that servos, friction and feet allow"
    lines = path.read_text(encoding="utf-8").split("\n")
    place = next(k for k, line in enumerate(lines) if line.startswith("servo_step = "))
    lines[place] = f"servo_step = {step:g}  # guessed: {why}"
    with accessible(path, "written"), whole_file(path) as file:
        file.write("\n".join(lines).encode())
    return f"servo_step = {step:g}: {why}"


class _Sheet:
    """The lines of a `robot.toml`."""

    def __init__(self, tree: Tree, name: str, knees: Knees | None) -> None:
        self.tree, self.name = tree, name
        self.knees, self.knees_known = tree.knee_signs(knees)
        self.guesses: list[str] = []
        self.torque_unit = tree.mass * GRAVITY * tree.length

    def _guess(self, line: str, why: str) -> str:
        self.guesses.append(f"{line.split('#')[0].strip()}: {why}")
        return f"{line}  # guessed: {why}"

    def _motors(self) -> list[MotorJoint]:
        return [joint for leg in self.tree.legs for joint in leg.joints]

    def _each(self, key: str, values: Sequence[float], unit: str, guess: str = "") -> str:
        """Return a line with a number for all motors, one for each motor of a leg, or one for each motor."""
        per_leg = len(self.tree.legs[0].joints)
        rounded = [float(f"{value:.4g}") for value in values]
        shown = rounded if rounded[:per_leg] * len(self.tree.legs) != rounded else rounded[:per_leg]
        text = f"{key} = {shown[0] if len(set(rounded)) == 1 else shown}"
        return self._guess(text, f"{guess} ({unit})") if guess else f"{text}  # {unit}"

    def text(self) -> str:
        """Return the whole sheet."""
        tree, legs = self.tree, []
        for leg_name, leg, knee in zip(LEGS, tree.legs, self.knees, strict=True):
            motors = ", ".join(f'"{joint.name}"' for joint in leg.joints)
            line = f'knee = "{"forward" if knee > 0 else "backward"}"'
            legs += [
                f"[legs.{leg_name}]",
                f"motors = [{motors}]",
                f'foot = "{leg_name}_foot"',
                line if self.knees_known else self._guess(line, "the knees' limits do not say"),
                "",
            ]
        order = ", ".join(f'"{joint.name}"' for joint in self._motors())
        return "\n".join(
            [
                f"# {self.name}: made from {tree.path.name}, whose {tree.forward} is forward. SI units, radians.",
                "# Lines with 'guessed' are not in that file: replace them by what is known of the robot.",
                "",
                f'name = "{self.name}"',
                'urdf = "robot.urdf"',
                'base = "base"',
                "",
                "# In the order of commands and readings; joint angle in the URDF = sign * motor angle.",
                "[motors]",
                self._guess(f"order = [{order}]", "leg by leg; take the order of the robot's own interface"),
                "",
                "[legs]",
                f"order = [{', '.join(f'{chr(34)}{leg}{chr(34)}' for leg in LEGS)}]",
                "",
                *legs,
                *self._leg_space(),
                "",
                *self._actuator(),
                "",
                *self._timing(),
                "",
                "[contact]",
                self._guess("friction = 0.8", "rubber on a floor"),
                "",
            ]
        )

    def _leg_space(self) -> list[str]:
        """Return the ranges of commands: what all joints can do, and not further than usual."""
        tree = self.tree
        reaches: list[list[float]] = []
        for leg in tree.legs:
            bends, (upper, lower) = _bends(leg), _lengths(leg)
            if bends is None:
                continue
            sign = 1 if sum(bends) > 0 else -1
            most, least = (max(sign * bend for bend in bends), max(0.0, min(sign * bend for bend in bends)))
            reach = [
                math.hypot(upper + lower * math.cos(b), lower * math.sin(b)) / (upper + lower) for b in (most, least)
            ]
            reaches.append(reach)
        low = max([0.35, *(reach[0] + 0.02 for reach in reaches)])
        high = min([0.97, *(reach[1] - 0.01 for reach in reaches)])
        rest = min(max(0.75, low + 0.05), high - 0.05)
        lines = [
            "# What commands may ask of legs: abduction and swing in rad, extension in lengths of the straight leg."
        ]
        lines.append("[leg_space]")
        coordinates = [0.0, 0.0, round(rest, 3)][-len(tree.legs[0].joints) :]
        if len(tree.legs[0].joints) == 3:
            spans = [leg.joints[0].limits for leg in tree.legs if leg.joints[0].limits]
            aside = min([0.5, *(min(abs(limit) for limit in span) for span in spans)])
            lines.append(f"abduction = [{-aside:.3g}, {aside:.3g}]")
        lines += ["swing = [-1.0, 1.0]", f"extension = [{low:.3g}, {high:.3g}]"]
        lines.append(self._guess(f"rest = {coordinates}", "stands with legs straight down"))
        return lines

    def _actuator(self) -> list[str]:
        tree, motors, unit = self.tree, self._motors(), self.torque_unit
        lines = ["# All at the joint: after the gear.", "[actuator]", 'kind = "joint"']
        lines.append(self._each("kp", [unit] * len(motors), "N m/rad", "m g l, the stiffness that carries the robot"))
        kd = 0.15 * unit * math.sqrt(tree.length / GRAVITY)
        lines.append(self._each("kd", [kd] * len(motors), "N m s/rad", ".15 kp sqrt(l / g)"))
        known = [joint.torque is not None and 0 < joint.torque < PLACEHOLDER * unit for joint in motors]
        torques = [float(joint.torque or 0) if ok else 0.4 * unit for joint, ok in zip(motors, known, strict=True)]
        lines.append(
            self._each("torque_limit", torques, "N m", "" if all(known) else ".4 m g l; the file has no real limit")
        )
        fast = 100.0
        known = [joint.speed is not None and 0 < joint.speed < fast for joint in motors]
        usual = 6 * math.sqrt(GRAVITY / tree.length)
        speeds = [float(joint.speed or 0) if ok else usual for joint, ok in zip(motors, known, strict=True)]
        lines.append(
            self._each(
                "speed_limit", speeds, "rad/s", "" if all(known) else "6 sqrt(g / l); the file has no real limit"
            )
        )
        full = [0.5 * speed for speed in speeds]
        lines.append(self._each("full_torque_speed", full, "rad/s", "half of the speed limit"))
        rotors = [joint.rotor_inertia or 0.005 * tree.mass * tree.length**2 for joint in motors]
        guess = (
            "" if all(joint.rotor_inertia for joint in motors) else ".005 m l^2: gear ratio squared times the rotor's"
        )
        lines.append(self._each("rotor_inertia", rotors, "kg m2", guess))
        lines.append(self._each("friction", [joint.friction for joint in motors], "N m, Coulomb"))
        lines.append(self._each("viscous_friction", [joint.damping for joint in motors], "N m s/rad"))
        return lines

    def _timing(self) -> list[str]:
        step = 0.001 if self.tree.mass < 5 else 0.002
        lines = ["[timing]", self._guess(f"servo_step = {step}", "s, of the actuators' controllers")]
        lines.append(self._guess("control_step = 0.01", "s, between two commands of a policy"))
        lines.append(self._guess("servo_latency = 0.002", "s, age of what the actuators' controllers see"))
        lines.append(self._guess("control_latency = 0.01", "s, age of what a policy sees"))
        return lines


def _urdf(tree: Tree, name: str) -> str:
    """Return a URDF with frames along the base's and shapes of its own: a box, cylinders and spheres."""
    robot = ElementTree.Element("robot", name=name)
    centre, half = tree.base_box
    base = _link(robot, "base", tree.base, np.zeros(3))
    _shape(base, "box", centre, size=_words(2 * half))
    thick = 0.06 * tree.length
    for leg_name, leg in zip(LEGS, tree.legs, strict=True):
        parent, origin = "base", np.zeros(3)
        for place, (joint, body) in enumerate(zip(leg.joints, leg.bodies, strict=True)):
            from_end = len(leg.joints) - place
            link_name = f"{leg_name}_{('lower', 'upper', 'hip')[from_end - 1]}"
            link = _link(robot, link_name, body, joint.place)
            _joint(robot, joint, parent, link_name, joint.place - origin)
            if from_end <= 2:
                end = leg.foot if from_end == 1 else leg.joints[-1].place
                # Collinear with the link, and short of its ends, so that shapes of one leg do not touch.
                start = joint.place.copy()
                start[1] = end[1]
                _cylinder(link, start - joint.place, end - joint.place, thick * (0.5 if from_end == 2 else 0.3))
            parent, origin = link_name, joint.place
        foot = ElementTree.SubElement(robot, "link", name=f"{leg_name}_foot")
        _inertial(foot, RigidBody(1e-6, np.zeros(3), 1e-10 * np.eye(3)), np.zeros(3))
        _shape(foot, "sphere", np.zeros(3), radius=f"{leg.foot_radius:.6g}")
        fixed = ElementTree.SubElement(robot, "joint", name=f"{leg_name}_ankle", type="fixed")
        _ends(fixed, parent, f"{leg_name}_foot", leg.foot - origin)
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def _words(values: Array) -> str:
    return " ".join(f"{value:.9g}" for value in np.where(np.abs(values) < 1e-9, 0.0, values))


def _link(robot: ElementTree.Element, name: str, body: RigidBody, origin: Array) -> ElementTree.Element:
    link = ElementTree.SubElement(robot, "link", name=name)
    _inertial(link, body, origin)
    return link


def _inertial(link: ElementTree.Element, body: RigidBody, origin: Array) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_words(body.centre - origin), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=f"{body.mass:.9g}")
    tensor = {f"i{'xyz'[r]}{'xyz'[c]}": f"{body.inertia[r, c]:.9g}" for r in range(3) for c in range(r, 3)}
    ElementTree.SubElement(inertial, "inertia", tensor)


def _ends(joint: ElementTree.Element, parent: str, child: str, place: Array) -> None:
    ElementTree.SubElement(joint, "origin", xyz=_words(place), rpy="0 0 0")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)


def _joint(robot: ElementTree.Element, given: MotorJoint, parent: str, child: str, place: Array) -> None:
    joint = ElementTree.SubElement(robot, "joint", name=given.name, type="revolute" if given.limits else "continuous")
    _ends(joint, parent, child, place)
    ElementTree.SubElement(joint, "axis", xyz=_words(given.axis))
    if given.limits:
        low, high = given.limits
        ElementTree.SubElement(joint, "limit", lower=f"{low:.9g}", upper=f"{high:.9g}", effort="1000", velocity="1000")


def _shape(link: ElementTree.Element, kind: str, place: Array, rpy: str = "0 0 0", **sizes: str) -> None:
    for use in ("visual", "collision"):
        element = ElementTree.SubElement(link, use)
        ElementTree.SubElement(element, "origin", xyz=_words(place), rpy=rpy)
        ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), kind, sizes)


def _cylinder(link: ElementTree.Element, start: Array, end: Array, radius: float) -> None:
    """Add a cylinder along a link."""
    along = end - start
    length = float(np.linalg.norm(along))
    z = along / length
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rpy = _words(matrix_rpy(np.stack([x, np.cross(z, x), z], axis=1)))
    _shape(link, "cylinder", (start + end) / 2, rpy, radius=f"{radius:.6g}", length=f"{0.9 * length:.6g}")
