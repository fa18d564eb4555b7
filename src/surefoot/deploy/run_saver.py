"""Recording of a run on a robot: rows during the run, and the complete trace with metadata at the end."""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

from surefoot.arrays import Array
from surefoot.deploy.deployment import Deployment, RunOutcome
from surefoot.deploy.motion_capture import base_and_feet, read_capture
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.recorder import Recorder
from surefoot.deploy.trace_file import TraceFile
from surefoot.errors import SurefootError
from surefoot.task.partial_trace import SUFFIX, TraceHeader
from surefoot.task.trace import EpisodeTrace, run_meta


def next_free_path(folder: Path) -> Path:
    """Return the first path of run_000.npz, run_001.npz, ... that no complete or partial run uses."""
    taken = set(os.listdir(folder)) if folder.is_dir() else set()
    names = (f"run_{number:03d}.npz" for number in itertools.count())
    return folder / next(name for name in names if not {name, name + SUFFIX} & taken)


@dataclass(frozen=True)
class SavedRun:
    """Result of recording a run."""

    trace: EpisodeTrace | None = None
    """Trace of the run; None if no control step was executed."""
    path: Path | None = None
    """File of the trace, if it was saved."""
    notes: list[str] = field(default_factory=list)
    """Problems of the recording."""
    lost: bool = False
    """Whether the trace, or a part of it, could not be saved."""


class RunSaver:
    """Records one run of a connected deployment; saves the trace (.npz) if a path is given."""

    def __init__(
        self, deployment: Deployment, path: Path | None, max_steps: int, world: str = "robot", run: int = 0
    ) -> None:
        contract, robot, controller = deployment.contract, deployment.robot, deployment.controller
        self.path, self.link, self._monitor = path, deployment.link, deployment.monitor
        handshake = self.link.handshake
        meta = run_meta(
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
        )
        if contract.height_map is not None:
            meta["height_map"] = {"ahead": contract.height_map.ahead, "left": contract.height_map.left}
        self._head = TraceHeader.of_robot(
            meta,
            len(contract.action_names),
            robot.archive,
            commands=contract.commands is not None,
            accelerometer=self.link.state is not None and self.link.state.accelerometer is not None,
        )
        self.recorder = Recorder(self._head.layout, contract.control_step, max_steps, self._keep)
        self._file: TraceFile | None = None
        self._stop_reported = False

    def begin(self) -> None:
        """Prepare the recording, before the robot moves.

        Raises:
            SurefootError: the folder cannot be written.
        """
        if self.path is not None:
            self._file = TraceFile(self.path, self._head.line)
            self._monitor.recording(f"recording to {self.path}")

    def _keep(self, rows: Array) -> None:
        start, file = self.recorder.start, self._file
        self._head.meta["robot_time_start"] = start if math.isfinite(start) else None
        if file is None:
            return
        file.add(rows)
        if file.error and not self._stop_reported:
            self._stop_reported = True
            self._monitor.recording(f"recording stopped: {file.error}; the robot continues")

    def finish(self, outcome: RunOutcome, timing: LoopTiming, capture: Path | None) -> SavedRun:
        """Assemble the trace, with base and feet from a motion capture file if given, and save it."""
        file, recorder, notes = self._file, self.recorder, []
        if file is not None:
            file.close()
            if file.error:
                notes.append(f"recording stopped: {file.error}")
        if not recorder.steps:
            return SavedRun(notes=[*notes, "no control step was executed, so there is no trace"])
        meta = {
            "ended": outcome.ended,
            "reason": outcome.reason,
            "what": outcome.text,
            "missed_steps": recorder.missed,
            "timing": timing.metrics(),
            "frames_missing": self.link.statistics.missing,
        }
        truth: dict[str, Array] | None = None
        if capture is not None:
            try:
                truth = self._truth(capture)
            except SurefootError as error:
                notes.append(f"{error}; the trace has no base motion")
        try:
            trace = self._head.trace(recorder.rows, meta, truth)
        except SurefootError as error:
            return SavedRun(notes=[*notes, f"no trace can be made of the rows: {error}"], lost=True)
        if file is None:
            return SavedRun(trace, notes=notes)
        if problem := file.replace(trace):
            return SavedRun(trace, notes=[*notes, problem], lost=True)
        return SavedRun(trace, self.path, notes)

    def _truth(self, capture: Path) -> dict[str, Array]:
        start = self._head.meta["robot_time_start"]
        if start is None:
            raise SurefootError("the start time on the robot's clock is unknown")
        recorder, legs = self.recorder, tuple(self._head.meta["leg_names"])
        return base_and_feet(read_capture(capture), start, recorder.control_step, recorder.steps, legs)
