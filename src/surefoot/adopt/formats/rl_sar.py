"""rl_sar (github.com/fan-ziqi/rl_sar): `config.yaml` of a policy, and `base.yaml` of its robot, of version 3.

Observations are scaled, then clipped; histories are clipped observations, 0 the newest. Joint k of the policy is motor
`joint_mapping[k]` of the robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from surefoot.adopt.builder import unknown_term
from surefoot.adopt.formats.reading import pick
from surefoot.adopt.specification import PerJoint, PolicySpecification, Term, TermName
from surefoot.configuration import read_yaml
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.robot import RobotDescription

TERMS: dict[str, TermName] = {
    "commands": "command",
    "gravity_vec": "gravity",
    "dof_pos": "joint_positions",
    "dof_vel": "joint_speeds",
    "actions": "last_action",
    **dict.fromkeys(("ang_vel", "ang_vel_body", "ang_vel_world", "ang_vel_axis"), "angular_velocity"),
}
"""Terms by their names."""
_CLOCKS = {"phase": (4.0, 8.0, 16.0), "g1_phase": (0.8,)}
"""Periods [s] of the clocks of an observation."""
_UNMEASURED = {"lin_vel": "is the speed of the base, which no sensor of a robot gives"}


@dataclass(frozen=True)
class _Config:
    """What is read of both files; see rl_sar."""

    observations: tuple[str, ...]
    default_dof_pos: tuple[float, ...]
    rl_kp: tuple[float, ...]
    rl_kd: tuple[float, ...]
    action_scale: tuple[float, ...]
    dt: float
    decimation: int
    joint_mapping: tuple[int, ...]
    observations_history: tuple[int, ...] = ()
    observations_history_priority: Literal["time", "term"] = "time"
    clip_obs: float | None = None
    clip_actions_lower: tuple[float, ...] = ()
    clip_actions_upper: tuple[float, ...] = ()
    ang_vel_scale: float = 1.0
    dof_pos_scale: float = 1.0
    dof_vel_scale: float = 1.0
    gravity_vec_scale: float = 1.0
    commands_scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    wheel_indices: tuple[int, ...] = ()


def read(config: Path, robot: RobotDescription) -> PolicySpecification:
    """Read the specification of a policy.

    Args:
        config: its `config.yaml`; `base.yaml` is taken from the same folder or the one above.
        robot: the robot; its motors are in the order of the hardware, where `base.yaml` has no names.

    Raises:
        SurefootError: a file without what is needed, or an observation that is not known.
    """
    own = _only_table(config)
    bases = [folder / "base.yaml" for folder in (config.parent, config.parent.parent)]
    base = next((_only_table(path) for path in bases if path.is_file() and path != config), {})
    with prefix_errors(config):
        table = pick(_Config, {**base, **own})
        if table.wheel_indices:
            raise SurefootError("wheel_indices are given; robots with wheels can't be adopted")
        names = _hardware_names(base, robot)
        if sorted(table.joint_mapping) != sorted(range(len(names))):
            raise SurefootError(
                f"joint_mapping is {list(table.joint_mapping)}; each of {len(names)} motors must be in it"
            )
        steps = table.observations_history or (0,)
        clip = (table.clip_actions_lower, table.clip_actions_upper)
        return PolicySpecification(
            joints=tuple(names[motor] for motor in table.joint_mapping),
            default_pose=table.default_dof_pos,
            kp=table.rl_kp,
            kd=table.rl_kd,
            control_step=table.dt * table.decimation,
            observations=tuple(term for name in table.observations for term in _terms(name, table, steps)),
            action_scale=table.action_scale,
            action_clip=clip if all(clip) else None,
            observation_clip=table.clip_obs,
            history_by="term" if table.observations_history_priority == "term" else "step",
            notes={"forward": "commands: rl_sar's files do not say which were trained; --forward and others set them"},
        )


def _only_table(path: Path) -> dict[str, Any]:
    """Return the one table of a file, or that of its folder's name."""
    data = read_yaml(path)
    tables = {name: table for name, table in data.items() if isinstance(table, dict)}
    if len(tables) == 1:
        return next(iter(tables.values()))
    for name, table in tables.items():
        if name.rpartition("/")[2] == path.parent.name:
            return table
    raise SurefootError(f"{path}: holds {choices(data)}; rl_sar has one table in it, such as 'go2/himloco'")


def _hardware_names(base: dict[str, Any], robot: RobotDescription) -> list[str]:
    """Return the joints in the order of the hardware."""
    joints, mapping = base.get("joint_names"), base.get("joint_mapping")
    if not joints or not mapping:
        return [*robot.motor_names]
    if len(joints) != len(mapping) or sorted(mapping) != [*range(len(joints))]:
        raise SurefootError("base.yaml: joint_names and joint_mapping must be as many, and each motor in them")
    return [str(joints[mapping.index(motor)]) for motor in range(len(joints))]


def _terms(name: str, table: _Config, steps: tuple[int, ...]) -> list[Term]:
    """Return the terms of an observation of rl_sar."""
    if name in TERMS:
        scales: dict[str, PerJoint] = {
            "command": table.commands_scale,
            "gravity": table.gravity_vec_scale,
            "joint_positions": table.dof_pos_scale,
            "joint_speeds": table.dof_vel_scale,
            "angular_velocity": table.ang_vel_scale,
        }
        term = TERMS[name]
        return [Term(term, scale=scales.get(term, 1.0), steps=steps)]
    if name in _CLOCKS:
        step = table.dt * table.decimation
        return [Term("clock", period=period, start=step / period, steps=steps) for period in _CLOCKS[name]]
    raise unknown_term(name, {**TERMS, **_CLOCKS}, _UNMEASURED)
