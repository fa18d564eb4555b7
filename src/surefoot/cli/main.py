"""`surefoot`: find and run a command, report errors in one line."""

from __future__ import annotations

import gc
import importlib
import os
import sys
from collections.abc import Sequence

from surefoot import __version__
from surefoot.api.extras import describe_missing
from surefoot.cli.helpers.output import table_lines
from surefoot.errors import SurefootError, suggest
from surefoot.stop_signals import INTERRUPTED, enable_interrupt, end_when_interrupted, was_interrupted

GROUPS = {
    "make a gait": {
        "train": "learn a gait in simulation",
        "adopt": "bring in a policy that others trained",
        "export": "write a policy for another deployer",
    },
    "look at it": {
        "show": "watch a policy in a window or as a video, and recorded runs in the browser",
        "drive": "steer, push and change a simulated robot, on a page in the browser",
    },
    "measure it": {
        "evaluate": "measure policies in simulation, side by side, and find what breaks them",
        "gap": "measure what policies lose in another world, or on a robot",
    },
    "robot": {
        "robot": "describe any quadruped from its URDF or MJCF, check it, write its firmware",
        "identify": "identify a robot's parameters by experiments or from logs; replay a recorded run",
        "emulate": "emulate a robot: microcontroller and physics behind a pseudo-terminal",
        "doctor": "check a policy, a link and a robot before it runs",
        "deploy": "run a policy on a robot, or on an emulated one",
    },
    "science": {
        "study": "compare groups of trainings, search settings, tune handcrafted gaits, report on the paper",
    },
}
"""Purpose of each command, by the heading of its group; command NAME is module surefoot.cli.NAME."""
COMMANDS = {name: purpose for group in GROUPS.values() for name, purpose in group.items()}
RENAMED_COMMANDS = {
    "play": "surefoot show POLICY, or for its --browser surefoot drive POLICY",
    "compare": "surefoot evaluate POLICY POLICY",
    "sensitivity": "surefoot evaluate sensitivity POLICY",
    "replay": "surefoot identify replay TRACE",
    "trace": "surefoot identify import LOG",
    "firmware": "surefoot robot firmware",
    "search": "surefoot study search TASK",
    "tune": "surefoot study tune",
    "paper": "surefoot study paper",
}
"""Commands of earlier versions, and what to type now."""
_USAGE = """usage: surefoot COMMAND ...

Agile gaits for quadruped robots, learned in simulation and carried to the robot.

{commands}

surefoot COMMAND --help lists a command's options; surefoot --version prints the version."""
_MAX_ERROR_LENGTH = 2000


def program() -> int:
    """Run the process's own command, as `main`; imported libraries cost less time."""
    # They make some hundred thousand objects, which stay: searched for garbage less often, and not at the end.
    gc.set_threshold(100_000, 20, 20)
    end_when_interrupted()
    try:
        return main()
    finally:
        gc.freeze()


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, by default that of the process; return 0, 2 for an error of the user, or 130 when interrupted."""
    try:
        code = _run(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return code
    except SurefootError as error:
        return _fail(str(error))
    except BrokenPipeError:
        # The reader of the output is gone: nothing more can be written, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}")
    except ModuleNotFoundError as error:
        if hint := describe_missing(error):
            return _fail(hint)
        raise
    except KeyboardInterrupt:
        return _interrupted()
    except Exception:
        if was_interrupted():
            return _interrupted()
        raise


def _run(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        width = max(map(len, COMMANDS))
        groups = "\n\n".join(f"{title}:\n{table_lines(group, width)}" for title, group in GROUPS.items())
        print(_USAGE.format(commands=groups), file=sys.stdout if words else sys.stderr)
        return 0 if words else 2
    if words[0] == "--version":
        print(f"surefoot {__version__}")
        return 0
    if words[0] in RENAMED_COMMANDS:
        raise SurefootError(f"'{words[0]}' is no command any more; type {RENAMED_COMMANDS[words[0]]}")
    if words[0] not in COMMANDS:
        raise SurefootError(f"'{words[0]}' is not a command; {suggest(words[0], COMMANDS)}")
    if not all(word.isprintable() for word in words):
        raise SurefootError("the arguments hold characters that can't be printed; use UTF-8 without control characters")
    enable_interrupt()
    code: int = importlib.import_module(f"surefoot.cli.{words[0]}").main(words[1:])
    return code


def _interrupted() -> int:
    print("surefoot: interrupted", file=sys.stderr)
    return INTERRUPTED


def _fail(message: str) -> int:
    """Print an error in one line. Text of files in it must not control the terminal."""
    line = " ".join(message.split())
    if len(line) > _MAX_ERROR_LENGTH:
        line = f"{line[:_MAX_ERROR_LENGTH]} ..."
    line = "".join(letter if letter.isprintable() else "?" for letter in line)
    print(f"surefoot: error: {line}", file=sys.stderr)
    return 2
