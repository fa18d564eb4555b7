"""Experiments connect to a robot over both links; a Go2 over DDS receives the user's gains."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surefoot.cli.helpers import link_options
from surefoot.cli.helpers.identify_run import ExperimentCommand, run_experiment
from surefoot.cli.helpers.output import print_warning
from surefoot.cli.identify import _check_options
from surefoot.deploy.robot_link import close_link
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


def test_a_go2_that_is_not_given_back_is_a_warning(capsys: pytest.CaptureFixture[str]):
    def close() -> None:
        raise SurefootError("--hand-back: the robot does not lie still; its controller is not activated")

    close_link(SimpleNamespace(close=close), print_warning)  # type: ignore[arg-type]
    assert capsys.readouterr().err.startswith("surefoot: warning: --hand-back: the robot does not lie still")


def test_a_go2_is_given_back_after_the_experiment_only(monkeypatch: pytest.MonkeyPatch):
    go2, events = RobotDescription.load("go2"), list[Any]()

    class Link:
        def __init__(self, hands_back: bool) -> None:
            self.hands_back = hands_back

        def connect(self) -> SimpleNamespace:
            return SimpleNamespace(robot="go2", angle_low=np.full(12, -1.0), angle_high=np.full(12, 1.0))

        def close(self) -> None:
            events.append(("close", self.hands_back))

    def ask(place: str) -> None:
        events.append("ask")
        if refuses:
            raise SurefootError("not confirmed; nothing has moved")

    where = "surefoot.cli.helpers.identify_run"
    monkeypatch.setattr(link_options, "open_dds_link", lambda *words: Link(words[-1]))
    for name, function in (
        ("check_terminal", lambda place: None),
        ("check_robot", lambda *_: None),
        ("show_plan", lambda *_: None),
        ("ask_to_move", ask),
        ("_run", lambda *_: events.append("run")),
    ):
        monkeypatch.setattr(f"{where}.{name}", function)
    command, plan = ExperimentCommand(link="dds", interface="eth0", hand_back=True), SimpleNamespace(rack=True)
    refuses = False
    run_experiment(command, plan, go2, Path("recording.npz"))  # type: ignore[arg-type]
    assert events == [("close", False), "ask", "run", ("close", True)]
    events.clear()
    refuses = True
    with pytest.raises(SurefootError, match="not confirmed"):
        run_experiment(command, plan, go2, Path("recording.npz"))  # type: ignore[arg-type]
    assert events == [("close", False), "ask", ("close", True)]
