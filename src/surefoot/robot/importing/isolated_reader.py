"""Reader in a separate process with limits: an untrusted file may crash MuJoCo's parser, fill memory or never end."""

from __future__ import annotations

import importlib
import io
import json
import math
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from surefoot import sandbox
from surefoot.errors import SurefootError
from surefoot.robot.appearance import VisualPart
from surefoot.robot.importing.import_errors import check_kind, check_suffix
from surefoot.robot.importing.imported import ImportedRobot
from surefoot.robot.importing.named_files import check_named_files, find_mesh
from surefoot.robot.rigid_body import RigidBody
from surefoot.robot.urdf_file import read_xml
from surefoot.sandbox import Limits

LIMITS = Limits(memory=2 << 30, time=4.0, timeout=20.0)
"""Limits for reading a description, without the time for its meshes. Typical robots take a tenth of a second."""
_MESH_SPEED = 5e6
"""Size of meshes per additional second of time limit [byte/s]; the reader is about twice as fast."""
_MAX_MESH_SECONDS = 120.0
_PACKAGES = ("mujoco", "trimesh", "collada", "fast_simplification")
"""Packages that the reader imports."""
_ARRAYS = (
    *("axis_points", "axes", "limits", "kp", "kd", "torque", "speed", "damping", "friction", "rotor_inertia"),
    *("feet", "foot_radius"),
)
"""Array fields of `ImportedRobot`."""


def read_robot(path: Path, forward: str | None = None, meshes: bool = True, limits: Limits = LIMITS) -> ImportedRobot:
    """Read a quadruped from a URDF or MJCF in a separate process.

    Args:
        path: the file.
        forward: see `reader.read_robot`.
        meshes: see `reader.read_robot`.
        limits: limits of the process; large meshes extend the time limit.

    Raises:
        SurefootError: see `reader.read_robot`; or the process exceeded its limits or crashed.
    """
    for package in _PACKAGES:
        if find_spec(package) is None:
            importlib.import_module(package)  # raises the error with the command to install it
    size = _check(path, meshes)
    extra = min(size / _MESH_SPEED, _MAX_MESH_SECONDS)
    limits = Limits(limits.memory, limits.time + extra, limits.timeout + 2 * extra)
    words = [str(path), forward or "", "meshes" if meshes else "", str(limits.memory), str(math.ceil(limits.time))]
    ending = sandbox.run_module(__name__, words, limits)
    if ending.code == 2:
        raise SurefootError(ending.message)
    if ending.code:
        # MuJoCo's bindings raise an "unknown exception" if an allocation fails.
        reason = "its memory was used up" if "unknown exception" in ending.reason else ending.reason
        raise SurefootError(
            f"{path}: can't be read within {limits.memory / 2**30:g} GiB and {limits.time:.3g} s ({reason}); "
            "the description of a robot needs much less: remove what is not part of the robot"
        )
    try:
        return decode(ending.output, path)
    except (ValueError, LookupError, TypeError, EOFError) as error:
        raise SurefootError(f"{path}: the process that reads it returned no robot: {error}") from error


def _check(path: Path, meshes: bool) -> int:
    """Check a description and the files that it names without a C parser; return the files' size [byte]."""
    check_suffix(path)
    root = read_xml(path)
    check_kind(root, path)
    if root.tag == "mujoco":
        return check_named_files(root, path)
    files = set()
    for mesh in root.iter("mesh") if meshes else ():
        try:
            files.add(find_mesh(mesh.get("filename", ""), path))
        except (SurefootError, OSError, ValueError):
            continue  # the reader adds a note
    return sum(file.stat().st_size for file in files)


def encode(robot: ImportedRobot) -> bytes:
    """Serialize a robot without its path as arrays and text, which can be read without running code."""
    bodies = [robot.base, *(body for leg in robot.bodies for body in leg)]
    meta = {
        "name": robot.name,
        "forward": robot.forward,
        "joints": robot.joints,
        "poses": [source for source, _ in robot.poses],
        "links_without_mesh": robot.links_without_mesh,
        "damping_is_kd": robot.damping_is_kd,
        "motor_order": robot.motor_order,
        "notes": robot.notes,
        "warnings": robot.warnings,
        "parts": [[part.link, part.color] for part in robot.parts],
    }
    arrays = {name: getattr(robot, name) for name in _ARRAYS} | {
        "base_box": np.array(robot.base_box),
        "mass": np.array([body.mass for body in bodies]),
        "centre": np.array([body.centre for body in bodies]),
        "inertia": np.array([body.inertia for body in bodies]),
        "poses": np.array([angles for _, angles in robot.poses]).reshape(-1, *robot.kp.shape),
    }
    for k, part in enumerate(robot.parts):
        arrays |= {f"vertices_{k}": part.vertices, f"faces_{k}": part.faces}
    file = io.BytesIO()
    np.savez(file, meta=np.array(json.dumps(meta)), **arrays)
    return file.getvalue()


def decode(data: bytes, path: Path) -> ImportedRobot:
    """Deserialize the output of `encode`.

    Raises:
        ValueError, LookupError, TypeError or EOFError: the data is invalid.
    """
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    meta: dict[str, Any] = json.loads(str(arrays["meta"]))
    bodies = [
        RigidBody(float(mass), centre, inertia)
        for mass, centre, inertia in zip(arrays["mass"], arrays["centre"], arrays["inertia"], strict=True)
    ]
    joints = tuple(map(tuple, meta["joints"]))
    count = len(joints[0])
    low, high = arrays["base_box"]
    return ImportedRobot(
        name=meta["name"],
        path=path,
        forward=meta["forward"],
        base=bodies[0],
        base_box=(low, high),
        joints=joints,
        bodies=tuple(tuple(bodies[1 + k * count :][:count]) for k in range(len(joints))),
        **{name: arrays[name] for name in _ARRAYS},
        parts=tuple(
            VisualPart(link, arrays[f"vertices_{k}"], arrays[f"faces_{k}"], tuple(color))
            for k, (link, color) in enumerate(meta["parts"])
        ),
        poses=tuple(zip(meta["poses"], arrays["poses"], strict=True)),
        links_without_mesh=tuple(meta["links_without_mesh"]),
        damping_is_kd=meta["damping_is_kd"],
        motor_order=tuple(meta["motor_order"]),
        notes=tuple(meta["notes"]),
        warnings=tuple(meta["warnings"]),
    )


def main(words: Sequence[str]) -> int:
    """Entry point of the process: read the file in the first argument and write the robot to standard output.

    Returns:
        2 after an error, which is printed.
    """
    file, forward, meshes, memory, time = words
    output = sandbox.claim_stdout()
    from surefoot.robot.importing import reader

    sandbox.limit_resources(Limits(int(memory), float(time), 0.0))
    try:
        data = encode(reader.read_robot(Path(file), forward or None, bool(meshes)))
    except SurefootError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    with output:
        output.write(data)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
