"""`surefoot`: find and run a command, and report errors in one line."""

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
    "policies": {
        "train": "learn a gait in simulation",
        "adopt": "convert a third-party policy",
        "export": "write a policy for another framework",
    },
    "watching": {
        "show": "watch a policy in a window or as a video, or recorded runs in the browser",
        "drive": "steer, push and modify a simulated robot on a page in the browser",
    },
    "evaluation": {
        "evaluate": "measure and compare policies in simulation, and find what breaks them",
        "gap": "measure the reality gap of policies in another world, or on a robot",
    },
    "robot": {
        "robot": "import a quadruped from its URDF or MJCF, check it, and write its firmware",
        "identify": "identify a robot's physical parameters by experiments or from logs",
        "emulate": "emulate a robot: its microcontroller and physics, behind a pseudo-terminal or DDS",
        "doctor": "check a policy, the link and the robot before deployment",
        "deploy": "run a policy on a robot or an emulated robot",
    },
    "research": {
        "study": "compare groups of trainings, search hyperparameters, tune handcrafted gaits",
    },
}
"""Purpose of each command, by group; command NAME is implemented in module surefoot.cli.NAME."""
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
"""Commands of earlier versions, and their replacements."""
_USAGE = """usage: surefoot COMMAND ...

Agile gaits for quadruped robots, learned in simulation and deployed on the robot.

{commands}

surefoot COMMAND --help lists a command's options; surefoot --version prints the version."""
_MAX_ERROR_LENGTH = 2000


def program() -> int:
    """Run the command of this process, as `main` does, with a garbage collector tuned for many imported libraries."""
    # Imports create some hundred thousand permanent objects: collect garbage less often, and not at exit.
    gc.set_threshold(100_000, 20, 20)
    # surefoot draws without OpenGL, for which MuJoCo would search in a process that Ctrl-C ends with a traceback.
    os.environ.setdefault("MUJOCO_GL", "disable")
    end_when_interrupted()
    try:
        return main()
    finally:
        gc.freeze()


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command, by default of this process; return 0, 2 after an invalid input, or 130 after an interrupt."""
    try:
        code = _run(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return code
    except SurefootError as error:
        return _fail(str(error))
    except BrokenPipeError:
        # The reader of the output has closed it; redirect it, so that flushing at exit does not fail again.
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
        raise SurefootError(f"'{words[0]}' is not a command any more; use {RENAMED_COMMANDS[words[0]]}")
    if words[0] not in COMMANDS:
        raise SurefootError(f"'{words[0]}' is not a command; {suggest(words[0], COMMANDS)}")
    if not all(word.isprintable() for word in words):
        raise SurefootError("the arguments contain unprintable characters; use UTF-8 without control characters")
    enable_interrupt()
    code: int = importlib.import_module(f"surefoot.cli.{words[0]}").main(words[1:])
    return code


def _interrupted() -> int:
    print("surefoot: interrupted", file=sys.stderr)
    return INTERRUPTED


def _fail(message: str) -> int:
    """Print an error in one line. It may quote text of files, so control characters are replaced."""
    line = " ".join(message.split())
    if len(line) > _MAX_ERROR_LENGTH:
        line = f"{line[:_MAX_ERROR_LENGTH]} ..."
    line = "".join(letter if letter.isprintable() else "?" for letter in line)
    print(f"surefoot: error: {line}", file=sys.stderr)
    return 2
