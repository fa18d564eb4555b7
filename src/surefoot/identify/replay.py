"""Sends what was recorded once more, to a batch of simulated robots, and reads them as the recording was read.

What a state of the robot's time t tells is, with the control latency L_c and the servo step dt:

    motor_angle, motor_velocity, roll, pitch, rates     of t - L_c, between servo steps on a straight line
    motor_torque                                        of the servo step that ended last, at t or before
    voltage                                             of t, which is that of the servo step that begins then

Commands act from the first servo step that begins when they have come or later. The robot's clock is taken to show
multiples of dt when servo steps begin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.wire.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.recording import Recording
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

Array = NDArray[np.float64]

SETTLE = 0.6
"""Time [s] for which simulated robots hold the first command before the recording begins."""
HELD = -1
"""An order: the servos hold the angles that they find, as they do from arming to the first command."""
_CLOCK = 2e-5
"""Resolution of the times in states [s], twice."""


@dataclass(frozen=True)
class Stretch:
    """A part of a recording: commands, and the states among them. Its time begins with the first command."""

    order_tick: NDArray[np.int64]
    """Servo step from which each command acts (C,), rising from 0."""
    order: Array
    """Motor angles [rad] or duties (C, M)."""
    kind: NDArray[np.int64]
    """What an order is (C,): `Mode.POSITION`, `Mode.PWM`, `Mode.DISARMED`, or `HELD`."""
    state_time: Array
    """When states were sent (T,) [s]."""
    states: NDArray[np.int64]
    """Their places in the recording (T,)."""
    voltage: Array
    """Of the battery in each servo step (ticks,) [V]."""
    start: Array
    """Motor angles (M,) [rad] that were held before the first command."""

    @property
    def ticks(self) -> int:
        """Servo steps."""
        return len(self.voltage)

    @property
    def duration(self) -> float:
        """Length [s]."""
        return float(self.state_time[-1] - self.state_time[0])


def stretch_of(recording: Recording, first: int, last: int) -> Stretch:
    """The phases `first` to `last`, of which the first one must begin with servos at rest.

    Between phases of servos and of duties the robot is disarmed for some milliseconds, and its motors damped.
    """
    dt = float(recording.meta["servo_period"])
    mine = np.flatnonzero((recording.sent_phase >= first) & (recording.sent_phase <= last))
    if len(mine) < 2:
        raise SurefootError(f"the recording has no commands of phases {first} to {last}")
    begins = np.ceil((recording.arrival[mine] - _CLOCK) / dt).astype(np.int64)
    modes = [phase["mode"] for phase in recording.meta["phases"]]
    kind = np.array([int(modes[int(phase)]) for phase in recording.sent_phase[mine]], np.int64)
    orders = recording.sent_value[mine]
    for sent, mode in recording.meta["mode_changes"]:
        tick = int(np.ceil((sent + recording.way - _CLOCK) / dt))
        if begins[0] < tick <= begins[-1]:
            place = int(np.searchsorted(begins, tick, side="right"))
            begins = np.insert(begins, place, tick)
            orders = np.insert(orders, place, 0.0, axis=0)
            kind = np.insert(kind, place, {Mode.POSITION: HELD, Mode.PWM: Mode.PWM}.get(mode, Mode.DISARMED))
    states = np.flatnonzero(
        (recording.time >= recording.arrival[mine[0]]) & (recording.time <= recording.arrival[mine[-1]] + _CLOCK)
    )
    origin = int(begins[0])
    state_time = recording.time[states] - origin * dt
    ticks = int(np.floor(state_time[-1] / dt + 1e-6)) + 1
    # The voltage falls when a command makes the current jump: what a step had is told by the state that follows.
    following = np.searchsorted(recording.time, (origin + np.arange(ticks)) * dt - _CLOCK)
    return Stretch(
        order_tick=begins - origin,
        order=orders,
        kind=kind,
        state_time=state_time,
        states=states,
        voltage=recording.voltage[np.minimum(following, len(recording.time) - 1)],
        start=recording.sent_value[mine[0]],
    )


@dataclass(frozen=True)
class Replayed:
    """What N simulated robots would have told in T states."""

    motor_angle: Array
    """(N, T, M) [rad]."""
    motor_velocity: Array
    """(N, T, M) [rad/s]."""
    motor_torque: Array
    """(N, T, M) [N m]."""
    roll_pitch_yaw: Array
    """(N, T, 3) [rad], without the IMU's bias."""
    angular_velocity_base: Array
    """(N, T, 3) [rad/s]."""


class Replayer:
    """Simulated robots that go through a stretch of a recording.

    Args:
        robot: their description.
        num_envs: how many at a time.
        rack: whether they hang in the air.
    """

    def __init__(self, robot: RobotDescription, num_envs: int, rack: bool) -> None:
        self.robot, self.num_envs = robot, num_envs
        self.world = SimWorld(robot, num_envs, config=WorldConfig(rack=rack))

    def run(self, stretch: Stretch, params: PhysicalParams) -> Replayed:
        """Go through it, with at most `num_envs` rows of parameters."""
        given, history, torque = self._simulate(stretch, params)
        return self._read(stretch, given, params.num_envs, history, torque)

    def read_late(self, stretch: Stretch, params: PhysicalParams, latencies: Array) -> Array:
        """Motor angles (K, T, M) [rad] that one simulated robot would tell with each of K control latencies [s]."""
        given, history, torque = self._simulate(stretch, params)
        many, rows = given.rows(np.zeros(len(latencies), np.int64)), np.zeros(len(latencies), np.int64)
        many.control_latency[:] = latencies
        return self._read(stretch, many, len(latencies), history[:, rows], torque[:, rows]).motor_angle

    def _simulate(self, stretch: Stretch, params: PhysicalParams) -> tuple[PhysicalParams, Array, Array]:
        """Parameters as applied, states (ticks + 1, N, width), and torques of the steps that led to them."""
        world, rows, robot = self.world, params.num_envs, self.robot
        motors = robot.num_motors
        everyone = np.arange(self.num_envs)
        given = params.rows(np.minimum(everyone, rows - 1))
        world.set_params(everyone, given)
        world.reset()
        drive = world.drive
        active = np.where(everyone < rows, 1, 0)
        drive.voltage[:] = stretch.voltage[0]
        self._settle(stretch.start, active)
        history = np.empty((stretch.ticks + 1, rows, drive.now.shape[1]))
        torque = np.empty((stretch.ticks + 1, rows, motors))
        history[0], torque[0] = drive.now[:rows], drive.motor_torque[:rows]
        order = -1
        changes = np.append(stretch.order_tick, stretch.ticks + 1)
        for tick in range(stretch.ticks):
            while changes[order + 1] <= tick:
                order += 1
                self._obey(int(stretch.kind[order]), stretch.order[order], given)
            drive.voltage[:] = stretch.voltage[tick]
            world.engine.advance(active)
            history[tick + 1], torque[tick + 1] = drive.now[:rows], drive.motor_torque[:rows]
        # Row k of the history is the state at k dt; its torque is that of the step before.
        return given, history, torque

    def _obey(self, kind: int, order: Array, params: PhysicalParams) -> None:
        drive = self.world.drive
        follows = kind in (Mode.POSITION, HELD)
        drive.duty[:] = order if kind == Mode.PWM else 0.0
        drive.kp[:] = params.servo_kp if follows else 0.0
        # A robot that is not armed damps its motors with the derivative gain of its data sheet.
        drive.kd[:] = params.servo_kd if follows else self.robot.actuator.kd if kind == Mode.DISARMED else 0.0
        drive.target[:] = drive.now[:, : self.robot.num_motors] if kind == HELD else order

    def _settle(self, start: Array, active: NDArray[np.int64]) -> None:
        drive, steps = self.world.drive, round(SETTLE / self.robot.timing.servo_step)
        begin = drive.target.copy()
        for k in range(steps):
            share = min(2 * k / steps, 1.0)
            drive.target[:] = begin + (start - begin) * share
            self.world.engine.advance(active)

    def _read(
        self, stretch: Stretch, params: PhysicalParams, rows: int, history: Array, torque: Array
    ) -> Replayed:
        motors, last, dt = self.robot.num_motors, len(history) - 1, self.robot.timing.servo_step
        told = np.empty((rows, len(stretch.state_time), history.shape[2]))
        for row in range(rows):
            at = np.clip((stretch.state_time - params.control_latency[row]) / dt, 0.0, last)
            before = np.minimum(at.astype(np.int64), last - 1)
            share = (at - before)[:, None]
            told[row] = (1 - share) * history[before, row] + share * history[before + 1, row]
        ended = np.clip(np.floor(stretch.state_time / dt + 1e-3).astype(np.int64), 0, last)
        return Replayed(
            motor_angle=told[:, :, :motors],
            motor_velocity=told[:, :, motors : 2 * motors],
            motor_torque=np.moveaxis(torque[ended], 1, 0),
            roll_pitch_yaw=told[:, :, 2 * motors : 2 * motors + 3],
            angular_velocity_base=told[:, :, 2 * motors + 3 :],
        )
