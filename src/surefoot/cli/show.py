"""`surefoot show`: recorded runs on a page in the browser, or as one file of HTML."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from surefoot.cli.helpers.options import PAGE_PORT, Host, PagePort, check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError, choices, quote
from surefoot.files import atomic_write
from surefoot.robot import RobotDescription
from surefoot.world.terrain import is_map

if TYPE_CHECKING:
    from surefoot.report.pages.recorded_runs import ShownTrace
    from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class ShowCommand:
    """Show recorded runs on a page in the browser: robots in 3D, a time line, and plots that follow it.

    Runs may be of different robots and worlds: simulated, deployed, or logs made traces by `surefoot trace import`.
    """

    trace: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="TRACE [TRACE ...]")]
    """Trace files (.npz), or folders of them; with --robot also .npz files with arrays time, command, motor_angle and
    imu, which name no robot."""
    robot: str | None = None
    """Name or folder of the robot of such files, or of traces in place of the robot that they carry."""
    terrain: Path | None = None
    """Map (.npz, .png) on which robots stood: a trace has its name alone."""
    layout: Literal["side", "over", "one"] = "side"
    """Robots side by side, laid over each other, or one at a time; the page can change it."""
    out: Path | None = None
    """File to write (.html) in place of serving: the whole page, which opens in a browser without anything else."""
    page_port: PagePort = PAGE_PORT
    host: Host = None


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(ShowCommand, argv, "surefoot show")
    check_suffix("page", command.out, ".html")
    if command.terrain is not None and not is_map(str(command.terrain)):
        raise SurefootError(f"--terrain is {command.terrain}; it must be a map (.npz, .png): traces hold other terrain")
    if not command.trace:
        raise SurefootError("no TRACE is given; give one or more files (.npz), or folders of them")
    from surefoot.report.pages.recorded_runs import recording_page
    from surefoot.report.pages.server import PageServer

    page = recording_page(_load_traces(command), command.layout)
    if command.out is not None:
        command.out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(command.out, page)
        print(f"wrote {command.out}: {len(page) / 1e6:.1f} MB; opens in a browser")
        return 0
    server = PageServer(command.host, command.page_port, None, page)
    try:
        server.print_addresses()
        threading.Event().wait()
    finally:
        server.stop()
    return 0


def _load_traces(command: ShowCommand) -> list[ShownTrace]:
    """Load traces and robots; a trace is named by its policy, and by world or file where that is not unique."""
    from surefoot.api.policies import distinct_names
    from surefoot.evaluation.recorded import find_traces, load_robot
    from surefoot.identify.motion.importing import import_log
    from surefoot.identify.motion.traces import trace_from_motion
    from surefoot.npz import read_npz
    from surefoot.report.pages.recorded_runs import ShownTrace

    robot = None if command.robot is None else RobotDescription.load(command.robot)
    traces = []
    for path in command.trace:
        if robot is not None and path.is_file() and path.suffix == ".npz" and "meta" not in read_npz(path):
            traces.append((path, trace_from_motion(import_log(path, robot), robot)))
        else:
            traces += find_traces(path)
    # Robots of one name may differ, where each trace carries its own.
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
            print(f"{title} stood on the map {quote(name)}, which is not drawn: give its file with --terrain")
    pairs = zip(titles, traces, strict=True)
    return [ShownTrace(title, robot_of(path, trace), trace, command.terrain) for title, (path, trace) in pairs]
