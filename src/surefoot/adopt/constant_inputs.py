"""Constant inputs of an adopted network: placeholders for quantities that were measured in training, or settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from surefoot.adopt.builder import CONSTANTS_EFFECT, NetworkSizes, PolicyBuilder, adopted_specification
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription


@dataclass(frozen=True)
class ConstantInputs:
    """Number and effect of a network's constant inputs."""

    count: int
    """Number of constants."""
    total: int
    """Number of inputs."""
    effect: float | None = None
    """Change of a joint target [rad] if the most influential constant changes by 1; None if unknown."""

    @property
    def text(self) -> str:
        """Message about the constant inputs."""
        text = f"{self.count} of {self.total} inputs of the network are constants"
        if self.effect is not None:
            text += f"; if one of them changes by 1, the targets of the joints change by up to {self.effect:.2g} rad"
        return f"{text}: what were these inputs in training?"


def constant_inputs(contract: Contract, robot: RobotDescription) -> ConstantInputs | None:
    """Return the constant inputs of an adopted policy, or None if it has none."""
    specification, adopted = adopted_specification(contract), contract.figures.get("adopted")
    if specification is None or not isinstance(adopted, Mapping):
        return None
    maker = PolicyBuilder(specification, NetworkSizes(None, len(specification.joints)), robot)
    if not maker.constant_places:
        return None
    effect = adopted.get(CONSTANTS_EFFECT)
    known = float(effect) if isinstance(effect, int | float) else None
    return ConstantInputs(len(maker.constant_places), len(maker.rows), known)
