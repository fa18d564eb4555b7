"""A process without rights: no files, no network, no other processes, bounded memory and time. Linux only.

A filter of system calls (seccomp) lets the process compute, and read and write what is open; every other call fails.
It can't be taken off again. See man 2 seccomp.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import resource
import struct
import sys

from surefoot.errors import SurefootError

MEMORY = 16 * 2**30
"""Address space [byte]; torch reserves some 5 GiB of it."""
TIME = 60
"""Processor time [s]."""
OUTPUT = 128 * 2**20
"""Size of a file that it writes [byte]."""
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
_NUMBER, _ARCHITECTURE = 0, 4
"""Places in the data of a call."""
_ALLOW, _FAIL = 0x7FFF0000, 0x00050000 | errno.EPERM
_SET_SECCOMP, _FILTER, _NO_NEW_PRIVILEGES = 22, 2, 38


def is_supported() -> bool:
    """Return whether this machine can make such a process."""
    return sys.platform == "linux" and platform.machine() in _ARCHITECTURES


def enter() -> None:
    """Give up all rights of this process, for good.

    Raises:
        SurefootError: the machine can't do that.
    """
    if not is_supported():
        raise SurefootError(f"{sys.platform} on {platform.machine()} has no filter of system calls that surefoot knows")
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (TIME, TIME))
    resource.setrlimit(resource.RLIMIT_FSIZE, (OUTPUT, OUTPUT))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    architecture, *allowed = _ARCHITECTURES[platform.machine()]
    program = [
        (_LOAD, 0, 0, _ARCHITECTURE),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, _FAIL),
        (_LOAD, 0, 0, _NUMBER),
    ]
    # A call that is equal jumps over the rest to the last instruction.
    program += [(_EQUAL, len(allowed) - k, 0, number) for k, number in enumerate(allowed)]
    program += [(_RETURN, 0, 0, _FAIL), (_RETURN, 0, 0, _ALLOW)]
    code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *instruction) for instruction in program))
    header = ctypes.create_string_buffer(struct.pack("@HP", len(program), ctypes.addressof(code)))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.prctl(_SET_SECCOMP, _FILTER, header, 0, 0):
        raise SurefootError(
            f"the filter of system calls is refused: {errno.errorcode.get(ctypes.get_errno(), 'unknown')}"
        )
