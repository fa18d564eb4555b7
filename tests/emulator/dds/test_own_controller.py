"""The emulated Go2's own controller: modes, postures, and motor commands."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cyclonedds")

from emulated_go2 import STANDING, Robot

from surefoot.deploy.dds.services import BAD_PARAMETER, mode_name
from surefoot.emulator.dds.own_controller import NOT_ACTIVE, OwnController


def test_modes_of_the_own_controller() -> None:
    controller, still = OwnController(), np.zeros(12)
    assert mode_name(controller.check_mode("")[1]) == ""
    assert controller.command(0, still) is None
    assert [request()[0] for request in (controller.stand_up, controller.stand_down, controller.damp)] == [
        NOT_ACTIVE
    ] * 3
    for parameter in ("", "[]", '{"name": "ai"}'):
        assert controller.select_mode(parameter)[0] == BAD_PARAMETER
    assert controller.select_mode('{"name": "mcf"}') == (0, "")
    assert mode_name(controller.check_mode("")[1]) == "mcf"
    motors = controller.command(0, still)["motor_cmd"][:12]
    assert (motors["kp"].max(), motors["kd"].min()) == (0, 3)
    # After its release a standing robot sinks: the last command damps the motors.
    controller.release_mode("")
    assert controller.command(2000, still)["motor_cmd"]["kp"].max() == 0
    assert controller.command(4000, still) is None
    assert not controller.blocked
    controller.select_mode('{"name": "normal"}')
    assert controller.blocked


def test_it_stands_up_lies_down_and_drops_when_damped() -> None:
    robot = Robot()
    robot.controller.activate()
    assert robot.run(0.4)["motor_state"]["tau_est"].max() < 1
    robot.controller.stand_up()
    robot.run(2.2)
    assert robot.height > 0.32
    robot.controller.stand_down()
    robot.run(2.0)
    assert robot.height < 0.15
    assert robot.wire.published[-1]["motor_cmd"]["kp"][0] == 60  # it holds its legs
    robot.controller.stand_up()
    robot.run(2.2)
    robot.controller.damp()
    robot.run(1.0)
    assert robot.height < 0.2
    # It has commanded the motors at 500 Hz throughout.
    assert len(robot.wire.published) == 500 * 7.8


def test_motors_alternate_between_commands_of_two_programs() -> None:
    robot = Robot(rack=True)
    robot.controller.activate()
    robot.run(0.1)
    torques = []
    for _ in range(200):
        robot.command(q=STANDING, kp=60, kd=1)
        torques.append(robot.run(0.002)["motor_state"]["tau_est"][1])
    # It damps the motors, the other program moves them: each gets about half of all servo steps.
    jumps = np.abs(np.diff(torques)) > 2
    assert 0.2 < jumps.mean() < 0.8
    robot.controller.release_mode("")
    robot.run(0.01)
    torques = []
    for _ in range(100):
        robot.command(q=STANDING, kp=60, kd=1)
        torques.append(robot.run(0.002)["motor_state"]["tau_est"][1])
    assert (np.abs(np.diff(torques)) < 2).all()
