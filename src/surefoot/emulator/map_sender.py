"""Sender of height maps around the emulated robot, as a mapping program on a robot would send them."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.map_channel import send_map
from surefoot.emulator.plant import Plant
from surefoot.rotations import quat_yaw
from surefoot.task.height_scan import POLICY_GRID, HeightScanner, ScanConfig

PERIOD = 20_000
"""Period of maps [us]; the unit of their delay."""


class MapSender:
    """Sends height maps of the ground, with errors, to the channel of `deploy.map_channel`.

    Args:
        port: port of the channel.
        plant: simulated body of the robot.
        errors: errors of the maps.
        seed: seed of the errors.
    """

    def __init__(self, port: int, plant: Plant, errors: ScanConfig, seed: int) -> None:
        self._port, self._plant, self._ground = port, plant, plant.world.config.ground
        self._age = errors.delay * PERIOD / 1e6
        self._scanner = HeightScanner(errors, plant.robot, 1, seed)
        self._scanner.reset(np.arange(1), self._ground, *self._pose())

    def _pose(self) -> tuple[Array, Array]:
        sample = self._plant.capture()
        return sample.position[None], np.atleast_1d(quat_yaw(sample.quat))

    def update(self, now: int) -> None:
        """Send a map if one is due at `now` [us], the end of a servo step."""
        if now % PERIOD:
            return
        self._scanner.update(self._ground, *self._pose())
        send_map(self._port, self._scanner.heights.reshape(len(POLICY_GRID.ahead), -1).tolist(), self._age)

    def close(self) -> None:
        """Do nothing."""
