"""Fixtures shared by the tests of worlds."""

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
    """Return a factory of worlds, with physical parameters by name and arguments of `SimWorld`."""

    def make(
        num_envs: int = 1,
        *,
        seed: int = 0,
        config: dict[str, Any] | None = None,
        engine: str = "mujoco",
        **values: Any,
    ) -> SimWorld:
        params = PhysicalParams.nominal(robot, num_envs).with_values(robot, **values)
        return SimWorld(robot, num_envs, params, seed, WorldConfig(**(config or {})), engine)

    return make


@pytest.fixture(params=["mujoco", "bullet"])
def engine(request: pytest.FixtureRequest) -> str:
    """Parametrize tests over the names of engines."""
    if request.param != "mujoco":
        pytest.importorskip("pybullet")
    name: str = request.param
    return name


@pytest.fixture(scope="session")
def varied() -> Callable[..., dict[str, np.ndarray]]:
    """Return a function that returns different values of many parameters for a number of robots."""

    def values(num_envs: int, bullet: bool = False) -> dict[str, np.ndarray]:
        draw = np.random.default_rng(7)
        of_bullet = {
            "knee_friction": draw.uniform(0, 0.02, num_envs),
            "knee_play": draw.uniform(0.0001, 0.0005, num_envs),
            "floor_unevenness": draw.uniform(0.001, 0.004, num_envs),
        }
        return {
            "base_mass_ratio": draw.uniform(0.8, 1.2, num_envs),
            "leg_mass_ratio": draw.uniform(0.8, 1.2, num_envs),
            "base_inertia_ratio": draw.uniform(0.8, 1.2, num_envs),
            "leg_inertia_ratio": draw.uniform(0.5, 1.5, num_envs),
            "motor_strength": draw.uniform(0.8, 1.2, (num_envs, 8)),
            "motor_viscous_friction": draw.uniform(0, 0.02, (num_envs, 8)),
            "voltage": draw.uniform(14, 16.8, num_envs),
            "contact_friction": draw.uniform(0.5, 1.25, num_envs),
            "control_step": draw.uniform(0.003, 0.012, num_envs),
            "control_latency": draw.uniform(0, 0.04, num_envs),
            "servo_latency": draw.uniform(0, 0.01, num_envs),
            "imu_noise": draw.uniform(0.01, 0.05, num_envs),
            "imu_mount": draw.uniform(-0.02, 0.02, (num_envs, 3)),
            "contact_stiffness": draw.uniform(1500, 6000, num_envs),
            "contact_spinning_friction": draw.uniform(0.002, 0.006, num_envs),
            **(of_bullet if bullet else {}),
        }

    return values


@pytest.fixture
def trot(robot: RobotDescription) -> Callable[[int], np.ndarray]:
    """Return a function with the motor angles (8,) of an open-loop trot at a control step."""

    def angles(step: int) -> np.ndarray:
        phase = 2 * np.pi * 2.0 * 0.006 * step + np.array([0, np.pi, np.pi, 0])
        return robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.35 * np.sin(phase))

    return angles


@pytest.fixture
def assert_same() -> Callable[..., None]:
    """Return a function that compares two dataclasses of arrays to the last bit, with NaN equal to NaN."""

    def compare(a: Any, b: Any, rows_a: Any = slice(None), rows_b: Any = slice(None)) -> None:
        for name in vars(a):
            if getattr(a, name) is None and getattr(b, name) is None:
                continue
            first, second = getattr(a, name)[rows_a], getattr(b, name)[rows_b]
            assert np.array_equal(first, second, equal_nan=first.dtype.kind == "f"), name

    return compare
