"""Conversion between a task and the contract of its policy.

A contract states what a robot needs to run the policy (observation, reference, bounds, commands, gains and delays) as
numbers for one robot. The rest of the task (reward, randomization, pushes) is in `Contract.task`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot import __version__
from surefoot.configuration import from_mapping, from_tagged, to_mapping
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import (
    ASSUMED_PARAMS,
    MEMORY,
    Contract,
    HeightMap,
    ObservationPart,
    config_hash,
    contract_fields,
)
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription
from surefoot.robot.params_file import ParamValue, param_values
from surefoot.task.commands import CommandConfig
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.gait import ActionKind, action_names
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.observation import Observer
from surefoot.task.plugins import used_plugins
from surefoot.task.policy_plugins import check_plugins, task_without_skipped
from surefoot.task.reference_config import REFERENCES
from surefoot.task.terrain import TerrainConfig

if TYPE_CHECKING:
    from surefoot.task.env import LocomotionEnv

_STATED = contract_fields(TaskConfig)
"""Dotted names of the task's fields that are fields of the contract."""


def make_contract(
    env: LocomotionEnv, config: Any = None, metrics: Mapping[str, Any] | None = None, created: str = ""
) -> Contract:
    """Return the contract of a policy that was trained in an environment.

    Args:
        env: the environment.
        config: configuration of the whole run, a dataclass whose `name` becomes the policy's. Defaults to the task.
        metrics: metrics of the run.
        created: when the policy was made, ISO 8601.
    """
    config = config or env.task
    return contract_from_task(
        env.task, env.robot, config_hash(_without_path(to_mapping(config), env.robot)), config.name, metrics, created
    )


def contract_from_task(
    task: TaskConfig,
    robot: RobotDescription,
    whole_hash: str = "",
    name: str = "",
    metrics: Mapping[str, Any] | None = None,
    created: str = "",
) -> Contract:
    """Return the contract of a policy for a task on its robot.

    Args:
        task: the task.
        robot: the task's robot.
        whole_hash: `config_hash` of the configuration of the run. Defaults to the hash of the task.
        name: name of the policy. Defaults to the task's name.
        metrics: metrics of the run.
        created: when the policy was made, ISO 8601.
    """
    gait, scan = task.gait(robot), task.terrain.scan
    observer = Observer(robot, task.observations, gait.action_names)
    assumed: dict[str, Any] = param_values(task.nominal(robot), ASSUMED_PARAMS)
    assumed |= {name: None for name in assumed if name not in PhysicalParams.names(robot)}
    return Contract(
        name=name or task.name,
        robot=robot.name,
        description=robot.location if robot.is_builtin else "",
        motor_names=robot.motor_names,
        motor_signs=tuple(float(sign) for sign in robot.motor_sign),
        leg_names=robot.leg_names,
        observation=tuple(ObservationPart(**part) for part in observer.describe()),
        columns=tuple(observer.columns),
        history=task.history,
        action_names=tuple(gait.action_names),
        low=tuple(gait.low.tolist()),
        high=tuple(gait.high.tolist()),
        reference=None if task.reference.kind == "none" else gait.reference.to_dict(),
        rest=task.rest or gait.rest,
        **assumed,
        task=_task_mapping(task),
        config_hash=whole_hash or config_hash(_without_path(to_mapping(task), robot)),
        figures=dict(metrics or {}),
        commands=task.commands.limits(robot),
        height_map=HeightMap(*POLICY_GRID.scale(robot), age=scan.delay * float(task.nominal(robot).control_step[0]))
        if task.needs_height_map
        else None,
        plugins=used_plugins(task.reward, task.observations),
        version=__version__,
        created=created,
    )


def _without_path(config: dict[str, Any], robot: RobotDescription) -> dict[str, Any]:
    """Return the configuration of a run or task with the robot's name instead of its path, which may change."""
    if robot.is_builtin:
        return config
    if isinstance(config.get("task"), dict):
        return {**config, "task": _without_path(config["task"], robot)}
    return {**config, "robot": robot.name}


def _task_mapping(task: TaskConfig) -> dict[str, Any]:
    """Return the fields of a task that are not fields of the contract."""
    data = to_mapping(task)
    if task.needs_height_map:
        del data["terrain"]["scan"]["delay"]  # in the contract as the age of the map
    return _without_stated(data)


def _without_stated(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a task's table without the fields of the contract."""
    return {
        key: _without_stated(value, f"{prefix}{key}.") if isinstance(value, Mapping) else value
        for key, value in table.items()
        if f"{prefix}{key}" not in _STATED
    }


def task_from_contract(contract: Contract, robot: RobotDescription | None = None) -> TaskConfig:
    """Return the task for which a policy was made.

    Args:
        contract: contract of the policy.
        robot: description of the robot. Defaults to the robot of the contract's name that ships with surefoot.

    Raises:
        SurefootError: a key that contracts do not have, or values that do not fit the robot.
    """
    check_plugins(contract)
    robot = robot or RobotDescription.load(contract.description)
    if stated := _STATED.intersection(_names(contract.task)):
        raise SurefootError(f"task.{min(stated)} is not a key; the contract states it outside the task")
    task = from_mapping(TaskConfig, task_without_skipped(contract), "task")
    kind, memory, feedback = _feedback(contract, robot)
    scan = task.terrain.scan
    if contract.height_map is not None:
        scan = replace(scan, delay=round(contract.height_map.age / contract.control_step))
    return replace(
        task,
        robot=robot.location,
        observations=tuple(part.name for part in contract.observation),
        history=contract.history,
        reference=from_tagged(REFERENCES, contract.reference or {}, "reference"),
        feedback=feedback,
        action=kind,
        memory=memory,
        rest=contract.rest,
        commands=_commands(contract, task.commands),
        params=task.params | _assumed_params(contract, robot),
        # Neither the terrain of the training nor its step of physics are those in which the policy runs.
        terrain=TerrainConfig(scan=scan),
        physics_step=0.0,
    )


def _names(table: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of all entries in nested tables."""
    for key, value in table.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _names(value, f"{prefix}{key}.")


def _feedback(contract: Contract, robot: RobotDescription) -> tuple[ActionKind, int, FeedbackConfig]:
    """Return the kind of action, the number of memory outputs, and the bounds of the feedback."""
    prefix = contract.action_names[0].partition(".")[0] if contract.action_names else ""
    kind: ActionKind = "joint" if prefix == "joint" else "angle" if prefix == "angle" else "leg"
    memory = sum(name.startswith(f"{MEMORY}.") for name in contract.action_names)
    names = action_names(robot, kind, memory)
    if list(contract.action_names) != names:
        raise SurefootError(
            f"its actions are {choices(contract.action_names)}; on {robot.name} they must be {choices(names)}"
        )
    ends = np.array([contract.low, contract.high])[:, : len(names) - memory]
    if kind == "angle":
        lowest, highest = robot.motor_limits
        if outside := np.flatnonzero((ends[0] < lowest - 1e-9) | (ends[1] > highest + 1e-9)).tolist():
            k = outside[0]
            raise SurefootError(
                f"bounds of {names[k]} are {ends[0, k]:g} to {ends[1, k]:g} rad; the joint of {robot.name} "
                f"allows {lowest[k]:g} to {highest[k]:g}"
            )
        return kind, memory, FeedbackConfig()
    coordinates = ("joint",) if kind == "joint" else robot.coordinates
    low, high = (np.reshape(bound, (len(coordinates), -1)) for bound in ends)
    bounds = zip(coordinates, low.min(axis=1).tolist(), high.max(axis=1).tolist(), strict=True)
    return kind, memory, FeedbackConfig(**{name: (lowest, highest) for name, lowest, highest in bounds})


def _commands(contract: Contract, config: CommandConfig) -> CommandConfig:
    """Return the configuration of commands with the contract's limits as ranges."""
    limits = contract.commands
    if limits is None:
        return replace(config, forward=(0.0, 0.0), sideways=(0.0, 0.0), yaw_rate=(0.0, 0.0))
    return replace(
        config,
        forward=limits.forward,
        sideways=limits.sideways,
        yaw_rate=limits.yaw_rate,
        relative=False,
        acceleration=limits.acceleration[0] / GRAVITY,
        heading_gain=limits.heading_gain,
    )


def _assumed_params(contract: Contract, robot: RobotDescription) -> dict[str, ParamValue]:
    """Return the contract's physical parameters that differ from the robot's description."""
    nominal = param_values(PhysicalParams.nominal(robot), ASSUMED_PARAMS)
    assumed = {name: getattr(contract, name) for name in ASSUMED_PARAMS}
    return {name: value for name, value in assumed.items() if value is not None and value != nominal[name]}
