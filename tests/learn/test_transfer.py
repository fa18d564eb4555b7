"""Warm starts from the networks of another run, worked by hand and in runs."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.run_folder import RunFolder
from surefoot.learn.training_loop import TrainingLoop
from surefoot.learn.transfer import NETWORK_FIELDS, PRIVILEGED, Network, move_inputs, network_inputs, scale_output
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.height_scan import CRITIC_GRID, POLICY_GRID
from surefoot.world.sim_world import SimWorld

TINY = {
    "num_envs": 16,
    "steps_per_update": 16,
    "steps": 16 * 16 * 2,
    "evaluate_every": 16 * 16 * 2,
    "evaluation_episodes": 2,
    "threads": 1,
    "learning_threads": 1,
    "task": {
        "max_steps": 40,
        "params": {"imu_noise": 0.02},
        "pushes": {"enabled": True, "period": 0.1, "duration": 0.03},
    },
}


def tiny_config(**changes: object) -> TrainConfig:
    return from_mapping(TrainConfig, {**TINY, **changes}, base=load_train_config("trot"))


def train(root: Path, config: TrainConfig, stop_after: int | None = None) -> TrainingLoop:
    loop = TrainingLoop.create(config, RunFolder.create(config, root), SimWorld)
    updates: list[Any] = []
    loop.run(lambda *metrics: updates.append(metrics), lambda: len(updates) == stop_after)
    return loop


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> TrainingLoop:
    return train(tmp_path_factory.mktemp("whole"), tiny_config())


def first_layer(*inputs: float) -> dict[str, torch.Tensor]:
    """Return a network of one hidden unit with weights `inputs`, means of a tenth of them, and stds of ten times."""
    row = torch.tensor([inputs])
    statistics = {"obs_normalizer._mean": 0.1 * row, "obs_normalizer._std": 10 * row}
    count = {"obs_normalizer.count": torch.tensor(7)}
    return {**statistics, **count, "mlp.0.weight": row, "mlp.0.bias": torch.ones(1), "mlp.2.weight": torch.ones(1, 1)}


def test_moved_inputs_worked_by_hand():
    near = POLICY_GRID.nearest(CRITIC_GRID)["ground-2.5.left0.5"]
    assert near == "ground-3.middle"
    network = Network(first_layer(1.0, 2.0), [(0, "a"), (0, "b")])
    critic = Network(first_layer(5.0, 6.0, 7.0, 8.0), [(0, "a"), (0, "b"), (PRIVILEGED, "c"), (PRIVILEGED, near)])
    names = [(0, "b"), (1, "a"), (0, "a"), (0, "c"), (0, "ground-2.5.left0.5"), (0, "unknown")]
    moved = move_inputs(network, Network(first_layer(*[0.5] * 6), names), critic)
    assert moved["mlp.0.weight"].tolist() == [[2.0, 0.0, 1.0, 0.0, 0.0, 0.0]]
    # From the network, the critic's input of the name, the network, the critic's nearest point, and a new network.
    expected = torch.tensor([[2.0, 5.0, 1.0, 7.0, 8.0, 0.5]])
    assert torch.equal(moved["obs_normalizer._mean"], 0.1 * expected)
    assert torch.equal(moved["obs_normalizer._std"], 10 * expected)
    same = ("obs_normalizer.count", "mlp.0.bias", "mlp.2.weight")
    assert all(torch.equal(moved[name], network.parameters[name]) for name in same)


def test_a_layer_of_another_width_is_not_changed():
    network = Network(first_layer(1.0, 2.0, 3.0), [(0, "a"), (0, "b")])
    critic = Network(first_layer(1.0), [(0, "a"), (0, "b")])
    moved = move_inputs(network, Network(first_layer(0.0, 0.0, 0.0), [(0, "a"), (0, "b"), (0, "c")]), critic)
    assert all(torch.equal(value, network.parameters[name]) for name, value in moved.items())


@pytest.mark.parametrize("networks", [["mlp"], ["mlp.first", "mlp.over_holes"]])
def test_scaled_outputs_worked_by_hand(networks: list[str]):
    old = np.array([-1.0, 0.0, 0.2]), np.array([1.0, 1.0, 0.2])
    new = np.array([-2.0, -1.0, 0.2]), np.array([2.0, 3.0, 0.2])
    actor = {"distribution.log_std_param": torch.ones(3)}
    for name in networks:
        actor |= {f"{name}.0.weight": torch.ones(1, 1), f"{name}.0.bias": torch.ones(1)}
        # Layers are ordered by number, not by name.
        actor |= {f"{name}.2.weight": torch.ones(1, 1), f"{name}.2.bias": torch.ones(1)}
        actor |= {f"{name}.10.weight": torch.tensor([[2.0], [4.0], [3.0]])}
        actor |= {f"{name}.10.bias": torch.tensor([1.0, -1.0, 0.5])}
    scaled = scale_output(actor, old, new)
    assert scaled.keys() == actor.keys()
    for name, value in scaled.items():
        if name.endswith("10.weight"):
            # Half the output with bounds twice as wide, a quarter with four times; equal bounds have no effect.
            assert value.tolist() == [[1.0], [1.0], [3.0]]
        elif name.endswith("10.bias"):
            # Action -1 was feedback 0 of the second coordinate, which is action -0.5 now.
            assert value.tolist() == [0.5, -0.5, 0.5]
        else:
            assert torch.equal(value, actor[name])


CHANGES: dict[str, Any] = {
    "name": "other",
    "observations": ["roll", "pitch"],
    "history": 2,
    "feedback": {"swing": [-0.1, 0.1]},
    "action": "joint",
    "memory": 1,
    "rest": [0.0, 2.0],
    "fall_angle": 0.4,
    "fall_height": 0.05,
    "max_steps": 50,
    "commands": {"forward": [0.0, 0.5]},
    "reward": {"progress": 2.0},
    "reward_limits": {"progress": 0.5},
    "pushes": {"enabled": False},
    "terrain": {"ground": "rough:0.02"},
    "randomize": {"motor_friction": [0.0, 0.05]},
    "randomize_ramp": 3,
    "params": {"motor_friction": 0.01},
    "params_source": {"file": "params.yaml"},
    "actuator": "constraint",
    "thermal_protection": True,
    "physics_step": 0.002,
    "start_linear_speed": 0.1,
    "start_angular_speed": 0.2,
}
"""One change per field of a task; some fields can only be changed together with others."""


def test_network_fields_are_complete():
    def interface(task: TaskConfig) -> tuple[object, ...]:
        env = LocomotionEnv(task, 1, SimWorld, threads=1)
        return network_inputs(env, True), env.gait.action_names, env.gait.low.tolist(), env.gait.high.tolist()

    task = load_task("trot")[0]
    before = interface(task)
    assert {field.name for field in fields(TaskConfig)} == {*CHANGES, "robot", "reference"}
    changing = {
        name
        for name, value in CHANGES.items()
        if interface(from_mapping(TaskConfig, {name: value}, base=task)) != before
    }
    # A warm start assumes that these are equal in both runs.
    alike = {"action", "memory", "commands"}
    # The reward depends on the reference.
    assert changing == {*NETWORK_FIELDS, *alike} - {"reference", "reward"}


def test_a_warm_start_may_change_ranges_and_exploration(whole: TrainingLoop, tmp_path: Path) -> None:
    def start(before: TrainingLoop, **task: object) -> TrainingLoop:
        config = tiny_config(start_from=str(before.folder.path), steps=256, task=task, ppo={"start_std": 0.2})
        return TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)

    def first_layer(loop: TrainingLoop) -> dict[str, torch.Tensor]:
        """Return the critic's weights by its privileged inputs."""
        layers = loop.learner.algorithm.save()["critic_state_dict"].values()
        weights = next(value for value in layers if value.dim() == 2 and len(value) > 1)
        columns = loop.learner.env.privileged_columns
        return dict(zip(columns, weights.T[-len(columns) :], strict=True))

    pushed = start(whole, randomize={"motor_friction": [0.0, 0.05]})
    own, learned = (one.learner.algorithm.save()["actor_state_dict"] for one in (pushed, whole))
    spread = "distribution.log_std_param"
    assert all(torch.equal(value, learned[name]) for name, value in own.items() if name != spread)
    assert torch.allclose(own[spread].exp(), torch.tensor(0.2))
    assert not torch.allclose(learned[spread], own[spread])
    before, after = first_layer(whole), first_layer(pushed)
    assert after.keys() - before.keys() == {"motor_friction"}
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert not after["motor_friction"].any()
    pushed.learner.update()
    pushed.save()
    # A new range precedes the others, and pushes are removed.
    last = first_layer(pushed)
    ranges = {"base_mass_ratio": [0.9, 1.1], "motor_friction": [0.0, 0.1]}
    other = first_layer(start(pushed, randomize=ranges, pushes={"enabled": False}))
    assert not other.pop("base_mass_ratio").any()
    assert other.keys() == last.keys() - {"push_x", "push_y"}
    assert last["motor_friction"].any()
    assert all(torch.equal(other[name], last[name]) for name in other)


def test_added_observations_and_history_do_not_change_outputs(whole: TrainingLoop, tmp_path: Path) -> None:
    names = whole.config.task.observations
    task = {"observations": ["height_scan", *reversed(names), "gravity"], "history": 3}
    config = tiny_config(start_from=str(whole.folder.path), task=task)
    loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    rng, inputs = np.random.default_rng(0), []
    numbers: dict[object, np.ndarray] = {}
    for learner in (whole.learner, loop.learner):
        columns = [(age, name) for age in range(learner.env.task.history) for name in learner.env.observer.columns]
        true = [(None, name) for name in learner.env.privileged_columns]
        for one in columns + true:
            numbers.setdefault(one, rng.normal(size=6).astype(np.float32))
        groups = {"policy": columns, "privileged": true}
        stacked = {key: torch.from_numpy(np.stack([numbers[one] for one in ones], 1)) for key, ones in groups.items()}
        inputs.append(TensorDict(stacked, batch_size=[6]))
    actions, values = [], []
    for learner, one in zip((whole.learner, loop.learner), inputs, strict=True):
        actions.append(learner.act(one["policy"].numpy()))
        with torch.inference_mode():
            values.append(learner.algorithm.critic(one).numpy())
    assert inputs[1]["policy"].shape[1] > 3 * inputs[0]["policy"].shape[1]
    np.testing.assert_allclose(actions[1], actions[0], atol=1e-5)
    np.testing.assert_allclose(values[1], values[0], atol=1e-4)
    loop.learner.update()
    assert np.abs(loop.learner.act(inputs[1]["policy"].numpy()) - actions[1]).max() > 1e-4


def test_a_new_observation_has_the_normalization_of_the_critic(tmp_path: Path) -> None:
    terrain = {"ground": "rough:0.02"}
    before = train(tmp_path / "blind", tiny_config(task={"terrain": terrain}), stop_after=1)
    names = before.config.task.observations
    task = {"terrain": terrain, "observations": [*names, "height_scan"]}
    config = tiny_config(start_from=str(before.folder.path), task=task)
    seeing = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    learned, actor = before.learner.algorithm.critic.obs_normalizer, seeing.learner.policy.obs_normalizer
    columns = [*before.learner.env.observer.columns, *before.learner.env.privileged_columns]
    near = POLICY_GRID.nearest(CRITIC_GRID)
    assert near["ground-2.5.left0.5"] == "ground-3.middle"
    places = [columns.index(near[name]) for name in POLICY_GRID.columns()]
    assert (learned.mean[places] < -0.1).all()
    for name in ("mean", "std"):
        assert torch.equal(getattr(actor, name)[-len(places) :], getattr(learned, name)[places])


@pytest.mark.parametrize("task", [{}, {"history": 3}])
def test_a_policy_remains_symmetric_in_a_warm_start(task: dict[str, object], tmp_path: Path) -> None:
    """New inputs have the normalization of the critic, which is not symmetric."""
    before = train(tmp_path / "first", tiny_config(ppo={"symmetry": True}), stop_after=2)
    assert before.learner.algorithm.policy_symmetry is not None
    config = tiny_config(start_from=str(before.folder.path), task=task, ppo={"symmetry": True})
    loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    assert loop.learner.algorithm.policy_symmetry is not None
    asymmetric = train(tmp_path / "other", tiny_config(), stop_after=2)
    config = tiny_config(start_from=str(asymmetric.folder.path), task=task, ppo={"symmetry": True})
    loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    assert loop.learner.algorithm.policy_symmetry is None


def test_start_from_rejects_a_task_without_an_observation_that_the_policy_needs(
    whole: TrainingLoop, tmp_path: Path
) -> None:
    config = tiny_config(start_from=str(whole.folder.path), task={"observations": ["roll", "pitch", "roll_rate"]})
    with pytest.raises(SurefootError, match=r"policy observes pitch_rate, 0 control steps old, which this run's does"):
        TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)


def test_start_from_allows_a_limit_of_a_new_reward_term(whole: TrainingLoop, tmp_path: Path) -> None:
    task = {"reward": {"forward_speed": 0.5}, "reward_limits": {"forward_speed": 0.4}}
    config = tiny_config(start_from=str(whole.folder.path), task=task)
    assert "forward_speed" not in whole.config.task.reward
    loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    assert loop.learner.env.task.reward_limits == {"forward_speed": 0.4}


def test_start_from_rejects_other_actions(whole: TrainingLoop, tmp_path: Path) -> None:
    config = tiny_config(start_from=str(whole.folder.path), task={"memory": 2})
    with pytest.raises(SurefootError, match="start_from: the other run's memory is 0, this run's 2; they must be"):
        TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)


def test_a_policy_gives_the_same_feedback_between_other_bounds(whole: TrainingLoop, tmp_path: Path) -> None:
    task = {"feedback": {"swing": [-0.6, 0.4], "extension": [-0.3, 0.3]}}
    config = tiny_config(start_from=str(whole.folder.path), steps=256, task=task)
    loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    observation = np.random.default_rng(0).normal(size=(5, *whole.learner.env.single_observation_space.shape))
    observation = 0.1 * observation.astype(np.float32)
    feedback = [
        one.learner.env.gait.low
        + 0.5
        * (one.learner.act(observation) + 1)
        * np.ptp([one.learner.env.gait.low, one.learner.env.gait.high], axis=0)
        for one in (whole, loop)
    ]
    assert not np.allclose(whole.learner.env.gait.high, loop.learner.env.gait.high)
    np.testing.assert_allclose(feedback[1], feedback[0], atol=1e-5)


def test_start_from_rejects_networks_of_other_layers(whole: TrainingLoop, tmp_path: Path) -> None:
    config = tiny_config(start_from=str(whole.folder.path), ppo={"policy_hidden": [16]})
    with pytest.raises(SurefootError, match=r"start_from: the other run's networks do not fit"):
        TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    config = tiny_config(start_from=str(tmp_path / "nowhere"))
    with pytest.raises(SurefootError, match=r"nowhere: is not a run folder"):
        TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
