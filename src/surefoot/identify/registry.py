"""The experiments there are: what each needs, plans and fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from surefoot.identify.plan import Plan
from surefoot.identify.quality import check_recording
from surefoot.identify.recording import Recording
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription

FitProgress = Callable[[str, float], None]
"""Is told what a fit does, and the mean square of its residuals in standard deviations."""


def silent(step: str, cost: float) -> None:
    """Tell nobody how a fit goes."""


@dataclass(frozen=True)
class Experiment:
    """An experiment on a robot. What fits it is imported when asked for: the robot's computer has no MuJoCo."""

    name: str
    what: str
    """What it measures, in a line."""
    rack: bool
    """Whether the robot hangs in the air."""
    before: tuple[str, ...] = ()
    """Experiments whose results it should have."""

    def plan(self, robot: RobotDescription) -> Plan:
        """What it is going to do."""
        module = import_module(f"surefoot.identify.experiments.{self.name}")
        plan: Plan = getattr(module, f"{self.name}_plan")(robot)
        return plan

    def fit(
        self,
        robot: RobotDescription,
        recording: Recording,
        known: PhysicalParams,
        sensors: dict[str, Any] | None = None,
        tell: FitProgress = silent,
    ) -> Identification:
        """Find what a recording of it tells.

        Args:
            robot: its description.
            recording: of this experiment.
            known: all parameters as far as they are known, one row.
            sensors: `Identification.sensors` of earlier experiments.
            tell: is told of the fit's progress.

        Raises:
            SurefootError: data too poor to tell anything.
        """
        notes = check_recording(recording, robot)
        module = import_module(f"surefoot.identify.fits.{self.name}")
        found: Identification = getattr(module, f"fit_{self.name}")(robot, recording, known, sensors or {}, tell)
        date = str(recording.meta["date"])
        return replace(found, notes=(*notes, *found.notes), digest=recording.digest, date=date)


EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment("latency", "age of the readings at the servo and at the computer", rack=True),
        Experiment("motor", "motors, servo, friction, the legs' mass and inertia, both latencies", rack=True),
        Experiment("mass", "mass, centre of mass and inertia of the base", rack=False, before=("motor",)),
        Experiment("contact", "friction, stiffness and damping of the feet", rack=False, before=("motor", "mass")),
    )
}
