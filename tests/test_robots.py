"""Every released robot: kinematics, standing in both engines, ranges, a policy, a video, the emulator, deployment."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

for module in ("mujoco", "torch", "imageio_ffmpeg"):
    pytest.importorskip(module)

from fault_bench import QUICK  # noqa: E402
from processes import EmulatorHere, assert_rejected, emulators, surefoot  # noqa: E402

from surefoot.evaluation.sensitivity import make_test_worlds  # noqa: E402
from surefoot.learn.config import load_train_config  # noqa: E402
from surefoot.learn.ppo_learner import PpoLearner  # noqa: E402
from surefoot.robot import PhysicalParams, RobotDescription  # noqa: E402
from surefoot.robot.randomization import draw_hidden, load_ranges  # noqa: E402
from surefoot.world.interface import WorldConfig  # noqa: E402
from surefoot.world.mujoco_model import build_model  # noqa: E402
from surefoot.world.sim_world import SimWorld  # noqa: E402


@pytest.fixture(scope="module", params=RobotDescription.available())
def robot(request: pytest.FixtureRequest) -> RobotDescription:
    """Return each released robot."""
    return RobotDescription.load(request.param)


@pytest.fixture(scope="module")
def policy(robot: RobotDescription, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write an untrained trot, which follows the reference."""
    config = replace(load_train_config("trot", robot.name), num_envs=2, threads=1)
    return PpoLearner(config, SimWorld).export(tmp_path_factory.mktemp(robot.name) / "untrained.onnx")


def test_a_robot_stands_equally_in_both_engines(robot: RobotDescription) -> None:
    pytest.importorskip("pybullet")
    stood = []
    for world in (SimWorld(robot, 1, engine=engine) for engine in ("mujoco", "bullet")):
        for _ in range(round(0.5 / robot.timing.control_step)):
            world.step(world.resting_angles[None])
        truth = world.truth()
        assert np.abs(truth.roll_pitch_yaw[0, :2]).max() < 0.1
        assert (truth.foot_contact > 0).all()
        stood.append(truth.base_position_world[0, 2])
    assert stood[1] == pytest.approx(stood[0], rel=0.03)
    masses = sum(mass for mass, _ in world.engine.models[0].mass.values())  # type: ignore[attr-defined]
    assert masses == pytest.approx(build_model(robot).body_subtreemass[0], rel=1e-9)
    assert masses == pytest.approx(robot.urdf.total_mass, rel=1e-9)


def test_parameters_can_be_randomized_within_table_1(robot: RobotDescription) -> None:
    ranges = load_ranges("table1", robot=robot.name)
    worlds = make_test_worlds(ranges, PhysicalParams.nominal(robot), 2)
    assert {row for row, *_ in worlds} == set(ranges)
    drawn = draw_hidden(robot, ranges, 1)
    world = SimWorld(robot, 1, drawn, config=WorldConfig(threads=1))
    world.step(world.resting_angles[None])
    assert isinstance(drawn, PhysicalParams)
    assert not world.truth().diverged.any()


@pytest.fixture
def emulate() -> Iterator[object]:
    """Start emulators whose robots stand up quickly, and which are ended with the test."""
    with mock.patch.multiple("surefoot.deploy.motion_runner", **QUICK), emulators(EmulatorHere) as start:
        yield start


def test_a_policy_is_evaluated_played_and_deployed(robot, policy, emulate, tmp_path) -> None:
    result = surefoot("evaluate", policy, "--episodes", 1, "--json", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["robot"] == robot.name
    result = surefoot("show", policy, "--out", "run.mp4", "--duration", 0.1, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "run.mp4").stat().st_size > 1000
    port = emulate("--lockstep", "--robot", robot.name).port
    words = ("--port", port, "--lockstep", "--duration", 0.3, "--out", "runs", "--json")
    result = surefoot("deploy", policy, *words, cwd=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    (run,) = json.loads(result.stdout)["runs"]
    assert run["ended"] in ("time", "fall")


def test_identification_runs_or_rejects_in_one_line(robot: RobotDescription, tmp_path: Path) -> None:
    result = surefoot("identify", "motor", "--robot", robot.name, "--port", "none", cwd=tmp_path)
    message = "confirm it with --yes" if robot.name == "minitaur" else robot.name
    assert_rejected(result, message)
