"""What reports in Markdown share."""

from __future__ import annotations

import math
from collections.abc import Sequence

from surefoot.evaluate.gap import Estimate


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
    # What rounds to zero has no sign.
    mean = round(estimate.mean, digits) + 0.0
    text = f"{mean:{'+' if sign and mean else ''}.{digits}f}"
    return f"{text} ± {estimate.error:.{digits}f}" if math.isfinite(estimate.error) else text
