"""Format `rl_sar` (github.com/fan-ziqi/rl_sar): `config.yaml` of a policy, and `base.yaml` of its robot.

Observations are scaled, then clipped; histories store clipped observations, and age 0 is the newest. Since version 3,
joint k of the policy is motor `joint_mapping[k]` of the robot. Older files have one flat table that names a framework:
lists are leg by leg in the order of `joint_controller_names`; for isaacsim with `rows` and `cols` they are transposed
to all hips first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from surefoot.adopt.formats.common import field_names, from_table, match_joints, unknown_term, unread_keys, unread_note
from surefoot.adopt.specification import ObservationTerm, PerJoint, PolicySpecification, TermName
from surefoot.configuration import read_yaml
from surefoot.errors import SurefootError, choices, prefix_errors, quote
from surefoot.robot import RobotDescription

T = TypeVar("T")

TERMS: dict[str, TermName] = {
    "commands": "command",
    "lin_vel": "base_velocity",
    "gravity_vec": "gravity",
    "dof_pos": "joint_positions",
    "dof_vel": "joint_speeds",
    "actions": "last_action",
    **dict.fromkeys(("ang_vel", "ang_vel_body", "ang_vel_world", "ang_vel_axis"), "angular_velocity"),
}
"""Observation terms by rl_sar's names."""
_CLOCKS = {"phase": (4.0, 8.0, 16.0), "g1_phase": (0.8,)}
"""Periods [s] of clocks by the name of the observation."""
_HARMLESS = (
    *("model_name", "framework", "rows", "cols", "num_observations", "num_of_dofs", "torque_limits"),
    *("fixed_kp", "fixed_kd", "joint_names", "joint_controller_names", "command_mapping", "state_mapping"),
    *("action_scale_wheel", "stiffness", "damping"),
)
"""Keys that affect neither observations nor actions, or that other keys replace."""
_OLD_FORMAT_KEY = "framework"
"""Key that only files before version 3 have."""


@dataclass(frozen=True)
class _Config:
    """Keys of both files that the reader uses, with rl_sar's names."""

    observations: tuple[str, ...]
    default_dof_pos: tuple[float, ...]
    rl_kp: tuple[float, ...] | float
    rl_kd: tuple[float, ...] | float
    action_scale: tuple[float, ...] | float
    dt: float
    decimation: int
    joint_mapping: tuple[int, ...]
    observations_history: tuple[int, ...] = ()
    observations_history_priority: Literal["time", "term"] = "time"
    clip_obs: float | None = None
    clip_actions_lower: tuple[float, ...] = ()
    clip_actions_upper: tuple[float, ...] = ()
    lin_vel_scale: float = 1.0
    ang_vel_scale: float = 1.0
    dof_pos_scale: float = 1.0
    dof_vel_scale: float = 1.0
    gravity_vec_scale: float = 1.0
    commands_scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    wheel_indices: tuple[int, ...] = ()
    hip_scale_reduction: float = 1.0
    hip_scale_reduction_indices: tuple[int, ...] = ()
    use_history: bool = False


def read(config: Path, robot: RobotDescription, overrides: Mapping[str, Any]) -> PolicySpecification:
    """Read the specification of a policy.

    Args:
        config: its `config.yaml`; `base.yaml` is taken from the same folder or the one above.
        robot: the robot; its motor order is the hardware's order, unless `base.yaml` has names.
        overrides: fields of the specification from the user, which the files need not have.

    Raises:
        SurefootError: a file is missing or incomplete, or an observation is unknown.
    """
    own = _single_table(config)
    bases = [folder / "base.yaml" for folder in (config.parent, config.parent.parent)]
    base = next((_single_table(path) for path in bases if path.is_file() and path != config), {})
    with prefix_errors(config):
        data, notes = {**base, **own, **_override_keys(overrides)}, {}
        names = _hardware_names(base, robot)
        if _OLD_FORMAT_KEY in own and "joint_mapping" not in data:
            with prefix_errors("rl_sar's format before version 3"):
                names, note = _old_format_joints(data, robot)
            data["joint_mapping"], notes["joints"] = list(range(len(names))), note
            table = _pick(data, "rl_sar's format before version 3; ")
        else:
            table = _pick(data, "")
        if table.wheel_indices:
            raise SurefootError("wheel_indices are given; robots with wheels can't be adopted")
        if table.use_history and not table.observations_history:
            raise SurefootError(
                "use_history is true; state its steps as observations_history, such as [0, 1, 2, 3, 4, 5]"
            )
        if sorted(table.joint_mapping) != sorted(range(len(names))):
            raise SurefootError(
                f"joint_mapping is {list(table.joint_mapping)}; each of {len(names)} motors must be in it"
            )
        order, why = _order(table, own)
        if why:
            notes["joints"] = f"{notes.get('joints', 'order of joints')}; {why}"
        scale, reduced = _action_scale(table, order)
        if reduced:
            notes["action_scale"] = reduced
        steps = table.observations_history or (0,)
        joints = [names[motor] for motor in table.joint_mapping]
        clip = [_reordered(one, order) for one in (table.clip_actions_lower, table.clip_actions_upper)]
        return PolicySpecification(
            joints=tuple(joints[place] for place in order),
            default_pose=_reordered(table.default_dof_pos, order),
            kp=_reordered(table.rl_kp, order),
            kd=_reordered(table.rl_kd, order),
            control_step=table.dt * table.decimation,
            observations=tuple(term for name in table.observations for term in _terms(name, table, steps)),
            action_scale=scale,
            action_clip=(clip[0], clip[1]) if all(clip) else None,
            observation_clip=table.clip_obs,
            history_by="term" if table.observations_history_priority == "term" else "step",
            notes={
                "forward": "commands: rl_sar's files do not say which were trained; --forward and others set them",
                **notes,
                **unread_note(unread_keys(data, field_names(_Config), _HARMLESS)),
            },
        )


def _pick(data: Mapping[str, Any], what: str) -> _Config:
    """Parse a table; an error begins with `what`, the format, and names options that replace missing keys."""
    try:
        return from_table(_Config, data)
    except SurefootError as error:
        options = {"dt": "--control-step", "rl_kp": "--kp", "rl_kd": "--kd"}
        missing = [option for name, option in options.items() if data.get(name) is None]
        hint = f" ({', '.join(missing)} replaces it)" if missing and "missing" in str(error) else ""
        raise SurefootError(f"{what}{error}{hint}") from error


def _override_keys(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the user's fields as keys of a table."""
    keys: dict[str, Any] = {
        name: overrides[field] for field, name in (("kp", "rl_kp"), ("kd", "rl_kd")) if overrides.get(field) is not None
    }
    if overrides.get("control_step") is not None:
        keys |= {"dt": overrides["control_step"], "decimation": 1}
    return keys


def _old_format_joints(data: dict[str, Any], robot: RobotDescription) -> tuple[list[str], str]:
    """Return the joints in the order of the lists in a file before version 3, and a note about the order.

    Single-number gains `stiffness` and `damping` are copied to `rl_kp` and `rl_kd`.
    """
    for old, new in (("stiffness", "rl_kp"), ("damping", "rl_kd")):
        if new not in data and isinstance(data.get(old), int | float):
            data[new] = data[old]
    name = "joint_controller_names" if data.get("joint_controller_names") else "joint_names"
    controllers = _list_of(data.get(name), str, name)
    if not controllers:
        first = ", ".join(robot.motor_names[:4])
        return [
            *robot.motor_names
        ], f"order of joints: the file does not say it; the robot's is assumed, {first} and so on"
    motors = match_joints(map(str, controllers), robot.motor_names)
    if motors is None or {*motors} != {*robot.motor_names}:
        raise SurefootError(
            f"joint_controller_names are {choices(controllers)}; {robot.name} has {choices(robot.motor_names)}"
        )
    return [*motors], "order of joints: as in joint_controller_names"


def _order(table: _Config, own: Mapping[str, Any]) -> tuple[tuple[int, ...], str]:
    """Return the index in the file's lists of each joint of the network, and a note about it."""
    count, rows, columns = len(table.joint_mapping), own.get("rows"), own.get("cols")
    same = tuple(range(count))
    if own.get(_OLD_FORMAT_KEY) != "isaacsim" or not isinstance(rows, int) or not isinstance(columns, int):
        return same, ""
    if rows < 1 or columns < 1 or rows * columns != count:
        raise SurefootError(f"rows and cols are {rows} and {columns}; there are {count} joints")
    if table.hip_scale_reduction_indices == same[::columns]:
        return same, "leg by leg as in hip_scale_reduction_indices, although framework is isaacsim"
    order = tuple(np.arange(count).reshape(rows, columns).T.ravel().tolist())
    return order, "all hips first, then all thighs, then all calves, as for framework isaacsim with rows and cols"


def _reordered(values: Any, order: tuple[int, ...]) -> Any:
    """Reorder per-joint numbers to the network's order."""
    return (
        tuple(values[place] for place in order) if isinstance(values, tuple) and len(values) == len(order) else values
    )


def _action_scale(table: _Config, order: tuple[int, ...]) -> tuple[PerJoint, str]:
    """Return the action scale including the reduction for hips, and a note about it."""
    own: PerJoint = _reordered(table.action_scale, order)
    if table.hip_scale_reduction == 1.0 or not table.hip_scale_reduction_indices:
        return own, ""
    hips = list(table.hip_scale_reduction_indices)
    if not {*hips} <= {*range(len(order))}:
        raise SurefootError(f"hip_scale_reduction_indices are {hips}; there are {len(order)} joints")
    scale = np.array(np.broadcast_to(own, len(order)), float)
    scale[hips] *= table.hip_scale_reduction
    note = (
        f"scale of actions: hip_scale_reduction is in it, {scale.min():g} to {scale.max():g} rad; the last action is "
    )
    return tuple(scale.tolist()), f"{note}observed without it"


def _single_table(path: Path) -> dict[str, Any]:
    """Return the single table of a file, or the table with its folder's name; or the whole file if it is flat."""
    data = read_yaml(path)
    if "observations" in data or (_OLD_FORMAT_KEY in data and "decimation" in data):
        return data
    tables = {name: table for name, table in data.items() if isinstance(table, dict)}
    if len(tables) == 1:
        return next(iter(tables.values()))
    for name, table in tables.items():
        if str(name).rpartition("/")[2] == path.parent.name:
            return table
    raise SurefootError(f"{path}: holds {choices(data)}; a file of rl_sar has one table, such as 'go2/himloco'")


def _list_of(value: Any, kind: type[T], where: str) -> list[T]:
    """Return a list, empty if there is none.

    Raises:
        SurefootError: it is no list, or has an entry of another type.
    """
    if value is None:
        return []
    if not isinstance(value, list) or not all(isinstance(one, kind) for one in value):
        what = "names" if kind is str else "whole numbers"
        raise SurefootError(f"{where} is {quote(value)}; it must be a list of {what}")
    return value


def _hardware_names(base: dict[str, Any], robot: RobotDescription) -> list[str]:
    """Return the joint names in the order of the hardware."""
    joints = _list_of(base.get("joint_names"), str, "base.yaml: joint_names")
    mapping = _list_of(base.get("joint_mapping"), int, "base.yaml: joint_mapping")
    if not joints or not mapping:
        return [*robot.motor_names]
    if len(joints) != len(mapping) or sorted(mapping) != [*range(len(joints))]:
        raise SurefootError("base.yaml: joint_names and joint_mapping must be equally long, with each motor once")
    return [str(joints[mapping.index(motor)]) for motor in range(len(joints))]


def _terms(name: str, table: _Config, steps: tuple[int, ...]) -> list[ObservationTerm]:
    """Convert an observation of rl_sar to terms."""
    if name in TERMS:
        scales: dict[str, PerJoint] = {
            "command": table.commands_scale,
            "gravity": table.gravity_vec_scale,
            "joint_positions": table.dof_pos_scale,
            "joint_speeds": table.dof_vel_scale,
            "angular_velocity": table.ang_vel_scale,
            "base_velocity": table.lin_vel_scale,
        }
        term = TERMS[name]
        return [ObservationTerm(term, scale=scales.get(term, 1.0), steps=steps)]
    if name in _CLOCKS:
        step = table.dt * table.decimation
        return [ObservationTerm("clock", period=period, start=step / period, steps=steps) for period in _CLOCKS[name]]
    raise unknown_term(name, {**TERMS, **_CLOCKS})
