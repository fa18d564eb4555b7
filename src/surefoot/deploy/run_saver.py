"""Keeps a run: rows on the disk several times a second while it goes, the whole trace when it is over.

So a killed computer leaves its run. What stands in the file of rows, and how it is read again: `task.partial_trace`.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import threading
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.deployment import Deployment, RunOutcome
from surefoot.deploy.motion_capture import base_and_feet, read_capture
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.recorder import Recorder
from surefoot.errors import SurefootError, accessible
from surefoot.task.partial_trace import SUFFIX, Layout, head_line, row_bytes, trace_of
from surefoot.task.trace import EpisodeTrace

FLUSH = 0.1
"""Time [s] between two writes."""
PATIENCE = 2.0
"""Time [s] that the disk has for the last write."""
_MOST = 20_000
"""Rows that may wait for the disk; beyond that recording stops, the memory of a robot's computer is not endless."""


class PartialFile:
    """Writes rows from a thread of its own; whoever adds rows never waits for the disk.

    Args:
        path: the file; made with the first row, and replaced, if there is one.
        layout: of a row.
        meta: meta of the trace, as far as it is known when the first row comes.
    """

    def __init__(self, path: Path, layout: Layout, meta: dict[str, Any]) -> None:
        self.path = path
        self.stopped = ""
        """Why nothing is written any more; empty while all goes well."""
        self._layout, self._meta = layout, meta
        self._begun = False
        self._waiting: deque[bytes] = deque()
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._write, name="trace", daemon=True)
        self._thread.start()

    def add(self, rows: Array) -> None:
        """Take rows (n, width)."""
        if self.stopped:
            return
        if len(self._waiting) > _MOST:
            self.stopped = "the disk is too slow"
            return
        if not self._begun:
            self._begun = True
            self._waiting.append(head_line(self._layout, self._meta))
        self._waiting.append(row_bytes(rows))

    def _write(self) -> None:
        try:
            while not self._waiting:
                if self._end.wait(FLUSH) and not self._waiting:
                    return
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("wb", buffering=0) as file:
                while True:
                    over = self._end.wait(FLUSH)
                    parts = [self._waiting.popleft() for _ in range(len(self._waiting))]
                    data = memoryview(b"".join(parts))
                    while data:
                        data = data[file.write(data) :]
                    if over and not self._waiting:
                        return
        except OSError as error:
            self.stopped = error.strerror or str(error)
            self._waiting.clear()

    def close(self) -> None:
        """Write what waits, and end; waits for the disk no longer than `PATIENCE`."""
        self._end.set()
        self._thread.join(PATIENCE)
        if self._thread.is_alive() and not self.stopped:
            self.stopped = "the disk does not answer"

    def remove(self) -> None:
        """Drop the file, once the whole trace is kept elsewhere."""
        self.close()
        self.path.unlink(missing_ok=True)


def next_free(folder: Path) -> Path:
    """The first of run_000.npz, run_001.npz, ... that stands for no run yet, whole or partial."""
    taken = set(os.listdir(folder)) if folder.is_dir() else set()
    names = (f"run_{number:03d}.npz" for number in itertools.count())
    return folder / next(name for name in names if not {name, name + SUFFIX} & taken)


@dataclass(frozen=True)
class SavedRun:
    """What is left of a run."""

    trace: EpisodeTrace | None = None
    """The trace, if any control step was done."""
    path: Path | None = None
    """Where it is."""
    notes: list[str] = field(default_factory=list)
    """What could not be kept, and why."""
    lost: bool = False
    """Whether the trace, or a part of it, is on no disk."""


class RunSaver:
    """One run's record.

    Args:
        deployment: whose run it is; the robot has been greeted.
        path: the trace's file (.npz); None keeps nothing on the disk.
        max_steps: control steps at most.
        world: name of the world, for the trace.
        run: number of the run.
    """

    def __init__(
        self,
        deployment: Deployment,
        path: Path | None,
        max_steps: int,
        world: str = "robot",
        run: int = 0,
    ) -> None:
        contract, robot = deployment.contract, deployment.robot
        self.path, self.link, self._monitor = path, deployment.link, deployment.monitor
        controller = deployment.controller
        actions = len(controller.contract.action_names)
        layout = Layout(
            robot.num_motors, len(robot.legs), controller.observer.width, actions, 3 if contract.commands else 0
        )
        self.recorder = Recorder(layout, contract.control_step, max_steps)
        handshake = self.link.handshake
        self.meta: dict[str, Any] = {
            "robot": robot.name,
            "world": world,
            "policy": contract.name,
            "episode": run,
            "control_step": contract.control_step,
            "leg_names": list(contract.leg_names),
            "motor_names": list(contract.motor_names),
            "observation_names": list(contract.columns),
            "params": {},
            "energy_weight": controller.task.energy_weight(robot),
            "max_steps": max_steps,
            "gait_period": controller.gait.reference.period,
            "lead": self.link.lead,
            "firmware": handshake.firmware if handshake is not None else "",
            "config_hash": contract.config_hash,
            "dry_run": deployment.dry_run,
            "ended": "fault",
            "reason": "cut off",
        }
        self._partial: PartialFile | None = None
        self._told = False

    def begin(self) -> None:
        """Get ready to write; the robot has not moved yet.

        Raises:
            SurefootError: the folder can't be written.
        """
        if self.path is not None:
            with accessible(f"folder {self.path.parent}", "written"):
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryFile(dir=self.path.parent):
                    pass
            self._partial = PartialFile(self.path.with_name(self.path.name + SUFFIX), self.recorder.layout, self.meta)
            self._monitor.recording(f"recording to {self.path}")

    def keep(self, rows: Array) -> None:
        """Take rows that have been closed."""
        if self._partial is not None:
            self._partial.add(rows)
            if self._partial.stopped and not self._told:
                self._told = True
                self._monitor.recording(f"recording stopped: {self._partial.stopped}; the robot goes on")

    def begun(self, robot_time: float) -> None:
        """Take the robot's time [s] at which the policy started."""
        self.meta["robot_time_start"] = robot_time if np.isfinite(robot_time) else None

    def finish(self, outcome: RunOutcome, timing: LoopTiming, capture: Path | None) -> SavedRun:
        """Make the trace and write it.

        Args:
            outcome: how the run ended.
            timing: how late the loop was.
            capture: a motion capture file, if there is one.
        """
        partial, notes = self._partial, []
        if partial is not None:
            partial.close()
            if partial.stopped:
                notes.append(f"recording stopped: {partial.stopped}")
        meta = {
            **self.meta,
            "ended": outcome.ended,
            "reason": outcome.reason,
            "what": outcome.text,
            "missed_steps": self.recorder.missed,
            "timing": timing.figures(),
            "frames_missing": self.link.statistics.missing,
        }
        if not self.recorder.steps:
            if partial is not None:
                partial.remove()
            return SavedRun(notes=[*notes, "no control step was done, so there is no trace"])
        truth: dict[str, Array] | None = None
        if capture is not None:
            try:
                truth = self._truth(capture)
            except SurefootError as error:
                notes.append(f"{error}; the trace has no base motion")
        try:
            trace = trace_of(self.recorder.layout, self.recorder.rows, meta, truth)
        except SurefootError as error:
            notes.append(f"the rows make no trace: {error}")
            return SavedRun(notes=notes, lost=True)
        if self.path is None:
            return SavedRun(trace, notes=notes)
        try:
            trace.save(self.path)
        except OSError as error:
            why = error.strerror or str(error)
            left = "it is lost"
            if partial is not None and partial.path.exists():
                left = f"what could be written is in {partial.path}"
            notes.append(f"trace {self.path} can't be written: {why}; {left}")
            return SavedRun(trace, notes=notes, lost=True)
        if partial is not None:
            partial.remove()
        return SavedRun(trace, self.path, notes)

    def _truth(self, capture: Path) -> dict[str, Array]:
        start = self.meta.get("robot_time_start")
        if start is None:
            raise SurefootError("the robot's time of the start is not known")
        recorder, legs = self.recorder, tuple(self.meta["leg_names"])
        return base_and_feet(read_capture(capture), start, recorder.control_step, recorder.steps, legs)
