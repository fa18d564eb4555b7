"""`surefoot doctor`: check policy, link, robot and computer before the policy runs."""

from __future__ import annotations

import contextlib
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Annotated

from rich.console import Console
from rich.text import Text

from surefoot.api.policies import find_policy, open_policy
from surefoot.check_result import CheckResult
from surefoot.cli.helpers.link_options import LinkOptions
from surefoot.cli.helpers.options import Json, PluginNames, PolicyName, Yes, ask_to_move, check_terminal
from surefoot.cli.helpers.output import make_console, print_json
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Within
from surefoot.deploy.doctor.examination import STEPS, examine
from surefoot.deploy.doctor.link_check import PINGS
from surefoot.deploy.robot_link import LinkLostError
from surefoot.errors import SurefootError

FAILED = 3
"""Exit code when a check failed."""
_LABELS = {True: ("pass", "green"), False: ("FAIL", "bold red"), None: ("not done", "yellow")}


@dataclass(frozen=True)
class DoctorCommand(LinkOptions):
    """Check policy, link, robot and this computer, one line a check: pass, FAIL or not done, why, and what to do.

    Nothing moves without --rack or --ground. Exit code 0: all that was done passed; 3: something failed; 2: it could
    not begin, such as without a robot.
    """

    policy: PolicyName
    rack: bool = False
    """Also wiggle each motor by .05 rad: the robot hangs free, its legs in the air."""
    ground: bool = False
    """Also stand up and tilt with the legs: the robot sits on flat ground, with a metre of room."""
    yes: Yes = False
    robot: str | None = None
    """Name or folder of the robot's description; the policy's, if not given."""
    pings: Annotated[int, Within(10, 100_000)] = PINGS
    """Pings that the link is measured with."""
    steps: Annotated[int, Within(10, 100_000)] = STEPS
    """Control steps and inferences that this computer is measured with."""
    json: Json = False
    plugin: PluginNames = ()


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(DoctorCommand, argv, "surefoot doctor")
    command.check_link()
    if command.rack and command.ground:
        raise SurefootError("--rack and --ground don't go together; a robot hangs or sits: give one")
    policy, robot = open_policy(find_policy(command.policy), command.robot)
    if (command.rack or command.ground) and not command.yes:
        place = "hang free, its legs in the air" if command.rack else "sit on flat ground with a metre of room"
        check_terminal(place)
        ask_to_move(place)
    console = make_console()
    if not command.json:
        console.print(f"policy '{policy.contract.name}' for {robot.name}, {command.address}")
    link = command.open_link(robot, (policy.contract.servo_kp, policy.contract.servo_kd), may_ask=False)
    results = []
    try:
        for result in examine(link, policy, robot, command.rack, command.ground, command.pings, command.steps):
            results.append(result)
            if not command.json:
                print_result(console, result)
    finally:
        with contextlib.suppress(LinkLostError, OSError):
            link.close()
    counts = Counter(result.passed for result in results)
    if command.json:
        data = {
            "policy": policy.contract.name,
            "robot": robot.name,
            "link": command.address,
            "passed": not counts[False],
            "checks": [asdict(result) for result in results],
        }
        print_json(data)
    else:
        console.print(f"{counts[True]} passed, {counts[False]} failed, {counts[None]} not done")
    return FAILED if counts[False] else 0


def print_result(console: Console, result: CheckResult) -> None:
    """Print a result in one line. The remedy of a failed check gets a second one."""
    label, style = _LABELS[result.passed]
    remedy = f": {result.remedy}" if result.passed is None else ""
    console.print(Text.assemble((f"{label:<8}", style), f"  {result.name:<20}  {result.message}{remedy}"))
    if result.passed is False:
        console.print(Text(f"{'':<32}to do: {result.remedy}"))
