"""Replay of recorded commands on a batch of simulated robots, with the readings that the recorder would have seen.

With the servo step dt, the control latency L_c (age of a reading when it is used) and the lead (time from sending a
state to its use), a state that was sent at time t on the robot's clock holds:

    motor_angle, motor_velocity, IMU    at t - L_c + lead, interpolated linearly between servo steps
    motor_torque                        of the last servo step that ended at or before t
    voltage                             of the servo step that begins at t

A command acts from the first servo step that begins at or after its arrival. Servo steps begin at multiples of dt on
the robot's clock.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.recording import CLOCK_RESOLUTION, Recording
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.actuation import read_imu
from surefoot.world.interface import WorldConfig
from surefoot.world.registry import DEFAULT_WORLD, WORLDS
from surefoot.world.sim_world import SimWorld

SETTLE_TIME = 0.6
"""Time [s] for which simulated robots hold the first command before the segment begins."""
INITIAL_WINDOW = 0.06
"""Time [s] at the start of a motion on a rack whose readings give the initial angles and speeds."""
MIN_INITIAL_READINGS = 5
"""Minimum number of readings in `INITIAL_WINDOW` for a speed."""
HOLD = -1
"""Kind of command: servos hold their present angles, as between arming and the first command."""


@dataclass(frozen=True)
class Segment:
    """Segment of a recording to replay: C commands and the T states among them. Time 0 is the first command."""

    command_tick: NDArray[np.int64]
    """Servo step from which each command acts (C,), rising from 0."""
    command: Array
    """Motor angles [rad] or duties (C, M)."""
    kind: NDArray[np.int64]
    """Kind of each command (C,): `Mode.POSITION`, `Mode.PWM`, `Mode.DISARMED`, or `HOLD`."""
    state_time: Array
    """Time at which each state was sent (T,) [s]."""
    states: NDArray[np.int64]
    """Indices of these states in the recording (T,)."""
    voltage: Array
    """Battery voltage in each servo step (ticks,) [V]."""
    start: Array
    """Motor angles held before the first command (M,) [rad]."""
    start_velocity: Array | None = None
    """Motor speeds at the first command (M,) [rad/s]. If given, robots are placed such that their readings are `start`,
    instead of being moved there by their servos, because under gravity they would settle elsewhere."""
    lead: float = 0.0
    """Time from sending a state to its use [s], which the control latency includes."""

    def with_clock_scale(self, scale: float, dt: float) -> Segment:
        """Return the segment with a corrected clock: one second of the recorded clock takes `scale` seconds.

        `dt` is the servo step [s].
        """
        state_time = self.state_time * scale
        velocity = None if self.start_velocity is None else self.start_velocity / scale
        return replace(
            self,
            command_tick=np.round(self.command_tick * scale).astype(np.int64),
            state_time=state_time,
            voltage=np.resize(self.voltage, _count_ticks(state_time, dt)),
            start_velocity=velocity,
        )


def segment_from_recording(recording: Recording, first: int, last: int) -> Segment:
    """Return the phases `first` to `last` of a recording; the first one must begin with servos at rest.

    When the mode changes between servo and PWM, the robot is disarmed and its motors are damped for some milliseconds.
    """
    dt = float(recording.meta["servo_period"])
    sent = np.flatnonzero((recording.sent_phase >= first) & (recording.sent_phase <= last))
    if len(sent) < 2:
        raise SurefootError(f"the recording has no commands of phases {first} to {last}")
    arrival = recording.arrival[sent]
    begins = recording.servo_step(arrival)
    modes = [phase["mode"] for phase in recording.meta["phases"]]
    kind = np.array([int(modes[int(phase)]) for phase in recording.sent_phase[sent]], np.int64)
    commands = recording.sent_value[sent]
    for sent_time, mode in recording.meta["mode_changes"]:
        tick = int(recording.servo_step(sent_time + recording.clock_offset))
        if begins[0] < tick <= begins[-1]:
            place = int(np.searchsorted(begins, tick, side="right"))
            begins = np.insert(begins, place, tick)
            commands = np.insert(commands, place, 0.0, axis=0)
            kind = np.insert(kind, place, {Mode.POSITION: HOLD, Mode.PWM: Mode.PWM}.get(mode, Mode.DISARMED))
    states = np.flatnonzero((recording.time >= arrival[0]) & (recording.time <= arrival[-1] + CLOCK_RESOLUTION))
    origin = int(begins[0])
    state_time = recording.time[states] - origin * dt
    ticks = _count_ticks(state_time, dt)
    # The voltage drops when a command makes the current jump, so the state after a servo step has its voltage.
    following = np.searchsorted(recording.time, (origin + np.arange(ticks)) * dt - CLOCK_RESOLUTION)
    return Segment(
        command_tick=begins - origin,
        command=commands,
        kind=kind,
        state_time=state_time,
        states=states,
        voltage=recording.voltage[np.minimum(following, len(recording.time) - 1)],
        start=recording.sent_value[sent[0]],
        lead=float(recording.meta["lead"]),
    )


def segment_from_motion(motion: RecordedMotion, robot: RobotDescription) -> Segment:
    """Return a recorded motion as a segment.

    A robot on a rack starts with the angles and speeds of its first readings. On the ground, joints whose command is
    constant start at their command. Moving joints start where the same joints of other legs are held, or at their
    first reading if these joints move in all legs.
    """
    dt, origin = robot.timing.servo_step, float(motion.time[0])
    state_time = np.maximum(motion.read_time - origin, 0.0)
    start, velocity = motion.command[0].copy(), None
    if motion.rack and not robot.loops and np.isfinite(motion.motor_angle[0]).all():
        start, velocity = _first_readings(motion)
    else:
        for motors in robot.leg_motor_index.T:
            still = motors[~motion.moving_joints[motors]]
            for motor in motors[motion.moving_joints[motors]]:
                reading = motion.motor_angle[0, motor]
                if len(still):
                    start[motor] = motion.command[0, still].mean()
                elif np.isfinite(reading):
                    start[motor] = reading
    return Segment(
        command_tick=np.ceil((motion.time - origin) / dt - 1e-6).astype(np.int64),
        command=motion.command,
        kind=np.full(len(motion.time), int(Mode.POSITION)),
        state_time=state_time,
        states=np.arange(len(motion.time)),
        voltage=np.full(_count_ticks(state_time, dt), float(robot.battery.nominal)),
        start=start,
        start_velocity=velocity,
    )


def _first_readings(motion: RecordedMotion) -> tuple[Array, Array]:
    """Return angles [rad] and speeds [rad/s] (M,) at the first row, from a parabola fitted to `INITIAL_WINDOW`."""
    first = motion.read_time <= motion.read_time[0] + INITIAL_WINDOW
    angles, since = motion.motor_angle[first], (motion.read_time - motion.read_time[0])[first]
    usable = np.isfinite(angles).all(axis=1) & motion.has_new_reading[first]
    if usable.sum() < MIN_INITIAL_READINGS:
        return motion.motor_angle[0].copy(), np.zeros(motion.motor_angle.shape[1])
    # A parabola instead of a line, because a motion that begins from rest has zero speed at its first row.
    _, slope, angle = np.polyfit(since[usable], angles[usable], 2)
    return angle, slope


def _count_ticks(state_time: Array, dt: float) -> int:
    return int(np.floor(state_time[-1] / dt + 1e-6)) + 1


@dataclass(frozen=True)
class ReplayedReadings:
    """Readings of N simulated robots with M motors at T states."""

    motor_angle: Array
    """(N, T, M) [rad]"""
    motor_velocity: Array
    """(N, T, M) [rad/s]"""
    motor_torque: Array
    """(N, T, M) [N m]; empty if the replayer does not record torques."""
    imu: Array
    """Roll, pitch, yaw [rad] and angular velocity in the IMU's frame [rad/s] (N, T, 6)."""


class Replayer:
    """Batch of simulated robots that replays segments of recordings.

    Args:
        robot: robot description.
        num_envs: number of robots that are simulated at once.
        rack: whether the bases are held in the air.
        engine: name of the physics engine in the registry of worlds; an engine that uses threads runs on all cores.
        torques: whether to record motor torques and apply the segment's voltage, which needs one engine call per
            servo step.
    """

    def __init__(
        self,
        robot: RobotDescription,
        num_envs: int,
        rack: bool = True,
        engine: str = DEFAULT_WORLD,
        torques: bool = True,
    ) -> None:
        self.robot, self.num_envs, self._torques = robot, num_envs, torques
        cores = min(os.cpu_count() or 1, num_envs) if WORLDS[engine].uses_threads else 1
        # One world per core: several threads of one world would wait for each other in every servo step.
        config = WorldConfig(rack=rack, threads=1)
        self._worlds = [SimWorld(robot, -(-num_envs // cores), config=config, engine=engine) for _ in range(cores)]
        self._pool = ThreadPoolExecutor(cores)

    def run(self, segment: Segment, params: PhysicalParams) -> ReplayedReadings:
        """Replay a segment on one robot per row of the parameters (`num_envs` rows at most)."""
        return self._read(segment, params, *self._simulate(segment, params))

    def angles_with_latencies(self, segment: Segment, params: PhysicalParams, latencies: Array) -> Array:
        """Return the motor angles (K, T, M) [rad] of one simulated robot, read with K control latencies [s]."""
        history, torque = self._simulate(segment, params)
        rows = np.zeros(len(latencies), np.int64)
        delayed = params.rows(rows)
        delayed.control_latency[:] = latencies
        return self._read(segment, delayed, history[:, rows], torque[:, rows]).motor_angle

    def _simulate(self, segment: Segment, params: PhysicalParams) -> tuple[Array, Array]:
        """Return states (ticks + 1, N, width) and the torques of the preceding servo steps (ticks + 1, N, M)."""
        chunks = np.array_split(np.arange(params.num_envs), min(len(self._worlds), params.num_envs))
        rows = [params.rows(chunk) for chunk in chunks]
        simulate = partial(_simulate_segment, segment, torques=self._torques)
        states, torques = zip(*self._pool.map(simulate, self._worlds[: len(rows)], rows), strict=True)
        return np.concatenate(states, axis=1), np.concatenate(torques, axis=1)

    def _read(self, segment: Segment, params: PhysicalParams, history: Array, torque: Array) -> ReplayedReadings:
        motors, last, dt = self.robot.num_motors, len(history) - 1, self.robot.timing.servo_step
        readings = np.empty((params.num_envs, len(segment.state_time), history.shape[2]))
        for row, latency in enumerate(params.control_latency.tolist()):
            age = max(latency - segment.lead, 0.0)
            at = np.clip((segment.state_time - age) / dt, 0.0, last)
            before = np.minimum(at.astype(np.int64), last - 1)
            weight = (at - before)[:, None]
            readings[row] = (1 - weight) * history[before, row] + weight * history[before + 1, row]
        ended = np.clip(np.floor(segment.state_time / dt + 1e-3).astype(np.int64), 0, len(torque) - 1)
        imu = readings[:, :, 2 * motors :]
        for row in range(params.num_envs):
            read_imu(imu[row, :, :3], imu[row, :, 3:], segment.state_time, params, np.full(len(imu[row]), row))
        return ReplayedReadings(
            motor_angle=readings[:, :, :motors],
            motor_velocity=readings[:, :, motors : 2 * motors],
            motor_torque=np.moveaxis(torque[ended] if len(torque) else torque, 1, 0),
            imu=imu,
        )


def _simulate_segment(segment: Segment, world: SimWorld, params: PhysicalParams, torques: bool) -> tuple[Array, Array]:
    """Simulate a segment; return the state at each servo step and the torques of the step before (empty if unused)."""
    rows, all_robots = params.num_envs, np.arange(world.num_envs)
    padded = params.rows(np.minimum(all_robots, rows - 1))
    world.set_params(all_robots, padded)
    world.reset()
    actuation, advance = world.actuation, world.engine.advance
    active = np.where(all_robots < rows, 1, 0)
    actuation.voltage[:] = segment.voltage[0]
    if segment.start_velocity is None:
        steps, begin = round(SETTLE_TIME / world.robot.timing.servo_step), actuation.target.copy()
        for k in range(steps):
            actuation.target[:] = begin + (segment.start - begin) * min(2 * k / steps, 1.0)
            advance(active)
    else:
        # Readings are old by the control latency; the motor has moved on since.
        age = padded.control_latency[:, None]
        velocity = np.broadcast_to(segment.start_velocity, actuation.target.shape)
        world.place_motors(segment.start + age * velocity, velocity)
    ticks, history_length = len(segment.voltage), len(actuation.times[0])
    history = np.empty((ticks + 1, rows, actuation.sample.shape[1]))
    torque = np.empty((ticks + 1 if torques else 0, rows, actuation.target.shape[1]))
    history[0], torque[:1] = actuation.sample[:rows], actuation.motor_torque[:rows]
    current, tick = -1, 0
    changes = [*segment.command_tick.tolist(), ticks]
    while tick < ticks:
        while changes[current + 1] <= tick and current + 1 < len(segment.command_tick):
            current += 1
            _apply_command(world, int(segment.kind[current]), segment.command[current], padded)
        actuation.voltage[:] = segment.voltage[tick]
        count = 1 if torques else min(changes[current + 1], ticks, tick + history_length) - tick
        advance(count * active)
        if torques:
            torque[tick + 1] = actuation.motor_torque[:rows]
        slots = np.arange(int(actuation.ticks[0]) - count + 1, int(actuation.ticks[0]) + 1) % history_length
        history[tick + 1 : tick + 1 + count] = np.moveaxis(actuation.history[:rows, slots], 1, 0)
        tick += count
    return history, torque


def _apply_command(world: SimWorld, kind: int, command: Array, params: PhysicalParams) -> None:
    actuation, servo = world.actuation, kind in (Mode.POSITION, HOLD)
    actuation.duty[:] = command if kind == Mode.PWM else 0.0
    actuation.kp[:] = params.servo_kp if servo else 0.0
    # A disarmed robot damps its motors with the derivative gain of its data sheet.
    damping = world.robot.actuator.kd if kind == Mode.DISARMED else 0.0
    actuation.kd[:] = params.servo_kd if servo else np.asarray(damping)
    actuation.target[:] = actuation.sample[:, : world.robot.num_motors] if kind == HOLD else command
