"""What sensitivity studies came to, as tables: one line a world, or one line an episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from surefoot.evaluate.sensitivity import Sensitivity, row_unit
from surefoot.files import write_table


def write_csv(path: str | Path, results: Sequence[Sensitivity]) -> Path:
    """Write one line for each test world and policy; returns the path.

    Columns: policy, row, unit, value, episodes, return_mean [m], return_standard_error [m] (empty for one episode),
    return_std [m] (of the population), speed_mean [m/s], falls.
    """
    header = "policy,row,unit,value,episodes,return_mean,return_standard_error,return_std,speed_mean,falls"
    lines = []
    for result in results:
        errors = result.standard_error
        for i, world in enumerate(result.worlds):
            numbers = (result.mean_return[i], errors[i], result.returns[i].std(), result.speed[i].mean())
            texts = ["" if math.isnan(number) else f"{number:.6f}" for number in numbers]
            falls = int(result.fell[i].sum())
            start = [result.policy, world.row, row_unit(world.row), f"{world.value:.9g}", result.episodes]
            lines.append([*start, *texts, falls])
    return write_table(path, header, lines)


def write_episodes_csv(path: str | Path, results: Sequence[Sensitivity]) -> Path:
    """Write one line for each episode; returns the path.

    Columns: policy, row (`nominal` for the nominal world), unit, value (empty for the nominal world), episode,
    return [m], speed [m/s], fell (0 or 1).
    """
    lines: list[list[object]] = []
    for result in results:
        nominal = result.nominal
        whole = [("nominal", "", "", nominal.returns, nominal.speed, nominal.fell)]
        whole += [
            (world.row, row_unit(world.row), f"{world.value:.9g}", *parts)
            for world, *parts in zip(result.worlds, result.returns, result.speed, result.fell, strict=True)
        ]
        for row, unit, value, *parts in whole:
            for episode, (gained, speed, fell) in enumerate(zip(*parts, strict=True)):
                lines.append([result.policy, row, unit, value, episode, f"{gained:.6f}", f"{speed:.6f}", int(fell)])
    return write_table(path, "policy,row,unit,value,episode,return,speed,fell", lines)
