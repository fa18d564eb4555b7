"""Handcrafted gaits as files, and in a simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import run_episodes
from surefoot.learn.config import load_train_config
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.handcrafted import HandcraftedGait, OpenLoop
from surefoot.task.leg_config import FootConfig
from surefoot.task.observation import IMU_4D
from surefoot.task.raibert import HISTORY, OBSERVATIONS, RaibertConfig, RaibertController
from surefoot.task.reference_config import FootReferenceConfig
from surefoot.task.trace import EpisodeTrace
from surefoot.world.sim_world import SimWorld

TROT = {"front_left": 0.0, "back_left": 0.5, "front_right": 0.5, "back_right": 0.0}
FOOT = FootConfig(frequency=2.5, stroke=0.13, clearance=0.04, duty_factor=0.55, phase=TROT, height=0.23)
TASK = TaskConfig(
    name="hand",
    observations=OBSERVATIONS,
    history=HISTORY,
    reference=FootReferenceConfig(foot=FOOT),
    feedback=FeedbackConfig((-0.25, 0.25), (-0.25, 0.25)),
    max_steps=250,
)
GAIT = HandcraftedGait(TASK, RaibertConfig(pitch=0.5, pitch_rate=0.05, roll=0.5, roll_rate=0.05), {"seed": 3})


@pytest.mark.parametrize("gait", [GAIT, HandcraftedGait(replace(TASK, observations=IMU_4D, history=1))])
def test_a_saved_gait_is_read_back_as_gait_and_as_task(tmp_path: Path, gait: HandcraftedGait):
    path = tmp_path / "hand.yaml"
    gait.save(path)
    assert HandcraftedGait.load(path) == gait
    assert load_train_config(str(path)).task == gait.task


def test_a_gait_without_gains_is_open_loop():
    assert isinstance(GAIT.policy(), RaibertController)
    open_loop = replace(GAIT, raibert=None).policy()
    assert isinstance(open_loop, OpenLoop)
    assert open_loop.feedback(np.ones((3, 5))).tolist() == [[0.0] * 8] * 3


def run(gait: HandcraftedGait, **params) -> EpisodeTrace:
    task = replace(gait.task, params=params)
    return run_episodes(gait.policy(), task, 1, SimWorld, seed=4, threads=1)[0]


def test_raiberts_controller_corrects_a_measured_tilt():
    """An IMU that measures a pitch of 0.1 rad (nose down) makes the front legs longer and the nose too high."""
    low, high = (run(GAIT, imu_bias=(0.0, bias)).roll_pitch_yaw[50:, 1].mean() - bias for bias in (0.1, -0.1))
    assert low < high - 0.02
    left, right = (run(GAIT, imu_bias=(bias, 0.0)).roll_pitch_yaw[50:, 0].mean() - bias for bias in (0.1, -0.1))
    assert left < right - 0.02


def test_the_speed_estimate_is_near_the_true_speed():
    trace, policy = run(GAIT), GAIT.policy()
    assert isinstance(policy, RaibertController)
    rows = np.stack([trace.observation[k : k + HISTORY][::-1].reshape(-1) for k in range(50, 220)])
    true = (trace.base_position_world[220, 0] - trace.base_position_world[50, 0]) / (170 * 0.006)
    assert 0.1 < true < 0.4
    assert policy.speed(rows).mean() == pytest.approx(true, abs=0.06)


@pytest.mark.parametrize(
    ("text", "piece"),
    [
        ("reference: {kind: foot}", "handcrafted is missing; the file is a task"),
        ("handcrafted: {}", "task.reference.kind is 'none'; a handcrafted gait has a reference of kind foot"),
        ("reference: {kind: foot}\nhandcrafted: {gains: 1}", "handcrafted.gains is not a key; choices: raibert, about"),
        (
            "reference: {kind: foot}\nhandcrafted: {raibert: {pitch: 1000}}",
            "raibert.pitch is 1000; it must be 100 or less",
        ),
        ("reference: {kind: foot}\nhandcrafted: 3", "handcrafted is 3; it must be a table"),
        ("reference: {kind: foot, foot: {strok: 1}}\nhandcrafted: {}", "reference.foot.strok is not a key"),
    ],
)
def test_an_invalid_file_is_rejected_in_one_line(tmp_path: Path, text: str, piece: str):
    path = tmp_path / "hand.yaml"
    path.write_text(text + "\n")
    with pytest.raises(SurefootError) as caught:
        HandcraftedGait.load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert piece in message
