"""A policy network of two: one for each gait, where the reference has a gait of its own over holes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from rsl_rl.models import MLPModel
from torch import nn

from surefoot.task.config import TaskConfig
from surefoot.task.observation import OVER_HOLES


class GaitSwitch(nn.Module):
    """Two networks with the same inputs; the share of the gait over holes, one of these, blends their outputs.

    The first one does not learn: it is another run's policy, which keeps what it can do.

    Args:
        first: takes normalized observations (N, O), gives (N, A).
        over_holes: the same, over holes.
        column: of the share.
        unit: number there that is a share of 1.
    """

    def __init__(self, first: nn.Module, over_holes: nn.Module, column: int, unit: float) -> None:
        super().__init__()
        self.first, self.over_holes, self.column, self.unit = first.requires_grad_(False), over_holes, column, unit

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return the outputs (N, A) for inputs (N, O)."""
        share, first = inputs[:, self.column : self.column + 1] / self.unit, self.first(inputs)
        blended: torch.Tensor = first + share * (self.over_holes(inputs) - first)
        return blended


class GaitSwitchArchitecture:
    """Policy network of tasks with `reference.over_holes`; see `networks.Architecture`."""

    setting = "reference.over_holes"

    def applies_to(self, task: TaskConfig) -> bool:
        """Return whether the reference has a gait over holes."""
        return task.reference.over_holes is not None

    def build(self, actor: MLPModel, columns: Sequence[str], make_mlp: Callable[[], nn.Module]) -> None:
        """Make the actor's MLP the gait over holes, beside another one that does not learn.

        Inputs are normalized as the first network knows them: the normalizer does not learn either, and divides inputs
        that are new by 1 + eps.
        """
        normalizer = actor.obs_normalizer
        normalizer.until = 0
        actor.mlp = GaitSwitch(make_mlp(), actor.mlp, columns.index(OVER_HOLES), 1.0 / (1.0 + normalizer.eps))

    def adopt(self, fresh: Mapping[str, torch.Tensor], single: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the parameters with those of a policy of one gait as the first network's."""
        return {**fresh, **{name.replace("mlp.", "mlp.first."): value for name, value in single.items()}}
