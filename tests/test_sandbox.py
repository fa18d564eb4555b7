"""Isolated processes: what they can't do, and how their results are reported."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from surefoot import sandbox
from surefoot.sandbox import Limits, ProcessResult, run_module

LIMITS = "sandbox.Limits(memory=16 << 30, time=60, timeout=60)"


@pytest.mark.skipif(not sandbox.is_supported(), reason="this machine does not support the system call filter")
@pytest.mark.parametrize(
    "action",
    [
        "open('/etc/passwd')",
        "open('/tmp/surefoot-was-here', 'w')",
        "__import__('socket').socket()",
        "__import__('os').fork()",
        "__import__('os').execv('/bin/true', ['true'])",
        "__import__('os').kill(__import__('os').getppid(), 0)",
        "bytearray(64 << 30)",
    ],
)
def test_a_sandboxed_process_can_only_compute(action: str):
    enter = f"import socket, os\nfrom surefoot import sandbox\nsandbox.enter_sandbox({LIMITS})\n"
    script = f"{enter}print(sum(range(9)))\n{action}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stdout == "36\n"
    assert done.returncode != 0
    assert done.stderr.rstrip().splitlines()[-1].startswith(("PermissionError", "MemoryError"))


SIGNAL = """
from ctypes import CDLL, get_errno
libc = CDLL(None, use_errno=True)
def signal(process):
    return libc.tgkill(process, process, 0), get_errno()
sandbox.enter_sandbox(sandbox.LIMITS)
print(signal(os.getppid()), signal(1), signal(os.getpid()))
libc.abort()
"""


@pytest.mark.skipif(not sandbox.is_supported(), reason="this machine does not support the system call filter")
def test_a_sandboxed_process_can_signal_only_itself():
    script = f"import os\nfrom surefoot import sandbox\n{SIGNAL.replace('sandbox.LIMITS', LIMITS)}"
    done = subprocess.run([sys.executable, "-uc", script], capture_output=True, text=True, check=False)
    assert done.stdout == f"{(-1, errno.EPERM)} {(-1, errno.EPERM)} (0, {errno.EPERM})\n"
    assert done.returncode == -signal.SIGABRT


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that runs Python source as a module within limits."""

    def run(text: str, limits: Limits, data: bytes = b"") -> ProcessResult:
        start = f"from surefoot import sandbox\nsandbox.limit_resources(sandbox.{limits})\n"
        (tmp_path / "stranger_program.py").write_text(start + text)
        monkeypatch.syspath_prepend(tmp_path)
        return run_module("stranger_program", ["a word"], limits, data)

    return run


QUICK = Limits(memory=1 << 30, time=1.0, timeout=20.0)


def test_output_and_messages_are_separate(program):
    text = "import sys\nfile = sandbox.claim_stdout()\nprint('noise')\nfile.write(sys.stdin.buffer.read() * 2)"
    assert program(text, QUICK, b"\0x") == ProcessResult(0, b"\0x\0x", "noise")
    assert program("import sys\nprint(sys.argv[1], file=sys.stderr)\nsys.exit(2)", QUICK) == ProcessResult(
        2, b"", "a word"
    )


def test_a_process_sees_no_passwords(program, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("WANDB_API_KEY", "secret")
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    text = "import os, sys\nprint(os.environ.get('WANDB_API_KEY'), os.environ.get('LC_ALL'), file=sys.stderr)"
    assert program(text, QUICK).message == "None C.UTF-8"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("while True: pass", "it ran out of time"),
        ("x = bytearray(2 << 30)", "MemoryError"),
        ("import os\nos.kill(os.getpid(), 11)", "it was ended by SIGSEGV"),
        ("import os\nos._exit(7)", "it exited with code 7"),
    ],
)
def test_a_failed_process_reports_the_reason(program, text: str, reason: str):
    ending = program(text, QUICK)
    assert ending.code != 0
    assert ending.reason == reason


def test_a_waiting_process_is_killed_at_its_wall_clock_limit(program):
    start = time.monotonic()
    ending = program("import time\ntime.sleep(60)", Limits(memory=1 << 30, time=1.0, timeout=0.5))
    assert (ending.code, ending.reason) == (-signal.SIGKILL, "it ran out of time")
    assert time.monotonic() - start < 30


def test_modules_in_the_current_folder_are_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "platform.py").write_text("open('was here', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    run_module("surefoot.sandbox", [], QUICK)
    assert not (tmp_path / "was here").exists()
