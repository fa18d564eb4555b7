"""Output of commands: results as JSON, tables of names, and suggestions for the next command."""

from __future__ import annotations

import json
import math
import shlex
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from itertools import islice
from pathlib import Path

from rich.console import Console

from surefoot.errors import SurefootError, suggest

Actions = Mapping[str, tuple[str, Callable[[list[str]], int] | str]]
"""Subcommands by name: a line of help, and a function that takes the remaining arguments and returns the exit code, or
the name of a module with such a function `main`, which is imported when it runs."""


def plugin_paths() -> list[str]:
    """Return the values of --plugin with which another command, in any folder, loads the plug-ins of this command."""
    module = sys.modules.get("surefoot.task.plugins")  # not imported without plug-ins
    plugins = [] if module is None else module.registered_plugins()
    return [str(Path(plugin.path).absolute()) if plugin.source else plugin.name for plugin in plugins]


def make_console(stderr: bool = False) -> Console:
    """Return a console that prints text unchanged, without wrapping lines."""
    return Console(stderr=stderr, highlight=False, soft_wrap=True, emoji=False, markup=False)


def print_warning(text: str) -> None:
    """Print a warning to standard error."""
    print(f"surefoot: warning: {text}", file=sys.stderr)


def print_json(result: Mapping[str, object]) -> None:
    """Print a result as one JSON object; numbers that are not finite become null."""
    print(json.dumps(_plain(result)), flush=True)


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def next_command(purpose: str, *words: object) -> str:
    """Return a line that suggests a command, such as `to resume: surefoot train --resume RUN`.

    The command works in any folder, because paths among `words` are made absolute. If it runs a policy or a task, it
    includes the plug-ins of this command.
    """
    texts = [str(word.absolute() if isinstance(word, Path) else word) for word in words]
    plugins = [] if words[0] == "show" else [word for path in plugin_paths() for word in ("--plugin", path)]
    return f"to {purpose}: {shlex.join([*_program(), *texts, *plugins])}"


def _program() -> list[str]:
    """Return the words that run this installation of surefoot from any folder: `surefoot` if it is on the PATH."""
    script, on_path = Path(sys.executable).with_name("surefoot"), shutil.which("surefoot")
    if on_path is not None and script.exists() and Path(on_path).samefile(script):
        return ["surefoot"]
    return [str(script)] if script.exists() else [sys.executable, "-m", "surefoot"]


def show_command(traces: Iterable[Path]) -> str:
    """Return a line that suggests the command to show traces (at most the first four) in the browser."""
    return next_command("look at", "show", *islice(traces, 4))


def table_lines(rows: Mapping[str, str], width: int = 0) -> str:
    """Return lines with names, in a column of at least `width` characters, and their descriptions."""
    width = max(width, *map(len, rows))
    return "\n".join(f"  {name:<{width}}  {meaning}" for name, meaning in rows.items())


def run_action(argv: list[str], command: str, actions: Actions) -> int:
    """Run the subcommand that the first argument names; without arguments, print the list of subcommands.

    Args:
        argv: arguments after the command's name.
        command: name of the command.
        actions: its subcommands.

    Raises:
        SurefootError: the first argument is not a subcommand.
    """
    if not argv or argv[0] in ("-h", "--help"):
        lines = table_lines({name: line for name, (line, _) in actions.items()})
        usage = f"usage: surefoot {command} ACTION ...\n\nactions:\n{lines}"
        print(usage, file=sys.stdout if argv else sys.stderr)
        return 0 if argv else 2
    if argv[0] not in actions:
        raise SurefootError(f"'{argv[0]}' is not an action; {suggest(argv[0], actions)}")
    run = actions[argv[0]][1]
    code: int = import_module(run).main(argv[1:]) if isinstance(run, str) else run(argv[1:])
    return code
