"""Physical parameters of one robot in a TOML file, with further tables.

    [params]
    motor_strength = [0.94, 0.97, 0.91, 1.0, 0.99, 0.93, 0.96, 0.98]
    voltage = 15.4

Parameters that the file does not name are the robot's own. Other tables, with tables in them, are kept as they are.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.configuration import is_number, read_toml
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors, quote, suggest
from surefoot.files import atomic_write
from surefoot.robot.description import RobotDescription
from surefoot.robot.params import PARAMETERS, PhysicalParams, parse_settings

ParamValue = float | tuple[float, ...]
"""A parameter of one robot: one number, or one for each motor or axis."""


@dataclass(frozen=True)
class ParamsFile:
    """What a file of physical parameters has."""

    params: PhysicalParams
    """All parameters, one row; those that the file does not name are nominal."""
    names: tuple[str, ...]
    """The parameters that the file names."""
    tables: dict[str, Any] = field(default_factory=dict)
    """Everything else in the file, by name."""
    source: dict[str, str] = field(default_factory=dict)
    """The file's name and the SHA-256 of what was read, as `file` and `sha256`."""

    @property
    def values(self) -> dict[str, ParamValue]:
        """The parameters that the file names, as a task holds them."""
        return param_values(self.params, self.names)


def param_values(params: PhysicalParams, names: Iterable[str] | None = None) -> dict[str, ParamValue]:
    """Return the parameters of one robot by name: one number each, or one per motor or axis where these differ.

    Args:
        params: one row.
        names: parameters to give; all, if left out.
    """
    values: dict[str, ParamValue] = {}
    for name in PhysicalParams.names() if names is None else names:
        numbers = getattr(params, name)[0].ravel().tolist()
        values[name] = numbers[0] if len(set(numbers)) == 1 else tuple(numbers)
    return values


def find_params(path_or_name: str | Path, robot: RobotDescription) -> Path:
    """Return the path of a file of parameters, given by path, or by the name of one that ships with the robot.

    Raises:
        SurefootError: neither a file nor such a name.
    """
    path, own = Path(path_or_name), robot.folder / f"{path_or_name}.toml"
    if path.suffix or path.exists():
        return path
    names = sorted(item.stem for item in robot.folder.glob("*.toml") if item.name != "robot.toml")
    if path.name not in names:
        own_names = suggest(path_or_name, names) if names else f"{robot.name} ships with none"
        raise SurefootError(f"params is '{path_or_name}'; it must be a file (.toml), or a name; {own_names}")
    return own


def load_params(
    robot: RobotDescription,
    path_or_name: str | Path | None,
    settings: Iterable[Iterable[str]],
    start: Mapping[str, ParamValue] | None = None,
) -> PhysicalParams:
    """Return the parameters of one robot, one row.

    Args:
        robot: the robot's description.
        path_or_name: as of `find_params`; None: nominal parameters.
        settings: words NAME=VALUE that change some of them, a group for each `--set`.
        start: parameters that differ from the nominal ones, unless the file names them.
    """
    params = PhysicalParams.nominal(robot).with_values(robot, **(start or {}))
    if path_or_name is not None:
        params = params.with_values(robot, **read_params(find_params(path_or_name, robot), robot).values)
    return params.with_values(robot, **parse_settings([word for group in settings for word in group]))


def read_params(path: Path, robot: RobotDescription) -> ParamsFile:
    """Read the physical parameters of a robot.

    Raises:
        SurefootError: no such file, no TOML, no table [params], another robot's, or a parameter or value that the
            robot does not have.
    """
    data, content = read_toml(path)
    table = data.pop("params", None)
    with prefix_errors(path):
        if not isinstance(table, dict):
            raise SurefootError("has no table [params]; it holds NAME = number or list")
        if data.get("robot", robot.name) != robot.name:
            raise SurefootError(f"has parameters of robot '{data['robot']}', not of '{robot.name}'")
        params = PhysicalParams.nominal(robot).with_values(robot, **param_table(table, "params"))
    source = {"file": path.name, "sha256": hashlib.sha256(content).hexdigest()}
    return ParamsFile(params, tuple(table), data, source)


def param_table(table: Mapping[str, Any], label: str) -> dict[str, ParamValue]:
    """Return the parameters in a table from a file.

    Raises:
        SurefootError: a value that is neither a finite number nor a list of such.
    """
    for name, value in table.items():
        numbers = value if isinstance(value, list) else [value]
        if not numbers or not all(map(is_number, numbers)):
            raise SurefootError(f"{label}.{name} is {quote(value)}; it must be a finite number or a list of such")
    return dict(table)


def write_params(
    path: Path,
    robot: RobotDescription,
    params: PhysicalParams,
    tables: Mapping[str, Any] | None = None,
    names: tuple[str, ...] | None = None,
) -> Path:
    """Write the physical parameters of one robot, at full precision, whole or not at all.

    Args:
        path: the file.
        robot: whose they are; its name is written too.
        params: one row.
        tables: what else the file is to hold, such as `ParamsFile.tables`: tables of numbers, texts, dates, lists of
            them and further tables. The name of the robot is written in any case.
        names: parameters to write; all, if not given.

    Raises:
        SurefootError: a folder that does not exist, or a value that TOML cannot hold.
    """
    others = _plain({key: value for key, value in (tables or {}).items() if key != "robot"})
    first = {key: value for key, value in others.items() if not isinstance(value, dict)}
    lines = [_dump({"robot": robot.name, **first}), "[params]"]
    for name in PhysicalParams.names(robot) if names is None else names:
        numbers = np.asarray(getattr(params, name)[0]).tolist()
        lines.append(f"{name} = {numbers}  # {PARAMETERS[name].unit}")
    lines += ["", _dump({key: value for key, value in others.items() if key not in first})]
    with describe_os_errors(path, "written"):
        atomic_write(path, "\n".join(lines).rstrip() + "\n")
    return path


def _plain(value: Any) -> Any:
    """Return tables, lists and numbers of NumPy as Python's own."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _dump(table: Mapping[str, Any]) -> str:
    """Return a table as TOML, each list in one line."""
    import tomli_w

    try:
        text = tomli_w.dumps(table)
    except TypeError as error:
        raise SurefootError(f"a file of parameters can't hold it: {error}") from error
    # No text in it has an end of a line, so these are the lists', which `tomli_w` writes a value a line.
    return re.sub(r"\[\n +", "[", re.sub(r",\n +(?=[^ \]])", ", ", re.sub(r",\n *\]", "]", text)))
