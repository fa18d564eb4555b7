"""Robots that a study hides and identifies: physical parameters by seed, and motors of another family for some."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from surefoot.configuration import Seed, Within, read_toml, to_mapping
from surefoot.errors import SurefootError, choices, suggest
from surefoot.files import atomic_write
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.archive import SHEET, copy_robot
from surefoot.robot.params import CONTROLLER, GROUPS, PARAMETERS
from surefoot.robot.params_file import ParamsFile, ParamValue, read_params
from surefoot.robot.randomization import Ranges, check_ranges, draw_hidden

DATA_SHEET_MOTORS, OTHER_MOTORS = "own", "other"
"""Motor families: the one of the data sheet, on which simulators that train are built, and another one."""


@dataclass(frozen=True)
class OtherMotors:
    """Motors that no simulator models in which policies train."""

    seeds: tuple[Seed, ...]
    """The robots that have them."""
    actuator: dict[str, Any]
    """Keys of the data sheet's `[actuator]` in place of its own, such as the curve of torque over current."""
    label: str = "motors of another family"
    """What figures and tables call them."""


@dataclass(frozen=True)
class HiddenRobots:
    """Robots that stand for reality in a study: nobody knows their parameters until they are identified."""

    seeds: tuple[Seed, ...]
    """A robot for each."""
    ranges: Ranges
    """Ranges that a robot's parameters are drawn from once; in a file also the name of a table."""
    world: str = "bullet"
    """Engine that simulates them."""
    starts: Annotated[int, Within(1, 1000)] = 10
    """Runs of a policy on each of its robots, and as many in the policy's own simulator."""
    other_motors: OtherMotors | None = None
    robot: str = ""
    """Name or folder of the robots' description, by which they are identified; defaults to the study's."""

    def __post_init__(self) -> None:
        """Refuse seeds that do not fit together, and ranges that no robot can have."""
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise SurefootError(f"robots.seeds is {list(self.seeds)}; it takes 1 or more, none twice")
        for seed in () if self.other_motors is None else self.other_motors.seeds:
            if seed not in self.seeds:
                raise SurefootError(f"robots.other_motors.seeds: {seed} is no robot; {suggest(seed, self.seeds)}")
        check_ranges(self.ranges)

    def family(self, seed: int) -> str:
        """Return the family of a robot's motors, `DATA_SHEET_MOTORS` or `OTHER_MOTORS`."""
        return OTHER_MOTORS if self.other_motors is not None and seed in self.other_motors.seeds else DATA_SHEET_MOTORS

    def params(self, seed: int, folder: Path) -> PhysicalParams:
        """Return a robot's true physical parameters, one row; `folder` is that of `description`."""
        return draw_hidden(RobotDescription.load(self.description(seed, folder)), self.ranges, seed)

    def description(self, seed: int, folder: Path) -> str:
        """Return the true description of a robot: the study's, or the one with other motors, written into a folder.

        Raises:
            SurefootError: motors that no sheet may state.
        """
        if self.other_motors is None or self.family(seed) == DATA_SHEET_MOTORS:
            return self.robot
        import tomli_w

        source = RobotDescription.load(self.robot).folder
        data, _ = read_toml(source / SHEET)
        text = tomli_w.dumps({**data, "actuator": {**data["actuator"], **self.other_motors.actuator}})
        if not (folder / SHEET).is_file() or (folder / SHEET).read_text(encoding="utf-8") != text:
            copy_robot(source, folder)
            atomic_write(folder / SHEET, text)
        RobotDescription.load(folder)  # refuses motors that do not fit
        return str(folder.absolute())

    def settings(self) -> dict[str, Any]:
        """Return everything that the robots' physics depends on, as JSON holds it."""
        data = to_mapping(self)
        return {name: data[name] for name in ("ranges", "world", "other_motors", "robot")}


def check_identified(names: tuple[str, ...], where: str) -> None:
    """Refuse names that are neither physical parameters nor groups of them, and those that a policy sets.

    Raises:
        SurefootError: with the name and the choices.
    """
    for name in names:
        if name in CONTROLLER:
            raise SurefootError(
                f"{where}: {name} belongs to the controller, whose contract states it; it is not taken from a file"
            )
        if name not in GROUPS and name not in PARAMETERS:
            raise SurefootError(
                f"{where}: '{name}' is neither a physical parameter nor a group of them ({choices(GROUPS)}); "
                f"{suggest(name, [*GROUPS, *PARAMETERS])}"
            )


def robot_name(seed: int) -> str:
    """Return the name of a hidden robot, as folders and tables have it."""
    return f"robot_{seed}"


def other_motors_folder(work: Path) -> Path:
    """Return the folder with the description of robots with other motors in that of a study's identifications."""
    return work / "other_motors"


def robot_file(folder: Path, seed: int) -> Path:
    """Return the file of a robot's identified parameters."""
    return folder / f"{robot_name(seed)}.toml"


def read_identified(folder: Path | None, seed: int, robot: str) -> ParamsFile | None:
    """Return a robot's identified parameters; None before it is identified."""
    if folder is None or not (path := robot_file(folder, seed)).is_file():
        return None
    return read_params(path, RobotDescription.load(robot))


def select_identified(file: ParamsFile, names: tuple[str, ...]) -> dict[str, ParamValue]:
    """Return the values of a file that a group takes, by parameter; never the controller's."""
    return {
        name: value
        for name, value in file.values.items()
        if name not in CONTROLLER and (name in names or PARAMETERS[name].group in names)
    }
