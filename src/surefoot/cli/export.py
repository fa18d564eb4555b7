"""`surefoot export`: write a policy as files for another framework's deployment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from surefoot.api.policies import find_policy, open_policy
from surefoot.cli.helpers.options import Json, PolicyName, check_folder
from surefoot.cli.helpers.output import print_json
from surefoot.cli.helpers.parsing import parse


@dataclass(frozen=True)
class ExportCommand:
    """Write a policy as the files that another framework deploys.

    The policy's actions must be motor angles, as for policies from `surefoot adopt`. Before anything is written, the
    angles computed by the other framework's formulas are compared with the policy's.
    """

    policy: PolicyName
    to: Annotated[Literal["rl_sar", "mjlab"], tyro.conf.arg(name="to")]
    """Framework; rl_sar: policy.onnx, config.yaml and base.yaml; mjlab: policy.onnx with its metadata."""
    out: Path
    """Folder to write to."""
    robot: str | None = None
    """Name or folder of the robot. Defaults to the policy's robot."""
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(ExportCommand, argv, "surefoot export")
    check_folder(command.out)
    path = find_policy(command.policy)
    policy, robot = open_policy(path, command.robot)
    from surefoot.adopt.exporting import EXPORTERS

    files = EXPORTERS[command.to](policy, path.read_bytes(), robot, command.out)
    if command.json:
        print_json({"policy": policy.contract.name, "robot": robot.name, "files": [str(file) for file in files]})
        return 0
    for file in files:
        print(f"wrote {file}")
    return 0
