"""Policy network for references with a second gait over holes: one network per gait, blended by an observation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from rsl_rl.models import MLPModel
from torch import nn

from surefoot.task.config import TaskConfig
from surefoot.task.observation import OVER_HOLES


class GaitSwitchNetwork(nn.Module):
    """Two networks with the same inputs. One input, the blend weight of the gait over holes, blends their outputs.

    The first network is the frozen policy of another run, so that its skill is kept.

    Args:
        first: network for the first gait, from normalized observations (N, O) to outputs (N, A).
        over_holes: network for the gait over holes.
        column: index of the input with the blend weight.
        unit: normalized value of this input for a blend weight of 1.
    """

    def __init__(self, first: nn.Module, over_holes: nn.Module, column: int, unit: float) -> None:
        super().__init__()
        self.first, self.over_holes, self.column, self.unit = first.requires_grad_(False), over_holes, column, unit

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the outputs (N, A) for inputs (N, O)."""
        weight, first = inputs[:, self.column : self.column + 1] / self.unit, self.first(inputs)
        blended: torch.Tensor = first + weight * (self.over_holes(inputs) - first)
        return blended


class GaitSwitchArchitecture:
    """Architecture of policies for tasks with `reference.over_holes`; see `networks.Architecture`."""

    setting = "reference.over_holes"

    def applies_to(self, task: TaskConfig) -> bool:
        """Return whether the task's reference has a gait over holes."""
        return task.reference.over_holes is not None

    def build(self, actor: MLPModel, columns: Sequence[str], make_mlp: Callable[[], nn.Module]) -> None:
        """Use the actor's MLP for the gait over holes, and add a frozen one for the first gait.

        The normalizer is also frozen, so that inputs are normalized as the first network expects. It divides new inputs
        by 1 + eps.
        """
        normalizer = actor.obs_normalizer
        normalizer.until = 0
        actor.mlp = GaitSwitchNetwork(make_mlp(), actor.mlp, columns.index(OVER_HOLES), 1.0 / (1.0 + normalizer.eps))

    def initial_parameters(
        self, fresh: Mapping[str, torch.Tensor], single: Mapping[str, torch.Tensor]
    ) -> dict[str, torch.Tensor]:
        """Return the parameters, with a single-gait policy as the first network."""
        return {**fresh, **{name.replace("mlp.", "mlp.first."): value for name, value in single.items()}}
