"""Processes of their own for files that others made: with bounded memory and time, or without any rights.

Parsers written in C may crash, fill the memory or never end on a hostile file. `run_module` runs one in a process that
limits itself (`limit_resources`), and returns how it ended.

On Linux such a process can give up all rights (`enter`): a filter of system calls (seccomp) lets it compute, and read
and write what is open; every other call fails. It can't be taken off again. See man 2 seccomp.
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
"""Size of a file that such a process writes [byte]."""
_ENVIRONMENT = re.compile(
    r"PATH|HOME|LANG|LC_.*|TZ|TMPDIR|TEMP|TMP|USER|LD_LIBRARY_PATH|DYLD_.*|PYTHON[A-Z]*|VIRTUAL_ENV|CONDA_PREFIX|XDG_.*_HOME|"
    r"SUREFOOT_.*|MUJOCO_.*|CUDA_VISIBLE_DEVICES|COVERAGE_.*"
)
"""Variables that such a process has: it may write what it sees into its result, and others hold passwords."""
_PARENT = "SUREFOOT_PARENT"
"""Variable of the environment with the number of the process that started this one."""
_MESSAGE_BYTES = 4000
"""How much of the end of a process's messages is read."""
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
"""Number of the architecture, and of the calls that are allowed: read, write, close, fstat, lseek, mmap, mprotect,
munmap, brk, rt_sigaction, rt_sigprocmask, rt_sigreturn, writev, sched_yield, mremap, madvise, getpid, exit, getrusage,
sigaltstack, gettid, futex, sched_getaffinity, clock_gettime, clock_nanosleep, exit_group, tgkill, set_robust_list,
getrandom, membarrier, rseq (linux/audit.h, asm/unistd.h)."""
_LOAD, _EQUAL, _RETURN = 0x20, 0x15, 0x06
_NUMBER, _ARCHITECTURE, _FIRST = 0, 4, 16
"""Places in the data of a call; `_FIRST` is the lower half of its first argument."""
_SIGNAL_THREAD = {"x86_64": 234, "aarch64": 131}
"""The number of tgkill, by which a process ends itself. It may signal no other one."""
_ALLOW, _FAIL = 0x7FFF0000, 0x00050000 | errno.EPERM
_SET_DEATH_SIGNAL, _SET_SECCOMP, _FILTER, _NO_NEW_PRIVILEGES = 1, 22, 2, 38


def is_supported() -> bool:
    """Return whether this machine can make such a process."""
    return sys.platform == "linux" and platform.machine() in _ARCHITECTURES


@dataclass(frozen=True)
class Limits:
    """What a process may use."""

    memory: int
    """Address space [byte]."""
    time: float
    """Processor time of all its threads from when it limits itself [s]; whole seconds are counted."""
    patience: float
    """Time by the clock [s]."""


@dataclass(frozen=True)
class ProcessResult:
    """How a process ended, and what it gave."""

    code: int
    """Exit code; the negative number of the signal that ended it."""
    output: bytes
    """What it wrote to `claim_stdout`."""
    message: str
    """Last line of what it printed."""

    @property
    def reason(self) -> str:
        """Why a process failed, in words."""
        if self.code in (-signal.SIGXCPU, -signal.SIGKILL):
            return "its time was over"
        if self.code < 0:
            with contextlib.suppress(ValueError):
                return f"{signal.Signals(-self.code).name} ended it"
        return self.message or f"it ended with code {self.code}"


def run_module(module: str, words: Sequence[str], limits: Limits, data: bytes = b"") -> ProcessResult:
    """Run a module as a program in a process of its own, which is killed when it takes too long or at Ctrl-C.

    The process must limit its memory and processor time: see `limit_resources` and `enter`.

    Args:
        module: dotted name of the module.
        words: its arguments.
        limits: how long it may take by the clock.
        data: its standard input.
    """
    environment = {
        **{name: value for name, value in os.environ.items() if _ENVIRONMENT.fullmatch(name)},
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        _PARENT: str(os.getpid()),
        # Threads reserve address space that they do not use.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MALLOC_ARENA_MAX": "2",
    }
    # -P: modules are not looked for in the present folder, which may be a stranger's.
    command = [sys.executable, "-P", "-m", module, *words]
    # What it writes goes to files, whose size is limited.
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            code = subprocess.run(
                command, input=data, stdout=output, stderr=errors, timeout=limits.patience, env=environment, check=False
            ).returncode
        except subprocess.TimeoutExpired:
            code = -signal.SIGKILL
        errors.seek(max(errors.seek(0, os.SEEK_END) - _MESSAGE_BYTES, 0))
        lines = errors.read().decode(errors="replace").strip().splitlines()
        output.seek(0)
        return ProcessResult(code, output.read(), lines[-1] if lines else "")


def claim_stdout() -> BufferedWriter:
    """Return this process's standard output, to which only a result is written; what else prints goes to stderr."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return output


def limit_resources(limits: Limits) -> None:
    """Limit memory, processor time and written files of this process, for good; it ends with its parent (Linux).

    What it has imported before takes none of its time, which is as long on a slow computer as on a fast one.
    """
    seconds = max(math.ceil(time.process_time() + limits.time), 1)
    for kind, value in (
        (resource.RLIMIT_AS, limits.memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, OUTPUT_BYTES),
        (resource.RLIMIT_CORE, 0),
    ):
        _, most = resource.getrlimit(kind)
        least = value if most == resource.RLIM_INFINITY else min(value, most)
        # macOS knows no limit of the address space.
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (least, least))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
    # The parent may have ended before, for example by Ctrl-C.
    if os.environ.get(_PARENT, parent := str(os.getppid())) != parent:
        os._exit(1)


def enter(limits: Limits) -> None:
    """Give up all rights of this process, for good, and limit what it uses.

    Raises:
        SurefootError: the machine can't do that.
    """
    if not is_supported():
        raise SurefootError(f"{sys.platform} on {platform.machine()} has no filter of system calls that surefoot knows")
    limit_resources(limits)
    architecture, *allowed = _ARCHITECTURES[platform.machine()]
    program = [
        (_LOAD, 0, 0, _ARCHITECTURE),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _FAIL),
        (_LOAD, 0, 0, _NUMBER),
    ]
    allowed.remove(own := _SIGNAL_THREAD[platform.machine()])
    # A call that is equal jumps over the rest to the last instruction.
    program += [(_EQUAL, len(allowed) + 3 - k, 0, number) for k, number in enumerate(allowed)]
    program += [(_EQUAL, 0, 2, own), (_LOAD, 0, 0, _FIRST), (_EQUAL, 1, 0, os.getpid())]
    program += [(_RETURN, 0, 0, _FAIL), (_RETURN, 0, 0, _ALLOW)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *instruction) for instruction in program))
    header = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.prctl(_SET_SECCOMP, _FILTER, header, 0, 0):
        raise SurefootError(
            f"the filter of system calls is refused: {errno.errorcode.get(ctypes.get_errno(), 'unknown')}"
        )
