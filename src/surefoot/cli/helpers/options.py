"""Options shared by several commands, and checks of the files and folders that they name."""

from __future__ import annotations

import sys
from collections.abc import Container, Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import tyro

from surefoot import configuration
from surefoot.configuration import Within
from surefoot.errors import SurefootError, choices
from surefoot.world.registry import WORLDS
from surefoot.world.terrain import KINDS

PolicyName = Annotated[
    str,
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="POLICY", help="Path of a policy file (.onnx) or run folder, or the name of a released policy."
    ),
]
PolicyNames = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="POLICY [POLICY ...]",
        help="Paths of policy files (.onnx) or run folders, or names of released policies.",
    ),
]
Repeated = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""Values of an option that may be repeated, with one or more values each time."""
Settings = Annotated[Repeated, tyro.conf.arg(name="set", metavar="NAME=VALUE [...]")]
Pushes = Annotated[
    bool, tyro.conf.arg(help="Push the robot at random times, as configured in its task. By default it is not pushed.")
]
PushForce = Annotated[tuple[float, float] | None, Within(0, 1e6), tyro.conf.arg(metavar="LOW HIGH")]
"""Minimum and maximum force of pushes [N]."""
Count = configuration.Count
Seed = Annotated[configuration.Seed, tyro.conf.arg(help="Seed of all random numbers.")]
Threads = Annotated[configuration.Threads, tyro.conf.arg(help="Threads of the simulation; 0 means one per core.")]
Workers = Annotated[
    configuration.Threads,
    tyro.conf.arg(
        help="Trainings in parallel, each with one thread; 0 means one per core (with --ray, of the cluster)."
    ),
]
Ray = Annotated[
    str | None,
    tyro.conf.arg(metavar="HOST:PORT", help="Ray cluster to train on. Defaults to this machine."),
]
World = Annotated[str, tyro.conf.arg(help=f"World (simulator) to run in: {choices(WORLDS)}.")]
Json = Annotated[bool, tyro.conf.arg(help="Print the result as one JSON object.")]
RobotName = Annotated[
    str | None, tyro.conf.arg(help="Name or folder of the robot. Defaults to the robot of the policy or trace.")
]
PluginNames = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(
        name="plugin",
        metavar="FILE",
        help="Python file with your own reward terms and observations, which is executed, or the name of an installed "
        "plug-in. May be repeated.",
    ),
]
Terrain = Annotated[
    str,
    tyro.conf.arg(
        metavar="KIND:SIZE",
        help=f"Terrain: flat; {choices(KINDS)} with a size, such as stairs:0.10 [m] or slope:20 [deg]; or the path of "
        "a height map (.npz, .png).",
    ),
]
PAGE_PORT = 8400
"""Default TCP port of a page in the browser."""
PagePort = Annotated[int, Within(0, 65535), tyro.conf.arg(help="TCP port of the page; 0 for a free one.")]
MapPort = Annotated[int | None, Within(1024, 65535), tyro.conf.arg(metavar="PORT")]
"""UDP port of the height map channel."""
Host = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="ADDRESS",
        help="Address at which other machines can open the page, such as 0.0.0.0; its URL then contains a token. "
        "By default only this machine can open it.",
    ),
]
Port = Annotated[str, tyro.conf.arg(help="Serial port or pseudo-terminal of the robot, such as /dev/ttyUSB0.")]
Yes = Annotated[bool, tyro.conf.arg(help="Do not ask for confirmation before motors move.")]
PLACES = {True: "hang freely, with its legs in the air", False: "sit on flat ground with a metre of free space"}
"""Where the robot must be before motors move, by whether it is on a rack."""


def check_terminal(place: str) -> None:
    """Require --yes if there is no terminal to ask for confirmation; `place` is where the robot must be."""
    if not sys.stdin.isatty():
        raise SurefootError(f"motors will move and the robot must {place}; without a terminal, confirm it with --yes")


def ask_to_move(place: str) -> None:
    """Ask the operator to confirm the robot's place before motors move; any answer but yes is an error."""
    print(f"Motors will move. Does the robot {place}? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise SurefootError("not confirmed; nothing has moved")


def ask_to_release(controller: str) -> bool:
    """Ask whether the robot shall lie down and its own controller be released; return the answer."""
    question = f"The robot's own controller '{controller}' is active. Let it lie down and release it? [y/N] "
    print(question, end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def check_suffix(what: str, path: Path | None, suffix: str) -> None:
    """Reject a file name that does not end in `suffix`; `what` is the purpose of the file, for the message."""
    if path is not None and path.suffix.lower() != suffix:
        raise SurefootError(f"{what} {path}: the name must end in {suffix}")


def files_by_suffix(paths: Sequence[Path], suffixes: Sequence[str]) -> dict[str, Path]:
    """Return the files of `--out` by suffix; reject two files with the same suffix, and other suffixes."""
    files: dict[str, Path] = {}
    for path in paths:
        suffix = path.suffix.lower()
        if suffix not in suffixes or suffix in files:
            raise SurefootError(f"out {path}: the name must end in {' or '.join(suffixes)}, with one file of each")
        files[suffix] = path
    return files


def check_folder(path: Path | None) -> None:
    """Reject a file where `--out` must be a folder."""
    if path is not None and path.exists() and not path.is_dir():
        raise SurefootError(f"out is {path}; it must be a folder")


def changed_option(options: Any, names: Container[str]) -> str | None:
    """Return the first option of a dataclass that differs from its default, such as --hold-out; None if none does."""
    for item in fields(options):
        if item.name in names and getattr(options, item.name) != item.default:
            return f"--{'set' if item.name == 'settings' else item.name.replace('_', '-')}"
    return None


def make_figures_folder(path: Path | None) -> None:
    """Create the folder for results with figures, if any; fail before the run if matplotlib is not installed."""
    if path is not None:
        import_module("matplotlib")
        path.mkdir(parents=True, exist_ok=True)
