"""What reports in Markdown share."""

from __future__ import annotations

import math
from collections.abc import Sequence

from surefoot.evaluate.gap import Estimate
from surefoot.evaluate.statistics import decimal


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table; all columns but the first are aligned to the right."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, rule, *lines))


def plus_minus(estimate: Estimate, digits: int = 2, sign: bool = False) -> str:
    """A mean with its standard error, such as `1.20 ± 0.15`; the mean alone where the error is not known.

    Args:
        estimate: what is told.
        digits: behind the point.
        sign: write + before what is above zero.
    """
    mean = decimal(estimate.mean, digits, sign)
    return f"{mean} ± {decimal(estimate.error, digits)}" if math.isfinite(estimate.error) else mean
