"""The registry of worlds: one entry for each name that `--world` takes, with everything that depends on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

from surefoot.errors import SurefootError, choices
from surefoot.world.interface import SimulationFactory


def _mujoco() -> SimulationFactory:
    from surefoot.world.sim_world import SimWorld

    return SimWorld


def _bullet() -> SimulationFactory:
    from surefoot.world.process_world import bullet_world

    return bullet_world


def _published() -> SimulationFactory:
    from surefoot.world.process_world import bullet_world

    return partial(bullet_world, published=True)


def _ensemble() -> SimulationFactory:
    from surefoot.evaluate.ensemble import ensemble_world

    return ensemble_world


@dataclass(frozen=True)
class WorldEntry:
    """A simulated world."""

    load: Callable[[], SimulationFactory]
    """Imports what makes it."""
    package: str
    """What must be installed, by the name of its import."""
    side_by_side: int = 0
    """Robots that many episodes are best run with at a time, 0 for all."""


# Bullet takes some 33 MB for each robot.
WORLDS = {
    "mujoco": WorldEntry(_mujoco, "mujoco"),
    "bullet": WorldEntry(_bullet, "pybullet", 128),
    "bullet-published": WorldEntry(_published, "pybullet", 128),
    "ensemble": WorldEntry(_ensemble, "pybullet", 128),
}


def find_world(name: str) -> SimulationFactory:
    """Return the factory of worlds of a name in `WORLDS`.

    Raises:
        SurefootError: no such world.
        ModuleNotFoundError: its physics engine is not installed.
    """
    if name not in WORLDS:
        raise SurefootError(f"world '{name}' does not exist; choices: {choices(WORLDS)}")
    entry = WORLDS[name]
    # Processes import it when the world is made; that would be too late for a plain word.
    if find_spec(entry.package) is None:
        raise ModuleNotFoundError(f"No module named '{entry.package}'", name=entry.package)
    return entry.load()
