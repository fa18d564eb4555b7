"""The experiments there are: what each needs, plans and fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from surefoot.identify.ground.plans import contact_plan, mass_plan
from surefoot.identify.plan import Plan
from surefoot.identify.quality import check_recording
from surefoot.identify.rack.plans import latency_plan, motor_plan
from surefoot.identify.recording import Recording
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription

FitProgress = Callable[[str, float], None]
"""Is told what a fit does, and the mean square of its residuals in standard deviations."""


def ignore_progress(step: str, cost: float) -> None:
    """Tell nobody how a fit goes."""


@dataclass(frozen=True)
class Experiment:
    """An experiment on a robot. What fits it is imported when asked for: the robot's computer has no MuJoCo."""

    name: str
    what: str
    """What it measures, in a line."""
    plan: Callable[[RobotDescription], Plan]
    """Returns what it is going to do."""
    rack: bool
    """Whether the robot hangs in the air."""
    before: tuple[str, ...] = ()
    """Experiments whose results it should have."""

    def fit(
        self,
        robot: RobotDescription,
        recording: Recording,
        known: PhysicalParams,
        sensors: dict[str, Any] | None = None,
        report: FitProgress = ignore_progress,
    ) -> Identification:
        """Find what a recording of it tells.

        Args:
            robot: its description.
            recording: of this experiment.
            known: all parameters as far as they are known, one row.
            sensors: `Identification.sensors` of earlier experiments.
            tell: is told of the fit's progress.

        Raises:
            SurefootError: data too poor to tell anything, or a robot on the ground that did not stand.
        """
        notes = check_recording(recording, robot)
        module = import_module(f"surefoot.identify.{'rack' if self.rack else 'ground'}.fits")
        found: Identification = getattr(module, f"fit_{self.name}")(robot, recording, known, sensors or {}, report)
        date = str(recording.meta["date"])
        return replace(found, notes=(*notes, *found.notes), digest=recording.digest, date=date)


EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment("latency", "age of the readings at the servo and at the computer", latency_plan, True),
        Experiment("motor", "motors, servo, friction, the legs' mass and inertia, both latencies", motor_plan, True),
        Experiment("mass", "mass, centre of mass and inertia of the base", mass_plan, False, ("motor",)),
        Experiment("contact", "friction, stiffness and damping of the feet", contact_plan, False, ("motor", "mass")),
    )
}
