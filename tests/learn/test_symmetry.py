"""Mirror images: worked by hand, and compared in the physics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from odd_quadrupeds import urdf
from tensordict import TensorDict

from surefoot.api.training import check_config, symmetry_note
from surefoot.errors import SurefootError
from surefoot.learn.config import PPOConfig, TrainConfig, load_train_config
from surefoot.learn.networks import make_algorithm
from surefoot.learn.symmetry import (
    MirrorSamples,
    is_half_period_shifted,
    mirror_columns,
    mirror_motors,
    mirror_name,
)
from surefoot.robot import RobotDescription
from surefoot.robot.importing.reader import read_robot
from surefoot.robot.importing.writer import write_robot
from surefoot.robot.randomization import load_ranges
from surefoot.task.config import FeedbackConfig, TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.leg_config import WaveConfig
from surefoot.task.observation import PARTS
from surefoot.task.pushes import PushConfig
from surefoot.task.reference_config import SineReferenceConfig
from surefoot.world.sim_world import SimWorld


def make_env(task: TaskConfig, num_envs: int = 2) -> LocomotionEnv:
    return LocomotionEnv(task, num_envs, SimWorld, seed=3, threads=1)


def test_mirrored_columns_worked_by_hand():
    names = ["roll", "pitch", "angle.front_left_1", "angle.front_right_1", "phase_sin"]
    assert mirror_name("back_right_2_motor") == "back_left_2_motor"
    source, sign = mirror_columns(names)
    assert source.tolist() == [0, 1, 3, 2, 4]
    assert sign.tolist() == [-1, 1, 1, 1, 1]
    assert mirror_columns(names, half_period=True)[1].tolist() == [-1, 1, 1, 1, -1]
    source, sign = mirror_columns(
        ["foothold_x.front_left", "foothold_x.front_right", "foothold_y.front_left", "foothold_y.front_right"]
    )
    assert source.tolist() == [1, 0, 3, 2]
    assert sign.tolist() == [1, 1, -1, -1]


def test_a_column_without_counterpart_is_rejected():
    with pytest.raises(SurefootError, match=r"angle\.right_1.*no counterpart"):
        mirror_columns(["angle.left_1"])


def test_a_column_whose_counterpart_has_another_sign_is_rejected():
    names = ["side.left", "side.right"]
    assert mirror_columns(names, extra_flipped=names)[1].tolist() == [-1, -1]
    with pytest.raises(SurefootError, match=r"mirror image of side\.right is not side\.left with the same sign"):
        mirror_columns(names, extra_flipped=["side.left"])


def test_numbers_of_the_memory_are_pairs():
    names = ["roll", *(f"memory.{k}" for k in range(5))]
    source, sign = mirror_columns(names)
    assert source.tolist() == [0, 3, 4, 1, 2, 5]
    assert sign.tolist() == [-1, 1, 1, 1, 1, 1]


def test_legs_that_are_not_called_left_and_right_are_rejected():
    robot = RobotDescription.load("go2")
    legs = [replace(leg, name=leg.name.replace("left", "l").replace("right", "r")) for leg in robot.legs]
    with pytest.raises(SurefootError, match=r"leg front_[lr] has no counterpart; legs must be called left and right"):
        mirror_motors(replace(robot, legs=type(robot.legs)(legs)))


def test_bounds_that_are_no_mirror_images_are_rejected():
    task = replace(load_task("trot", "go2")[0], action="joint")
    for joint, fits in (((-0.3, 0.3), True), ((-0.2, 0.5), False)):
        env = make_env(replace(task, feedback=replace(task.feedback, joint=joint)))
        if fits:
            MirrorSamples(env)
            continue
        with pytest.raises(SurefootError, match=r"from -0\.2 to 0\.5, and in the mirror image from -0\.5 to 0\.2"):
            MirrorSamples(env)


def wave(*phase: float) -> TaskConfig:
    """Return a task whose reference has these phases: front left, back left, front right, back right."""
    phases = dict(zip(("front_left", "back_left", "front_right", "back_right"), phase, strict=True))
    waves = SineReferenceConfig(
        swing=WaveConfig(amplitude=0.2, frequency=2.0, phase=phases),
        extension=WaveConfig(amplitude=0.2, frequency=2.0, phase=phases, offset=2.0),
    )
    return TaskConfig(reference=waves, feedback=FeedbackConfig((-0.1, 0.1), (-0.1, 0.1)))


@pytest.mark.parametrize(
    ("phases", "half"),
    [
        ((0.0, np.pi, np.pi, 0.0), True),  # trot
        ((0.0, 0.0, np.pi, np.pi), True),  # pace
        ((0.0, np.pi, 0.0, np.pi), False),  # bound
    ],
)
def test_the_mirror_image_of_a_reference_is_itself_or_half_a_period_later(phases, half):
    assert is_half_period_shifted(make_env(wave(*phases))) is half


def test_a_reference_that_is_not_symmetric_is_rejected():
    with pytest.raises(SurefootError, match=r"ppo\.symmetry.*not left-right symmetric"):
        is_half_period_shifted(make_env(wave(0.0, 1.0, 2.0, 3.0)))


@pytest.mark.parametrize(("longer", "is_mirror"), [(0.0005, True), (0.004, False), (0.02, False)])
def test_a_robot_whose_sides_differ_trains_with_mirrored_samples_up_to_half_a_percent(
    longer: float, is_mirror: bool, tmp_path: Path
):
    (tmp_path / "odd.urdf").write_text(urdf(longer))
    write_robot(read_robot(tmp_path / "odd.urdf"), tmp_path / "odd", "odd")
    config = load_train_config("trot", str(tmp_path / "odd"))
    config = replace(config, num_envs=2, steps_per_update=4, threads=1)
    assert config.ppo.symmetry
    check_config(config)
    env = make_env(config.task)
    observation, _ = env.reset()
    groups = {"policy": torch.from_numpy(observation), "privileged": torch.from_numpy(env.privileged())}
    algorithm = make_algorithm(config, env, TensorDict(groups, batch_size=[2]))
    assert (algorithm.mirror is not None) is is_mirror
    note = symmetry_note(config)
    assert (note is None) is is_mirror
    if note is not None:
        for words in (f"back_left's upper link is {1e3 * longer:.2g} mm longer", "limit 2 mm", "--ppo.no-symmetry"):
            assert words in note
    assert symmetry_note(replace(config, ppo=replace(config.ppo, symmetry=False))) is None


def test_a_gait_that_is_not_symmetric_is_rejected_before_a_run_is_made():
    config = TrainConfig(task=wave(0.0, 1.0, 2.0, 3.0), ppo=PPOConfig(symmetry=True), threads=1)
    with pytest.raises(SurefootError, match=r"--ppo\.no-symmetry learns without mirrored samples"):
        check_config(config)
    check_config(replace(config, ppo=PPOConfig()))


@pytest.fixture(scope="module")
def trot_env() -> LocomotionEnv:
    task = replace(
        load_task("trot")[0],
        observations=tuple(name for name in PARTS if name not in ("command", "footholds", "over_holes")),
        history=2,
        randomize=load_ranges("table1"),
        pushes=PushConfig(enabled=True),
    )
    return make_env(task)


@pytest.mark.parametrize(("action", "name"), [("leg", "scratch"), ("joint", "trot"), ("angle", "scratch")])
def test_the_last_action_is_mirrored_like_the_action(action: str, name: str):
    task = replace(load_task(name, "go2")[0], action=action, observations=("roll", "last_action"))
    mirror = MirrorSamples(LocomotionEnv(task, 1, SimWorld, threads=1))
    ones = mirror.mirror("actions", torch.ones(1, 12))
    assert torch.equal(mirror.mirror("policy", torch.ones(1, 13))[:, 1:], ones)


def test_mirroring_twice_gives_the_sample(trot_env):
    mirror, generator = MirrorSamples(trot_env), torch.Generator().manual_seed(0)
    for group, width in (("policy", trot_env.single_observation_space.shape[0]), ("actions", 8)):
        values = torch.randn(5, width, generator=generator)
        image = mirror.mirror(group, values)
        assert not torch.equal(image, values)
        assert torch.equal(mirror.mirror(group, image), values)


def test_privileged_observations_have_column_names(trot_env):
    assert len(trot_env.privileged_columns) == trot_env.privileged().shape[1]
    assert len(set(trot_env.privileged_columns)) == len(trot_env.privileged_columns)


def test_a_mirrored_robot_moves_like_the_mirror_image():
    # The second robot gets the mirrored actions half a period later: its observations must be mirror images.
    task = replace(
        load_task("trot")[0],
        observations=tuple(
            name
            for name in PARTS
            if name not in ("reference_phase", "command", "height_scan", "footholds", "over_holes")
        ),
        start_linear_speed=0.0,
        start_angular_speed=0.0,
        pushes=PushConfig(),
    )
    pronk = wave(0.0, 0.0, 0.0, 0.0).reference
    env = make_env(replace(task, reference=pronk, feedback=FeedbackConfig((-0.2, 0.2), (-0.2, 0.2))))
    mirror = MirrorSamples(env)
    draws = np.random.default_rng(1)
    observation, _ = env.reset()
    for _ in range(40):
        actions = draws.uniform(-1, 1, (2, 8)).astype(np.float32)
        actions[1] = mirror.mirror("actions", torch.from_numpy(actions[:1])).numpy()[0]
        observation, *_ = env.step(actions)
        image = mirror.mirror("policy", torch.from_numpy(observation[:1])).numpy()[0]
        np.testing.assert_allclose(observation[1], image, atol=5e-3)
    rates = [env.observer.columns.index(name) for name in ("roll_rate", "pitch_rate")]
    assert np.abs(observation[0, rates]).max() > 0.02
