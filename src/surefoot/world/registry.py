"""Registry of worlds: one entry per name that `--world` accepts, with everything that depends on its engine.

To add an engine, write a class that implements `engine.Engine`, and add an entry here and an extra of the package in
pyproject.toml.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from surefoot.errors import SurefootError, suggest
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.world.ensemble import draw_ensemble
from surefoot.world.interface import Simulation, SimulationFactory, WorldConfig

if TYPE_CHECKING:
    from surefoot.world.engine import EngineFactory


@dataclass(frozen=True)
class WorldEntry:
    """A simulated world. Classes are named as "module:name" and imported on first use."""

    engine: str
    """Class of the physics engine, a `world.engine.Engine`."""
    package: str
    """Import name of the package that the engine needs."""
    extra: str
    """Extra of surefoot that installs this package."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of the engine's class."""
    uses_threads: bool = True
    """Whether the engine steps robots on several threads; otherwise robots are distributed over processes."""
    max_robots: int | None = None
    """Maximum number of robots per process; None for no limit."""
    robots_per_batch: int = 0
    """Number of robots to simulate in parallel if there are many episodes; 0 for all."""
    seeds: range | None = None
    """Seeds of the world's own robots (`world.ensemble`), or None if the caller chooses the physical parameters."""


_BULLET = WorldEntry(
    "surefoot.world.bullet_engine:BulletEngine",
    package="pybullet",
    extra="bullet",
    uses_threads=False,
    max_robots=256,  # of PyBullet's 1024 clients; each takes some 33 MB
    robots_per_batch=128,
)
WORLDS = {
    "mujoco": WorldEntry("surefoot.world.mujoco_engine:MujocoEngine", package="mujoco", extra="sim"),
    "bullet": _BULLET,
    "bullet-published": replace(_BULLET, options={"published": True}),
    # Robots 1 to 20 are for development of policies and tasks. Robots 21 to 60 are for reported results, and run only
    # once, when a policy is final. Robots 61 to 100 were never run: they replace robots 21 to 60 as soon as any
    # decision was based on results with those.
    "ensemble": replace(_BULLET, seeds=range(1, 21)),
    "ensemble-test": replace(_BULLET, seeds=range(21, 61)),
}
DEFAULT_WORLD = "mujoco"


def find_entry(name: str) -> WorldEntry:
    """Return the entry of a world.

    Raises:
        SurefootError: no such world.
        ModuleNotFoundError: its physics engine is not installed.
    """
    if name not in WORLDS:
        raise SurefootError(f"world '{name}' does not exist; {suggest(name, WORLDS)}")
    entry = WORLDS[name]
    # Check now, because engines are also imported in other processes, where it would be too late for a message.
    if find_spec(entry.package) is None:
        raise ModuleNotFoundError(f"No module named '{entry.package}'", name=entry.package)
    return entry


def find_engine(name: str) -> EngineFactory:
    """Return the engine factory of a world. See `find_entry` for errors."""
    entry = find_entry(name)
    factory: EngineFactory = partial(_load(entry.engine), **entry.options)
    return factory


def find_world(name: str) -> SimulationFactory:
    """Return the simulation factory of a world. See `find_entry` for errors."""
    find_entry(name)
    return partial(make_world, name)


def make_world(
    name: str,
    robot: RobotDescription,
    num_envs: int,
    params: PhysicalParams | None = None,
    seed: int = 0,
    config: WorldConfig | None = None,
) -> Simulation:
    """Make a simulation: in this process, or distributed over `config.threads` processes for engines without threads.

    Raises:
        SurefootError: see `find_entry` and `SimWorld`; or more robots than the processes can hold.
    """
    entry, config = find_entry(name), config or WorldConfig()
    if entry.seeds is not None:
        params = draw_ensemble(
            robot, PhysicalParams.nominal(robot, num_envs) if params is None else params, entry.seeds
        )
    make = (
        "surefoot.world.sim_world:SimWorld"
        if entry.uses_threads
        else "surefoot.world.process_world:make_distributed_world"
    )
    world: Simulation = _load(make)(robot, num_envs, params, seed, config, name)
    return world


def check_randomized(name: str, randomize: Mapping[str, Any]) -> None:
    """Reject randomization in a world whose robots have their own parameters, which it would replace.

    Raises:
        SurefootError: the world has such robots, and `randomize` is not empty.
    """
    if randomize and find_entry(name).seeds is not None:
        raise SurefootError(
            f"world '{name}' has robots of its own, whose parameters can't be randomized; leave out --randomize, or "
            "take the world bullet"
        )


def check_takes_params(name: str) -> None:
    """Raise a `SurefootError` for a world whose robots have their own parameters. See `find_entry` for other errors."""
    if find_entry(name).seeds is not None:
        raise SurefootError(f"world is '{name}'; {suggest(name, worlds_with_params())}")


def worlds_with_params() -> list[str]:
    """Return the names of the worlds that take physical parameters; worlds of ensembles have their own."""
    return [name for name, entry in WORLDS.items() if entry.seeds is None]


def is_modelled(name: str, parameter: str) -> bool:
    """Return whether the engine of a world models a physical parameter, which must otherwise be 0."""
    engines = PARAMETERS[parameter].engines
    return not engines or WORLDS[name].engine in (WORLDS[world].engine for world in engines)


def check_modelled(name: str, params: PhysicalParams) -> None:
    """Raise a `SurefootError` for a nonzero physical parameter that the engine of a world does not model."""
    for parameter, declared in PARAMETERS.items():
        if not is_modelled(name, parameter):
            values = getattr(params, parameter)
            if values.any():
                raise SurefootError(
                    f"{parameter} is {values[values != 0][0]:g}; world {name} does not model it: "
                    f"set 0, or use world {' or '.join(declared.engines)}"
                )


def _load(path: str) -> Callable[..., Any]:
    module, _, name = path.partition(":")
    loaded: Callable[..., Any] = getattr(import_module(module), name)
    return loaded
