"""The page of `surefoot train --browser`: the newest policy runs on the drive page while it learns.

The page runs in a process of its own, with low priority, and watches a policy file that the training writes now and
then. So it can't change the training.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surefoot.api.drive_page import DrivePage, serve
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.plugins import load_plugins, registered_plugins

if TYPE_CHECKING:
    from surefoot.learn.training_loop import TrainingLoop

_WRITE_PERIOD = 5.0
"""Time between two policy files [s]."""
_READ_PERIOD = 1.0
"""Time between two looks for a new file [s]."""
_NICENESS = 5
"""Niceness of the page's process: a third of the processor's time that the training gets, where there is too little."""
_INITIAL_SPEED = 0.5
"""Share of the greatest speed forward at which a policy with commands runs until the page steers it."""


class TrainingPage:
    """Writes the newest policy into the run's folder during a training, and starts the process that shows it.

    Args:
        loop: the training.
        port: TCP port of the page; 0 for a free one.
    """

    def __init__(self, loop: TrainingLoop, port: int) -> None:
        self._loop, self._file = loop, loop.folder.path / "newest.onnx"
        self._write()
        command = [sys.executable, "-m", __name__, str(self._file), loop.config.world, str(port)]
        command += [plugin.path for plugin in registered_plugins()]
        # A session of its own: Ctrl-C is for the training. Its input ends with this process, however that ends.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)

    def update(self) -> None:
        """Write the policy if the file is old."""
        if time.monotonic() - self._written > _WRITE_PERIOD:
            with contextlib.suppress(OSError):  # a full disk ends the training where it must write
                self._write()

    def _write(self) -> None:
        self._loop.learner.export(self._file)
        self._written = time.monotonic()

    def close(self) -> None:
        """End the page and remove the file."""
        self._process.terminate()
        self._process.communicate()
        self._file.unlink(missing_ok=True)


class NewestPolicy(DrivePage):
    """Page of a simulated robot that runs the training's newest policy, and reloads it whenever its file changes.

    Args:
        file: file of the newest policy.
        world: name of the world.
    """

    def __init__(self, file: Path, world: str) -> None:
        super().__init__(str(file), world, recordings=file.parent / "recordings")
        self._file, self._modified, self._checked = file, file.stat().st_mtime_ns, time.monotonic()
        if self.robot.limits is not None:
            self.robot.command(np.array([_INITIAL_SPEED * self.robot.limits.high[0], 0.0, 0.0]))

    def _handle_messages(self) -> None:
        super()._handle_messages()
        if self.policy != str(self._file) or time.monotonic() - self._checked < _READ_PERIOD:
            return
        self._checked = time.monotonic()
        with contextlib.suppress(OSError, SurefootError):  # the training may be about to end
            if (modified := self._file.stat().st_mtime_ns) != self._modified:
                self.robot.policy, self._modified = PolicyRuntime.load(self._file), modified


def main(argv: list[str]) -> int:
    """Run the page's process, with the arguments FILE WORLD PORT [PLUGIN ...], until it is ended or its input ends."""

    def end_with_input() -> None:
        sys.stdin.read()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=end_with_input, daemon=True).start()
    with contextlib.suppress(OSError):
        os.nice(_NICENESS)
    file, world, port, *plugins = argv
    try:
        load_plugins(plugins)
        serve(NewestPolicy(Path(file), world), None, int(port))
    except SurefootError as error:
        print(f"surefoot: the page can't be shown: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
