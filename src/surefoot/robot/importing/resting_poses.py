"""Named poses such as 'home' or 'standing' in a robot's file or in the SRDF next to it."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from pathlib import Path

from surefoot.errors import SurefootError
from surefoot.robot.urdf_file import read_xml

Pose = dict[str, float]
"""Angles [rad] by joint name."""
_STANDING_NAMES = re.compile(r"stand|half_sitting|home|default|init", re.IGNORECASE)
_MAX_FILES = 20
"""Maximum number of SRDF files that are read."""


def order_poses(poses: Iterator[tuple[str, Pose]]) -> tuple[tuple[str, Pose], ...]:
    """Sort poses and their sources; poses with a name that suggests standing come first."""
    return tuple(sorted(poses, key=lambda item: not is_standing(item[0])))


def is_standing(source: str) -> bool:
    """Return whether the source of a pose, such as "keyframe 'home'", suggests that the robot stands."""
    return bool(_STANDING_NAMES.search(source.split("'")[1]))


def srdf_poses(path: Path) -> Iterator[tuple[str, Pose]]:
    """Yield the group states of SRDF files next to a URDF and in nearby `srdf` folders; a file of its name is first."""
    folder = path.resolve().parent
    files = [file for near in (folder, folder / "srdf", folder.parent / "srdf") for file in sorted(near.glob("*.srdf"))]
    for file in sorted(files[:_MAX_FILES], key=lambda file: file.stem != path.stem):
        with contextlib.suppress(SurefootError):  # the user did not ask for this file, so skip an invalid one
            for state in read_xml(file).iter("group_state"):
                pose = {}
                for joint in state.iter("joint"):
                    with contextlib.suppress(ValueError):
                        pose[joint.get("name", "")] = float(joint.get("value", ""))
                yield (
                    f"state '{state.get('name', '')}' of {file.name}",
                    {name: angle for name, angle in pose.items() if math.isfinite(angle)},
                )
