"""`surefoot deploy POLICY --port P`: run a policy on a robot.

Exit codes: 0: completed, or stopped by the operator; 2: rejected before anything moved; 3: ended by a safety limit of
the robot or of this computer, or the trace was lost.
"""

from __future__ import annotations

import contextlib
import math
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from surefoot.cli.helpers.link_options import LinkOptions
from surefoot.cli.helpers.options import (
    PAGE_PORT,
    Count,
    Json,
    MapPort,
    PagePort,
    PluginNames,
    PolicyName,
    check_folder,
)
from surefoot.cli.helpers.output import print_json, show_command
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Duration
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from surefoot.deploy.deployment import Deployment, RunOutcome
    from surefoot.deploy.messages import Handshake
    from surefoot.deploy.pacer import LoopTiming
    from surefoot.deploy.run_saver import SavedRun
    from surefoot.robot import RobotDescription

_BROWSER_DURATION = 600.0
"""Default duration of a run with --browser [s]."""
SAFETY_STOP = 3
"""Exit code of a run that was ended by a safety limit."""


@dataclass(frozen=True)
class DeployCommand(LinkOptions):
    """Run a policy on a robot: check, arm, stand up, run, sit down and disarm, and record a trace.

    Ctrl-C makes the robot sit down and disarms it; a second Ctrl-C damps the motors immediately. Exit codes: 0:
    completed, or stopped by the operator; 2: rejected before anything moved; 3: ended by a safety limit, or the trace
    was lost.
    """

    policy: PolicyName
    duration: Duration | None = None
    """Duration of the run [s]. Defaults to the policy's episode or the --commands file, whichever is longer."""
    episodes: Count = 1
    """Number of runs in sequence; the robot sits down between them."""
    out: Path | None = None
    """Folder for traces (run_000.npz and so on). Defaults to deploy; a dry run writes traces only with --out."""
    dry_run: bool = False
    """Read states and compute commands, but neither arm the robot nor send commands."""
    json: Json = False
    plugin: PluginNames = ()
    commands: Annotated[
        str | None,
        tyro.conf.arg(
            help="Source of velocity commands: a file (CSV: time, forward, sideways, yaw_rate), keyboard, gamepad, or "
            "a UDP port number of this computer. Without it the command is zero.",
        ),
    ] = None
    height_map: MapPort = None
    """UDP port of this computer that receives the height map, for a policy with a height map in its observation."""
    browser: Annotated[
        bool,
        tyro.conf.arg(
            help="Show the robot on a page in the browser, and take velocity commands from there. The default duration "
            "is then ten minutes. The command becomes zero one second after the last command of the page, such as when "
            "its tab is closed. If the page's process ends, the robot sits down and is disarmed.",
        ),
    ] = False
    page_port: PagePort = PAGE_PORT
    motion_capture: Path | None = None
    """Motion capture of the run (.csv), with times of the robot's clock; it is read after the run."""
    world_name: str = "robot"
    """Name of the world that is written into the traces."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(DeployCommand, argv, "surefoot deploy")
    check_folder(command.out)
    command.check_link()
    if command.browser and command.commands is not None:
        raise SurefootError("--browser and --commands can't be combined; commands come from one source")
    for option, does in (("release", "moves a Go2"), ("hand_back", "activates a Go2's own controller")):
        if command.dry_run and getattr(command, option):
            name = f"--{option.replace('_', '-')}"
            raise SurefootError(f"--dry-run and {name} can't be combined: a dry run sends nothing, and {name} {does}")
    if command.browser and command.lockstep:
        raise SurefootError("--browser and --lockstep can't be combined; a page runs in real time")
    if command.browser:
        import_module("viser")  # a missing package is reported before the robot is connected
    from surefoot.api.policies import find_policy, open_policy
    from surefoot.check_result import first_failure
    from surefoot.deploy.checks import check_contract, check_map
    from surefoot.deploy.command_sources import (
        KEYBOARD,
        ChannelCommands,
        CommandSource,
        keyboard_file,
        open_commands,
    )
    from surefoot.deploy.controller import Controller
    from surefoot.deploy.deployment import Deployment
    from surefoot.deploy.display import open_display
    from surefoot.deploy.loop import RunMonitor
    from surefoot.deploy.map_channel import MapChannel
    from surefoot.deploy.pacer import real_time_priority
    from surefoot.stop_signals import StopSignals

    policy, robot = open_policy(find_policy(command.policy))
    contract = policy.contract
    controller = Controller(policy, robot)
    check_map(contract, command.height_map)

    def check(handshake: Handshake) -> None:
        if (error := first_failure(link.preliminary_checks)) is not None:
            raise SurefootError(f"the robot is not armed: {error}")
        error = first_failure(check_contract(contract, handshake, robot))
        if error is not None:
            raise SurefootError(f"policy '{contract.name}' must not run on this robot: {error}")

    stop = StopSignals()
    with contextlib.ExitStack() as stack:
        title = f"{contract.name} on {robot.name}, {command.address}" + (", dry run" if command.dry_run else "")
        commands: CommandSource | None = None
        monitor: RunMonitor
        if command.commands is not None:
            if contract.commands is None:
                raise SurefootError(f"--commands is given; policy '{contract.name}' follows no commands")
            if command.commands == KEYBOARD:
                keyboard_file()
            else:
                commands = open_commands(command.commands, contract.commands)
                stack.callback(commands.close)
        if command.browser:
            from surefoot.cli.helpers.deploy_page import DeployPage

            channel = ChannelCommands(0)
            stack.callback(channel.close)
            monitor = page = DeployPage(
                title, str(robot.folder), contract.name, contract.commands, command.page_port, channel.port
            )
            stop.sources.append(page.stops)
            print(f"{page.address}   (Ctrl-C: the robot sits down)", file=sys.stderr, flush=True)
            commands = channel if contract.commands is not None else None
            stack.callback(page.close)
        maps = None
        if command.height_map is not None and contract.height_map is not None:
            maps = MapChannel(command.height_map, contract.height_map)
            stack.callback(maps.close)
        # After all that can be rejected, as a Go2 lies down when its controller is released. Until the link is open,
        # Ctrl-C ends the command.
        link = command.open_link(robot, contract, may_ask=not command.dry_run)
        unused = stack.enter_context(contextlib.ExitStack())
        unused.callback(link.close)
        stack.enter_context(stop)
        # What takes the terminal comes after the questions there.
        if command.commands == KEYBOARD and contract.commands is not None:
            commands = open_commands(KEYBOARD, contract.commands)
            stack.callback(commands.close)
        if not command.browser:
            monitor = open_display(title)
            stack.callback(monitor.close)
        if maps is not None:
            maps.clock = link.clock.now
            maps.discard()
        deployment = Deployment(link, controller, stop, monitor, command.dry_run, commands, maps)
        unused.pop_all()  # the deployment closes it
        stack.callback(deployment.close)
        for result in link.preliminary_checks:
            if result.passed is None:
                monitor.warn(f"{result.name}: {result.message}; {result.remedy}")
        if not command.lockstep:
            stack.enter_context(real_time_priority())
        deployment.connect(check)
        runs, code = _runs(command, deployment)
    # Motion is estimated after the session has ended: a robot waits for its operator for a second only.
    return _report(command, deployment, [_result(*run, deployment.robot) for run in runs], code)


def _runs(
    command: DeployCommand, deployment: Deployment
) -> tuple[list[tuple[RunOutcome, LoopTiming, SavedRun, int]], int]:
    """Run all episodes, unless one ends early; return the first arguments of `_result` for each, and the exit code."""
    from surefoot.deploy.command_sources import FileCommands
    from surefoot.deploy.motion_runner import SHUTDOWN_TIME, STARTUP_TIME
    from surefoot.deploy.pacer import LoopTiming
    from surefoot.deploy.run_saver import RunSaver, next_free_path

    contract = deployment.contract
    step = contract.control_step
    steps = deployment.controller.task.max_steps
    duration = command.duration or (_BROWSER_DURATION if command.browser else None)
    if duration is not None:
        steps = max(round(duration / step), 1)
    elif isinstance(deployment.commands, FileCommands):
        steps = max(round(deployment.commands.duration / step), steps)
    runs: list[tuple[RunOutcome, LoopTiming, SavedRun, int]] = []
    code = 0
    for run in range(command.episodes):
        timing = LoopTiming(steps + round((STARTUP_TIME + SHUTDOWN_TIME) / step) + 16)
        try:
            path = None if command.dry_run and command.out is None else next_free_path(command.out or Path("deploy"))
            saver = RunSaver(deployment, path, steps, command.world_name, run)
            saver.begin()
        except (SurefootError, OSError) as error:
            if not runs:
                raise
            deployment.monitor.warn(f"run {run} can't be recorded and did not begin: {error}")
            code = SAFETY_STOP
            break
        outcome = deployment.run(saver.recorder, timing)
        saved = saver.finish(outcome, timing, command.motion_capture)
        runs.append((outcome, timing, saved, saver.recorder.steps))
        if outcome.safe or saved.lost:
            code = SAFETY_STOP
        if outcome.ended != "time" or outcome.safe:
            break
    return runs, code


def _result(
    outcome: RunOutcome, timing: LoopTiming, saved: SavedRun, steps: int, robot: RobotDescription
) -> dict[str, Any]:
    from surefoot.evaluation.estimated_motion import (
        estimate_intervals,
        is_estimated,
        path_length,
        with_estimated_motion,
    )

    speed = distance = path = interval = None
    estimated = False
    if saved.trace is not None:
        trace = with_estimated_motion(saved.trace, robot)
        forward, estimated = trace.base_position_world[:, 0], is_estimated(trace)
        if math.isfinite(forward[-1] - forward[0]):
            distance = float(forward[-1] - forward[0])
            speed = distance / trace.duration
            path = path_length(trace)
            if estimated:
                interval = estimate_intervals([trace], {"distance_mean": distance})["distance_mean"]
    return {
        "ended": outcome.ended,
        "reason": outcome.reason,
        "what": outcome.text,
        "steps": steps,
        "trace": str(saved.path) if saved.path is not None else None,
        "distance": distance,
        "speed": speed,
        "distance_interval": interval,
        "path": path,
        "estimated": estimated,
        "notes": saved.notes,
        "timing": timing.metrics(),
    }


def _report(command: DeployCommand, deployment: Deployment, results: list[dict[str, Any]], code: int) -> int:
    """Print the results; return the exit code, even if the output can't be written."""
    statistics, state = deployment.link.statistics, deployment.link.state
    counts = ("received", "damaged", "missing", "repeated", "unsent")
    report = {
        "policy": deployment.contract.name,
        "robot": deployment.robot.name,
        "exit_code": code,
        "runs": results,
        "frames": {
            **{name: getattr(statistics, name) for name in counts},
            "commands_refused": state.dropped if state is not None else None,
        },
    }
    with contextlib.suppress(OSError):
        if command.json:
            print_json(report)
            return code
        for result in results:
            _print_result(result, deployment.contract.commands is not None)
        if traces := [Path(result["trace"]) for result in results if result["trace"] is not None]:
            print(show_command(traces), flush=True)
    return code


def _print_result(result: dict[str, Any], is_steered: bool) -> None:
    metrics = result["timing"]
    parts = [
        f"{result['ended']}: {result['what']}" if result["ended"] != "time" else str(result["what"]),
        f"{result['steps']} steps",
    ]
    if result["distance"] is not None:
        how = ", estimated" if result["estimated"] else ""
        if is_steered:
            # A steered robot may come back to where it started.
            parts.append(f"path of {result['path']:.2f} m{how}")
        else:
            ends = result["distance_interval"]
            likely = f" (95 %: {ends[0]:.2f} to {ends[1]:.2f})" if ends is not None else ""
            parts.append(f"{result['distance']:.2f} m{likely} at {result['speed']:.2f} m/s{how}")
    if metrics["lateness_median_ms"] is not None:
        late = "/".join(f"{metrics[f'lateness_{key}_ms']:.2f}" for key in ("median", "p99_9", "max"))
        parts.append(f"lateness {late} ms (median/99.9 %/max)")
    if metrics["inference_median_ms"] is not None:
        parts.append(f"inference {metrics['inference_median_ms']:.2f} ms")
    parts += [f"{metrics['missed']} missed", *result["notes"]]
    if result["trace"] is not None:
        parts.append(f"wrote {result['trace']}")
    print("; ".join(parts), flush=True)
