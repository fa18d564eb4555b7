"""Worlds in several processes: identical results, and no process that outlives its owner."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world import registry
from surefoot.world.actuation import SHARED_ARRAYS, new_actuation
from surefoot.world.interface import WorldConfig
from surefoot.world.process_world import ProcessWorld, process_count, worker_pool
from surefoot.world.sim_world import SimWorld

# Most tests are about processes and use MuJoCo, which starts and steps faster.
NUM = 5


CONFIG = {"start_linear_speed": 0.05, "start_angular_speed": 0.1}


@pytest.fixture
def single(make_world, varied) -> SimWorld:
    """Return five robots with different parameters in one world."""
    return make_world(NUM, seed=3, config={"threads": 1, **CONFIG}, **varied(NUM))


@pytest.fixture(scope="module")
def processes(robot: RobotDescription, varied) -> Iterator[tuple[ProcessWorld, dict[str, Any]]]:
    """Yield the same robots in three processes, and their initial state."""
    params = PhysicalParams.nominal(robot, NUM).with_values(robot, **varied(NUM))
    world = ProcessWorld(robot, NUM, params, 3, WorldConfig(threads=3, **CONFIG), "mujoco")
    yield world, world.get_state()
    world.close()


@pytest.fixture
def spread(processes) -> ProcessWorld:
    """Return the world in three processes in its initial state."""
    world, state = processes
    world.set_state(state)
    return world


def assert_same_state(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    assert one["streams"] == other["streams"]
    for key in ("engine", "control_steps", "noise", "diverged", "divergences"):
        np.testing.assert_array_equal(one[key], other[key])
    for part in ("actuation", "params"):
        assert one[part].keys() == other[part].keys()
        for name in one[part]:
            np.testing.assert_array_equal(one[part][name], other[part][name], err_msg=name)


def ids(world: ProcessWorld) -> list[int]:
    return [process.pid for process in world._processes]


def gone(process_id: int, within: float = 20.0) -> bool:
    """Return whether a process ends within a time [s]; zombies count as ended."""
    end = time.monotonic() + within
    while time.monotonic() < end:
        try:
            if Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
            os.kill(process_id, 0)
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.05)
    return False


def play(world: Any, trot: Any) -> list[Any]:
    """Call all methods of a simulation, and return their results."""
    returned = [world.readings(), world.truth()]
    active = np.array([True, False, True, True, False])
    for k in range(20):
        returned.append(world.step(trot(k), active if k % 3 == 0 else None))
        returned.append(world.truth())
    params = world.params.rows([4, 0]).with_values(world.robot, leg_mass_ratio=1.4, contact_friction=0.5)
    world.set_params([4, 0], params)
    world.place([0, 3], np.array([[0.5, 0.0], [0.0, -0.3]]), np.array([1.0, -2.0]))
    returned.append(world.reset([4, 0, -2]))
    world.push(np.arange(3 * NUM).reshape(NUM, 3))
    target = np.tile(trot(3), (NUM, 1))
    target[3, 2] = np.nan
    returned += [world.step(target), world.truth(), world.readings(), world.reset(), world.truth()]
    return returned


def test_several_processes_give_the_results_of_one_world(single, spread, processes, trot, assert_same):
    assert_same_state(single.get_state(), processes[1])
    for a, b in zip(play(single, trot), play(spread, trot), strict=True):
        assert_same(a, b)
    np.testing.assert_array_equal(single.foot_positions(), spread.foot_positions())
    assert single.divergences == spread.divergences == 1
    assert_same(single.params, spread.params)


def test_states_are_interchangeable_with_one_world(single, spread, trot, assert_same):
    for k in range(7):
        spread.step(trot(k))
        single.step(trot(k))
    state = spread.get_state()
    assert_same_state(single.get_state(), state)
    for k in range(30):
        spread.step(trot(k))
    for world in (spread, single):
        world.set_state(state)
    for k in range(7, 20):
        assert_same(spread.step(trot(k)), single.step(trot(k)))
    assert_same(spread.truth(), single.truth())


def test_torque_readings_of_several_processes_are_joined(robot, trot):
    config = {"torque_readings": True, **CONFIG}
    one = SimWorld(robot, NUM, None, 3, WorldConfig(threads=1, **config))
    several = ProcessWorld(robot, NUM, None, 3, WorldConfig(threads=2, **config), "mujoco")
    try:
        for k in range(5):
            readings = one.step(trot(k)).motor_torque
            np.testing.assert_array_equal(several.step(trot(k)).motor_torque, readings)
        several.set_state(one.get_state())
        np.testing.assert_array_equal(several.readings().motor_torque, readings)
    finally:
        several.close()


def test_shared_arrays_are_complete(robot):
    # Arrays either have one row per robot, for 3 and for 7 robots, or are shared.
    three, seven = (new_actuation(robot, num, 5, WorldConfig())._asdict() for num in (3, 7))
    for name in three:
        assert (len(three[name]), len(seven[name])) == (3, 7) or name in SHARED_ARRAYS, name
    for name in SHARED_ARRAYS:
        np.testing.assert_array_equal(three[name], seven[name])


def test_truth_may_be_modified_by_the_caller(spread, trot):
    spread.reset()
    spread.step(trot(0))
    truth = spread.truth()
    truth.motor_angle[:] = 0.0
    assert spread.truth().motor_angle.all()


def test_an_error_in_a_process_is_raised_and_the_world_continues(robot, spread, trot):
    bad = PhysicalParams.nominal(robot, NUM)
    bad.voltage[4] = 100.0
    with pytest.raises(SurefootError, match="voltage is 100; minitaur allows 5 to 30"):
        spread.set_params(np.arange(NUM), bad)
    assert spread.params.voltage.max() < 17
    with pytest.raises(ValueError, match="broadcast") as caught:
        spread._call("push", [(np.zeros((7, 2)),)] * 3)
    assert "in a worker process of the world" in caught.value.__notes__[0]
    assert spread.step(trot(0)).motor_angle.shape == (NUM, 8)
    with pytest.raises(IndexError, match="the world has 5 robots"):
        spread.reset([5])


@pytest.mark.parametrize("num_envs", [0, 2])
def test_a_wrong_number_of_robots_is_rejected(robot, num_envs):
    with pytest.raises(SurefootError, match=r"num_envs is 0|params are for 5 robots; the world has 2"):
        ProcessWorld(robot, num_envs, PhysicalParams.nominal(robot, 5), 0, WorldConfig(), "mujoco")


def test_an_error_during_construction_ends_all_processes(robot):
    before = set(Path("/proc").glob("[0-9]*"))
    with pytest.raises(SurefootError, match="does not settle at its resting pose"):
        ProcessWorld(robot, 2, None, 0, WorldConfig(threads=2, rest=(0.0, float("nan"))), "mujoco")
    ours = f"PPid:\t{os.getpid()}\n"
    for process in set(Path("/proc").glob("[0-9]*")) - before:
        assert ours not in (process / "status").read_text()


@pytest.fixture
def pair(robot: RobotDescription) -> ProcessWorld:
    return ProcessWorld(robot, 2, None, 0, WorldConfig(threads=2), "mujoco")


def test_a_killed_process_is_one_clear_error(pair, trot):
    pids = ids(pair)
    os.kill(pids[1], signal.SIGKILL)
    with pytest.raises(SurefootError, match=r"a process of the simulated world ended on its own \(exit code -9\)"):
        pair.step(trot(0))
    assert all(map(gone, pids))
    with pytest.raises(SurefootError, match="this world is closed, or one of its processes has ended"):
        pair.step(trot(0))


def test_processes_end_with_the_world(robot):
    world = ProcessWorld(robot, 1, None, 0, WorldConfig(threads=1), "mujoco")
    (pid,) = ids(world)
    assert not gone(pid, 0.1)
    del world
    gc.collect()
    assert gone(pid)


def test_pooled_workers_give_the_same_results_as_new_workers(robot, single, trot, assert_same, varied):
    params = PhysicalParams.nominal(robot, NUM).with_values(robot, **varied(NUM))

    def make() -> ProcessWorld:
        return ProcessWorld(robot, NUM, params, 3, WorldConfig(threads=2, **CONFIG), "mujoco")

    with worker_pool():
        world = make()
        first = ids(world)
        play(world, trot)
        world.close()
        with pytest.raises(SurefootError, match="closed"):
            world.readings()
        again = make()
        assert set(ids(again)) == set(first)
        for a, b in zip(play(single, trot), play(again, trot), strict=True):
            assert_same(a, b)
        # A process that has died is not returned to the pool, nor are the other processes of its world.
        os.kill(first[0], signal.SIGKILL)
        with pytest.raises(SurefootError, match="ended on its own"):
            again.step(trot(0))
        assert all(map(gone, first))
        last = make()
        assert not set(ids(last)) & set(first)
        last.close()
        assert not any(gone(pid, 0.1) for pid in ids(last))
    assert all(map(gone, ids(last)))


OWNER = """
import sys, time
import numpy as np
from surefoot.robot import RobotDescription
from surefoot.world import registry
from surefoot.world.interface import WorldConfig
from surefoot.world.process_world import ProcessWorld
world = ProcessWorld(RobotDescription.load("minitaur"), 2, None, 0, WorldConfig(threads=2), "mujoco")
print(*(process.pid for process in world._processes), flush=True)
while True:
    world.step(np.full(8, 2.0))
"""


def test_no_process_outlives_an_owner_that_is_killed():
    # Without a guard for __main__, and without a chance to clean up.
    owner = subprocess.Popen([sys.executable, "-c", OWNER], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    pids = [int(word) for word in owner.stdout.readline().split()]
    assert len(pids) == 2
    owner.kill()
    owner.wait()
    owner.stdout.close()
    assert all(map(gone, pids))


@pytest.mark.parametrize(("threads", "num_envs", "expected"), [(3, 5, 3), (8, 5, 5), (1, 5, 1), (0, 1, 1)])
def test_there_are_never_more_processes_than_robots(threads, num_envs, expected):
    assert process_count(num_envs, WorldConfig(threads=threads)) == expected
    assert process_count(1000, WorldConfig()) == os.cpu_count()


def test_bullet_gives_the_same_results_in_several_processes(robot, trot, assert_same):
    pytest.importorskip("pybullet")
    one, two = (
        registry.make_world("bullet", robot, 3, None, 1, WorldConfig(threads=threads, **CONFIG)) for threads in (1, 2)
    )
    assert isinstance(one, SimWorld)
    assert isinstance(two, ProcessWorld)
    for k in range(15):
        assert_same(one.step(trot(k)), two.step(trot(k)))
    assert_same(one.truth(), two.truth())
    two.set_state(one.get_state())
    assert_same(one.step(trot(15)), two.step(trot(15)))
    two.close()


def test_more_robots_than_the_processes_can_hold_are_rejected(robot):
    with pytest.raises(SurefootError, match="num_envs is 513; world bullet holds up to 256 robots in each of 2"):
        registry.make_world("bullet", robot, 513, config=WorldConfig(threads=2))
