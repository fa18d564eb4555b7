"""Policies that are left-right symmetric by their weights, so that mirror images of samples need not be run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from rsl_rl.models import MLPModel
from torch import nn

from surefoot.learn.symmetry import MirrorSamples, Reflection, swap_halves

_TOLERANCE = 1e-6
"""Differences between a parameter and its image that come from rounding."""


class _SymmetricParameter(NamedTuple):
    """A parameter that equals its image in a symmetric policy."""

    parameter: torch.Tensor
    reflection: Reflection
    """Reflection of its flattened elements."""

    def image(self, values: torch.Tensor) -> torch.Tensor:
        """Return the image of values in the shape of the parameter."""
        return self.reflection(values.flatten()).view_as(values)


class PolicySymmetry:
    """Left-right symmetry of an MLP policy p: M p(x) = p(M x), where M is the mirror image.

    Hidden units are pairs: unit k + H // 2 of H sees mirrored inputs with the weights of unit k (with an odd H the last
    unit is its own partner). A symmetric policy's gradient for samples and their mirror images is the mean of the
    gradient for the samples and its image. Hence it learns from both in the time of one, and remains symmetric
    (Ordonez-Apraez et al. 2023, "On discrete symmetries of robotics systems").

    Args:
        actor: policy with an MLP; its normalizer is part of it.
        mirror: mirror images of its observations and actions.
    """

    def __init__(self, actor: MLPModel, mirror: MirrorSamples) -> None:
        self._normalizer = actor.obs_normalizer
        self.observations = mirror.reflections["policy"]
        """Mirror image of the observations."""
        layers = [layer for layer in actor.mlp if isinstance(layer, nn.Linear)]
        self._parameters: list[_SymmetricParameter] = []
        before = self.observations
        for layer in layers:
            units = layer.out_features
            pairs = Reflection(torch.from_numpy(swap_halves(units)), torch.ones(units))
            after = mirror.reflections["actions"] if layer is layers[-1] else pairs
            self._parameters += [
                _SymmetricParameter(layer.weight, _reflect_matrix(after, before)),
                _SymmetricParameter(layer.bias, after),
            ]
            before = after
        sizes = Reflection(before.source, torch.ones_like(before.sign))  # standard deviations have no sign
        self._parameters.append(_SymmetricParameter(actor.distribution.log_std_param, sizes))

    def impose(self) -> None:
        """Make a new policy symmetric: the first parameter of each pair determines the second."""
        with torch.no_grad():
            for one in self._parameters:
                image, source = one.image(one.parameter), one.reflection.source.view_as(one.parameter)
                place = torch.arange(source.numel()).view_as(source)
                # An element that is its own partner is the mean of both, which is 0 where the sign changes.
                own = torch.where(source == place, 0.5 * (one.parameter + image), one.parameter)
                one.parameter.copy_(torch.where(source < place, image, own))

    def mirror_unused_inputs(self) -> None:
        """Make the statistics of inputs without weights symmetric, such as those that a warm start has added."""
        weight = self._parameters[0].parameter
        unused = (weight == 0.0).all(0)
        unused &= unused[self.observations.source]
        for buffer, image in self._statistics():
            buffer[:, unused] = 0.5 * (buffer + image)[:, unused]

    def holds(self) -> bool:
        """Return whether the policy is symmetric up to rounding."""
        pairs = [(one.parameter, one.image(one.parameter)) for one in self._parameters]
        pairs += [(buffer, image) for buffer, image in self._statistics()]
        return all(torch.allclose(*pair, rtol=_TOLERANCE, atol=_TOLERANCE) for pair in pairs)

    def symmetrize_gradients(self) -> None:
        """Replace gradients for samples by those for the samples and their mirror images."""
        for one in self._parameters:
            if (gradient := one.parameter.grad) is not None:
                gradient.add_(one.image(gradient)).mul_(0.5)

    def remove_rounding(self) -> None:
        """Remove the differences between images that rounding makes."""
        with torch.no_grad():
            for one in self._parameters:
                one.parameter.add_(one.image(one.parameter)).mul_(0.5)
            for buffer, image in self._statistics():
                buffer.copy_(0.5 * (buffer + image))

    def _statistics(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """Yield the statistics of the normalizer with their images."""
        yield self._normalizer._mean, self.observations(self._normalizer._mean)
        for buffer in (self._normalizer._var, self._normalizer._std):
            yield buffer, buffer[:, self.observations.source]


def _reflect_matrix(rows: Reflection, columns: Reflection) -> Reflection:
    """Return the reflection of a flattened matrix whose rows and columns are reflected."""
    source = rows.source[:, None] * len(columns.source) + columns.source
    return Reflection(source.flatten(), (rows.sign[:, None] * columns.sign).flatten())
