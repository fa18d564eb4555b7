"""Two gaits that follow the same commands, one of them over holes, and a share that blends them."""

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
    """A gait that follows commands, with another one while the map of heights has holes, see `Footholds`.

    Poses and frequencies go over from the one to the other with `CommandState.over_holes`. Strides, lift by touch and
    feed-forward are those of the first gait; footholds are chosen for the other one.
    """

    holes_gait: FollowingReference = field(kw_only=True)
    """The gait over holes; no foot is lifted further by touch in it."""

    @property
    def over_holes(self) -> FollowingReference:
        """The gait over holes."""
        return self.holes_gait

    def frequency(self, command: Array, over_holes: Array | None = None) -> Array:
        """Return the frequency (N,) [Hz] at commands (N, 3) and the share of the gait over holes (N,)."""
        own = super().frequency(command)
        if over_holes is None:
            return own
        return np.asarray(own + over_holes * (self.holes_gait.frequency(command) - own))

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at the state's commands, phases and share of the gait over holes."""
        pose = super().pose(time, state)
        if state is None or state.over_holes is None or not state.over_holes.any():
            return pose
        other = self.holes_gait.pose(time, replace(state, lift=None))
        return np.asarray(pose + state.over_holes[:, None, None] * (other - pose))

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration that makes it again, as JSON values."""
        other = self.holes_gait.choice
        numbers = {name: getattr(other, name) for name in ("stride_gain", "frequency_rise")}
        return {**super().to_dict(), "over_holes": {"foot": self.holes_gait.feet.to_dict(), **numbers}}
