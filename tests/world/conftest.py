"""The robot and worlds that tests of this room share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld


@pytest.fixture
def make_world(robot: RobotDescription) -> Callable[..., SimWorld]:
    """Make a world of so many robots, with parameters by name and the rest as `SimWorld` takes it."""

    def make(num_envs: int = 1, *, seed: int = 0, config: dict[str, Any] | None = None, **values: Any) -> SimWorld:
        params = PhysicalParams.nominal(robot, num_envs).with_values(robot, **values)
        return SimWorld(robot, num_envs, params, seed, WorldConfig(**(config or {})))

    return make


@pytest.fixture
def trot(robot: RobotDescription) -> Callable[[int], np.ndarray]:
    """Motor angles (8,) of an open loop trot at a control step; it keeps all parts of the robot busy."""

    def angles(step: int) -> np.ndarray:
        phase = 2 * np.pi * 2.0 * 0.006 * step + np.array([0, np.pi, np.pi, 0])
        return robot.leg_to_motor_angles(0.3 * np.sin(phase), 2.0 + 0.35 * np.sin(phase))

    return angles


@pytest.fixture
def assert_same() -> Callable[[Any, Any], None]:
    """Compare two dataclasses of arrays to the last bit, NaN equal to NaN."""

    def compare(a: Any, b: Any, rows_a: Any = slice(None), rows_b: Any = slice(None)) -> None:
        for name in vars(a):
            first, second = getattr(a, name)[rows_a], getattr(b, name)[rows_b]
            assert np.array_equal(first, second, equal_nan=first.dtype.kind == "f"), name

    return compare
