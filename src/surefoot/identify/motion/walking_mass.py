"""Mass of a walking robot, from the torques and the motion of a recorded run.

A steady walk gives the mass of the base if the mass of the legs is known. Foot forces follow from torques and motion
(`identify.ground.inverse_dynamics`), once per control step. Impacts between two readings are not observed, but motors
respond before and after them, and over many strides the mean change of the vertical momentum is zero:

    total mass = mean of the vertical forces / g
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from surefoot.actuator import motor_friction
from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.ground.inverse_dynamics import InverseDynamics, Motion
from surefoot.identify.model import GAIN_DEVIATION
from surefoot.identify.motion.torque_model import MASS
from surefoot.identify.motion.torque_rows import TorqueRows
from surefoot.identify.recording import interpolate_columns
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

MIN_WALK = 3.0
"""Minimum length of a trace [s] whose mean force gives the weight."""
WALK_START = 1.0
"""Time [s] at the start of a run that is left out, because the gait is not steady yet."""
MAX_TILT = 0.4
"""Roll or pitch [rad] above which other parts than the feet may touch the ground."""
WEIGHT_DEVIATION = 0.016
"""Relative standard deviation of the weight. In trots of emulated robots the RMS error was 0.9 % and the maximum 1.6 %;
in gallops the maximum was 2.6 %."""
FORCE_BLOCK = 0.5
"""Length [s] of the time blocks whose forces are taken as independent."""
_FORCE_ROWS = 1500
_DIFFERENCE = 0.0015


def walking_mass(
    robot: RobotDescription, segments: Sequence[TorqueRows], params: PhysicalParams
) -> tuple[float, float, float]:
    """Return the total mass of a walking robot [kg], the ratio of the base mass to the description, and its deviation.

    Raises:
        SurefootError: no trace has a long enough walk, or the feet carry less than the mass of the legs.
    """
    walks = [walk for walk in map(_steady_part, segments) if walk is not None]
    if not walks:
        raise SurefootError(
            f"{MASS}: no trace has {MIN_WALK:g} s upright after its first {WALK_START:g} s; give longer walks, or do "
            "not fit it"
        )
    dynamics = InverseDynamics(robot, replace(params, base_mass_ratio=np.ones(1)))
    legs = dynamics.mass - dynamics.base_mass
    every = max(sum(len(walk.rows) for walk in walks) // _FORCE_ROWS, 1)
    means, spreads, lengths = [], [], []
    for walk in walks:
        times, vertical = _vertical_force(dynamics, walk, params, every)
        # A window that starts and ends at zero reduces the effect of the momentum's change from start to end.
        weight = np.sin(np.pi * (np.arange(len(times)) + 0.5) / len(times)) ** 2
        means.append(float(np.average(vertical, weights=weight)))
        blocks = ((times - times[0]) / FORCE_BLOCK).astype(np.int64)
        inside = [np.mean(vertical[blocks == k]) for k in np.unique(blocks)[:-1]]  # the last one is cut off
        spreads.append(float(np.std(inside, ddof=1) / np.sqrt(len(inside))))
        lengths.append(float(times[-1] - times[0]))
    weights = np.array(lengths) / np.sum(lengths)
    total = float(np.sum(weights * means)) / GRAVITY
    if not total > legs:
        raise SurefootError(
            f"{MASS}: the feet carry {total:.2f} kg on average, less than the mass of the legs, {legs:.2f} kg; give "
            "walks on the ground, or do not fit it"
        )
    random = float(np.sqrt(np.sum((weights * spreads) ** 2))) / GRAVITY
    systematic = np.hypot(WEIGHT_DEVIATION, GAIN_DEVIATION / np.sqrt(robot.num_motors)) * total
    return total, (total - legs) / dynamics.base_mass, float(np.hypot(random, systematic)) / dynamics.base_mass


def _steady_part(segment: TorqueRows) -> TorqueRows | None:
    """Return the part with a steady gait and an upright robot, or None if it is too short."""
    time = segment.motion.read_time
    fallen = np.flatnonzero(np.abs(segment.motion.roll_pitch_yaw[:, :2]).max(axis=1) > MAX_TILT)
    end = fallen[0] if len(fallen) else len(time)
    rows = segment.rows[(time[segment.rows] > WALK_START) & (segment.rows < end)]
    length = float(np.minimum(np.diff(time[rows]), FORCE_BLOCK).sum())  # gaps are no walk
    return replace(segment, rows=rows) if length >= MIN_WALK else None


def _vertical_force(
    dynamics: InverseDynamics, segment: TorqueRows, params: PhysicalParams, every: int
) -> tuple[Array, Array]:
    """Return times (n,) [s] and the sum of the vertical forces on the feet (n,) [N]."""
    subset = replace(segment, rows=segment.rows[::every])
    motion, latency = segment.motion, float(params.control_latency[0])
    angle, speed = subset.state(0.0, latency)
    acceleration = (subset.state(-_DIFFERENCE, latency)[1] - subset.state(_DIFFERENCE, latency)[1]) / (2 * _DIFFERENCE)
    at, times = motion.read_time[subset.rows] - subset.timing.age, motion.read_time - latency
    rates = motion.angular_velocity_base
    tilt, rate = interpolate_columns(at, times, motion.roll_pitch_yaw[:, :2]), interpolate_columns(at, times, rates)
    turning = interpolate_columns(at, times, np.gradient(rates, motion.read_time, axis=0))
    torque = subset.torque + motor_friction(speed, params.motor_friction[0], params.motor_viscous_friction[0])
    forces = dynamics.forces(Motion(angle, speed, acceleration, torque, tilt, rate, turning))
    forward, up = forces.force.sum(axis=1).T
    return at, (up * np.cos(tilt[:, 0]) * np.cos(tilt[:, 1])) - forward * np.sin(tilt[:, 1])
