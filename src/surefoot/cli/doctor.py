"""`surefoot doctor`: check policy, link, robot and computer before the policy runs."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.text import Text

from surefoot.api.policies import find_policy, open_policy
from surefoot.check_result import CheckResult
from surefoot.cli.helpers.link_options import LinkOptions
from surefoot.cli.helpers.options import (
    PLACES,
    Json,
    PluginNames,
    PolicyName,
    Seed,
    Threads,
    World,
    Yes,
    ask_to_move,
    changed_option,
    check_terminal,
)
from surefoot.cli.helpers.output import make_console, print_json, print_warning
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Within
from surefoot.deploy.doctor.examination import STEPS, examine
from surefoot.deploy.doctor.link_check import PINGS
from surefoot.deploy.robot_link import close_link
from surefoot.errors import SurefootError

FAILED = 3
"""Exit code if a check failed."""
_LABELS = {True: ("pass", "green"), False: ("FAIL", "bold red"), None: ("not done", "yellow")}


@dataclass(frozen=True)
class DoctorCommand(LinkOptions):
    """Check a policy, the link, the robot and this computer; print one line per check with the reason and the remedy.

    Motors move only with --rack or --ground. Without a robot (no --port), an adopted policy is simulated instead: does
    it stand and follow commands, and if not, which common mistake in its configuration explains it? Exit codes: 0: all
    checks that were done passed; 3: a check failed; 2: the checks could not start, such as without a robot.
    """

    policy: PolicyName
    rack: bool = False
    """Also move each motor by 0.05 to 0.15 rad, after legs with abduction have moved apart; the robot must hang freely,
    with its legs in the air."""
    ground: bool = False
    """Also stand up and tilt the body; the robot must sit on flat ground with a metre of free space."""
    yes: Yes = False
    robot: str | None = None
    """Name or folder of the robot. Defaults to the policy's robot."""
    pings: Annotated[int, Within(10, 100_000)] = PINGS
    """Number of pings for the measurement of the link."""
    steps: Annotated[int, Within(10, 100_000)] = STEPS
    """Number of control steps and inferences for the measurement of this computer."""
    json: Json = False
    plugin: PluginNames = ()
    world: World = "mujoco"
    seed: Seed = 0
    threads: Threads = 0
    out: Path | None = None
    """Folder for a report of that simulation, with videos."""
    correct: Path | None = None
    """File (.yaml) for the corrected specification if that simulation finds a mistake, for `adopt --from manual`."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(DoctorCommand, argv, "surefoot doctor")
    if command.port is None and command.link == "serial":
        return _examine(command)
    if (option := changed_option(command, ("world", "seed", "threads", "out", "correct"))) is not None:
        raise SurefootError(f"{option} is given; it is for the simulation of an adopted policy, without --port")
    command.check_link()
    if command.rack and command.ground:
        raise SurefootError("--rack and --ground can't be combined; choose where the robot is")
    policy, robot = open_policy(find_policy(command.policy), command.robot)
    if (command.rack or command.ground) and not command.yes:
        place = PLACES[command.rack]
        check_terminal(place)
        ask_to_move(place)
    console = make_console()
    if not command.json:
        console.print(f"policy '{policy.contract.name}' for {robot.name}, {command.address}")
    link = command.open_link(robot, policy.contract, may_ask=False)
    results = []
    try:
        for result in examine(link, policy, robot, command.rack, command.ground, command.pings, command.steps):
            results.append(result)
            if not command.json:
                print_result(console, result)
    finally:
        close_link(link, print_warning)
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


def _examine(command: DoctorCommand) -> int:
    """Examine an adopted policy in simulation."""
    contract = open_policy(find_policy(command.policy), command.robot)[0].contract
    if "adopted" not in contract.figures or command.rack or command.ground:
        command.check_link()  # a policy that was not adopted, and motions, require a robot
    without = "it is for a robot: give --port, or --link dds --interface NAME"
    command.reject_link(without)
    if (option := changed_option(command, ("yes", "pings", "steps"))) is not None:
        raise SurefootError(f"{option} is given; {without}")
    from surefoot.api.adopted import examine_policy

    world, seed, threads = command.world, command.seed, command.threads
    result = examine_policy(command.policy, command.robot, world, seed, threads, command.out, command.correct)
    failed = any(check.passed is False for check in result.checks)
    if command.json:
        files = [str(file) for file in result.files]
        data = {"policy": result.name, "robot": result.robot.name, "world": command.world, "passed": not failed}
        print_json({**data, "checks": [asdict(check) for check in result.checks], "files": files})
        return FAILED if failed else 0
    console = make_console()
    console.print(f"policy '{result.name}' for {result.robot.name}, simulated in {command.world}")
    for check in result.checks:
        print_result(console, check)
    for file in result.files:
        console.print(f"wrote {file}", highlight=False, soft_wrap=True)
    if command.correct is not None and command.correct not in result.files:
        console.print(f"no mistake was found; {command.correct} was not written", highlight=False, soft_wrap=True)
    return FAILED if failed else 0


def print_result(console: Console, result: CheckResult) -> None:
    """Print a result in one line, and the remedy of a failed check or a warning in a second one."""
    label, style = ("warn", "yellow") if result.warn else _LABELS[result.passed]
    remedy = f": {result.remedy}" if result.passed is None else ""
    console.print(Text.assemble((f"{label:<8}", style), f"  {result.name:<20}  {result.message}{remedy}"))
    if result.passed is False or result.warn:
        console.print(Text(f"{'':<32}to do: {result.remedy}"))
