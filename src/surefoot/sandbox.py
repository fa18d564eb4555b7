"""Isolated processes for untrusted files: with limits on memory and time, or without any privileges.

Parsers written in C may crash, exhaust the memory or never return on a hostile file. `run_module` runs one in a process
that limits itself (`limit_resources`), and returns its exit code and output.

On Linux such a process can also drop all privileges (`enter_sandbox`): a filter of system calls (seccomp) lets it
compute, and read and write files that are already open; every other call fails. The filter can't be removed again. See
man 2 seccomp.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import math
import os
import platform
import re
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from io import BufferedWriter

from surefoot.errors import SurefootError

OUTPUT_BYTES = 128 * 2**20
"""Maximum size of a file written by an isolated process [bytes]."""
_ENVIRONMENT = re.compile(
    r"PATH|HOME|LANG|LC_.*|TZ|TMPDIR|TEMP|TMP|USER|LD_LIBRARY_PATH|DYLD_.*|PYTHON[A-Z]*|VIRTUAL_ENV|CONDA_PREFIX|XDG_.*_HOME|"
    r"SUREFOOT_.*|MUJOCO_.*|CUDA_VISIBLE_DEVICES|COVERAGE_.*"
)
"""Environment variables passed to an isolated process, without passwords, which it could write into its result."""
_PARENT = "SUREFOOT_PARENT"
"""Environment variable with the id of the process that started this one."""
_MESSAGE_BYTES = 4000
"""Number of bytes read from the end of a process's error output."""
_ARCHITECTURES = {
    "x86_64": (
        0xC000003E,
        *(0, 1, 3, 5, 8, 9, 10, 11, 12, 13, 14, 15, 20, 24, 25, 28, 39, 60, 98, 131, 186, 202, 204, 228, 230, 231, 234),
        *(273, 318, 324, 334),
    ),
    "aarch64": (
        0xC00000B7,
        *(57, 62, 63, 64, 66, 80, 93, 94, 98, 99, 113, 115, 123, 124, 131, 132, 134, 135, 139, 165, 172, 178, 214, 215),
        *(216, 222, 226, 233, 278, 283, 293),
    ),
}
"""Numbers of the architecture and of the allowed system calls: read, write, close, fstat, lseek, mmap, mprotect,
munmap, brk, rt_sigaction, rt_sigprocmask, rt_sigreturn, writev, sched_yield, mremap, madvise, getpid, exit, getrusage,
sigaltstack, gettid, futex, sched_getaffinity, clock_gettime, clock_nanosleep, exit_group, tgkill, set_robust_list,
getrandom, membarrier, rseq (linux/audit.h, asm/unistd.h)."""
_LOAD, _EQUAL, _RETURN = 0x20, 0x15, 0x06
_NUMBER, _ARCHITECTURE, _FIRST = 0, 4, 16
"""Offsets in the data of a system call; `_FIRST` is the lower half of its first argument."""
_SIGNAL_THREAD = {"x86_64": 234, "aarch64": 131}
"""Number of tgkill, with which a process may signal only itself."""
_ALLOW, _FAIL = 0x7FFF0000, 0x00050000 | errno.EPERM
_SET_DEATH_SIGNAL, _SET_SECCOMP, _FILTER, _NO_NEW_PRIVILEGES = 1, 22, 2, 38


def is_supported() -> bool:
    """Return whether this machine supports `enter_sandbox`."""
    return sys.platform == "linux" and platform.machine() in _ARCHITECTURES


@dataclass(frozen=True)
class Limits:
    """Resource limits of a process."""

    memory: int
    """Address space [bytes]."""
    time: float
    """Processor time of all its threads, counted from when it limits itself [s]; rounded up to whole seconds."""
    timeout: float
    """Wall-clock time [s]."""


@dataclass(frozen=True)
class ProcessResult:
    """Exit code and output of an isolated process."""

    code: int
    """Exit code, or the negative number of the signal that ended the process."""
    output: bytes
    """Bytes written to the file that `claim_stdout` returned in the process."""
    message: str
    """Last line of its error output."""

    @property
    def reason(self) -> str:
        """Reason why the process failed, for messages."""
        if self.code in (-signal.SIGXCPU, -signal.SIGKILL):
            return "it ran out of time"
        if self.code < 0:
            with contextlib.suppress(ValueError):
                return f"it was ended by {signal.Signals(-self.code).name}"
        return self.message or f"it exited with code {self.code}"


def run_module(module: str, arguments: Sequence[str], limits: Limits, data: bytes = b"") -> ProcessResult:
    """Run a module as a program in a separate process, which is killed at its wall-clock limit and at Ctrl-C.

    The process itself must limit its memory and processor time: see `limit_resources` and `enter_sandbox`.

    Args:
        module: dotted name of the module.
        arguments: its command-line arguments.
        limits: only the wall-clock limit is used.
        data: its standard input.
    """
    environment = {
        **{name: value for name, value in os.environ.items() if _ENVIRONMENT.fullmatch(name)},
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        _PARENT: str(os.getpid()),
        # Each thread reserves address space, which is limited.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "2",
    }
    # -P: do not import modules from the current folder, which may be untrusted.
    command = [sys.executable, "-P", "-m", module, *arguments]
    # Its output goes to files because their size is limited.
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            code = subprocess.run(
                command, input=data, stdout=output, stderr=errors, timeout=limits.timeout, env=environment, check=False
            ).returncode
        except subprocess.TimeoutExpired:
            code = -signal.SIGKILL
        errors.seek(max(errors.seek(0, os.SEEK_END) - _MESSAGE_BYTES, 0))
        lines = errors.read().decode(errors="replace").strip().splitlines()
        output.seek(0)
        return ProcessResult(code, output.read(), lines[-1] if lines else "")


def claim_stdout() -> BufferedWriter:
    """Return this process's standard output for its result, and redirect all other output to stderr."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return output


def limit_resources(limits: Limits) -> None:
    """Limit memory, processor time and the size of written files of this process irrevocably.

    Processor time that was used before, such as for imports, is not counted, so the limit is equally strict on slow and
    fast computers. On Linux the process also ends when its parent does.
    """
    seconds = max(math.ceil(time.process_time() + limits.time), 1)
    for kind, value in (
        (resource.RLIMIT_AS, limits.memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, OUTPUT_BYTES),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard_limit = resource.getrlimit(kind)
        limit = value if hard_limit == resource.RLIM_INFINITY else min(value, hard_limit)
        # macOS has no limit on address space.
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (limit, limit))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    # The parent may already have ended, for example by Ctrl-C.
    if os.environ.get(_PARENT, parent := str(os.getppid())) != parent:
        os._exit(1)


def enter_sandbox(limits: Limits) -> None:
    """Drop all privileges of this process irrevocably, and limit its resources.

    Raises:
        SurefootError: the machine does not support it.
    """
    if not is_supported():
        raise SurefootError(f"surefoot has no system call filter for {sys.platform} on {platform.machine()}")
    limit_resources(limits)
    architecture, *allowed = _ARCHITECTURES[platform.machine()]
    program = [
        (_LOAD, 0, 0, _ARCHITECTURE),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _FAIL),
        (_LOAD, 0, 0, _NUMBER),
    ]
    allowed.remove(own := _SIGNAL_THREAD[platform.machine()])
    # An allowed call jumps to the last instruction.
    program += [(_EQUAL, len(allowed) + 3 - k, 0, number) for k, number in enumerate(allowed)]
    program += [(_EQUAL, 0, 2, own), (_LOAD, 0, 0, _FIRST), (_EQUAL, 1, 0, os.getpid())]
    program += [(_RETURN, 0, 0, _FAIL), (_RETURN, 0, 0, _ALLOW)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *instruction) for instruction in program))
    header = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.prctl(_SET_SECCOMP, _FILTER, header, 0, 0):
        raise SurefootError(
            f"the system call filter can't be set: {errno.errorcode.get(ctypes.get_errno(), 'unknown')}"
        )
