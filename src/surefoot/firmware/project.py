"""A robot's firmware as a folder of C: sources that all robots share, and `robot.h` with the numbers of one."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import fields
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from surefoot import __version__
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.board.signals import microseconds
from surefoot.deploy.messages import Handshake, Reason
from surefoot.deploy.serial.c_header import c_header
from surefoot.deploy.serial.codec import Codec, encodings
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.actuator import JointActuatorData

SOURCES = Path(__file__).parent
_TIME_LIMITS = ("clean_gap", "owner_timeout", "voltage_time")
"""Limits that are times, in C in microseconds."""
_STATED = ("voltage", "temperature", "tilt", "command_timeout", "command_period", "rearm_after")
"""Limits that the handshake states, and of which the program takes it."""


def firmware_handshake(robot: RobotDescription, limits: Limits) -> Handshake:
    """Return the handshake of a robot with this firmware."""
    return make_handshake(robot, limits, f"surefoot firmware {__version__}", robot.timing.servo_step)


def robot_header(robot: RobotDescription, limits: Limits | None = None, handshake: Handshake | None = None) -> str:
    """Return robot.h: handshake, limits and texts of one robot; by default those of its sheet."""
    limits = limits or Limits.from_robot(robot)
    handshake = handshake or firmware_handshake(robot, limits)
    actuator = robot.actuator
    limit = actuator.torque_limit if isinstance(actuator, JointActuatorData) else 1.0
    names = ", ".join(_text(reason.name.lower()) for reason in Reason)
    lines = [
        f"/* Numbers of {robot.name}, made by `surefoot robot firmware new` of its data sheet. Times of limits are "
        "in us. */",
        *("#ifndef ROBOT_H", "#define ROBOT_H", "", "#include <math.h>", "", '#include "surefoot_wire.h"', ""),
        f'#define ROBOT_SCHEMA_TEXT "{Codec(robot.num_motors).schema:#010x}"',
        *_limits(limits),
        *("", "static const surefoot_handshake robot_handshake = {", *_handshake(handshake), "};", ""),
        "/* Greatest duty of DC motors, or greatest torque [N m] of joint actuators. */",
        f"static const float robot_effort_limit[] = {_floats(np.broadcast_to(limit, robot.num_motors))};",
        f"static const char *const reason_names[] = {{{names}}};",
        *("", "#endif", ""),
    ]
    return "\n".join(lines)


def _limits(limits: Limits) -> list[str]:
    lines = []
    for item in fields(limits):
        name, value = f"LIMIT_{item.name.upper()}", getattr(limits, item.name)
        if item.name in _STATED:
            continue
        if isinstance(value, tuple):
            lines += [
                f"#define {name}_{end} {microseconds(one)}u" for end, one in zip(("MIN", "MAX"), value, strict=True)
            ]
        else:
            number = f"{microseconds(value)}u" if item.name in _TIME_LIMITS else _float(value)
            lines.append(f"#define {name} {f'{value}u' if isinstance(value, int) else number}")
    return lines


def _handshake(handshake: Handshake) -> list[str]:
    lines = []
    for name, spec in encodings(Handshake).items():
        value = getattr(handshake, name)
        if spec.kind == "text":
            written = _text(value) if spec.count == 1 else f"{{{', '.join(map(_text, value))}}}"
        elif spec.kind == "f32":
            written = _float(value) if spec.count == 1 else _floats(value)
        elif spec.count == 1:
            written = f"{round(value / spec.scale) if spec.scale else value}u"
        else:
            written = f"{{{', '.join(str(int(one)) for one in value)}}}"
        lines.append(f"    .{name} = {written},")
    return lines


def _text(text: str) -> str:
    """Return a string of C; anything but letters, digits and common signs as octal numbers."""
    plain = re.sub(rb"[^A-Za-z0-9 ._-]", lambda other: b"\\%03o" % ord(other.group()), text.encode())
    return f'"{plain.decode()}"'


def _float(value: Any) -> str:
    number = np.float32(value)
    return f"{number!s}f" if np.isfinite(number) else "INFINITY"


def _floats(values: Any) -> str:
    return f"{{{', '.join(map(_float, np.asarray(values, float).tolist()))}}}"


def write_sources(
    folder: Path,
    robot: RobotDescription,
    limits: Limits | None = None,
    handshake: Handshake | None = None,
    word: str = "",
) -> None:
    """Write the sources of a robot's firmware into a folder.

    `word` is what a command takes as the robot, its name by default; limits and handshake are those of its sheet.

    Raises:
        SurefootError: more motors than fit a frame.
    """
    shutil.copytree(SOURCES, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    (folder / "README.md").write_text(
        _readme(robot, limits or Limits.from_robot(robot), word or robot.name), encoding="utf-8"
    )
    (folder / "core" / "robot.h").write_text(robot_header(robot, limits, handshake), encoding="utf-8")
    (folder / "core" / "surefoot_wire.h").write_text(c_header(robot.num_motors), encoding="utf-8")


def _readme(robot: RobotDescription, limits: Limits, word: str) -> str:
    """Return the page that takes an owner from a bench to a robot."""
    joint = robot.actuator.kind == "joint"
    units = ("N m/rad", "N m s/rad") if joint else ("duty/rad", "duty s/rad")
    handshake = firmware_handshake(robot, limits)
    columns = (handshake.servo_kp, handshake.servo_kd, handshake.angle_low, handshake.angle_high)
    rows = [
        f"| {number} | {name} | {sign:+.0f} | {' | '.join(f'{column[number]:.3g}' for column in columns)} |"
        for number, (name, sign) in enumerate(zip(robot.motor_names, robot.motor_sign, strict=True))
    ]
    head = f"| | motor | sign | kp [{units[0]}] | kd [{units[1]}] | least angle [rad] | greatest angle [rad] |"
    return Template((SOURCES / "README.md").read_text(encoding="utf-8")).substitute(
        robot=robot.name,
        robot_option=word,
        motors=robot.num_motors,
        functions=len(re.findall(r"^[a-z].* \**hal_\w+\(", (SOURCES / "core" / "hal.h").read_text(), re.MULTILINE)),
        effort="a torque [N m]" if joint else "a PWM duty, -1 to 1",
        table="\n".join([head, "|---|---|---|---|---|---|---|", *rows]),
        tilt=f"{limits.tilt:g}",
        voltage=f"{limits.voltage:g}",
    )


def build_firmware(folder: Path, *variables: str, target: str = "board") -> Path:
    """Compile a firmware by its Makefile, with variables NAME=VALUE; return the path of the target.

    By default the target is its program for this computer.

    Raises:
        SurefootError: there is no `make` or no compiler, or it finds an error.
    """
    if shutil.which("make") is None:
        raise SurefootError(
            "there is no program 'make'; install it and a C compiler (Debian: apt-get install make gcc)"
        )
    done = subprocess.run(["make", "-C", str(folder), target, *variables], capture_output=True, text=True)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error:" in line.lower()] + done.stderr.splitlines()[:1]
        raise SurefootError(f"the firmware does not compile: {lines[0].strip()}")
    return folder / target
