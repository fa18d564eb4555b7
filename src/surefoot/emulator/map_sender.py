"""The map of heights around the emulated robot, as a program with the robot's sensors would send it to a deployment."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.map_channel import send_map
from surefoot.emulator.plant import Plant
from surefoot.rotations import quat_yaw
from surefoot.task.height_scan import POLICY_GRID, HeightScanner, ScanConfig

PERIOD = 20_000
"""Time between two maps [us]; the delay of a map is a number of these."""


class MapSender:
    """Sends maps of the true ground, with errors, to the channel of `deploy.map_channel`.

    Args:
        port: of the channel.
        plant: the body.
        errors: what a map makes of the ground.
        seed: of the errors.
    """

    def __init__(self, port: int, plant: Plant, errors: ScanConfig, seed: int) -> None:
        self._port, self._plant, self._ground = port, plant, plant.world.config.ground
        self._age = errors.delay * PERIOD / 1e6
        self._scanner = HeightScanner(errors, plant.robot, 1, seed)
        self._scanner.reset(np.arange(1), self._ground, *self._pose())

    def _pose(self) -> tuple[Array, Array]:
        seen = self._plant.capture()
        return seen.position[None], np.atleast_1d(quat_yaw(seen.quat))

    def see(self, now: int) -> None:
        """Send a map if a servo step that ended at `now` [us] is due for one."""
        if now % PERIOD:
            return
        self._scanner.update(self._ground, *self._pose())
        send_map(self._port, self._scanner.heights.reshape(len(POLICY_GRID.ahead), -1).tolist(), self._age)

    def close(self) -> None:
        """Do nothing."""
