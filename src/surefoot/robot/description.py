"""Description of a robot: its URDF and data sheet, loaded and validated.

A robot is a folder with a data sheet `robot.toml` and the URDF that the data sheet names. `RobotDescription.load`
takes the name of a built-in robot or the path of such a folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.configuration import from_mapping, read_toml
from surefoot.errors import SurefootError, check_name, choices, prefix_errors, quote, suggest
from surefoot.robot.actuator import ActuatorData, DcMotorData, nominal_params, read_actuator
from surefoot.robot.appearance import Appearance
from surefoot.robot.archive import DATA_SHEET, pack_robot, unpack_robot
from surefoot.robot.data_sheet import (
    GRAVITY,
    Battery,
    ContactData,
    DataSheet,
    Heat,
    Leg,
    Loop,
    Poses,
    Range,
    Timing,
    check_ranges,
)
from surefoot.robot.experiments import Experiments, read_experiments
from surefoot.robot.leg import FiveBar, Legs
from surefoot.robot.params import PARAMETERS
from surefoot.robot.serial_leg import SerialLegs
from surefoot.robot.urdf import Urdf
from surefoot.robot.urdf_file import read_urdf

_ROBOTS_FOLDER = Path(__file__).parent

DEFAULT_ROBOT = "minitaur"
"""Robot of a task that names none: the paper's."""
ANGLE_MARGIN = 1.0
"""Margin [rad] by which commands may exceed the motor angles of leg space. A damped robot on its belly folds its legs
further than a gait may, and standing up starts from these angles."""
_DEFAULT_VOLTAGE = 24.0
"""Default nominal battery voltage [V] of robots with joint actuators."""


@dataclass(frozen=True)
class RobotDescription:
    """A robot. Angles are motor angles theta in the data sheet's motor order unless stated otherwise."""

    name: str
    folder: Path
    urdf: Urdf
    base: str
    body_length: float
    motor_names: tuple[str, ...]
    motor_sign: Array
    legs: tuple[Leg, ...]
    leg_mounts: Array
    """Hip position (L, 3) of each leg in the base frame [m], x forward, y left, z up: midway between the motors of a
    five-bar leg, on the abduction axis of a serial leg."""
    leg_geometry: Legs
    loops: tuple[Loop, ...]
    leg_space: dict[str, Range]
    """Range of each leg-space coordinate that commands may use, in order."""
    rest: tuple[float, ...]
    """Resting pose of every leg in leg space, in which the robot settles before an episode."""
    actuator: ActuatorData
    timing: Timing
    contact: ContactData
    poses: Poses
    battery: Battery
    heat: Heat
    experiments: Experiments
    allowed: dict[str, tuple[float, float]]
    priors: dict[str, float]
    visuals: str | None = None
    """Name of the file with visual meshes in the robot's folder; None: the URDF's visuals are used."""

    @classmethod
    def available(cls) -> list[str]:
        """Return the names of the built-in robots."""
        return sorted(path.parent.name for path in _ROBOTS_FOLDER.glob("*/robot.toml"))

    @classmethod
    def find_folder(cls, robot: str | Path) -> Path:
        """Return the folder of a built-in robot, given by name; any other argument is returned as a path."""
        return _ROBOTS_FOLDER / str(robot) if str(robot) in cls.available() else Path(robot)

    @classmethod
    def resolve(cls, robot: str, folder: Path) -> str:
        """Return an argument for `load` from a file's reference to a robot; paths are relative to the file's folder."""
        return robot if robot in cls.available() else str((folder / robot).resolve())

    @classmethod
    def load(cls, robot: str | Path) -> RobotDescription:
        """Load a robot by name or by the path of its folder.

        Raises:
            SurefootError: there is no such robot, or its description is invalid; the message names file, key and rule.
        """
        folder = cls.find_folder(robot)
        sheet_path = folder / DATA_SHEET
        if not sheet_path.is_file():
            raise SurefootError(
                f"robot '{robot}': no such robot and no folder with a robot.toml; {suggest(robot, cls.available())}"
            )
        data, _ = read_toml(sheet_path)
        with prefix_errors(sheet_path):
            if "looks" in data:
                raise SurefootError("looks is named visuals now; rename this key")
            sheet = from_mapping(DataSheet, data)
            check_name("name", sheet.name)
            if Path(sheet.urdf).is_absolute() or ".." in Path(sheet.urdf).parts:
                raise SurefootError(f"urdf is {quote(sheet.urdf)}; it must be a file in the robot's folder")
        urdf = read_urdf(folder / sheet.urdf)
        with prefix_errors(sheet_path):
            return cls._from_sheet(sheet, urdf, folder)

    @classmethod
    def _from_sheet(cls, sheet: DataSheet, urdf: Urdf, folder: Path) -> RobotDescription:
        legs, order = sheet.read_legs(urdf), sheet.motors.order
        sign = np.array(sheet.motors.sign or [1] * len(order), float)
        bounds = {name: item.bounds for name, item in PARAMETERS.items()}
        if unknown := [name for name in sheet.allowed if name not in bounds]:
            raise SurefootError(f"allowed.{unknown[0]} is unknown; {suggest(unknown[0], bounds)}")
        check_ranges("allowed", sheet.allowed)
        if sheet.visuals is not None and (Path(sheet.visuals).name != sheet.visuals or sheet.visuals in ("", "..")):
            raise SurefootError(
                f"visuals is {quote(sheet.visuals)}; it must be the name of a file in the robot's folder"
            )
        positions, axes, feet = _joint_positions(urdf, sheet.base, legs)
        mounts = _mounts(positions, feet, bool(sheet.leg_geometry))
        signs = sign[[[order.index(name) for name in leg.motors] for leg in legs]]
        geometry = sheet.leg_geometry or SerialLegs.from_positions(legs, mounts, positions, axes, signs, feet)
        space, rest = sheet.complete_leg_space(geometry)
        actuator = read_actuator(sheet.actuator, order, [leg.motors for leg in legs])
        voltage = actuator.voltage if isinstance(actuator, DcMotorData) else _DEFAULT_VOLTAGE
        description = cls(
            name=sheet.name,
            folder=folder,
            urdf=urdf,
            base=sheet.base,
            body_length=sheet.body_length or float(np.ptp(mounts[:, 0])) or geometry.length,
            motor_names=order,
            motor_sign=sign,
            legs=legs,
            leg_mounts=mounts,
            leg_geometry=geometry,
            loops=sheet.loops,
            leg_space=space,
            rest=rest,
            actuator=actuator,
            timing=sheet.timing,
            contact=sheet.complete_contact(GRAVITY * urdf.total_mass / len(legs), geometry.length),
            poses=sheet.complete_poses(space),
            battery=sheet.complete_battery(voltage),
            heat=sheet.heat,
            experiments=read_experiments(sheet.experiments, space["extension"], actuator),
            allowed={**bounds, **sheet.allowed},
            priors=sheet.priors,
            visuals=sheet.visuals,
        )
        description._check_legs()
        return description

    def _check_legs(self) -> None:
        legs, extensions = self.leg_geometry, self.leg_space["extension"]
        if not legs.is_feasible(legs.to_motors(np.tile(np.transpose([self.rest]), len(self.legs)))).all():
            pose = ", ".join(f"{name} {value:g}" for name, value in zip(self.leg_space, self.rest, strict=True))
            raise SurefootError(
                f"leg_geometry: a leg can't reach its resting pose ({pose}); "
                "the lower links of a loop must reach each other, and a serial leg must be long enough"
            )
        poses = np.zeros((201, len(self.leg_space), len(self.legs)))
        poses[:, -1] = np.linspace(*extensions, 201)[:, None]
        if not legs.is_feasible(legs.to_motors(poses)).all():
            raise SurefootError(
                f"leg_space.extension is {list(extensions)}, "
                "but a leg can't reach every extension in it; narrow it or check leg_geometry"
            )
        for name, value in self.nominal_params().items():
            if PARAMETERS[name].belongs_to(self):
                self.check_allowed(name, np.asarray(value), source="nominal ")

    @property
    def is_builtin(self) -> bool:
        """Whether the robot is part of surefoot, so that its name suffices to load it anywhere."""
        return self.folder.resolve().parent == _ROBOTS_FOLDER.resolve()

    @property
    def location(self) -> str:
        """Argument for `load` to load the robot again on this computer: a built-in robot's name, else the folder."""
        return self.folder.name if self.is_builtin else str(self.folder)

    @cached_property
    def archive(self) -> bytes:
        """Archive of the robot's folder, to be embedded in files; empty for a built-in robot."""
        return b"" if self.is_builtin else pack_robot(self.folder)

    @property
    def num_motors(self) -> int:
        """Number of motors."""
        return len(self.motor_names)

    @property
    def leg_names(self) -> tuple[str, ...]:
        """Names of the legs, in order."""
        return tuple(leg.name for leg in self.legs)

    @cached_property
    def leg_motor_index(self) -> NDArray[np.int64]:
        """Index (legs, m) of each leg's motors in the motor order; read-only."""
        index = np.array([[self.motor_names.index(name) for name in leg.motors] for leg in self.legs])
        index.setflags(write=False)
        return index

    @property
    def weight(self) -> float:
        """Weight of the whole robot [N]."""
        return GRAVITY * self.urdf.total_mass

    @property
    def natural_time(self) -> float:
        """Natural time sqrt(l / g) of legs of length l [s]."""
        return float(np.sqrt(self.leg_geometry.length / GRAVITY))

    @property
    def torque_table(self) -> tuple[Array, Array]:
        """Torque-current curve of a DC motor: currents [A] and torques [N m]."""
        return np.array(self.dc_motor.torque_table_current), np.array(self.dc_motor.torque_table_torque)

    @property
    def dc_motor(self) -> DcMotorData:
        """Data of the DC motors.

        Raises:
            SurefootError: the robot has motors of another kind.
        """
        if not isinstance(self.actuator, DcMotorData):
            raise SurefootError(f"the motors of {self.name} are of kind {self.actuator.kind}; this needs DC motors")
        return self.actuator

    @property
    def five_bar(self) -> FiveBar:
        """Geometry of the five-bar legs.

        Raises:
            SurefootError: the robot has serial legs.
        """
        if not isinstance(self.leg_geometry, FiveBar):
            raise SurefootError(f"the legs of {self.name} are serial; this needs five-bar legs")
        return self.leg_geometry

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the leg-space coordinates: (abduction,) swing, extension."""
        return tuple(self.leg_space)

    @property
    def command_range(self) -> tuple[Array, Array]:
        """Minimum and maximum motor angles (M,) [rad] that a command may request, also while standing up."""
        minimum, maximum = self.angle_extent(*self.leg_space.values())
        return minimum - ANGLE_MARGIN, maximum + ANGLE_MARGIN

    @property
    def motor_limits(self) -> tuple[Array, Array]:
        """Minimum and maximum motor angles (M,) [rad] that both the joint limits and `command_range` allow."""
        turn = (-2 * np.pi, 2 * np.pi)
        limits = np.array([self.urdf.joints[name].limits or turn for name in self.motor_names])
        ends, (minimum, maximum) = np.sort(self.motor_sign[:, None] * limits, axis=1), self.command_range
        return np.maximum(ends[:, 0], minimum), np.minimum(ends[:, 1], maximum)

    def _split_legs(self, angles: Array) -> Array:
        """Rearrange the angles of all motors (..., M) by leg (..., L, m)."""
        return angles[..., self.leg_motor_index]

    def to_motors(self, pose: ArrayLike) -> Array:
        """Convert poses in leg space (..., C, L) to motor angles (..., M) [rad]."""
        theta, index = self.leg_geometry.to_motors(pose), self.leg_motor_index
        angles = np.empty((*theta.shape[:-2], self.num_motors))
        angles[..., index] = theta
        return angles

    def to_pose(self, angles: ArrayLike) -> Array:
        """Convert motor angles (..., M) [rad] to poses in leg space (..., C, L)."""
        return self.leg_geometry.to_pose(self._split_legs(np.asarray(angles, float)))

    def foot_positions(self, angles: Array) -> Array:
        """Return the foot positions in the base frame (..., L, 3) [m] at motor angles (..., M) [rad].

        NaN for five-bar legs whose loop can't close.
        """
        return np.asarray(self.leg_geometry.foot_position(self._split_legs(angles)) + self.leg_mounts)

    def pose_angles(self, *coordinates: ArrayLike) -> Array:
        """Return the motor angles (..., M) [rad] of a pose.

        Each leg-space coordinate is an argument: one value per leg (..., L), or one number for all legs.
        """
        if len(coordinates) != len(self.coordinates):
            rule = f"legs of {self.name} have {choices(self.coordinates)}"
            raise SurefootError(f"a pose has {len(coordinates)} numbers; {rule}")
        legs = len(self.legs)
        for name, values in zip(self.coordinates, coordinates, strict=True):
            if np.ndim(values) and np.shape(values)[-1] not in (1, legs):
                raise SurefootError(f"{name} of a pose has {np.shape(values)[-1]} numbers; {self.name} has {legs} legs")
        *values, _ = np.broadcast_arrays(*coordinates, np.zeros(legs))
        return self.to_motors(np.stack(values, axis=-2))

    def angle_extent(self, *ranges: Range) -> tuple[Array, Array]:
        """Return the minimum and maximum motor angles (M,) [rad] over all poses in the coordinates' ranges.

        Motor angles are monotonic in each coordinate except the extension, which is sampled.
        """
        *sides, (low, high) = ranges
        angles = [self.pose_angles(*pose) for pose in product(*sides, np.linspace(low, high, 17))]
        return np.min(angles, axis=0), np.max(angles, axis=0)

    @property
    def resting_angles(self) -> Array:
        """Motor angles (motors,) [rad] of the resting pose."""
        return self.pose_angles(*self.rest)

    def joint_angles(self, angles: ArrayLike) -> dict[str, Array]:
        """Return the URDF joint angles (...) [rad] of motor and knee joints by name, for motor angles (..., M) [rad].

        NaN at the knees of a leg whose loop can't close.
        """
        theta = np.asarray(angles, float)
        joints = {name: self.motor_sign[k] * theta[..., k] for k, name in enumerate(self.motor_names)}
        knees = self.leg_geometry.knee_angles(self._split_legs(theta))
        for number, leg in enumerate(self.legs):
            joints |= {name: knees[..., number, k] for k, name in enumerate(leg.knees)}
        return joints

    def link_frames(self, angles: ArrayLike) -> dict[str, Array]:
        """Return the poses (..., 4, 4) of all links in the base frame by name, for motor angles (..., M) [rad].

        Loops of five-bar legs are closed.

        NaN below the knees of a leg whose loop can't close.
        """
        frames = self.urdf.frames(self.joint_angles(angles))
        in_base = np.linalg.inv(frames[self.base])
        return {link: in_base @ frame for link, frame in frames.items()}

    def appearance(self) -> Appearance:
        """Return the visual parts of the robot: from its file of visual meshes, else from the URDF's visuals.

        Raises:
            SurefootError: the robot has neither, or the file is invalid.
        """
        if self.visuals is None:
            return Appearance.from_urdf(self.urdf, self.legs)
        return Appearance.load(self.folder / self.visuals, self.urdf.links)

    def nominal_params(self) -> dict[str, Any]:
        """Return the nominal value of every physical parameter by name: one number, or one per motor."""
        return {
            **{name: item.nominal for name, item in PARAMETERS.items()},
            **nominal_params(self.actuator),
            **{name: getattr(self.timing, name) for name in ("servo_latency", "control_latency", "control_step")},
            **{
                f"contact_{name}": getattr(self.contact, name)
                for name in ("friction", "stiffness", "spinning_friction")
            },
        }

    def check_allowed(self, name: str, values: Array, source: str = "") -> None:
        """Reject values of a physical parameter outside the range that the data sheet allows."""
        low, high = self.allowed[name]
        bad = np.asarray(values)[~((values >= low) & (values <= high))]
        if bad.size:
            allowed = f"{self.name} allows {low:g} to {high:g} (unit: {PARAMETERS[name].unit_for(self)})"
            raise SurefootError(f"{source}{name} is {bad.flat[0]:g}; {allowed}")


def load_embedded_robot(archive: bytes, name: object) -> RobotDescription:
    """Load the robot of a recorded run: from the embedded archive, else the built-in robot of that name.

    Raises:
        SurefootError: there is no archive and no built-in robot of that name, or the robot is invalid.
    """
    if archive:
        return RobotDescription.load(unpack_robot(archive))
    if not isinstance(name, str) or name not in RobotDescription.available():
        raise SurefootError(f"is of robot {quote(name)}, which is not built in; give its folder with --robot")
    return RobotDescription.load(name)


def _joint_positions(urdf: Urdf, base: str, legs: Sequence[Leg]) -> tuple[Array, Array, Array]:
    """Return motor positions (L, m, 3) [m], motor axes (L, m, 3) and foot positions (L, 3) [m] at zero angles.

    All are in the base frame.
    """
    frames = urdf.frames()
    inverse = np.linalg.inv(frames[base])
    motors = [[urdf.joints[name] for name in leg.motors] for leg in legs]
    at = np.array([[inverse @ frames[joint.child] for joint in chain] for chain in motors])
    axes = np.array(
        [[frame[:3, :3] @ j.axis for frame, j in zip(*row, strict=True)] for row in zip(at, motors, strict=True)]
    )
    return at[..., :3, 3], axes, np.array([(inverse @ frames[leg.foot])[:3, 3] for leg in legs])


def _mounts(positions: Array, feet: Array, five_bar: bool) -> Array:
    """Return the hip positions (L, 3) [m]; see `RobotDescription.leg_mounts`."""
    if five_bar:
        return positions.mean(axis=1)
    hips, abducts = positions[:, -2], positions.shape[1] == 3
    pivots = positions[:, 0] if abducts else np.column_stack([hips[:, 0], feet[:, 1], hips[:, 2]])
    return np.column_stack([hips[:, 0], pivots[:, 1:]])
