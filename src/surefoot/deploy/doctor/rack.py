"""The doctor's look at a robot that hangs free: each motor alone, a step of .05 rad there and back.

Which reading moves, and which way, shows order and signs; when it begins to move, the latency; how it goes on, the
servo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
from surefoot.deploy.doctor.leashed_robot import LeashedRobot, MotionStoppedError
from surefoot.deploy.doctor.rest import Sample
from surefoot.deploy.robot_link import RobotLink
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals
from surefoot.task.contract_mapping import task_from_contract

NAMES = ("motors, one by one", "control latency", "servo response")
STEP = 0.05
"""How far each motor is asked to go [rad]: too little to hurt, a hundred times what an encoder tells apart."""
LEASH = 0.15
"""How far [rad] a motor may be from where it was sent before all are damped."""
SETTLE, HOLD = 0.4, 0.35
"""Time [s] that the robot is held before the first step, and after each."""
AMOUNT = (0.6, 1.4)
"""How far the motor that was asked must go, in shares of the step: gravity and friction take some."""
OTHERS = 0.3
"""How far any other motor may go, in shares of the step."""
LATENCY_TOLERANCE = 0.006
"""How far [s] the latency may be from the one that the policy was trained with: a control step of the paper, less than
what a policy that was trained at one latency is known to bear; ranges that it was trained in count in full."""
RISE = 0.08
"""Longest time [s] for 63 % of a step: half a stride of the trot takes .25 s."""
_SETTLED = 5
"""Readings that are averaged once a motor has settled."""
_FIT_ERROR = 0.15
_FEWEST = 8
WINDOW = 0.15
"""Time after a step [s] whose readings are kept."""
_EARLY = 0.5
"""Share of the step up to which readings are fitted: later on the leg's other motor gives way, and its loop bends the
response in a way that no two poles follow; fits of all readings were up to 6 ms off, these 1."""
_DELAYS = np.arange(0.0, 0.1, 0.001)
_FREQUENCIES = np.geomspace(15.0, 400.0, 28)
_DAMPINGS = np.array([0.3, 0.45, 0.6, 0.8, 1.05, 1.3, 1.8, 2.6, 4.0])


@dataclass(frozen=True)
class Wiggle:
    """What was seen when one motor was asked to go there and back."""

    motor: int
    """Which one."""
    step: float
    """How far it was asked to go [rad], with sign."""
    moved: Array
    """How far each motor had gone when it had settled (M,) [rad]."""
    age: Array
    """Of readings after both steps: time since the command arrived at the robot (n,) [s]."""
    share: Array
    """What of the way the motor that was asked had gone by then (n,)."""


def wiggle_motors(
    link: RobotLink, contract: Contract, robot: RobotDescription, operator: StopSignals
) -> list[CheckResult]:
    """Arm a robot on its rack, wiggle each motor, disarm, and judge.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the port is gone.
    """
    state, handshake = link.state, link.handshake
    if state is None or handshake is None:
        return [CheckResult(NAMES[0], False, "the robot tells nothing of its state", "switch it off and on")]
    start = np.clip(state.motor_angle, handshake.angle_low, handshake.angle_high)
    wiggles: list[Wiggle] = []
    leashed = LeashedRobot(link, robot, contract.control_step, operator, LEASH)
    asked: int | None = None
    try:
        with leashed:
            leashed.hold(start, SETTLE)
            for motor in range(robot.num_motors):
                asked = motor
                # Away from the nearer limit.
                middle = (handshake.angle_low[motor] + handshake.angle_high[motor]) / 2
                step = STEP if start[motor] <= middle else -STEP
                wiggles.append(_wiggle(leashed, start, motor, step))
    except MotionStoppedError as stopped:
        return [_stopped(stopped, leashed, asked, robot), *skipped(NAMES[1:], "the wiggle did not come to its end")]
    return [
        check_motors(wiggles, robot),
        *check_response(wiggles, _trained_latencies(contract, robot), handshake.servo_period, link.lead),
    ]


def _wiggle(leashed: LeashedRobot, start: Array, motor: int, step: float) -> Wiggle:
    before = _settled(leashed.samples)
    target = start.copy()
    target[motor] += step
    command, samples = leashed.hold(target, HOLD)
    there = _settled(samples)
    points = _points(samples, command, before, motor, step, leashed.control_step)
    command, samples = leashed.hold(start, HOLD)
    points += _points(samples, command, there, motor, -step, leashed.control_step)
    # The fit has to wait until the robot is disarmed: it takes longer than a robot waits for commands.
    age, share = np.array(points or np.empty((0, 2))).T
    return Wiggle(motor, step, there - before, age, share)


def _settled(samples: Sequence[Sample]) -> Array:
    """Motor angles (M,) of the last readings."""
    return np.mean([sample.state.motor_angle for sample in samples[-_SETTLED:]], axis=0)


def _points(
    samples: Sequence[Sample], command: int, before: Array, motor: int, step: float, period: float
) -> list[tuple[float, float]]:
    """Time since the command arrived at the robot [s], and share of the step that was gone by then, of each reading."""
    arrived = next(
        (
            sample.time - sample.state.command_age - (sample.state.command - command) * period
            for sample in samples
            if 0 <= sample.state.command - command < 4
        ),
        None,
    )
    if arrived is None:
        return []
    points = [(s.time - arrived, (s.state.motor_angle[motor] - before[motor]) / step) for s in samples]
    return [point for point in points if 0 <= point[0] <= WINDOW]


def check_motors(wiggles: Sequence[Wiggle], robot: RobotDescription) -> CheckResult:
    """Whether each motor that was asked moved, by as much, and no other did."""
    name, names, wrong = NAMES[0], robot.motor_names, []
    goes: dict[int, int] = {}
    for wiggle in wiggles:
        share = wiggle.moved / wiggle.step
        others = [m for m in range(len(names)) if m != wiggle.motor and abs(share[m]) > OTHERS]
        own, who = share[wiggle.motor], names[wiggle.motor]
        if AMOUNT[0] <= own <= AMOUNT[1] and not others:
            continue
        asked = f"{who}, asked to go {wiggle.step:+.3f} rad,"
        if others and abs(own) <= OTHERS:
            first = max(others, key=lambda m: abs(share[m]))
            goes[wiggle.motor] = first
            wrong.append(f"{asked} stayed, and {names[first]} went {wiggle.moved[first]:+.3f}")
        elif others:
            told = ", ".join(names[m] for m in others)
            wrong.append(f"{asked} went {wiggle.moved[wiggle.motor]:+.3f} and took along {told}")
        else:
            wrong.append(f"{asked} went {wiggle.moved[wiggle.motor]:+.3f}")
    if not wrong:
        least, most = (100 * f(w.moved[w.motor] / w.step for w in wiggles) for f in (min, max))
        why = f"each went its own way, {least:.0f} to {most:.0f} % of the {STEP:g} rad asked for, no other with it"
        return CheckResult(name, True, why, value=float(least) / 100)
    pairs = [(a, b) for a, b in goes.items() if goes.get(b) == a and a < b]
    if pairs:
        told = ", ".join(f"{names[a]} with {names[b]}" for a, b in pairs)
        todo = f"exchanged: {told}; exchange their cables, or their places in the firmware"
    elif any(wiggle.moved[wiggle.motor] / wiggle.step < -OTHERS for wiggle in wiggles):
        todo = "turn the sign of what goes the wrong way, of motor or encoder, in the firmware"
    else:
        todo = "check cables, servo gains and what blocks the leg"
    more = f" (and {len(wrong) - 2} more)" if len(wrong) > 2 else ""
    return CheckResult(name, False, "; ".join(wrong[:2]) + more, todo)


def check_response(
    wiggles: Sequence[Wiggle], trained_latencies: tuple[float, float], servo_period: float, lead: float
) -> list[CheckResult]:
    """Judge when the motors began to move, and how fast they went.

    The delay between a command's arrival and the first motion in readings, as they are sent, is the age of these
    readings and what a command waits for the servo's next step, half a period on average. The policy uses a state
    `lead` after it was sent: a state that travels for longer is a control step late, which round trips tell.

    Args:
        wiggles: of all motors.
        trained_latencies: least and greatest control latency in training [s].
        servo_period: of the robot [s].
        lead: how long before it is used a state is sent [s].
    """
    clear = [w for w in wiggles if len(w.age) >= _FEWEST and abs(w.moved[w.motor]) > OTHERS * STEP]
    fits = [fit for fit in (fit_response(w.age, w.share) for w in clear) if fit.error < _FIT_ERROR]
    if len(fits) < max(len(wiggles) // 2, 1):
        return skipped(NAMES[1:], f"only {len(fits)} of {len(wiggles)} motors answered clearly")
    latency = float(np.median([fit.delay for fit in fits])) - servo_period / 2 + lead
    return [_latency(latency, trained_latencies, lead), _servo(float(np.median([fit.rise for fit in fits])))]


@dataclass(frozen=True)
class Response:
    """A step response of second order with a delay."""

    delay: float
    """From the command's arrival at the robot to the first motion in the readings, at the time they are sent [s]."""
    rise: float
    """From the first motion to 63 % of the way [s]."""
    error: float
    """Root mean square of what the fit leaves, for a step of 1."""


def fit_response(age: Array, moved: Array) -> Response:
    """Fit readings of a motor after a step of its target.

        y(t) = gain (1 + (p2 exp(p1 t) - p1 exp(p2 t)) / (p1 - p2)),  t = max(age - delay, 0)

    with the poles p = w (-z +- sqrt(z^2 - 1)): the servo's proportional and derivative gain on the inertia of a leg.

    Args:
        age: of each reading: time from the command's arrival until it was sent, on the robot's clock (n,) [s].
        moved: how far it had moved by then, in shares of the step (n,).
    """
    order = np.argsort(age, kind="stable")
    whole_age, whole_moved = age[order], moved[order]
    begun = np.flatnonzero(whole_moved > _EARLY)
    kept = whole_age <= (whole_age[begun[0]] if len(begun) else WINDOW)
    age, moved = whole_age[kept], whole_moved[kept]
    found, frequency, damping = _search(age, moved, _DELAYS, _FREQUENCIES, _DAMPINGS)
    for delay, spread in ((2e-3, 1.3), (5e-4, 1.1)):
        delays = found.delay + np.linspace(-delay, delay, 21)
        around = np.geomspace(1 / spread, spread, 9)
        found, frequency, damping = _search(age, moved, delays[delays >= 0], frequency * around, damping * around)
    return replace(found, rise=_crossing(whole_age, whole_moved, 1 - np.exp(-1)) - found.delay)


def _search(
    age: Array, moved: Array, delays: Array, frequencies: Array, dampings: Array
) -> tuple[Response, float, float]:
    """The best of a grid, with its frequency [rad/s] and damping ratio."""
    damping, frequency = (axis.ravel() for axis in np.meshgrid(dampings, frequencies))
    # Both poles being one is no case of its own, but a division by 0.
    root = np.sqrt((damping + 1e-6 * (damping == 1)).astype(complex) ** 2 - 1)
    one, other = frequency * (root - damping), frequency * (-root - damping)
    best, found, at = np.inf, Response(0.0, WINDOW, np.inf), 0
    for delay in delays:
        unit = _step(one, other, np.maximum(age - delay, 0.0))
        gain = (unit @ moved) / np.maximum((unit * unit).sum(axis=1), 1e-12)
        error = ((gain[:, None] * unit - moved) ** 2).sum(axis=1)
        index = int(np.argmin(error))
        if error[index] < best:
            best, at = float(error[index]), index
            found = Response(float(delay), WINDOW, float(np.sqrt(best / max(len(age), 1))))
    return found, float(frequency[at]), float(damping[at])


def _step(one: NDArray[np.complex128], other: NDArray[np.complex128], time: Array) -> Array:
    """Unit step responses (K, n) of K pairs of poles."""
    p, q = one[:, None], other[:, None]
    response: Array = np.real(1 + (q * np.exp(p * time) - p * np.exp(q * time)) / (p - q))
    return response


def _crossing(age: Array, moved: Array, share: float) -> float:
    """When readings first pass a share of the step [s], on a straight line between two; `WINDOW`, if never."""
    above = np.flatnonzero(moved >= share)
    if not len(above) or above[0] == 0:
        return WINDOW
    after = int(above[0])
    part = (share - moved[after - 1]) / (moved[after] - moved[after - 1])
    return float(age[after - 1] + part * (age[after] - age[after - 1]))


def _trained_latencies(contract: Contract, robot: RobotDescription) -> tuple[float, float]:
    """Return the least and greatest control latency [s] in a policy's training."""
    nominal = contract.control_latency
    low, high = task_from_contract(contract, robot).randomize.ranges.get("latency", (nominal, nominal))
    return min(low, nominal), max(high, nominal)


def _latency(latency: float, trained_range: tuple[float, float], lead: float) -> CheckResult:
    low, high = trained_range
    trained = f"{1e3 * low:g}" if low == high else f"{1e3 * low:g} to {1e3 * high:g}"
    told = (
        f"{1e3 * latency:.1f} ms (with {1e3 * lead:g} ms from sending to use); the policy was trained with {trained} ms"
    )
    return judge(
        NAMES[1],
        low - LATENCY_TOLERANCE <= latency <= high + LATENCY_TOLERANCE,
        told,
        f", and it must be within {1e3 * LATENCY_TOLERANCE:g} ms of that",
        f"find what delays the readings (filters, averaging, a slow bus), or train with control_latency {latency:.3f}",
        latency,
    )


def _servo(rise: float) -> CheckResult:
    told = f"63 % of a step in {1e3 * rise:.0f} ms"
    todo = "check servo gains, battery and friction in the legs"
    return judge(NAMES[2], rise <= RISE, told, f"; at most {1e3 * RISE:g} ms", todo, rise)


def _stopped(
    stopped: MotionStoppedError, leashed: LeashedRobot, asked: int | None, robot: RobotDescription
) -> CheckResult:
    name = NAMES[0]
    if stopped.verdict.reason == "operator":
        return skipped([name], "stopped by the operator", "run it again")[0]
    if leashed.strayed is None:
        return CheckResult(name, False, stopped.verdict.text, "mend that, and run the doctor again")
    motor, off = leashed.strayed
    when = "while all were asked to hold" if asked is None else f"while {robot.motor_names[asked]} was asked to move"
    return CheckResult(
        name,
        False,
        f"{robot.motor_names[motor]} went {off:+.2f} rad from where it was sent {when}; motors were damped",
        "its sign, of motor or encoder, is flipped, or its commands belong to another motor: check cables and firmware",
        robot.motor_names[motor],
    )
