"""`SimWorld`: simulation of a batch of robots with a physics engine, actuators, delays and sensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.seeding import generators
from surefoot.world.actuation import (
    SHARED_ARRAYS,
    new_actuation,
    read_delayed,
    read_imu,
    read_torque,
    record_sample,
    set_actuation_params,
)
from surefoot.world.engine import EngineFactory, Index
from surefoot.world.interface import SensorReadings, SimState, WorldConfig
from surefoot.world.registry import DEFAULT_WORLD, check_modelled, find_engine

SETTLE_TIME = 0.5
"""Time [s] for which a robot settles before an episode, as in the paper robot's published environment."""
_NOISE_BLOCK = 256
_RESET_ARRAYS = (
    *("ticks", "duty", "torque", "motor_torque", "energy", "heat", "overheated_time", "switched_off", "contact_ticks"),
    *("limit_ticks", "filtered_speed", "friction_stretch"),
)

_SUMMED_ARRAYS = ("energy", "heat", "contact_ticks", "limit_ticks")
"""Quantities that are summed over the servo steps of a control step."""


def check_batch(num_envs: int, params: PhysicalParams | None) -> None:
    """Raise a `SurefootError` for a world without robots, or parameters of another number of robots."""
    if num_envs < 1:
        raise SurefootError(f"num_envs is {num_envs}; a world needs 1 robot or more")
    if params is not None and params.num_envs != num_envs:
        raise SurefootError(f"params are for {params.num_envs} robots; the world has {num_envs}")


class SimWorld:
    """A batch of simulated robots, each with its own physical parameters, clock and control step.

    Args:
        robot: the robot.
        num_envs: number of robots.
        params: physical parameters, one row per robot. Defaults to nominal values.
        seed: seed of sensor noise and initial velocities, with one random stream per robot.
        config: configuration of the world.
        engine: name of a world in the registry, whose engine is used.
        first: index of the first robot if several worlds share a batch. Robot k uses the random streams of robot
            `first` + k.

    Raises:
        SurefootError: no robots, or parameters for another number of robots or outside the allowed bounds.
    """

    def __init__(
        self,
        robot: RobotDescription,
        num_envs: int,
        params: PhysicalParams | None = None,
        seed: int = 0,
        config: WorldConfig | None = None,
        engine: str = DEFAULT_WORLD,
        first: int = 0,
    ) -> None:
        check_batch(num_envs, params)
        self.num_envs, self.config = num_envs, config or WorldConfig()
        if self.config.physics_step:
            from surefoot.world.physics_step import with_physics_step  # imports MuJoCo

            robot = with_physics_step(robot, self.config.physics_step)
        self.robot = robot
        longest = max(robot.allowed["control_latency"][1], robot.allowed["servo_latency"][1])
        self._history = int(np.ceil(longest / robot.timing.servo_step)) + 2
        self.actuation = new_actuation(robot, num_envs, self._history, self.config)
        self._engine_name, make_engine = engine, find_engine(engine)
        self.engine = make_engine(robot, self.actuation, self.config)
        self.params = PhysicalParams.nominal(robot, num_envs)
        self.resting_angles = robot.pose_angles(*(self.config.rest or robot.rest))
        # Static penetration of nominal feet [m]: weight per foot over contact stiffness.
        self._weight = self.engine.gravity * robot.urdf.total_mass / len(robot.legs)
        self._nominal_depth = self._weight / robot.contact.stiffness
        self._settled_state, self._settled_torque = self._settle(make_engine)
        self._imu_streams = generators(seed, "imu noise", first + num_envs)[first:]
        self._start_streams = generators(seed, "start", first + num_envs)[first:]
        self._noise = np.zeros((num_envs, _NOISE_BLOCK, 2))
        self._control_steps = np.zeros(num_envs, np.int64)
        self._diverged = np.zeros(num_envs, np.bool_)
        self.divergences = 0
        self._starts, self._headings = np.zeros((num_envs, 3)), np.zeros(num_envs)
        if params is not None:
            self.set_params(np.arange(num_envs), params)
        self.reset()

    def _settle(self, make_engine: EngineFactory) -> tuple[Array, Array]:
        """Return the engine state and motor torques (M,) of one nominal robot that has settled in its resting pose."""
        config = replace(self.config, thermal_protection=False, threads=1)
        actuation = new_actuation(self.robot, 1, self._history, config)
        single = make_engine(self.robot, actuation, config)
        actuation.target[:] = self.resting_angles
        only = np.zeros(1, np.int64)
        single.set_state(only, single.initial_state)
        single.observe(only)
        record_sample(actuation, 0)
        single.advance(np.array([round(SETTLE_TIME / self.robot.timing.servo_step)]))
        if single.diverged[0]:
            raise SurefootError(
                f"{self.robot.name}: the robot does not settle at its resting pose; check its description"
            )
        return single.get_state(only)[0], actuation.motor_torque[0].copy()

    def reset(self, index: ArrayLike | None = None) -> SensorReadings:
        """Reset robots to the settled resting pose with a new history; return the readings of all robots."""
        rows = np.arange(self.num_envs) if index is None else np.atleast_1d(np.asarray(index, np.int64))
        self._reset(rows)
        self._diverged[rows] = False
        return self.readings()

    def _reset(self, rows: Index) -> None:
        actuation, config = self.actuation, self.config
        for name in _RESET_ARRAYS:
            getattr(actuation, name)[rows] = 0
        actuation.target[rows] = self.resting_angles
        self._control_steps[rows] = 0
        self._draw_noise(rows)
        self.engine.set_state(rows, self._settled_state)
        turned = rows[self._headings[rows] != 0.0]
        self.engine.rotate(turned, self._headings[turned])
        offset = self._starts[rows]
        offset[:, 2] += self._nominal_depth - self._weight / self.params.contact_stiffness[rows]
        moved = offset.any(axis=1)
        self.engine.move_base(rows[moved], offset[moved])
        if config.start_linear_speed or config.start_angular_speed:
            draw = np.array([self._start_streams[i].uniform(-1, 1, 6) for i in rows]).reshape(-1, 6)
            speeds = config.start_linear_speed * draw[:, :3], config.start_angular_speed * draw[:, 3:]
            self.engine.set_base_velocity(rows, *speeds)
        self._record_start(rows)

    def _record_start(self, rows: Index) -> None:
        """Start the histories of robots that were reset with their present state."""
        self.engine.observe(rows)
        for i in rows:
            record_sample(self.actuation, i)
        # Motors have no torque before their first step; the robots stand, so their sensors measure one.
        self.actuation.torque_history[rows, :1] = self._settled_torque

    def place_motors(self, angle: Array, velocity: Array) -> None:
        """Set the initial state to measured motor angles [rad] and speeds [rad/s] (N, M).

        For robots without closed loops. Call it right after a reset: the history then starts with these readings.
        """
        rows = np.arange(self.num_envs)
        self.engine.set_motors(rows, angle - self.actuation.motor_offset, velocity)
        self.actuation.filtered_speed[:] = velocity
        self._record_start(rows)

    def step(self, target: ArrayLike, active: NDArray[np.bool_] | None = None) -> SensorReadings:
        """Hold motor angles (N, M) [rad] for one control step of each robot; return the readings at its end.

        With `active` (N,), all other robots are frozen and take no computing time.

        A control step that is not a multiple of the servo step is correct on average: the k-th control step ends at the
        servo step closest to k times the control step. A robot that diverges, or receives angles that are not finite,
        is reset to its resting pose, counted in `divergences` and marked in `truth().diverged`.
        """
        if active is None:
            self.actuation.target[...] = target
        else:
            np.copyto(self.actuation.target, target, where=active[:, None])
        before = self._last_servo_steps(self._control_steps)
        self._control_steps += 1 if active is None else active
        due = self._control_steps % _NOISE_BLOCK == 0
        if due.any():
            self._draw_noise(np.flatnonzero(due if active is None else due & active))
        finite = np.isfinite(self.actuation.target)
        if not finite.all():
            self.engine.diverged |= ~finite.all(axis=1)
        servo_steps = (self._last_servo_steps(self._control_steps) - before).astype(np.int64)
        # Nothing happens in a control step without a servo step.
        idle = servo_steps == 0 if active is None else (servo_steps == 0) & active
        for name in _SUMMED_ARRAYS if idle.any() else ():
            getattr(self.actuation, name)[idle] = 0.0
        self.engine.advance(servo_steps)
        self._diverged = self.engine.diverged.copy()
        if self._diverged.any():
            rows = np.flatnonzero(self._diverged)
            self.divergences += len(rows)
            self._reset(rows)
        return self.readings()

    def _last_servo_steps(self, control_steps: Index) -> Array:
        """Return the servo step with which each robot's control step of a number ends (N,)."""
        return np.asarray(np.round(control_steps * (self.params.control_step / self.robot.timing.servo_step)))

    def readings(self) -> SensorReadings:
        """Return the readings at the control computer: `control_latency` old, with bias and noise on roll and pitch."""
        motors = self.robot.num_motors
        out = np.empty_like(self.actuation.sample)
        read_delayed(self.actuation, self.params.control_latency, out)
        angles, rates = out[:, 2 * motors : 2 * motors + 3], out[:, 2 * motors + 3 :]
        time = np.asarray(self.actuation.ticks * self.robot.timing.servo_step, np.float64)
        read_imu(angles, rates, time, self.params)
        if self.params.imu_noise.any():
            noise = self._noise[np.arange(self.num_envs), self._control_steps % _NOISE_BLOCK]
            angles[:, :2] += noise * self.params.imu_noise[:, None]
        torque = None
        if self.config.torque_readings:
            torque = np.empty_like(self.actuation.motor_torque)
            read_torque(self.actuation, self.params.control_latency, torque)
        return SensorReadings(
            time=time,
            roll_pitch_yaw=angles,
            angular_velocity_base=rates,
            motor_angle=out[:, :motors],
            motor_velocity=out[:, motors : 2 * motors],
            motor_torque=torque,
        )

    def _draw_noise(self, rows: Index) -> None:
        """Draw the next block of standard normal numbers for robots with IMU noise."""
        for i in rows[self.params.imu_noise[rows] > 0]:
            self._noise[i] = self._imu_streams[i].standard_normal((_NOISE_BLOCK, 2))

    def truth(self) -> SimState:
        """Return the true state, with energy, heat and contacts over the last control step."""
        base, motors = self.engine.base(), self.robot.num_motors
        now = self.actuation.sample
        count = self._control_steps
        ticks = np.maximum(self._last_servo_steps(count) - self._last_servo_steps(count - 1), 1)
        return SimState(
            base_position_world=base[:, :3],
            base_quat_world=base[:, 3:7],
            base_velocity_world=base[:, 7:],
            roll_pitch_yaw=now[:, 2 * motors : 2 * motors + 3].copy(),
            motor_angle=now[:, :motors] - self.actuation.motor_offset,
            motor_velocity=now[:, motors : 2 * motors].copy(),
            motor_torque=self.actuation.motor_torque.copy(),
            energy=self.actuation.energy.copy(),
            heat=self.actuation.heat.copy(),
            foot_contact=np.minimum(self.actuation.contact_ticks / ticks[:, None], 1.0),
            motor_saturation=np.minimum(self.actuation.limit_ticks / ticks[:, None], 1.0),
            diverged=self._diverged.copy(),
        )

    def foot_positions(self) -> Array:
        """Return the centres of the spherical feet in the world frame (N, L, 3) [m]."""
        return self.engine.foot_positions()

    def set_params(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Set the physical parameters of the robots at `index`, one row per robot. A reset should follow.

        Raises:
            SurefootError: a value outside the bounds of the robot's description, or a parameter that the engine does
                not model. In this case, no robot is changed.
        """
        rows = np.atleast_1d(np.asarray(index, np.int64))
        params.check(self.robot)
        check_modelled(self._engine_name, params)
        self.engine.set_params(rows, params)
        self.params.set_rows(rows, params)
        set_actuation_params(self.actuation, rows, params)

    def place(self, index: ArrayLike, starts: Array, headings: Array) -> None:
        """Set the positions (n, 2) [m] and headings (n,) [rad] at which robots start after their next reset.

        The ground there must be as level as at (0, 0), where the robot has settled.
        """
        rows, ground = np.atleast_1d(np.asarray(index, np.int64)), self.config.ground
        self._starts[rows, :2], self._headings[rows] = starts, headings
        self._starts[rows, 2] = ground.height(np.asarray(starts, float)) - ground.height(np.zeros(2))

    def push(self, force_world: ArrayLike) -> None:
        """Set the force (N, 3) [N] on each base's centre of mass in the world frame, until the next call."""
        self.engine.set_force(np.asarray(force_world, float))

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the world."""
        return {
            "engine": self.engine.get_state(np.arange(self.num_envs)),
            "actuation": {name: array.copy() for name, array in self._actuation_arrays().items()},
            "params": {name: getattr(self.params, name).copy() for name in PhysicalParams.names()},
            "control_steps": self._control_steps.copy(),
            "noise": self._noise.copy(),
            "streams": [stream.bit_generator.state for stream in self._imu_streams + self._start_streams],
            "diverged": self._diverged.copy(),
            "divergences": self.divergences,
            "starts": self._starts.copy(),
            "headings": self._headings.copy(),
        }

    def _actuation_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the actuation that change, by name, without those that this world does not use."""
        arrays = self.actuation._asdict().items()
        return {name: array for name, array in arrays if array.size and name not in SHARED_ARRAYS}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `get_state`, to continue exactly from there."""
        # Checkpoints of earlier versions lack parameters that were added later, whose values are still nominal.
        self.set_params(np.arange(self.num_envs), replace(self.params, **state["params"]))
        for name, array in self._actuation_arrays().items():
            array[...] = state["actuation"].get(name, array)
        self.engine.set_state(np.arange(self.num_envs), state["engine"])
        self._control_steps[:] = state["control_steps"]
        self._noise[:] = state["noise"]
        for stream, saved in zip(self._imu_streams + self._start_streams, state["streams"], strict=True):
            stream.bit_generator.state = saved
        self._diverged[:] = state["diverged"]
        self.divergences = state["divergences"]
        self._starts[:] = state["starts"]
        self._headings[:] = state["headings"]
