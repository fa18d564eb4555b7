"""`surefoot train TASK`: train a policy; `surefoot train --resume RUN`: resume a training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from surefoot.cli.helpers.options import PAGE_PORT, PagePort, PluginNames, Settings
from surefoot.cli.helpers.output import make_console, next_command, show_command
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.ranges import ranges_help, take_ranges
from surefoot.cli.helpers.simulator import Simulator, SimulatorOptions
from surefoot.configuration import field_bounds, from_mapping
from surefoot.errors import SurefootError, choices, suggest
from surefoot.learn.config import LoggerName, Steps, TrainConfig, load_train_config
from surefoot.task.config import TaskConfig, preset_names
from surefoot.task.plugins import load_plugins
from surefoot.task.reference_config import REFERENCES

if TYPE_CHECKING:
    from rich.console import Console

    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

_USAGE = """usage: surefoot train TASK [options]                 train a policy
       surefoot train --resume RUN [--steps N]         resume a run exactly where it stopped, with its own options
       surefoot train TASK --help                      list all options, with the task's values as defaults

TASK is {tasks}, or the path of a YAML file.

Options in addition to those that TASK --help lists:
{ranges}"""

_REFERENCE = "--task.reference."


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_USAGE.format(tasks=choices(preset_names()), ranges=ranges_help()))
        return 0 if argv else 2
    if argv[0].partition("=")[0] == "--resume":
        resume = parse(ResumeCommand, argv, "surefoot train")
        return _resume(resume)
    if argv[0].startswith("-"):
        raise SurefootError(f"'{argv[0]}' is not a task; {suggest(argv[0], preset_names())}, or a YAML file")
    config, command = _parse(argv)
    from surefoot.api.training import check_config, training_notes

    check_config(config)
    for note in training_notes(config):
        print(f"note: {note}")
    options = command.page, command.logger_name
    from surefoot.learn.run_folder import RunFolder

    return _train(RunFolder.create(config, command.out), False, *options)


@dataclass(frozen=True)
class ViewOptions:
    """Options for monitoring a training."""

    logger: LoggerName = "tensorboard"
    """Where to log; tensorboard: TensorBoard files in the run folder; wandb: also Weights & Biases."""
    browser: bool = False
    """Show the newest policy on a page in the browser during the training."""
    page_port: PagePort = PAGE_PORT
    plugin: PluginNames = ()

    @property
    def page(self) -> int | None:
        """Port of the page, or None without a page."""
        if self.browser:
            import_module("viser")  # a missing package is reported before the run folder is created
        return self.page_port if self.browser else None

    @property
    def logger_name(self) -> LoggerName:
        """The logger; its package is installed."""
        if self.logger == "wandb":
            import_module("wandb")  # as above
        return self.logger


@dataclass(frozen=True, kw_only=True)
class ResumeCommand(ViewOptions):
    """Resume a run exactly where it stopped, with its own options."""

    resume: Path
    """Folder of the run."""
    steps: Steps | None = None
    """Total control steps, more than done so far; this also continues a finished run. Defaults to the run's value."""


@dataclass(frozen=True)
class TrainCommand(ViewOptions, TrainConfig):
    """Train a policy."""

    simulator: SimulatorOptions = Simulator()
    """Differences from the task's simulator."""
    pushes: bool = False
    """Push the robot at random, with the force and frequency configured in the task."""
    robot: Annotated[str | None, tyro.conf.arg(help="Name or folder of the robot. Defaults to the task's.")] = None
    settings: Settings = ()
    """Physical parameters to change, such as motor_strength=0.8."""
    out: Path = Path("runs")
    """Parent folder of the run folder."""


def _parse(argv: list[str]) -> tuple[TrainConfig, TrainCommand]:
    """Return the configuration given by the arguments, with the task's values as defaults, and the command."""
    # The other options and their defaults depend on --plugin, --robot and the kind of reference.
    load_plugins(_option_values(argv, "--plugin"))
    base = load_train_config(argv[0], next(reversed(_option_values(argv, "--robot")), None))
    for kind in _option_values(argv, f"{_REFERENCE}kind")[-1:]:
        base = replace(base, task=from_mapping(TaskConfig, {"reference": {"kind": kind}}, base=base.task))
    _check_reference_options(argv, base.task.reference.kind)
    words, range_options = take_ranges(argv[1:])
    ranges = range_options.apply(base.task.robot, base.task.randomize)
    # Ranges are parsed separately, since tyro would accept any number of values.
    preset = TrainCommand(**vars(base) | {"task": replace(base.task, randomize={}), "pushes": base.task.pushes.enabled})
    command = parse(TrainCommand, words, f"surefoot train {argv[0]}", preset)
    task = command.simulator.condition(command.settings, estimated_gains=False).simulate(command.task)
    task = replace(task, pushes=replace(task.pushes, enabled=command.pushes), randomize=ranges)
    return TrainConfig(**{name: getattr(command, name) for name in vars(base)} | {"task": task}), command


def _check_reference_options(argv: list[str], kind: str) -> None:
    """Reject options that belong to another kind of reference than the task's."""
    for name in [word.partition("=")[0] for word in argv if word.startswith(_REFERENCE)]:
        key = name.removeprefix(_REFERENCE).partition(".")[0].replace("-", "_")
        kinds = [option.kind for option in REFERENCES if key in field_bounds(option)]
        if kinds and kind not in kinds:
            raise SurefootError(
                f"{name} is an option of references of kind {choices(kinds)}, but the task's kind is {kind}; to "
                f"change the kind: {_REFERENCE}kind {kinds[0]}"
            )


def _option_values(argv: list[str], option: str) -> list[str]:
    """Return the values of an option, which may be repeated."""
    pairs = [(*word.partition("="), after) for word, after in zip(argv, [*argv[1:], ""], strict=True)]
    return [value or after for name, _, value, after in pairs if name == option]


def _resume(command: ResumeCommand) -> int:
    """Resume a run, with more steps if requested; return the exit code."""
    from surefoot.learn.folder_lock import folder_lock
    from surefoot.learn.run_config import set_steps
    from surefoot.learn.run_folder import RunFolder

    folder, _ = RunFolder.open(command.resume)
    options = command.page, command.logger_name
    if command.steps is not None:
        with folder_lock(folder.path):
            if command.steps <= (done := folder.saved_steps(folder.load())):
                raise SurefootError(f"steps is {command.steps}, but {folder.path} has already done {done}; give more")
            set_steps(folder.path, command.steps)
    return _train(folder, True, *options)


def _print_next_commands(console: Console, folder: RunFolder) -> None:
    """Print the policy file of a stopped run, if it exists, and the commands that can be run next."""
    if folder.policy.exists():
        console.print(f"policy: {folder.policy.absolute()}")
        console.print(next_command("drive it", "drive", folder.path))
    if folder.latest.exists():
        console.print(next_command("resume", "train", "--resume", folder.path))


def _train(folder: RunFolder, resume: bool, page_port: int | None, logger: LoggerName) -> int:
    """Train in a run folder, from the beginning or from its last checkpoint; return the exit code."""
    from surefoot.api.episodes import print_summaries
    from surefoot.api.training import EPISODE_FILE, run_training

    console = make_console()
    watch = None if page_port is None else partial(_page, port=page_port)
    summaries = run_training(folder, console, resume=resume, logger=logger, watch=watch)
    if summaries is None:
        _print_next_commands(console, folder)
        return 130
    reward = type(folder).open(folder.path)[1].task.reward
    print_summaries({kind.replace("_", " "): summary for kind, summary in summaries.items()}, reward)
    console.print(f"Policy, table, figures and video are in {folder.path}")
    console.print(show_command([folder.path / "figures" / EPISODE_FILE]))
    console.print(next_command("drive it", "drive", folder.policy))
    return 0


@contextmanager
def _page(loop: TrainingLoop, port: int) -> Iterator[Callable[[], None]]:
    """Show a training on a page in the browser; yield the function to call after every update."""
    from surefoot.cli.helpers.train_page import TrainingPage

    with closing(TrainingPage(loop, port)) as page:
        yield page.update
