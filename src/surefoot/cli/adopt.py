"""`surefoot adopt`: convert a third-party policy to a policy file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from surefoot.cli.helpers.options import Json
from surefoot.cli.helpers.output import print_json
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

Interval = tuple[float, float]


@dataclass(frozen=True)
class AdoptCommand:
    """Convert a policy of another framework to a policy file that all commands accept.

    The order, signs, scales, clipping limits, offsets and history of its observation become part of the network, so
    that the policy file takes raw sensor readings in SI units and returns motor angles. Files are checked before
    anything in them is executed.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Network of the policy: ONNX (.onnx), or TorchScript (.pt), which requires torch."""
    format: Annotated[Literal["rl_sar", "unitree_rl_lab", "mjlab", "legged_gym", "manual"], tyro.conf.arg(name="from")]
    """Framework for which its configuration is written."""
    out: Path
    """Policy file to write (.onnx)."""
    robot: str
    """Name of a released robot, or the folder of a robot."""
    config: Path | None = None
    """Configuration of the policy. Defaults to the framework's usual file name in the folder of FILE."""
    forward: Interval | None = None
    """Range of the forward velocity command [m/s]. Defaults to the files, or else -0.5 to 1."""
    sideways: Interval | None = None
    """Range of the sideways velocity command [m/s], left positive. Defaults to the files, or else -0.4 to 0.4."""
    yaw_rate: Interval | None = None
    """Range of the yaw rate command [rad/s]. Defaults to the files, or else -0.8 to 0.8."""
    kp: float | None = None
    """Proportional gain of all joints [N m/rad]. Defaults to the gains in the files."""
    kd: float | None = None
    """Derivative gain of all joints [N m s/rad]. Defaults to the gains in the files."""
    control_step: float | None = None
    """Time between two actions [s]. Defaults to the value in the files."""
    latency: float | None = None
    """Age of the sensor readings during training [s]. Defaults to the robot's nominal latency."""
    base_velocity: Literal["estimate"] | None = None
    """Source of the base's velocity for a policy that observes it, since no sensor measures it. estimate: an estimate
    from the IMU and the legs. Without it, such a policy is rejected."""
    trust: bool = False
    """Load TorchScript with all your privileges if this machine does not support a sandbox."""
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(AdoptCommand, argv, "surefoot adopt")
    if command.out.suffix != ".onnx":
        raise SurefootError(f"--out is {command.out}; the name must end in .onnx")
    robot = RobotDescription.load(command.robot)
    from surefoot.adopt.adoption import adopt
    from surefoot.files import atomic_write
    from surefoot.policy.runtime import PolicyRuntime

    names = ("forward", "sideways", "yaw_rate", "kp", "kd", "control_step", "latency", "base_velocity")
    changes = {name: value for name in names if (value := getattr(command, name)) is not None}
    result = adopt(command.file, command.format, robot, command.out.stem, command.config, changes, command.trust)
    contract = PolicyRuntime.parse(result.data).contract
    command.out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(command.out, result.data)
    notes = list(result.specification.notes.values())
    if command.json:
        print_json({"policy": contract.name, "robot": robot.name, "file": str(command.out), "notes": notes})
        return 0
    for note in notes:
        print(f"note: {note}")
    print(f"wrote {command.out}")
    return 0
