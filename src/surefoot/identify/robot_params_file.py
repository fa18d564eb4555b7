"""The result of an identification, merged into the file of a robot's parameters.

    [params]                    values, for `surefoot train --params` and all other commands
    [sensors]                   properties of sensors that later fits need
    [intervals]                 NAME = [low, high] of 95 %, or a list of such pairs, one a motor or axis
    [identified_by]             NAME = "EXPERIMENT" that identified it last
    [identified.EXPERIMENT]     date and SHA-256 of the data, their file, version of surefoot; of logs, that of each
    [gains]                     gains of the logs of a robot that gets its gains with every command: for replays of
                                logs that do not state theirs; a policy keeps its own

A pair of infinities stands for a motor or axis that was not identified. All else in the file stays.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from surefoot import __version__
from surefoot.errors import SurefootError
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import ParamsFile, ParamValue, param_table, read_params, write_params

_UNBOUNDED = (-math.inf, math.inf)
GAINS_TABLE = "gains"
_TABLES = ("sensors", "intervals", "identified_by", "identified", GAINS_TABLE)


def read_prior(path: Path | None, robot: RobotDescription) -> ParamsFile:
    """Return the parameters before an identification: those of a file, or the nominal ones if there is no file.

    Raises:
        SurefootError: a file that can't be read, is another robot's, or has something else under the names of the
            tables that are written here.
    """
    if path is None or not path.exists():
        return ParamsFile(PhysicalParams.nominal(robot), ())
    prior = read_params(path, robot)
    tables = {name: prior.tables[name] for name in _TABLES if name in prior.tables}
    if isinstance(identified := tables.get("identified"), dict):
        tables |= {f"identified.{name}": table for name, table in identified.items()}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise SurefootError(f"parameters {path}: {name} is {table!r}; it must be a table")
    return prior


def missing_experiments(prior: ParamsFile, experiments: Iterable[str]) -> tuple[str, ...]:
    """Return those of the experiments whose results a file does not have."""
    return tuple(name for name in experiments if name not in prior.tables.get("identified", {}))


def overlay(prior: ParamsFile, result: Identification, robot: RobotDescription, source: str = "") -> ParamsFile:
    """Return the prior with the result of an identification in its place; `source` is the file of the data."""
    tables = deepcopy(prior.tables)
    if result.sensors:
        tables["sensors"] = {**tables.get("sensors", {}), **result.sensors}
    intervals, identified_by = tables.setdefault("intervals", {}), tables.setdefault("identified_by", {})
    if result.gains:
        tables[GAINS_TABLE] = {**result.gains, "stated": list(result.stated_gains)}
    for name in dict.fromkeys(item.name for item in result.estimates if item.identifiable and item.of_robot):
        intervals[name] = _interval(result, name, intervals.get(name), robot)
        identified_by[name] = result.experiment
    data: dict[str, Any] = {"date": result.date, "data": result.digest, "file": source, "surefoot": __version__}
    seen = _fitted_logs(prior, result.experiment) | {digest: name for name, digest in result.parts.items()}
    data["logs"] = seen
    tables.setdefault("identified", {})[result.experiment] = {key: value for key, value in data.items() if value}
    names = {*prior.names, *result.identified_names()}
    written = tuple(name for name in PhysicalParams.names() if name in names)
    return ParamsFile(result.params(robot, prior.params), written, tables)


def _fitted_logs(prior: ParamsFile, experiment: str) -> dict[str, str]:
    """Return the names of the logs that a file was fitted to, or checked with, by their SHA-256."""
    before = prior.tables.get("identified", {}).get(experiment, {})
    logs = before.get("logs", {}) if isinstance(before, dict) else {}
    return dict(logs) if isinstance(logs, dict) else {}


def check_new_logs(path: Path | None, prior: ParamsFile, digests: Mapping[str, str], total: str = "") -> None:
    """Refuse logs that a file of parameters was fitted to already: a second fit would count them twice.

    Args:
        path: the file.
        prior: what it holds.
        digests: SHA-256 of each log, by name.
        total: SHA-256 of all of them, which older files have.
    """
    before = prior.tables.get("identified", {}).get("logs", {})
    seen = _fitted_logs(prior, "logs")
    if total and isinstance(before, dict) and before.get("data") == total:
        seen = {digest: name for name, digest in digests.items()}
    if again := [name for name, digest in digests.items() if digest in seen]:
        raise SurefootError(
            f"{path} was fitted to {again[0]} already; logs that count twice give too narrow intervals: give another "
            "file"
        )


def read_gains(prior: ParamsFile) -> dict[str, ParamValue]:
    """Return the gains of the logs that a file of parameters was fitted to; none, if it has none."""
    table = prior.tables.get(GAINS_TABLE, {})
    if not isinstance(table, dict):
        return {}
    return param_table({name: table[name] for name in ("servo_kp", "servo_kd") if name in table}, GAINS_TABLE)


def write_robot_params(path: Path, robot: RobotDescription, params: ParamsFile) -> Path:
    """Write a file of parameters, whole or not at all, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_params(path, robot, params.params, params.tables, params.names)


def _interval(result: Identification, name: str, before: Any, robot: RobotDescription) -> list[Any]:
    """Return the interval of a number, or one for each motor or axis: those that are not identifiable stay."""
    items = [item for item in result.estimates if item.name == name]
    identified = [item for item in items if item.identifiable]
    if identified[0].index is None:
        return list(identified[0].interval)
    count = max(item.index or 0 for item in items) + 1
    if name in PhysicalParams.names():
        count = max(count, int(np.prod(getattr(PhysicalParams.nominal(robot), name).shape[1:])))
    try:
        array = np.broadcast_to(np.asarray(_UNBOUNDED if before is None else before, float), (count, 2))
    except (TypeError, ValueError):  # a file may hold anything
        array = np.broadcast_to(np.array(_UNBOUNDED), (count, 2))
    pairs: list[Any] = array.tolist()
    for item in identified:
        pairs[item.index or 0] = list(item.interval)
    return pairs
