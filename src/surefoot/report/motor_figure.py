"""The figure of one motor that follows a sine: models of the motor over what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from surefoot.report.style import BLUE, GREEN, ORANGE, QUIET, heading, new_figure

STYLES = {"dc": (ORANGE, "servo and DC motor"), "constraint": (GREEN, "constraint motor")}
"""Colour and name of each actuator."""


def motor_figure(
    path: Path,
    time: ArrayLike,
    target: ArrayLike,
    measured: ArrayLike,
    simulated: Mapping[str, ArrayLike],
    errors: Mapping[str, float],
    title: str,
) -> Path:
    """Draw target, measured angle and each model's angle over time, and the models' errors below.

    Args:
        path: PNG file to write.
        time: (T,) s.
        target: (T,) rad.
        measured: (T,) rad, NaN where nothing was measured; all NaN, if nothing was: errors are then to the target.
        simulated: by actuator, (T,) rad.
        errors: by actuator, root mean square error [rad].
        title: what was done.
    """
    reference, known = np.asarray(measured, float), np.isfinite(np.asarray(measured, float))
    told = "measured" if known.any() else "target"
    reference = reference if known.any() else np.asarray(target, float)
    with new_figure(path, (8.0, 5.8), rows=2, sharex=True, height_ratios=(2.2, 1)) as (figure, (above, below)):
        above.step(time, target, where="post", color=QUIET, alpha=0.6, label="target")
        if known.any():
            above.plot(time, reference, color=BLUE, linewidth=2.4, label="measured")
        for name, angle in simulated.items():
            color, label = STYLES[name]
            above.plot(time, angle, color=color, label=f"{label}, {1000 * errors[name]:.1f} mrad RMS")
            below.plot(time, 1000 * (np.asarray(angle) - reference), color=color)
        above.set_title("Motor angle (rad)")
        below.axhline(0, color=QUIET, linewidth=0.8)
        below.set_title(f"Less {told} (mrad)")
        below.set_xlabel("time (s)")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        heading(figure, title)
    return path
