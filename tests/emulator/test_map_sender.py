"""Height maps sent by an emulated robot."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.map_channel import MapChannel
from surefoot.emulator.map_sender import PERIOD, MapSender
from surefoot.emulator.plant import Plant
from surefoot.policy.contract import HeightMap
from surefoot.task.height_scan import POLICY_GRID, ScanConfig


def test_maps_are_sent_at_50_hz_with_age_and_errors(robot) -> None:
    plant, grid = Plant(robot), HeightMap(*POLICY_GRID.scale(robot), age=0.0)
    level = -plant.capture().position[2]
    errors = ScanConfig(noise=0.0, drift=0.0, shift=0.0, holes=0.0, delay=3)
    with contextlib.closing(MapChannel(0, grid, clock=lambda: 0.0)) as channel:
        sender = MapSender(channel.port, plant, errors, seed=0)
        sender.update(PERIOD + 1000)
        assert channel.read() is None
        sender.update(PERIOD)
        assert channel.read() == pytest.approx(level, abs=1e-6)
        assert channel.age == pytest.approx(0.06)
        noisy = MapSender(channel.port, plant, ScanConfig(noise=0.03, drift=0.0, holes=0.0), seed=0)
        spread = []
        for k in range(20):
            noisy.update(k * PERIOD)
            spread.append(channel.read() - level)
        assert np.std(spread[3:]) == pytest.approx(0.03, rel=0.1)
