"""Distance of touchdowns from their footholds, for the reward term `foothold_error`; only in simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.rotations import from_heading_frame, quat_matrix
from surefoot.task.commands import CommandState
from surefoot.task.component import Component
from surefoot.task.footholds import FOOTHOLD_FIXED_PHASE, Footholds
from surefoot.task.state import EnvState
from surefoot.world.interface import SimState

MIN_AIRBORNE_STEPS = 4
"""Control steps without contact after which a contact is a landing."""
MIN_LANDING_PHASE = 0.7
"""Part of the swing after which a contact is one."""
MIN_STRIDE_FRACTION = 0.5
"""Share of full steps from which feet have footholds."""
MISSED_PHASE = 0.3
"""Part of the cycle after which a foot that has not landed has missed the ground."""
LANDING_COST_SCALE = 1 / 12
"""Distance with a cost of 1, in lengths l of the straight leg."""
MAX_LANDING_COST = 4.0
"""Maximum cost of a landing, and the cost of a foot that has missed the ground."""


class FootholdError(Component):
    """Places in the world where the feet of N robots with L legs are to land, and whether they did.

    Args:
        footholds: on which feet should land.
    """

    prefix = "landings"
    changing = ("places", "share", "airborne")

    def __init__(self, footholds: Footholds) -> None:
        self.footholds, shape = footholds, footholds.landed.shape
        self.places = np.full((*shape, 2), np.nan)
        """Of feet in the second part of their swing (N, L, 2) [m]; NaN for others."""
        self.share = np.zeros(shape)
        """Part of the feet's cycles that was over at the end of the last control step (N, L)."""
        self.airborne = np.zeros(shape)
        """Control steps since the last contact (N, L)."""

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Expect no landing of robots that stand."""
        self.places[rows], self.share[rows], self.airborne[rows] = np.nan, 0.0, 0.0

    def measure(self, state: EnvState) -> None:
        """Write the foothold error of the control step to the state."""
        state.foothold_error = self.compute(state.truth)

    def after_step(self, state: EnvState) -> None:
        """Take the footholds of the next control step."""
        assert state.gait_state is not None
        self.plan(state.truth, state.gait_state)

    def compute(self, truth: SimState) -> Array:
        """Return the foothold error of feet that touched down in this control step (N,), by the truth at its end."""
        part = self._swing_phase(self.share)
        touches, awaited = truth.foot_contact > 0, np.isfinite(self.places[..., 0])
        lands = touches & awaited & (self.airborne >= MIN_AIRBORNE_STEPS) & ((part <= 0.0) | (part > MIN_LANDING_PHASE))
        late = ~touches & awaited & (part <= 0.0) & (self.share > MISSED_PHASE)
        robot = self.footholds.reference.robot
        foot = robot.foot_positions(truth.motor_angle)
        there = truth.base_position_world[:, None] + foot @ np.swapaxes(quat_matrix(truth.base_quat_world), 1, 2)
        unit = LANDING_COST_SCALE * robot.leg_geometry.length
        distance = np.linalg.norm(there[..., :2] - self.places, axis=-1) / unit
        self.places[lands | late] = np.nan
        self.airborne = np.where(touches, 0.0, self.airborne + 1.0)
        return np.where(lands, np.fmin(distance**2, MAX_LANDING_COST), MAX_LANDING_COST * late).sum(axis=1)

    def plan(self, truth: SimState, state: CommandState) -> None:
        """Take the footholds that feet have chosen now, with what the gait follows next."""
        share, goes = self.footholds.reference.feet.shares(state.phase), state.activity > MIN_STRIDE_FRACTION
        chosen = (self._swing_phase(share) >= FOOTHOLD_FIXED_PHASE) & (self._swing_phase(self.share) < FOOTHOLD_FIXED_PHASE)
        chosen &= (self.footholds.follows & goes)[:, None]
        places = from_heading_frame(self.footholds.landing_places(state), truth.roll_pitch_yaw[:, 2])
        self.places = np.where(chosen[..., None], truth.base_position_world[:, None, :2] + places, self.places)
        self.share = share

    def _swing_phase(self, share: Array) -> Array:
        """Return the part of the swing that is over of feet (N, L), less than 0 in stance."""
        duty = self.footholds.reference.feet.duty_factor
        return np.asarray((share - duty) / (1.0 - duty))
