"""`surefoot drive`: a page in the browser to steer, push and modify a simulated robot while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.helpers.options import PAGE_PORT, Host, PagePort, PolicyName, check_folder
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.simulator import SimulationOptions


@dataclass(frozen=True)
class DriveCommand(SimulationOptions):
    """Steer a simulated robot on a page in the browser.

    Options of the simulation apply to this policy; other policies selected on the page run as they were trained.
    """

    policy: PolicyName
    page_port: PagePort = PAGE_PORT
    commands: Annotated[
        str | None,
        tyro.conf.arg(
            help="Source of velocity commands instead of the page: a file (CSV: time, forward, sideways, yaw_rate), "
            "keyboard or gamepad of this terminal, or a UDP port number of this computer.",
        ),
    ] = None
    host: Host = None
    out: Path = Path("recordings")
    """Folder for recordings: traces (.npz), pages (.html) and videos (.mp4); it is created when necessary."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(DriveCommand, argv, "surefoot drive")
    check_folder(command.out)
    from surefoot.api.drive_page import DrivePage, serve

    change, folder = command.in_simulator, command.out
    drive = DrivePage(command.policy, command.world, command.robot, change, folder, command.terrain)
    serve(drive, command.host, command.page_port, command.commands)
    return 0
