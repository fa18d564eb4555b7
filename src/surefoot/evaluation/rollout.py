"""Run a policy in a simulation: measure every episode, and record traces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.evaluation.runs import episode_metrics
from surefoot.robot.params_file import param_values
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.trace import EpisodeTrace
from surefoot.world.interface import SimulationFactory

Progress = Callable[[float], None]
"""Called after every control step with the share of all control steps that is done, 0 to 1."""


class Policy(Protocol):
    """A policy, such as a `PolicyRuntime`."""

    def feedback(self, observation: ArrayLike) -> Array:
        """Return leg-space feedback (N, 2 L) [rad] for observations (N, O * history)."""
        ...


def run_to_end(
    act: Callable[[NDArray[np.float32]], ArrayLike],
    env: LocomotionEnv,
    observation: NDArray[np.float32],
    steps: NDArray[np.int64] | None = None,
    progress: Progress | None = None,
    record: Callable[[Array, NDArray[np.float32]], None] | None = None,
) -> pd.DataFrame:
    """Run every robot of an environment to its own end: a fall, or its number of control steps.

    A robot whose simulation diverged is measured a control step before that; it neither fell nor balanced.

    Args:
        act: returns actions (N, A) for observations (N, O * history), which are zero for robots that are over.
        env: without autoreset, just reset.
        observation: the first one.
        steps: control steps of each robot (N,), 0 for one that does not run; the task's `max_steps`, if not given.
        progress: called with the share of the control steps that is done.
        record: called after every control step with time [s] (N,) and observation (N, O * history) at its start.

    Returns:
        a row a robot with the columns of `episode_metrics`.
    """
    limit = np.full(env.num_envs, env.task.max_steps) if steps is None else steps
    env.over |= limit == 0
    terminated, diverged = np.zeros((2, env.num_envs), np.bool_)
    time, energy = np.zeros((2, env.num_envs))
    position = env.start_position[:, 0].copy()
    while not env.over.all():
        going = ~env.over
        start, seen = env.readings.time, np.where(going[:, None], observation, np.float32(0.0))
        observation, _, ended, _, _ = env.step(act(seen))
        if record is not None:
            record(start, seen)
        sound = going & ~env.truth.diverged
        position[sound], time[sound] = env.truth.base_position_world[sound, 0], env.readings.time[sound]
        energy[sound] += env.truth.energy[sound]
        terminated |= ended
        diverged |= going & ~sound
        env.over |= env.steps >= limit
        if progress is not None:
            progress(float(np.where(env.over, limit, env.steps).sum() / limit.sum()))
    return episode_metrics(
        env.returns.copy(),
        position - env.start_position[:, 0],
        np.where(time > 0, time, np.inf),
        energy,
        env.steps - diverged,
        np.where(~terminated, "time", np.where(diverged, "fault", "fall")),
    )


class EpisodeRecorder:
    """Records every control step of all robots of an environment from now on; `pushed`: forces of pushes too."""

    def __init__(self, env: LocomotionEnv, pushed: bool) -> None:
        self.env, self._pushed, self._start = env, pushed, env.readings.time.copy()
        self.position, self.quat = [env.truth.base_position_world.copy()], [env.truth.base_quat_world.copy()]
        self.steps: list[dict[str, Array]] = []
        self.command = self._command()

    def _command(self) -> Array:
        source, robots = self.env.source, self.env.num_envs
        return np.full((robots, 3), np.nan) if source is None else source.command.copy()

    def record(self, time: Array, observation: NDArray[np.float32]) -> None:
        """Record the control step that just ended; `time` (N,) [s] and `observation` are of its start."""
        env, readings, truth = self.env, self.env.readings, self.env.truth
        self.position.append(truth.base_position_world.copy())
        self.quat.append(truth.base_quat_world.copy())
        self.steps.append(
            {
                "time": readings.time - self._start,
                "roll_pitch_yaw": readings.roll_pitch_yaw,
                "angular_velocity_base": readings.angular_velocity_base,
                "motor_angle": readings.motor_angle,
                "motor_velocity": readings.motor_velocity,
                "motor_torque": truth.motor_torque,
                "observation": observation[:, : env.observer.width].astype(float),
                "feedback": env.feedback.copy(),
                "target": env.target,
                "energy": truth.energy,
                "foot_contact": truth.foot_contact,
                "foot_position_world": env.world.foot_positions(),
                "motor_saturation": truth.motor_saturation,
                "motor_heat": truth.heat,
                "true_motor_angle": truth.motor_angle,
                "command": self.command,
                "reward": env.reward,
                "push_force_world": env.pusher.force.copy() if self._pushed else np.full((env.num_envs, 3), np.nan),
            }
        )
        self.command = self._command()

    def trace(self, robot: int, steps: int, meta: dict[str, Any]) -> EpisodeTrace:
        """Return the trace of a robot's first control steps, with further entries of its meta."""
        if steps < 1:
            raise SurefootError("the simulation diverged in the first control step; no episode can be recorded")
        arrays = {name: np.array([step[name][robot] for step in self.steps[:steps]]) for name in self.steps[0]}
        return EpisodeTrace(
            base_position_world=np.array([row[robot] for row in self.position[: steps + 1]]),
            base_quat_world=np.array([row[robot] for row in self.quat[: steps + 1]]),
            meta=self._meta(robot) | meta,
            robot_archive=self.env.robot.archive,
            **arrays,
        )

    def _meta(self, robot: int) -> dict[str, Any]:
        env, task = self.env, self.env.task
        params = param_values(env.world.params.rows([robot]))
        return {
            "robot": env.robot.name,
            "actuator": task.actuator,
            "leg_names": list(env.robot.leg_names),
            "motor_names": list(env.robot.motor_names),
            "observation_names": list(env.observer.columns),
            **task.return_meta(env.robot),
            "gait_period": env.gait.reference.period,
            "max_steps": task.max_steps,
            "terrain": task.terrain.name,
            "params_source": task.params_source,
            "params": params,
            "control_step": params["control_step"],
        }


def run_episodes(
    policy: Policy,
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
    """Run episodes side by side and record each to its own end: a fall, or `task.max_steps` control steps.

    An episode in which the simulation diverged ends as a fault, one control step before.

    Args:
        policy: gives the feedback.
        task: what is run; its physical parameters and pushes hold.
        episodes: how many.
        make_world: makes the simulation.
        seed: the one seed; episode i is the same in any number of episodes.
        threads: threads of the simulation; 0 means one a core.
        progress: called with the share of the control steps that is done.
        world_name: for the traces.
        policy_name: for the traces.
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
