"""`surefoot adopt`: bring in a policy that others trained."""

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

Range = tuple[float, float]


@dataclass(frozen=True)
class AdoptCommand:
    """Write a policy of another framework as a policy file that every command takes.

    Order, signs, scales, clips, offsets and histories of its observation become part of the network; the contract says
    raw readings in SI units in and motor angles out. Nothing of the files is executed before it was checked.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Its network: ONNX (.onnx), or TorchScript (.pt), which needs torch."""
    format: Annotated[Literal["rl_sar", "unitree_rl_lab", "mjlab", "legged_gym", "manual"], tyro.conf.arg(name="from")]
    """What its configuration is written for."""
    out: Path
    """Policy file to write (.onnx)."""
    robot: str
    """Name or folder of the robot's description."""
    config: Path | None = None
    """Its configuration; the format's usual name beside FILE, if not given."""
    forward: Range | None = None
    """Speeds forward that may be commanded [m/s]; as the files say, else -.5 to 1."""
    sideways: Range | None = None
    """Speeds to the left [m/s]; as the files say, else -.4 to .4."""
    yaw_rate: Range | None = None
    """Yaw rates [rad/s]; as the files say, else -.8 to .8."""
    kp: float | None = None
    """Proportional gain of all joints [N m/rad], in place of the files'."""
    kd: float | None = None
    """Derivative gain of all joints [N m s/rad], in place of the files'."""
    control_step: float | None = None
    """Time between two actions [s], in place of the files'."""
    latency: float | None = None
    """Age of the readings in training [s]; the robot's nominal one, if not given."""
    trust: bool = False
    """Load TorchScript with all your rights, where the machine can't make a process without any."""
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

    names = ("forward", "sideways", "yaw_rate", "kp", "kd", "control_step", "latency")
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
