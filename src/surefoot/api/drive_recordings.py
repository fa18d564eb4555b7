"""Recordings of the drive page: traces, and pages and videos of them made by `surefoot show`.

A trace is written during the recording (.npz.partial), so that only its last moments are lost if the page is killed.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.deploy.trace_file import TraceFile
from surefoot.errors import SurefootError, choices
from surefoot.evaluation.command_runs import MAX_RECORDING
from surefoot.world.terrain import is_map

if TYPE_CHECKING:
    from surefoot.evaluation.command_runs import DrivenRecording, DrivenRobot

KINDS = ("html", "mp4")
"""File types to which a recorded trace can be exported."""
_NICENESS = 10
"""Niceness of the export process, so that the simulation has priority."""


class DriveRecordings:
    """Recorder of simulated robots, one recording at a time.

    Args:
        folder: folder for files; it is created when necessary.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files: dict[str, Path] = {}
        """Files of the last recording, by type: npz, ghost (trace of the ghost), html and mp4."""
        self.error = ""
        """Error message, which is cleared by the caller that reports it."""
        self._recordings: list[tuple[TraceFile, DrivenRecording]] = []
        self._thread: threading.Thread | None = None
        self._process: subprocess.Popen[str] | None = None
        self._kind, self._duration, self._note = "", 0.0, ""
        self._map: list[str] = []

    @property
    def is_recording(self) -> bool:
        """Whether a recording is running."""
        return bool(self._recordings)

    def start(self, robots: dict[str, DrivenRobot], terrain: str = "flat") -> None:
        """Start recording robots, given by the names of their policies, on a terrain.

        Raises:
            SurefootError: the last recording is still being written, or the folder is not writable.
        """
        if self._thread is not None or self._process is not None:
            raise SurefootError("the last recording is still being written; record again in a moment")
        self.files, self._note = {}, ""
        self._robot = next(iter(robots.values())).robot
        self._map = ["--terrain", str(Path(terrain).resolve())] if is_map(terrain) else []
        stem = re.sub(r"[^\w.-]+", "-", next(iter(robots)))[:60] + time.strftime("-%Y-%m-%d_%H-%M-%S")
        for end, (policy, robot) in zip(("", "-ghost"), robots.items(), strict=False):
            recording = robot.record(policy)
            file = TraceFile(self.folder / f"{stem}{end}.npz", recording.head)
            recording.on_rows = file.add
            self._recordings.append((file, recording))

    def stop(self) -> None:
        """End the recording, and write its traces in a thread."""
        recordings, self._recordings = self._recordings, []
        for _, recording in recordings:
            recording.end("stopped")
        self._duration = recordings[0][1].duration
        self._thread = threading.Thread(target=self._write, args=(recordings,))
        self._thread.start()

    def _write(self, recordings: list[tuple[TraceFile, DrivenRecording]]) -> None:
        for kind, (file, recording) in zip(("npz", "ghost"), recordings, strict=False):
            file.close()
            try:
                problem = file.replace(recording.trace())
            except SurefootError as error:
                problem = f"the recording is lost: {error}"
            if problem:
                self.error = problem
            else:
                self.files[kind] = file.path

    def export(self, kind: str) -> None:
        """Export the last recording to a page or a video, in a separate process.

        Raises:
            SurefootError: an unknown file type, no recording, or an export that is still running.
        """
        if kind not in KINDS:
            raise SurefootError(f"a recording is exported as {choices(KINDS)}")
        if "npz" not in self.files or self._thread is not None:
            raise SurefootError("there is no recording to export")
        if self._process is not None:
            raise SurefootError(f"the {self._kind} file is still being written")
        out = self.files["npz"].with_suffix(f".{kind}")
        traces = [self.files[name] for name in ("npz", "ghost") if name in self.files]
        words = [*map(str, traces if kind == "html" else traces[:1]), "--robot", str(self._robot.folder), *self._map]
        words = [sys.executable, "-m", "surefoot", "show", *words, "--layout", "over", "--out", str(out)]
        self._kind, silent = kind, subprocess.DEVNULL
        self._process = subprocess.Popen(words, stdin=silent, stdout=silent, stderr=subprocess.PIPE, text=True)
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, _NICENESS)

    def update(self) -> None:
        """Handle the end of the recorded episode, of the writing thread and of the export process."""
        if self._recordings and (ended := self._recordings[0][1].ended):
            self._note = {"fall": "the robot fell", "time": f"it reached {MAX_RECORDING:g} s"}.get(ended, "")
            self.stop()
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
        if self._process is not None and self._process.poll() is not None:
            _, output = self._process.communicate()
            if self._process.returncode == 0:
                self.files[self._kind] = self.files["npz"].with_suffix(f".{self._kind}")
            else:
                last = (output.strip().splitlines() or ["its process ended"])[-1].removeprefix("surefoot: error: ")
                self.error = f"the {self._kind} file was not written: {last[:200]}"
            self._process = None

    def report(self) -> dict[str, Any]:
        """Return the state of the recording for the page."""
        if self._recordings:
            return {"on": True, "duration": round(self._recordings[0][1].duration, 1), "limit": MAX_RECORDING}
        if not self.files:
            return {}
        return {
            "duration": round(self._duration, 1),
            "note": self._note,
            "folder": str(self.folder.resolve()),
            "files": {kind: path.name for kind, path in self.files.items()},
            "making": self._kind if self._process is not None else "",
        }

    def close(self) -> None:
        """Finish a running recording, and end the export process."""
        if self._recordings:
            self.stop()
        if self._thread is not None:
            self._thread.join()
        if self._process is not None:
            self._process.terminate()
            self._process.communicate()
