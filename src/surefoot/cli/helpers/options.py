"""Options that several commands share, and checks of the files and folders that options name."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated

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
        metavar="POLICY", help="Path of a policy file (.onnx), or the name of a policy that ships with surefoot."
    ),
]
PolicyNames = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    tyro.conf.arg(
        metavar="POLICY [POLICY ...]",
        help="Paths of policy files (.onnx), or names of policies that ship with surefoot.",
    ),
]
Repeated = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction]
"""Values of an option that may be given any number of times, with one or more values each time."""
Settings = Annotated[Repeated, tyro.conf.arg(name="set", metavar="NAME=VALUE [...]")]
Pushes = Annotated[
    bool, tyro.conf.arg(help="Push the robot at random, as its task says how; without this nothing pushes.")
]
PushForce = Annotated[tuple[float, float] | None, Within(0, 1e6), tyro.conf.arg(metavar="LOW HIGH")]
"""Least and greatest force of pushes [N]."""
Count = Annotated[int, Within(1, 10_000)]
"""Number of episodes or runs."""
Seed = Annotated[configuration.Seed, tyro.conf.arg(help="Seed of all random numbers.")]
Threads = Annotated[configuration.Threads, tyro.conf.arg(help="Threads of the simulation; 0 means one a core.")]
Workers = Annotated[
    configuration.Threads,
    tyro.conf.arg(help="Trainings side by side, each with one thread; 0 means one a core, or as the cluster has."),
]
Ray = Annotated[
    str | None,
    tyro.conf.arg(metavar="HOST:PORT", help="Ray cluster that trains; this machine alone, if not given."),
]
World = Annotated[str, tyro.conf.arg(help=f"Where to run: {choices(WORLDS)}.")]
Json = Annotated[bool, tyro.conf.arg(help="Print one JSON object.")]
RobotName = Annotated[
    str | None, tyro.conf.arg(help="Name or folder of the robot; the one of the policy or trace, if not given.")
]
PluginNames = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(
        name="plugin",
        metavar="FILE",
        help="Python file with reward terms and observations of your own, which is executed, or the name of an "
        "installed plug-in; as often as you like.",
    ),
]
Terrain = Annotated[
    str,
    tyro.conf.arg(
        metavar="KIND:SIZE",
        help=f"What the robot stands on: flat, {choices(KINDS)} with a size, such as stairs:0.10 [m] or slope:20 "
        "[deg], or a map of heights (.npz, .png).",
    ),
]
PAGE_PORT = 8400
"""TCP port of a page in the browser, if none is given."""
PagePort = Annotated[int, Within(0, 65535), tyro.conf.arg(help="TCP port of the page; 0 for a free one.")]
MapPort = Annotated[int | None, Within(1024, 65535), tyro.conf.arg(metavar="PORT")]
"""UDP port of the channel of maps of heights."""
Host = Annotated[
    str | None,
    tyro.conf.arg(
        metavar="ADDRESS",
        help="Address to listen at for other machines, such as 0.0.0.0; the page's address then holds a token. Without "
        "it only this machine can open the page.",
    ),
]
Port = Annotated[str, tyro.conf.arg(help="Serial port or pseudo-terminal of the robot, such as /dev/ttyUSB0.")]
Yes = Annotated[bool, tyro.conf.arg(help="Do not ask before motors move.")]


def check_terminal(place: str) -> None:
    """Refuse to move motors without --yes where there is no terminal; `place` is where the robot must be."""
    if not sys.stdin.isatty():
        raise SurefootError(f"motors will move and the robot must {place}; without a terminal, say so with --yes")


def ask_to_move(place: str) -> None:
    """Ask whether the robot is where it must be before motors move; refuse any answer but yes."""
    print(f"Motors will move. Does the robot {place}? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise SurefootError("not begun; nothing has moved")


def ask_to_release(controller: str) -> bool:
    """Ask whether a robot is to lie down, and its own controller to be released; return whether it is."""
    question = f"The robot's own controller '{controller}' is active. Let it lie down and release it? [y/N] "
    print(question, end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def check_suffix(what: str, path: Path | None, suffix: str) -> None:
    """Refuse the name of a file that does not end in `suffix`; `what` is the purpose of the file."""
    if path is not None and path.suffix.lower() != suffix:
        raise SurefootError(f"{what} {path}: the name must end in {suffix}")


def files_by_suffix(paths: Sequence[Path], suffixes: Sequence[str]) -> dict[str, Path]:
    """Return the files of `--out` by suffix, where each kind of file has one; refuse two of a kind, and other kinds."""
    files: dict[str, Path] = {}
    for path in paths:
        suffix = path.suffix.lower()
        if suffix not in suffixes or suffix in files:
            raise SurefootError(f"out {path}: the name must end in {' or '.join(suffixes)}, with one file of each")
        files[suffix] = path
    return files


def check_folder(path: Path | None) -> None:
    """Refuse a file where `--out` must be a folder."""
    if path is not None and path.exists() and not path.is_dir():
        raise SurefootError(f"out is {path}; it must be a folder")


def make_figures_folder(path: Path | None) -> None:
    """Make the folder for results with figures, if one is wanted; matplotlib must be there before anything runs."""
    if path is not None:
        import_module("matplotlib")
        path.mkdir(parents=True, exist_ok=True)
