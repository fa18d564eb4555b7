"""File of a robot's identified parameters (robot.toml), into which each identification merges its estimates.

    [params]                    values, for `surefoot train --params` and all other commands
    [sensors]                   sensor properties that later fits need
    [intervals]                 NAME = [low, high], the 95 % interval, or a list with one such pair per motor or axis
    [identified_by]             NAME = "EXPERIMENT", the last experiment that identified it
    [identified.EXPERIMENT]     date, SHA-256 and file of the data, version of surefoot; for logs, the SHA-256 of each
    [gains]                     gains of the logs, for a robot that receives its gains with every command. Replays of
                                logs that do not state their gains use them; a policy uses its own gains.

A pair of infinities marks a motor or axis that was not identified. All other entries of the file are kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from surefoot import __version__
from surefoot.configuration import is_number
from surefoot.errors import SurefootError
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS
from surefoot.robot.params_file import ParamsFile, ParamValue, param_table, read_params, write_params

_UNBOUNDED = (-math.inf, math.inf)
GAINS_TABLE = "gains"
_TABLES = ("sensors", "intervals", "identified_by", "identified", GAINS_TABLE)


def read_prior(path: Path | None, robot: RobotDescription) -> ParamsFile:
    """Return the parameters before an identification: from the file if it exists, otherwise the nominal parameters.

    Raises:
        SurefootError: the file can't be read or belongs to another robot, an entry that must be a table is not one, or
            the properties of the sensors are no numbers.
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
    sensors = tables.get("sensors", {})
    for name, count in (("torque_gain", robot.num_motors), ("torque_accuracy", None)):
        if name in sensors and not _are_fractions(sensors[name], count):
            what = "a number" if count is None else f"{count} numbers"
            raise SurefootError(
                f"parameters {path}: sensors.{name} is {sensors[name]!r}; it must be {what} within ±0.9"
            )
    return prior


def _are_fractions(value: Any, count: int | None) -> bool:
    """Return whether a value is a list of `count` numbers within ±0.9, or such a number if `count` is None."""
    values = [value] if count is None else value
    if not isinstance(values, list) or len(values) != (count or 1):
        return False
    return all(is_number(one) and abs(one) <= 0.9 for one in values)


def missing_experiments(prior: ParamsFile, experiments: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the experiments that have no result in the file."""
    return tuple(name for name in experiments if name not in prior.tables.get("identified", {}))


def merge_estimates(prior: ParamsFile, result: Identification, robot: RobotDescription, source: str = "") -> ParamsFile:
    """Return the prior parameters updated with the estimates of an identification; `source` names the data file."""
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
    logs = _fitted_logs(prior, result.experiment) | {digest: name for name, digest in result.log_digests.items()}
    data["logs"] = logs
    tables.setdefault("identified", {})[result.experiment] = {key: value for key, value in data.items() if value}
    names = {*prior.names, *result.identified_names()}
    written = tuple(name for name in PhysicalParams.names() if name in names)
    return ParamsFile(result.params(robot, prior.params), written, tables)


def _fitted_logs(prior: ParamsFile, experiment: str) -> dict[str, str]:
    """Return the names of the logs that the parameters were already fitted to or checked with, by their SHA-256."""
    table = prior.tables.get("identified", {}).get(experiment, {})
    logs = table.get("logs", {}) if isinstance(table, dict) else {}
    return dict(logs) if isinstance(logs, dict) else {}


def check_new_logs(path: Path | None, prior: ParamsFile, digests: Mapping[str, str], total: str = "") -> None:
    """Reject logs that the parameters were already fitted to: a second fit would count the same data twice.

    Args:
        path: file of the parameters.
        prior: contents of the file.
        digests: SHA-256 of each log, by name.
        total: SHA-256 of all logs together, which older files have instead.

    Raises:
        SurefootError: the file was fitted to one of the logs.
    """
    table = prior.tables.get("identified", {}).get("logs", {})
    fitted = _fitted_logs(prior, "logs")
    if total and isinstance(table, dict) and table.get("data") == total:
        fitted = {digest: name for name, digest in digests.items()}
    if repeated := [name for name, digest in digests.items() if digest in fitted]:
        raise SurefootError(
            f"{path} was already fitted to {repeated[0]}; logs that count twice give intervals that are too narrow: "
            "give another file"
        )


def read_gains(prior: ParamsFile) -> dict[str, ParamValue]:
    """Return the servo gains of the logs that the parameters were fitted to; empty if the file has none."""
    table = prior.tables.get(GAINS_TABLE, {})
    if not isinstance(table, dict):
        return {}
    return param_table({name: table[name] for name in GAINS if name in table}, GAINS_TABLE)


def write_robot_params(path: Path, robot: RobotDescription, params: ParamsFile) -> Path:
    """Write a file of parameters atomically; create its folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_params(path, robot, params.params, params.tables, params.names)


def _interval(result: Identification, name: str, before: Any, robot: RobotDescription) -> list[Any]:
    """Return the interval of a parameter, or one per motor or axis; unidentifiable ones keep the interval `before`."""
    items = [item for item in result.estimates if item.name == name]
    identified = [item for item in items if item.identifiable]
    if identified[0].index is None:
        return list(identified[0].interval)
    count = max(item.index or 0 for item in items) + 1
    if name in PhysicalParams.names():
        count = max(count, int(np.prod(getattr(PhysicalParams.nominal(robot), name).shape[1:])))
    try:
        array = np.broadcast_to(np.asarray(_UNBOUNDED if before is None else before, float), (count, 2))
    except (TypeError, ValueError):  # the file may hold anything
        array = np.broadcast_to(np.array(_UNBOUNDED), (count, 2))
    pairs: list[Any] = array.tolist()
    for item in identified:
        pairs[item.index or 0] = list(item.interval)
    return pairs
