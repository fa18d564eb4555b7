"""Page of `surefoot train --browser`: the drive page runs the newest policy during a training.

The page runs in a separate process with low priority, and reloads a policy file that the training writes periodically.
It can't affect the training.
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
"""Minimum time between two updates of the policy file [s]."""
_READ_PERIOD = 1.0
"""Time between two checks for a new policy file [s]."""
_NICENESS = 5
"""Niceness of the page's process: it gets a third as much processor time as the training when time is scarce."""
_INITIAL_SPEED = 0.5
"""Initial forward command of a policy with commands, as a fraction of its upper limit."""


class TrainingPage:
    """Writer of the newest policy to the run folder during a training; it starts the page's process.

    Args:
        loop: the training.
        port: TCP port of the page; 0 for a free one.
    """

    def __init__(self, loop: TrainingLoop, port: int) -> None:
        self._loop, self._file = loop, loop.folder.path / "newest.onnx"
        self._write()
        command = [sys.executable, "-m", __name__, str(self._file), loop.config.world, str(port)]
        command += [plugin.path for plugin in registered_plugins()]
        # A new session, so that Ctrl-C reaches only the training. Its input ends with this process, however that ends.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)

    def update(self) -> None:
        """Write the policy file if an update is due."""
        if time.monotonic() - self._written > _WRITE_PERIOD:
            with contextlib.suppress(OSError):  # on a full disk the training itself reports the error
                self._write()

    def _write(self) -> None:
        self._loop.learner.export(self._file)
        self._written = time.monotonic()

    def close(self) -> None:
        """End the page's process and remove the policy file."""
        self._process.terminate()
        self._process.communicate()
        self._file.unlink(missing_ok=True)


class NewestPolicy(DrivePage):
    """Drive page that runs the newest policy of a training, and reloads it whenever its file changes.

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
    """Run the page's process with the arguments FILE WORLD PORT [PLUGIN ...], until it is ended or its input ends."""

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
        print(f"surefoot: the page can't be served: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
