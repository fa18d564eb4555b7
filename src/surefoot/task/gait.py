"""The hybrid policy's arithmetic: a(t, o) = reference(t) + feedback(o), bounded, as motor angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.reference import Reference

Range = tuple[float, float]


class HybridGait:
    """Reference plus bounded feedback (Tan et al. 2018, eq. 3).

    Args:
        robot: legs, their order and range.
        reference: the open loop part.
        swing: bounds of the feedback on each leg's swing [rad].
        extension: bounds of the feedback on each leg's extension [rad].

    Raises:
        SurefootError: a command could leave the leg's range.
    """

    def __init__(self, robot: RobotDescription, reference: Reference, swing: Range, extension: Range) -> None:
        self.robot, self.reference = robot, reference
        self.low, self.high = np.repeat(np.array([swing, extension], float).T, len(robot.legs), axis=1)
        given, allowed = (swing, extension), (robot.swing_range, robot.extension_range)
        spans = zip(("swing", "extension"), reference.extent(), given, allowed, strict=True)
        for name, (least, most), (low, high), (allowed_low, allowed_high) in spans:
            if least + low < allowed_low - 1e-9 or most + high > allowed_high + 1e-9:
                raise SurefootError(
                    f"{name} can be {least + low:.3f} to {most + high:.3f} rad "
                    f"(reference {least:.3f} to {most:.3f}, feedback {low:g} to {high:g}); "
                    f"a leg of {robot.name} allows {allowed_low:g} to {allowed_high:g}"
                )

    @property
    def action_names(self) -> list[str]:
        """Names of the feedback's numbers: the swing of every leg, then the extension of every leg."""
        return [f"{part}.{leg}" for part in ("swing", "extension") for leg in self.robot.leg_names]

    @property
    def rest(self) -> Range:
        """Swing and extension [rad] in the middle of the range of commands."""
        (s_low, s_high), (e_low, e_high) = self.reference.extent()
        swing, extension = s_low + s_high + self.low[0] + self.high[0], e_low + e_high + self.low[-1] + self.high[-1]
        return float(swing) / 2, float(extension) / 2

    def feedback(self, action: ArrayLike) -> Array:
        """Return feedback (N, 2 L) [rad] for actions in [-1, 1], clipped: -1 is the lower bound, 1 the upper one."""
        unit = np.clip(np.asarray(action, float), -1.0, 1.0)
        return self.low + (unit + 1.0) / 2 * (self.high - self.low)

    def action(self, feedback: ArrayLike) -> Array:
        """Return the actions (N, 2 L) in [-1, 1] that give this feedback (N, 2 L) [rad]; 0 where bounds are equal."""
        width = self.high - self.low
        free = width > 0
        unit = 2 * (np.asarray(feedback, float) - self.low) / np.where(free, width, 1.0) - 1.0
        return np.where(free, np.clip(unit, -1.0, 1.0), 0.0)

    def motor_targets(self, time: ArrayLike, feedback: Array) -> Array:
        """Return the motor angles (N, M) [rad] for feedback (N, 2 L) [rad] at times (N,) [s]."""
        swing, extension = self.reference.pose(time)
        legs = swing.shape[-1]
        return self.robot.leg_to_motor_angles(swing + feedback[:, :legs], extension + feedback[:, legs:])
