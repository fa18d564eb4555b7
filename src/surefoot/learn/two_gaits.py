"""A policy's network of two: one for each gait, where the reference has one of its own over holes."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn


class TwoGaits(nn.Module):
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


def with_first_gait(policy: Mapping[str, torch.Tensor], one: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the parameters of a policy of two gaits with those of a policy of one as its first network."""
    return {**policy, **{name.replace("mlp.", "mlp.first."): value for name, value in one.items()}}
