"""How many copies of something an MJCF asks MuJoCo to make, counted before a parser makes them.

MuJoCo's time grows with the square of these numbers: 20 s for 100,000 keyframes, 9 s for a grid of 9,000 bodies.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from surefoot.errors import SurefootError

MAX_COPIES = 1000
"""Copies of one element, in all replicates around it, or keyframes."""
_COUNTS = {"size": ("nkey",), "replicate": ("count",), "flexcomp": ("count",)}
"""Attributes that say how many there are of something, by element; of several numbers the product counts."""


def check_copies(root: ElementTree.Element, path: Path) -> None:
    """Refuse an MJCF with counts over `MAX_COPIES`, where replicates in each other multiply.

    Raises:
        SurefootError: such a count.
    """
    # Elements with how often those around them are made.
    left = [(root, 1.0)]
    while left:
        element, times = left.pop()
        for key in _COUNTS.get(element.tag, ()):
            count = _product(element.get(key, ""))
            total = times * count
            if total > MAX_COPIES:
                around = f", and {total:.10g} with those around it" if times > 1 else ""
                raise SurefootError(
                    f"{path}: {key} of <{element.tag}> is {count:.10g}{around}; it must be {MAX_COPIES} or less: "
                    "leave out what is no part of the robot"
                )
            times = total if element.tag == "replicate" else times
        left += [(child, times) for child in element]


def _product(text: str) -> float:
    """Return the product of the numbers of an attribute; 1 if they are none, which MuJoCo's parser refuses."""
    try:
        # In this order, what is not a number is no number of copies either.
        return math.prod(max(1.0, float(word)) for word in text.split())
    except ValueError:
        return 1.0
