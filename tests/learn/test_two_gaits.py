"""A policy's network of two gaits."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from surefoot.learn.two_gaits import TwoGaits, with_first_gait, without_gait_over_holes
from surefoot.policy.graph import Graph
from surefoot.policy.network import INPUT
from surefoot.policy.torch_graph import trace_module


def both() -> TwoGaits:
    """Return a network whose gaits give 1 + the second input, and 10 times it; the first input is the share."""
    first, over = nn.Linear(2, 1), nn.Linear(2, 1)
    with torch.no_grad():
        for layer, weight, bias in ((first, 1.0, 1.0), (over, 10.0, 0.0)):
            layer.weight[:] = torch.tensor([0.0, weight])
            layer.bias.fill_(bias)
    return TwoGaits(nn.Sequential(first), nn.Sequential(over), 0, 0.5)


def test_the_share_blends_both_gaits():
    given = torch.tensor([[0.0, 3.0], [0.25, 3.0], [0.5, 3.0]])
    np.testing.assert_allclose(both()(given).detach().numpy()[:, 0], [4.0, 17.0, 30.0])


def test_only_the_network_over_holes_learns():
    network = both()
    network(torch.tensor([[0.25, 1.0]])).sum().backward()
    learns = {name: one.grad is not None for name, one in network.named_parameters()}
    assert learns == {
        "first.0.weight": False,
        "first.0.bias": False,
        "over_holes.0.weight": True,
        "over_holes.0.bias": True,
    }


def test_it_can_be_a_policy_file():
    trace_module(both(), Graph(), INPUT, 2, 1)


@pytest.mark.parametrize("bias", [0.0, 2.0])
def test_parameters_of_a_policy_of_one_gait_go_in_and_out(bias: float):
    one = {"mlp.0.weight": torch.ones(1), "mlp.0.bias": torch.tensor([bias]), "distribution.std": torch.ones(1)}
    two = {f"mlp.{part}.0.{name}": torch.zeros(1) for part in ("first", "over_holes") for name in ("weight", "bias")}
    joined = with_first_gait({**two, "distribution.std": torch.zeros(1)}, one)
    assert {name: float(value) for name, value in joined.items()} == {
        "mlp.first.0.weight": 1.0,
        "mlp.first.0.bias": bias,
        "mlp.over_holes.0.weight": 0.0,
        "mlp.over_holes.0.bias": 0.0,
        "distribution.std": 1.0,
    }
    assert {name: float(value) for name, value in without_gait_over_holes(joined).items()} == {
        name: float(value) for name, value in one.items()
    }
