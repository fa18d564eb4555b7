"""Data of the page of recorded runs: positions, angles and forces at a constant rate; rejected traces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("viser")

from recordings import data_of, standing_height, swinging

from surefoot.errors import SurefootError
from surefoot.evaluation.foot_forces import foot_forces
from surefoot.report.pages.recorded_runs import MAX_TRACES, ShownTrace, recording_page
from surefoot.robot import RobotDescription
from surefoot.rotations import quat_matrix, rpy_quat
from surefoot.task.trace import IMPORTED_LOG, EpisodeTrace

MakeRun = Callable[..., EpisodeTrace]
GO2 = RobotDescription.load("go2")


def test_rows_are_the_trace_at_a_constant_rate(make_run: MakeRun):
    one = swinging(make_run, speed=0.5, seconds=2.0)
    (run,) = data_of(recording_page([one]))["runs"]
    columns, time = run["columns"], np.arange(101) / 50
    assert run["rows"] == 101
    # Row 0 shows the end of the first control step, because there is no earlier state.
    assert np.allclose(columns["pose"][1:, 0], 0.5 * time[1:], atol=1e-4)
    assert np.allclose(columns["pose"][:, 3:], [1.0, 0.0, 0.0, 0.0])
    swing = 0.2 * np.sin(2 * np.pi * time[1:])
    assert np.allclose(columns["angle"][1:], GO2.resting_angles + swing[:, None], atol=1e-4)
    assert np.allclose(columns["target"] - columns["angle"], 0.05, atol=1e-4)
    assert np.allclose(columns["speed"][1:], [0.5, 0.0, 0.0], atol=1e-3)
    assert not {"command", "push"} & set(columns)
    turning = GO2.joint_angles(GO2.resting_angles + swing[:, None])
    assert np.allclose(columns["joint"][1:], np.column_stack([*turning.values()]), atol=1e-4)
    assert len(run["joints"]) == len(turning)


def test_runs_begin_at_the_origin_and_head_along_x(make_run: MakeRun):
    turn, tilt = np.array(rpy_quat(0.0, 0.0, 2.0)), np.array(rpy_quat(0.1, -0.2, 2.0))
    whole = swinging(make_run, speed=0.5)
    moved = whole.trace.base_position_world @ quat_matrix(turn).T + [3.0, -4.0, 0.0]
    trace = replace(whole.trace, base_position_world=moved, base_quat_world=np.tile(tilt, (len(moved), 1)))
    (run,) = data_of(recording_page([replace(whole, trace=trace)]))["runs"]
    assert np.allclose(run["columns"]["pose"][-1, :2], [1.0, 0.0], atol=1e-3)
    assert np.allclose(np.abs(run["columns"]["pose"][-1, 3:] @ rpy_quat(0.1, -0.2, 0.0)), 1.0, atol=1e-6)


def test_runs_on_terrain_keep_their_position(make_run: MakeRun):
    place = {"base_position_world": np.tile([2.0, 0.5, 0.6], (201, 1))}
    rows = [swinging(make_run, arrays=place, terrain=name) for name in ("slope:20", "slope:20", "flat")]
    data = data_of(recording_page(rows))
    assert data["layout"] == "over"
    assert [run["ground"] for run in data["runs"]] == ["/world/ground0", "/world/ground0", "/world/ground1"]
    columns = data["runs"][0]["columns"]
    np.testing.assert_allclose(columns["pose"][:, :3], np.tile([2.0, 0.5, 0.6], (len(columns["pose"]), 1)), atol=1e-3)
    np.testing.assert_allclose(columns["level"], np.tan(np.radians(20.0)), atol=0.02)
    assert "level" not in data["runs"][2]["columns"]
    assert "on slope:20" in data["runs"][0]["notes"][0]
    with pytest.raises(SurefootError, match=r"^go2: terrain 'lava' does not exist"):
        recording_page([swinging(make_run, terrain="lava:1")])


def test_unmeasured_base_is_shown_at_standing_height(make_run: MakeRun):
    nothing = {"base_position_world": np.full((201, 3), np.nan), "base_quat_world": np.full((201, 4), np.nan)}
    rolled = {"roll_pitch_yaw": np.tile([0.1, -0.2, 3.0], (200, 1)), "foot_contact": np.full((200, 4), np.nan)}
    (run,) = data_of(recording_page([swinging(make_run, arrays=nothing | rolled)]))["runs"]
    assert np.allclose(run["columns"]["pose"][:, :2], 0.0)
    assert np.allclose(run["columns"]["pose"][:, 2], standing_height(GO2), atol=0.02)
    assert np.allclose(run["columns"]["pose"][:, 3:] @ rpy_quat(0.1, -0.2, 0.0), 1.0, atol=1e-6)
    assert not {"speed", "contact"} & set(run["columns"])
    assert any("shown at standing height" in note for note in run["notes"])


def test_base_is_interpolated_across_gaps(make_run: MakeRun):
    one = swinging(make_run, speed=0.5)
    position = one.trace.base_position_world.copy()
    position[50:150] = np.nan
    (run,) = data_of(recording_page([replace(one, trace=replace(one.trace, base_position_world=position))]))["runs"]
    assert np.allclose(run["columns"]["pose"][1:, 0], 0.5 * np.arange(1, 101) / 50, atol=1e-3)
    assert "50.0 % of the rows" in run["notes"][1]
    assert np.isnan(run["columns"]["speed"][40:70, :2]).all()
    assert np.allclose(run["columns"]["speed"][-5:], [0.5, 0.0, 0.0], atol=1e-3)


def test_log_without_readings_shows_its_commands(make_run: MakeRun):
    missing = {name: np.full((200, 12), np.nan) for name in ("motor_angle", "motor_velocity", "motor_torque")}
    time = {"time": 1.6e9 + np.repeat(0.02 * np.arange(100), 2), "energy": np.full(200, np.nan)}
    (run,) = data_of(recording_page([swinging(make_run, arrays=missing | time, world=IMPORTED_LOG)]))["runs"]
    assert run["rows"] == 100
    assert np.allclose(
        run["columns"]["joint"][0], np.column_stack([*GO2.joint_angles(run["columns"]["target"][:1]).values()])
    )
    assert any("12 of 12 motors were not read" in note for note in run["notes"])
    assert not {"torque", "force", "power"} & set(run["columns"])


def test_forces_are_shown_only_for_feet_on_the_ground(make_run: MakeRun):
    one = swinging(make_run)
    hold = -np.einsum(
        "lij,lj->li",
        np.swapaxes(GO2.leg_geometry.foot_kinematics(GO2.resting_angles[GO2.leg_motor_index]).jacobian, -1, -2),
        np.tile([0.0, 0.0, 40.0], (4, 1)),
    )
    torque = np.zeros((200, 12))
    torque[:, GO2.leg_motor_index] = hold
    push = np.zeros((200, 3))
    push[100:, 1] = 50.0
    turned = np.tile(rpy_quat(0.0, 0.0, np.pi / 2), (201, 1))
    trace = replace(one.trace, motor_torque=torque, push_force_world=push, base_quat_world=turned)
    (run,) = data_of(recording_page([replace(one, trace=trace)]))["runs"]
    expected = foot_forces(GO2, one.trace.motor_angle, torque).reshape(200, -1)
    assert np.allclose(run["columns"]["force"][10], expected[19], atol=0.05)  # 0.2 s: on the ground
    assert np.allclose(run["columns"]["force"][35], 0.0, atol=1e-3)  # 0.7 s: in the air
    assert np.allclose(run["columns"]["push"][[10, 90]], [[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]], atol=1e-2)


def test_page_shows_all_kinds_of_robots(make_run: MakeRun):
    names = RobotDescription.available()
    page = recording_page([swinging(make_run, name, seconds=0.2) for name in names], "over")
    data = data_of(page)
    assert [run["name"] for run in data["runs"]] == names
    assert len({run["color"] for run in data["runs"]}) == len(names)
    assert data["layout"] == "over"
    assert len(page) < 2e6


def test_long_run_has_fewer_rows(make_run: MakeRun):
    one = swinging(make_run, seconds=2.0)
    slow = replace(one.trace, time=one.trace.time * 900.0)
    data = data_of(recording_page([replace(one, trace=slow)]))
    assert 19_900 < data["runs"][0]["rows"] <= 20_001


def test_texts_of_traces_can_not_end_the_script(make_run: MakeRun):
    evil = "</script><script>alert(1)</script><!--"
    one = replace(swinging(make_run, world=evil, policy=evil), name=evil)
    page = recording_page([one])
    assert evil not in page
    assert data_of(page)["runs"][0]["name"] == evil


@pytest.mark.parametrize(
    ("name", "arrays", "message"),
    [
        ("go2", {"time": 1e300 * np.arange(1, 201)}, "the maximum is 3600 s"),
        ("go2", {"motor_angle": np.full((200, 12), 1e9)}, "the maximum is"),
        ("go2", {"base_position_world": np.linspace(0, 1e200, 603).reshape(201, 3)}, "the maximum is"),
        ("minitaur", {"motor_angle": np.zeros((200, 8))}, "can't close its loop"),
    ],
)
def test_page_rejects_values_that_can_not_be_shown(
    make_run: MakeRun, name: str, arrays: dict[str, np.ndarray], message: str
):
    with pytest.raises(SurefootError, match=message):
        recording_page([swinging(make_run, name, arrays=arrays)])


def test_page_rejects_another_robot_and_too_many_traces(make_run: MakeRun):
    one = swinging(make_run)
    with pytest.raises(SurefootError, match="was recorded on robot 'go2'"):
        ShownTrace("x", RobotDescription.load("solo8"), one.trace)
    for number in (0, MAX_TRACES + 1):
        with pytest.raises(SurefootError, match=f"{number} traces are given"):
            recording_page([one] * number)
