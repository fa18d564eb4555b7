"""Simulated test of an adopted policy: does it stand and follow commands, unchanged or with a change?

All changes are simulated in one batch, with one robot per command. A correction of the specification is applied to the
existing policy file by a linear map before it and another after it: the raw observation is changed so that the file's
network receives the input that the corrected specification would give it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.adopt.builder import NetworkSizes, PolicyBuilder, adopted_specification
from surefoot.adopt.mistakes import Correction
from surefoot.adopt.robot_variants import RobotVariant
from surefoot.adopt.specification import PolicySpecification
from surefoot.adopt.usual_numbers import unusual_numbers
from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Progress, run_to_end
from surefoot.policy.contract import MEMORY, Contract
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.rotations import quat_matrix
from surefoot.task.commands import CommandConfig
from surefoot.task.component import Component
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.state import EnvState
from surefoot.world.registry import find_world

EPISODE_DURATION = 4.0
"""Duration of an episode [s]."""
SETTLING_FRACTION = 0.4
"""Fraction of an episode at its start that is not evaluated."""
MAX_ERROR = np.array([0.5, 0.4, 0.8])
"""Errors of velocity [m/s, m/s] and yaw rate [rad/s] at which the score is 0."""
COMMAND_FRACTIONS = {
    "stand": (0, 0, 0),
    "forward": (0.6, 0, 0),
    "backward": (-0.6, 0, 0),
    "left": (0, 0.75, 0),
    "right": (0, -0.75, 0),
    "turn": (0, 0, 0.75),
    "curve left": (0.5, 0, 0.75),
    "curve right": (0.5, 0, -0.75),
}
"""Commands of an examination, as fractions of the policy's command limits."""
MIN_GOOD_SCORE = 0.4
"""Minimum score of a command that a robot follows."""
UNUSUAL_PENALTY = 0.08
"""Penalty on the likelihood of a specification per unusual number."""
_ROUNDING = 1e-9
"""Absolute value below which a number counts as 0."""


@dataclass(frozen=True)
class TrueVelocity:
    """The policy observes the true velocity of the base instead of the estimate, to show the cost of the estimate."""

    text: str = "with the true speed of the base"


Change = Correction | RobotVariant | TrueVelocity
"""What a trial changes: the specification, the robot, or the source of the base's velocity."""


@dataclass(frozen=True)
class TrialResult:
    """Result of one change in an examination: R robots for each of C commands."""

    change: Change | None
    """The change; None: everything is unchanged."""
    commands: tuple[str, ...]
    """Names of the commands."""
    command: Array
    """Commands (C, 3) [m/s, m/s, rad/s]."""
    motion: Array
    """Mean forward and leftward velocity and yaw rate (R, C, 3); NaN if the robot fell early."""
    upright_fraction: Array
    """Fraction of the episode before the robot fell (R, C); 1: it did not fall."""
    unusual: int = 0
    """Number of unusual numbers in the specification; see `usual_numbers.unusual_numbers`."""

    @property
    def correction(self) -> Correction | None:
        """The change, if it is a change of the specification."""
        return self.change if isinstance(self.change, Correction) else None

    @property
    def text(self) -> str:
        """Description of the change."""
        return "as it is" if self.change is None else self.change.text

    @property
    def velocity(self) -> Array:
        """Mean forward and leftward velocity and yaw rate over robots (C, 3); NaN if one fell early."""
        return np.asarray(self.motion.mean(axis=0))

    @property
    def fell(self) -> NDArray[np.bool_]:
        """Whether a robot fell, for each command (C,)."""
        return np.asarray(self.upright_fraction.min(axis=0) < 1.0 - 1e-6)

    @property
    def falls(self) -> int:
        """Number of robots that fell, over all commands."""
        return int((self.upright_fraction < 1.0 - 1e-6).sum())

    @property
    def errors(self) -> Array:
        """Mean absolute errors of the commands over robots that did not fall (3,) [m/s, m/s, rad/s]."""
        upright = self.upright_fraction >= 1.0 - 1e-6
        if not upright.any():
            return np.full(3, np.nan)
        return np.asarray(np.abs(self.motion - self.command)[upright].mean(axis=0))

    @property
    def scores(self) -> Array:
        """Score of each command (C,), averaged over robots: 0 if the robot fell, 1 if it followed exactly."""
        error = np.linalg.norm((self.motion - self.command) / MAX_ERROR, axis=-1)
        upright = self.upright_fraction >= 1.0 - 1e-6
        scores = np.where(upright, np.maximum(0.0, 1.0 - np.nan_to_num(error, nan=9.0)), 0.0)
        return np.asarray(scores.mean(axis=0))

    @property
    def score(self) -> float:
        """Mean score over commands."""
        return float(self.scores.mean())

    @property
    def likelihood(self) -> float:
        """The score minus a penalty for each unusual number."""
        return self.score - UNUSUAL_PENALTY * self.unusual


def require_specification(contract: Contract) -> PolicySpecification:
    """Return the specification that an adopted policy was built from.

    Raises:
        SurefootError: the policy was not adopted.
    """
    specification = adopted_specification(contract)
    if specification is None:
        raise SurefootError(
            f"policy '{contract.name}' was not adopted; the specification is known only of adopted policies"
        )
    return specification


class CorrectedPolicy:
    """A policy file that behaves as if it had been built from other specifications, one per group of robots.

    Args:
        policy: the policy file.
        robot: robot that it is for.
        specifications: one for each group; groups have equal sizes and consecutive rows.
    """

    def __init__(
        self, policy: PolicyRuntime, robot: RobotDescription, specifications: Sequence[PolicySpecification]
    ) -> None:
        self._policy, contract = policy, policy.contract
        own = self._maker(require_specification(contract), robot, contract)
        self._motors = len(contract.motor_names)
        self._joints = len(own.specification.joints)
        self._has_last = any(term.term == "last_action" for term in own.specification.observations)
        weight, offset, scale = own.observation_map()
        matrix = (weight * scale).T
        self._limits = np.array([contract.low, contract.high])[:, : self._motors]
        inverse = np.linalg.pinv(matrix)
        self._own = own.target_map()
        self.makers = [self._maker(one, robot, contract) for one in specifications]
        self._targets = [maker.target_map() for maker in self.makers]
        self._clips = [one.target_clip for one in specifications]
        self._maps: list[tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]] = []
        for maker in self.makers:
            other, shift, factor = maker.observation_map()
            # Change of the raw observation; columns that the network does not observe stay unchanged.
            change = inverse @ ((other * factor).T - matrix)
            more = inverse @ (shift * factor - offset * scale)
            change[np.abs(change) < _ROUNDING], more[np.abs(more) < _ROUNDING] = 0.0, 0.0
            rows, columns = np.flatnonzero(change.any(axis=1) | (more != 0)), np.flatnonzero(change.any(axis=0))
            self._maps.append((rows, columns, change[np.ix_(rows, columns)].T, more[rows]))

    @staticmethod
    def _maker(specification: PolicySpecification, robot: RobotDescription, contract: Contract) -> PolicyBuilder:
        joints = len(specification.joints)
        hidden = sum(name.startswith(f"{MEMORY}.") for name in contract.action_names)
        hidden -= joints * any(term.term == "last_action" for term in specification.observations)
        hidden -= 2 * sum(term.term == "clock" for term in specification.observations)
        return PolicyBuilder(specification, NetworkSizes(None, joints, (hidden,) if hidden else ()), robot)

    def feedback(self, observation: ArrayLike, going: NDArray[np.bool_] | None = None) -> Array:
        """Return the feedback (N, A) for observations (N, O * history); rows that are not `going` (N,) get 0."""
        inputs = np.array(observation, np.float64)
        size = len(inputs) // len(self._maps)
        rows = np.arange(len(inputs)) if going is None else np.flatnonzero(going)
        ends = np.searchsorted(rows, np.arange(len(self._maps) + 1) * size)
        groups = [rows[first:last] for first, last in pairwise(ends)]
        for group, (changed, columns, change, more) in zip(groups, self._maps, strict=True):
            if len(changed) and len(group):
                inputs[np.ix_(group, changed)] += inputs[np.ix_(group, columns)] @ change + more
        feedback = np.zeros((len(inputs), len(self._policy.contract.action_names)))
        feedback[rows] = self._policy.feedback(np.nan_to_num(inputs[rows], posinf=1e6, neginf=-1e6))
        scale, offset, to_motors = self._own
        if self._has_last:
            actions = feedback[:, self._motors : self._motors + self._joints]
        else:
            actions = (feedback[:, : self._motors] @ to_motors.T - offset) / scale
        for group, (scale, offset, to_motors), clip in zip(groups, self._targets, self._clips, strict=True):
            target = actions[group] * scale + offset
            if clip is not None:
                target = np.clip(target, *clip)
            feedback[group, : self._motors] = np.clip(target @ to_motors, *self._limits)
        return feedback


class _TrueVelocities(Component):
    """Replaces the estimated velocity of the base by the true one for some robots.

    Args:
        chosen: whether to replace it, for each robot (N,).
    """

    def __init__(self, chosen: NDArray[np.bool_]) -> None:
        self._chosen = chosen

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Replace the velocities at the start of an episode."""
        self.publish(state)

    def after_step(self, state: EnvState) -> None:
        """Replace the velocities after a control step."""
        self.publish(state)

    def publish(self, state: EnvState) -> None:
        """Write the true velocities to the state."""
        truth = state.truth
        assert state.base_velocity is not None
        to_base = quat_matrix(truth.base_quat_world).swapaxes(-1, -2)
        velocity = (to_base @ truth.base_velocity_world[..., None])[..., 0]
        state.base_velocity = np.where(self._chosen[:, None], velocity, state.base_velocity)


def examine(
    policy: PolicyRuntime,
    robot: RobotDescription,
    task: TaskConfig,
    tried: Sequence[Change | None],
    world: str = "mujoco",
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
    duration: float | None = None,
    repeats: int = 1,
    chosen: Sequence[str] = tuple(COMMAND_FRACTIONS),
) -> list[TrialResult]:
    """Simulate commands with several changes of an adopted policy's specification or robot in one batch.

    Args:
        policy: an adopted policy.
        robot: robot that it is for.
        task: its task.
        tried: the changes; None: the unchanged policy.
        world: name of the world.
        seed: seed of noise and initial states.
        threads: number of simulation threads; 0: one per core.
        progress: called with the completed fraction.
        duration: duration of an episode [s]; defaults to `EPISODE_DURATION`.
        repeats: number of robots per command.
        chosen: names of the commands, keys of `COMMAND_FRACTIONS`.

    Returns:
        One result per change.
    """
    duration = EPISODE_DURATION if duration is None else duration
    stated = require_specification(policy.contract)
    specifications = [one.specification if isinstance(one, Correction) else stated for one in tried]
    corrected = CorrectedPolicy(policy, robot, specifications)
    limits = policy.contract.commands
    names, asked = _commands(limits, chosen)
    size = repeats * len(names)
    robots = size * len(tried)
    commands = replace(task.commands, each=tuple(map(tuple, asked.tolist()))) if limits else CommandConfig()
    task = replace(task, commands=commands, randomize={}, pushes=replace(task.pushes, enabled=False), max_steps=10**6)
    env = LocomotionEnv(task, robots, find_world(world), seed, autoreset=False, threads=threads)
    nominal = env.world.params
    changed = {
        name: np.repeat([_per_motor(maker, field) for maker in corrected.makers], size, axis=0)
        for name, field in (("servo_kp", "kp"), ("servo_kd", "kd"))
    }
    steps = np.repeat([one.control_step for one in specifications], size)
    params = nominal.with_values(robot, control_step=steps, **changed)
    for k, one in enumerate(tried):
        if isinstance(one, RobotVariant):
            rows = np.arange(k * size, (k + 1) * size)
            own = params.rows(rows)
            params.set_rows(rows, own.with_values(robot, **one.params(own)))
    if any(isinstance(one, TrueVelocity) for one in tried):
        env.components.append(_TrueVelocities(np.repeat([isinstance(one, TrueVelocity) for one in tried], size)))
    env.world.set_params(np.arange(robots), params)
    observation, _ = env.reset()
    sums, times = np.zeros((robots, 3)), np.zeros(robots)

    def act(observation: NDArray[np.float32]) -> Array:
        return env.gait.action(corrected.feedback(observation, ~env.state.over))

    def record(start: Array, seen: NDArray[np.float32]) -> None:
        evaluated = (start >= SETTLING_FRACTION * duration) & (env.state.readings.time > start)
        sums[evaluated] += (env.state.planar_velocity * steps[:, None])[evaluated]
        times[evaluated] += steps[evaluated]

    limit = np.round(duration / steps).astype(np.int64)
    runs = run_to_end(act, env, observation, limit, progress, record)
    with np.errstate(invalid="ignore", divide="ignore"):
        motion = (sums / times[:, None]).reshape(len(tried), repeats, -1, 3)
    upright_fraction = np.where(runs.balanced, 1.0, runs.steps.to_numpy() / limit).reshape(len(tried), repeats, -1)
    return [
        TrialResult(one, names, asked, motion[k], upright_fraction[k], len(unusual_numbers(specifications[k], robot)))
        for k, one in enumerate(tried)
    ]


def run_task(task: TaskConfig, maker: PolicyBuilder, answer: TrialResult) -> TaskConfig:
    """Return the task of an episode in which one robot receives all commands of a trial one after another."""
    each = EPISODE_DURATION / 2
    rows = [(each * k, *row) for k, row in enumerate(answer.command.tolist())]
    step = maker.specification.control_step
    params = {"control_step": step, "servo_kp": maker.per_motor(maker.specification.kp)}
    params["servo_kd"] = maker.per_motor(maker.specification.kd)
    return replace(
        task,
        commands=replace(task.commands, schedule=tuple(rows)),
        randomize={},
        pushes=replace(task.pushes, enabled=False),
        params={**task.params, **params},
        max_steps=max(round(each * len(rows) / step), 1),
    )


def _per_motor(maker: PolicyBuilder, field: str) -> Array:
    """Return a gain of the specification for each motor (M,)."""
    values: Any = maker.per_motor(getattr(maker.specification, field))
    return np.broadcast_to(np.asarray(values, float), maker.robot.num_motors)


def _commands(limits: CommandLimits | None, chosen: Sequence[str]) -> tuple[tuple[str, ...], Array]:
    """Return names and values of the chosen commands that the policy supports; only "stand" if it has no commands."""
    if limits is None:
        return ("stand",), np.zeros((1, 3))
    rows = {}
    for name in chosen:
        fractions = np.array(COMMAND_FRACTIONS[name], float)
        row = np.where(fractions >= 0, fractions * limits.high, -fractions * limits.low)
        if name == "stand" or np.abs(row).max() > 0:
            rows[name] = row
    return tuple(rows), np.array(list(rows.values()))
