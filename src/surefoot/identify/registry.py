"""Registry of the experiments: what each measures, its plan and its fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from surefoot.identify.ground.plans import contact_plan, mass_plan
from surefoot.identify.plan import Plan
from surefoot.identify.quality import check_recording
from surefoot.identify.rack.air_plan import air_plan
from surefoot.identify.rack.plans import latency_plan, motor_plan
from surefoot.identify.recording import Recording
from surefoot.identify.result import FitProgress, Identification, ignore_progress
from surefoot.robot import PhysicalParams, RobotDescription


@dataclass(frozen=True)
class Experiment:
    """An experiment on a robot. Its fit is imported when it runs, because the robot's computer has no MuJoCo."""

    name: str
    measures: str
    """Measured quantities, in one line."""
    plan: Callable[[RobotDescription], Plan]
    rack: bool
    """Whether the robot hangs in the air."""
    prerequisites: tuple[str, ...] = ()
    """Names of experiments whose results it needs."""
    for_joint_actuators: bool = False
    """Whether it is for robots with joint actuators and serial legs; otherwise for DC motors and five-bar legs."""

    def fit(
        self,
        robot: RobotDescription,
        recording: Recording,
        prior: PhysicalParams,
        sensors: dict[str, Any] | None = None,
        report: FitProgress = ignore_progress,
    ) -> Identification:
        """Identify parameters from a recording of this experiment.

        Args:
            robot: robot description.
            recording: recording of this experiment.
            prior: parameters before the experiment, one row.
            sensors: `Identification.sensors` of earlier experiments.
            report: callback with the progress of the fit.

        Raises:
            SurefootError: the data determine nothing, or a robot on the ground did not stand.
        """
        notes = check_recording(recording, robot)
        folder = "rack" if self.rack else "ground"
        module = import_module(f"surefoot.identify.{folder}.{'air_fit' if self.for_joint_actuators else 'fits'}")
        result: Identification = getattr(module, f"fit_{self.name}")(robot, recording, prior, sensors or {}, report)
        date = str(recording.meta["date"])
        return replace(result, notes=(*notes, *result.notes), digest=recording.digest, date=date)


EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment("motor", "motors, servo, friction, leg mass and inertia, both latencies", motor_plan, True),
        Experiment("latency", "age of the readings used by the servo and by the computer", latency_plan, True),
        Experiment("mass", "mass, centre of mass and inertia of the base", mass_plan, False, ("motor",)),
        Experiment("contact", "friction, stiffness and damping of the feet", contact_plan, False, ("motor", "mass")),
        Experiment(
            "air",
            "for joint actuators: friction, inertia, leg mass, latency",
            air_plan,
            True,
            for_joint_actuators=True,
        ),
    )
}
