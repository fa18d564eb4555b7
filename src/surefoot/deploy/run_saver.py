"""Saves a run: rows to the disk several times a second while it goes on, the whole trace at its end.

If the computer stops, the rows remain. `task.partial_trace` defines their file and reads it.
"""

from __future__ import annotations

import itertools
import math
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from surefoot.arrays import Array
from surefoot.deploy.background_file import BackgroundFile
from surefoot.deploy.deployment import Deployment, RunOutcome
from surefoot.deploy.motion_capture import base_and_feet, read_capture
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.recorder import Recorder
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.task.partial_trace import SUFFIX, head_line, make_trace, measured_layout, row_bytes
from surefoot.task.trace import EpisodeTrace, run_meta

FLUSH = 0.1
"""Time [s] between two writes."""
MAX_WAITING = 20_000
"""Pieces of data that may wait for the disk, as memory of a robot's computer is short; then recording stops."""


def next_free(folder: Path) -> Path:
    """Return the first of run_000.npz, run_001.npz, ... that no run has, whole or partial."""
    taken = set(os.listdir(folder)) if folder.is_dir() else set()
    names = (f"run_{number:03d}.npz" for number in itertools.count())
    return folder / next(name for name in names if not {name, name + SUFFIX} & taken)


@dataclass(frozen=True)
class SavedRun:
    """The trace of a run, if any control step was done, its file, and notes on what could not be saved.

    `lost`: whether the trace, or a part of it, is on no disk.
    """

    trace: EpisodeTrace | None = None
    path: Path | None = None
    notes: list[str] = field(default_factory=list)
    lost: bool = False


class RunSaver:
    """Saves one run of a connected deployment to a file (.npz), or makes its trace alone if there is no path."""

    def __init__(
        self, deployment: Deployment, path: Path | None, max_steps: int, world: str = "robot", run: int = 0
    ) -> None:
        contract, robot, controller = deployment.contract, deployment.robot, deployment.controller
        self.path, self.link, self._monitor = path, deployment.link, deployment.monitor
        handshake = self.link.handshake
        self.meta = run_meta(
            robot,
            contract.columns,
            controller.gait.reference.period,
            **controller.task.return_meta(robot),
            max_steps=max_steps,
            world=world,
            policy=contract.name,
            episode=run,
            control_step=contract.control_step,
            lead=self.link.lead,
            firmware=handshake.firmware if handshake is not None else "",
            config_hash=contract.config_hash,
            dry_run=deployment.dry_run,
            ended="fault",
            reason="cut off",
        )
        layout = measured_layout(self.meta, len(contract.action_names), contract.commands is not None)
        self.recorder = Recorder(layout, contract.control_step, max_steps, self._keep)
        self._robot_archive = robot.archive
        self._partial: BackgroundFile | None = None
        self._stop_reported = False

    def begin(self) -> None:
        """Prepare to write, before the robot moves.

        Raises:
            SurefootError: the folder can't be written.
        """
        if self.path is not None:
            with describe_os_errors(f"folder {self.path.parent}", "written"):
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryFile(dir=self.path.parent):
                    pass
            self._partial = BackgroundFile(self.path.with_name(self.path.name + SUFFIX), FLUSH)
            self._monitor.recording(f"recording to {self.path}")

    def _keep(self, rows: Array) -> None:
        start, partial = self.recorder.start, self._partial
        if "robot_time_start" not in self.meta:
            self.meta["robot_time_start"] = start if math.isfinite(start) else None
            if partial is not None:
                partial.add(head_line(self.recorder.layout, self.meta, robot_archive=self._robot_archive))
        if partial is None:
            return
        if partial.waiting > MAX_WAITING:
            partial.stopped = "the disk is too slow"
        partial.add(row_bytes(rows))
        if partial.stopped and not self._stop_reported:
            self._stop_reported = True
            self._monitor.recording(f"recording stopped: {partial.stopped}; the robot goes on")

    def finish(self, outcome: RunOutcome, timing: LoopTiming, capture: Path | None) -> SavedRun:
        """Make the trace, with base and feet of a motion capture file if there is one, and write it."""
        partial, recorder, notes = self._partial, self.recorder, []
        if partial is not None:
            partial.close()
            if partial.stopped:
                notes.append(f"recording stopped: {partial.stopped}")
        if not recorder.steps:
            return SavedRun(notes=[*notes, "no control step was done, so there is no trace"])
        meta = {
            **self.meta,
            "ended": outcome.ended,
            "reason": outcome.reason,
            "what": outcome.text,
            "missed_steps": recorder.missed,
            "timing": timing.figures(),
            "frames_missing": self.link.statistics.missing,
        }
        truth: dict[str, Array] | None = None
        if capture is not None:
            try:
                truth = self._truth(capture)
            except SurefootError as error:
                notes.append(f"{error}; the trace has no base motion")
        try:
            trace = make_trace(recorder.layout, recorder.rows, meta, truth=truth, robot_archive=self._robot_archive)
        except SurefootError as error:
            return SavedRun(notes=[*notes, f"the rows make no trace: {error}"], lost=True)
        if self.path is None:
            return SavedRun(trace, notes=notes)
        try:
            trace.save(self.path)
        except (OSError, SurefootError) as error:
            reason, left = getattr(error, "strerror", None) or error, "it is lost"
            if partial is not None and partial.path.exists():
                left = f"what could be written is in {partial.path}"
            notes.append(f"trace {self.path} can't be written: {reason}; {left}")
            return SavedRun(trace, notes=notes, lost=True)
        if partial is not None:
            partial.path.unlink(missing_ok=True)
        return SavedRun(trace, self.path, notes)

    def _truth(self, capture: Path) -> dict[str, Array]:
        start = self.meta["robot_time_start"]
        if start is None:
            raise SurefootError("the robot's time of the start is not known")
        recorder, legs = self.recorder, tuple(self.meta["leg_names"])
        return base_and_feet(read_capture(capture), start, recorder.control_step, recorder.steps, legs)
