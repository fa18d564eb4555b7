"""Registry of worlds: effects of entries, and errors."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams
from surefoot.robot.params import PARAMETERS
from surefoot.world import registry
from surefoot.world.interface import WorldConfig
from surefoot.world.registry import WORLDS, WorldEntry, check_randomized, check_takes_params, find_world, make_world


@pytest.mark.parametrize("name", WORLDS)
def test_a_robot_stands_in_every_world(robot, name):
    pytest.importorskip(WORLDS[name].package)
    world = find_world(name)(robot, 1, PhysicalParams.nominal(robot), 0, WorldConfig())
    for _ in range(30):
        world.step(robot.resting_angles)
    assert 0.1 < world.truth().base_position_world[0, 2] < 0.3
    assert not world.divergences


def test_a_new_engine_is_one_entry(robot, monkeypatch):
    entry = WorldEntry(
        "surefoot.world.mujoco_engine:MujocoEngine", package="mujoco", extra="sim", uses_threads=False, max_robots=1
    )
    monkeypatch.setitem(WORLDS, "third", entry)
    assert make_world("third", robot, 1).step(robot.resting_angles).motor_angle.shape == (1, 8)
    with pytest.raises(SurefootError, match="num_envs is 1000; world third holds up to 1 robots"):
        make_world("third", robot, 1000)


def test_an_unknown_or_uninstalled_world_is_rejected(monkeypatch):
    with pytest.raises(SurefootError, match="world 'moon' does not exist; choices: mujoco, bullet"):
        find_world("moon")
    monkeypatch.setattr(registry, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="No module named 'mujoco'"):
        find_world("mujoco")


def test_a_world_with_its_own_parameters_accepts_no_others():
    pytest.importorskip("pybullet")
    with pytest.raises(SurefootError, match="world is 'ensemble'; choices: mujoco, bullet, bullet-published"):
        check_takes_params("ensemble")


def test_the_robots_of_an_ensemble_are_not_randomized():
    with pytest.raises(SurefootError, match="world 'ensemble' has robots of its own, whose parameters can't be random"):
        check_randomized("ensemble", {"voltage": (14.0, 15.0)})
    check_randomized("ensemble", {})
    check_randomized("mujoco", {"voltage": (14.0, 15.0)})


@pytest.mark.parametrize("name", sorted(name for name, declared in PARAMETERS.items() if declared.engines))
def test_a_parameter_that_the_engine_does_not_model_is_rejected(make_world, name):
    world = make_world(2)
    with pytest.raises(SurefootError, match=f"{name} is 0.001; world mujoco does not model it: set 0, or use"):
        world.set_params([1], world.params.rows([1]).with_values(world.robot, **{name: 0.001}))
    assert not np.any(getattr(world.params, name))
