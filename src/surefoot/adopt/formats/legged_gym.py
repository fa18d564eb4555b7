"""Format `legged_gym` (github.com/leggedrobotics/legged_gym) and its descendants: a robot's Python configuration.

The file is parsed but not run: only numbers, texts and tables that its classes assign, and arithmetic of these, are
read. Missing values have legged_gym's defaults. Joints are in Isaac Gym's order.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from surefoot.adopt.formats.common import plain_joint_name, unread_keys, unread_note
from surefoot.adopt.formats.python_values import Computed, read_classes
from surefoot.adopt.specification import ObservationTerm, PolicySpecification, Range
from surefoot.configuration import is_number
from surefoot.errors import SurefootError, choices, describe_os_errors, nearest, prefix_errors, quote
from surefoot.files import read_configuration
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS

_DEFAULTS: dict[str, Any] = {
    "sim.dt": 0.005,
    "control.decimation": 4,
    "control.action_scale": 0.5,
    "control.control_type": "P",
    "normalization.obs_scales.lin_vel": 2.0,
    "normalization.obs_scales.ang_vel": 0.25,
    "normalization.obs_scales.dof_pos": 1.0,
    "normalization.obs_scales.dof_vel": 0.05,
    "normalization.clip_observations": 100.0,
    "normalization.clip_actions": 100.0,
    "commands.heading_command": True,
    "commands.ranges.lin_vel_x": [-1.0, 1.0],
    "commands.ranges.lin_vel_y": [-1.0, 1.0],
    "commands.ranges.ang_vel_yaw": [-1.0, 1.0],
}
"""Defaults of legged_gym (`legged_robot_config.py`)."""
_NEEDED = ("init_state.default_joint_angles", "control.stiffness", "control.damping")
_OPTIONAL = ("env.num_observations",)
_HIP_SCALES = ("control.hip_scale_reduction", "control.hip_reduction")
"""Names of the action scale factor of each leg's first joint in walk-these-ways and HIMLoco."""
_DEFAULT_KEYS = (
    *("init_state.pos", "init_state.rot", "init_state.lin_vel", "init_state.ang_vel"),
    *("commands.curriculum", "commands.max_curriculum", "commands.num_commands", "commands.resampling_time"),
    *("commands.ranges.heading", "normalization.obs_scales.height_measurements"),
    *("env.num_envs", "env.num_privileged_obs", "env.num_actions", "env.env_spacing", "env.send_timeouts"),
    *("env.episode_length_s", "sim.substeps", "sim.gravity", "sim.up_axis"),
)
"""Keys of legged_gym that affect neither observations nor actions of a policy."""
_POLICY_SECTIONS = ("control", "init_state", "normalization", "commands", "env", "sim")
"""Sections whose unread keys are reported."""
_SECTIONS = (
    *_POLICY_SECTIONS,
    *("terrain", "asset", "domain_rand", "rewards", "noise", "viewer", "policy", "algorithm", "runner"),
)
"""Classes of legged_gym's configurations of environments and learners."""
_NUM_INPUTS = 45
"""Width of an observation without base velocity: angular velocity, gravity, commands, joints and last action."""
_NUM_WITH_VELOCITY = _NUM_INPUTS + 3
"""Width of legged_gym's own observation, which begins with the base velocity."""


def read(config: Path, robot: RobotDescription, overrides: Mapping[str, Any]) -> PolicySpecification:
    """Read the specification of a policy; the file need not have fields in `overrides`.

    Raises:
        SurefootError: the file is not Python, a value is missing or computed, or no sensor provides an observation.
    """
    with describe_os_errors(config):
        source = read_configuration(config)
    with prefix_errors(config):
        assigned = read_classes(source, _SECTIONS)
        values = _DEFAULTS | assigned
        for field, key in (("kp", "control.stiffness"), ("kd", "control.damping")):
            if overrides.get(field) is not None:
                values[key] = {"": overrides[field]}
        for field, name in zip(COMMANDS, _RANGES, strict=True):
            if overrides.get(field) is not None and isinstance(values.get(f"commands.ranges.{name}"), Computed):
                values[f"commands.ranges.{name}"] = list(overrides[field])
        if overrides.get("control_step") is not None:
            values |= {"sim.dt": overrides["control_step"], "control.decimation": 1}
        if missing := [key for key in _NEEDED if key not in values]:
            near = [nearest(key.rpartition(".")[2], [one.rpartition(".")[2] for one in assigned]) for key in missing]
            hints = [f"{key}{f' (did you mean {one}?)' if one else ''}" for key, one in zip(missing, near, strict=True)]
            raise SurefootError(f"{', '.join(hints)} {'is' if len(missing) == 1 else 'are'} missing")
        if _literal(values, "control.control_type") != "P":
            raise SurefootError(f"control_type is {quote(values['control.control_type'])}; only P can be adopted")
        joints = _isaac_gym_order(robot)
        count = int(_number(values, "env.num_observations")) if "env.num_observations" in values else _NUM_INPUTS
        if count not in (_NUM_INPUTS, _NUM_WITH_VELOCITY):
            raise SurefootError(
                f"num_observations is {count}; {_NUM_INPUTS} can be adopted: angular velocity, gravity, commands, "
                f"joint positions and speeds, last action; and legged_gym's own {_NUM_WITH_VELOCITY}, which begin with "
                "the speed of the base; for any other observation, use --from manual"
            )
        scales = {
            name: _number(values, f"normalization.obs_scales.{name}") for name in ("lin_vel", "ang_vel", "dof_pos")
        }
        limit = _number(values, "normalization.clip_actions")
        velocity = (ObservationTerm("base_velocity", scale=scales["lin_vel"]),) * (count == _NUM_WITH_VELOCITY)
        forward, sideways, yaw_rate = (_pair(values, f"commands.ranges.{name}") for name in _RANGES)
        action_scale, hips = _action_scale(values, robot, joints)
        return PolicySpecification(
            joints=joints,
            default_pose=tuple(
                _joint_value(values, "init_state.default_joint_angles", joint, True) for joint in joints
            ),
            kp=tuple(_joint_value(values, "control.stiffness", joint) for joint in joints),
            kd=tuple(_joint_value(values, "control.damping", joint) for joint in joints),
            control_step=_number(values, "sim.dt") * _number(values, "control.decimation"),
            observations=(
                *velocity,
                ObservationTerm("angular_velocity", scale=scales["ang_vel"]),
                ObservationTerm("gravity"),
                ObservationTerm("command", scale=(scales["lin_vel"], scales["lin_vel"], scales["ang_vel"])),
                ObservationTerm("joint_positions", scale=scales["dof_pos"]),
                ObservationTerm("joint_speeds", scale=_number(values, "normalization.obs_scales.dof_vel")),
                ObservationTerm("last_action"),
            ),
            action_scale=action_scale,
            action_clip=(-limit, limit),
            observation_clip=_number(values, "normalization.clip_observations"),
            notes={
                "joints": f"order of joints: Isaac Gym's is assumed, {', '.join(joints[:4])} and so on, which the "
                "file does not say",
                "observations": f"observation: {'base velocity, ' if velocity else ''}angular velocity, gravity, "
                "commands, joint positions and speeds, last action is assumed; the file does not say it",
                **hips,
                **unread_note(_unread_keys(assigned)),
            },
            forward=forward,
            sideways=sideways,
            yaw_rate=yaw_rate,
        )


_RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")


def _action_scale(
    values: Mapping[str, Any], robot: RobotDescription, joints: tuple[str, ...]
) -> tuple[float | tuple[float, ...], dict[str, str]]:
    """Return the action scale including the reduction for hips, and a note about it."""
    scale = _number(values, "control.action_scale")
    factor = 1.0
    for key in _HIP_SCALES:
        factor *= _number(values, key) if key in values else 1.0
    if factor == 1.0:
        return scale, {}
    hips = {leg.motors[0] for leg in robot.legs}
    note = f"scale of actions: for the first joint of each leg it is {scale * factor:g} rad, as the file reduces it"
    return tuple(scale * (factor if joint in hips else 1.0) for joint in joints), {"action_scale": note}


def _unread_keys(assigned: Mapping[str, Any]) -> list[str]:
    """Return unread keys of sections that affect a policy, and unknown sections."""
    read = [*_DEFAULTS, *_NEEDED, *_OPTIONAL, *_HIP_SCALES]
    policy_keys, sections = {}, {}
    for key, value in assigned.items():
        section, _, name = key.partition(".")
        if section in _POLICY_SECTIONS and not key.startswith("sim.physx."):
            policy_keys[key] = value.text if isinstance(value, Computed) else value
        elif name and section not in _SECTIONS:
            sections[section] = "a class"
    return unread_keys(policy_keys, read, _DEFAULT_KEYS) + unread_keys(sections, _SECTIONS)


def _isaac_gym_order(robot: RobotDescription) -> tuple[str, ...]:
    """Return the joints leg by leg, with legs sorted by the name of their first joint: FL FR RL RR."""
    legs = sorted(robot.legs, key=lambda leg: leg.motors[0])
    return tuple(motor for leg in legs for motor in leg.motors)


def _literal(values: Mapping[str, Any], key: str) -> Any:
    """Return a value; reject a computed value."""
    value = values.get(key)
    if isinstance(value, Computed):
        raise SurefootError(f"{key} is computed ({quote(value.text)}); write the value itself")
    return value


def _number(values: Mapping[str, Any], key: str) -> float:
    value = _literal(values, key)
    if not is_number(value):
        raise SurefootError(f"{key} is {'missing' if value is None else quote(value)}; it must be a number")
    return float(value)


def _pair(values: Mapping[str, Any], key: str) -> Range:
    value = _literal(values, key)
    if not isinstance(value, list | tuple) or len(value) != 2 or not all(map(is_number, value)):
        raise SurefootError(f"{key} is {quote(value)}; it must be two numbers")
    return float(value[0]), float(value[1])


def _joint_value(values: Mapping[str, Any], key: str, joint: str, whole: bool = False) -> float:
    """Look up a joint in a table: by its name or, for gains (not `whole`), by a part of its name."""
    table = _literal(values, key)
    if not isinstance(table, dict):
        raise SurefootError(f"{key} is {'missing' if table is None else quote(table)}; it must be a table of joints")
    matches = [value for name, value in table.items() if name == joint or (not whole and str(name) in joint)]
    if not matches:
        plain = plain_joint_name(joint)
        matches = [value for name, value in table.items() if plain_joint_name(str(name)) == plain]
    if len(matches) != 1 or not is_number(matches[0]):
        raise SurefootError(f"{key} is for {choices(table)}; it must have one number for {joint}")
    return float(matches[0])
