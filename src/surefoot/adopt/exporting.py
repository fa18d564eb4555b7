"""Export of policies whose actions are motor angles to the formats of other deployment frameworks.

The framework's observation is unscaled. Nodes before the policy's graph convert it to the raw observation of the
contract, and nodes after it convert the output to the framework's action. The framework then computes the same motor
angles as surefoot, except that it does not clip them to the joint limits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
import yaml
from onnx import helper

from surefoot import __version__
from surefoot.adopt.builder import OBSERVATION_PARTS, VECTOR_COLUMNS, NetworkSizes, PolicyBuilder, adopted_specification
from surefoot.adopt.formats import isaac_lab, rl_sar
from surefoot.adopt.formats.common import first_names
from surefoot.adopt.onnx_network import run_model
from surefoot.adopt.specification import PolicySpecification
from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.files import atomic_write
from surefoot.policy.contract import MEMORY
from surefoot.policy.graph import Graph, Value
from surefoot.policy.network import INPUT, OUTPUT
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.rotations import up_direction

_PHYSICS_STEP = 0.005
"""Time between two commands to the motors in rl_sar [s]."""
_TERM_ORDER = ("command", "angular_velocity", "gravity", "joint_positions", "joint_speeds", "last_action")
"""Observation terms of exported policies. Other frameworks have no estimate of the velocity of the base."""
_TOLERANCE = 1e-4
_SAMPLES = 64


class _Exported(NamedTuple):
    """A policy converted to a deployment framework's conventions."""

    graph: Graph
    observation: Value
    action: Value
    terms: tuple[str, ...]
    """Observation terms, in order."""
    history: int
    joints: tuple[str, ...]
    default_pose: Array
    """Joint angles [rad], in the order of the joints."""
    action_scale: Array
    kp: Array
    kd: Array
    control_step: float


def export_rl_sar(policy: PolicyRuntime, data: bytes, robot: RobotDescription, folder: Path) -> list[Path]:
    """Write `policy.onnx` and `config.yaml` for rl_sar, and the robot's `base.yaml`; return their paths.

    Raises:
        SurefootError: the policy's actions are not motor angles, or rl_sar does not support its memory or observations.
    """
    made = _translate(policy, data, robot, by_term=False)
    names = first_names(rl_sar.TERMS)
    count, decimation = robot.num_motors, max(round(made.control_step / _PHYSICS_STEP), 1)
    # The robot stands up with the data sheet's gains, because a policy's gains are often too soft for it.
    motors = {f"fixed_{name}": getattr(robot.actuator, name) for name in ("kp", "kd")}
    motors["torque_limits"] = getattr(robot.actuator, "torque_limit", 0.0)
    motors = {key: np.broadcast_to(np.asarray(value, float), count) for key, value in motors.items()}
    order = [robot.motor_names.index(joint) for joint in made.joints]
    pose = np.empty(count)
    pose[order] = made.default_pose
    # In rl_sar, base.yaml has the motors in the hardware's order, and config.yaml in the policy's order.
    base: dict[str, object] = {
        "dt": made.control_step / decimation,
        "decimation": decimation,
        "num_of_dofs": count,
        "wheel_indices": [],
        **{key: values.tolist() for key, values in motors.items()},
        "default_dof_pos": pose.tolist(),
        "joint_names": list(robot.motor_names),
        "joint_controller_names": [f"{name.removesuffix('_joint')}_controller" for name in robot.motor_names],
        "joint_mapping": list(range(count)),
    }
    config = {
        "model_name": "policy.onnx",
        "num_observations": made.observation.width // made.history,
        "observations": [names[term] for term in made.terms],
        "observations_history": list(range(made.history)) if made.history > 1 else [],
        "observations_history_priority": "time",
        "clip_obs": 1e6,
        "clip_actions_lower": [-1e6] * count,
        "clip_actions_upper": [1e6] * count,
        "rl_kp": made.kp.tolist(),
        "rl_kd": made.kd.tolist(),
        **{key: values[order].tolist() for key, values in motors.items()},
        "num_of_dofs": count,
        "action_scale": made.action_scale.tolist(),
        "wheel_indices": [],
        "lin_vel_scale": 1.0,
        "ang_vel_scale": 1.0,
        "dof_pos_scale": 1.0,
        "dof_vel_scale": 1.0,
        "commands_scale": [1.0, 1.0, 1.0],
        "default_dof_pos": made.default_pose.tolist(),
        "joint_mapping": order,
    }
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "policy.onnx", folder / "config.yaml", folder / "base.yaml"]
    files[0].write_bytes(_model(made, {}))
    for path, name, table in ((files[1], f"{robot.name}/{folder.name}", config), (files[2], robot.name, base)):
        text = yaml.safe_dump({name: table}, sort_keys=False, default_flow_style=None, width=110)
        atomic_write(
            path, f"# Written by surefoot {__version__} for policy {policy.contract.name}; not run on a robot.\n{text}"
        )
    return files


def export_mjlab(policy: PolicyRuntime, data: bytes, robot: RobotDescription, folder: Path) -> list[Path]:
    """Write `policy.onnx` with the properties that mjlab's exporter writes; return its path.

    Raises:
        SurefootError: see `export_rl_sar`.
    """
    made = _translate(policy, data, robot, by_term=True)
    names = first_names(isaac_lab.TERMS)

    def numbers(values: Array) -> str:
        return ",".join(f"{value:.9g}" for value in values)

    properties = {
        "run_path": "surefoot",
        "joint_names": ",".join(made.joints),
        "joint_stiffness": numbers(made.kp),
        "joint_damping": numbers(made.kd),
        "default_joint_pos": numbers(made.default_pose),
        "command_names": "twist",
        "observation_names": ",".join(names[term] for term in made.terms),
        "observation_terms_history_length": ",".join([f"{made.history}"] * len(made.terms)),
        "action_scale": numbers(made.action_scale),
        "control_step": f"{made.control_step:.9g}",
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "policy.onnx"
    path.write_bytes(_model(made, properties))
    return [path]


EXPORTERS: dict[str, Callable[[PolicyRuntime, bytes, RobotDescription, Path], list[Path]]] = {
    "rl_sar": export_rl_sar,
    "mjlab": export_mjlab,
}
"""Exporters by the name of the deployment framework."""


def _model(made: _Exported, properties: dict[str, str]) -> bytes:
    """Serialize the network for a batch of one robot, with metadata properties."""
    model = made.graph.to_onnx([made.observation], [made.action], "policy", __version__)
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.shape.dim[0].dim_value = 1
    helper.set_model_props(model, properties)
    data: bytes = model.SerializeToString()
    return data


def _translate(policy: PolicyRuntime, data: bytes, robot: RobotDescription, by_term: bool) -> _Exported:
    """Convert a policy to a deployment framework's conventions.

    Args:
        policy: the policy.
        data: its file.
        robot: robot that it is for.
        by_term: whether histories are flattened term by term, oldest first; otherwise step by step, newest first.
    """
    contract = policy.contract
    if not contract.action_names[0].startswith("angle."):
        what = "a reference gait adds to its actions" if contract.reference else "its actions are not motor angles"
        raise SurefootError(f"policy '{contract.name}' can't be exported: {what}; other formats take only joint angles")
    kept = [name for name in contract.action_names if name.startswith(f"{MEMORY}.")]
    spec = adopted_specification(policy.contract)
    count = robot.num_motors
    if len(kept) not in (0, count) or (kept and spec is None):
        raise SurefootError(
            f"policy '{contract.name}' can't be exported: it has {len(kept)} numbers of memory, such as clocks or "
            "hidden states, which the format does not support"
        )
    joints, scale, offset, to_motors = _actions(policy, robot, spec)
    if spec is not None and spec.target_clip is not None:
        raise SurefootError(f"policy '{contract.name}' can't be exported: its angles are clipped, the format's are not")
    terms = _terms(policy)
    graph = Graph()
    widths = [3 if term in VECTOR_COLUMNS else count for term in terms]
    observation = Value("obs", sum(widths) * contract.history)
    rows = []
    for age in range(contract.history):
        place = _places(observation, widths, terms, contract.history, age, by_term)
        rows.append(_raw(policy, graph, place, robot, joints, scale, offset))
    raw = graph.join(rows)
    inner = onnx.load_model_from_string(data).graph
    for node in inner.node:
        node.name = ""
        for names in (node.input, node.output):
            for k, name in enumerate(names):
                names[k] = raw.name if name == INPUT else f"policy_{name}"
    graph.nodes += inner.node
    for constant in inner.initializer:
        constant.name = f"policy_{constant.name}"
    graph.constants += inner.initializer
    feedback = Value(f"policy_{OUTPUT}", len(contract.action_names))
    if kept:
        action = graph.select(feedback, range(count, 2 * count))
    else:
        weight = np.zeros((feedback.width, count))
        weight[:count] = to_motors.T / scale
        action = graph.linear(feedback.name, weight, -offset / scale)
    graph.nodes[-1].output[0] = "actions"
    action = Value("actions", count)
    index = [robot.motor_names.index(joint) for joint in joints]
    kp, kd = (np.broadcast_to(gain, count)[index] for gain in (contract.servo_kp, contract.servo_kd))
    made = _Exported(
        graph, observation, action, terms, contract.history, joints, offset, scale, kp, kd, contract.control_step
    )
    _compare(policy, made, robot, to_motors, by_term)
    return made


def _actions(
    policy: PolicyRuntime, robot: RobotDescription, spec: PolicySpecification | None
) -> tuple[tuple[str, ...], Array, Array, Array]:
    """Return joints, scale and offset of the exported actions, and the matrix (J, M) from joint to motor angles."""
    if spec is None:
        to_motors = np.diag(robot.motor_sign)
        stand = robot.pose_angles(*policy.contract.rest)
        return robot.motor_names, np.ones(robot.num_motors), stand * robot.motor_sign, to_motors
    maker = PolicyBuilder(spec, NetworkSizes(None, len(spec.joints)), robot)
    scale, offset, to_motors = maker.target_map()
    if spec.joint_signs is not None and min(spec.joint_signs) < 0:
        raise SurefootError(
            f"policy '{policy.contract.name}' can't be exported: some joints have the opposite sign, which the format "
            "does not support"
        )
    return spec.joints, np.array(scale, float), np.array(offset, float), to_motors


def _terms(policy: PolicyRuntime) -> tuple[str, ...]:
    """Return the observation terms of the exported policy, in order."""
    term_of_part = {
        **{part: term for term, parts in OBSERVATION_PARTS.items() for part in parts if term in _TERM_ORDER},
        **dict.fromkeys(("roll", "pitch"), "gravity"),
        **dict.fromkeys(("last_action", "memory"), "last_action"),
    }
    parts = [part.name for part in policy.contract.observation]
    if unknown := [part for part in parts if part not in term_of_part]:
        raise SurefootError(
            f"policy '{policy.contract.name}' can't be exported: it observes {choices(unknown)}; the format does not"
        )
    needed = {term_of_part[part] for part in parts}
    return tuple(term for term in _TERM_ORDER if term in needed)


class _Place(NamedTuple):
    """Column indices of each term in the exported observation, for one time step of the history."""

    observation: Value
    columns: dict[str, range]


def _places(
    observation: Value, widths: Sequence[int], terms: Sequence[str], history: int, age: int, by_term: bool
) -> _Place:
    columns, start = {}, 0
    for term, width in zip(terms, widths, strict=True):
        if by_term:
            first = start * history + (history - 1 - age) * width
        else:
            first = age * sum(widths) + start
        columns[term] = range(first, first + width)
        start += width
    return _Place(observation, columns)


def _raw(
    policy: PolicyRuntime,
    graph: Graph,
    place: _Place,
    robot: RobotDescription,
    joints: Sequence[str],
    scale: Array,
    offset: Array,
) -> Value:
    """Add nodes that compute the raw observation of one time step, in the contract's order."""
    columns = list(policy.contract.columns)
    weight, shift = np.zeros((place.observation.width, len(columns))), np.zeros(len(columns))
    for term, numbers in place.columns.items():
        for k, name in enumerate(VECTOR_COLUMNS.get(term, ())):
            if name in columns:
                weight[numbers[k], columns.index(name)] = 1.0
    for k, joint in enumerate(joints):
        sign = float(robot.motor_sign[robot.motor_names.index(joint)])
        if f"angle.{joint}" in columns:
            weight[place.columns["joint_positions"][k], columns.index(f"angle.{joint}")] = sign
            shift[columns.index(f"angle.{joint}")] = sign * offset[k]
        if f"speed.{joint}" in columns:
            weight[place.columns["joint_speeds"][k], columns.index(f"speed.{joint}")] = sign
        if f"last_angle.{joint}" in columns:
            weight[place.columns["last_action"][k], columns.index(f"last_angle.{joint}")] = sign * scale[k]
            shift[columns.index(f"last_angle.{joint}")] = sign * offset[k]
        if f"{MEMORY}.{k}" in columns:
            weight[place.columns["last_action"][k], columns.index(f"{MEMORY}.{k}")] = 1.0
    value = graph.linear(place.observation.name, weight, shift)
    for name in ("roll", "pitch"):
        if name in columns:
            value = _add_tilt(graph, value, place, name, columns.index(name))
    return value


def _add_tilt(graph: Graph, value: Value, place: _Place, name: str, column: int) -> Value:
    """Add roll = atan(g_y / g_z) or pitch = asin(g_x) to a zero column of the raw observation."""
    x, y, z = (graph.select(place.observation, [place.columns["gravity"][k]]).name for k in range(3))
    if name == "pitch":
        angle = graph.apply("Asin", graph.clip(x, -1.0, 1.0))
    else:
        angle = graph.apply("Atan", graph.apply("Div", y, graph.clip(z, -2.0, -1e-3)))
    spread = graph.linear(angle, np.eye(1, value.width, column))
    return Value(graph.apply("Add", value.name, spread.name), value.width)


def _compare(policy: PolicyRuntime, made: _Exported, robot: RobotDescription, to_motors: Array, by_term: bool) -> None:
    """Verify on random observations that the framework's arithmetic gives the same angles as the policy.

    Raises:
        SurefootError: the angles differ.
    """
    contract, random = policy.contract, np.random.default_rng(0)
    columns, count = list(contract.columns), robot.num_motors
    index = [robot.motor_names.index(joint) for joint in made.joints]
    signs = robot.motor_sign[index]
    raws, rows = [], []
    for _ in range(contract.history):
        tilt = random.uniform(-0.5, 0.5, (_SAMPLES, 2))
        roll, pitch = tilt.T
        terms = {
            "gravity": -up_direction(tilt),
            "angular_velocity": random.normal(size=(_SAMPLES, 3)),
            "command": random.uniform(-0.4, 0.4, (_SAMPLES, 3)),
            "joint_positions": random.normal(scale=0.2, size=(_SAMPLES, count)),
            "joint_speeds": random.normal(size=(_SAMPLES, count)),
            "last_action": random.normal(size=(_SAMPLES, count)),
        }
        values = {name: terms[term][:, k] for term in terms for k, name in enumerate(VECTOR_COLUMNS.get(term, ()))}
        values |= {"roll": roll, "pitch": pitch}
        for k, joint in enumerate(made.joints):
            values[f"angle.{joint}"] = signs[k] * (terms["joint_positions"][:, k] + made.default_pose[k])
            values[f"speed.{joint}"] = signs[k] * terms["joint_speeds"][:, k]
            action = terms["last_action"][:, k]
            values[f"last_angle.{joint}"] = signs[k] * (action * made.action_scale[k] + made.default_pose[k])
            values[f"{MEMORY}.{k}"] = action
        raws.append(np.stack([values[name] for name in columns], axis=1))
        rows.append([terms[term] for term in made.terms])
    if by_term:
        parts = [rows[age][k] for k in range(len(made.terms)) for age in reversed(range(contract.history))]
    else:
        parts = [part for row in rows for part in row]
    model = made.graph.to_onnx([made.observation], [made.action]).SerializeToString()
    (actions,) = run_model(model, {"obs": np.concatenate(parts, axis=1).astype(np.float32)})
    angles = (actions * made.action_scale + made.default_pose) @ to_motors
    theirs = np.clip(angles, *np.array([contract.low, contract.high])[:, :count])
    mine = policy.feedback(np.concatenate(raws, axis=1))[:, :count]
    difference = float(np.abs(mine - theirs).max())
    if not difference <= _TOLERANCE:
        raise SurefootError(f"the exported network gives other angles than the policy, by up to {difference:.2g} rad")
