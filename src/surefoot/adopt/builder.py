"""Builder of a policy file from the specification and network of a third-party policy.

The policy file takes raw readings and outputs motor angles: orders, signs, offsets, scales, clips and histories of the
specification become nodes of its graph. The state of the policy is memory of the contract: the last raw action of the
network, clocks, and hidden states.

A clock with period T is stored as (sin, cos - 1) of its phase, so that memory starts at 0, and rotated in each control
step. It is normalized in each step, because it would drift with 32-bit numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from surefoot.adopt.specification import ObservationTerm, PerJoint, PolicySpecification, Range
from surefoot.arrays import Array
from surefoot.configuration import from_mapping, to_mapping
from surefoot.deploy.checks import check_policy
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import Contract
from surefoot.policy.digest import add_digest, read_parts
from surefoot.policy.graph import MAX_FLOAT, Graph, Value
from surefoot.policy.network import INPUT, OUTPUT, check_network
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import ParamValue
from surefoot.task.commands import CommandConfig
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import contract_from_task
from surefoot.task.observation import BASE_VELOCITY, Observer

_REWARD = {"track_velocity": 1.0, "track_yaw_rate": 0.5}
"""Reward of the contract's task: command tracking, because the reward of the policy's training is unknown."""
_EPISODE_DURATION = 20.0
"""Duration of an episode [s]."""
CONSTANTS_EFFECT = "constants_effect"
"""Metric in an adopted policy's contract: change of a joint target [rad] if a constant input changes by 1."""
_NUM_PROBES, _PROBE_NOISE = 64, 0.5
"""Number of random observations for measuring that effect, and the standard deviation of their inputs."""
OBSERVATION_PARTS = {
    "command": ("command",),
    "gravity": ("gravity",),
    "angular_velocity": ("roll_rate", "pitch_rate", "yaw_rate"),
    "base_velocity": (BASE_VELOCITY,),
    "roll_pitch": ("roll", "pitch"),
    "joint_positions": ("motor_angles",),
    "joint_speeds": ("motor_speeds",),
    "last_action": (),
    "clock": (),
    "constant": (),
}
"""Parts of surefoot's observation from which each term is computed."""
VECTOR_COLUMNS = {
    "command": ("command_forward", "command_sideways", "command_yaw_rate"),
    "gravity": ("gravity_x", "gravity_y", "gravity_z"),
    "angular_velocity": ("roll_rate", "pitch_rate", "yaw_rate"),
    "base_velocity": tuple(f"{BASE_VELOCITY}_{axis}" for axis in "xyz"),
    "roll_pitch": ("roll", "pitch"),
}
"""Columns of surefoot's observation for terms that are vectors."""


def adopted_specification(contract: Contract) -> PolicySpecification | None:
    """Return the specification that an adopted policy was built from; None for a policy that was not adopted."""
    adopted = contract.figures.get("adopted")
    stated = adopted.get("specification") if isinstance(adopted, Mapping) else None
    return from_mapping(PolicySpecification, stated, "specification") if isinstance(stated, Mapping) else None


def adopted_notes(contract: Contract) -> dict[str, str]:
    """Return the notes and assumptions of an adoption by field of the specification."""
    adopted = contract.figures.get("adopted")
    notes = adopted.get("notes") if isinstance(adopted, Mapping) else None
    return {str(name): str(note) for name, note in notes.items()} if isinstance(notes, Mapping) else {}


class ForeignNetwork(Protocol):
    """A third-party network, convertible to nodes that a policy file may have."""

    @property
    def inputs(self) -> int | None:
        """Width of an observation; None: any."""

    @property
    def outputs(self) -> int:
        """Width of an action."""

    @property
    def hidden(self) -> tuple[int, ...]:
        """Widths of the hidden states, which start at 0."""

    def add(self, graph: Graph, observation: Value, hidden: list[Value]) -> tuple[Value, list[Value]]:
        """Add the network's nodes to a graph; return the action and the next hidden states."""


@dataclass(frozen=True)
class _Row:
    """One element of the network's observation: clip_after(clip(weights * raw columns + offset) * scale)."""

    weights: dict[int, float]
    offset: float
    clip: Range | None
    scale: float
    clip_after: Range | None

    @property
    def is_constant(self) -> bool:
        """Whether the element never changes."""
        clipped = any(clip is not None and clip[0] == clip[1] for clip in (self.clip, self.clip_after))
        return not self.weights or self.scale == 0.0 or clipped


def build_policy(
    specification: PolicySpecification,
    network: ForeignNetwork,
    robot: RobotDescription,
    name: str,
    source: Mapping[str, Any],
) -> bytes:
    """Build a policy file.

    Args:
        specification: specification of the policy.
        network: network of the policy.
        robot: robot that the policy runs on.
        name: name of the policy, unless the specification has one.
        source: provenance, which is stored in the contract's metrics.

    Raises:
        SurefootError: the specification does not match the network or the robot.
    """
    maker = PolicyBuilder(specification, network, robot)
    contract = maker.contract(specification.name or name, {**source, **_effect_of_constants(maker)})
    check_policy(contract, robot)
    model = maker.graph(contract).to_model(contract, robot.archive)
    check_network(read_parts(model).graph)
    data = add_digest(model)
    PolicyRuntime.parse(data)
    return data


def _effect_of_constants(maker: PolicyBuilder) -> dict[str, float]:
    """Measure how much a joint target changes [rad] if the most influential constant input changes by 1.

    The change is averaged over random observations; the maximum over constants and joints is returned. Empty without
    constants.
    """
    if not maker.constant_places:
        return {}
    from surefoot.adopt.onnx_network import run_model

    graph, observation = Graph(), Value("observation", len(maker.rows))
    states = [Value(f"hidden_{k}", width) for k, width in enumerate(maker.network.hidden)]
    action, _ = maker.network.add(graph, observation, states)
    model = graph.to_onnx([observation, *states], [action]).SerializeToString()
    rows = np.random.default_rng(0).normal(scale=_PROBE_NOISE, size=(_NUM_PROBES, observation.width))
    at_rest = {state.name: np.zeros((_NUM_PROBES, state.width), np.float32) for state in states}

    def targets(inputs: Array) -> Array:
        return np.asarray(run_model(model, {"observation": inputs.astype(np.float32), **at_rest})[0] * scale)

    scale, effects = maker.target_map()[0], []
    before = targets(rows)
    for place in maker.constant_places:
        changed = rows.copy()
        changed[:, place] += 1.0
        effects.append(float(np.abs(targets(changed) - before).mean(axis=0).max()))
    return {CONSTANTS_EFFECT: max(effects)}


@dataclass(frozen=True)
class NetworkSizes:
    """Sizes of a network, for checks without the network itself."""

    inputs: int | None
    """Width of an observation; defaults to the specification's if None."""
    outputs: int
    hidden: tuple[int, ...] = ()

    def add(self, graph: Graph, observation: Value, hidden: list[Value]) -> tuple[Value, list[Value]]:
        """Refuse: there is no network."""
        raise NotImplementedError


def check_specification(specification: PolicySpecification, robot: RobotDescription) -> int:
    """Check a specification against the robot; return the expected number of inputs of the network.

    Raises:
        SurefootError: the joints differ, the legs can't reach the default pose, a term has the wrong size, or the
            velocity of the base is observed without a source.
    """
    specification.check_commands()
    specification.check_base_velocity()
    width = sum(_width(term, robot.num_motors) * len(term.steps) for term in specification.observations)
    maker = PolicyBuilder(specification, NetworkSizes(width, len(specification.joints)), robot)
    check_policy(maker.contract("policy", {}), robot)
    return width


def _likely_rest(more: int, steps: int, joints: int) -> str:
    """Guess the meaning of inputs that the specification lacks, as the end of a message."""
    likely = {3: "the speed of the base (term base_velocity)", 4: "the contacts of the feet"}
    likely |= {joints: "the last action, or another term of the joints"}
    what = likely.get(more // max(steps, 1)) if more > 0 and more % max(steps, 1) == 0 else None
    return f"; {more} more could be {what}" if what else ""


def _width(term: ObservationTerm, joints: int) -> int:
    """Return the width of an observation term for one time step."""
    if term.columns is not None:
        return len(term.columns)
    counts = {"clock": 2 * len(term.phases), "constant": len(term.values)}
    return counts.get(term.term, len(VECTOR_COLUMNS[term.term]) if term.term in VECTOR_COLUMNS else joints)


class PolicyBuilder:
    """Builder of the contract and graph of one policy.

    Args:
        specification: specification of the policy.
        network: network of the policy, or only its sizes.
        robot: robot that the policy runs on.

    Raises:
        SurefootError: the specification does not match the network or the robot.
    """

    def __init__(self, specification: PolicySpecification, network: ForeignNetwork, robot: RobotDescription) -> None:
        self.specification, self.network, self.robot = spec, net, _ = specification, network, robot
        self._motors = self._find_motors()
        count = len(spec.joints)
        if net.outputs != count:
            raise SurefootError(f"the network gives {net.outputs} numbers; there are {count} joints")
        self._clocks = [term for term in spec.observations if term.term == "clock"]
        self._has_last = any(term.term == "last_action" for term in spec.observations)
        self._hidden_start = count * self._has_last + 2 * len(self._clocks)
        self.memory = self._hidden_start + sum(net.hidden)
        parts = {part for term in spec.observations for part in OBSERVATION_PARTS[term.term]}
        order = [part for parts_of in OBSERVATION_PARTS.values() for part in parts_of if part in parts]
        if self.memory:
            order.append("memory")
        self.task = self._task(tuple(order))
        self.gait = self.task.gait(robot)
        self.observer = Observer(robot, self.task.observations, self.gait.action_names)
        self._index = {column: place for place, column in enumerate(self.observer.columns)}
        self.rows = self._find_rows()
        self.constant_places = [k for k, row in enumerate(self.rows) if row.is_constant]
        if net.inputs is not None and len(self.rows) != net.inputs:
            sizes = ", ".join(f"{term.term} {_width(term, count)} x {len(term.steps)}" for term in spec.observations)
            raise SurefootError(
                f"the network takes {net.inputs} numbers; the observations are {len(self.rows)}: {sizes}"
                f"{_likely_rest(net.inputs - len(self.rows), len(spec.observations[0].steps), count)}"
            )

    def _find_motors(self) -> list[int]:
        """Return the motor of each joint."""
        robot, joints = self.robot, self.specification.joints
        if sorted(joints) != sorted(robot.motor_names):
            wrong = [joint for joint in joints if joint not in robot.motor_names] or joints
            raise SurefootError(
                f"joints are {choices(wrong)}, which {robot.name} does not have; it has {choices(robot.motor_names)}"
            )
        return [robot.motor_names.index(joint) for joint in joints]

    @property
    def _signs(self) -> Array:
        """Ratio of motor angle to joint angle (J,), 1 or -1."""
        own = np.array(self.specification.joint_signs or np.ones(len(self._motors)))
        return own * self.robot.motor_sign[self._motors]

    def per_motor(self, numbers: PerJoint) -> ParamValue:
        """Reorder one number per joint to one number per motor; a single number is returned as it is."""
        if not isinstance(numbers, tuple):
            return numbers
        values = np.empty(len(self._motors))
        values[self._motors] = numbers
        return tuple(values.tolist()) if np.ptp(values) else float(values[0])

    def _task(self, observations: tuple[str, ...]) -> TaskConfig:
        spec, robot = self.specification, self.robot
        stand = np.empty(robot.num_motors)
        stand[self._motors] = self._signs * spec.default_pose
        rest = tuple(tuple(row) for row in robot.to_pose(stand).tolist())
        with np.errstate(invalid="ignore"):
            wrong = np.abs(robot.pose_angles(*rest) - stand) > 1e-6
        if not np.isfinite(rest).all() or wrong.any():
            motor = int(np.argmax(wrong))
            raise SurefootError(
                f"{robot.name} can't reach default_pose: see {robot.motor_names[motor]}, {stand[motor]:g} rad; do the "
                "knees bend the other way, or are the order or signs of the joints different?"
            )
        params: dict[str, Any] = {"control_step": spec.control_step}
        params |= {"servo_kp": self.per_motor(spec.kp), "servo_kd": self.per_motor(spec.kd)}
        if spec.latency is not None:
            params["control_latency"] = spec.latency
        follows = any(term.term == "command" for term in spec.observations)
        ranges = {name: getattr(spec, name) for name in ("forward", "sideways", "yaw_rate")} if follows else {}
        return TaskConfig(
            name="adopted",
            robot=robot.location,
            observations=observations,
            history=max(age for term in spec.observations for age in term.steps) + 1,
            action="angle",
            memory=self.memory,
            rest=rest,
            fall_angle=spec.fall_angle,
            max_steps=round(_EPISODE_DURATION / spec.control_step),
            commands=CommandConfig(**ranges),
            reward=_REWARD if follows else {"progress": 1.0},
            params=params,
        )

    def contract(self, name: str, source: Mapping[str, Any]) -> Contract:
        """Return the policy's contract; its metrics store specification and notes for the search for mistakes."""
        kept = to_mapping(self.specification)
        notes = kept.pop("notes")
        if kept["base_velocity"] is None:
            del kept["base_velocity"]  # files of other policies stay as they were
        figures = {"adopted": {**source, "notes": notes, "specification": kept}}
        return contract_from_task(self.task, self.robot, metrics=figures, name=name)

    def _find_rows(self) -> list[_Row]:
        """Return the rows of the network's observation, in its order."""
        spec = self.specification
        terms = {k: {age: self._term_rows(k, age) for age in term.steps} for k, term in enumerate(spec.observations)}
        if spec.history_by == "term":
            return [row for ages in terms.values() for rows in ages.values() for row in rows]
        steps = spec.observations[0].steps
        return [row for age in steps for ages in terms.values() for row in ages[age]]

    def _term_rows(self, number: int, age: int) -> list[_Row]:
        """Return the rows of a term that is `age` control steps old."""
        term = self.specification.observations[number]
        start = age * len(self.observer.columns)
        rows = [
            ({start + self._index[column]: weight for column, weight in weights.items()}, offset)
            for weights, offset in self._columns(term)
        ]
        if term.columns is not None:
            if max(term.columns, default=0) >= len(rows):
                raise SurefootError(f"observation {term.term}: columns are {list(term.columns)}; it has {len(rows)}")
            rows = [rows[column] for column in term.columns]
        scale = np.atleast_1d(term.scale)
        if len(scale) not in (1, len(rows)):
            raise SurefootError(f"observation {term.term}: scale has {len(scale)} numbers; the term has {len(rows)}")
        scales = np.broadcast_to(scale, len(rows))
        return [_Row(*row, term.clip, float(factor), term.clip_after) for row, factor in zip(rows, scales, strict=True)]

    def _columns(self, term: ObservationTerm) -> list[tuple[dict[str, float], float]]:
        """Return for each element of a term the weights of raw columns, and an offset."""
        spec, names = self.specification, self.robot.motor_names
        if term.term in VECTOR_COLUMNS:
            return [({column: 1.0}, 0.0) for column in VECTOR_COLUMNS[term.term]]
        if term.term in ("joint_positions", "joint_speeds"):
            prefix, zero = ("angle", spec.default_pose) if term.term == "joint_positions" else ("speed", None)
            zeros = zero if zero is not None and term.relative else np.zeros(len(names))
            joints = zip(self._motors, self._signs, zeros, strict=True)
            return [({f"{prefix}.{names[motor]}": float(sign)}, -float(middle)) for motor, sign, middle in joints]
        if term.term == "last_action":
            return [({f"memory.{k}": 1.0}, 0.0) for k in range(len(spec.joints))]
        if term.term == "constant":
            return [({}, value) for value in term.values]
        sine, cosine = (f"memory.{self._clock_place(term) + k}" for k in range(2))
        rows = []
        for phase in term.phases:
            angle = 2 * np.pi * (phase + term.start)
            sin, cos = float(np.sin(angle)), float(np.cos(angle))
            # The column `cosine` contains cos - 1.
            rows += [({sine: cos, cosine: sin}, sin), ({sine: -sin, cosine: cos}, cos)]
        return rows

    def _clock_place(self, term: ObservationTerm) -> int:
        number = next(k for k, clock in enumerate(self._clocks) if clock is term)
        return len(self.specification.joints) * self._has_last + 2 * number

    def graph(self, contract: Contract) -> Graph:
        """Return the graph of the policy file."""
        graph, spec = Graph(), self.specification
        raw = Value(INPUT, contract.width)
        hidden, start = [], self._index["memory.0"] + self._hidden_start if self.memory else 0
        for width in self.network.hidden:
            hidden.append(graph.select(raw, range(start, start + width)))
            start += width
        action, after = self.network.add(graph, self._observation(graph, raw), hidden)
        if spec.action_clip is not None:
            action = self._bounded(graph, action, *spec.action_clip)
        scale, offset, to_motors = self.target_map()
        if spec.target_clip is not None:
            joints = graph.linear(action.name, np.diag(scale), offset)
            target = graph.linear(self._bounded(graph, joints, *spec.target_clip).name, to_motors)
        else:
            target = graph.linear(action.name, scale[:, None] * to_motors, offset @ to_motors)
        parts = [target, *([action] if self._has_last else []), *self._next_clocks(graph, raw), *after]
        output = self._bounded(graph, graph.join(parts), contract.low, contract.high)
        graph.nodes[-1].output[0] = OUTPUT
        assert output.width == len(contract.action_names)
        return graph

    def _bounded(self, graph: Graph, value: Value, low: PerJoint, high: PerJoint) -> Value:
        """Clip a value to bounds, either common or per element."""
        ends = (graph.constant(np.broadcast_to(end, (1, value.width))) for end in (low, high))
        return Value(graph.apply("Min", graph.apply("Max", value.name, next(ends)), next(ends)), value.width)

    def _clipped(self, graph: Graph, value: Value, clips: list[Range | None]) -> Value:
        """Clip those elements of a value that have bounds."""
        low, high = np.array([clip or (-MAX_FLOAT, MAX_FLOAT) for clip in clips]).T
        return self._bounded(graph, value, tuple(low), tuple(high))

    def observation_map(self) -> tuple[Array, Array, Array]:
        """Return weights (W, O), offsets (O,) and scales (O,): observation = (raw @ weights + offsets) * scales."""
        rows = self.rows
        weight = np.zeros((self.observer.width * self.task.history, len(rows)))
        for k, row in enumerate(rows):
            for column, factor in row.weights.items():
                weight[column, k] = factor
        return weight, np.array([row.offset for row in rows]), np.array([row.scale for row in rows])

    def target_map(self) -> tuple[Array, Array, Array]:
        """Return scales (J,), offsets (J,) and a matrix (J, M): motor angles = (action * scales + offsets) @ matrix."""
        spec, count = self.specification, len(self.specification.joints)
        offset = np.array(spec.default_pose if spec.action_offset is None else spec.action_offset)
        to_motors = np.zeros((count, count))
        to_motors[np.arange(count), self._motors] = self._signs
        return np.broadcast_to(spec.action_scale, count), offset, to_motors

    def _observation(self, graph: Graph, raw: Value) -> Value:
        """Add nodes that compute the network's observation from the raw observation."""
        rows, (weight, offset, scale) = self.rows, self.observation_map()
        if any(row.clip for row in rows):
            value = self._clipped(graph, graph.linear(raw.name, weight, offset), [row.clip for row in rows])
            value = Value(graph.apply("Mul", value.name, graph.constant(scale[None])), value.width)
        else:
            value = graph.linear(raw.name, weight * scale, offset * scale)
        if any(row.clip_after for row in rows):
            value = self._clipped(graph, value, [row.clip_after for row in rows])
        limit = self.specification.observation_clip
        return value if limit is None else Value(graph.clip(value.name, -limit, limit), value.width)

    def _next_clocks(self, graph: Graph, raw: Value) -> list[Value]:
        """Add nodes that compute the clocks of the next control step."""
        values = []
        for term in self._clocks:
            place = self._index["memory.0"] + self._clock_place(term)
            angle = 2 * np.pi * self.specification.control_step / term.period
            sin, cos = np.sin(angle), np.cos(angle)
            weight = np.zeros((raw.width, 2))
            weight[place : place + 2] = [[cos, -sin], [sin, cos]]
            turned = graph.linear(raw.name, weight, [sin, cos]).name
            # One Newton step for 1 / length: (3 - length^2) / 2.
            factor = graph.linear(graph.apply("Mul", turned, turned), np.full((2, 2), -0.5), [1.5, 1.5]).name
            unit = graph.apply("Mul", turned, factor)
            values.append(Value(graph.apply("Sub", unit, graph.constant([[0.0, 1.0]])), 2))
        return values
