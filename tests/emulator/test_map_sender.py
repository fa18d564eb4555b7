"""The map of heights that an emulated robot sends."""

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


def test_a_map_comes_fifty_times_a_second_with_its_age_and_errors(robot) -> None:
    plant, grid = Plant(robot), HeightMap(*POLICY_GRID.scale(robot), age=0.0)
    level = -plant.capture().position[2]
    errors = ScanConfig(noise=0.0, drift=0.0, shift=0.0, holes=0.0, delay=3)
    with contextlib.closing(MapChannel(0, grid, clock=lambda: 0.0)) as channel:
        sender = MapSender(channel.port, plant, errors, seed=0)
        sender.see(PERIOD + 1000)
        assert channel.read() is None
        sender.see(PERIOD)
        assert channel.read() == pytest.approx(level, abs=1e-6)
        assert channel.age == pytest.approx(0.06)
        noisy = MapSender(channel.port, plant, ScanConfig(noise=0.03, drift=0.0, holes=0.0), seed=0)
        spread = []
        for k in range(20):
            noisy.see(k * PERIOD)
            spread.append(channel.read() - level)
        assert np.std(spread[3:]) == pytest.approx(0.03, rel=0.1)
