"""What was identified, laid over the file of what is known of a robot.

    [params]                    values, for `surefoot train --params` and all other commands
    [sensors]                   what later fits need to know of the sensors
    [intervals]                 NAME = [low, high] of 95 %, or a list of such pairs, one a motor or axis
    [identified_by]                   NAME = "EXPERIMENT" that told it last
    [identified.EXPERIMENT]     date and SHA-256 of the data, their file, version of surefoot

A pair of infinities stands for a motor or axis of which nothing was told. Whatever else the file has stays.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surefoot import __version__
from surefoot.errors import SurefootError
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params, write_params

NOTHING = (-math.inf, math.inf)
"""Interval of a number of which nothing is told."""
_OURS = ("sensors", "intervals", "identified_by", "identified")


@dataclass(frozen=True)
class Known:
    """What a file of parameters tells of a robot, or the robot's description, if there is no file."""

    params: PhysicalParams
    """All parameters, one row: the file's, and the nominal ones."""
    given: tuple[str, ...] = ()
    """Names of those that the file has."""
    tables: dict[str, Any] = field(default_factory=dict)
    """Everything else in the file, by name."""

    @property
    def sensors(self) -> dict[str, Any]:
        """What earlier experiments found of the sensors."""
        return dict(self.tables.get("sensors", {}))

    def lacks(self, experiments: Iterable[str]) -> tuple[str, ...]:
        """Those of the experiments whose results the file does not have."""
        done = self.tables.get("identified", {})
        return tuple(name for name in experiments if name not in done)


def read_known(path: Path | None, robot: RobotDescription) -> Known:
    """What a file of parameters tells of a robot; without a file its description alone is known.

    Raises:
        SurefootError: a file that can't be read, is another robot's, or has other things under the names of the tables
            that are written here.
    """
    if path is None or not path.exists():
        return Known(PhysicalParams.nominal(robot))
    found = read_params(path, robot)
    for name in _OURS:
        if not isinstance(found.tables.get(name, {}), dict):
            raise SurefootError(f"parameters {path}: {name} is {found.tables[name]!r}; it must be a table")
    for name, table in found.tables.get("identified", {}).items():
        if not isinstance(table, dict):
            raise SurefootError(f"parameters {path}: identified.{name} is {table!r}; it must be a table")
    return Known(found.params, found.names, found.tables)


def overlay(known: Known, found: Identification, robot: RobotDescription, source: str = "") -> Known:
    """What is known together with what was found in the file `source`; what was found counts."""
    tables = deepcopy(known.tables)
    if found.sensors:
        tables["sensors"] = {**tables.get("sensors", {}), **found.sensors}
    told = dict.fromkeys(item.name for item in found.estimates if item.identifiable)
    intervals, identified_by = tables.setdefault("intervals", {}), tables.setdefault("identified_by", {})
    for name in told:
        intervals[name] = _interval(found, name, intervals.get(name), robot)
        identified_by[name] = found.experiment
    data = {"date": found.date, "data": found.digest, "file": source, "surefoot": __version__}
    tables.setdefault("identified", {})[found.experiment] = {key: value for key, value in data.items() if value}
    names = {*known.given, *found.identified_names()}
    given = tuple(name for name in PhysicalParams.names() if name in names)
    return Known(found.params(robot, known.params), given, tables)


def write_known(path: Path, robot: RobotDescription, known: Known) -> Path:
    """Write what is known to a file of parameters, whole or not at all, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_params(path, robot, known.params, known.tables, known.given)


def _interval(found: Identification, name: str, before: Any, robot: RobotDescription) -> list[Any]:
    """The interval of a number, or one for each motor or axis: what is not identifiable now stays as it was."""
    items = [item for item in found.estimates if item.name == name and item.identifiable]
    if items[0].index is None:
        return list(items[0].interval)
    count = max(item.index or 0 for item in found.estimates if item.name == name) + 1
    if name in PhysicalParams.names():
        count = max(count, int(np.prod(getattr(PhysicalParams.nominal(robot), name).shape[1:])))
    try:
        array = np.broadcast_to(np.asarray(NOTHING if before is None else before, float), (count, 2))
    except (TypeError, ValueError):  # a file may hold anything
        array = np.broadcast_to(np.array(NOTHING), (count, 2))
    pairs: list[Any] = array.tolist()
    for item in items:
        pairs[item.index or 0] = list(item.interval)
    return pairs
