"""`surefoot identify --trace`: fit physical parameters to recorded runs and logs."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.helpers.options import Json, Seed, Settings
from surefoot.configuration import Within
from surefoot.errors import SurefootError, suggest
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.robot_params_file import check_new_logs, read_gains, read_prior
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS, parse_settings

RUNS = Path("runs/identify")
FIT_FAILED = 3
"""Exit code of a fit that does not reproduce its logs."""


@dataclass(frozen=True)
class TracesCommand:
    """Identify a robot's physical parameters from traces of its runs or from logs, without an experiment.

    The last traces (at least one), or the last quarter of a single trace, are held out to check the fit; logs are held
    out by name (--hold-out). Exit codes: 0: completed; 2: rejected; 3: the result does not reproduce the logs.
    """

    trace: Path
    """Trace file (.npz), or a folder of trace files. For robots with joint actuators: logs of commands and angles."""
    fit: tuple[str, ...] = ()
    """Physical parameters to identify. Defaults to all that are identifiable from traces; others are not changed."""
    params: Path | None = None
    """File of the robot's parameters (.toml) to which the estimates are written. Defaults to robot.toml in --out."""
    out: Path | None = None
    """Folder for the report. Defaults to runs/identify/traces-TIME."""
    robot: str | None = None
    """Name or folder of the robot. Defaults to the traces' robot; required for logs."""
    rack: tuple[str, ...] = ()
    """File names of logs whose robot hung with its base fixed."""
    hold_out: tuple[str, ...] = ()
    """File names of logs that are not fitted, but replayed with the estimates."""
    plan: bool = False
    """Print which parameters are identifiable from logs of a hanging robot, without fitting."""
    settings: Settings = ()
    """Known parameters, such as servo_kp=20 servo_kd=1.5, which are not fitted."""
    duration: Annotated[
        float | None,
        Within(0.5, 3600),
        tyro.conf.arg(
            help="Duration of each log that is fitted, from its start [s]. Defaults to 24 s for a hanging robot, and "
            "to 2.3 s on the ground, where longer replays diverge.",
        ),
    ] = None
    generations: Annotated[int, Within(0, 100_000)] = 0
    """Generations of CMA-ES to find the initial values of the fit."""
    seed: Seed = 1
    json: Json = False


def identify_from_logs(command: TracesCommand, robot: RobotDescription) -> int:
    """Fit the parameters of a robot with joint actuators to logs; return the exit code."""
    from surefoot.identify.motion.recorded import common_gains
    from surefoot.identify.motion.traces import read_motion

    paths = sorted(command.trace.glob("*.npz")) if command.trace.is_dir() else [command.trace]
    if not paths:
        raise SurefootError(f"folder {command.trace} contains no logs (.npz)")
    logs = {path.name.removesuffix(".npz"): read_motion(path, robot) for path in paths}
    for option, names in (("rack", command.rack), ("hold-out", command.hold_out)):
        if bad := [name for name in names if name not in logs]:
            raise SurefootError(f"--{option} names '{bad[0]}', which is not a log; {suggest(bad[0], logs)}")
    prior = read_prior(command.params, robot)
    from surefoot.identify.motion.motion_digest import all_digest, motion_digest
    from surefoot.identify.motion.priors import gains_are_commanded

    fitted = [name for name in logs if name not in command.hold_out]
    ordered = [logs[name] for name in [*fitted, *command.hold_out]]
    check_new_logs(command.params, prior, {log.name: motion_digest(log) for log in ordered}, all_digest(ordered))
    # Gains given by --set take precedence, then those that an earlier fit estimated, then those that the logs state.
    logged = common_gains(logs.values())
    settings = parse_settings([word for group in command.settings for word in group])
    stated = {**logged, **settings}
    gains = {**read_gains(prior), **{name: value for name, value in stated.items() if name not in prior.names}}
    gains |= settings
    # The estimates hold for the values of --set, so these are written too; commanded gains have a table of their own.
    kept = {*prior.names, *settings.keys() - ({*GAINS} if gains_are_commanded(robot) else set())}
    names = tuple(name for name in PhysicalParams.names() if name in kept)
    prior = replace(prior, params=prior.params.with_values(robot, **gains), names=names)
    from surefoot.cli.helpers.identify_results import check_installed, fit_progress, print_failure, save_and_print

    check_installed()
    from surefoot.identify.motion.robot_fit import fit_robot

    runs = {name: replace(log, rack=name in command.rack) for name, log in logs.items()}
    if command.plan:
        return _print_expected_accuracy(robot, [runs[name] for name in fitted], prior.params, tuple(stated), command)
    held = [runs[name] for name in command.hold_out]
    with fit_progress("logs") as report:
        result = fit_robot(robot, [runs[name] for name in fitted], held, command.fit or None, prior.params,
                           command.duration, command.generations, command.seed, report, tuple(stated))  # fmt: skip
    if result.failure:
        print_failure(result, command.json)
        return FIT_FAILED
    folder, more = command.out or new_folder("logs"), {"logs": [str(path) for path in paths]}
    save_and_print(robot, prior, result, command.params, folder, command.trace.name, more, command.json)
    return 0


def _print_expected_accuracy(
    robot: RobotDescription,
    motions: list[RecordedMotion],
    prior: PhysicalParams,
    stated: tuple[str, ...],
    command: TracesCommand,
) -> int:
    if on_ground := [motion.name for motion in motions if not motion.rack]:
        raise SurefootError(f"--plan is for logs of a hanging robot; {on_ground[0]} is not named by --rack")
    from surefoot.cli.helpers.identify_results import print_expected_accuracy
    from surefoot.identify.motion.expected_accuracy import predict_accuracy
    from surefoot.identify.motion.robot_model import fitted_part

    parts = [fitted_part(motion, command.duration) for motion in motions]
    print_expected_accuracy(
        robot, predict_accuracy(robot, parts, prior, stated), prior, command.trace.name, command.json
    )
    return 0


def new_folder(name: str) -> Path:
    """Return the default folder for the results of an experiment or a fit."""
    return RUNS / f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
