"""Task configuration: presets, YAML files and errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.configuration import to_mapping, write_yaml
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.config import FeedbackConfig, TaskConfig, load_task, preset_names
from surefoot.task.leg_config import WaveConfig
from surefoot.task.reference_config import SineReferenceConfig


def test_gallop_learns_from_scratch_and_trot_follows_a_reference():
    gallop, trot = load_task("gallop")[0], load_task("trot")[0]
    assert gallop.reference.kind == "none"
    assert gallop.feedback.swing == (-0.5, 0.5)
    np.testing.assert_allclose(gallop.feedback.extension, (np.pi / 2 - 0.5, np.pi / 2 + 0.5), atol=1e-6)
    assert trot.reference.kind == "sine"
    assert trot.feedback.swing == trot.feedback.extension == (-0.25, 0.25)
    assert trot.pushes.force == (130.0, 220.0)


def load(tmp_path: Path, text: str) -> TaskConfig:
    (tmp_path / "mine.yaml").write_text(text)
    return load_task(str(tmp_path / "mine.yaml"))[0]


def test_an_empty_table_gives_the_defaults_and_the_files_name(tmp_path):
    assert load(tmp_path, "{}\n") == TaskConfig(name="mine")


def test_a_file_name_may_start_with_a_robot_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "go2-mine.yaml").write_text("{base: trot, robot: go2}")
    assert load_task("go2-mine.yaml")[0].name == "go2-mine"
    assert load_task("go2-mine.yaml")[0].robot == load_task("go2-trot")[0].robot


def test_the_train_table_is_returned_unchanged(tmp_path):
    (tmp_path / "mine.yaml").write_text("train: {steps: 5, seed: 3}\n")
    assert load_task(str(tmp_path / "mine.yaml"))[1] == {"steps": 5, "seed": 3}


def test_a_parameter_has_one_value_or_one_per_motor(tmp_path):
    config = load(tmp_path, "params: {voltage: 15, imu_bias: [0.1, -0.2]}\nparams_source: {file: a.toml}\n")
    assert config.params == {"voltage": 15.0, "imu_bias": (0.1, -0.2)}
    write_yaml(tmp_path / "again.yaml", config)
    assert load_task(str(tmp_path / "again.yaml"))[0] == config


def test_the_path_of_a_table_is_relative_to_the_task_file(tmp_path):
    config = load(tmp_path, "reference: {kind: table, file: sub/gait.csv, period: 0.5}\n")
    assert config.reference.file == str(tmp_path / "sub" / "gait.csv")
    assert config.reference.period == 0.5


@pytest.mark.parametrize("name", preset_names())
def test_a_task_survives_writing_and_reading(tmp_path, name):
    config, _ = load_task(name)
    assert config.name == name
    write_yaml(tmp_path / "again.yaml", config)
    assert load_task(str(tmp_path / "again.yaml"))[0] == config
    assert to_mapping(config)["feedback"]["swing"] == list(config.feedback.swing)


@pytest.mark.parametrize(
    ("text", "pieces"),
    [
        ("robott: minitaur", ["robott is not a key; did you mean robot? ", "choices: name, robot, observations"]),
        ("feedback: {swign: [0, 1]}", ["feedback.swign is not a key", "choices: swing, extension"]),
        ("feedback: {swing: [0, 1, 2]}", ["feedback.swing is [0, 1, 2]", "a list of 2 values, each a number"]),
        ("feedback: {swing: [1, 0]}", ["feedback.swing is [1, 0]", "the lower bound must come first"]),
        ("feedback: 3", ["feedback is 3", "must be a table", "swing, extension"]),
        ("max_steps: 10.5", ["max_steps is 10.5", "a whole number"]),
        ("max_steps: 0", ["max_steps is 0", "1 or more"]),
        ("fall_angle: .nan", ["fall_angle is nan"]),
        ("observations: roll", ["observations is 'roll'", "a list of values, each text"]),
        ("reference: {kind: square}", ["reference.kind is 'square'", "choices: none, sine, table, foot"]),
        ("reference: {swing: {phase: left}}", ["reference.swing.phase is 'left'", "a number or a table"]),
        ("pushes: {enabled: sometimes}", ["pushes.enabled is 'sometimes'", "true or false"]),
        ("pushes: {duration: 2}", ["pushes.duration is 2 s", "below pushes.period 1.2 s"]),
        ("params: {voltage: high}", ["params.voltage is 'high'", "a number"]),
        ("rest: 2", ["rest is 2", "a list of values, each a number or nothing"]),
        ("", ["contains NoneType", "must be a table"]),
        ("- a\n- b", ["contains list", "must be a table"]),
        ("\t- x: {", ["is not YAML"]),
        ("robot: !!python/object:os.system x", ["is not YAML"]),
        ("base: waltz", ["base is 'waltz'", "choices: ", "trot"]),
        ("reward: {}", ["reward has no term; choices: progress, energy"]),
        ("reward: {speed: 1}", ["reward.speed is not a term; choices: progress, energy"]),
        ("reward: {progress: much}", ["reward.progress is 'much'; it must be a number"]),
        ("reward: {progress: 1.0e+7}", ["reward.progress is 1e+07; it must be 1000000 or less"]),
        ("reward_limits: {tilt: 1}", ["reward_limits.tilt is not a term of reward; choices: progress, energy"]),
    ],
)
def test_an_invalid_file_is_rejected_in_one_line(tmp_path, text, pieces):
    with pytest.raises(SurefootError) as caught:
        load(tmp_path, text + "\n")
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{tmp_path / 'mine.yaml'}: ")
    for piece in pieces:
        assert piece in message


def test_an_unknown_task_names_the_presets():
    with pytest.raises(
        SurefootError,
        match=r"'waltz' does not exist; choices: gallop, gallop-robust, scratch, steer, .*of a YAML file",
    ):
        load_task("waltz")


def test_a_relative_reference_narrows_bounds_to_the_range_of_the_legs() -> None:
    go2 = RobotDescription.load(
        "go2"
    )  # legs reach 0.9 of their length, the reference 0.8, and the feedback up to 0.12 more
    gait = load_task("trot", "go2")[0].gait(go2)
    (lowest, highest) = gait.reference.extent()[-1]
    assert gait.low[-1] == -0.12
    assert highest + gait.high[-1] == pytest.approx(0.9)
    assert lowest + gait.low[-1] >= 0.35


def test_bounds_of_feedback_are_kept_if_commands_are_clipped() -> None:
    robot = RobotDescription.load("go2")
    task = load_task("steer", "go2")[0]
    wide = FeedbackConfig(abduction=(-0.3, 0.3), swing=(-0.7, 0.7), extension=(-0.3, 0.9))
    gait = replace(task, feedback=wide).gait(robot)
    lowest, _ = gait.reference.extent()[-1]
    np.testing.assert_allclose(gait.low[::4], [-0.3, -0.7, -0.3])
    # Feedback that stretches the shortest leg of the reference beyond 0.9 is useless.
    np.testing.assert_allclose(gait.high[::4], [0.3, 0.7, 0.9 - lowest])
    state = CommandState(np.zeros((2, 3)), np.ones(2), np.array([0.1, 0.8]))
    for end in (gait.low, gait.high):
        poses = robot.to_pose(gait.motor_targets(np.zeros(2), np.tile(end, (2, 1)), state))
        assert poses[:, -1].min() > 0.35 - 1e-9
        assert poses[:, -1].max() < 0.9 + 1e-9


def test_the_base_of_a_robots_task_is_the_robots_own_task():
    steer, robust, preset = load_task("steer", "go2")[0], load_task("steer-robust", "go2")[0], load_task("steer")[0]
    assert robust.reference == steer.reference != preset.reference
    assert robust.params == steer.params
    assert robust.randomize
    assert not steer.randomize


def test_the_base_of_a_file_is_the_own_task_of_its_robot(tmp_path: Path) -> None:
    robust = load_task("steer-robust", "go2")[0]
    assert load(tmp_path, "base: steer-robust\nrobot: go2\n") == replace(robust, name="mine")
    assert load(tmp_path, "base: steer\n") == replace(load_task("steer", "solo8")[0], name="mine", robot="minitaur")


def test_a_task_with_a_reference_of_another_kind_than_its_base_drops_the_keys_of_that_kind(tmp_path: Path) -> None:
    task = load(tmp_path, "base: trot\nrobot: go2\nreference: {kind: sine, swing: {amplitude: 0.1}}\n")
    assert task.reference == SineReferenceConfig(swing=WaveConfig(amplitude=0.1))
    with pytest.raises(SurefootError, match=r"reference.foot is not a key of kind sine, but of foot, follow; keys of"):
        load(tmp_path, "base: trot\nrobot: go2\nreference: {kind: sine, foot: {height: 0.1}}\n")


@pytest.mark.parametrize("robot", ["minitaur", "go2"])
def test_ranges_are_added_to_the_table_of_the_base(tmp_path: Path, robot: str) -> None:
    base = load_task("trot-robust", robot)[0].randomize
    text = f"base: trot-robust\nrobot: {robot}\nrandomize: {{control_latency: [0.0, 0.01]}}\n"
    assert load(tmp_path, text).randomize == {**base, "control_latency": (0.0, 0.01)}


@pytest.mark.parametrize("robot", ["5", "[go2]", ""])
def test_a_robot_that_is_no_text_is_rejected(tmp_path: Path, robot: str) -> None:
    with pytest.raises(SurefootError, match=r"mine.yaml: robot is .*; it must be the name or folder of a robot"):
        load(tmp_path, f"base: trot\nrobot: {robot}\n")


def test_a_task_overrides_values_of_its_base(tmp_path: Path) -> None:
    base = load_task("trot", "go2")[0]
    changed = "base: trot\nrobot: go2\nreference: {foot: {height: 0.7}}\nmax_steps: 7\ntrain: {steps: 5}\n"
    (tmp_path / "mine.yaml").write_text(changed)
    task, train = load_task(str(tmp_path / "mine.yaml"))
    foot = replace(base.reference.foot, height=0.7)
    assert task == replace(base, name="mine", max_steps=7, reference=replace(base.reference, foot=foot))
    assert train["steps"] == 5
    assert train["ppo"]["policy_hidden"] == [125, 89]
