"""Poses that a robot's file or the SRDF beside it names, such as 'home' or 'standing'."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from pathlib import Path

from surefoot.errors import SurefootError
from surefoot.robot.urdf_file import read_xml

Pose = dict[str, float]
"""Angles [rad] by the joint's name."""
_STANDING_NAMES = re.compile(r"stand|half_sitting|home|default|init", re.IGNORECASE)
_MAX_FILES = 20
"""SRDF files that are looked at."""


def order_poses(poses: Iterator[tuple[str, Pose]]) -> tuple[tuple[str, Pose], ...]:
    """Return where each pose is from, and the pose; those whose name says that the robot stands come first."""
    return tuple(sorted(poses, key=lambda item: not is_standing(item[0])))


def is_standing(source: str) -> bool:
    """Return whether where a pose is from, such as "keyframe 'home'", names one in which the robot stands."""
    return bool(_STANDING_NAMES.search(source.split("'")[1]))


def srdf_poses(path: Path) -> Iterator[tuple[str, Pose]]:
    """Yield the states of SRDF files beside a URDF and in folders `srdf` near it; files of its name come first."""
    folder = path.resolve().parent
    files = [file for near in (folder, folder / "srdf", folder.parent / "srdf") for file in sorted(near.glob("*.srdf"))]
    for file in sorted(files[:_MAX_FILES], key=lambda file: file.stem != path.stem):
        with contextlib.suppress(SurefootError):  # it is not the file that was asked for
            for state in read_xml(file).iter("group_state"):
                pose = {}
                for joint in state.iter("joint"):
                    with contextlib.suppress(ValueError):
                        pose[joint.get("name", "")] = float(joint.get("value", ""))
                yield (
                    f"state '{state.get('name', '')}' of {file.name}",
                    {name: angle for name, angle in pose.items() if math.isfinite(angle)},
                )
