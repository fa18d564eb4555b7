"""Format `unitree_rl_lab` (github.com/unitreerobotics/unitree_rl_lab): `deploy.yaml`, which its trainings write.

Joint k of the policy is motor `joint_ids_map[k]` in the vendor's order. Gains are in the vendor's order; default pose,
action scale and action offset are in the policy's order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.adopt.formats.common import field_names, from_table, unread_keys, unread_note
from surefoot.adopt.formats.isaac_lab import make_term
from surefoot.adopt.specification import ObservationTerm, PolicySpecification, Range
from surefoot.configuration import read_yaml
from surefoot.errors import SurefootError, choices, prefix_errors, quote
from surefoot.robot import RobotDescription

_ACTION = "JointPositionAction"
_ACTION_HARMLESS = ("joint_names", "preserve_order", "use_default_offset", "class_type", "asset_name")
_SWITCHES = ("use_gym_history", "scale_first")


@dataclass(frozen=True)
class _Ranges:
    lin_vel_x: Range = (0.0, 0.0)
    lin_vel_y: Range = (0.0, 0.0)
    ang_vel_z: Range = (0.0, 0.0)


@dataclass(frozen=True)
class _Action:
    scale: tuple[float, ...] | float
    offset: tuple[float, ...] | None = None
    clip: tuple[Range, ...] | None = None


@dataclass(frozen=True)
class _Observation:
    scale: tuple[float, ...] | float = 1.0
    clip: Range | None = None
    history_length: int = 1
    params: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Config:
    joint_ids_map: tuple[int, ...]
    step_dt: float
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    default_joint_pos: tuple[float, ...]
    actions: dict[str, Any]
    observations: dict[str, Any]
    commands: dict[str, Any] = field(default_factory=dict)


def read(config: Path, robot: RobotDescription, overrides: Mapping[str, Any]) -> PolicySpecification:
    """Read the specification of a policy; the robot's motors must be in the vendor's order.

    The file need not have fields in `overrides`.

    Raises:
        SurefootError: the file is missing or incomplete, or an observation is unknown.
    """
    data = read_yaml(config)
    with prefix_errors(config):
        count = robot.num_motors
        stated = {"step_dt": overrides.get("control_step")}
        stated |= {
            name: [overrides[field]] * count
            for field, name in (("kp", "stiffness"), ("kd", "damping"))
            if overrides.get(field) is not None
        }
        data |= {name: value for name, value in stated.items() if value is not None}
        table = from_table(_Config, data)
        if sorted(table.joint_ids_map) != [*range(count)]:
            raise SurefootError(f"joint_ids_map is {list(table.joint_ids_map)}; each of {count} motors must be in it")
        for name in ("stiffness", "damping"):
            if len(getattr(table, name)) != count:
                raise SurefootError(f"{name} has {len(getattr(table, name))} numbers; {robot.name} has {count} motors")
        if list(table.actions) != [_ACTION]:
            raise SurefootError(f"actions are {choices(table.actions) or 'none'}; only {_ACTION} can be adopted")
        options = table.actions[_ACTION] or {}
        if not isinstance(options, dict):
            raise SurefootError(f"actions.{_ACTION} is {quote(options)}; it must be a table")
        action = from_table(_Action, options)
        terms, by_step, ignored = _terms(table)
        ignored += unread_keys(data, field_names(_Config))
        ignored += unread_keys(options, field_names(_Action), _ACTION_HARMLESS, f"actions.{_ACTION}.")
        ranges = _command_ranges(table)
        silent = {} if ranges else {"forward": "commands: the file states no ranges; --forward and others set them"}
        low_high = np.array(action.clip or [], float).T
        specification = PolicySpecification(
            joints=tuple(robot.motor_names[motor] for motor in table.joint_ids_map),
            default_pose=table.default_joint_pos,
            kp=tuple(table.stiffness[motor] for motor in table.joint_ids_map),
            kd=tuple(table.damping[motor] for motor in table.joint_ids_map),
            control_step=table.step_dt,
            observations=terms,
            action_scale=action.scale,
            action_offset=action.offset,
            target_clip=(tuple(low_high[0].tolist()), tuple(low_high[1].tolist())) if action.clip else None,
            history_by="step" if by_step else "term",
            notes={**silent, **unread_note(ignored)},
        )
        return replace(specification, **ranges)


def _terms(table: _Config) -> tuple[tuple[ObservationTerm, ...], bool, list[str]]:
    """Return the terms, whether histories are ordered step by step, and unread keys."""
    group = table.observations
    names = [name for name in group if name not in _SWITCHES]
    if names and all(isinstance(group[name], Mapping) and "params" not in group[name] for name in names):
        # A term has params; otherwise the entry is a group of terms for one input of the network.
        if len(names) > 1:
            raise SurefootError(f"observations are for {len(names)} inputs ({choices(names)}); one can be adopted")
        group = group[names[0]]
        names = [name for name in group if name not in _SWITCHES]
    terms, ignored = [], []
    for name in names:
        if not isinstance(group[name], Mapping):
            raise SurefootError(f"observations.{name} is {quote(group[name])}; it must be a table")
        one = from_table(_Observation, group[name])
        ignored += unread_keys(group[name], field_names(_Observation), where=f"observations.{name}.")
        period = one.params.get("period")
        if not isinstance(period, int | float):
            period = None
        if period is None and name == "gait_phase":
            raise SurefootError("observations.gait_phase.params.period is missing; it must be given")
        term = make_term(name, one.scale, one.clip, one.history_length, period=period)
        if group.get("scale_first"):
            term = replace(term, clip=None, clip_after=one.clip)
        # The phase advances by one control step before it is first observed.
        terms.append(replace(term, start=table.step_dt / period) if period else term)
    return tuple(terms), bool(group.get("use_gym_history")), ignored


def _command_ranges(table: _Config) -> dict[str, Any]:
    """Return the command ranges in the file, by field of the specification."""
    stated = table.commands.get("base_velocity")
    if not isinstance(stated, Mapping) or not isinstance(stated.get("ranges"), Mapping):
        return {}
    ranges = from_table(_Ranges, stated["ranges"])
    return {"forward": ranges.lin_vel_x, "sideways": ranges.lin_vel_y, "yaw_rate": ranges.ang_vel_z}
