"""One training of a study in a process of its own: `python -m surefoot.cli.study_worker`, started by `surefoot study`.

The request comes as one line of JSON on standard input, figures go as lines of JSON to standard output.
"""

from __future__ import annotations

import json
import math
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig
from surefoot.learn.study_config import StudyRun
from surefoot.learn.workers import orphaned
from surefoot.stop_signals import StopSignals

if TYPE_CHECKING:
    from surefoot.learn.run import Evaluation
    from surefoot.learn.trainer import UpdateFigures

STOPPED = 130
PATIENCE = 120.0
"""How long [s] to wait for another process to leave the folder: one that lost its parent needs an update to stop."""


def main() -> int:
    """Train the run that standard input names; returns 0 when finished, 130 when stopped, 2 for what can be mended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    request = json.loads(sys.stdin.readline())
    config = from_mapping(TrainConfig, request["config"])
    run = StudyRun(request["group"], config, Path(request["path"]))
    from surefoot.learn.run_folder import alone

    try:
        with StopSignals(("SIGTERM",)) as stop, alone(run.path, PATIENCE):
            return 0 if _train(run, lambda: stop.count > 0 or orphaned()) else STOPPED
    except SurefootError as error:
        print(error, file=sys.stderr)
        return 2
    except BrokenPipeError:
        return STOPPED  # The parent is gone; the last checkpoint stands.


def _train(run: StudyRun, should_stop: Any) -> bool:
    """Train a run from wherever it is until it is exported, or told to stop; returns whether it is."""
    from surefoot.learn.export import export_run
    from surefoot.learn.run import TrainingRun
    from surefoot.learn.run_folder import RunFolder
    from surefoot.world.sim_world import SimWorld

    run.check()
    state = run.state
    if state == "finished":
        return True
    if state == "started":
        folder, config = RunFolder.open(run.path)
    else:
        folder, config = RunFolder.create_at(run.config, run.path), run.config
    training = TrainingRun(config, folder, SimWorld, resume=state == "started")
    training.run(_tell, should_stop)
    if not training.finished:
        return False
    # The policy's file is what makes a run finished.
    export_run(training, folder.policy)
    return True


def _tell(figures: UpdateFigures, evaluation: Evaluation | None) -> None:
    event: dict[str, Any] = {"steps": figures.steps}
    for name, value in (("speed", figures.speed_mean), ("return", figures.return_mean)):
        if not math.isnan(value):
            event[name] = value
    if evaluation is not None:
        event["evaluation"] = asdict(evaluation)
    print(json.dumps(event), flush=True)


if __name__ == "__main__":
    sys.exit(main())
