"""legged_gym (github.com/leggedrobotics/legged_gym) and what comes of it: the Python file of a robot's configuration.

The file is parsed and not run: only the numbers, texts and tables that its classes assign are read. What it does not
assign has legged_gym's defaults. Joints are in Isaac Gym's order.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from surefoot.adopt.specification import PolicySpecification, Range, Term
from surefoot.errors import SurefootError, choices, describe_os_errors, prefix_errors, quote
from surefoot.files import read_configuration
from surefoot.robot import RobotDescription

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
"""legged_gym's own, where a robot's file says nothing (`legged_robot_config.py`)."""
_MAX_DEPTH = 8
_WITHOUT_SPEED = 45
"""Numbers of an observation without the speed of the base: angular velocity, gravity, commands, joints, last action."""


def read(config: Path, robot: RobotDescription) -> PolicySpecification:
    """Read the specification of a policy.

    Raises:
        SurefootError: no Python, a value that is missing, or an observation that no sensor gives.
    """
    with describe_os_errors(config):
        source = read_configuration(config)
    with prefix_errors(config):
        values = _DEFAULTS | _read_classes(source)
        if values["control.control_type"] != "P":
            raise SurefootError(f"control_type is {quote(values['control.control_type'])}; P alone can be adopted")
        joints = _isaac_gym_order(robot)
        count = int(_number(values, "env.num_observations")) if "env.num_observations" in values else _WITHOUT_SPEED
        if count != _WITHOUT_SPEED:
            raise SurefootError(
                f"num_observations is {count}; legged_gym's own {_WITHOUT_SPEED + 3} begin with the speed of the base, "
                f"which no sensor gives. {_WITHOUT_SPEED} can be adopted: angular velocity, gravity, commands, joint "
                "positions and speeds, last action; for any other observation, use --from manual"
            )
        scales = {
            name: _number(values, f"normalization.obs_scales.{name}") for name in ("lin_vel", "ang_vel", "dof_pos")
        }
        limit = _number(values, "normalization.clip_actions")
        forward, sideways, yaw_rate = (_pair(values, f"commands.ranges.{name}") for name in _RANGES)
        return PolicySpecification(
            joints=joints,
            default_pose=tuple(
                _joint_value(values, "init_state.default_joint_angles", joint, True) for joint in joints
            ),
            kp=tuple(_joint_value(values, "control.stiffness", joint) for joint in joints),
            kd=tuple(_joint_value(values, "control.damping", joint) for joint in joints),
            control_step=_number(values, "sim.dt") * _number(values, "control.decimation"),
            observations=(
                Term("angular_velocity", scale=scales["ang_vel"]),
                Term("gravity"),
                Term("command", scale=(scales["lin_vel"], scales["lin_vel"], scales["ang_vel"])),
                Term("joint_positions", scale=scales["dof_pos"]),
                Term("joint_speeds", scale=_number(values, "normalization.obs_scales.dof_vel")),
                Term("last_action"),
            ),
            action_scale=_number(values, "control.action_scale"),
            action_clip=(-limit, limit),
            observation_clip=_number(values, "normalization.clip_observations"),
            notes={
                "joints": f"order of joints: Isaac Gym's is assumed, {', '.join(joints[:4])} and so on, which the "
                "file does not say",
                "observations": "observation: angular velocity, gravity, commands, joint positions and speeds, last "
                "action is assumed; the file does not say it",
            },
            forward=forward,
            sideways=sideways,
            yaw_rate=yaw_rate,
        )


_RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")


def _isaac_gym_order(robot: RobotDescription) -> tuple[str, ...]:
    """Return the joints leg by leg, the legs by the names of their first joints: FL FR RL RR."""
    legs = sorted(robot.legs, key=lambda leg: leg.motors[0])
    return tuple(motor for leg in legs for motor in leg.motors)


def _read_classes(source: bytes) -> dict[str, Any]:
    """Return what the classes of a Python file assign, by dotted name below the outermost class.

    Where several classes of the outermost level assign the same, the last one counts.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise SurefootError(f"is not Python: {error}") from error
    values: dict[str, Any] = {}

    def visit(body: list[ast.stmt], prefix: str, depth: int) -> None:
        for item in body:
            if isinstance(item, ast.ClassDef) and depth < _MAX_DEPTH:
                visit(item.body, f"{prefix}{item.name}.", depth + 1)
            elif isinstance(item, ast.Assign | ast.AnnAssign) and item.value is not None:
                targets = item.targets if isinstance(item, ast.Assign) else [item.target]
                try:
                    value = ast.literal_eval(item.value)
                except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError):
                    continue  # computed: it is not run
                values.update({f"{prefix}{one.id}": value for one in targets if isinstance(one, ast.Name)})

    for outer in tree.body:
        if isinstance(outer, ast.ClassDef):
            visit(outer.body, "", 0)
    return values


def _number(values: dict[str, Any], key: str) -> float:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SurefootError(f"{key} is {'missing' if value is None else quote(value)}; it must be a number")
    return float(value)


def _pair(values: dict[str, Any], key: str) -> Range:
    value = values.get(key)
    if not isinstance(value, list | tuple) or len(value) != 2 or not all(isinstance(x, int | float) for x in value):
        raise SurefootError(f"{key} is {quote(value)}; it must be two numbers")
    return float(value[0]), float(value[1])


def _joint_value(values: dict[str, Any], key: str, joint: str, whole: bool = False) -> float:
    """Return the value of a joint in a table: under its own name or, in tables of gains, under a part of it."""
    table = values.get(key)
    if not isinstance(table, dict):
        raise SurefootError(f"{key} is {'missing' if table is None else quote(table)}; it must be a table of joints")
    found = [value for name, value in table.items() if name == joint or (not whole and str(name) in joint)]
    if len(found) != 1 or isinstance(found[0], bool) or not isinstance(found[0], int | float):
        raise SurefootError(f"{key} is for {choices(table)}; it must have one number for {joint}")
    return float(found[0])
