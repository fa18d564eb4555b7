"""Distance between touchdowns and planned footholds, for the reward term `foothold_error` (simulation only)."""

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
"""Minimum control steps without contact before a contact counts as a touchdown."""
MIN_LANDING_PHASE = 0.7
"""Minimum swing phase at which a contact counts as a touchdown."""
MIN_STRIDE_FRACTION = 0.5
"""Minimum stepping amplitude at which feet have footholds."""
MISSED_PHASE = 0.3
"""Phase of the cycle at which a foot that has not touched down has missed the ground."""
LANDING_COST_SCALE = 1 / 12
"""Distance with a cost of 1, in lengths l of the straight leg."""
MAX_LANDING_COST = 4.0
"""Maximum cost of a touchdown, and the cost of a foot that has missed the ground."""


class FootholdError(Component):
    """Planned footholds of N robots with L legs in the world frame, and the cost of touchdowns away from them.

    Args:
        footholds: component that chooses the footholds.
    """

    prefix = "landings"
    changing = ("places", "share", "airborne")

    def __init__(self, footholds: Footholds) -> None:
        self.footholds, shape = footholds, footholds.landed.shape
        self.places = np.full((*shape, 2), np.nan)
        """Planned footholds in the world frame (N, L, 2) [m]; NaN for feet without one."""
        self.share = np.zeros(shape)
        """Phase of each foot's cycle at the end of the last control step (N, L), 0 to 1."""
        self.airborne = np.zeros(shape)
        """Control steps since each foot's last contact (N, L)."""

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Start episodes without planned footholds."""
        self.places[rows], self.share[rows], self.airborne[rows] = np.nan, 0.0, 0.0

    def measure(self, state: EnvState) -> None:
        """Write the foothold error of the control step to the state."""
        state.foothold_error = self.compute(state.truth)

    def after_step(self, state: EnvState) -> None:
        """Store the footholds that became final in this control step."""
        assert state.gait_state is not None
        self.plan(state.truth, state.gait_state)

    def compute(self, truth: SimState) -> Array:
        """Return the foothold error (N,) of feet that touched down in this control step or missed the ground.

        Args:
            truth: true state at the end of the control step.
        """
        swing = self._swing_phase(self.share)
        contact, planned = truth.foot_contact > 0, np.isfinite(self.places[..., 0])
        in_time = (swing <= 0.0) | (swing > MIN_LANDING_PHASE)
        lands = contact & planned & (self.airborne >= MIN_AIRBORNE_STEPS) & in_time
        missed = ~contact & planned & (swing <= 0.0) & (self.share > MISSED_PHASE)
        robot = self.footholds.reference.robot
        foot = robot.foot_positions(truth.motor_angle)
        foot_world = truth.base_position_world[:, None] + foot @ np.swapaxes(quat_matrix(truth.base_quat_world), 1, 2)
        unit = LANDING_COST_SCALE * robot.leg_geometry.length
        distance = np.linalg.norm(foot_world[..., :2] - self.places, axis=-1) / unit
        self.places[lands | missed] = np.nan
        self.airborne = np.where(contact, 0.0, self.airborne + 1.0)
        return np.where(lands, np.fmin(distance**2, MAX_LANDING_COST), MAX_LANDING_COST * missed).sum(axis=1)

    def plan(self, truth: SimState, state: CommandState) -> None:
        """Store the footholds of feet whose choice became final, in the world frame.

        Args:
            truth: true state at the end of the control step.
            state: state of the gait in the next control step.
        """
        phase, steps = self.footholds.reference.feet.cycle_phase(state.phase), state.activity > MIN_STRIDE_FRACTION
        is_fixed, was_fixed = (self._swing_phase(one) >= FOOTHOLD_FIXED_PHASE for one in (phase, self.share))
        is_new = is_fixed & ~was_fixed & (self.footholds.is_active & steps)[:, None]
        places = from_heading_frame(self.footholds.landing_places(state), truth.roll_pitch_yaw[:, 2])
        self.places = np.where(is_new[..., None], truth.base_position_world[:, None, :2] + places, self.places)
        self.share = phase

    def _swing_phase(self, cycle_phase: Array) -> Array:
        """Return the phase of the swing (N, L), negative in stance, for the phase of the cycle."""
        duty = self.footholds.reference.feet.duty_factor
        return np.asarray((cycle_phase - duty) / (1.0 - duty))
