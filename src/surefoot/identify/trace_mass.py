"""The base's mass from a steady walk: what the feet carry is, in the mean, the robot's weight.

Forces on the feet follow from torques and motion (`identify.inverse_dynamics`), one moment a control step. Impacts
between two readings are not seen, but motors feel them before and after, and over many strides the vertical momentum
comes back to what it was:

    sum of the masses = mean of the vertical forces / g
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator import motor_friction
from surefoot.errors import SurefootError
from surefoot.identify.fits.motor import GAIN
from surefoot.identify.inverse_dynamics import InverseDynamics, Motion
from surefoot.identify.trace_rows import Piece
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription

Array = NDArray[np.float64]

LEAST = 3.0
"""Least length of a trace [s] whose mean force is taken for the weight."""
START = 1.0
"""Time [s] at the start of a run that is left out: the robot is not in its gait yet."""
TILT = 0.4
"""Roll or pitch [rad] from which the ground may touch more of a robot than its feet."""
WEIGHT_ERROR = 0.016
"""Relative standard deviation of a weight that is found so. In trots of emulated robots it was off by .9 % in the mean
square and 1.6 % at most, in gallops by up to 2.6 %."""
BLOCK = 0.5
"""Length [s] of the blocks of time whose forces are taken to be independent."""
_ROWS = 1500
_DIFFERENCE = 0.0015


@dataclass(frozen=True)
class Mass:
    """What a steady walk tells."""

    total: float
    """Mass of the robot [kg]."""
    base_ratio: float
    """Of the base's mass, to the description's; that of the legs is taken as it is known."""
    deviation: float
    """Of the ratio."""


def walking_mass(robot: RobotDescription, pieces: Sequence[Piece], params: PhysicalParams) -> Mass:
    """Find the mass of a robot that walks.

    Args:
        robot: its description.
        pieces: of traces.
        params: latencies, friction, and mass of the legs, one row.

    Raises:
        SurefootError: no run is long enough with the robot upright, or the forces are not those of a robot on its feet.
    """
    usable = [piece for piece in (_walk(piece) for piece in pieces) if piece is not None]
    if not usable:
        raise SurefootError(
            f"base_mass_ratio: no trace has {LEAST:g} s upright after its first {START:g} s; give longer walks, "
            "or leave it out"
        )
    light = InverseDynamics(robot, replace(params, base_mass_ratio=np.ones(1)))
    base = light.base_mass
    rest = light.mass - base
    every = max(sum(len(piece.rows) for piece in usable) // _ROWS, 1)
    means, spreads, lengths = [], [], []
    for piece in usable:
        times, vertical = _vertical_force(light, piece, params, every)
        # A window that begins and ends at nothing does not count what momentum the robot gained from start to end.
        weight = np.sin(np.pi * (np.arange(len(times)) + 0.5) / len(times)) ** 2
        means.append(float(np.average(vertical, weights=weight)))
        blocks = ((times - times[0]) / BLOCK).astype(np.int64)
        inside = [np.mean(vertical[blocks == k]) for k in range(int(blocks[-1]))]
        spreads.append(float(np.std(inside, ddof=1) / np.sqrt(len(inside))))
        lengths.append(float(times[-1] - times[0]))
    share = np.array(lengths) / np.sum(lengths)
    force = float(np.sum(share * means))
    total = force / GRAVITY
    if not total > rest:
        raise SurefootError(
            f"base_mass_ratio: the feet carry {total:.2f} kg in the mean, less than the legs' {rest:.2f} kg; "
            "give walks on the ground, or leave it out"
        )
    random = float(np.sqrt(np.sum((share * spreads) ** 2))) / GRAVITY
    sure = np.hypot(WEIGHT_ERROR, GAIN / np.sqrt(robot.num_motors)) * total
    return Mass(total, (total - rest) / base, float(np.hypot(random, sure)) / base)


def _walk(piece: Piece) -> Piece | None:
    """The part of a piece in which the robot is in its gait and upright, if it is long enough."""
    trace = piece.trace
    fallen = np.flatnonzero(np.abs(trace.roll_pitch_yaw[:, :2]).max(axis=1) > TILT)
    end = fallen[0] if len(fallen) else trace.num_steps
    rows = piece.rows[(trace.time[piece.rows] > START) & (piece.rows < end)]
    length = float(np.ptp(trace.time[rows])) if len(rows) else 0.0
    return replace(piece, rows=rows) if length >= LEAST else None


def _vertical_force(dynamics: InverseDynamics, piece: Piece, params: PhysicalParams, every: int) -> tuple[Array, Array]:
    """Times (n,) [s] and the sum of the vertical forces on the feet (n,) [N]."""
    thin = replace(piece, rows=piece.rows[::every])
    trace, late = piece.trace, float(params.control_latency[0])
    angle, speed = thin.motion(0.0, late)
    acceleration = (thin.motion(-_DIFFERENCE, late)[1] - thin.motion(_DIFFERENCE, late)[1]) / (2 * _DIFFERENCE)
    at = trace.time[thin.rows] - thin.reporting.age

    def read(values: Array) -> Array:
        return np.stack([np.interp(at, trace.time - late, column) for column in values.T], axis=1)

    tilt = read(trace.roll_pitch_yaw[:, :2])
    turning = np.gradient(trace.angular_velocity_base, trace.time, axis=0)
    torque = thin.torque + motor_friction(speed, params.motor_friction[0], params.motor_viscous_friction[0])
    rate = read(trace.angular_velocity_base)
    forces = dynamics.forces(Motion(angle, speed, acceleration, torque, tilt, rate, read(turning)))
    forward, up = forces.force.sum(axis=1).T
    return at, (up * np.cos(tilt[:, 0]) * np.cos(tilt[:, 1])) - forward * np.sin(tilt[:, 1])
