"""Policies that are symmetric by their weights."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict

from surefoot.learn.config import load_train_config
from surefoot.learn.normalization import update_normalizer
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.learn.symmetric_network import PolicySymmetry
from surefoot.learn.symmetry import Reflection
from surefoot.world.sim_world import SimWorld


class Mirror:
    """Mirror images of observations (left, right, roll, phase) and actions (left, right)."""

    reflections = {  # noqa: RUF012
        "policy": Reflection(torch.tensor([1, 0, 2, 3]), torch.tensor([1.0, 1.0, -1.0, -1.0])),
        "actions": Reflection(torch.tensor([1, 0]), torch.tensor([-1.0, -1.0])),
    }


def make_policy(hidden: tuple[int, ...]) -> tuple[MLPModel, PolicySymmetry]:
    """Return a policy with a normalizer that has seen symmetric observations."""
    torch.manual_seed(0)
    groups = TensorDict({"policy": torch.zeros(1, 4)}, batch_size=[1])
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}
    actor = MLPModel(
        groups, {"actor": ["policy"]}, "actor", 2, hidden, "elu", obs_normalization=True, distribution_cfg=distribution
    )
    symmetry = PolicySymmetry(actor, Mirror())  # type: ignore[arg-type]
    observations = torch.randn(50, 4) + torch.tensor([1.0, 2.0, 3.0, 4.0])
    update_normalizer(actor.obs_normalizer, observations, symmetry.observations)
    return actor, symmetry


def outputs(actor: MLPModel, observations: torch.Tensor) -> torch.Tensor:
    return actor(TensorDict({"policy": observations}, batch_size=[len(observations)]))


@pytest.mark.parametrize("hidden", [(6,), (8, 6), (7, 5)])  # the last unit of an odd number is its own partner
def test_a_symmetric_policy_maps_mirror_images_to_mirror_images(hidden: tuple[int, ...]) -> None:
    actor, symmetry = make_policy(hidden)
    observe, act = Mirror.reflections["policy"], Mirror.reflections["actions"]
    observations = torch.randn(20, 4)
    assert not symmetry.holds()
    assert not torch.allclose(outputs(actor, observe(observations)), act(outputs(actor, observations)))
    before = [parameter.detach().clone() for parameter in actor.mlp.parameters()]
    symmetry.impose()
    assert symmetry.holds()
    torch.testing.assert_close(outputs(actor, observe(observations)), act(outputs(actor, observations)))
    # The first half of the first layer is as it was drawn.
    half = hidden[0] // 2
    assert torch.equal(actor.mlp[0].weight[:half], before[0][:half])
    assert outputs(actor, observations).std() > 0.05


def test_hidden_units_are_pairs_that_see_mirrored_inputs() -> None:
    actor, symmetry = make_policy((5,))
    symmetry.impose()
    first, last = actor.mlp[0].weight, actor.mlp[-1].weight
    torch.testing.assert_close(first[2:4], first[:2][:, [1, 0, 2, 3]] * torch.tensor([1.0, 1.0, -1.0, -1.0]))
    assert first[4, 0] == first[4, 1]
    assert first[4, 2] == first[4, 3] == 0.0
    torch.testing.assert_close(last[1], -last[0][[2, 3, 0, 1, 4]])
    assert actor.mlp[-1].bias[0] == -actor.mlp[-1].bias[1]


def test_symmetrized_gradients_are_those_of_samples_and_images() -> None:
    actor, symmetry = make_policy((7, 5))
    symmetry.impose()
    observe, act = Mirror.reflections["policy"], Mirror.reflections["actions"]
    observations, targets = torch.randn(20, 4), torch.randn(20, 2)
    both = torch.cat([observations, observe(observations)]), torch.cat([targets, act(targets)])
    gradients = []
    for inputs, wanted in (both, (observations, targets)):
        actor.zero_grad()
        (outputs(actor, inputs) - wanted).square().mean().backward()
        gradients.append([parameter.grad.clone() for parameter in actor.mlp.parameters()])
    symmetry.symmetrize_gradients()
    for expected, plain, parameter in zip(*gradients, actor.mlp.parameters(), strict=True):
        torch.testing.assert_close(parameter.grad, expected)
        assert not torch.allclose(plain, expected)


def test_a_policy_remains_exactly_symmetric_while_it_learns() -> None:
    config = load_train_config("trot", "minitaur")
    assert config.ppo.policy_hidden[0] % 2
    ppo = replace(config.ppo, symmetry=True)
    learner = PpoLearner(replace(config, num_envs=4, steps_per_update=8, threads=1, ppo=ppo), SimWorld)
    first = learner.policy.mlp[0].weight.detach().clone()
    for _ in range(3):
        learner.update()
    assert not torch.equal(learner.policy.mlp[0].weight, first)
    mirror, observation = learner.algorithm.mirror, learner.observation["policy"]
    assert mirror is not None
    images = mirror.mirror("policy", observation)
    actions = learner.act(observation.numpy())
    torch.testing.assert_close(
        torch.from_numpy(learner.act(images.numpy())), mirror.mirror("actions", torch.from_numpy(actions))
    )
    symmetry = learner.algorithm.policy_symmetry
    assert symmetry is not None
    for one in symmetry._parameters:
        assert torch.equal(one.parameter, one.image(one.parameter))


def test_a_state_that_is_not_symmetric_is_not_changed() -> None:
    config = replace(load_train_config("steer", "go2"), num_envs=4, steps_per_update=4, threads=1)
    plain = PpoLearner(replace(config, ppo=replace(config.ppo, symmetry=False)), SimWorld)
    plain.update()
    learner = PpoLearner(config, SimWorld)
    assert learner.algorithm.policy_symmetry is not None
    learner.set_state(plain.get_state())
    assert learner.algorithm.policy_symmetry is None
    for one, other in zip(learner.policy.parameters(), plain.policy.parameters(), strict=True):
        assert torch.equal(one, other)
    symmetric = PpoLearner(config, SimWorld)
    symmetric.update()
    learner.set_state(symmetric.get_state())
    assert learner.algorithm.policy_symmetry is not None


def test_a_normalizer_is_updated_as_by_rsl_rl() -> None:
    reflection, draws = Mirror.reflections["policy"], torch.Generator().manual_seed(0)
    ours, theirs, mirrored, both = (EmpiricalNormalization(4) for _ in range(4))
    for size in (30, 50, 7):
        values = 3.0 * torch.randn(size, 4, generator=draws) + torch.tensor([1.0, 2.0, 3.0, 4.0])
        update_normalizer(ours, values)
        theirs.update(values)
        update_normalizer(mirrored, values, reflection)
        both.update(torch.cat([values, reflection(values)]))
    for one, other in ((ours, theirs), (mirrored, both)):
        torch.testing.assert_close(one.mean, other.mean)
        torch.testing.assert_close(one.std, other.std)
    assert ours.count == theirs.count == mirrored.count
    frozen = EmpiricalNormalization(4, until=0)
    update_normalizer(frozen, values)
    assert torch.equal(frozen.mean, torch.zeros(4))
