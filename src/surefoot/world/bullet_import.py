"""Import of PyBullet without its output."""

from __future__ import annotations

import sys
from types import ModuleType

from surefoot.native_output import quiet


def import_pybullet() -> ModuleType:
    """Import PyBullet without its banner.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    if "pybullet" in sys.modules:
        return sys.modules["pybullet"]
    with quiet():
        import pybullet
    module: ModuleType = pybullet
    return module
