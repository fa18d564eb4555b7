"""Rollouts of a policy in simulation: metrics of every episode, and recorded traces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.columns import columns_of
from surefoot.errors import SurefootError
from surefoot.evaluation.runs import episode_metrics
from surefoot.robot.params_file import param_values
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.partial_trace import TraceHeader, row_layout
from surefoot.task.trace import EpisodeTrace, run_meta, trace_sizes
from surefoot.world.interface import SimulationFactory

Progress = Callable[[float], None]
"""Called after every control step with the completed fraction of all control steps, 0 to 1."""


class Controller(Protocol):
    """A policy, such as a `PolicyRuntime`."""

    def feedback(self, observation: ArrayLike) -> Array:
        """Return actions (N, A), in the units of the policy's action columns, for observations (N, O * history)."""
        ...


def run_to_end(
    act: Callable[[NDArray[np.float32]], ArrayLike],
    env: LocomotionEnv,
    observation: NDArray[np.float32],
    steps: NDArray[np.int64] | None = None,
    progress: Progress | None = None,
    record: Callable[[Array, NDArray[np.float32]], object] | None = None,
) -> pd.DataFrame:
    """Run one episode of every robot in an environment, to a fall or its number of control steps.

    If a simulation diverges, the robot's metrics end one control step earlier, and it counts neither as fallen nor as
    balanced.

    Args:
        act: returns actions (N, A) for observations (N, O * history), which are zero for finished robots.
        env: an environment without autoreset, after its reset.
        observation: observation of the reset.
        steps: control steps of each robot (N,), 0 for a robot that does not run; defaults to the task's `max_steps`.
        progress: called with the completed fraction of the control steps.
        record: called after every control step with time [s] (N,) and observation (N, O * history) at its start.

    Returns:
        One row per robot with the columns of `episode_metrics`.
    """
    limit = np.full(env.num_envs, env.task.max_steps) if steps is None else steps
    env.state.over |= limit == 0
    terminated, diverged = np.zeros((2, env.num_envs), np.bool_)
    time, energy = np.zeros((2, env.num_envs))
    position = env.state.start_position[:, 0].copy()
    while not env.state.over.all():
        active = ~env.state.over
        start, masked = env.state.readings.time, np.where(active[:, None], observation, np.float32(0.0))
        observation, _, ended, _, _ = env.step(act(masked))
        if record is not None:
            record(start, masked)
        valid = active & ~env.state.truth.diverged
        position[valid], time[valid] = env.state.truth.base_position_world[valid, 0], env.state.readings.time[valid]
        energy[valid] += env.state.truth.energy[valid]
        terminated |= ended
        diverged |= active & ~valid
        env.state.over |= env.state.steps >= limit
        if progress is not None:
            progress(float(np.where(env.state.over, limit, env.state.steps).sum() / limit.sum()))
    return episode_metrics(
        env.state.returns.copy(),
        position - env.state.start_position[:, 0],
        np.where(time > 0, time, np.inf),
        energy,
        env.state.steps - diverged,
        np.where(~terminated, "time", np.where(diverged, "fault", "fall")),
    )


class EpisodeRecorder:
    """Recorder of all robots of an environment from the current control step on.

    Args:
        env: the environment.
        pushed: whether to record push forces; otherwise they are NaN.
    """

    def __init__(self, env: LocomotionEnv, pushed: bool) -> None:
        self.env, self._pushed, self._started = env, pushed, env.state.readings.time.copy()
        sizes = trace_sizes(0, env.state.feedback.shape, self._meta(0))
        # Traces of a simulation need no height map, because they name the terrain, and have no accelerometer.
        names = tuple(name for name in columns_of(EpisodeTrace) if name not in ("accelerometer", "height_map"))
        self.layout = row_layout(names, sizes)
        self.rows: list[Array] = []
        """One array (N, width) per control step."""
        self._start = {name: values.copy() for name, values in self._base().items()}
        self._command = self._newest_command()

    def _base(self) -> dict[str, Array]:
        truth = self.env.state.truth
        return {"base_position_world": truth.base_position_world, "base_quat_world": truth.base_quat_world}

    def _newest_command(self) -> Array:
        has_commands, command = self.env.task.commands.enabled, self.env.state.command
        return command.copy() if has_commands else np.full_like(command, np.nan)

    def record(self, time: Array, observation: NDArray[np.float32]) -> Array:
        """Record the last control step, and return its rows (N, width).

        `time` (N,) [s] and `observation` are the ones at its start.
        """
        env, state = self.env, self.env.state
        readings, truth = state.readings, state.truth
        rows = self.layout.rows(
            {
                **self._base(),
                "time": readings.time - self._started,
                "roll_pitch_yaw": readings.roll_pitch_yaw,
                "angular_velocity_base": readings.angular_velocity_base,
                "motor_angle": readings.motor_angle,
                "motor_velocity": readings.motor_velocity,
                "motor_torque": truth.motor_torque,
                "observation": observation[:, : env.observer.width],
                "feedback": state.feedback,
                "target": state.target,
                "energy": truth.energy,
                "foot_contact": truth.foot_contact,
                "foot_position_world": env.world.foot_positions(),
                "motor_saturation": truth.motor_saturation,
                "motor_heat": truth.heat,
                "true_motor_angle": truth.motor_angle,
                "command": self._command,
                "reward": state.reward,
                "push_force_world": state.push_force if self._pushed else np.full((env.num_envs, 3), np.nan),
            }
        )
        self.rows.append(rows)
        self._command = self._newest_command()
        return rows

    def head(self, robot: int, meta: dict[str, Any]) -> TraceHeader:
        """Return the header of a robot's trace, with additional metadata."""
        start = {name: values[robot] for name, values in self._start.items()}
        return TraceHeader(self.layout, self._meta(robot) | meta, start, self.env.robot.archive)

    def trace(self, robot: int, steps: int, meta: dict[str, Any]) -> EpisodeTrace:
        """Return the trace of a robot's first `steps` control steps, with additional metadata."""
        if steps < 1:
            raise SurefootError("the simulation diverged in the first control step; no episode can be recorded")
        return self.head(robot, meta).trace(np.array([step[robot] for step in self.rows[:steps]]), {})

    def _meta(self, robot: int) -> dict[str, Any]:
        env, task = self.env, self.env.task
        params = param_values(env.world.params.rows([robot]))
        return run_meta(
            env.robot,
            env.observer.columns,
            env.gait.reference.period,
            **task.return_meta(env.robot),
            max_steps=task.max_steps,
            actuator=task.actuator,
            terrain=task.terrain.name,
            params_source=task.params_source,
            params=params,
            control_step=params["control_step"],
        )


def run_episodes(
    policy: Controller,
    task: TaskConfig,
    episodes: int,
    make_world: SimulationFactory,
    seed: int = 0,
    threads: int = 0,
    progress: Progress | None = None,
    *,
    world_name: str = "mujoco",
    policy_name: str = "",
) -> list[EpisodeTrace]:
    """Run episodes in parallel and record each to a fall or `task.max_steps` control steps.

    An episode in which the simulation diverges ends as a fault, one control step earlier.

    Args:
        policy: computes the feedback.
        task: the task, including its physical parameters and pushes.
        episodes: number of episodes.
        make_world: creates the simulation.
        seed: seed of all random numbers; episode i does not depend on the number of episodes.
        threads: threads of the simulation; 0 means one per core.
        progress: called with the completed fraction of the control steps.
        world_name: name of the world in the traces.
        policy_name: name of the policy in the traces.
    """
    env = LocomotionEnv(task, episodes, make_world, seed, autoreset=False, threads=threads)
    observation, _ = env.reset()
    recorder = EpisodeRecorder(env, task.pushes.enabled)

    def act(observation: NDArray[np.float32]) -> Array:
        return env.gait.action(policy.feedback(observation))

    runs = run_to_end(act, env, observation, progress=progress, record=recorder.record)
    ended = np.where(runs.balanced, "time", np.where(runs.fell, "fall", "fault"))
    meta = {"world": world_name, "policy": policy_name, "seed": seed}
    return [
        recorder.trace(i, int(runs.steps[i]), {**meta, "episode": i, "ended": str(ended[i])}) for i in range(episodes)
    ]
