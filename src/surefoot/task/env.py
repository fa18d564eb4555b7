"""Locomotion environments: a batch of robots on one task, as a Gymnasium vector environment."""

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
"""Takes pictures (N, height, width, 3): base positions (N, 3), orientations (N, 4), motor angles (N, M), ground."""
Kind = TypeVar("Kind", bound=Component)


class LocomotionEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], Any]):
    """A batch of robots on one task.

    Observations (N, O) are raw SI readings. Actions (N, A) in [-1, 1] span the feedback's bounds: each coordinate of
    leg space in turn, of every leg, or every motor's angle; see `HybridGait`. Rewards are the task's, see
    `task.reward`. An episode is terminated by a fall or a diverged simulation, and truncated after `max_steps`, see
    `task.terminations`. With `autoreset`, a robot whose episode is over starts anew in the same step
    (`AutoresetMode.SAME_STEP`): the observation returned is the new episode's first one, and `info` holds `final_obs`
    and, for every episode that ended, its `figures`. Without it, time stands still for a robot whose episode is over,
    until its reset.

    What a task can do besides is in its components, see `task.components`.

    Args:
        task: its configuration, which must fit its robot.
        num_envs: number of robots.
        make_world: makes the simulation, such as `surefoot.world.registry.find_world` returns.
        seed: seeds every stream of random numbers.
        autoreset: whether robots start anew by themselves.
        threads: threads of the simulation; 0 means one a core.
        source: command generator; defaults to the one that the task configures.
        camera: takes the pictures of `render`; without it there are none.
        step_info: whether `info` describes every step; see `StepInfo`.
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
        """Make components, world and state, and start all robots."""
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
            ground=tiles.ground,
            threads=self._threads,
        )
        self.world: Simulation = self._make_world(self.robot, self.num_envs, self.nominal, seed, config)
        self.state = EnvState.of_world(self.world, self.gait, tiles.ground)
        self.history = np.zeros((self.num_envs, task.history, self.observer.width))
        self._start(np.arange(self.num_envs))

    def component(self, kind: type[Kind]) -> Kind:
        """Return the component of a kind; the task must have that capability."""
        return next(one for one in self.components if isinstance(one, kind))

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
        """Start all robots anew; with a seed, every stream of random numbers too.

        `options={"reset_mask": (N,) bool}` resets only some of them.
        """
        rows = np.arange(self.num_envs)
        if options and "reset_mask" in options:
            rows = np.flatnonzero(options["reset_mask"])
        if seed is not None:
            self._make(seed)
        else:
            self.state.terminated = np.zeros(self.num_envs, np.bool_)
            self._start(rows)
        return self._observation(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Run one control step of every robot."""
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
        """Return a picture (height, width, 3) of each robot; None without a camera."""
        if self._camera is None:
            return None
        truth = self.state.truth
        pictures = self._camera(truth.base_position_world, truth.base_quat_world, truth.motor_angle, self.state.ground)
        return tuple(pictures)

    def _privileged(self) -> list[tuple[list[str], Array]]:
        return [part for component in self.components for part in component.privileged(self.state)]

    def privileged(self) -> NDArray[np.float32]:
        """Return what a critic may observe in simulation in addition to the observation (N, P).

        The true state of the base [m, m/s, rad] and the motors [rad, rad/s], and what components add: heights of the
        ground, heading error, phase of the reference, pushes [100 N], and physical parameters that were drawn, from -1
        to 1 over their ranges.
        """
        return np.concatenate([values for _, values in self._privileged()], axis=1).astype(np.float32)

    @property
    def privileged_columns(self) -> list[str]:
        """Names of the numbers of `privileged`, in order."""
        return [name for names, _ in self._privileged() for name in names]

    def metrics(self) -> dict[str, Any]:
        """Return what components have for the log of a training, by name."""
        return {name: value for component in self.components for name, value in component.metrics().items()}

    def get_state(self) -> dict[str, Any]:
        """Return the whole state of the environment, for an exact resume."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        streams = {name: [one.bit_generator.state for one in streams] for name, streams in self._streams().items()}
        return {"world": self.world.get_state(), **arrays, **streams}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, exactly."""
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
