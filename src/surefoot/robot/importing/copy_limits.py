"""Limits of the copies that an MJCF requests, checked before MuJoCo creates them.

MuJoCo's time grows with the square of these counts: 20 s for 100,000 keyframes, 9 s for a grid of 9,000 bodies.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from surefoot.errors import SurefootError

MAX_COPIES = 1000
"""Maximum number of copies of an element, including all enclosing replicates, and of keyframes."""
_COUNT_ATTRIBUTES = {"size": ("nkey",), "replicate": ("count",), "flexcomp": ("count",)}
"""Attributes with a count, by element; several numbers are multiplied."""


def check_copies(root: ElementTree.Element, path: Path) -> None:
    """Reject an MJCF with a count over `MAX_COPIES`; counts of nested replicates multiply.

    Raises:
        SurefootError: a count is too large.
    """
    # Elements, each with the number of times that its enclosing replicates copy it.
    left = [(root, 1.0)]
    while left:
        element, times = left.pop()
        for key in _COUNT_ATTRIBUTES.get(element.tag, ()):
            count = _product(element.get(key, ""))
            total = times * count
            if total > MAX_COPIES:
                around = f", or {total:.10g} with its enclosing replicates" if times > 1 else ""
                raise SurefootError(
                    f"{path}: {key} of <{element.tag}> is {count:.10g}{around}; it must be {MAX_COPIES} or less: "
                    "remove what is not part of the robot"
                )
            times = total if element.tag == "replicate" else times
        left += [(child, times) for child in element]


def _product(text: str) -> float:
    """Return the product of an attribute's numbers; 1 if it has none, which MuJoCo's parser rejects."""
    try:
        # max(1.0, nan) is 1.0 in this order of arguments.
        return math.prod(max(1.0, float(word)) for word in text.split())
    except ValueError:
        return 1.0
