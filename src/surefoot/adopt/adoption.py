"""Conversion of a third-party policy to a policy file of surefoot; its files are only read as data."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.adopt import torchscript_network
from surefoot.adopt.builder import ForeignNetwork, build_policy, check_specification
from surefoot.adopt.constant_inputs import constant_inputs
from surefoot.adopt.formats import legged_gym, manual, mjlab, rl_sar, unitree_rl_lab
from surefoot.adopt.formats.common import match_joints
from surefoot.adopt.mistakes import fits_robot, joint_orders
from surefoot.adopt.onnx_network import OnnxNetwork
from surefoot.adopt.onnx_weights import read_network
from surefoot.adopt.specification import PolicySpecification
from surefoot.errors import SurefootError, prefix_errors
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS


@dataclass(frozen=True)
class Format:
    """A format of third-party policies."""

    configs: tuple[str, ...]
    """Possible paths of the configuration relative to the network's folder; empty if the network file contains it."""
    read: Callable[[Path, RobotDescription, Mapping[str, Any]], PolicySpecification]
    """Reader of the configuration; fields that the user overrides may be missing in it."""


FORMATS: dict[str, Format] = {
    "rl_sar": Format(("config.yaml",), rl_sar.read),
    "unitree_rl_lab": Format(("deploy.yaml", "params/deploy.yaml", "../params/deploy.yaml"), unitree_rl_lab.read),
    "mjlab": Format((), mjlab.read),
    "legged_gym": Format(("config.py",), legged_gym.read),
    "manual": Format(("policy.yaml",), manual.read),
}


@dataclass(frozen=True)
class AdoptedPolicy:
    """An adopted policy."""

    data: bytes
    """The policy file."""
    specification: PolicySpecification
    """The specification it was built from, with notes for the user."""


def adopt(
    path: Path,
    format_name: str,
    robot: RobotDescription,
    name: str,
    config: Path | None = None,
    changes: dict[str, Any] | None = None,
    trusted: bool = False,
) -> AdoptedPolicy:
    """Convert a third-party policy to a policy file.

    Args:
        path: network file: ONNX or TorchScript.
        format_name: one of `FORMATS`.
        robot: robot that the policy is for.
        name: name of the policy, unless its files have one.
        config: configuration file; defaults to the format's usual file next to the network.
        changes: fields of the specification that override the files.
        trusted: load TorchScript with all rights of this process.

    Raises:
        SurefootError: files are missing, malicious, unsupported, or do not match each other or the robot.
    """
    kind, changes = FORMATS[format_name], changes or {}
    config = _find_config(path, kind, format_name, config)
    read = kind.read(config, robot, changes)
    notes = {name: note for name, note in read.notes.items() if name not in changes}
    specification = replace(read, **changes, notes={**notes, **_stand_note(read)})
    _check_ranges(changes)
    with prefix_errors(config):
        specification = _with_robots_names(specification, robot)
        width = _check(specification, robot)
        more = {**_gravity_note(specification), **_velocity_note(specification)}
        specification = replace(specification, notes={**specification.notes, **more})
    data = read_network(path)
    source = {"format": format_name}
    for part, content in (("network", data), ("configuration", config.read_bytes())):
        source[part] = hashlib.sha256(content).hexdigest()
    with prefix_errors(path):
        network = load_network(path, data, width, trusted)
        made = build_policy(specification, network, robot, name, source)
    constants = constant_inputs(PolicyRuntime.parse(made).contract, robot)
    if constants is not None:
        specification = replace(specification, notes={**specification.notes, "constants": constants.text})
    return AdoptedPolicy(made, specification)


def _check_ranges(changes: Mapping[str, Any]) -> None:
    """Reject command ranges of the user that do not contain 0."""
    for name in COMMANDS:
        low, high = changes.get(name) or (0.0, 0.0)
        if not low <= 0.0 <= high:
            raise SurefootError(
                f"--{name.replace('_', '-')} is {low:g} to {high:g}; it must go from 0 or less to 0 or more, since "
                "surefoot lets robots stand at command 0"
            )


def _find_config(path: Path, kind: Format, name: str, config: Path | None) -> Path:
    """Return the path of a policy's configuration file, which defaults to the format's usual file."""
    if not kind.configs:
        if config is not None:
            raise SurefootError(f"--config is given, but {name} has everything in the network's file")
        return path
    if config is not None:
        return config
    candidates = [path.parent / name for name in kind.configs]
    existing = next((candidate for candidate in candidates if candidate.is_file()), None)
    if existing is None and len(candidates) > 1:
        raise SurefootError(
            f"{path}: has no {kind.configs[0]} next to it, nor in params next to its folder; give --config"
        )
    return existing or candidates[0]


def _stand_note(read: PolicySpecification) -> dict[str, str]:
    """Return a note if the policy was never trained to stand, judging by the command ranges in its file."""
    apart = [
        f"{name.replace('_', ' ')} {low:g} to {high:g} {unit}"
        for name, unit in COMMANDS.items()
        for low, high in [getattr(read, name)]
        if not low <= 0.0 <= high
    ]
    return {"stand": f"trained at {', '.join(apart)}: standing was never trained"} if apart else {}


def _with_robots_names(specification: PolicySpecification, robot: RobotDescription) -> PolicySpecification:
    """Replace joint names by the robot's motor names, if they differ only by affixes that frameworks add."""
    joints = specification.joints
    if {*joints} == {*robot.motor_names}:
        return specification
    motors = match_joints(joints, robot.motor_names)
    if motors is None or {*motors} != {*robot.motor_names}:
        return specification
    note = f"names of joints: {joints[0]} is {robot.name}'s {motors[0]}, and so on"
    return replace(specification, joints=motors, notes={**specification.notes, "names": note})


def _gravity_note(specification: PolicySpecification) -> dict[str, str]:
    """Return a note if the scale of gravity is unusual."""
    gravity = next((term for term in specification.observations if term.term == "gravity"), None)
    if gravity is None:
        return {}
    scales = np.atleast_1d(gravity.scale)
    length, doubts = float(np.abs(scales).max()), []
    if not math.isclose(length, 1.0, rel_tol=0.01):
        doubts.append(f"its length is {length:.3g}, usually 1")
    if scales.min() < 0.0:
        doubts.append("its sign is opposite to the usual one: (0, 0, -1) of a level base")
    return {"gravity": f"gravity: {'; '.join(doubts)}"} if doubts else {}


def _velocity_note(specification: PolicySpecification) -> dict[str, str]:
    """Return a note if the velocity of the base is estimated."""
    if not specification.observes_base_velocity:
        return {}
    note = "speed of the base: estimated from the IMU and the legs; surefoot doctor compares it with the true speed"
    return {"base_velocity": note}


def _check(specification: PolicySpecification, robot: RobotDescription) -> int:
    """Return the network's expected number of inputs; an error names a usual joint order that would match."""
    try:
        return check_specification(specification, robot)
    except SurefootError as error:
        orders = joint_orders(robot) if "default_pose" in str(error) else {}
        matching = [name for name, order in orders.items() if fits_robot(replace(specification, joints=order), robot)]
        hint = f"; it fits with the joints in the order {' or '.join(matching[:2])}" if matching else ""
        raise SurefootError(f"{error}{hint}") from error


def load_network(path: Path, data: bytes, width: int, trusted: bool = False) -> ForeignNetwork:
    """Parse a network file for observations of a given width."""
    if path.suffix == ".onnx":
        return OnnxNetwork(data)
    if path.suffix in (".pt", ".jit", ".pth"):
        return torchscript_network.load(data, width, trusted)
    raise SurefootError(f"its name ends in {path.suffix or 'nothing'}; it must end in .onnx, or in .pt for TorchScript")
