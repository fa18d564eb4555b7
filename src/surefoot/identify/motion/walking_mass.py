"""Mass of a robot that walks, from the torques and the motion of a recorded run.

The base's mass follows from a steady walk, for legs of known mass. Forces on the feet follow from torques and motion
(`identify.ground.inverse_dynamics`), one moment a control step. Impacts between two readings are not seen, but motors
respond before and after them, and over many strides the vertical momentum returns to its value:

    sum of the masses = mean of the vertical forces / g
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
from surefoot.identify.recording import read_at
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

MIN_WALK = 3.0
"""Least length of a trace [s] whose mean force gives the weight."""
WALK_START = 1.0
"""Time [s] at the start of a run that is left out: the robot is not in its gait yet."""
MAX_TILT = 0.4
"""Roll or pitch [rad] from which the ground may touch more of a robot than its feet."""
WEIGHT_DEVIATION = 0.016
"""Relative standard deviation of the weight. In trots of emulated robots it was off by .9 % in the mean square, 1.6 %
at most, in gallops by up to 2.6 %."""
FORCE_BLOCK = 0.5
"""Length [s] of the blocks of time whose forces are taken to be independent."""
_FORCE_ROWS = 1500
_DIFFERENCE = 0.0015


def walking_mass(
    robot: RobotDescription, segments: Sequence[TorqueRows], params: PhysicalParams
) -> tuple[float, float, float]:
    """Return the mass [kg] of a robot that walks, and the base's ratio to the description's with its deviation."""
    walks = [walk for walk in map(_steady_part, segments) if walk is not None]
    if not walks:
        raise SurefootError(
            f"{MASS}: no trace has {MIN_WALK:g} s upright after its first {WALK_START:g} s; give longer walks, or "
            "leave it out"
        )
    light = InverseDynamics(robot, replace(params, base_mass_ratio=np.ones(1)))
    legs = light.mass - light.base_mass
    every = max(sum(len(walk.rows) for walk in walks) // _FORCE_ROWS, 1)
    means, spreads, lengths = [], [], []
    for walk in walks:
        times, vertical = _vertical_force(light, walk, params, every)
        # A window that begins and ends at zero leaves out the change of momentum from start to end.
        weight = np.sin(np.pi * (np.arange(len(times)) + 0.5) / len(times)) ** 2
        means.append(float(np.average(vertical, weights=weight)))
        blocks = ((times - times[0]) / FORCE_BLOCK).astype(np.int64)
        inside = [np.mean(vertical[blocks == k]) for k in range(int(blocks[-1]))]
        spreads.append(float(np.std(inside, ddof=1) / np.sqrt(len(inside))))
        lengths.append(float(times[-1] - times[0]))
    share = np.array(lengths) / np.sum(lengths)
    total = float(np.sum(share * means)) / GRAVITY
    if not total > legs:
        raise SurefootError(
            f"{MASS}: the feet carry {total:.2f} kg in the mean, less than the legs' {legs:.2f} kg; give walks on the "
            "ground, or leave it out"
        )
    random = float(np.sqrt(np.sum((share * spreads) ** 2))) / GRAVITY
    systematic = np.hypot(WEIGHT_DEVIATION, GAIN_DEVIATION / np.sqrt(robot.num_motors)) * total
    return total, (total - legs) / light.base_mass, float(np.hypot(random, systematic)) / light.base_mass


def _steady_part(segment: TorqueRows) -> TorqueRows | None:
    """Return the part in which the robot is in its gait and upright, if it is long enough."""
    time = segment.motion.read_time
    fallen = np.flatnonzero(np.abs(segment.motion.roll_pitch_yaw[:, :2]).max(axis=1) > MAX_TILT)
    end = fallen[0] if len(fallen) else len(time)
    rows = segment.rows[(time[segment.rows] > WALK_START) & (segment.rows < end)]
    length = float(np.ptp(time[rows])) if len(rows) else 0.0
    return replace(segment, rows=rows) if length >= MIN_WALK else None


def _vertical_force(
    dynamics: InverseDynamics, segment: TorqueRows, params: PhysicalParams, every: int
) -> tuple[Array, Array]:
    """Return times (n,) [s] and the sum of the vertical forces on the feet (n,) [N]."""
    thin = replace(segment, rows=segment.rows[::every])
    motion, late = segment.motion, float(params.control_latency[0])
    angle, speed = thin.state(0.0, late)
    acceleration = (thin.state(-_DIFFERENCE, late)[1] - thin.state(_DIFFERENCE, late)[1]) / (2 * _DIFFERENCE)
    at, times = motion.read_time[thin.rows] - thin.timing.age, motion.read_time - late
    rates = motion.angular_velocity_base
    tilt, rate = read_at(at, times, motion.roll_pitch_yaw[:, :2]), read_at(at, times, rates)
    turning = read_at(at, times, np.gradient(rates, motion.read_time, axis=0))
    torque = thin.torque + motor_friction(speed, params.motor_friction[0], params.motor_viscous_friction[0])
    forces = dynamics.forces(Motion(angle, speed, acceleration, torque, tilt, rate, turning))
    forward, up = forces.force.sum(axis=1).T
    return at, (up * np.cos(tilt[:, 0]) * np.cos(tilt[:, 1])) - forward * np.sin(tilt[:, 1])
