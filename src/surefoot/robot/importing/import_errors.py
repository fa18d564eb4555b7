"""Errors of the importer: what a file contains instead of a quadruped, and what to do."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from surefoot.errors import SurefootError, choices
from surefoot.files import check_readable
from surefoot.robot.importing.xacro import explain_xacro, is_xacro

QUADRUPED = "robot new reads quadrupeds: four legs of two or three hinges"
_MESHES = (".stl", ".obj", ".dae", ".ply", ".msh", ".glb", ".gltf", ".fbx", ".3mf", ".step", ".stp")
_ROOTS = {
    "sdf": "is an SDF of Gazebo; convert it to a URDF, or take the URDF that it was made from",
    "COLLADA": "is a mesh; give the URDF or MJCF that names it",
    "package": "describes a ROS package; give the URDF in it",
    "launch": "is a ROS launch file; give the URDF that it loads",
    "mujocoinclude": "is a part that other MJCF files include; give the MJCF that includes it",
}
_MUJOCO = re.compile(
    r"(?:(?:XML )?Error: )*(?P<what>.*?)(?: Element (?P<is_name>name )?'(?P<name>[^']*)')?(?:, id \d+)?"
    r"(?:, line (?P<line>\d+))?"
)
_REASONS = {
    "mjMINVAL": "moves and has no mass or no inertia; state both in its <inertial>",
    "positive eigenvalues": "has an inertia with a moment that is not over 0; correct its <inertial>",
    "mesh volume is too small": "is a mesh without a volume; leave out meshes (--no-meshes)",
}
"""Explanations by a phrase in MuJoCo's message."""


def check_suffix(path: Path) -> None:
    """Reject meshes, empty files and binary files."""
    if path.suffix.lower() in _MESHES:
        raise SurefootError(f"{path}: is a mesh; give the URDF or MJCF that names it")
    try:
        check_readable(path)  # opening a pipe would block
        with path.open("rb") as file:
            start = file.read(1024)
    except OSError:
        return  # the reader reports the reason
    if not start.strip():
        raise SurefootError(f"{path}: is empty; give the URDF or MJCF of a robot")
    if b"\0" in start and not start.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise SurefootError(f"{path}: is a binary file; give the URDF or MJCF of a robot, which is text")


def check_kind(root: ElementTree.Element, path: Path) -> None:
    """Reject files that are neither URDF nor MJCF by their root element, xacro templates, and URDFs without links."""
    if root.tag not in ("mujoco", "robot"):
        kind = _ROOTS.get(root.tag.split("}")[-1])
        kind = kind or f"the root element is <{root.tag}>; a URDF's is <robot>, an MJCF's <mujoco>"
        raise SurefootError(f"{path}: {kind}")
    if root.tag == "robot" and is_xacro(root):
        raise explain_xacro(path)
    if root.tag == "robot" and root.find("link") is None:
        srdf = path.suffix == ".srdf" or root.find("group") is not None or root.find("group_state") is not None
        kind = "is an SRDF, which names groups and poses" if srdf else "has no links"
        raise SurefootError(f"{path}: {kind}; give the URDF of the robot")


def explain_mujoco(message: str, path: Path) -> SurefootError:
    """Convert a message of MuJoCo's parser or compiler to an error about the file."""
    message = " ".join(message.split("The visual elements of the spec")[0].split())
    match = _MUJOCO.fullmatch(message)
    what, name, line = (match["what"], match["name"], match["line"]) if match else (message, None, None)
    if missing := re.search(r"Error opening file '([^']*)'", what):
        return SurefootError(
            f"{path}: names the file '{missing[1]}', which does not exist; put it there, or leave out meshes "
            "(--no-meshes)"
        )
    for words, reason in _REASONS.items():
        if name is not None and words in what:
            return SurefootError(f"{path}: '{name}' {reason}")
    place = ", ".join(
        [
            *([f"line {line}"] if line else []),
            *([f"'{name}'" if match and match["is_name"] else f"<{name}>"] if name else []),
        ]
    )
    return SurefootError(f"{path}: MuJoCo can't read it: {f'{place}: ' if place else ''}{what}")


def check_legs(
    path: Path, base: str, chains: Sequence[Sequence[str]], branches: str | None, coupled: str, slides: Sequence[str]
) -> None:
    """Reject robots that are not quadrupeds with serial legs of two or three hinges.

    Args:
        path: the file.
        base: name of the body to which the legs are attached.
        chains: joint names of each leg, from the base to the foot.
        branches: name of a leg body with more than one child, or None.
        coupled: how the legs are coupled, such as "closed loops"; empty if they are not.
        slides: names of leg bodies whose joint is not a single hinge.
    """
    lengths = [len(chain) for chain in chains]
    counts = choices(f"{length}" for length in lengths)
    structure = f"'{base}' has {len(chains)} chains of {counts} joints"
    by_hand = "five-bar legs need a data sheet that is written by hand, like the Minitaur's"
    why = None
    if len(chains) == 1:
        why = f"is an arm or another single chain: '{base}' has one chain of {lengths[0]} joints"
    elif len(chains) == 2 or (branches and max(lengths) > 3):
        branching = f", which branch at {branches!r}" if branches else ""
        why = f"is a biped, humanoid or other robot: {structure}{branching}"
    elif coupled or branches:
        why = f"has {coupled or f'legs that branch at {branches!r}'}; {by_hand}"
    elif len(chains) == 8 and max(lengths) <= 2:
        why = f"has two chains per leg ({structure}); {by_hand}"
    elif len(chains) != 4:
        why = f"has {len(chains)} legs: {structure}"
    elif len(set(lengths)) > 1 or not 2 <= lengths[0] <= 3:
        why = f"its legs have {counts} hinges; all must have 2, or all 3"
    elif slides:
        why = f"body '{slides[0]}' does not have a single hinge, but a sliding joint, a ball joint, or several joints"
    if why:
        raise SurefootError(f"{path}: {why}" + ("" if by_hand in why else f"; {QUADRUPED}"))
