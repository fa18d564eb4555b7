"""Fuzz test of the command line: run commands with damaged options and files, and report those that fail badly.

Each case takes a valid command, changes some of its words or damages a file that it reads, and runs it in a separate
process; or it sends invalid messages to a command's page, and steers after each message. Failures are a traceback, a
page that no longer responds, a timeout, an undocumented exit code, an exit code 2 without its one-line message, or a
file written to an unexpected place. A case depends only on seed and number: `--seed S --case N` repeats it and shows
its output.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import math
import os
import pkgutil
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from hostile_files import EXPANSIONS, make_models
from hostile_messages import send_messages

import surefoot
from surefoot.report.pages.messages import DeployMessage, DriveMessage, TabMessage

LIMIT = 10.0
"""Maximum processor time of a case [s]."""
PATIENCE = 12.0
"""Maximum ratio of wall time to processor time, for a busy computer."""
ANSWER = 60.0
"""Wall time within which a page must act on a command [s]."""
UNCAUGHT = 70
"""Exit code of a case that ended with a traceback."""
NUMBERS = (
    *("nan", "inf", "-inf", "1e30", "-1e30", "1e-300", "1e400", "-1", "0", "1", "2", "0.5", "-0.0", "3.7", "9" * 23),
    *("1" + "0" * 400, "9" * 6000, "-" + "9" * 6000, "0x10", "1e", "\uff11"),
)
WORDS = (
    *("", " ", "-", "--", "x", "true", "none", "null", "[", "{}", "[]", "../../x", "/", ".", "..", "/dev/zero"),
    *("/dev/null", "/proc/x", "/proc/self/mem", "\u00e9", "\udc80", "\x1b[2J", "x" * 5000, "a b", "%s", "=", "a=b"),
    *("mujoco", "trot", "minitaur", "table1", "2020-01-01", "seeds", "&a [*a]", "!!int x", "*a", "- - -"),
)
TINY = (
    "--num-envs 2 --steps-per-update 4 --steps 8 --evaluate-every 8 --evaluation-episodes 1 --task.max-steps 4 "
    "--threads 1 --learning-threads 1 --ppo.minibatches 1"
)
RUN = "--threads 1 --out out"
OUT = ("--out", "--symlink", "--params")
"""Options that name output files."""
SAFETY = 3
"""Exit code of a deployment that a safety rule ended, for example on a computer that is too slow."""
CODES = {
    **{"study": {1, 130}, "train": {130}, "drive": {130}, "deploy": {SAFETY}, "doctor": {3}, "identify": {3}},
    "robot": {3},
}
"""Documented exit codes other than 0 and 2."""
COMMANDS = {
    "train options": f"train trot {TINY} --out out",
    "evaluate options": f"evaluate @policy.onnx --episodes 1 {RUN}",
    "gap options": f"gap @policy.onnx --to mujoco --episodes 1 --duration 0.03 {RUN}",
    "sensitivity options": (
        f"evaluate sensitivity @policy.onnx --values 2 --episodes 1 --duration 0.03 --ranges @ranges.yaml {RUN}"
    ),
    "show options": "show @policy.onnx --duration 0.03 --out out/a.mp4",
    "study options": "study @study.yaml --report-only --out out",
    "search options": "study search @task.yaml --space @space.yaml --report-only --out out/search",
    "space": "study search @task.yaml --space @@space.yaml --report-only --out out/search",
    "deploy options": "deploy @policy.onnx --port nowhere --duration 0.03 --out out",
    "doctor options": "doctor @policy.onnx --port nowhere",
    "identify options": "identify latency --recording @recording.npz --params out/robot.toml --out out",
    "motor figure options": "identify motor-figure --duration 0.03 --out out/a.png",
    "trace fit options": "identify --trace @trace.npz --out out",
    "emulate options": "emulate --duration 0.02",
    "task": f"train @@task.yaml {TINY} --out out",
    "table of poses": f"train table.yaml {TINY} --out out --task.reference.file @@poses.csv",
    "ranges": f"evaluate @policy.onnx --episodes 1 --randomize @@ranges.yaml {RUN}",
    "study": "study @@study.yaml --report-only --out out",
    "sheet": f"evaluate @policy.onnx --episodes 1 --robot @@robot/robot.toml {RUN}",
    "urdf": f"evaluate @policy.onnx --episodes 1 --robot @@robot/minitaur.urdf {RUN}",
    "params": f"evaluate @policy.onnx --episodes 1 --params @@params.toml {RUN}",
    "policy": f"evaluate @@policy.onnx --episodes 1 {RUN}",
    "policy to deploy": "deploy @@policy.onnx --port nowhere --out out",
    "trace": "evaluate --trace @@trace.npz --out out",
    "trace in a gap": "gap @policy.onnx --from trace @trace.npz --to trace @@trace.npz --out out",
    "recording": "identify latency --recording @@recording.npz --params out/robot.toml --out out",
    "motor log": "identify motor-figure --log @@log.csv --out out/a.png",
    "run folder": "train --resume @@run/config.yaml",
    "run's papers": "train --resume @@run/run.json",
    "checkpoint": "train --resume @@run/checkpoints/latest.ckpt",
    "mjcf": "robot new @@dog.xml --out out --name dog",
    "collada": "robot new @@meshed/body.dae --out out --name dog",
    "foreign urdf": "robot new @@meshed/dog.urdf --out out --name dog",
    "messages to drive": "drive go2-steer --page-port 0 --out out",
    "messages to train": (
        "train steer --robot go2 --num-envs 2 --steps-per-update 16 --steps 100000000 --evaluate-every 100000000 "
        "--evaluation-episodes 1 --task.max-steps 60 --threads 1 --learning-threads 1 --browser --page-port 0 --out out"
    ),
    "messages to deploy": "deploy go2-steer --port EMULATED --browser --page-port 0 --out out",
}
"""Valid commands by kind of case; `@file` is an unchanged seed file, `@@file` a damaged one."""
PAGES: dict[str, type[TabMessage]] = {
    "messages to drive": DriveMessage,
    "messages to train": DriveMessage,
    "messages to deploy": DeployMessage,
}
"""Kinds whose page receives messages, and the type of its messages."""
MESSAGES = 25
"""Number of messages to the page of a case."""
EMULATED = "emulate --robot go2 --ideal-sensors --set servo_kp=40 servo_kd=1"
"""Command of the robot on the port EMULATED."""
OPTIONS = {
    "train options": ("learn.config:TrainConfig", 2),
    "evaluate options": ("cli.evaluate:EvaluateCommand", 1),
    "gap options": ("cli.gap:GapCommand", 1),
    "sensitivity options": ("cli.evaluate_sensitivity:SensitivityCommand", 2),
    "show options": ("cli.show:ShowPolicyCommand", 1),
    "study options": ("cli.study:StudyCommand", 1),
    "search options": ("cli.study_search:SearchCommand", 2),
    "deploy options": ("cli.deploy:DeployCommand", 1),
    "doctor options": ("cli.doctor:DoctorCommand", 1),
    "identify options": ("cli.helpers.identify_run:ExperimentCommand", 2),
    "motor figure options": ("cli.helpers.identify_motor_figure:MotorFigureCommand", 2),
    "trace fit options": ("cli.identify:TracesCommand", 3),
    "emulate options": ("cli.emulate:EmulateCommand", 3),
}
"""Kinds whose words are changed: class that declares the options, and number of first words that are kept."""
WHOLE_FOLDERS = {"robot": "robot", "run": "run", "meshed": "meshed/dog.urdf"}
"""Seed folders that are copied as a whole, and the path in each that the command receives."""


@dataclass(frozen=True)
class Case:
    """Case and its result."""

    number: int
    kind: str
    words: tuple[str, ...]
    code: int = 0
    """Exit code, or the negative number of the signal that ended the process."""
    seconds: float = 0.0
    output: str = ""
    fault: str = ""
    """Description of the failure; empty if there is none."""


class Fuzz:
    """Runner of cases in a folder.

    Args:
        root: an empty folder.
        seed: seed of all cases.
        limit: maximum processor time of a case [s].
        kinds: names of kinds to choose from; defaults to all.
    """

    def __init__(self, root: Path, seed: int, limit: float = LIMIT, kinds: Sequence[str] = ()) -> None:
        self.seed, self.limit = seed, limit
        self.seeds, self.place = root / "seeds", root / "a" / "b" / "case"
        self.root = root
        self.seeds.mkdir()
        self.kinds = kinds or tuple(COMMANDS)
        words = [word for kind in self.kinds for word in COMMANDS[kind].split()]
        make_seeds(self.seeds, {word.lstrip("@") for word in words if "@" in word})
        self._seeds_state = _state(self.seeds)
        self._options: dict[str, list[str]] = {}

    def run(self, number: int) -> Case:
        """Run the case with a number."""
        rng = random.Random(f"{self.seed} {number}")
        kind = rng.choice(self.kinds)
        shutil.rmtree(self.root / "a", ignore_errors=True)
        self.place.mkdir(parents=True)
        words = [self._prepare_word(word, rng) for word in COMMANDS[kind].split()]
        (self.place / "table.yaml").write_text("reference: {kind: table, period: 0.5, file: none.csv}\n")
        if kind in OPTIONS:
            words = self._change_words(words, kind, rng)
        before = _state(self.root)
        if kind in PAGES:
            return self._visit(number, kind, words, rng, before)
        case = Case(number, kind, tuple(words), *_run(words, self.place, self.limit))
        return replace(case, fault=self._find_fault(case, before))

    def _visit(
        self, number: int, kind: str, words: list[str], rng: random.Random, before: dict[str, tuple[int, int]]
    ) -> Case:
        """Run a command that serves a page, send messages to the page, and end the command with Ctrl-C."""
        patience, fault = self.limit * PATIENCE, ""
        with contextlib.ExitStack() as stack:
            if "EMULATED" in words:
                robot = stack.enter_context(_Command(EMULATED.split(), self.place))
                words = [robot.wait_for(r"robot on (\S+)", patience) if word == "EMULATED" else word for word in words]
            page = stack.enter_context(_Command(words, self.place))
            try:
                address = page.wait_for(r"(http://localhost:\d+/)", patience)
                if words[0] == "deploy" and rng.random() < 0.5:
                    page.wait_for(r"surefoot: (run) \(", patience)  # its motors turn
                fault = send_messages(address, PAGES[kind], rng, MESSAGES, ANSWER)
            except TimeoutError as error:
                fault = str(error)
            page.interrupt()
            code, seconds = page.wait(patience)
            output = page.read()
        # The page works continuously, so that its processor time depends on the length of the case.
        case = Case(number, kind, tuple(words), code, math.inf if math.isinf(seconds) else 0.0, output)
        if "the page's process has ended" in output:
            fault = fault or "its page has ended"
        elif code == SAFETY:
            fault = ""
        return replace(case, fault=fault or self._find_fault(case, before))

    def _prepare_word(self, word: str, rng: random.Random) -> str:
        """Return a word of the command, and create its file, damaged if marked so."""
        if not word.startswith("@"):
            return word
        name = word.lstrip("@")
        top = Path(name).parts[0]
        if not word.startswith("@@"):
            return str(self.seeds / name)
        if top in WHOLE_FOLDERS:
            shutil.copytree(self.seeds / top, self.place / top)
        damage(self.seeds / name, self.place / name, rng)
        return WHOLE_FOLDERS.get(top, name)

    def _change_words(self, words: list[str], kind: str, rng: random.Random) -> list[str]:
        """Return words with up to three changes."""
        from surefoot.cli.helpers.parsing import options

        where, keep = OPTIONS[kind]
        if kind not in self._options:
            module, name = where.split(":")
            declared = getattr(importlib.import_module(f"surefoot.{module}"), name)
            # No window can be opened here.
            self._options[kind] = [option for option in options(declared) if option != "--viewer"]
        words = list(words)
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            option = rng.choice(self._options[kind])
            value = rng.choice(NUMBERS if rng.random() < 0.6 else WORDS)
            places = [k for k in range(keep, len(words)) if not words[k].startswith("--")]
            what = rng.random()
            if what < 0.25 and places:
                words[rng.choice(places)] = value
            elif what < 0.35 and places:
                del words[rng.choice(places)]
            elif what < 0.4:
                words.append(value)
            elif what < 0.45:
                words.append(option)
            elif what < 0.5:
                words.append(f"{option}={value}")
            elif option in words[keep:]:
                words[words.index(option, keep) + 1 :][:1] = [value]
            else:
                words += [option, value, *([rng.choice(NUMBERS)] if rng.random() < 0.2 else [])]
        return words

    def _find_fault(self, case: Case, before: dict[str, tuple[int, int]]) -> str:
        """Return the failure of a case, or an empty string."""
        allowed = {0, 2, *CODES.get(case.words[0], set())}
        if case.seconds > self.limit:
            return f"takes more than {self.limit:g} s"
        if case.code == UNCAUGHT or "Traceback (most recent" in case.output:
            return f"a traceback: {case.output.strip().splitlines()[-1][:200]}"
        if case.code not in allowed:
            return f"exit code {case.code}"
        lines = [line for line in case.output.splitlines() if line.startswith("surefoot: error: ")]
        if case.code == 2 and len(lines) != 1:
            return f"exit code 2 with {len(lines)} lines that say why"
        if case.words[0] == "robot" and case.code == 2 and (self.place / "out" / "robot.toml").exists():
            return "exit code 2 and a robot's folder"
        after = _state(self.root)
        if self._seeds_state != _state(self.seeds):
            return "a file that is read was written"
        named = [self.place / "run" / name for name in ("", "x")][:1] if "--resume" in case.words else []
        for option, value in zip(case.words, case.words[1:], strict=False):
            if option in OUT and "\0" not in value:
                named.append(Path(os.path.normpath(self.place / value)))
            elif (parts := option.partition("="))[0] in OUT:
                named.append(Path(os.path.normpath(self.place / parts[2])))
        for path in sorted(set(before.items()) ^ set(after.items())):
            changed = self.root / path[0]
            if not any(place == changed or place in changed.parents or changed in place.parents for place in named):
                return f"writes {path[0]}"
        return ""


def _state(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and modification time of all files in a folder, by relative path; zeros for folders."""
    state = {}
    for path in folder.rglob("*"):
        about = path.lstat()
        state[str(path.relative_to(folder))] = (0, 0) if path.is_dir() else (about.st_size, about.st_mtime_ns)
    return state


class _Command:
    """Command in a forked child of this process, which has imported everything; it ends with the context."""

    def __init__(self, words: Sequence[str], place: Path) -> None:
        self._output = tempfile.TemporaryFile()  # noqa: SIM115
        self._child = os.fork()
        if self._child == 0:
            _child(words, place, self._output.fileno())
        self._code: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.wait(0.0)
        self._output.close()

    def read(self) -> str:
        """Return the output so far."""
        # The file offset is shared with the child, and must not change.
        return os.pread(self._output.fileno(), 1 << 20, 0).decode(errors="replace")

    def wait_for(self, pattern: str, patience: float) -> str:
        """Wait until the output matches a pattern; return the match of its group.

        Raises:
            TimeoutError: the command ended first, or `patience` [s] is over.
        """
        end = time.monotonic() + patience
        while (match := re.search(pattern, self.read())) is None:
            if time.monotonic() > end or self._has_ended():
                raise TimeoutError(f"it has not printed {pattern}")
            time.sleep(0.02)
        return match[1]

    def _has_ended(self) -> bool:
        about = os.waitid(os.P_PID, self._child, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        return about is not None

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        os.kill(self._child, signal.SIGINT)  # a child that has ended is there until `wait`

    def wait(self, patience: float) -> tuple[int, float]:
        """Wait for the end of the command; kill it after `patience` [s].

        Returns:
            Exit code and processor time [s], which is infinite if it was killed.
        """
        if self._code is None:
            end, killed = time.monotonic() + patience, False
            while True:
                done, status, used = os.wait4(self._child, os.WNOHANG)
                if done:
                    break
                if time.monotonic() > end:
                    killed, end = True, math.inf
                    os.kill(self._child, signal.SIGKILL)
                time.sleep(0.01)
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._child, signal.SIGKILL)  # processes that it may have left
            self._code = os.waitstatus_to_exitcode(status)
            self._seconds = math.inf if killed else used.ru_utime + used.ru_stime
        return self._code, self._seconds


def _run(words: Sequence[str], place: Path, limit: float) -> tuple[int, float, str]:
    """Run a command, and kill it if it takes too long.

    Returns:
        Exit code, processor time [s] (infinite if it was killed), and output.
    """
    with _Command(words, place) as command:
        return *command.wait(limit * PATIENCE), command.read()


def _child(words: Sequence[str], place: Path, output: int) -> None:
    """Run a case in this process and end it."""
    code = UNCAUGHT
    try:
        os.setsid()
        os.chdir(place)
        nowhere = os.open(os.devnull, os.O_RDONLY)
        for target, source in ((0, nowhere), (1, output), (2, output)):
            os.dup2(source, target)
        sys.stdin = io.TextIOWrapper(io.FileIO(0, "r", closefd=False))
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), encoding="utf-8", write_through=True)
        sys.stderr = io.TextIOWrapper(
            io.FileIO(2, "w", closefd=False), encoding="utf-8", errors="backslashreplace", write_through=True
        )
        from surefoot.api import episodes, training
        from surefoot.cli.main import main

        # The figures and video of each training would take most of the time.
        training.finish_run = lambda *_: {}
        episodes.print_summaries = lambda *_: None
        try:
            code = main(list(words))
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


# --- files ------------------------------------------------------------------------------------------------


def damage(source: Path, target: Path, rng: random.Random) -> None:
    """Write a damaged copy of a file, with one to four changes of bytes, words, numbers or values."""
    content = source.read_bytes()
    kinds: dict[str, Callable[[bytes, random.Random], bytes]] = {".npz": _archive, ".onnx": _policy, **EXPANSIONS}
    inside = kinds.get(source.suffix)
    if inside is not None and rng.random() < 0.7:
        content = inside(content, rng)
    elif source.suffix in (".npz", ".onnx", ".ckpt"):
        content = _bytes(content, rng)
    else:
        for _ in range(rng.choice((1, 1, 2, 4))):
            content = _bytes(content, rng) if rng.random() < 0.15 else _text(content, rng)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(content)


def _bytes(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    at = rng.randrange(len(data) + 1)
    what = rng.randrange(5)
    if what == 0:
        return bytes(data[:at])
    if what == 1:
        del data[at : at + rng.randrange(1, 100)]
    elif what == 2:
        data[at:at] = rng.randbytes(rng.randrange(1, 100))
    elif what == 3:
        data[at:at] = data[at : at + rng.randrange(1, 1000)]
    else:
        for _ in range(rng.randrange(1, 20)):
            data[rng.randrange(max(len(data), 1)) : 0] = b""
            if data:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _replace(text: str, match: re.Match[str], values: Sequence[str], rng: random.Random) -> str:
    return text[: match.start()] + rng.choice(values) + text[match.end() :]


def _text(content: bytes, rng: random.Random) -> bytes:
    text = content.decode(errors="surrogateescape")
    numbers = list(re.finditer(r"(?<![\w.])-?\d[\d.eE+-]*", text))
    words = list(re.finditer(r"[A-Za-z_][\w.-]*", text))
    lines = text.splitlines(keepends=True)
    what = rng.random()
    if what < 0.45 and numbers:
        text = _replace(text, rng.choice(numbers), NUMBERS if rng.random() < 0.8 else WORDS, rng)
    elif what < 0.7 and words:
        text = _replace(text, rng.choice(words), WORDS if rng.random() < 0.7 else NUMBERS, rng)
    elif lines:
        at = rng.randrange(len(lines))
        rest = lines[:at] + lines[at + 1 :]
        if what < 0.85:
            rest[at:at] = [] if what < 0.78 else [lines[at]] * 2
        elif what < 0.9:
            rest[at:at] = [f"{rng.choice(WORDS)}: {rng.choice((*WORDS, *NUMBERS))}\n", lines[at]]
        else:
            other = rng.randrange(len(lines))
            rest[at:at] = [lines[other]]
        text = "".join(rest)
    return text.encode(errors="surrogateescape" if "\udc80" not in text else "replace")


def _leaf(value: Any, rng: random.Random) -> Any:
    """Return JSON data with one value at any depth replaced, dropped or renamed."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if (what := rng.random()) < 0.1:
            return {name: item for name, item in value.items() if name != key}
        if what < 0.2:
            return {**value, rng.choice(WORDS[4:]): value[key]}
        return {**value, key: _leaf(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        return [*value[:at], *([] if rng.random() < 0.2 else [_leaf(value[at], rng)]), *value[at + 1 :]]
    return rng.choice(
        (None, True, 0, -1, 1, 2, 0.5, 1e30, 10**400, float("nan"), float("inf"), "", "x", "../../x", "\x1b[2J",
         "\udc80", [], {}, [[]], [0] * 10, "x" * 5000, {"a": {"b": [None]}})
    )  # fmt: skip


def _archive(content: bytes, rng: random.Random) -> bytes:
    """Return an archive of arrays with changed metadata or a changed array."""
    with np.load(io.BytesIO(content)) as archive:
        arrays = dict(archive)
    name = "meta" if rng.random() < 0.6 else rng.choice(sorted(arrays))
    if name == "meta":
        arrays[name] = np.array(json.dumps(_leaf(json.loads(str(arrays[name])), rng)))
    else:
        array, what = arrays[name], rng.randrange(7)
        if what == 0:
            array = array[: rng.randrange(len(array))]
        elif what == 1:
            array = array.reshape(-1)
        elif what == 2:
            array = np.full_like(array, rng.choice((np.nan, np.inf, -1e30, 0.0, 1e308)))
        elif what == 3:
            array = array.astype(rng.choice(("U5", "c16", "i1", "?", "f2")))
        elif what == 4:
            array = np.array(rng.choice((0.0, "x")))
        elif what == 5:
            array = array[::-1]
        else:
            array = array.copy()
            array.reshape(-1)[rng.randrange(array.size)] = rng.choice((np.nan, np.inf, 1e30, -1.0, 0.0))
        arrays[name] = array
        if rng.random() < 0.1:
            del arrays[name]
    if "sent_number" in arrays and rng.random() < 0.8:
        arrays = _signed(arrays)
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _signed(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return a recording's arrays with a matching digest, if they have one."""
    from surefoot.identify.recording import digest_arrays

    try:
        meta = json.loads(str(arrays["meta"]))
        meta["digest"] = digest_arrays({name: array for name, array in arrays.items() if name != "meta"})
    except (KeyError, TypeError, ValueError):
        return arrays
    return {**arrays, "meta": np.array(json.dumps(meta))}


def _policy(content: bytes, rng: random.Random) -> bytes:
    """Return a policy with a changed contract and a matching digest."""
    import onnx

    from surefoot.policy.contract import METADATA_KEY
    from surefoot.policy.digest import add_digest

    model = onnx.load(io.BytesIO(content))
    (entry,) = (entry for entry in model.metadata_props if entry.key == METADATA_KEY)
    text = json.dumps(_leaf(json.loads(entry.value), rng))
    onnx.helper.set_model_props(model, {METADATA_KEY: text})
    return add_digest(model.SerializeToString())


def make_seeds(folder: Path, names: set[str]) -> None:
    """Write the valid files that cases damage.

    Args:
        folder: an empty folder.
        names: files that cases read; files that need a simulation are written only if they are among these.
    """
    import onnx

    from surefoot.api.policies import find_policy
    from surefoot.policy.contract import METADATA_KEY
    from surefoot.policy.digest import add_digest
    from surefoot.robot import RobotDescription

    model = onnx.load(find_policy("trot"))
    (entry,) = (entry for entry in model.metadata_props if entry.key == METADATA_KEY)
    contract = json.loads(entry.value)
    contract["task"]["max_steps"] = 5
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(contract)})
    (folder / "policy.onnx").write_bytes(add_digest(model.SerializeToString()))
    robot = RobotDescription.load("minitaur")
    shutil.copytree(robot.folder, folder / "robot")
    (folder / "params.toml").write_text(
        'robot = "minitaur"\n[params]\nvoltage = 15.4\nimu_bias = [0.01, 0.02]\nmotor_strength = 0.9\n'
        '[sensors]\nage = 0.001\n[identified.motor]\ndate = "2020-01-01"\n'
    )
    (folder / "ranges.yaml").write_text("base_mass_ratio: [0.9, 1.1]\nvoltage: [14.0, 16.0]\ncontrol_latency: null\n")
    (folder / "task.yaml").write_text(
        "name: mine\nrobot: minitaur\nobservations: [roll, pitch, roll_rate, pitch_rate, motor_angles]\nhistory: 2\n"
        "reference:\n  kind: sine\n  swing: {amplitude: 0.3, frequency: 2.0, phase: 0.5, offset: 0.0}\n"
        "  extension: {amplitude: 0.2, frequency: 2.0, offset: 1.6}\nfeedback: {swing: [-0.2, 0.2], extension: [-0.2, "
        "0.2]}\nreward: {progress: 1.0, energy: -0.005}\n"
        "fall_angle: 0.5\nmax_steps: 4\npushes: {enabled: true, period: 1.2, duration: "
        "0.06, force: [10, 20]}\nrandomize: table1\nparams: {voltage: 15.0}\nactuator: dc\ntrain:\n  seed: 3\n"
        "  ppo: {gamma: 0.99, policy_hidden: [8, 8], learning_rate: 0.001}\n"
    )
    (folder / "study.yaml").write_text(
        "name: tiny\ntask: trot\nseeds: [0, 1]\ntrain: {steps: 100, ppo: {gamma: 0.99}}\ngroups:\n"
        "  plain: {label: a, train: {task: {pushes: {enabled: false}, randomize: none}}}\n"
        "  drawn: {label: b, train: {task: {randomize: table1}}}\nevaluate: [nominal, gap]\ncompare: [[plain, drawn]]\n"
        "bars: {both: [plain, drawn]}\nfindings: [{groups: [plain, drawn], text: nothing}]\n"
    )
    (folder / "space.yaml").write_text(
        "ppo.learning_rate: {low: 0.0001, high: 0.01, log: true}\nppo.policy_hidden.0: {low: 8, high: 16, int: true}\n"
        "task.reward.energy: {choices: [-0.001, -0.01]}\n"
    )
    header = [f"{part}_{leg}" for part in ("swing", "extension") for leg in robot.leg_names]
    rows = [[str(0.1 * k)] * 4 + ["1.6"] * 4 for k in range(4)]
    (folder / "poses.csv").write_text("\n".join(",".join(row) for row in (header, *rows)) + "\n")
    log = "".join(f"{0.006 * k:.3f},{1.5 + 0.01 * k:.3f},{1.5 + 0.009 * k:.3f}\n" for k in range(12))
    (folder / "log.csv").write_text("time,target,angle\n" + log)
    _make_recording(folder / "recording.npz", robot)
    if "trace.npz" in names:
        _work(folder, "evaluate", "policy.onnx", "--episodes", "1", "--out", "made", "--threads", "1")
        (folder / "made" / "episode_000.npz").rename(folder / "trace.npz")
    if names & {"dog.xml", "meshed/body.dae", "meshed/dog.urdf"}:
        make_models(folder)
    if any(name.startswith("run/") for name in names):
        _work(folder, "train", "task.yaml", *TINY.split(), "--out", "made")
        (run,) = (path.parent for path in folder.glob("made/*/*/run.json"))
        run.rename(folder / "run")
    shutil.rmtree(folder / "made", ignore_errors=True)


def _work(place: Path, *words: str) -> None:
    """Run a command that writes seed files."""
    code, _, output = _run(words, place, 100.0)
    if code != 0:
        raise RuntimeError(f"a command that should work does not: {' '.join(words)}\n{output}")


def _make_recording(path: Path, robot: Any) -> None:
    """Write a recording of some tenths of a second in which all motors move back and forth."""
    from surefoot.identify.recording import COMPLETE, SCHEMA, Recording, digest_arrays

    count, motors = 500, robot.num_motors
    time_, columns = 0.006 * np.arange(count), {"roll_pitch_yaw": 3, "angular_velocity_base": 3, "": motors}
    wide = ("sent_value", "motor_angle", "motor_velocity", "motor_torque", "temperature", *columns)
    arrays: dict[str, Any] = {}
    for item in fields(Recording):
        if item.name in ("time", "host_time", "sent_time"):
            arrays[item.name] = time_ + 0.001
        elif item.name in ("command", "sent_number"):
            arrays[item.name] = np.arange(float(count))
        elif item.name in wide:
            width = columns.get(item.name, motors)
            arrays[item.name] = 1.5 + 0.3 * np.sin(20 * time_)[:, None] * np.ones(width)
        elif item.name not in ("meta", "robot_archive"):
            arrays[item.name] = np.full(count, 16.0 if item.name == "voltage" else 0.0)
    meta = {
        **{"schema": SCHEMA, "experiment": "latency", "robot": robot.name, "motor_names": list(robot.motor_names)},
        **{"rack": True, "mode_changes": [[0.0, 1]], "ended": COMPLETE, "period": 0.006, "lead": 0.0},
        "phases": [{"name": "steps", "mode": 1, "use": "fit", "duration": 3.0}],
        **{"servo_period": 0.001, "resting_states": 5, "frames": {"received": count, "missing": 0, "damaged": 0}},
        **{"date": "2020-01-01", "digest": digest_arrays(arrays)},
    }
    Recording(**arrays, meta=meta).save(path)


def import_all() -> None:
    """Import all modules, so that forked processes do not have to."""
    for module in pkgutil.walk_packages(surefoot.__path__, "surefoot."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)


def main() -> int:
    """Run cases and print failures; return 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cases", type=int, default=3000, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="seed of all cases")
    parser.add_argument("--case", type=int, help="run only this case, and show its output")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--minutes", type=float, default=math.inf, help="time after which no case is started [min]")
    parser.add_argument("--limit", type=float, default=LIMIT, help="maximum processor time of a case [s]")
    parser.add_argument("--kind", action="append", default=[], choices=COMMANDS, help="only cases of this kind")
    options = parser.parse_args()
    os.environ.setdefault("MPLBACKEND", "Agg")
    import_all()
    codes: dict[str, Counter[str]] = {name: Counter() for name in COMMANDS}
    wrong, done, end = 0, 0, time.monotonic() + 60 * options.minutes
    numbers = [options.case] if options.case is not None else range(options.first, options.first + options.cases)
    with tempfile.TemporaryDirectory(prefix="surefoot-fuzz-") as folder:
        fuzz = Fuzz(Path(folder), options.seed, options.limit, options.kind)
        if len(numbers) > 100:  # so that no case has to compile the engines' loops
            _work(Path(folder), "evaluate", str(fuzz.seeds / "policy.onnx"), "--episodes", "1", *RUN.split())
        for number in numbers:
            if time.monotonic() > end:
                print(f"time is up: continue with --first {number} --cases {len(numbers) - done}")
                break
            case = fuzz.run(number)
            done += 1
            codes[case.kind]["wrong" if case.fault else f"exit {case.code}"] += 1
            if options.case is not None:
                print(case.output)
            if case.fault or options.case is not None:
                wrong += bool(case.fault)
                shown = " ".join(repr(word if len(word) < 80 else f"{word[:60]}...") for word in case.words)
                print(
                    f"seed {options.seed} case {number} ({case.kind}, {case.seconds:.1f} s): {case.fault or 'passed'}"
                )
                print(f"    {shown}", flush=True)
    for name, counter in codes.items():
        if counter:
            counts = ", ".join(f"{count} {what}" for what, count in sorted(counter.items()))
            print(f"{name:<22}{sum(counter.values()):>6} cases: {counts}")
    print(f"{wrong} of {done} cases failed")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
