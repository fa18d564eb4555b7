"""Locomotion environment: a Gymnasium vector environment of robots with one task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandGenerator
from surefoot.task.component import Component
from surefoot.task.components import Setup, make_components
from surefoot.task.config import TaskConfig
from surefoot.task.observation import Observer
from surefoot.task.reward import step_reward
from surefoot.task.state import EnvState
from surefoot.task.terminations import end_episodes
from surefoot.world.ground import Ground
from surefoot.world.interface import Simulation, SimulationFactory, WorldConfig

__all__ = ["Camera", "LocomotionEnv", "SimulationFactory"]

Camera = Callable[[Array, Array, Array, Ground], NDArray[np.uint8]]
"""Function that renders images (N, height, width, 3) from base positions (N, 3), orientations (N, 4), motor angles (N,
M) and the ground."""
Kind = TypeVar("Kind", bound=Component)


class LocomotionEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], Any]):
    """A batch of robots with one task.

    Observations (N, O) are raw sensor readings in SI units. Actions (N, A) in [-1, 1] span the bounds of the feedback:
    coordinate by coordinate of leg space for all legs, or one per motor; see `HybridGait`. Rewards are the weighted
    terms of the task, see `task.reward`. An episode is terminated by a fall or a diverged simulation, and truncated
    after `max_steps`; see `task.terminations`.

    With `autoreset`, a robot whose episode ended is reset in the same step (`AutoresetMode.SAME_STEP`): `step` returns
    the first observation of the new episode, and `info` holds `final_obs` and the metrics of all episodes that ended
    (`figures`). Without it, the robot is frozen until its reset.

    Optional capabilities (commands, pushes, terrain, randomization) are components, see `task.components`.

    Args:
        task: configuration of the task.
        num_envs: number of robots.
        make_world: factory of the simulation, for example from `surefoot.world.registry.find_world`.
        seed: seed of all random streams.
        autoreset: whether robots are reset when their episodes end.
        threads: threads of the simulation; 0 means one per core.
        source: command generator. Defaults to the one that the task configures.
        camera: renderer for `render`, which otherwise returns None.
        step_info: whether `info` describes every step; see `StepInfo`.

    Raises:
        SurefootError: a task that does not fit its robot.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        task: TaskConfig,
        num_envs: int,
        make_world: SimulationFactory,
        seed: int = 0,
        autoreset: bool = True,
        threads: int = 0,
        source: CommandGenerator | None = None,
        camera: Camera | None = None,
        step_info: bool = False,
    ) -> None:
        self.render_mode = None if camera is None else "rgb_array"
        self._camera, self._source, self._step_info = camera, source, step_info
        self.task, self.num_envs, self.autoreset, self._threads = task, num_envs, autoreset, threads
        self.robot = robot = RobotDescription.load(task.robot)
        self.gait = task.gait(robot)
        self.observer = Observer(robot, task.observations, self.gait.action_names)
        self.nominal = task.nominal(robot).rows(np.zeros(max(num_envs, 1), np.int64))
        self._make_world = make_world
        self._make(seed)
        self.metadata = {**self.metadata, "render_fps": round(1 / float(self.nominal.control_step[0]))}
        width = self.observer.width * task.history
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(self.gait.action_names),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _make(self, seed: int) -> None:
        """Create components, world and state, and start all robots."""
        task, tiles = self.task, self.task.terrain.build(seed)
        self.components = make_components(
            Setup(task, self.robot, self.gait, self.nominal, tiles, self.num_envs, seed, self._source, self._step_info)
        )
        config = WorldConfig(
            rest=task.rest or self.gait.rest,
            actuator=task.actuator,
            thermal_protection=task.thermal_protection,
            start_linear_speed=task.start_linear_speed,
            start_angular_speed=task.start_angular_speed,
            physics_step=task.physics_step,
            torque_readings=task.needs_base_velocity,
            ground=tiles.ground,
            threads=self._threads,
        )
        self.world: Simulation = self._make_world(self.robot, self.num_envs, self.nominal, seed, config)
        self.state = EnvState.of_world(self.world, self.gait, tiles.ground)
        self.history = np.zeros((self.num_envs, task.history, self.observer.width))
        self._start(np.arange(self.num_envs))

    def component(self, kind: type[Kind]) -> Kind:
        """Return the component of a class, which the task must have."""
        return next(component for component in self.components if isinstance(component, kind))

    def _start(self, rows: NDArray[np.int64]) -> None:
        """Start new episodes of some robots."""
        for component in self.components:
            component.before_reset(rows, self.state)
        self.state.begin_episodes(rows, self.world.reset(rows))
        for component in self.components:
            component.reset(rows, self.state)
        self.history[rows] = self.observer.observe(self.state)[rows, None]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Reset all robots and return their observations; a seed also restarts all random streams.

        `options={"reset_mask": (N,) bool}` resets only some robots.
        """
        rows = np.arange(self.num_envs)
        if options and "reset_mask" in options:
            rows = np.flatnonzero(options["reset_mask"])
        if seed is not None:
            self._make(seed)
        else:
            # Without autoreset, robots that fell are still over, and the terrain's curriculum wants to know it.
            self.state.terminated = self.state.terminated & self.state.over
            self._start(rows)
            self.state.terminated = np.zeros(self.num_envs, np.bool_)
        return self._observation(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Apply actions (N, A) for one control step; return observation, reward, terminated, truncated and info."""
        state, task = self.state, self.task
        for component in self.components:
            component.before_step(state)
        feedback = self.gait.feedback(actions)
        target = self.gait.motor_targets(state.readings.time, feedback, state.gait_state)
        active = ~state.over if state.over.any() else None
        state.finish_step(target, feedback, self.world.step(target, active))
        for component in self.components:
            component.measure(state)
        state.reward, state.reward_terms = step_reward(task.reward, task.reward_limits, state)
        for part in (state.reward, *state.reward_terms.values()):
            part[state.idle] = 0.0
        for component in self.components:
            component.after_step(state)
        end_episodes(state, task)
        info = {name: entry for component in self.components for name, entry in component.info(state).items()}
        self.history[:, 1:] = self.history[:, :-1].copy()
        self.history[:, 0] = self.observer.observe(state)
        reward, terminated, truncated = state.reward, state.terminated, state.truncated
        if state.done.any():
            if self.autoreset:
                info |= {"final_obs": self._observation(), "_final_obs": state.done}
                self._start(np.flatnonzero(state.done))
            else:
                state.over |= state.done
        return self._observation(), reward, terminated, truncated, info

    def _observation(self) -> NDArray[np.float32]:
        return self.history.reshape(self.num_envs, -1).astype(np.float32)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return an image (height, width, 3) of each robot, or None without a camera."""
        if self._camera is None:
            return None
        truth = self.state.truth
        images = self._camera(truth.base_position_world, truth.base_quat_world, truth.motor_angle, self.state.ground)
        return tuple(images)

    def _privileged(self) -> list[tuple[list[str], Array]]:
        return [part for component in self.components for part in component.privileged(self.state)]

    def privileged(self) -> NDArray[np.float32]:
        """Return the privileged observations (N, P), which a critic may receive in simulation.

        They are the true state of the base [m, m/s, rad] and the motors [rad, rad/s], and observations of components:
        heights of the ground, heading error, phase of the reference, pushes [100 N], and randomized physical
        parameters, scaled to -1 to 1 over their ranges.
        """
        return np.concatenate([values for _, values in self._privileged()], axis=1).astype(np.float32)

    @property
    def privileged_columns(self) -> list[str]:
        """Names of the columns of `privileged`, in order."""
        return [name for names, _ in self._privileged() for name in names]

    def metrics(self) -> dict[str, Any]:
        """Return metrics of components for the training log, by name."""
        return {name: value for component in self.components for name, value in component.metrics().items()}

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the environment, for an exact resume."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        streams = {name: [stream.bit_generator.state for stream in group] for name, group in self._streams().items()}
        return {"world": self.world.get_state(), **arrays, **streams}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `get_state`, to continue exactly from there."""
        self.world.set_state(state["world"])
        self.state.observe_world(self.world.readings())
        for name, array in self._arrays().items():
            array[:] = state[name]
        for name, streams in self._streams().items():
            for stream, saved in zip(streams, state[name], strict=True):
                stream.bit_generator.state = saved
        for component in self.components:
            component.publish(self.state)

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays that change over time, by name."""
        parts = [self.state.arrays(), *(component.arrays() for component in self.components)]
        return {"history": self.history, **{name: array for part in parts for name, array in part.items()}}

    def _streams(self) -> dict[str, list[np.random.Generator]]:
        return {name: streams for component in self.components for name, streams in component.streams.items()}
