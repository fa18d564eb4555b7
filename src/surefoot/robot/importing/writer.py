"""The folder of an imported robot: a URDF with frames along the base's and primitive shapes, and a sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, accessible, check_name
from surefoot.files import whole_file
from surefoot.robot.actuator import PLACEHOLDER_TORQUE
from surefoot.robot.importing.imported import LEGS, ImportedJoint, ImportedLeg, ImportedRobot, Knees
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.sheet import GRAVITY
from surefoot.robot.urdf import Joint, Link, Shape, Urdf
from surefoot.robot.urdf_file import format_urdf

_PLACEHOLDER_SPEED = 100.0
"""A speed limit [rad/s] from which on it is a placeholder."""
_Line = tuple[str, str]
"""A line of the sheet, and why it is a guess; empty for one that the file decides."""


def write_robot(robot: ImportedRobot, folder: Path, name: str, knees: Knees | None = None) -> list[str]:
    """Write a robot's folder: `robot.urdf`, and `robot.toml` with a comment at each guess.

    Args:
        robot: the robot.
        folder: an empty or new one.
        name: name of the robot.
        knees: where knees point; None: by the joints' limits.

    Returns:
        The guesses, a line each.

    Raises:
        SurefootError: an invalid name, a folder that holds a robot, or one that can't be written.
    """
    check_name("name", name)
    if (folder / "robot.toml").exists():
        raise SurefootError(f"{folder}: holds a robot; give another --out, or move it away")
    lines = _sheet(robot, name, knees)
    with accessible(folder, "made"):
        folder.mkdir(parents=True, exist_ok=True)
    _write(folder / "robot.urdf", format_urdf(_urdf(robot), name))
    _write(folder / "robot.toml", "\n".join(f"{line}  # guessed: {why}" if why else line for line, why in lines))
    return list(dict.fromkeys([*robot.notes, *(f"{line}: {why}" for line, why in lines if why)]))


def set_servo_step(folder: Path, step: float) -> str:
    """Write a shorter physics step [s] to the sheet of a robot that was just imported; return the guess as a line."""
    path, why = folder / "robot.toml", "s, the longest that servos, friction and feet allow"
    lines = path.read_text(encoding="utf-8").split("\n")
    number = next(k for k, line in enumerate(lines) if line.startswith("servo_step = "))
    lines[number] = f"servo_step = {step:g}  # guessed: {why}"
    _write(path, "\n".join(lines))
    return f"servo_step = {step:g}: {why}"


def _write(path: Path, text: str) -> None:
    with accessible(path, "written"), whole_file(path) as file:
        file.write(text.encode())


def _sheet(robot: ImportedRobot, name: str, knees: Knees | None) -> list[_Line]:
    """Return the lines of a `robot.toml`."""
    signs, certain = robot.knee_signs(knees)
    legs: list[_Line] = []
    for leg_name, leg, sign in zip(LEGS, robot.legs, signs, strict=True):
        legs += _plain(f"[legs.{leg_name}]", f"motors = {_names(leg.joints)}", f'foot = "{leg_name}_foot"')
        knee = f'knee = "{"forward" if sign > 0 else "backward"}"'
        legs += [(knee, "" if certain else "the knees' limits do not say"), ("", "")]
    step = 0.001 if robot.mass < 5 else 0.002
    return [
        *_plain(
            f"# {name}: made from {robot.path.name}, whose {robot.forward} is forward. SI units, radians.",
            "# Lines with 'guessed' are not in that file: replace them by what is known of the robot.",
            "",
            f'name = "{name}"',
            'urdf = "robot.urdf"',
            'base = "base"',
            "",
            "# In the order of commands and readings; joint angle in the URDF = sign * motor angle.",
            "[motors]",
        ),
        (f"order = {_names(_joints(robot))}", "leg by leg; take the order of the robot's own interface"),
        *_plain("", "[legs]", "order = [" + ", ".join(f'"{leg}"' for leg in LEGS) + "]", ""),
        *legs,
        *_leg_space(robot),
        ("", ""),
        *_actuator(robot),
        *_plain("", "[timing]"),
        (f"servo_step = {step}", "s, of the actuators' controllers"),
        ("control_step = 0.01", "s, between two commands of a policy"),
        ("servo_latency = 0.002", "s, age of what the actuators' controllers see"),
        ("control_latency = 0.01", "s, age of what a policy sees"),
        *_plain("", "[contact]"),
        ("friction = 0.8", "rubber on a floor"),
        ("", ""),
    ]


def _plain(*lines: str) -> list[_Line]:
    return [(line, "") for line in lines]


def _joints(robot: ImportedRobot) -> list[ImportedJoint]:
    return [joint for leg in robot.legs for joint in leg.joints]


def _names(joints: Sequence[ImportedJoint]) -> str:
    return "[" + ", ".join(f'"{joint.name}"' for joint in joints) + "]"


def _leg_space(robot: ImportedRobot) -> list[_Line]:
    """Return the ranges of commands: what all joints can do, within usual ranges."""
    low, high, aside = 0.35, 0.97, 0.5
    for leg in robot.legs:
        if (bends := leg.knee_range) is not None:
            sign = 1 if sum(bends) > 0 else -1
            bent, straight = max(sign * bend for bend in bends), max(0.0, min(sign * bend for bend in bends))
            low, high = max(low, _extension(leg, bent) + 0.02), min(high, _extension(leg, straight) - 0.01)
        if len(leg.joints) == 3 and leg.joints[0].limits:
            aside = min(aside, *map(abs, leg.joints[0].limits))
    rest = round(min(max(0.75, low + 0.05), high - 0.05), 3)
    abducts = len(robot.legs[0].joints) == 3
    return [
        *_plain(
            "# What commands may ask of legs: abduction and swing in rad, extension in lengths of the straight leg.",
            "[leg_space]",
            *([f"abduction = [{-aside:.3g}, {aside:.3g}]"] if abducts else []),
            "swing = [-1.0, 1.0]",
            f"extension = [{low:.3g}, {high:.3g}]",
        ),
        (f"rest = {[0.0] * (1 + abducts) + [rest]}", "stands with legs straight down"),
    ]


def _extension(leg: ImportedLeg, bend: float) -> float:
    """Return the distance from hip to foot at a bend of the knee [rad], over the straight leg's length."""
    upper, lower = leg.lengths
    return math.hypot(upper + lower * math.cos(bend), lower * math.sin(bend)) / (upper + lower)


def _actuator(robot: ImportedRobot) -> list[_Line]:
    joints, per_leg, torque_unit = _joints(robot), len(robot.legs[0].joints), robot.mass * GRAVITY * robot.length

    def line(key: str, values: Sequence[float], unit: str, why: str = "") -> _Line:
        """Return a line with a number for all motors, one for each motor of a leg, or one for each motor."""
        numbers = [float(f"{value:.4g}") for value in values]
        of_leg = numbers[:per_leg]
        value = numbers[0] if len(set(numbers)) == 1 else of_leg if of_leg * len(robot.legs) == numbers else numbers
        return (f"{key} = {value}", f"{why} ({unit})") if why else (f"{key} = {value}  # {unit}", "")

    def limit(
        key: str, values: Sequence[float | None], placeholder: float, usual: float, unit: str, rule: str
    ) -> tuple[list[float], _Line]:
        """Return the limits, the usual one in place of a missing one or a placeholder, and their line."""
        real = [value is not None and 0 < value < placeholder for value in values]
        limits = [float(value or 0) if ok else usual for value, ok in zip(values, real, strict=True)]
        return limits, line(key, limits, unit, "" if all(real) else f"{rule}; the file has no real limit")

    damping = 0.15 * torque_unit * math.sqrt(robot.length / GRAVITY)
    torques = [joint.torque for joint in joints]
    _, torque_line = limit(
        "torque_limit", torques, PLACEHOLDER_TORQUE * torque_unit, 0.4 * torque_unit, "N m", ".4 m g l"
    )
    speeds, speed_line = limit(
        "speed_limit",
        [joint.speed for joint in joints],
        _PLACEHOLDER_SPEED,
        6 * math.sqrt(GRAVITY / robot.length),
        "rad/s",
        "6 sqrt(g / l)",
    )
    rotors = [joint.rotor_inertia or 0.005 * robot.mass * robot.length**2 for joint in joints]
    why = "" if all(joint.rotor_inertia for joint in joints) else ".005 m l^2: gear ratio squared times the rotor's"
    return [
        *_plain("# All at the joint: after the gear.", "[actuator]", 'kind = "joint"'),
        line("kp", [torque_unit] * len(joints), "N m/rad", "m g l, the stiffness that carries the robot"),
        line("kd", [damping] * len(joints), "N m s/rad", ".15 kp sqrt(l / g)"),
        torque_line,
        speed_line,
        line("full_torque_speed", [0.5 * speed for speed in speeds], "rad/s", "half of the speed limit"),
        line("rotor_inertia", rotors, "kg m2", why),
        line("friction", [joint.friction for joint in joints], "N m, Coulomb"),
        line("viscous_friction", [joint.damping for joint in joints], "N m s/rad"),
    ]


def _urdf(robot: ImportedRobot) -> Urdf:
    """Return links with frames along the base's and shapes of their own: a box, cylinders and spheres."""
    centre, half = robot.base_box
    links = {"base": _link(robot.base, np.zeros(3), Shape("base", "box", tuple(half), _frame(centre)))}
    joints: dict[str, Joint] = {}
    for leg_name, leg in zip(LEGS, robot.legs, strict=True):
        parent, origin = "base", np.zeros(3)
        parts = ("hip", "upper", "lower")[-len(leg.joints) :]
        for part, joint, body in zip(parts, leg.joints, leg.bodies, strict=True):
            name, shapes = f"{leg_name}_{part}", []
            if part != "hip":
                end = leg.foot if part == "lower" else leg.joints[-1].place
                start = np.array([joint.place[0], end[1], joint.place[2]])
                radius = 0.06 * robot.length * (0.5 if part == "upper" else 0.3)
                shapes = [_cylinder(name, start - joint.place, end - joint.place, radius)]
            links[name] = _link(body, joint.place, *shapes)
            kind, (x, y, z) = "revolute" if joint.limits else "continuous", joint.axis.tolist()
            frame = _frame(joint.place - origin)
            joints[joint.name] = Joint(joint.name, kind, parent, name, (x, y, z), frame, joint.limits)
            parent, origin = name, joint.place
        foot, ankle = f"{leg_name}_foot", f"{leg_name}_ankle"
        sphere = Shape(foot, "sphere", (leg.foot_radius,), np.eye(4))
        links[foot] = _link(RigidBody(1e-6, np.zeros(3), 1e-10 * np.eye(3)), np.zeros(3), sphere)
        joints[ankle] = Joint(ankle, "fixed", parent, foot, (1.0, 0.0, 0.0), _frame(leg.foot - origin))
    return Urdf(robot.path, links, joints)


def _frame(place: Array) -> Array:
    frame = np.eye(4)
    frame[:3, 3] = place
    return frame


def _link(body: RigidBody, origin: Array, *shapes: Shape) -> Link:
    """Return a link whose frame is at `origin` (3,) [m]; `body` is in the base's frame."""
    return Link(replace(body, centre=body.centre - origin), shapes, shapes)


def _cylinder(link: str, start: Array, end: Array, radius: float) -> Shape:
    """Return a cylinder along the line between two points (3,) [m] of the link's frame.

    It is shorter than the line, so that shapes of one leg do not touch.
    """
    length = float(np.linalg.norm(end - start))
    z = (end - start) / length
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    frame = _frame((start + end) / 2)
    frame[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return Shape(link, "cylinder", (radius, 0.45 * length), frame)
