"""Amplitudes of experiments: the data sheet's numbers and their defaults."""

from __future__ import annotations

import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.experiments import read_experiments

MINITAUR = RobotDescription.load("minitaur")


def test_defaults_are_close_to_the_minitaurs_data_sheet() -> None:
    usual = read_experiments({}, MINITAUR.leg_space["extension"], MINITAUR.actuator)
    for name, value in vars(MINITAUR.experiments).items():
        assert getattr(usual, name) == pytest.approx(value, rel=0.02), name
    # 2.45 N m need 30 A, which is a duty of 30 * 0.186 / 16; a gain of 1 duty/rad commands it at as many rad.
    assert usual.step == pytest.approx(30 * 0.186 / 16)
    assert usual.fraction("step", 0.5) == 0.174


@pytest.mark.parametrize("name", RobotDescription.available())
def test_experiments_of_every_robot_stay_within_its_leg_space(name: str) -> None:
    robot = RobotDescription.load(name)
    low, high = robot.leg_space["extension"]
    moved = robot.experiments
    for extension in (moved.high, moved.low, moved.stance - moved.squat, moved.stance + moved.squat):
        assert low < extension < high


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"stance": -1.0}, "experiments.stance is -1"),
        ({"duty": 1.5}, "experiments.duty"),
        ({"jump": 1}, "is not a key"),
    ],
)
def test_invalid_experiments_are_rejected(table: dict[str, float], message: str) -> None:
    with pytest.raises(SurefootError, match=message):
        read_experiments(table, (0.6, 2.7), MINITAUR.actuator)
