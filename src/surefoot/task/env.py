"""Robots that learn a gait: a batch as a Gymnasium vector environment, or one robot as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import Randomizer
from surefoot.rotations import in_heading_frame
from surefoot.seeding import generators
from surefoot.task.commands import CommandFilter, CommandGenerator, CommandState
from surefoot.task.config import TaskConfig
from surefoot.task.follower import Follower
from surefoot.task.height_scan import AROUND, HeightScanner, scan_heights
from surefoot.task.landings import Landings
from surefoot.task.observation import ObservationInputs, Observer, gait_phase
from surefoot.task.pushes import Pusher
from surefoot.task.reward import Scales, StepMotion, base_height, base_rates, base_tilt, step_reward
from surefoot.task.terrain import TerrainCurriculum
from surefoot.world.ground import FLAT, Ground
from surefoot.world.interface import Readings, Simulation, SimulationFactory, Truth, WorldConfig

__all__ = ["LocomotionEnv", "LocomotionSingleEnv", "SimulationFactory"]

_STRIDE = 0.5
"""Duration of a stride [s] of gaits without a periodic reference."""
Camera = Callable[[Array, Array, Array, Ground], NDArray[np.uint8]]
"""Takes pictures (N, height, width, 3): base positions (N, 3), orientations (N, 4), motor angles (N, M), ground."""


def has_fallen(truth: Truth, angle: float, height: float = 0.0, ground: Ground = FLAT) -> NDArray[np.bool_]:
    """Return whether roll or pitch is beyond `angle` [rad], or the base's origin below `height` [m] if not 0, (N,).

    Heights are over the level of the ground, and angles from those of a base that lies along its course.

    Tan et al. 2018, section IV-C: an episode ends when the base tilts by more than .5 rad; the axis is not stated.
    """
    tilted = np.any(np.abs(base_tilt(truth, ground)) > angle, axis=1)
    return tilted | (base_height(truth.base_position_world, ground) < height) if height else tilted


class LocomotionEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], Any]):
    """A batch of robots on one task.

    Observations (N, O) are raw SI readings. Actions (N, A) in [-1, 1] span the feedback's bounds: each coordinate of
    leg space in turn, of every leg, or every motor's angle; see `HybridGait`. Rewards are the task's, see
    `task.reward`. An episode is terminated by a fall or a diverged simulation, and truncated after `max_steps`. With
    `autoreset`, a robot whose episode is over starts anew in the same step (`AutoresetMode.SAME_STEP`): the
    observation returned is the new episode's first one, and `info` holds `final_obs` and, for every episode
    that ended, its `figures`. Without it, time stands still for a robot whose episode is over, until its reset.

    Args:
        task: its configuration, which must fit its robot.
        num_envs: number of robots.
        make_world: makes the simulation, such as `surefoot.world.registry.find_world` returns.
        seed: seeds every stream of random numbers.
        autoreset: whether robots start anew by themselves.
        threads: threads of the simulation; 0 means one a core.
        source: gives the commands, if the task has any; what the task says, if None.
        camera: takes the pictures of `render`; without it there are none.
        step_info: whether `info` describes every step; see `_step_info`.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": ["rgb_array"]}  # noqa: RUF012
    arrays = ("steps", "returns", "start_position", "feedback", "stride_error", "over", "history")
    """Names of the arrays that change over time."""

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
        self._camera, self._has_step_info = camera, step_info
        self.task, self.num_envs, self.autoreset, self._threads = task, num_envs, autoreset, threads
        self._given_source = source
        self.robot = robot = RobotDescription.load(task.robot)
        self.gait = task.gait(robot)
        self.observer = Observer(robot, task.observations, self.gait.action_names)
        self._scales = Scales.from_robot(robot)
        self._scan_points = AROUND.points(robot)
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
        task, tiles = self.task, self.task.terrain.build(seed)
        config = WorldConfig(
            rest=task.rest or self.gait.rest,
            actuator=task.actuator,
            thermal_protection=task.thermal_protection,
            start_linear_speed=task.start_linear_speed,
            start_angular_speed=task.start_angular_speed,
            ground=tiles.ground,
            threads=self._threads,
        )
        self.curriculum: TerrainCurriculum | None = None
        if tiles.kinds:
            self.curriculum = TerrainCurriculum(task.terrain, tiles, self.num_envs, seed)
        self.heading_streams = generators(seed, "heading", self.num_envs if task.terrain.heading else 0)
        self.ground = config.ground
        self.scanner: HeightScanner | None = None
        if task.sees:
            self.scanner = HeightScanner(task.terrain.scan, self.robot, self.num_envs, seed)
        self.world: Simulation = self._make_world(self.robot, self.num_envs, self.nominal, seed, config)
        self.pusher = Pusher(task.pushes, self.num_envs, seed, self.robot.weight)
        self.randomizer = Randomizer(task.randomize, self.robot, self.nominal, seed, task.randomize_ramp)
        self.source: CommandGenerator | None = None
        self.follower: Follower | None = None
        if limits := task.commands.limits(self.robot):
            self.source = self._given_source or task.commands.make_generator(limits, self.num_envs, seed)
            self.follower = Follower(self.gait.reference, limits, self.robot, self.num_envs)
        self.landings: Landings | None = None
        if "foothold_error" in task.reward:
            if self.follower is None or self.follower.footholds is None:
                raise SurefootError("reward.foothold_error needs footholds, and reference.foothold_radius is 0")
            self.landings = Landings(self.follower.footholds)
        self.over = np.zeros(self.num_envs, np.bool_)
        self.steps = np.zeros(self.num_envs, np.int64)
        self.returns = np.zeros(self.num_envs)
        self.start_position = np.zeros((self.num_envs, 3))
        self.feedback = np.zeros((self.num_envs, len(self.gait.action_names)))
        self.target = np.zeros((self.num_envs, self.robot.num_motors))
        self.reward = np.zeros(self.num_envs)
        self.reward_terms: dict[str, Array] = {}
        self.command_error = np.zeros((self.num_envs, 3))
        self.stride_error = np.zeros((self.num_envs, 3))
        """See `StepMotion.stride_error`."""
        self.readings: Readings = self.world.readings()
        self.truth: Truth = self.world.truth()
        self._begin(np.arange(self.num_envs), np.zeros(self.num_envs, np.bool_))
        self.history = np.tile(self._observe()[:, None], (1, task.history, 1))

    def _begin(self, rows: NDArray[np.int64], fell: NDArray[np.bool_]) -> None:
        """Start new episodes for some robots; `fell` (N,) is how the last ones ended."""
        if self.curriculum is not None or self.heading_streams:
            starts = np.zeros((len(rows), 2)) if self.curriculum is None else self.curriculum.begin(rows, fell[rows])
            self.world.place(rows, starts, self._draw_headings(rows))
        if self.randomizer.enabled:
            self.world.set_params(rows, self.randomizer.draw(rows))
        self.readings = self.world.reset(rows)
        self.over[rows] = False
        self.steps[rows], self.returns[rows], self.feedback[rows], self.stride_error[rows] = 0, 0.0, 0.0, 0.0
        self.truth = self.world.truth()
        self.start_position[rows] = self.truth.base_position_world[rows]
        if self.scanner is not None:
            self.scanner.reset(rows, self.ground, self.truth.base_position_world, self.truth.roll_pitch_yaw[:, 2])
        if self.source is not None and self.follower is not None:
            self.source.reset(rows)
            self.follower.reset(rows, self.readings.roll_pitch_yaw[:, 2])
        if self.landings is not None:
            self.landings.reset(rows)
        if self.task.pushes.enabled:
            self.pusher.reset(rows)
            self.world.push(self.pusher.force)

    def _draw_headings(self, rows: NDArray[np.int64]) -> Array:
        """Return the headings (n,) [rad] that robots start with."""
        limit = np.radians(self.task.terrain.heading)
        return np.array([self.heading_streams[i].uniform(-limit, limit) if limit else 0.0 for i in rows])

    def _observe(self) -> Array:
        return self.observer.observe(self._observation_inputs())

    def _observation_inputs(self) -> ObservationInputs:
        return ObservationInputs(
            self.readings,
            self.gait.reference,
            self.feedback,
            self.command_state,
            self.gait.memory,
            None if self.scanner is None else self.scanner.heights,
        )

    @property
    def commands(self) -> CommandFilter | None:
        """The commands that are followed, of a task with commands."""
        return None if self.follower is None else self.follower.commands

    @property
    def command_state(self) -> CommandState | None:
        """What the gait follows now, of a task with commands."""
        return None if self.follower is None else self.follower.state

    def _observation(self) -> NDArray[np.float32]:
        return self.history.reshape(self.num_envs, -1).astype(np.float32)

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
            self._begin(rows, np.zeros(self.num_envs, np.bool_))
            self.history[rows] = self._observe()[rows, None]
        return self._observation(), {}

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Run one control step of every robot."""
        task, world = self.task, self.world
        if task.pushes.enabled and self.pusher.update(self.readings.time):
            world.push(self.pusher.force)
        last, self.feedback = self.feedback, self.gait.feedback(actions)
        active = ~self.over if self.over.any() else None
        self.target = self.gait.motor_targets(self.readings.time, self.feedback, self.command_state)
        self.readings = world.step(self.target, active)
        before, self.truth = self.truth, world.truth()
        diverged = self.truth.diverged
        motion = self._motion(before, last)
        reward, self.reward_terms = step_reward(task.reward, task.reward_limits, motion)
        if self.scanner is not None:
            self.scanner.update(self.ground, self.truth.base_position_world, self.truth.roll_pitch_yaw[:, 2])
        if self.source is not None and self.follower is not None:
            self.command_error, self.stride_error = motion.command_error, motion.stride_error
            if self.curriculum is not None:
                velocity = motion.command_error[:, :2] + motion.command[:, :2]
                duration = motion.duration * ~(self.over | diverged)
                self.curriculum.record(self.source.command[:, :2], velocity, before.roll_pitch_yaw[:, 2], duration)
            self.source.update(self.readings.time)
            heights = None if self.scanner is None else self.scanner.heights
            step = world.params.control_step
            self.follower.advance(self.source.command, step, self.readings, self.target, heights)
            if self.landings is not None:
                self.landings.plan(self.truth, self.follower.commands.state)
        for part in (reward, self.command_error, self.stride_error, *self.reward_terms.values()):
            part[diverged | self.over] = 0.0
        self.reward = reward
        self.steps += ~self.over
        self.returns += reward
        terminated = (has_fallen(self.truth, task.fall_angle, task.fall_height, self.ground) | diverged) & ~self.over
        truncated = ~terminated & ~self.over & (self.steps >= task.max_steps)
        done = terminated | truncated
        info: dict[str, Any] = self._step_info(before, terminated & ~diverged) if self._has_step_info else {}
        if diverged.any():
            info["diverged"] = diverged.copy()
        if task.history > 1:
            self.history[:, 1:] = self.history[:, :-1].copy()
        self.history[:, 0] = self._observe()
        if done.any():
            rows = np.flatnonzero(done)
            info["figures"] = self._episode_figures(done)
            info["_figures"] = done.copy()
            if not self.autoreset:
                self.over |= done
            else:
                info["final_obs"] = self._observation()
                info["_final_obs"] = done.copy()
                self._begin(rows, terminated)
                self.history[rows] = self._observe()[rows, None]
        return self._observation(), reward, terminated, truncated, info

    def _step_info(self, before: Truth, fell: NDArray[np.bool_]) -> dict[str, Any]:
        """Return what `info` says of the step that just ended, for N robots with M motors.

        `time` of the episode [s] (N,); `reward_terms`, the parts of the reward by name (N,); `velocity` (N, 3), mean
        speeds forward and to the left [m/s] and yaw rate [rad/s]; `torque` [N m] (N, M) at its end; `fell` (N,). With
        commands, the `command` that is followed and the `tracking_error`, velocity less command, (N, 3) each.
        """
        velocity, rates = base_rates(before, self.truth, self.world.params.control_step[:, None])
        info: dict[str, Any] = {
            "time": self.readings.time.copy(),
            "reward_terms": {name: part.copy() for name, part in self.reward_terms.items()},
            "velocity": np.column_stack([velocity[:, :2], rates[:, 2]]),
            "torque": self.truth.motor_torque.copy(),
            "fell": fell.copy(),
        }
        if self.commands is not None:
            info["command"] = self.commands.filtered_command.copy()
            info["tracking_error"] = info["velocity"] - info["command"]
        # Gymnasium's convention: which robots each entry is of.
        return info | {f"_{name}": np.ones(self.num_envs, np.bool_) for name in info}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (height, width, 3) of each robot; None without a camera."""
        if self._camera is None:
            return None
        truth = self.truth
        return tuple(self._camera(truth.base_position_world, truth.base_quat_world, truth.motor_angle, self.ground))

    def _motion(self, before: Truth, last_feedback: Array) -> StepMotion:
        """Return the motion of the control step that just ended, which began with a truth and the feedback before."""
        zero, period = np.zeros((self.num_envs, 3)), self.gait.reference.period
        return StepMotion(
            scales=self._scales,
            duration=self.world.params.control_step,
            before=before,
            after=self.truth,
            start_position=self.start_position,
            ground=self.ground,
            gait=self.gait,
            feedback=self.feedback,
            last_feedback=last_feedback,
            command=zero if self.commands is None else self.commands.filtered_command,
            heading_error=zero[:, 0] if self.commands is None else self.commands.heading_error,
            last_stride_error=self.stride_error,
            stride=_STRIDE if period is None else period,
            foothold_error=zero[:, 0] if self.landings is None else self.landings.judge(self.truth),
        )

    def _episode_figures(self, ended: NDArray[np.bool_]) -> dict[str, Array]:
        """Return the figures of the episodes that just ended; arrays (N,), zero for robots that go on."""
        distance = self.truth.base_position_world[:, 0] - self.start_position[:, 0]
        figures = {"return": self.returns, "steps": self.steps, "distance": distance, "duration": self.readings.time}
        return {name: np.where(ended, values, 0.0) for name, values in figures.items()}

    def privileged(self) -> NDArray[np.float32]:
        """Return what a critic may observe in simulation besides the observation: the true state (N, P).

        Base height [m] and velocity in the world [m/s], roll, pitch and yaw [rad], motor angles [rad] and
        speeds [rad/s], phase of the reference, horizontal force of a push [100 N], and physical parameters that
        were drawn, from -1 to 1 over their range.
        """
        return np.concatenate([values for _, values in self._privileged()], axis=1).astype(np.float32)

    @property
    def privileged_columns(self) -> list[str]:
        """Names of the numbers of `privileged`, in order."""
        return [name for names, _ in self._privileged() for name in names]

    def _privileged(self) -> list[tuple[list[str], Array]]:
        """Return the parts of the true state: names and numbers (N, width)."""
        truth, motors, period = self.truth, self.robot.motor_names, self.gait.reference.period
        velocity = truth.base_velocity_world
        if self.commands is not None:
            velocity = in_heading_frame(velocity, truth.roll_pitch_yaw[:, 2])
        parts = [
            (["height"], base_height(truth.base_position_world, self.ground)[:, None]),
            (["velocity_x", "velocity_y", "velocity_z"], velocity),
            (["roll", "pitch", "yaw"], truth.roll_pitch_yaw),
            ([f"angle.{motor}" for motor in motors], truth.motor_angle),
            ([f"speed.{motor}" for motor in motors], truth.motor_velocity),
        ]
        if not self.task.terrain.is_flat:
            scan = scan_heights(self.ground, self._scan_points, truth.base_position_world, truth.roll_pitch_yaw[:, 2])
            parts.append((AROUND.columns(), scan))
        if self.commands is not None:
            parts.append((["heading_error"], self.commands.heading_error[:, None]))
        if period is not None:
            parts.append((["phase_sin", "phase_cos"], gait_phase(self._observation_inputs())))
        if self.task.pushes.enabled:
            parts.append((["push_x", "push_y"], self.pusher.force[:, :2] / 100.0))
        if self.randomizer.enabled:
            parts.append((self.randomizer.columns, self.randomizer.scaled(self.world.params)))
        return parts

    def get_state(self) -> dict[str, Any]:
        """Return the whole state of the environment, for an exact resume."""
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        streams = {name: [one.bit_generator.state for one in streams] for name, streams in self._streams().items()}
        return {"world": self.world.get_state(), **arrays, **streams}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, exactly."""
        self.world.set_state(state["world"])
        self.readings, self.truth = self.world.readings(), self.world.truth()
        for name, array in self._arrays().items():
            array[:] = state[name]
        for name, streams in self._streams().items():
            for stream, saved in zip(streams, state[name], strict=True):
                stream.bit_generator.state = saved

    def _arrays(self) -> dict[str, NDArray[Any]]:
        owners: dict[str, Any] = {"": self, "pushes_": self.pusher, "randomizer_": self.randomizer}
        owners |= {"source_": self.source, "terrain_": self.curriculum, "scan_": self.scanner}
        owners |= {"landings_": self.landings}
        followed = {} if self.follower is None else self.follower.arrays
        return followed | {
            f"{prefix}{name}": getattr(owner, name)
            for prefix, owner in owners.items()
            if owner is not None
            for name in owner.arrays
        }

    def _streams(self) -> dict[str, list[np.random.Generator]]:
        drawn = {} if self.source is None else {"command_streams": self.source.streams}
        if self.heading_streams:
            drawn["heading_streams"] = self.heading_streams
        if self.curriculum is not None:
            drawn["terrain_streams"] = self.curriculum.streams
        if self.scanner is not None:
            drawn["scan_streams"] = self.scanner.streams
        return {"push_streams": self.pusher.streams, "randomize_streams": self.randomizer.streams, **drawn}


class LocomotionSingleEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One robot on one task, for learners without support of vector environments: a batch of one.

    Observations (O,), actions (A,), rewards and arguments are `LocomotionEnv`'s; without a seed any is taken. `info`
    describes every step, with what a batch has in arrays; at the end of an episode it holds its `figures`.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self, task: TaskConfig, make_world: SimulationFactory, seed: int | None = None, camera: Camera | None = None
    ) -> None:
        first = int(self.np_random.integers(2**31)) if seed is None else seed
        self.batch = LocomotionEnv(
            task, 1, make_world, first, autoreset=False, threads=1, camera=camera, step_info=True
        )
        self.render_mode = self.batch.render_mode
        self.metadata = {**self.metadata, "render_fps": self.batch.metadata["render_fps"]}
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; with a seed, every stream of random numbers too."""
        super().reset(seed=seed)
        observation, _ = self.batch.reset(seed=seed)
        return observation[0], {}

    def step(self, action: ArrayLike) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Run one control step."""
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        # The figures are not under the key `episode`, which belongs to Gymnasium's own wrapper.
        single: dict[str, Any] = _first({name: part for name, part in info.items() if not name.startswith("_")})
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), single

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override, unused-ignore]
        """Return a picture (height, width, 3); None without a camera."""
        pictures = self.batch.render()
        return None if pictures is None else pictures[0]


def _first(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a batch's information says of its first robot: arrays of a row, numbers and flags."""
    return {
        name: _first(part) if isinstance(part, Mapping) else part[0] if part.ndim > 1 else part[0].item()
        for name, part in info.items()
    }


def find_batch(env: Any) -> LocomotionEnv:
    """Return the batch of robots inside an environment: of Gymnasium or Stable-Baselines3, wrapped or not.

    Raises:
        SurefootError: an environment of another package, or one in another process.
    """
    inner = env
    while inner is not None and not isinstance(inner, LocomotionEnv):
        if isinstance(inner, LocomotionSingleEnv):
            inner = inner.batch
        elif isinstance(several := getattr(inner, "envs", None), list | tuple):
            inner = several[0]
        else:
            inner = next((part for name in ("venv", "env") if (part := getattr(inner, name, None)) is not None), None)
    if inner is None:
        raise SurefootError(f"env is a {type(env).__name__}; it must be an environment of surefoot, in this process")
    return inner
