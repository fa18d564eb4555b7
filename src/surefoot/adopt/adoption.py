"""Adopt a policy: read its files as data, and return a policy file of surefoot."""

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
from surefoot.adopt.formats.reading import match_joints
from surefoot.adopt.mistakes import fits, joint_orders
from surefoot.adopt.onnx_network import OnnxNetwork
from surefoot.adopt.onnx_weights import read_network
from surefoot.adopt.specification import PolicySpecification
from surefoot.errors import SurefootError, prefix_errors
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS


@dataclass(frozen=True)
class Format:
    """A format of policies."""

    configs: tuple[str, ...]
    """Places of its configuration as seen from the network's folder; empty, if the network has it all."""
    read: Callable[[Path, RobotDescription, Mapping[str, Any]], PolicySpecification]
    """Reads the configuration; fields that the user gives need not be in it."""


FORMATS: dict[str, Format] = {
    "rl_sar": Format(("config.yaml",), rl_sar.read),
    "unitree_rl_lab": Format(("deploy.yaml", "params/deploy.yaml", "../params/deploy.yaml"), unitree_rl_lab.read),
    "mjlab": Format((), mjlab.read),
    "legged_gym": Format(("config.py",), legged_gym.read),
    "manual": Format(("policy.yaml",), manual.read),
}


@dataclass(frozen=True)
class AdoptedPolicy:
    """A policy file, and what the user should know."""

    data: bytes
    specification: PolicySpecification


def adopt(
    path: Path,
    format_name: str,
    robot: RobotDescription,
    name: str,
    config: Path | None = None,
    changes: dict[str, Any] | None = None,
    trusted: bool = False,
) -> AdoptedPolicy:
    """Return a policy of others as a policy file.

    Args:
        path: its network: ONNX, or TorchScript.
        format_name: one of `FORMATS`.
        robot: that it is for.
        name: of the policy, where its files have none.
        config: its configuration; the format's usual file beside the network, if not given.
        changes: fields of the specification that replace those of the files.
        trusted: TorchScript may be loaded with all rights of this process.

    Raises:
        SurefootError: files that are missing, hostile, not understood, or do not fit each other or the robot.
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
        specification = replace(specification, notes={**specification.notes, **_doubts(specification)})
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
    """Refuse ranges of commands that the user gives and that do not hold 0."""
    for name in COMMANDS:
        low, high = changes.get(name) or (0.0, 0.0)
        if not low <= 0.0 <= high:
            raise SurefootError(
                f"--{name.replace('_', '-')} is {low:g} to {high:g}; it must go from 0 or less to 0 or more, since "
                "surefoot lets robots stand at command 0"
            )


def _find_config(path: Path, kind: Format, name: str, config: Path | None) -> Path:
    """Return the path of a policy's configuration: the given one, or the format's usual one."""
    if not kind.configs:
        if config is not None:
            raise SurefootError(f"--config is given; {name} has everything in the network's file")
        return path
    if config is not None:
        return config
    usual = [path.parent / place for place in kind.configs]
    found = next((one for one in usual if one.is_file()), None)
    if found is None and len(usual) > 1:
        raise SurefootError(
            f"{path}: has no {kind.configs[0]} next to it, nor in params next to its folder; give --config"
        )
    return found or usual[0]


def _stand_note(read: PolicySpecification) -> dict[str, str]:
    """Return the note about a policy that was never trained to stand, by the speeds that its file states."""
    apart = [
        f"{name.replace('_', ' ')} {low:g} to {high:g} {unit}"
        for name, unit in COMMANDS.items()
        for low, high in [getattr(read, name)]
        if not low <= 0.0 <= high
    ]
    return {"stand": f"trained at {', '.join(apart)}: standing was never trained"} if apart else {}


def _with_robots_names(specification: PolicySpecification, robot: RobotDescription) -> PolicySpecification:
    """Return a specification whose joints have the robot's names, where they differ by what frameworks add."""
    joints = specification.joints
    if {*joints} == {*robot.motor_names}:
        return specification
    found = match_joints(joints, robot.motor_names)
    if found is None or {*found} != {*robot.motor_names}:
        return specification
    note = f"names of joints: {joints[0]} is {robot.name}'s {found[0]}, and so on"
    return replace(specification, joints=found, notes={**specification.notes, "names": note})


def _doubts(specification: PolicySpecification) -> dict[str, str]:
    """Return notes about numbers that are usually others."""
    gravity = next((term for term in specification.observations if term.term == "gravity"), None)
    if gravity is None:
        return {}
    scales = np.atleast_1d(gravity.scale)
    length, doubts = float(np.abs(scales).max()), []
    if not math.isclose(length, 1.0, rel_tol=0.01):
        doubts.append(f"its length is {length:.3g}, usual is 1")
    if scales.min() < 0.0:
        doubts.append("its sign is the other one than usual: (0, 0, -1) of a level base")
    return {"gravity": f"gravity: {'; '.join(doubts)}"} if doubts else {}


def _check(specification: PolicySpecification, robot: RobotDescription) -> int:
    """Return how many numbers the network must take; an error says which usual order of joints would fit."""
    try:
        return check_specification(specification, robot)
    except SurefootError as error:
        orders = joint_orders(robot) if "default_pose" in str(error) else {}
        fitting = [name for name, order in orders.items() if fits(replace(specification, joints=order), robot)]
        hint = f"; it fits with the joints in the order {' or '.join(fitting[:2])}" if fitting else ""
        raise SurefootError(f"{error}{hint}") from error


def load_network(path: Path, data: bytes, width: int, trusted: bool = False) -> ForeignNetwork:
    """Return a network for observations of a width."""
    if path.suffix == ".onnx":
        return OnnxNetwork(data)
    if path.suffix in (".pt", ".jit", ".pth"):
        return torchscript_network.load(data, width, trusted)
    raise SurefootError(f"its name ends in {path.suffix or 'nothing'}; it must end in .onnx, or in .pt for TorchScript")
