"""Update of the normalizers of observations."""

from __future__ import annotations

import torch
from rsl_rl.modules import EmpiricalNormalization

from surefoot.learn.symmetry import Reflection


def update_normalizer(
    normalizer: EmpiricalNormalization, values: torch.Tensor, reflection: Reflection | None = None
) -> None:
    """Update a normalizer's mean and variance, as its own method does in several times the time.

    Args:
        normalizer: normalizer of rsl_rl.
        values: new inputs (B, C).
        reflection: the normalizer learns from the mirror images of the inputs too.
    """
    if normalizer.until is not None and normalizer.count >= normalizer.until:
        return
    mean = values.mean(0)
    variance = (values - mean).square().mean(0)
    if reflection is not None:
        image = reflection(mean)
        variance = 0.5 * (variance + variance[reflection.source]) + (0.5 * (mean - image)).square()
        mean = 0.5 * (mean + image)
    normalizer.count += len(values)
    rate = len(values) / int(normalizer.count)
    change = mean - normalizer._mean
    normalizer._mean += rate * change
    normalizer._var += rate * (variance - normalizer._var + change * (mean - normalizer._mean))
    normalizer._std = normalizer._var.sqrt()
