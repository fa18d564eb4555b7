"""Experiments of `surefoot identify`, shortened for tests."""

from __future__ import annotations

from dataclasses import replace

from surefoot.identify.plan import Plan
from surefoot.identify.registry import Experiment
from surefoot.robot import RobotDescription

LENGTHS = {
    "motor": {"unfold": 1.5, "hold": 0.2, "steps": 1.25, "centre": 0.5, "PWM pulses": 0.24, "chirp back": 1.5},
    "latency": {"unfold": 1.5, "hold": 0.3, "spikes": 0.24, "centre": 0.5, "chirp": 0.6, "steps": 0.25},
    "mass": {"stand still": 0.6, "squat slowly": 1.0, "nod": 3.0, "nod back": 0.6},
    "contact": {"drop": 1.2, "drag": 3.0, "nod": 2.0},
}
"""Lengths [s] of the kept phases by name, for each experiment."""
COUNTS: dict[str, dict[str, int]] = {
    "motor": {"centre": 3, "PWM pulses": 2},
    "latency": {"spikes": 2, "centre": 2},
    "mass": {},
    "contact": {"drop": 2, "drag": 2},
}
"""Numbers of kept phases with the same name; otherwise one."""


def short_plan(experiment: Experiment, robot: RobotDescription) -> Plan:
    """Return the plan of an experiment with selected phases of shorter durations; on the ground the robot stands up."""
    lengths, counts = LENGTHS[experiment.name], COUNTS[experiment.name]
    plan = experiment.plan(robot)
    first = 0 if plan.rack else next(k for k, phase in enumerate(plan.phases) if phase.use != "transition")
    seen: dict[str, int] = {}
    phases = list(plan.phases[:first])
    for phase in plan.phases[first:]:
        seen[phase.name] = seen.get(phase.name, 0) + 1
        if phase.name in lengths and seen[phase.name] <= counts.get(phase.name, 1):
            phases.append(replace(phase, duration=lengths[phase.name]))
    return replace(plan, phases=tuple(phases))
