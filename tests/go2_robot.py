"""Fake Go2 for tests of the DDS link, in a separate process: legs follow commands, and tests change the readings.

It has no physics, so that it takes little processor time from the tested processes.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from surefoot.deploy.dds import bus, low_level, services, types
from surefoot.deploy.dds.state_monitor import MOTORS
from surefoot.deploy.pacer import BOARD_PRIORITY, real_time_priority

LYING = np.tile([0.0, 1.2, -2.6], 4)
RATE = 30.0
"""Rate at which a joint approaches its target [1/s]."""
CATCH_UP = 0.2
"""Maximum delay of its states [s]: unlike a robot's board, this process shares the computer with others."""
SPEED_NOISE = 0.05
"""Noise of motor speeds [rad/s]."""
CELLS, CELL = 8, 3830


def worker_domain(first: int) -> int:
    """Return a DDS domain for this test worker."""
    return first + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])


@dataclass
class Frame:
    """Command received by the robot, with its time on the monotonic clock [s]."""

    time: float
    kp: float
    kd: float
    jump: float
    """Largest torque kp |q* - q| [N m]."""

    @property
    def damps(self) -> bool:
        return self.kp == 0 and self.kd > 0


@dataclass
class Settings:
    """Settings that tests change while the robot runs."""

    silent: bool = False
    corrupt: bool = False
    frozen: bool = False
    restart: bool = False
    short: bool = False
    """Whether messages have another length."""
    not_finite: bool = False
    roll: float = 0.0
    mode: int = low_level.SERVO
    """Value for the first motor."""
    lost_rate: int = 0
    """Number of messages that the first motor loses per state."""
    temperature: int = 40
    cell: int = CELL
    """Voltage of each cell [mV]."""
    buttons: frozenset[str] = frozenset()
    stick: float = 0.0
    sport: bool = False
    """Whether the robot's own controller publishes its state."""
    controller: str = ""
    """Name that the motion switcher answers."""
    angle: Any = field(default_factory=LYING.copy)


class _Body:
    def __init__(self, domain: int) -> None:
        self.settings = Settings()
        self.frames: list[Frame] = []
        here = bus.Bus("lo", domain)
        self._states = here.writer(bus.LOW_STATE_TOPIC, types.LowState)
        self._sport = here.writer(bus.SPORT_STATE_TOPIC, types.SportModeState)
        self._commands = here.reader(bus.LOW_COMMAND_TOPIC, types.LowCmd, 64)
        self._switcher = services.Server(
            here,
            services.MOTION_SWITCHER,
            {
                services.CHECK_MODE: self._check_mode,
                services.RELEASE_MODE: lambda _: self._select(""),
                services.SELECT_MODE: lambda text: self._select(services.parse_object(text)["name"]),
            },
        )
        self._sports = services.Server(here, services.SPORT, {services.STAND_DOWN: lambda _: (services.OK, "")})
        self._q, self._dq = self.settings.angle.copy(), np.zeros(MOTORS)
        self._random = np.random.default_rng(0)
        self._kp = self._kd = self._target = np.zeros(MOTORS)
        self.tick = 1000
        imu = types.IMUState([1.0, 0, 0, 0], [0.0] * 3, [0.0] * 3, [0.0] * 3, 40)
        path = [types.PathPoint()] * 10
        self._sport_state = types.SportModeState(
            *(types.TimeSpec(), 0, imu, 0, 0.0, 0, 0.0, [0.0] * 3, 0.0, [0.0] * 3, 0.0),
            *([0.0] * 4, [0] * 4, [0.0] * 12, [0.0] * 12, path),
        )
        self._lost = 7

    def reset(self) -> None:
        self.settings = Settings()
        self._q = self.settings.angle.copy()
        self._kp = self._kd = np.zeros(MOTORS)

    def _check_mode(self, _: str) -> services.Answer:
        return services.OK, f'{{"form":"0","name":"{self.settings.controller}"}}'

    def _select(self, name: str) -> services.Answer:
        self.settings.controller, self.settings.sport = name, bool(name)
        return services.OK, ""

    def set(self, name: str, value: Any) -> None:
        setattr(self.settings, name, value)
        if name == "angle":
            self._q = np.array(value, float)
        if name == "restart":
            self.tick = 0

    def step(self, dt: float) -> None:
        for data in self._commands.take(64):
            try:
                command = low_level.decode(low_level.LOW_COMMAND, data)
            except low_level.BadMessageError:
                continue
            motors = command["motor_cmd"][:MOTORS]
            self._kp, self._kd, self._target = (motors[name].astype(float) for name in ("kp", "kd", "q"))
            jump = float(np.max(self._kp * np.abs(self._target - self._q))) if self._kp.any() else 0.0
            self.frames.append(Frame(time.monotonic(), float(self._kp.max()), float(self._kd.max()), jump))
        before = self._q
        if self._kp.any():
            self._q = self._q + (self._target - self._q) * min(RATE * dt, 1.0)
        self._dq = (self._q - before) / dt
        self._switcher.serve()
        self._sports.serve()
        self._publish()
        if self.settings.sport:
            self._sport.write_message(self._sport_state)

    def _publish(self) -> None:
        now = self.settings
        if now.silent:
            return
        if not now.frozen:
            self.tick += 2
        state = low_level.new_record(low_level.LOW_STATE)
        state["head"] = low_level.HEAD
        state["tick"] = self.tick
        motors = state["motor_state"][:MOTORS]
        motors["mode"], motors["temperature"] = low_level.SERVO, now.temperature
        motors["q"], motors["tau_est"] = self._q, 0.5
        motors["dq"] = self._dq + SPEED_NOISE * self._random.standard_normal(MOTORS)
        motors["mode"][0] = now.mode
        self._lost += now.lost_rate
        motors["lost"] = 7
        motors["lost"][0] = self._lost
        imu = state["imu_state"]
        imu["quaternion"] = np.cos(now.roll / 2), np.sin(now.roll / 2), 0, 0
        imu["accelerometer"] = 0, 9.81 * np.sin(now.roll), 9.81 * np.cos(now.roll)
        imu["rpy"] = now.roll, 0, 0
        state["bms_state"]["cell_vol"][:CELLS] = now.cell
        state["power_v"] = 1e-3 * CELLS * now.cell
        if now.buttons or now.stick:
            state["wireless_remote"] = low_level.RemoteControl(now.buttons, now.stick, 0.0, 0.0, 0.0).encode()
        if now.not_finite:
            motors["q"][4] = np.nan
        data = low_level.encode(state)
        if now.corrupt:
            data = data[:100] + bytes([data[100] ^ 1]) + data[101:]
        self._states.write(data[:-4] if now.short else data)


def _run(domain: int, pipe: Connection) -> None:
    with real_time_priority(BOARD_PRIORITY, threads=True):
        body = _Body(domain)
        pipe.send("ready")
        due = last = time.monotonic()
        while True:
            due = max(due + low_level.STATE_PERIOD, time.monotonic() - CATCH_UP)
            time.sleep(max(due - time.monotonic(), 0.0))
            now = time.monotonic()
            body.step(max(now - last, 1e-4))
            last = now
            while pipe.poll():
                match pipe.recv():
                    case (str(name), value):
                        body.set(name, value)
                    case "frames":
                        pipe.send(body.frames)
                        body.frames = []
                    case "settings":
                        pipe.send(body.settings)
                    case "time":
                        pipe.send(1e-3 * body.tick)
                    case "reset":
                        body.reset()
                    case _:
                        return


class Go2:
    """The robot's process; times are of the monotonic clock."""

    def __init__(self, domain: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self.domain = domain
        self._process = context.Process(target=_run, args=(domain, there), daemon=True)
        self._process.start()
        assert self._pipe.recv() == "ready"
        self.frames: list[Frame] = []
        """Commands received until the last call of `read`."""

    def set(self, **changes: Any) -> float:
        """Change readings, and return when."""
        for item in changes.items():
            self._pipe.send(item)
        return time.monotonic()

    def reset(self) -> None:
        """Make the robot whole again, and forget the commands so far."""
        self._pipe.send("reset")
        self.read()
        self.frames = []

    @property
    def time(self) -> float:
        """Its own time [s], by its ticks."""
        self._pipe.send("time")
        return self._pipe.recv()

    @property
    def settings(self) -> Settings:
        self._pipe.send("settings")
        return self._pipe.recv()

    def read(self) -> list[Frame]:
        """Return all commands so far."""
        self._pipe.send("frames")
        self.frames += self._pipe.recv()
        return self.frames

    def wait_for(self, condition: Callable[[Frame], bool], after: float = 0.0, timeout: float = 20.0) -> Frame:
        """Return the first command after a time [s] for which a condition holds, once it has come."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            for frame in self.read():
                if frame.time >= after and condition(frame):
                    return frame
            time.sleep(0.005)
        raise AssertionError(f"no such command among {len(self.frames)}; the last: {self.frames[-1:]}")

    def close(self) -> None:
        self._pipe.send("end")
        self._process.join(5)
