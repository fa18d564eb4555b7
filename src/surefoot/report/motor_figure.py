"""The figure of one motor that follows a sine: models of the motor over what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import ArrayLike

STYLES = {"dc": ("tab:red", "servo and DC motor"), "constraint": ("tab:green", "constraint motor")}


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
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(8, 5.8), sharex=True, height_ratios=(2.2, 1), layout="constrained"
    )
    above.step(time, target, where="post", color="0.75", label="target")
    if known.any():
        above.plot(time, reference, color="tab:blue", linewidth=2.4, label="measured")
    for name, angle in simulated.items():
        color, label = STYLES[name]
        above.plot(time, angle, color=color, linewidth=1.2, label=f"{label}, {1000 * errors[name]:.1f} mrad RMS")
        below.plot(time, 1000 * (np.asarray(angle) - reference), color=color, linewidth=1.2)
    above.set_ylabel("motor angle [rad]")
    above.set_title(title)
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize=8, frameon=False)
    below.axhline(0, color="0.6", linewidth=0.8)
    below.set_ylabel(f"less {told} [mrad]")
    below.set_xlabel("time [s]")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path
