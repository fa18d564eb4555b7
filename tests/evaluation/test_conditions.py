"""Evaluation conditions: each field changes only its part of a policy's task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import Condition, data_sheet_task, episode_duration, undisturbed_task
from surefoot.robot import RobotDescription
from surefoot.task.config import load_task
from surefoot.task.pushes import PushConfig

ROBOT = RobotDescription.load("go2")
TASK = replace(
    load_task("steer", "go2")[0],
    actuator="dc",
    params={"servo_kp": 30.0, "contact_friction": 0.7, "control_step": 0.016},
    randomize={"base_mass_ratio": (0.8, 1.2)},
    randomize_ramp=3,
    pushes=PushConfig(enabled=True, ramp=2, probability=0.5),
)
TASK = replace(TASK, commands=replace(TASK.commands, ramp=4))


def test_by_default_the_robot_is_nominal_and_not_pushed():
    calm = replace(TASK.pushes, enabled=False, ramp=0, probability=1.0)
    plain = replace(TASK, randomize={}, randomize_ramp=0, pushes=calm, commands=replace(TASK.commands, ramp=0))
    plain = replace(plain, physics_step=0.0)
    assert Condition(terrain=None).apply(TASK, ROBOT) == plain
    assert Condition().apply(TASK, ROBOT).terrain.ground == "flat"
    kept = Condition(terrain=None, curricula=True).apply(TASK, ROBOT)
    assert kept == replace(plain, randomize_ramp=3, commands=TASK.commands)


@pytest.mark.parametrize(
    ("condition", "changes"),
    [
        (Condition(params={"imu_noise": 0.1}), {"params": {**TASK.params, "imu_noise": 0.1}}),
        (Condition(data_sheet=True), {"params": {"servo_kp": 30.0, "control_step": 0.016}}),
        (Condition(randomize={"imu_noise": (0.0, 0.1)}), {"randomize": {"imu_noise": (0.0, 0.1)}}),
        (Condition(pushes=True), {"pushes": PushConfig(enabled=True)}),
        (
            Condition(push_force=(10.0, 20.0)),
            {"pushes": PushConfig(enabled=True, force=(10.0, 20.0), direction="horizontal")},
        ),
        (Condition(pushes=PushConfig(enabled=True, ramp=7)), {"pushes": PushConfig(enabled=True, ramp=7)}),
        (Condition(thermal_protection=True), {"thermal_protection": True}),
        (Condition(duration=1.6), {"max_steps": 100}),
        (Condition(duration=1.6, params={"control_step": 0.008}), {"max_steps": 200}),
    ],
)
def test_a_condition_changes_only_its_fields(condition: Condition, changes: dict[str, object]):
    plain, changed = Condition().apply(TASK, ROBOT), condition.apply(TASK, ROBOT)
    assert {name: getattr(changed, name) for name in changes} == changes
    allowed = {*changes, "params"}
    assert replace(changed, **{name: getattr(plain, name) for name in allowed}) == plain


def test_commands_come_from_a_whole_file_or_are_constant_per_episode(tmp_path: Path):
    own = episode_duration(TASK)
    for end, duration in ((1.0, own), (own, own + 2.0)):
        (tmp_path / "way.csv").write_text(f"time,forward,sideways,yaw_rate\n0,0.5,0,0\n{end},0,0,0\n")
        task = Condition(commands=tmp_path / "way.csv").apply(TASK, ROBOT)
        assert episode_duration(task) == pytest.approx(duration, abs=0.016)
        assert task.commands.schedule == ((0.0, 0.5, 0.0, 0.0), (end, 0.0, 0.0, 0.0))
    assert Condition(command_rows=((0.5, 0.0, 0.1),)).apply(TASK, ROBOT).commands.each == ((0.5, 0.0, 0.1),)
    trot = load_task("trot", "go2")[0]
    with pytest.raises(SurefootError, match="task 'go2-trot' has no commands to follow"):
        Condition(commands=tmp_path / "way.csv").apply(trot, ROBOT)


def test_robots_with_commands_start_with_random_headings_on_terrain():
    assert Condition(terrain="slope:10").apply(TASK, ROBOT).terrain.heading == 180.0
    assert Condition(terrain="slope:10").apply(load_task("trot", "go2")[0], ROBOT).terrain.heading == 0.0
    with pytest.raises(SurefootError, match="size is 9 m"):
        Condition(terrain="stairs:9").apply(TASK, ROBOT)


def test_evaluations_have_the_data_sheets_step_of_physics():
    task = load_task("steer", "go2")[0]
    assert task.physics_step == 0.004
    assert Condition("x").apply(task, RobotDescription.load("go2")).physics_step == 0.0


def test_commands_of_a_condition_replace_those_of_the_task(tmp_path: Path):
    task, go2 = load_task("steer", "go2")[0], RobotDescription.load("go2")
    row = (0.1, 0.0, 0.0)
    constant = Condition("x", command_rows=(row,)).apply(task, go2)
    again = Condition("x", command_rows=(row, row)).apply(constant, go2)
    assert (len(again.commands.each), again.commands.schedule) == (2, ())
    (tmp_path / "walk.csv").write_text("time,forward,sideways,yaw_rate\n0,0.1,0,0\n")
    scheduled = Condition("x", commands=tmp_path / "walk.csv").apply(constant, go2)
    assert (len(scheduled.commands.schedule), scheduled.commands.each) == (1, ())


def test_the_undisturbed_task_has_no_randomization_pushes_and_curricula():
    home = undisturbed_task(TASK)
    assert (home.randomize, home.pushes) == ({}, replace(TASK.pushes, enabled=False))
    assert (TASK.randomize_ramp, TASK.commands.ramp) != (0, 0)
    assert (home.randomize_ramp, home.commands.ramp) == (0, 0)
    own = {name: getattr(TASK, name) for name in ("randomize", "pushes", "randomize_ramp", "commands")}
    assert replace(home, **own) == TASK


def test_the_data_sheet_task_has_the_robot_of_the_data_sheet():
    ideal = replace(TASK, actuator="constraint", params_source={"file": "robot.toml"})
    away = replace(undisturbed_task(TASK), params={"servo_kp": 30.0, "control_step": 0.016}, params_source={})
    assert data_sheet_task(ideal) == away
