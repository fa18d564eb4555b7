"""Firmware in C, compiled for tests with sanitizers for memory errors and undefined behaviour."""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from surefoot.deploy.board.limits import Limits
from surefoot.deploy.messages import Handshake
from surefoot.firmware.project import build_firmware, robot_header, write_sources
from surefoot.robot import RobotDescription

needs_gcc = pytest.mark.skipif(
    not (shutil.which("gcc") and shutil.which("make")), reason="no gcc and make here: the firmware is not built"
)
needs_qemu = pytest.mark.qemu
QEMU = os.environ.get("SUREFOOT_FIRMWARE") == "qemu"
"""Whether all tests run the firmware of the STM32F405 in QEMU, instead of this computer's."""
SANITIZE = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
_built: dict[tuple[str, ...], Path] = {}


def qemu_missing() -> str:
    """Return the missing programs for building and running the STM32F405's firmware; empty if none is missing."""
    missing = [name for name in ("make", "arm-none-eabi-gcc", "qemu-system-arm") if not shutil.which(name)]
    return f"no {', '.join(missing)} here: the firmware of the STM32F405 is not tested" if missing else ""


@functools.cache
def _options() -> tuple[str, ...]:
    with tempfile.TemporaryDirectory() as folder:
        words = ["gcc", *SANITIZE, "-x", "c", "-", "-o", f"{folder}/try"]
        tried = subprocess.run(words, input=b"int main(void) { return 0; }", capture_output=True)
        works = tried.returncode == 0 and subprocess.run([f"{folder}/try"], capture_output=True).returncode == 0
    return SANITIZE if works else ("-O1",)


def compiled(
    robot: RobotDescription,
    limits: Limits | None = None,
    handshake: Handshake | None = None,
    target: str = "board-qemu" if QEMU else "board",
    *variables: str,
) -> Path:
    """Return a compiled target of a robot's firmware, by default its program; each is compiled only once."""
    key = robot_header(robot, limits, handshake), target, *variables
    if key not in _built:
        folder = Path(tempfile.mkdtemp())
        atexit.register(shutil.rmtree, folder, True)
        write_sources(folder, robot, limits, handshake)
        options = [f"OPTIMIZE={' '.join(_options())}"] if target == "board" else []
        _built[key] = build_firmware(folder, *options, *variables, target=target)
    return _built[key]
