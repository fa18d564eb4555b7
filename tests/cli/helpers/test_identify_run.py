"""Experiments connect to a robot over both links; a Go2 over DDS receives the user's gains."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from surefoot.cli.helpers import link_options
from surefoot.cli.helpers.identify_run import ExperimentCommand
from surefoot.cli.identify import _check_options
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription


def test_a_go2_over_dds_receives_the_given_gains(monkeypatch: pytest.MonkeyPatch):
    go2, opened = RobotDescription.load("go2"), []

    def open_dds_link(*words: Any) -> str:
        opened.append(words)
        return "link"

    monkeypatch.setattr(link_options, "open_dds_link", open_dds_link)
    command = ExperimentCommand(link="dds", interface="eth0", settings=(("servo_kp=20", "servo_kd=1.5"),))
    _check_options(command)
    assert command.open_robot(go2) == "link"
    robot, interface, domain, gains, *_ = opened[0]
    assert (robot, interface, domain, gains) == (go2, "eth0", 0, (20.0, 1.5))
    ExperimentCommand(link="dds", interface="eth0").open_robot(go2)
    np.testing.assert_array_equal(opened[1][3], (go2.actuator.kp, go2.actuator.kd))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "--recording of an experiment; neither is given"),
        (
            {"port": "/dev/ttyUSB0", "settings": (("servo_kp=20",),)},
            "--set requires --link dds; a robot on a serial port",
        ),
        ({"link": "dds"}, "--interface is missing"),
        (
            {"link": "dds", "interface": "eth0", "settings": (("motor_friction=1",),)},
            "--set names motor_friction; it must be",
        ),
        ({"port": "/dev/ttyUSB0", "interface": "eth0"}, "--interface is given; it requires --link dds"),
    ],
)
def test_options_that_do_not_go_together_are_rejected(options: dict[str, Any], message: str):
    with pytest.raises(SurefootError, match=message):
        _check_options(ExperimentCommand(**options))
