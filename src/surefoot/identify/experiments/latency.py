"""The latency experiment: on a rack, spikes of torque, and sines to see the servo's own delay.

Tan et al. 2018, section V-A, send a spike of PWM for one time step and measure how long it takes until the motor is
reported to move, once at the microcontroller and once at the computer.
"""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.poses import pose
from surefoot.deploy.wire.messages import Mode
from surefoot.identify.experiments.motor import EXTENSION, STEP
from surefoot.identify.experiments.signals import chirps, go_to, hold, steps
from surefoot.identify.plan import Phase, Plan, Signal
from surefoot.robot import RobotDescription
from surefoot.seeding import generator

DUTY = 0.4
"""Height of a spike."""
SPIKE_EVERY, SPIKES = 0.12, 2
"""Time between spikes [s], and how many there are in a phase."""
GROUPS = 6
_SHORT = 0.001
"""Less than any time between two commands [s]: the first command of a spike is its only one."""


def latency_plan(robot: RobotDescription) -> Plan:
    """Spikes of a single command, the shortest that a robot takes; then motions that the servo follows."""
    motors = robot.num_motors
    draw = generator(0, "latency experiment")
    middle = pose(robot, 0.0, EXTENSION)
    turned = np.where(np.arange(motors) % 2 == 0, 0.0, np.pi / 2)
    fast = chirps(middle, np.full(motors, 0.12), 2.0, 20.0, 3.0, turned)
    jumps = middle + draw.uniform(-0.25, 0.25, (8, motors))
    phases = [
        Phase("unfold", "all legs to the middle of their reach", 1.5, go_to(middle, 1.5), use="way"),
        Phase("hold", "all legs held", 0.5, hold(middle)),
    ]
    for _ in range(GROUPS):
        phases += [
            Phase(
                "spikes",
                f"motors without servo: {SPIKES} spikes of {DUTY:g} duty, one command long, to and fro",
                SPIKES * SPIKE_EVERY,
                _spikes(DUTY * draw.choice([-1.0, 1.0], motors)),
                Mode.PWM,
            ),
            Phase("centre", "all legs back to the middle", 0.5, go_to(middle, 0.3), use="way"),
        ]
    phases += [
        Phase("chirp", "every motor 0.12 rad to both sides, from 2 to 20 Hz", 3.0, fast),
        Phase("steps", "every motor jumps by up to 0.25 rad to both sides, 8 times", 2.0, steps(jumps, 0.25)),
        Phase("hold", "all legs held", 0.3, hold(middle), use="way"),
    ]
    return Plan("latency", True, tuple(phases), middle - STEP, middle + STEP, DUTY)


def _spikes(height: Array) -> Signal:
    """A spike in the first command after each multiple of `SPIKE_EVERY`, turned round each time."""

    def signal(t: float, start: Array) -> Array:
        which, since = divmod(t + 1e-9, SPIKE_EVERY)
        return height * (1.0 if which % 2 == 0 else -1.0) if since < _SHORT else np.zeros_like(height)

    return signal
