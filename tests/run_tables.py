"""Tables of runs and sensitivities with given values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.sensitivity import NOMINAL, Sensitivity, row_unit
from surefoot.robot import RobotDescription

MINITAUR = RobotDescription.load("minitaur")


def runs_table(world: str, *returns: float, falls: int = 0) -> pd.DataFrame:
    """Return runs with given returns, at 1 m/s and 10 W; the first `falls` runs fell."""
    values, fell = np.array(returns), np.arange(len(returns)) < falls
    columns = {"return": values, "distance": values + 1, "speed": 1.0, "power": 10.0, "steps": 100}
    return pd.DataFrame({"world": world, "run": range(len(values)), **columns, "fell": fell, "balanced": ~fell})


def policy_gap(name: str, home: Sequence[float], away: Mapping[str, Sequence[float]], falls: int = 0) -> PolicyGap:
    """Return a policy's runs with given returns in mujoco and in other worlds, where the first `falls` runs fell."""
    worlds = [runs_table(world, *returns, falls=falls) for world, returns in away.items()]
    return PolicyGap.from_runs(name, [runs_table("mujoco", *home), *worlds])


def sensitivity_table(
    policy: str,
    worlds: Sequence[tuple[Any, ...]],
    returns: ArrayLike,
    fell: ArrayLike,
    nominal: tuple[Mapping[str, float], ArrayLike, ArrayLike],
) -> Sensitivity:
    """Return a sensitivity at 0.5 m/s from returns (W, E) and falls (W, E) in test worlds.

    The nominal world is given by the values of parameters, returns (E,) and falls (E,).
    """
    values, nominal_returns, nominal_fell = nominal
    table = np.vstack([nominal_returns, returns])
    places = [(NOMINAL, "", np.nan), *((row, row_unit(row, MINITAUR), value) for row, value, *_ in worlds)]
    frame = pd.DataFrame([one for one in places for _ in range(table.shape[1])], columns=["row", "unit", "value"])
    columns = {"return": table.ravel(), "speed": 0.5, "fell": np.vstack([nominal_fell, fell]).ravel()}
    return Sensitivity(policy, values, frame.assign(run=np.tile(np.arange(table.shape[1]), len(table)), **columns))
