"""Array type of numeric data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array in double precision; docstrings state its shape."""
