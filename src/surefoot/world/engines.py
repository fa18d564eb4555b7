"""Engines by name."""

from __future__ import annotations

from surefoot.errors import SurefootError, choices
from surefoot.world.sim_world import EngineFactory, mujoco_engine

ENGINES = ("mujoco", "bullet")


def engine_of(name: str) -> EngineFactory:
    """Return what makes the physics of a world, imported on first use.

    Raises:
        SurefootError: an unknown name.
        ModuleNotFoundError: PyBullet is not installed.
    """
    if name not in ENGINES:
        raise SurefootError(f"world is '{name}'; choices: {choices(ENGINES)}")
    if name == "mujoco":
        return mujoco_engine
    from surefoot.world.bullet_engine import BulletEngine

    return BulletEngine
