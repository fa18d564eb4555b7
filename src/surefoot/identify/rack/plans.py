"""Plans of the motor and latency experiments on a rack. Legs in the air are independent, so all motors move at once."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.identify.plan import ExperimentLimits, Phase, Plan, Signal, chirps, hold, steps, transition
from surefoot.robot import RobotDescription
from surefoot.seeding import generator

PULSE_HEIGHTS = (8 / 45, 1 / 3, 5 / 9, 7 / 9, 1.0)
"""Heights of PWM pulses, relative to the maximum duty."""
PULSE_TIME = 0.014
"""Length of a PWM pulse [s]."""
BURST_TIME = 0.24
"""Length of a PWM phase [s]: pulses, then zero duty."""
SPIKE_PERIOD, SPIKES = 0.12, 2
"""Time between spikes [s], and their number in a phase."""
SPIKE_PHASES = 6
_SPIKE_LENGTH = 0.001
"""Length of a spike [s], shorter than any command period, so that a spike is a single command."""


def _to_middle(middle: Array, duration: float) -> Phase:
    return transition("centre", "all legs back to the middle", duration, middle, 0.3)


def motor_plan(robot: RobotDescription) -> Plan:
    """Return the plan of the motor experiment: slow sines, chirps, steps and PWM pulses."""
    motors, use = robot.num_motors, robot.experiments
    draw = generator(0, "motor experiment")
    middle = robot.pose_angles(0.0, use.stance)
    shift = np.zeros(motors)
    # The motors of a leg are a quarter turn apart to excite swing and extension. Phases differ between legs, to
    # distinguish them by eye.
    for leg, (first, second) in enumerate(robot.leg_motor_index):
        shift[first], shift[second] = 0.4 * leg, 0.4 * leg + np.pi / 2
    all_motors = np.ones(motors)
    wide = chirps(middle, use.chirp * all_motors, 0.5, 10.0, 8.0, shift)
    small, back = use.fraction("chirp", 4 / 15), use.fraction("chirp", 2 / 3)
    narrow = chirps(middle, small * all_motors, 8.0, 25.0, 3.0, shift)
    slow = chirps(middle, use.sweep * all_motors, 0.25, 0.5, 4.0, shift)
    other = chirps(middle, back * all_motors, 7.0, 1.5, 3.0, shift[::-1])
    jumps = middle + draw.uniform(-use.step, use.step, (16, motors))
    phases = [
        transition("unfold", "all legs to the middle of their range", 1.5, middle),
        Phase("hold", "all legs held", 0.6, hold(middle)),
        Phase("sweep slowly", f"every motor {use.sweep:g} rad to both sides, three strokes", 4.0, slow),
        Phase("chirp", f"every motor {use.chirp:g} rad to both sides, from 0.5 to 10 Hz", 8.0, wide),
        Phase("fast chirp", f"every motor {small:g} rad to both sides, from 8 to 25 Hz", 3.0, narrow),
        Phase("steps", f"every motor jumps by up to {use.step:g} rad to both sides, 16 times", 4.0, steps(jumps, 0.25)),
    ]
    what = f"motors without servo: pulses of {1e3 * PULSE_TIME:g} ms, up to {use.duty:g} duty, back and forth"
    heights = [use.fraction("duty", height) for height in PULSE_HEIGHTS]
    for height in np.concatenate([draw.permutation(heights) for _ in range(2)]):
        pulses = _pulses(height * draw.choice([-1.0, 1.0], motors) * draw.uniform(0.7, 1.0, motors))
        phases += [_to_middle(middle, 0.5), Phase("PWM pulses", what, BURST_TIME, pulses, Mode.PWM)]
    phases += [
        _to_middle(middle, 0.7),
        Phase("chirp back", f"every motor {back:g} rad to both sides, from 7 to 1.5 Hz", 3.0, other, use="check"),
        Phase("hold", "all legs held", 0.3, hold(middle), use="check"),
    ]
    reach = max(use.chirp, use.sweep, use.step)
    return Plan("motor", True, tuple(phases), middle - reach, middle + reach, use.duty, ExperimentLimits(use.torque))


def _pulses(height: Array) -> Signal:
    """Return a pulse forward, a pulse back of twice the length, and one forward: the motor ends near its start."""

    def signal(t: float, start: Array) -> Array:
        return {0: 1.0, 1: -1.0, 2: -1.0, 3: 1.0}.get(int(t / PULSE_TIME + 1e-9), 0.0) * height

    return signal


def latency_plan(robot: RobotDescription) -> Plan:
    """Return the plan of the latency experiment: duty spikes of a single command, then motions under servo control."""
    motors, use = robot.num_motors, robot.experiments
    draw = generator(0, "latency experiment")
    middle = robot.pose_angles(0.0, use.stance)
    shift = np.where(np.arange(motors) % 2 == 0, 0.0, np.pi / 2)
    small, max_step = use.fraction("chirp", 0.4), use.fraction("step", 5 / 7)
    fast = chirps(middle, np.full(motors, small), 2.0, 20.0, 3.0, shift)
    jumps = middle + draw.uniform(-max_step, max_step, (8, motors))
    phases = [
        transition("unfold", "all legs to the middle of their range", 1.5, middle),
        Phase("hold", "all legs held", 0.5, hold(middle)),
    ]
    what = f"motors without servo: {SPIKES} spikes of {use.spike:g} duty, one command long, back and forth"
    for _ in range(SPIKE_PHASES):
        spikes = _spikes(use.spike * draw.choice([-1.0, 1.0], motors))
        phases += [Phase("spikes", what, SPIKES * SPIKE_PERIOD, spikes, Mode.PWM), _to_middle(middle, 0.5)]
    phases += [
        Phase("chirp", f"every motor {small:g} rad to both sides, from 2 to 20 Hz", 3.0, fast),
        Phase("steps", f"every motor jumps by up to {max_step:g} rad to both sides, 8 times", 2.0, steps(jumps, 0.25)),
        Phase("hold", "all legs held", 0.3, hold(middle), use="transition"),
    ]
    return Plan(
        "latency", True, tuple(phases), middle - use.step, middle + use.step, use.spike, ExperimentLimits(use.torque)
    )


def _spikes(height: Array) -> Signal:
    """Return spikes, each a single command, every `SPIKE_PERIOD` with alternating sign."""

    def signal(t: float, start: Array) -> Array:
        number, since = divmod(t + 1e-9, SPIKE_PERIOD)
        return height * (1.0 if number % 2 == 0 else -1.0) if since < _SPIKE_LENGTH else np.zeros_like(height)

    return signal
