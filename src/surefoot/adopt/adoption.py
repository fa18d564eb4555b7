"""Adopt a policy: read its files as data, and return a policy file of surefoot."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from surefoot.adopt import torchscript_network
from surefoot.adopt.builder import ForeignNetwork, build_policy, check_specification
from surefoot.adopt.formats import legged_gym, manual, mjlab, rl_sar, unitree_rl_lab
from surefoot.adopt.mistakes import fits, joint_orders
from surefoot.adopt.onnx_network import OnnxNetwork
from surefoot.adopt.specification import PolicySpecification
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.policy.network import MAX_BYTES
from surefoot.robot import RobotDescription


@dataclass(frozen=True)
class Format:
    """A format of policies."""

    config: str
    """Name of its configuration, looked for beside the network; empty, if the network has it all."""
    read: Callable[[Path, RobotDescription], PolicySpecification]
    """Reads the configuration."""


FORMATS: dict[str, Format] = {
    "rl_sar": Format("config.yaml", rl_sar.read),
    "unitree_rl_lab": Format("deploy.yaml", unitree_rl_lab.read),
    "mjlab": Format("", mjlab.read),
    "legged_gym": Format("config.py", legged_gym.read),
    "manual": Format("policy.yaml", manual.read),
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
    kind = FORMATS[format_name]
    if not kind.config and config is not None:
        raise SurefootError(f"--config is given; {format_name} has everything in the network's file")
    config = config or (path.parent / kind.config if kind.config else path)
    read, changes = kind.read(config, robot), changes or {}
    with prefix_errors(config):
        notes = {name: note for name, note in read.notes.items() if name not in changes}
        specification = replace(read, **changes, notes=notes)
        width = _check(specification, robot)
    with describe_os_errors(path), path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    source = {"format": format_name}
    for part, content in (("network", data), ("configuration", config.read_bytes())):
        source[part] = hashlib.sha256(content).hexdigest()
    with prefix_errors(path):
        network = load_network(path, data, width, trusted)
        return AdoptedPolicy(build_policy(specification, network, robot, name, source), specification)


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
