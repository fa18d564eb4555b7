"""`surefoot show`: show a policy in a window or as a video, or recorded runs in the browser or as one file."""

from __future__ import annotations

import sys
import threading
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from surefoot.api.policies import POLICY_FILE, find_policy, released_policies
from surefoot.cli.helpers.options import PAGE_PORT, Host, PagePort, PolicyName, check_suffix
from surefoot.cli.helpers.parsing import options, parse, positional_words
from surefoot.cli.helpers.simulator import RunOptions
from surefoot.configuration import Duration
from surefoot.errors import SurefootError, choices, prefix_errors, quote
from surefoot.files import atomic_write
from surefoot.robot import RobotDescription
from surefoot.task.commands import schedule_duration
from surefoot.task.partial_trace import SUFFIX
from surefoot.world.terrain import is_map

if TYPE_CHECKING:
    from surefoot.report.pages.recorded_runs import ShownTrace
    from surefoot.task.trace import EpisodeTrace

_DURATION = 6.0
"""Minimum of the default duration of a run [s]."""
_USAGE = """usage: surefoot show POLICY ...           run a policy once, and show it in a window or as a video
       surefoot show POLICY --contract     print the contract of a policy file
       surefoot show TRACE [TRACE ...]     show recorded runs on a page in the browser, or write them to one file

TRACE is a recorded run (.npz), or a folder of recorded runs without a policy; anything else is a POLICY.
"""


@dataclass(frozen=True)
class ShowPolicyCommand(RunOptions):
    """Run a policy once and show it, in MuJoCo's viewer if there is a display, or else as a video (MP4).

    To run it on a page in the browser, see `surefoot drive`.
    """

    policy: PolicyName
    duration: Duration | None = None
    """Duration in simulated time [s]. Defaults to 6 s or the --commands file, whichever is longer."""
    out: Path | None = None
    """Video (.mp4) to write instead of opening a window. Without a display it defaults to POLICY.mp4."""
    contract: bool = False
    """Print the contract of the policy file (inputs, command ranges, gains, rates, height map and notes), and exit."""


@dataclass(frozen=True)
class ShowRunsCommand:
    """Show recorded runs on a page in the browser: robots in 3D, a time line, and synchronized plots.

    Runs may be from different robots and worlds: simulated, deployed, or logs converted by `surefoot identify import`.
    """

    trace: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(
            metavar="TRACE [TRACE ...]",
            help="Trace files (.npz), or folders of them. With --robot also .npz files with the arrays time, command, "
            "motor_angle and imu.",
        ),
    ]
    robot: str | None = None
    """Name or folder of the robot. It is required for such files; it replaces the robot stored in a trace."""
    terrain: Path | None = None
    """Height map (.npz, .png) of the run; a trace stores only its name."""
    layout: Literal["side", "over", "one"] = "side"
    """Initial layout: robots side by side, overlaid, or one at a time."""
    out: Path | None = None
    """File to write instead of serving the page: a self-contained page (.html) or, of a single run, a video (.mp4)."""
    page_port: PagePort = PAGE_PORT
    host: Host = None


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    words = positional_words(argv, ShowPolicyCommand, ShowRunsCommand)
    if not words:
        return _print_help(argv)
    is_recorded = _is_recorded(words[0])
    kinds = [options(kind) for kind in (ShowRunsCommand, ShowPolicyCommand)]
    own, other = kinds if is_recorded else reversed(kinds)
    for name in (word.partition("=")[0] for word in argv):
        if name in other and name not in own:
            what = "recorded run" if is_recorded else "policy"
            raise SurefootError(f"{name} is not an option for {words[0]}, a {what}; all options: surefoot show --help")
    return _show_runs(argv) if is_recorded else _show_policy(argv)


def _print_help(argv: list[str]) -> int:
    """Print the options of both forms; without --help, report that there is nothing to show."""
    if not {"-h", "--help"} & set(argv):
        raise SurefootError("neither POLICY nor TRACE is given; all options: surefoot show --help")
    print(_USAGE)
    for kind in (ShowPolicyCommand, ShowRunsCommand):
        try:
            parse(kind, ["--help"], "surefoot show")
        except SystemExit:
            print()
    return 0


def _is_recorded(word: str) -> bool:
    """Return whether an argument names recorded runs rather than a policy."""
    path = Path(word)
    if path.is_dir():
        is_policy = word in released_policies() or (path / "run.json").is_file()
        return not (is_policy or (path / POLICY_FILE).is_file() or any(path.glob(f"*/{POLICY_FILE}")))
    return path.name.endswith((".npz", f".npz{SUFFIX}"))


def _note(text: str) -> None:
    """Print how the argument is interpreted."""
    print(f"surefoot: {text}", file=sys.stderr, flush=True)


def _show_policy(argv: list[str]) -> int:
    command = parse(ShowPolicyCommand, argv, "surefoot show")
    if command.contract:
        return _print_contract(find_policy(command.policy))
    check_suffix("video", command.out, ".mp4")
    from surefoot.api.episodes import film
    from surefoot.api.policies import load_gait, run_policy
    from surefoot.cli.helpers.viewer import has_display, replay
    from surefoot.evaluation.conditions import with_duration
    from surefoot.world.registry import find_world

    path = find_policy(command.policy)
    find_world(command.world)
    policy, robot, task, origin = load_gait(path, command.robot)
    task = command.apply(task, robot)
    # The video's camera is placed for a robot that moves along x.
    task = replace(task, terrain=replace(task.terrain, heading=0.0))
    duration = command.duration or max(_DURATION, schedule_duration(task.commands.schedule))
    task = with_duration(task, robot, duration)
    window = command.out is None and has_display()
    # Import before the simulation, so that a missing package is reported immediately.
    for module in ("mujoco",) if window else ("imageio_ffmpeg", "PIL"):
        import_module(module)
    _note(f"{command.policy} is a policy: it runs in {command.world}, {'in a window' if window else 'for a video'}")
    (trace,) = run_policy(policy, task, 1, command.world, command.seed, name=origin["name"])
    ground = task.terrain.build(command.seed).ground
    if window:
        replay(robot, trace, ground)
    else:
        print(f"wrote {film(robot, trace, command.out or Path(f'{path.stem}.mp4'), ground)}")
    return 0


def _print_contract(path: Path) -> int:
    """Print the contract of a policy file."""
    from surefoot.api.policy_text import policy_rows
    from surefoot.policy.runtime import PolicyRuntime

    if path.suffix != ".onnx":
        raise SurefootError(f"{path}: --contract is for policy files (.onnx)")
    rows = policy_rows(PolicyRuntime.load(path).contract, path)
    width = max(len(row[""]) for row in rows)
    for row in rows:
        print(f"{row['']:<{width}}  {row['says']}")
    return 0


def _show_runs(argv: list[str]) -> int:
    command = parse(ShowRunsCommand, argv, "surefoot show")
    out = command.out
    if out is not None and out.suffix.lower() not in (".html", ".mp4"):
        raise SurefootError(f"out {out}: the name must end in .html, or in .mp4 for a single run")
    if command.terrain is not None and not is_map(str(command.terrain)):
        raise SurefootError(f"--terrain is {command.terrain}; it must be a height map (.npz, .png)")
    shown = _load_traces(command)
    what = f"{command.trace[0]} is a recorded run" if len(shown) == 1 else f"{len(shown)} recorded runs"
    if out is not None and out.suffix.lower() == ".mp4":
        return _film_run(shown, out, what)
    from surefoot.report.pages.recorded_runs import recording_page
    from surefoot.report.pages.server import PageServer

    page = recording_page(shown, command.layout)
    _note(what)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(out, page)
        print(f"wrote {out}: {len(page) / 1e6:.1f} MB; opens in a browser")
        return 0
    with PageServer(command.host, command.page_port, None, page) as server:
        server.print_addresses()
        threading.Event().wait()
    return 0


def _film_run(shown: list[ShownTrace], out: Path, what: str) -> int:
    """Write the video of a single run."""
    from surefoot.api.episodes import film
    from surefoot.evaluation.recorded import ground_for_trace

    if len(shown) > 1:
        raise SurefootError(f"{len(shown)} runs are given; a video shows only one, a page (.html) shows all of them")
    _note(what)
    run = shown[0]
    print(f"wrote {film(run.robot, run.trace, out, ground_for_trace(run.trace, run.map_file))}")
    return 0


def _load_traces(command: ShowRunsCommand) -> list[ShownTrace]:
    """Load traces and robots; the title of a trace is its policy, with world or file name if that is not unique."""
    from surefoot.api.policies import distinct_names
    from surefoot.evaluation.recorded import find_traces, load_robot
    from surefoot.identify.motion.importing import import_log
    from surefoot.identify.motion.traces import trace_from_motion
    from surefoot.npz import read_npz
    from surefoot.report.pages.recorded_runs import ShownTrace

    robot = None if command.robot is None else RobotDescription.load(command.robot)
    traces = []
    for path in command.trace:
        is_log = robot is not None and path.is_file() and path.suffix == ".npz"
        if is_log:
            with prefix_errors(path):
                is_log = "meta" not in read_npz(path)
        if robot is not None and is_log:
            traces.append((path, trace_from_motion(import_log(path, robot), robot)))
        else:
            traces += find_traces(path)
    # Robots with the same name may differ, since each trace contains its own description.
    robots: dict[tuple[str, bytes], RobotDescription] = {}

    def robot_of(path: Path, trace: EpisodeTrace) -> RobotDescription:
        name = str(trace.meta["robot"])
        if robot is not None and robot.name == name:
            return robot
        if (key := (name, trace.robot_archive)) not in robots:
            robots[key] = load_robot(path, trace)
        return robots[key]

    titles = [str(trace.meta["policy"])[:80] or path.stem for path, trace in traces]
    if len(set(titles)) < len(titles):
        titles = [f"{title}, {str(trace.meta['world'])[:80]}" for title, (_, trace) in zip(titles, traces, strict=True)]
    titles = distinct_names(titles, [f"{path.parent.name}/{path.stem}" for path, _ in traces])
    map_name = "" if command.terrain is None else command.terrain.name
    if map_name and map_name not in (names := [str(trace.meta["terrain"]) for _, trace in traces]):
        raise SurefootError(
            f"--terrain is {map_name}; the traces' terrain is {choices(map(quote, sorted(set(names))))}"
        )
    for title, (_, trace) in zip(titles, traces, strict=True):
        if is_map(name := str(trace.meta["terrain"])) and name != map_name:
            print(f"{title}: the height map {quote(name)} is not shown; give its file with --terrain")
    pairs = zip(titles, traces, strict=True)
    return [ShownTrace(title, robot_of(path, trace), trace, command.terrain) for title, (path, trace) in pairs]
