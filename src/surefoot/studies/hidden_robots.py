"""Hidden robots of a study, which are identified: random physical parameters by seed, some with other motors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from surefoot.configuration import Seed, Within, read_toml, read_yaml, to_mapping, write_yaml
from surefoot.errors import SurefootError, choices, suggest
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.archive import DATA_SHEET, copy_robot
from surefoot.robot.params import CONTROLLER_PARAMETERS, PARAMETER_GROUPS, PARAMETERS
from surefoot.robot.params_file import ParamsFile, ParamValue, read_params
from surefoot.robot.randomization import Ranges, check_ranges, draw_hidden

DATA_SHEET_MOTORS, OTHER_MOTORS = "own", "other"
"""Motor families: the data sheet's, which the training simulators model, and another one."""
_SETTINGS = "hidden.yaml"
"""File with the settings of the robots that are identified in a folder."""


@dataclass(frozen=True)
class OtherMotors:
    """Motors that the training simulators do not model."""

    seeds: tuple[Seed, ...]
    """Seeds of the robots that have these motors."""
    actuator: dict[str, Any]
    """Keys that replace those in the data sheet's `[actuator]`, such as the torque-current curve."""
    label: str = "motors of another family"
    """Label in figures and tables."""

    def __post_init__(self) -> None:
        """Reject keys without a value."""
        if empty := [name for name, value in self.actuator.items() if value is None]:
            raise SurefootError(f"robots.other_motors.actuator.{empty[0]} has no value; give one, or leave it out")


@dataclass(frozen=True)
class HiddenRobots:
    """Simulated robots that represent reality in a study; their parameters are hidden and must be identified."""

    seeds: tuple[Seed, ...]
    """One robot per seed."""
    ranges: Ranges
    """Ranges from which each robot's parameters are drawn once; in a study file also the name of a table of ranges."""
    world: str = "bullet"
    """Engine that simulates the robots."""
    starts: Annotated[int, Within(1, 1000)] = 10
    """Number of a policy's runs on each robot, and in the training simulator."""
    other_motors: OtherMotors | None = None
    robot: str = ""
    """Name or folder of the robot description on which the identification is based; defaults to the study's robot."""

    def __post_init__(self) -> None:
        """Check the seeds and ranges.

        Raises:
            SurefootError: seeds repeat, other motors name a seed that is no robot, or no robot can have the ranges.
        """
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise SurefootError(f"robots.seeds is {list(self.seeds)}; it needs 1 or more, all different")
        for seed in () if self.other_motors is None else self.other_motors.seeds:
            if seed not in self.seeds:
                raise SurefootError(
                    f"robots.other_motors.seeds: {seed} is not a robot's seed; {suggest(seed, self.seeds)}"
                )
        check_ranges(self.ranges)

    def family(self, seed: int) -> str:
        """Return the family of a robot's motors, `DATA_SHEET_MOTORS` or `OTHER_MOTORS`."""
        return OTHER_MOTORS if self.other_motors is not None and seed in self.other_motors.seeds else DATA_SHEET_MOTORS

    def params(self, seed: int, folder: Path) -> PhysicalParams:
        """Return a robot's true physical parameters, one row; `folder` as in `description`."""
        return draw_hidden(RobotDescription.load(self.description(seed, folder)), self.ranges, seed)

    def description(self, seed: int, folder: Path) -> str:
        """Return the true robot description: the study's, or a copy with other motors, which is written into `folder`.

        Raises:
            SurefootError: the other motors are invalid in a data sheet.
        """
        if self.other_motors is None or self.family(seed) == DATA_SHEET_MOTORS:
            return self.robot
        import tomli_w

        source = RobotDescription.load(self.robot).folder
        data, _ = read_toml(source / DATA_SHEET)
        text = tomli_w.dumps({**data, "actuator": {**data["actuator"], **self.other_motors.actuator}})
        copy_robot(source, folder, text)
        RobotDescription.load(folder)  # raises if the motors are invalid
        return str(folder.absolute())

    def settings(self) -> dict[str, Any]:
        """Return everything on which the robots' physics depend, for JSON."""
        data: dict[str, Any] = json.loads(json.dumps(to_mapping(self)))
        if data["other_motors"]:
            del data["other_motors"]["label"]
        return {name: data[name] for name in ("ranges", "world", "other_motors", "robot")}

    def check_settings(self, folder: Path) -> None:
        """Check that the robots identified in a folder are these robots.

        Raises:
            SurefootError: their physics depend on other settings, or the file with these settings can't be read.
        """
        if not any(folder.glob("robot_*.toml")):
            return
        path = folder / _SETTINGS
        stored, own = read_yaml(path), self.settings()
        if different := [f"robots.{name}" for name in own if stored.get(name) != own[name]]:
            raise SurefootError(
                f"{path}: the robots in this folder were identified with other {', '.join(different)} than the study "
                "has; restore them, or move the folder away to identify the study's robots"
            )

    def write_settings(self, folder: Path) -> None:
        """Write the settings on which the robots' physics depend into the folder of their files."""
        folder.mkdir(parents=True, exist_ok=True)
        write_yaml(folder / _SETTINGS, self.settings())


def check_identified(names: tuple[str, ...], where: str) -> None:
    """Check that names are physical parameters, or groups of them, that a training can take from a file.

    Raises:
        SurefootError: a name is unknown, or the policy's contract sets the parameter.
    """
    for name in names:
        if name in CONTROLLER_PARAMETERS:
            raise SurefootError(
                f"{where}: {name} belongs to the controller, whose contract states it; it is not taken from a file"
            )
        if name not in PARAMETER_GROUPS and name not in PARAMETERS:
            raise SurefootError(
                f"{where}: '{name}' is neither a physical parameter nor a group of them ({choices(PARAMETER_GROUPS)}); "
                f"{suggest(name, [*PARAMETER_GROUPS, *PARAMETERS])}"
            )


def robot_name(seed: int) -> str:
    """Return the name of a hidden robot in folders and tables."""
    return f"robot_{seed}"


def other_motors_folder(work: Path) -> Path:
    """Return the folder for the robot description with other motors, within the folder of identifications."""
    return work / "other_motors"


def robot_file(folder: Path, seed: int) -> Path:
    """Return the file of a robot's identified parameters."""
    return folder / f"{robot_name(seed)}.toml"


def read_identified(folder: Path | None, seed: int, robot: str) -> ParamsFile | None:
    """Return a robot's identified parameters, or None if it is not identified yet."""
    if folder is None or not (path := robot_file(folder, seed)).is_file():
        return None
    return read_params(path, RobotDescription.load(robot))


def select_identified(file: ParamsFile, names: tuple[str, ...]) -> dict[str, ParamValue]:
    """Return the identified values that a group uses, by parameter; the controller's parameters are left out."""
    return {
        name: value
        for name, value in file.values.items()
        if name not in CONTROLLER_PARAMETERS and (name in names or PARAMETERS[name].group in names)
    }
