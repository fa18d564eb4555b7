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
            total = times * max(count, 1.0)
            if total > MAX_COPIES:
                around = f", in others {total:g} in all" if times > 1 else ""
                raise SurefootError(
                    f"{path}: <{element.tag}> has a {key} of {count:g}{around}; at most {MAX_COPIES} are read"
                )
            times = total if element.tag == "replicate" else times
        left += [(child, times) for child in element]


def _product(text: str) -> float:
    """Return the product of the numbers of an attribute; 1 if they are none, which MuJoCo's parser refuses."""
    try:
        return math.prod(max(float(word), 1.0) for word in text.split())
    except ValueError:
        return 1.0
