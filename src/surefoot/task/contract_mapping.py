"""The contract of a task's policy, and the task of a policy's contract.

A contract states what a robot needs to run the policy: its observation, reference, bounds, commands, gains and delays,
as numbers for one robot. The rest of the task (reward, randomization, pushes) stands in `Contract.task`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot import __version__
from surefoot.configuration import from_mapping, to_mapping
from surefoot.errors import SurefootError, choices, quote
from surefoot.policy.contract import ASSUMED_PARAMS, MEMORY, Contract, HeightMap, ObservationPart, config_hash
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription
from surefoot.robot.commands import COMMANDS
from surefoot.robot.params_file import ParamValue, param_values
from surefoot.task.commands import CommandConfig
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.gait import ActionKind, action_names
from surefoot.task.height_scan import MAP
from surefoot.task.observation import PARTS, Observer
from surefoot.task.plugins import changed_plugins, used_plugins
from surefoot.task.reference_config import ReferenceConfig
from surefoot.task.reward import TERMS
from surefoot.task.terrain import TerrainConfig

if TYPE_CHECKING:
    from surefoot.task.env import LocomotionEnv

_STATED = ("robot", "observations", "history", "reference", "feedback", "action", "memory", "rest")
"""Fields of the task that the contract states itself."""
_LIMITS = (*COMMANDS, "relative", "acceleration", "heading_gain")
"""Fields of the task's commands that the contract states as limits."""
_STATED_KEYS = {
    *(f"task.{name}" for name in _STATED),
    *(f"task.commands.{name}" for name in _LIMITS),
    *(f"task.params.{name}" for name in ASSUMED_PARAMS),
}


def make_contract(
    env: LocomotionEnv, config: Any = None, figures: Mapping[str, Any] | None = None, created: str = ""
) -> Contract:
    """Return the contract of a policy that was trained in an environment.

    Args:
        env: the environment.
        config: configuration of the whole run, a dataclass with a `name`: the policy's. The task's, if None.
        figures: figures of the run.
        created: when the policy was made, ISO 8601.
    """
    config = config or env.task
    return contract_from_task(
        env.task, env.robot, config_hash(_without_path(to_mapping(config), env.robot)), config.name, figures, created
    )


def contract_from_task(
    task: TaskConfig,
    robot: RobotDescription,
    whole_hash: str = "",
    name: str = "",
    figures: Mapping[str, Any] | None = None,
    created: str = "",
) -> Contract:
    """Return the contract of a policy for a task on its robot.

    Args:
        task: the task.
        robot: the task's.
        whole_hash: `config_hash` of the configuration of the run; the task's, if empty.
        name: of the policy; the task's, if empty.
        figures: figures of the run.
        created: when the policy was made, ISO 8601.
    """
    gait, scan = task.gait(robot), task.terrain.scan
    observer = Observer(robot, task.observations, gait.action_names)
    assumed: dict[str, Any] = param_values(task.nominal(robot), ASSUMED_PARAMS)
    assumed |= {name: None for name in assumed if name not in PhysicalParams.names(robot)}
    return Contract(
        name=name or task.name,
        robot=robot.name,
        description=robot.location if robot.ships else "",
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
        figures=dict(figures or {}),
        commands=task.commands.limits(robot),
        height_map=HeightMap(*MAP.scale(robot), age=scan.delay * float(task.nominal(robot).control_step[0]))
        if task.sees
        else None,
        plugins=used_plugins(task.reward, task.observations),
        version=__version__,
        created=created,
    )


def _without_path(config: dict[str, Any], robot: RobotDescription) -> dict[str, Any]:
    """Return a configuration, of a run or a task, with a robot that does not ship by name: its folder may move."""
    if robot.ships:
        return config
    if isinstance(config.get("task"), dict):
        return {**config, "task": _without_path(config["task"], robot)}
    return {**config, "robot": robot.name}


def _task_mapping(task: TaskConfig) -> dict[str, Any]:
    """Return the part of a task that the contract does not state itself."""
    data = {name: value for name, value in to_mapping(task).items() if name not in _STATED}
    if task.sees:
        del data["terrain"]["scan"]["delay"]
    data["params"] = {name: value for name, value in data["params"].items() if name not in ASSUMED_PARAMS}
    data["commands"] = {name: value for name, value in data["commands"].items() if name not in _LIMITS}
    return data


def check_plugins(contract: Contract) -> None:
    """Refuse a policy with an observation of a plug-in that is not registered."""
    for record in contract.plugins:
        if missing := [name for name in record.observations if name not in PARTS]:
            raise SurefootError(
                f"policy {quote(contract.name)} needs observation {choices(map(quote, missing))} of a plug-in; "
                f"name the file: --plugin {quote(record.name)}"
            )


def plugin_notes(contract: Contract) -> list[str]:
    """Return a line for each plug-in of a policy that has changed, and one for reward terms that are skipped."""
    notes = changed_plugins(contract.plugins)
    if skipped := _skipped_rewards(contract):
        names = choices(quote(record.name) for record in contract.plugins)
        what = (
            "are without"
            if skipped < {*contract.task.get("reward", {})}
            else "are those of the paper's reward, without"
        )
        notes.append(
            f"returns {what} {choices(map(quote, sorted(skipped)))}; to have them, name the plug-in: --plugin {names}"
        )
    return notes


def _skipped_rewards(contract: Contract) -> set[str]:
    """Return the reward terms of plug-ins that are not registered."""
    return {name for record in contract.plugins for name in record.rewards if name not in TERMS}


def _task_without_skipped(contract: Contract) -> dict[str, Any]:
    """Return the task's table without the reward terms of plug-ins that are not registered."""
    skipped, task = _skipped_rewards(contract), dict(contract.task)
    for key in ("reward", "reward_limits") if skipped else ():
        if isinstance(table := task.get(key), Mapping):
            task[key] = {name: value for name, value in table.items() if name not in skipped}
    if skipped and not task.get("reward"):
        task.pop("reward", None)
    return task


def task_from_contract(contract: Contract, robot: RobotDescription | None = None) -> TaskConfig:
    """Return the task that a policy was made for.

    Args:
        contract: the policy's.
        robot: the robot's description; the one of the contract's name that ships, if None.

    Raises:
        SurefootError: a key that contracts do not have, or values that do not fit the robot.
    """
    check_plugins(contract)
    robot = robot or RobotDescription.load(contract.description)
    keys = {f"task.{key}" for key in contract.task}
    for table in ("commands", "params"):
        if isinstance(values := contract.task.get(table), Mapping):
            keys |= {f"task.{table}.{key}" for key in values}
    if stated := keys & _STATED_KEYS:
        raise SurefootError(f"{min(stated)} is not a key; the contract states it outside the task")
    task = from_mapping(TaskConfig, _task_without_skipped(contract), "task")
    kind, memory, feedback = _feedback(contract, robot)
    scan = task.terrain.scan
    if contract.height_map is not None:
        scan = replace(scan, delay=round(contract.height_map.age / contract.control_step))
    return replace(
        task,
        robot=robot.location,
        observations=tuple(part.name for part in contract.observation),
        history=contract.history,
        reference=from_mapping(ReferenceConfig, contract.reference or {}, "reference"),
        feedback=feedback,
        action=kind,
        memory=memory,
        rest=contract.rest,
        commands=_commands(contract, task.commands),
        params=task.params | _assumed_params(contract, robot),
        # The terrain of its training is not what a robot stands on that runs it.
        terrain=TerrainConfig(scan=scan),
    )


def _feedback(contract: Contract, robot: RobotDescription) -> tuple[ActionKind, int, FeedbackConfig]:
    """Return what the feedback is added to, how many of its numbers are memory, and bounds on each coordinate."""
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
        least, greatest = robot.motor_limits
        if wrong := np.flatnonzero((ends[0] < least - 1e-9) | (ends[1] > greatest + 1e-9)).tolist():
            one = wrong[0]
            raise SurefootError(
                f"bounds of {names[one]} are {ends[0, one]:g} to {ends[1, one]:g} rad; the joint of {robot.name} "
                f"allows {least[one]:g} to {greatest[one]:g}"
            )
        return kind, memory, FeedbackConfig()
    coordinates = ("joint",) if kind == "joint" else robot.coordinates
    low, high = (np.reshape(bound, (len(coordinates), -1)) for bound in ends)
    bounds = zip(coordinates, low.min(axis=1).tolist(), high.max(axis=1).tolist(), strict=True)
    return kind, memory, FeedbackConfig(**{name: (least, most) for name, least, most in bounds})


def _commands(contract: Contract, config: CommandConfig) -> CommandConfig:
    """Return how commands are drawn, within the contract's limits."""
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
