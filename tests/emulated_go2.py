"""Emulated Go2 in memory: messages without DDS, as fast as the physics."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from surefoot.deploy.dds import low_level
from surefoot.deploy.dds.low_level import LOW_STATE, BadMessageError, Record
from surefoot.emulator.dds.board import Go2Board
from surefoot.emulator.dds.own_controller import OwnController
from surefoot.emulator.fault_table import parse_faults
from surefoot.emulator.hardware import PowerConfig, SensorConfig
from surefoot.emulator.plant import Plant
from surefoot.robot import RobotDescription

GO2 = RobotDescription.load("go2")
FOLDED, STANDING = (np.tile(leg, 4) for leg in ([0.0, 1.36, -2.65], [0.0, 0.67, -1.3]))
"""Poses of the vendor's stand-up example [rad]."""


class Wire:
    """Link in memory, with the robot's messages and commands for it."""

    next_departure = float("inf")

    def __init__(self) -> None:
        self.unplugged = False
        self.inbound: list[Record] = []
        self.published: list[Record] = []
        """Commands from the robot's own controller."""
        self.sent: list[tuple[int, bytes]] = []
        """Times [µs] and bytes of states."""

    def publish_command(self, command: Record) -> None:
        self.published.append(command.copy())

    def send(self, at: int, data: bytes) -> None:
        if not self.unplugged:
            self.sent.append((at, data))

    @property
    def states(self) -> list[Record]:
        """Undamaged states."""
        return list(self._undamaged(self.sent))

    @property
    def state(self) -> Record:
        """Last undamaged state."""
        return next(self._undamaged(reversed(self.sent)))

    @staticmethod
    def _undamaged(sent: Iterable[tuple[int, bytes]]) -> Iterator[Record]:
        for _, data in sent:
            with contextlib.suppress(BadMessageError):
                yield low_level.decode(LOW_STATE, data)


class Robot:
    """Emulated Go2 with ideal sensors, and a host that commands all motors."""

    def __init__(self, *faults: str, rack: bool = False, engine: str = "mujoco", noise: bool = False) -> None:
        self.wire, self.controller = Wire(), OwnController()
        sensors = SensorConfig() if noise else SensorConfig.ideal()
        plant = Plant(GO2, sensors=sensors, power=PowerConfig.ideal(), rack=rack, engine=engine, accelerometer=True)
        names = parse_faults(faults, motors=12, link="dds")
        self.board = Go2Board(plant, self.wire, 1.0, self.controller, faults=names)

    def run(self, seconds: float) -> Record:
        """Run for a time [s]; return the last state."""
        self.board.run_to(self.board.now + round(seconds * 1e6))
        return self.wire.state

    @property
    def height(self) -> float:
        """Height of the base link [m]."""
        return float(self.board.plant.capture().position[2])

    def command(self, **fields: Any) -> None:
        """Send the given fields to all twelve motors; other fields are 0."""
        command = low_level.new_command()
        motors = command["motor_cmd"][:12]
        for name, value in {"q": 0, "dq": 0, **fields}.items():
            motors[name] = value
        self.wire.inbound.append(command)

    def move(self, target: np.ndarray, seconds: float) -> None:
        """Move to a pose linearly at 500 Hz, as in the vendor's example."""
        first = self.wire.state["motor_state"]["q"][:12].astype(float)
        for step in range(round(seconds / 0.002)):
            self.command(q=first + (target - first) * step * 0.002 / seconds, kp=60, kd=5)
            self.run(0.002)
