"""Blend of two reference gaits that follow the same commands, one of them for terrain with holes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.task.commands import CommandState
from surefoot.task.reference import FollowingReference


@dataclass(frozen=True)
class GaitSwitch(FollowingReference):
    """A reference that switches to a second gait while the map of heights shows holes, see `Footholds`.

    Poses and frequencies are blended with the weight `CommandState.over_holes`. Strides, contact reflex and feedforward
    belong to the first gait. Footholds are chosen for the second gait.
    """

    holes_gait: FollowingReference = field(kw_only=True)
    """The gait over holes, without a contact reflex."""

    @property
    def over_holes(self) -> FollowingReference:
        """The gait over holes."""
        return self.holes_gait

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the gait frequency (N,) [Hz] for commands (N, 3) and the blend weight of the gait over holes (N,)."""
        own = super().frequency(command)
        if over_holes is None:
            return own
        return np.asarray(own + over_holes * (self.holes_gait.frequency(command) - own))

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the leg poses (..., N, C, L) for the state's commands, phases (..., N) and blend weight."""
        pose = super().pose(time, state)
        if state is None or state.over_holes is None or not state.over_holes.any():
            return pose
        other = self.holes_gait.pose(time, replace(state, lift=None))
        return np.asarray(pose + state.over_holes[:, None, None] * (other - pose))

    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent configuration as JSON values."""
        other = self.holes_gait.choice
        numbers = {name: getattr(other, name) for name in ("stride_gain", "frequency_rise")}
        return {**super().to_dict(), "over_holes": {"foot": self.holes_gait.feet.to_dict(), **numbers}}
