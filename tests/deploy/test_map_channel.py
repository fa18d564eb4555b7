"""Height maps: a real socket, and a toy robot with a perceptive policy, whose maps are in time, late or missing."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from surefoot.deploy.controller import Controller
from surefoot.deploy.deployment import Deployment
from surefoot.deploy.map_channel import MAX_DELAY, MapChannel, send_map
from surefoot.deploy.motion_runner import STARTUP_TIME
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.run_saver import RunSaver
from surefoot.deploy.safety import SafetyLimits
from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract, HeightMap
from surefoot.robot.commands import STAND_COMMAND
from surefoot.task.config import load_task
from surefoot.task.contract_mapping import contract_from_task
from surefoot.task.height_scan import POLICY_GRID

GRID = HeightMap(ahead=(-0.2, 0.0, 0.2), left=(-0.1, 0.1), age=0.04)
FALLS = 0.01
"""Speed at which the toy robot's ground sinks [m/s], so that a height shows when it was sent."""
UNDER = 0.22
"""Initial distance from the toy robot to the ground [m]."""
WALK = np.array([0.1, 0.0, 0.0])


@pytest.fixture
def now() -> list[float]:
    return [5.0]


@pytest.fixture
def channel(now: list[float]) -> Iterator[MapChannel]:
    with contextlib.closing(MapChannel(0, GRID, lambda: now[0])) as channel:
        yield channel


def receive(channel: MapChannel) -> list[float]:
    """Return the heights of the next map; the system may deliver it with a delay."""
    before, deadline = channel.newest, time.monotonic() + 30.0
    while (heights := channel.read()) is None or channel.newest is before:
        assert time.monotonic() < deadline
    return heights.tolist()


def test_heights_are_ordered_from_behind_to_ahead_and_right_to_left(channel: MapChannel, now: list[float]) -> None:
    assert channel.read() is None
    assert not channel.is_fresh
    send_map(channel.port, [[-0.3, -0.31], [-0.32, -0.33], [5.0, -0.35]], age=0.05)
    assert receive(channel) == [-0.3, -0.31, -0.32, -0.33, 1.0, -0.35]
    assert channel.age == pytest.approx(0.05)
    now[0] += GRID.age + MAX_DELAY - 0.051
    channel.read()
    assert channel.is_fresh
    now[0] += 0.002
    assert channel.read() is not None
    assert not channel.is_fresh


def test_unknown_heights_get_the_known_height_nearest_to_the_middle(channel: MapChannel) -> None:
    send_map(channel.port, [[None, -0.31], [None, -0.33], [-0.34, None]])
    assert receive(channel) == [-0.33, -0.31, -0.33, -0.33, -0.34, -0.33]


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"[]", b'{"age": 0}', b'{"heights": 3}', b'{"heights": [[0, 0], [0, 0]]}'),
        *(b'{"heights": [[0, 0], [0, 0], %s]}' % row for row in (b"[0]", b"[0, NaN]", b'[0, "1"]', b"[0, [0]]", b"0")),
        *(b'{"heights": [[0, 0], [0, 0], [0, 0]], %s}' % more for more in (b'"age": -1', b'"age": 1e9', b'"x": 1')),
        b'{"heights": [[null, null], [null, null], [null, null]]}',
        b'{"heights": [[0, 0], [0, 0], [0, 0]]}' + b" " * 20_000,
    ],
)
def test_invalid_maps_are_counted_and_ignored(channel: MapChannel, data: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(data, ("127.0.0.1", channel.port))
    send_map(channel.port, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    assert receive(channel) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    assert channel.rejected == 1


class Seeing:
    """A policy that records its observations and has no feedback."""

    def __init__(self, contract: Contract) -> None:
        self.contract, self.seen = contract, []

    def feedback(self, observation: np.ndarray) -> np.ndarray:
        self.seen.append(observation[0].copy())
        return np.zeros((1, len(self.contract.action_names)))


@pytest.fixture
def run(toy, link, robot, monitor, tmp_path) -> Callable[..., SimpleNamespace]:
    """Run a perceptive policy; a map is sent with every state while `sends` is true of the robot's time [s]."""

    def play(sends: Callable[[float], bool], steps: int = 150) -> SimpleNamespace:
        task = load_task("steer", robot=robot.name)[0]
        task = replace(task, observations=(*task.observations, "height_scan"))
        policy = Seeing(contract_from_task(task, robot))
        maps = MapChannel(0, policy.contract.height_map, link.clock.now)
        armed: list[float] = []

        def sensors(moment, readings):
            if toy.firmware.armed and not armed:
                armed.append(moment)
            if sends(moment - armed[0] - STARTUP_TIME if armed else -1.0):
                send_map(maps.port, [[-UNDER - FALLS * moment] * len(POLICY_GRID.left)] * len(POLICY_GRID.ahead))
            return readings

        toy.sensors = sensors
        starts: list[float] = []
        source = SimpleNamespace(read=lambda moment: WALK, start=lambda: starts.append(link.clock.now() - armed[0]))
        stop = SimpleNamespace(stops=0)
        deployment = Deployment(link, Controller(policy, robot), stop, monitor, commands=source, maps=maps)
        with contextlib.closing(maps):
            deployment.connect(lambda handshake: None)
            saver, timing = RunSaver(deployment, tmp_path / "run.npz", steps), LoopTiming(5000)
            saver.begin()
            outcome = deployment.run(saver.recorder, timing)
            trace = saver.finish(outcome, timing, None).trace
        return SimpleNamespace(outcome=outcome, trace=trace, policy=policy, starts=starts)

    return play


def test_a_policy_gets_its_map_and_follows_commands_while_maps_arrive(run, monitor) -> None:
    done = run(lambda moment: True)
    assert (done.outcome.ended, done.outcome.safe) == ("time", False)
    assert monitor.warnings == []
    assert done.trace.command == pytest.approx(np.tile(WALK, (150, 1)))
    assert done.starts == [pytest.approx(STARTUP_TIME, abs=0.1)]  # commands from before the robot stands don't count
    columns = done.policy.contract.columns
    seen = done.trace.observation[:, [columns.index(name) for name in columns if name.startswith("ground")]]
    assert seen.shape == (150, len(POLICY_GRID.ahead) * len(POLICY_GRID.left))
    sent = done.trace.meta["robot_time_start"] + done.trace.time - 2 * done.policy.contract.control_step
    np.testing.assert_array_equal(done.trace.height_map, seen)
    assert done.trace.meta["height_map"]["ahead"] == pytest.approx(done.policy.contract.height_map.ahead)
    assert seen == pytest.approx(-UNDER - FALLS * np.tile(sent, (seen.shape[1], 1)).T, abs=FALLS * 0.025)


def test_the_robot_stands_while_its_map_is_late(run, monitor) -> None:
    done = run(lambda moment: not 0.5 < moment < 1.5)
    assert (done.outcome.ended, done.outcome.safe) == ("time", False)
    (warning,) = monitor.warnings
    assert warning == "the height map was late; the robot stands until the next one"
    contract = done.policy.contract
    time = contract.control_step * np.arange(150)
    late = 0.5 + contract.height_map.age + MAX_DELAY
    walks, stands = (np.isclose(done.trace.command, one).all(axis=1) for one in (WALK, STAND_COMMAND))
    # States, and with them maps, are sent once per control step; each phase has one additional step.
    margin = 0.15
    assert walks[(time < late - margin) | (time > 1.5 + margin)].all()
    assert stands[(time > late + margin) & (time < 1.5 - margin)].all()


def test_the_robot_sits_when_maps_stay_away(run, toy) -> None:
    done = run(lambda moment: moment < 0.3, steps=400)
    assert (done.outcome.ended, done.outcome.reason, done.outcome.safe) == ("stopped", "map", True)
    assert "the latest height map is 2.0 s old; at most 2" in done.outcome.text
    assert toy.kinds()[-1] == "Disarm"
    ran = len(done.trace.time) * done.policy.contract.control_step
    assert ran == pytest.approx(0.3 + SafetyLimits.map_age, abs=0.15)


def test_without_a_map_no_motor_moves(run, toy) -> None:
    with pytest.raises(SurefootError, match=r"no height map arrived at port \d+ within 1 s; start the program"):
        run(lambda moment: False)
    assert "Arm" not in toy.kinds()
