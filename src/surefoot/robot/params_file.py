"""Parameter files: physical parameters of one robot in TOML, with further tables.

    [params]
    motor_strength = [0.94, 0.97, 0.91, 1.0, 0.99, 0.93, 0.96, 0.98]
    voltage = 15.4

Parameters that the file does not name are nominal. Other tables, also nested ones, are preserved.
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
"""Value of a parameter of one robot: one number, or one per motor or axis."""


@dataclass(frozen=True)
class ParamsFile:
    """Content of a parameter file."""

    params: PhysicalParams
    """All parameters, one row; parameters that the file does not name are nominal."""
    names: tuple[str, ...]
    """Names of the parameters in the file."""
    tables: dict[str, Any] = field(default_factory=dict)
    """All other entries of the file, by name."""
    source: dict[str, str] = field(default_factory=dict)
    """Provenance: the file's name and the SHA-256 of its content, as `file` and `sha256`."""

    @property
    def values(self) -> dict[str, ParamValue]:
        """Values of the parameters in the file, in the form that a task's `params` has."""
        return param_values(self.params, self.names)


def param_values(params: PhysicalParams, names: Iterable[str] | None = None) -> dict[str, ParamValue]:
    """Return the parameters of one robot by name: one number each, or one per motor or axis if they differ.

    Args:
        params: one row.
        names: parameters to return; defaults to all.
    """
    values: dict[str, ParamValue] = {}
    for name in PhysicalParams.names() if names is None else names:
        numbers = getattr(params, name)[0].ravel().tolist()
        values[name] = numbers[0] if len(set(numbers)) == 1 else tuple(numbers)
    return values


def find_params(path_or_name: str | Path, robot: RobotDescription) -> Path:
    """Return the path of a parameter file, given by path or by the name of one in the robot's folder.

    Raises:
        SurefootError: it is neither a file nor such a name.
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
    """Return the parameters of one robot as one row.

    Args:
        robot: the robot's description.
        path_or_name: the parameter file, see `find_params`; defaults to nominal parameters.
        settings: arguments NAME=VALUE that override parameters, one group per option `--set`.
        start: parameters that replace nominal values; the file and settings override them.
    """
    params = PhysicalParams.nominal(robot).with_values(robot, **(start or {}))
    if path_or_name is not None:
        params = params.with_values(robot, **read_params(find_params(path_or_name, robot), robot).values)
    return params.with_values(robot, **parse_settings([word for group in settings for word in group]))


def read_params(path: Path, robot: RobotDescription) -> ParamsFile:
    """Read a parameter file of a robot.

    Raises:
        SurefootError: there is no such file, it is not TOML, has no table [params], belongs to another robot, or has a
            parameter or value that the robot does not allow.
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
    """Validate a table of parameter values from a file and return it.

    Raises:
        SurefootError: a value is neither a finite number nor a list of finite numbers.
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
    """Write a parameter file atomically and at full precision.

    Args:
        path: the file.
        robot: the robot that the parameters belong to; its name is always written.
        params: one row.
        tables: further entries of the file, such as `ParamsFile.tables`: numbers, texts, dates, lists of them and
            nested tables.
        names: parameters to write; defaults to all.

    Raises:
        SurefootError: the folder does not exist, or TOML can't represent a value.
    """
    others = _to_python({key: value for key, value in (tables or {}).items() if key != "robot"})
    first = {key: value for key, value in others.items() if not isinstance(value, dict)}
    lines = [_dump({"robot": robot.name, **first}), "[params]"]
    for name in PhysicalParams.names(robot) if names is None else names:
        numbers = np.asarray(getattr(params, name)[0]).tolist()
        lines.append(f"{name} = {numbers}  # {PARAMETERS[name].unit_for(robot)}")
    lines += ["", _dump({key: value for key, value in others.items() if key not in first})]
    with describe_os_errors(path, "written"):
        atomic_write(path, "\n".join(lines).rstrip() + "\n")
    return path


def _to_python(value: Any) -> Any:
    """Convert tables, lists and NumPy scalars to plain Python types."""
    if isinstance(value, Mapping):
        return {key: _to_python(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_python(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def _dump(table: Mapping[str, Any]) -> str:
    """Return a table as TOML with each list on one line."""
    import tomli_w

    try:
        text = tomli_w.dumps(table)
    except TypeError as error:
        raise SurefootError(f"a parameter file can't hold it: {error}") from error
    # TOML escapes line ends in texts, so all line ends here belong to lists, which `tomli_w` writes one value per line.
    return re.sub(r"\[\n +", "[", re.sub(r",\n +(?=[^ \]])", ", ", re.sub(r",\n *\]", "]", text)))
