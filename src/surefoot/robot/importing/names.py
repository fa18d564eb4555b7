"""Name of an imported robot, from its file name, the name in the file and its package folder."""

from __future__ import annotations

import re
from pathlib import Path

_GENERIC_NAMES = re.compile(r"^(robot|model|urdf|mjcf|main|description|scene.*|world)$")
"""Generic file names, which do not identify the robot."""
_SUFFIXES = re.compile(r"(_(simple|description|robot|urdf|mjcf|scene))+$")


def robot_name(path: Path, inside: str) -> str:
    """Return a name for the robot, of letters, digits and _.

    The default is the file name. The name in the file is preferred if the file name starts with it (hyq_no_sensors:
    hyq) or is generic (scene). The package name is preferred if it starts with the name chosen so far (anymal in
    anymal_c_simple_description: anymal_c).

    Args:
        path: the file.
        inside: name of the robot in the file, or "".
    """
    stem, inside = _clean(path.stem), _clean(inside)
    packages = [folder for folder in path.resolve().parents[:3] if folder.name.endswith("_description")]
    package = _clean(packages[0].name) if packages else ""
    name = stem
    if _GENERIC_NAMES.match(stem):
        name = next((one for one in (inside, package, _clean(path.resolve().parent.name)) if one), stem)
    elif inside and stem.startswith(f"{inside}_"):
        name = inside
    return package if package.startswith(f"{name}_") else name


def _clean(text: str) -> str:
    return _SUFFIXES.sub("", re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_"))
