"""Maps with another grid, frame, sign or unit are rejected with a message, for heights as programs would send them."""

from __future__ import annotations

import contextlib
import time

import numpy as np
import pytest

from surefoot.deploy.map_channel import MapChannel, send_map
from surefoot.deploy.map_check import check_at_rest, check_grid, check_standing
from surefoot.errors import SurefootError
from surefoot.policy.contract import HeightMap
from surefoot.robot import RobotDescription
from surefoot.task.height_scan import POLICY_GRID

LEVEL = [0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def go2() -> RobotDescription:
    return RobotDescription.load("go2")


@pytest.fixture(scope="module")
def grid(go2) -> HeightMap:
    return HeightMap(*POLICY_GRID.scale(go2), age=0.04)


def heights(grid: HeightMap, value: float) -> np.ndarray:
    return np.full(len(grid.ahead) * len(grid.left), value)


def test_a_map_of_level_ground_is_accepted_for_a_lying_or_standing_robot(go2, grid):
    for value in (-0.07, -0.2, -0.31, -0.35):
        check_at_rest(heights(grid, value), grid, go2)
    check_standing(heights(grid, -0.31), grid, go2, go2.resting_angles, LEVEL)
    check_standing(heights(grid, -0.35), grid, go2, go2.resting_angles, LEVEL)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (0.0, "at 0.00 m in the map, but the robot stands 0.31 m above it: are the heights in the world frame?"),
        (0.31, "at 0.31 m in the map, but the robot stands 0.31 m above it: are the heights positive downward?"),
        (-310.0, "at -310.00 m in the map, but the robot stands 0.31 m above it: are the heights in millimetres?"),
        (-31.0, "are the heights in centimetres?"),
        (-3.0, "0.31 m above it. Heights must be relative to the base's origin, positive upward, in metres"),
    ],
)
def test_wrong_frames_signs_and_units_are_reported(go2, grid, value, message):
    with pytest.raises(SurefootError) as caught:
        check_at_rest(heights(grid, value), grid, go2)
    assert message in str(caught.value)
    with pytest.raises(SurefootError) as caught:
        check_standing(heights(grid, value), grid, go2, go2.resting_angles, LEVEL)
    assert message in str(caught.value)


def test_a_robot_on_a_slope_has_its_feet_on_the_map(go2, grid):
    # The base pitches up on ground that rises ahead, so heights increase with the distance ahead.
    pitch = -0.2
    slope = np.repeat(-0.31 / np.cos(pitch) - np.tan(pitch) * np.array(grid.ahead), len(grid.left))
    check_standing(slope, grid, go2, go2.resting_angles, [0.0, pitch, 1.0])
    with pytest.raises(SurefootError, match="the ground under the base is at"):
        check_standing(slope + 0.2, grid, go2, go2.resting_angles, [0.0, pitch, 1.0])


def test_a_stated_grid_must_be_the_policys(grid):
    ahead, left = list(grid.ahead), list(grid.left)
    check_grid({"ahead": [round(x, 3) for x in ahead], "left": left}, grid)
    for changed, message in (
        ({"left": [y / 2 for y in left]}, "the map's points are 0.02662 m apart to the left, the policy's 0.05325"),
        ({"ahead": ahead[1:]}, "the map has 18 points ahead, the policy 19"),
        ({"ahead": [x + 0.1 for x in ahead]}, "the map's points begin -0.2195 m ahead, the policy's -0.3195"),
        ({"left": left[::-1]}, "the map's points are -0.05325 m apart to the left"),
        ({"left": 3}, "the map's left must be numbers"),
    ):
        with pytest.raises(SurefootError) as caught:
            check_grid(changed, grid)
        assert message in str(caught.value)


def test_a_channel_accepts_maps_of_its_grid_and_reports_why_others_are_rejected(grid):
    rows = heights(grid, -0.31).reshape(len(grid.ahead), -1).tolist()
    with contextlib.closing(MapChannel(0, grid)) as channel:
        send_map(channel.port, rows[1:])
        send_map(channel.port, rows, grid=grid)
        deadline = time.monotonic() + 30.0
        while channel.read() is None:
            assert time.monotonic() < deadline
    assert channel.rejected == 1
    assert channel.last_error == "the map has 18 x 13 points, the policy 19 x 13"
