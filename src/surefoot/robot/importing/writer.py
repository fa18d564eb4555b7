"""Writer of an imported robot's folder: a URDF with primitive shapes, visual meshes and a data sheet.

All link frames of the URDF are parallel to the base frame at zero angles.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, check_name, describe_os_errors
from surefoot.files import atomic_write
from surefoot.robot.appearance import VISUALS_FILE, Appearance, VisualPart, triangulate_shape, visual_shapes
from surefoot.robot.data_sheet import Leg
from surefoot.robot.importing.data_sheet_numbers import actuator, leg_space, motor_order
from surefoot.robot.importing.imported import KNEE_SIGNS, LEGS, ImportedRobot, Knees
from surefoot.robot.importing.rules import GUESS_PREFIX, WARNING_PREFIX, one_line
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.urdf import Joint, Link, Shape, Urdf
from surefoot.robot.urdf_file import format_urdf
from surefoot.rotations import rpy_matrix

URDF = "robot.urdf"
_GUESS_COMMENT = f"  # {GUESS_PREFIX}"
_NEWLINE = "\n"


def write_robot(robot: ImportedRobot, folder: Path, name: str, knees: Knees | None = None) -> list[str]:
    """Write a robot's folder: `robot.urdf`, `visuals.npz`, and `robot.toml` with a comment on each guess.

    Args:
        robot: the robot.
        folder: an empty or new folder.
        name: name of the robot.
        knees: direction of the knees; defaults to `ImportedRobot.guess_knees`.

    Returns:
        The notes and guesses, one line each.

    Raises:
        SurefootError: the name is invalid, the folder already contains a robot or can't be written.
    """
    check_name("name", name)
    if (folder / "robot.toml").exists():
        raise SurefootError(f"{folder}: already has a robot; give another --out, or move it away")
    sheet = _sheet(robot, name, knees)
    with describe_os_errors(folder, "made"):
        folder.mkdir(parents=True, exist_ok=True)
    urdf = _urdf(robot)
    _write(folder / URDF, format_urdf(urdf, name))
    if robot.parts:
        Appearance((*robot.parts, *_substitutes(robot, urdf))).save(folder / VISUALS_FILE)
    _write(folder / "robot.toml", sheet)
    guesses = [line.replace(_GUESS_COMMENT, ": ") for line in sheet.splitlines() if _GUESS_COMMENT in line]
    return list(dict.fromkeys([*robot.notes, *guesses]))


def set_servo_step(folder: Path, step: float) -> str:
    """Set a shorter physics step [s] in the data sheet of a newly imported robot; return the guess as one line."""
    line = f"servo_step = {step:g}{_GUESS_COMMENT}s, the longest that servos, friction and feet allow"
    path = folder / "robot.toml"
    _write(path, re.sub("(?m)^servo_step = .*", line, path.read_text(encoding="utf-8")))
    return line.replace(_GUESS_COMMENT, ": ")


def _write(path: Path, text: str) -> None:
    with describe_os_errors(path, "written"):
        atomic_write(path, text)


def _sheet(robot: ImportedRobot, name: str, knees: Knees | None) -> str:
    """Return the text of the data sheet."""
    guess, reason, uncertain = robot.guess_knees()
    comment = f"{_GUESS_COMMENT}{reason}" if uncertain and knees is None else ""
    legs = [
        f"""
[legs.{leg}]
motors = {json.dumps(joints)}
foot = "{leg}_foot"
knee = "{"forward" if sign > 0 else "backward"}"{comment}"""
        for leg, joints, sign in zip(LEGS, robot.joints, KNEE_SIGNS[knees or guess], strict=True)
    ]
    return f"""\
# {name}: made from {one_line(robot.path.name)}, whose {robot.forward} is forward. SI units, radians.
# Numbers with the comment 'guessed' are not in that file: replace them by the robot's own numbers.
{"".join(f"{WARNING_PREFIX}{one_line(line)}{_NEWLINE}" for line in robot.warnings)}
name = "{name}"
urdf = "robot.urdf"
base = "base"
{f'visuals = "{VISUALS_FILE}"' if robot.parts else ""}
# Order of commands and readings; joint angle in the URDF = sign * motor angle.
[motors]
{motor_order(robot)}

[legs]
order = {json.dumps(LEGS)}
{_NEWLINE.join(legs)}

# Ranges of commands: abduction and swing in rad, extension relative to the straight leg's length.
[leg_space]
{_NEWLINE.join(leg_space(robot))}

# All at the joint: after the gear.
[actuator]
kind = "joint"
{_NEWLINE.join(actuator(robot))}

[timing]
servo_step = {0.001 if robot.mass < 5 else 0.002}{_GUESS_COMMENT}s, of the actuators' controllers
control_step = 0.01{_GUESS_COMMENT}s, between two commands of a policy
servo_latency = 0.002{_GUESS_COMMENT}s, age of the readings of the actuators' controllers
control_latency = 0.01{_GUESS_COMMENT}s, age of the readings of a policy

[contact]
friction = 0.8{_GUESS_COMMENT}rubber on a floor
"""


def _substitutes(robot: ImportedRobot, urdf: Urdf) -> Iterator[VisualPart]:
    """Yield primitive shapes for links with missing meshes."""
    feet = {lower: f"{leg}_foot" for leg, (*_, lower) in zip(LEGS, robot.link_names, strict=True)}
    links = {*robot.links_without_mesh, *(feet[link] for link in robot.links_without_mesh if link in feet)}
    legs = [Leg(motors, f"{name}_foot", name=name) for name, motors in zip(LEGS, robot.joints, strict=True)]
    yield from (triangulate_shape(shape) for shape in visual_shapes(urdf, legs) if shape.link in links)


def _urdf(robot: ImportedRobot) -> Urdf:
    """Return the robot with primitive shapes (a box, cylinders and spheres) and frames parallel to the base frame."""
    centre, half = robot.base_box
    links = {"base": _link(robot.base, np.zeros(3), Shape("base", "box", tuple(half), _frame(centre)))}
    joints: dict[str, Joint] = {}
    for k, leg in enumerate(LEGS):
        parent, origin = "base", np.zeros(3)
        ends = [None, *robot.axis_points[k, -1:], robot.feet[k]][-len(robot.joints[0]) :]
        hinges = robot.axis_points[k], robot.axes[k], robot.limits[k]
        for name, joint, body, end, place, axis, limits in zip(
            robot.link_names[k], robot.joints[k], robot.bodies[k], ends, *hinges, strict=True
        ):
            shapes = []
            if end is not None:
                radius = 0.06 * robot.length * (0.5 if name.endswith("upper") else 0.3)
                shapes = [_cylinder(name, np.array([0.0, end[1] - place[1], 0.0]), end - place, radius)]
            links[name] = _link(body, place, *shapes)
            limited, (x, y, z) = bool(np.isfinite(limits).all()), axis.tolist()
            kind, span = ("revolute", (float(limits[0]), float(limits[1]))) if limited else ("continuous", None)
            joints[joint] = Joint(joint, kind, parent, name, (x, y, z), _frame(place - origin), span)
            parent, origin = name, place
        foot, ankle = f"{leg}_foot", f"{leg}_ankle"
        sphere = Shape(foot, "sphere", (float(robot.foot_radius[k]),), np.eye(4))
        links[foot] = _link(RigidBody(1e-6, np.zeros(3), 1e-10 * np.eye(3)), np.zeros(3), sphere)
        joints[ankle] = Joint(ankle, "fixed", parent, foot, (1.0, 0.0, 0.0), _frame(robot.feet[k] - origin))
    return Urdf(robot.path, links, joints)


def _frame(place: Array) -> Array:
    frame = np.eye(4)
    frame[:3, 3] = place
    return frame


def _link(body: RigidBody, origin: Array, *shapes: Shape) -> Link:
    """Return a link with its frame at `origin` (3,) [m]; `body` is in the base frame."""
    return Link(replace(body, centre=body.centre - origin), shapes, shapes)


def _cylinder(link: str, start: Array, end: Array, radius: float) -> Shape:
    """Return a cylinder between two points (3,) [m] of the link's frame that differ in x and z.

    It is a little shorter than their distance, so that shapes of one leg do not touch.
    """
    x, _, z = end - start
    frame = _frame((start + end) / 2)
    frame[:3, :3] = rpy_matrix(0.0, math.atan2(x, z), 0.0)
    return Shape(link, "cylinder", (radius, 0.45 * math.hypot(x, z)), frame)
