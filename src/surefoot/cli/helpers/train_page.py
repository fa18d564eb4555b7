"""The page of `surefoot train --browser`: the newest policy runs on the page of `surefoot drive` while it learns.

The page runs in a process of its own, with low priority. It takes no part in the training: what it shows is a policy
file that the training writes now and then.
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

from surefoot.cli.drive import Drive, serve
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

if TYPE_CHECKING:
    from surefoot.learn.run import TrainingRun

_EVERY = 5.0
"""Time between two policy files [s]."""
_NICE = 5
"""Niceness of the page's process: a third of the processor's time that the training gets, where there is too little."""
_CRUISE = 0.5
"""Share of the greatest speed forward at which a policy with commands runs until the page steers it."""


class TrainingPage:
    """Writes the newest policy of a run into its folder, for a page in a process of its own.

    Args:
        run: what trains.
        port: TCP port of the page; 0 for a free one.
    """

    def __init__(self, run: TrainingRun, port: int) -> None:
        self._run, self._file = run, run.folder.path / "newest.onnx"
        self._write()
        words = [sys.executable, "-m", __name__, str(self._file), run.config.world, str(port)]
        # A session of its own: Ctrl-C is for the training. Its input ends with this process, however that ends.
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, start_new_session=True)

    def update(self) -> None:
        """Write the policy, if the last one is old."""
        if time.monotonic() - self._written > _EVERY:
            with contextlib.suppress(OSError):  # a full disk ends the training where it must write
                self._write()

    def _write(self) -> None:
        from surefoot.learn.export import export_trainer  # not at the top: the page's process needs no torch

        export_trainer(self._run.trainer, self._file)
        self._written = time.monotonic()

    def close(self) -> None:
        """End the page, and remove the file."""
        self._process.terminate()
        self._process.communicate()
        self._file.unlink(missing_ok=True)


class NewestPolicy(Drive):
    """The simulation behind the page: it takes a new policy where it goes.

    Args:
        file: where the newest policy is.
        world: name of the world.
    """

    def __init__(self, file: Path, world: str) -> None:
        super().__init__(str(file), world)
        self._file, self._seen, self._looked = file, file.stat().st_mtime_ns, time.monotonic()
        if self.robot.limits is not None:
            self.robot.command(np.array([_CRUISE * self.robot.limits.high[0], 0.0, 0.0]))

    def _take(self) -> None:
        super()._take()
        if self.policy != str(self._file) or time.monotonic() - self._looked < 1.0:
            return
        self._looked = time.monotonic()
        with contextlib.suppress(OSError, SurefootError):  # the training may be about to end
            if (written := self._file.stat().st_mtime_ns) != self._seen:
                self.robot.policy, self._seen = PolicyRuntime.load(self._file), written


def _end_with_input() -> None:
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


def main(argv: list[str]) -> int:
    """Run the page's process, with the words FILE WORLD PORT, until it is terminated or its input ends."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    file, world, port = argv
    try:
        serve(NewestPolicy(Path(file), world), None, int(port), None)
    except SurefootError as error:
        print(f"surefoot: the page can't be shown: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
