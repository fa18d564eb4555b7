"""How far from their footholds feet land: what the reward term `foothold_error` counts, in simulation alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.rotations import from_heading_frame, quat_matrix
from surefoot.task.commands import CommandState
from surefoot.task.footholds import CHOSEN, Footholds
from surefoot.world.interface import Truth

_AIRBORNE = 4
"""Control steps without contact after which a contact is a landing."""
_LANDS = 0.7
"""Part of the swing after which a contact is one."""
_GOES = 0.5
"""Share of full steps from which feet have footholds."""
_LATE = 0.3
"""Part of the cycle after which a foot that has not landed has missed the ground."""
_UNIT = 1 / 12
"""Distance that counts 1, in lengths l of the straight leg."""
_MOST = 4.0
"""The most that a landing counts, and what a foot does that has missed the ground."""


class Landings:
    """Places in the world where the feet of N robots with L legs are to land, and whether they did.

    Args:
        footholds: on which feet should land.
    """

    arrays = ("places", "share", "airborne")
    """Names of the arrays that change over time."""

    def __init__(self, footholds: Footholds) -> None:
        self.footholds, shape = footholds, footholds.landed.shape
        self.places = np.full((*shape, 2), np.nan)
        """Of feet in the second part of their swing (N, L, 2) [m]; NaN for others."""
        self.share = np.zeros(shape)
        """Part of the feet's cycles that was over at the end of the last control step (N, L)."""
        self.airborne = np.zeros(shape)
        """Control steps since the last contact (N, L)."""

    def reset(self, rows: NDArray[np.int64]) -> None:
        """Let robots stand."""
        self.places[rows], self.share[rows], self.airborne[rows] = np.nan, 0.0, 0.0

    def judge(self, truth: Truth) -> Array:
        """Return what the landings of a control step count (N,), with the truth at its end."""
        part = self._swing_part(self.share)
        touches, awaited = truth.foot_contact > 0, np.isfinite(self.places[..., 0])
        lands = touches & awaited & (self.airborne >= _AIRBORNE) & ((part <= 0.0) | (part > _LANDS))
        late = ~touches & awaited & (part <= 0.0) & (self.share > _LATE)
        robot = self.footholds.reference.robot
        foot = robot.foot_positions(truth.motor_angle)
        there = truth.base_position_world[:, None] + foot @ np.swapaxes(quat_matrix(truth.base_quat_world), 1, 2)
        distance = np.linalg.norm(there[..., :2] - self.places, axis=-1) / (_UNIT * robot.leg_geometry.length)
        self.places[lands | late] = np.nan
        self.airborne = np.where(touches, 0.0, self.airborne + 1.0)
        return np.where(lands, np.fmin(distance**2, _MOST), _MOST * late).sum(axis=1)

    def plan(self, truth: Truth, state: CommandState) -> None:
        """Take the footholds that feet have chosen now, with what the gait follows next."""
        share, goes = self.footholds.reference.feet.shares(state.phase), state.activity > _GOES
        chosen = (self._swing_part(share) >= CHOSEN) & (self._swing_part(self.share) < CHOSEN)
        chosen &= (self.footholds.follows & goes)[:, None]
        places = from_heading_frame(self.footholds.landing_places(state), truth.roll_pitch_yaw[:, 2])
        self.places = np.where(chosen[..., None], truth.base_position_world[:, None, :2] + places, self.places)
        self.share = share

    def _swing_part(self, share: Array) -> Array:
        """Return the part of the swing that is over of feet (N, L), less than 0 in stance."""
        duty = self.footholds.reference.feet.duty_factor
        return np.asarray((share - duty) / (1.0 - duty))
