"""Reader of any quadruped's URDF or MJCF with MuJoCo's parsers.

It does not limit time or memory; for untrusted files, `isolated_reader.py` runs it in a separate process.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import mjtInertiaFromGeom, mjtJoint
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.native_output import mujoco_errors
from surefoot.robot.appearance import MAX_EXTENT, MAX_PARTS, MAX_TRIANGLES, VisualPart
from surefoot.robot.importing.extra_hinges import describe_play, describe_springs, describe_wheels, find_play, is_wheel
from surefoot.robot.importing.feet import Foot, find_foot, pair_feet
from surefoot.robot.importing.import_errors import QUADRUPED, check_kind, check_legs, check_suffix, explain_mujoco
from surefoot.robot.importing.imported import ImportedRobot
from surefoot.robot.importing.inertias import drop_frame_masses, implausible_inertias, prepare_inertias
from surefoot.robot.importing.meshes import Color, Surface, merge_surfaces
from surefoot.robot.importing.named_files import find_mesh
from surefoot.robot.importing.names import robot_name
from surefoot.robot.importing.resting_poses import Pose, order_poses, srdf_poses
from surefoot.robot.importing.servo import motor_order, read_servos
from surefoot.robot.importing.shapes import BodyShapes
from surefoot.robot.importing.units import convert_degrees, explain_meshes, explain_ranges, explain_size
from surefoot.robot.importing.visuals import (
    Visual,
    decimate_visuals,
    note_problems,
    read_mjcf_visuals,
    read_urdf_visuals,
)
from surefoot.robot.rigid_body import RigidBody, fuse
from surefoot.robot.urdf_file import attribute, read_xml

FORWARD = {"+x": 0.0, "-x": np.pi, "+y": -np.pi / 2, "-y": np.pi / 2}
"""Possible forward directions in the file's frame, and the rotation about z to +x [rad]."""
_FRONT_NAMES = re.compile(r"front|fore|(?:^|[^a-z])(?:f[lr]|[lr]f)(?:[^a-z]|$)", re.IGNORECASE)
_AXIS_TOLERANCE = 1e-3
"""Tolerance of the cosine between a joint axis and an axis of the base; files round pi/2 to five digits."""
_MIN_AXIS_COSINE = 0.9
"""Minimum cosine between a joint axis and x or y for a hip that swings before it abducts."""
_MAX_CHAIN = 100
"""Maximum number of joints in a chain."""
_MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Mesh formats that MuJoCo reads."""


def read_robot(path: Path, forward: str | None = None, meshes: bool = True) -> ImportedRobot:
    """Read a quadruped from a URDF or MJCF in this process.

    Args:
        path: the file.
        forward: forward direction in the file's frame, one of `FORWARD`; by default it is guessed from leg names and
            joint axes.
        meshes: whether to read meshes and visuals; without meshes, the base is a box with its inertia.

    Raises:
        SurefootError: the file can't be read, or the robot is not a quadruped with legs of two or three hinges.
    """
    check_suffix(path)
    root = read_xml(path)
    check_kind(root, path)
    notes: list[str] = []
    visuals: list[Visual] = []
    incomplete: list[str] = []
    if meshes and root.tag == "robot":
        visuals, incomplete = read_urdf_visuals(root, path, find_mesh, notes)
    elif meshes:
        visuals = read_mjcf_visuals(path, notes)
    speeds = _prepare_urdf(root, path, meshes, notes) if root.tag == "robot" else {}
    with mujoco_errors(path, explain_mujoco):
        if root.tag == "mujoco":
            spec = mujoco.MjSpec.from_file(str(path))
        else:
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.compiler.discardvisual = True
        if spec.compiler.inertiafromgeom == mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
            # Keep the masses of visual geoms, which `discardvisual` removes.
            spec.compiler.inertiafromgeom = mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
            _drop_inertias(spec)
        spec.compiler.fusestatic = False
        drop_frame_masses(spec, notes)
        if not meshes and root.tag == "mujoco":
            _drop_files(spec)
        keys = [(key.name, list(key.qpos)) for key in spec.keys]
        for key in list(spec.keys):
            spec.delete(key)
        model = spec.compile()
    poses = order_poses(itertools.chain(_keyframe_poses(keys, model), srdf_poses(path)))
    file_name = root.get("name" if root.tag == "robot" else "model", "")
    return _Reader(path, model, speeds, poses, notes, file_name, root.tag == "robot").read(forward, visuals, incomplete)


def _drop_files(spec: mujoco.MjSpec) -> None:
    """Remove meshes with their geoms, materials and textures, which an MJCF reads from other files."""
    for geom in list(spec.geoms):
        geom.material = ""
        if geom.meshname:
            spec.delete(geom)
    for item in [*spec.meshes, *spec.materials, *spec.textures]:
        spec.delete(item)


def _drop_inertias(spec: mujoco.MjSpec) -> None:
    """Remove the inertias of bodies whose geoms have masses, as `inertiafromgeom="true"` does."""
    for body in spec.bodies:
        if any(geom.mass > 0 or (np.isnan(geom.mass) and geom.density > 0) for geom in body.geoms):
            body.explicitinertial = False
            body.ipos = np.full(3, np.nan)


def _keyframe_poses(keys: Sequence[tuple[str, list[float]]], model: mujoco.MjModel) -> Iterator[tuple[str, Pose]]:
    """Yield source and joint angles of each keyframe; `keys` has names, which may be empty, and `qpos`."""
    hinges = np.flatnonzero(model.jnt_type == mjtJoint.mjJNT_HINGE)
    for name, qpos in keys:
        if len(qpos) == model.nq:
            yield f"keyframe '{name}'", {model.joint(k).name: qpos[model.jnt_qposadr[k]] for k in hinges}


def _prepare_urdf(root: ElementTree.Element, path: Path, meshes: bool, notes: list[str]) -> dict[str, float]:
    """Prepare a URDF for MuJoCo: remove visuals, use absolute mesh paths, fix inertias and units.

    Returns:
        Speed limits by joint name [rad/s].
    """
    unreadable: set[str] = set()
    problems: dict[str, None] = {}
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for shape in link.findall("collision"):
            if (mesh := shape.find("geometry/mesh")) is None:
                continue
            try:
                file = find_mesh(mesh.get("filename", ""), path)
            except SurefootError as error:
                file = None
                problems |= {str(error).removeprefix(f"{path}: "): None} if meshes else {}
            if file is not None and meshes and file.suffix.lower() in _MESH_SUFFIXES:
                mesh.set("filename", str(file))
            else:
                link.remove(shape)
                unreadable |= {file.name} if file and meshes else set()
    if unreadable:
        notes.append(f"shapes that MuJoCo can't read are left out: {choices(sorted(unreadable))}")
    note_problems("shapes are left out", problems, notes)
    for old in root.findall("mujoco"):
        root.remove(old)
    compiler = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    compiler.attrib |= {"strippath": "false", "balanceinertia": "true", "inertiafromgeom": "false"}
    prepare_inertias(root, path, notes)
    convert_degrees(root, notes)
    speeds = {}
    for joint in root.findall("joint"):
        with contextlib.suppress(ValueError):
            speeds[joint.get("name", "")] = float(attribute(joint.find("limit"), "velocity"))
    return speeds


class _Reader:
    """Converter of a compiled model to an `ImportedRobot`, at zero angles and in the frame of the base."""

    def __init__(
        self,
        path: Path,
        model: mujoco.MjModel,
        speeds: dict[str, float],
        poses: Sequence[tuple[str, Pose]],
        notes: list[str],
        file_name: str,
        is_urdf: bool,
    ) -> None:
        self.path, self.model, self.speeds, self.poses, self.notes = path, model, speeds, poses, notes
        self.file_name, self.is_urdf = file_name, is_urdf
        self.data = mujoco.MjData(model)
        turning = np.isin(model.jnt_type, (mjtJoint.mjJNT_HINGE, mjtJoint.mjJNT_SLIDE))
        self.data.qpos[model.jnt_qposadr[turning]] = 0.0  # not `qpos0`, which is the attribute ref of an MJCF
        mujoco.mj_kinematics(model, self.data)
        self.play = find_play(model, self.data)
        if self.play:
            notes.append(describe_play(model, self.play))
        self.hinge = np.array([next(iter(self._joints(body)), -1) for body in range(model.nbody)])
        """First joint of each body, ignoring gear play; -1 if it has none."""
        self.group = self._groups()

    def _error(self, text: str) -> SurefootError:
        return SurefootError(f"{self.path}: {text}")

    def _joint_names(self, bodies: Iterable[int]) -> list[str]:
        return [str(self.model.joint(int(self.hinge[body])).name) for body in bodies]

    def _joints(self, body: int) -> list[int]:
        """Return the joints of a body, ignoring gear play."""
        return [int(joint) for joint in np.flatnonzero(self.model.jnt_bodyid == body) if joint not in self.play]

    def _groups(self) -> NDArray[np.int64]:
        """Return for each body the body whose joint moves it; bodies without joints are fixed to their parents."""
        model = self.model
        group = np.zeros(model.nbody, np.int64)
        for body in range(1, model.nbody):
            kinds = self._joints(body)
            # Without a free joint, a body that is attached to the world may be the base.
            top = not kinds and model.body_parentid[body] == 0 and mjtJoint.mjJNT_FREE not in model.jnt_type
            group[body] = body if kinds or top else group[model.body_parentid[body]]
        return group

    def read(self, forward: str | None, visuals: Sequence[Visual], incomplete: Sequence[str]) -> ImportedRobot:
        """Convert the model; `incomplete` are the names of links with unreadable visuals. See `read_robot`."""
        self.shapes = BodyShapes(self.model, self.data, self.group, visuals)
        chains, base = self._chains()
        model, data = self.model, self.data
        self._move(data.xmat[base].reshape(3, 3).T.copy(), data.xpos[base].copy())
        forward = forward or self._guess_forward(chains)
        self._turn(FORWARD[forward])
        anchors = data.xanchor[self.hinge[chains]]
        feet = [self._foot(chain[-1], anchor[-1]) for chain, anchor in zip(chains, anchors, strict=True)]
        order = self._order(anchors[:, -2], np.array([foot.centre for foot in feet]))
        chains, feet = [chains[leg] for leg in order], pair_feet([feet[leg] for leg in order])
        joints = tuple(tuple(self._joint_names(chain)) for chain in chains)
        knees = [leg[-1] for leg in joints]
        for source in dict.fromkeys(foot.source for foot in feet):
            radii = {name: foot.radius for foot, name in zip(feet, knees, strict=True) if foot.source == source}
            which = "feet" if len(radii) == len(feet) else f"feet of {choices(radii)}"
            radius = choices(dict.fromkeys(f"{radius:.3g}" for radius in radii.values()))
            self.notes.append(f"{which}: {source}, radius {radius} m")
        points = [self.shapes.hull_points(np.flatnonzero(model.geom_bodyid == body)) for body in range(model.nbody)]
        warnings = implausible_inertias(model, data, points)
        robot = ImportedRobot(
            name=robot_name(self.path, self.file_name),
            path=self.path,
            forward=forward,
            base=self._body(base),
            base_box=self._box(base),
            joints=joints,
            bodies=tuple(tuple(map(self._body, chain)) for chain in chains),
            **self._hinges(chains),
            feet=np.array([foot.centre for foot in feet]),
            foot_radius=np.array([foot.radius for foot in feet]),
            poses=tuple(
                (source, np.array([[pose.get(name, np.nan) for name in leg] for leg in joints]))
                for source, pose in self.poses
            ),
            motor_order=motor_order(self.model, [name for leg in joints for name in leg]),
            notes=tuple(self.notes),
            warnings=tuple(warnings),
        )
        legs, box = np.linalg.norm(robot.links, axis=-1).max(axis=1), float(robot.base_box[1].max())
        reason = explain_meshes(float(legs[0]), float(legs[1]), box) or explain_size(robot.mass, robot.length)
        if reason is not None:
            raise self._error(reason)
        names, origins = {base: "base"}, {base: np.zeros(3)}
        for chain, links, anchors in zip(chains, robot.link_names, robot.axis_points, strict=True):
            names |= dict(zip(chain, links, strict=True))
            origins |= dict(zip(chain, anchors, strict=True))
        parts = self._parts(visuals, names, origins)
        movers = [int(self.group[model.body(link).id]) for link in incomplete]
        links_without_mesh = dict.fromkeys(names[mover] for mover in movers if mover in names)
        return replace(robot, parts=parts, links_without_mesh=tuple(links_without_mesh), notes=tuple(self.notes))

    def _parts(
        self, visuals: Sequence[Visual], names: dict[int, str], origins: dict[int, Array]
    ) -> tuple[VisualPart, ...]:
        """Return the decimated visuals of base and legs, one part per link and colour.

        Args:
            visuals: visuals of the file.
            names: link names by the body that moves the link.
            origins: link origins (3,) [m] by that body.
        """
        movers = {visual.body: int(self.group[self.model.body(visual.body).id]) for visual in visuals}
        parts: dict[tuple[str, Color], list[Surface]] = {}
        for visual in decimate_visuals([visual for visual in visuals if movers[visual.body] in names]):
            body, mover = self.model.body(visual.body).id, movers[visual.body]
            frame = np.eye(4)
            frame[:3, :3] = self.data.xmat[body].reshape(3, 3)
            frame[:3, 3] = self.data.xpos[body] - origins[mover]
            surface = visual.surface.place(frame @ visual.frame)
            parts.setdefault((names[mover], visual.color), []).append(surface)
        merged = {key: merge_surfaces(surfaces) for key, surfaces in parts.items()}
        usable = {
            key: surface
            for key, surface in merged.items()
            if len(surface.faces) and np.abs(surface.vertices).max() < MAX_EXTENT - 1
        }
        triangles = sum(len(surface.faces) for surface in usable.values())
        if len(usable) > MAX_PARTS or triangles > MAX_TRIANGLES:
            self.notes.append(f"not drawn: {triangles} triangles of {len(usable)} links and colours are too many")
            return ()
        if len(usable) < len(merged):
            absent = choices(dict.fromkeys(link for link, color in merged if (link, color) not in usable))
            self.notes.append(f"not drawn: shapes of {absent} have no area, or are farther away than {MAX_EXTENT:g} m")
        return tuple(
            VisualPart(link, surface.vertices.astype(np.float32), surface.faces.astype(np.int32), color)
            for (link, color), surface in usable.items()
        )

    def _chains(self) -> tuple[list[list[int]], int]:
        """Return the four chains of moving bodies that are attached to the base, and the base."""
        model = self.model
        if mjtJoint.mjJNT_HINGE not in model.jnt_type:
            raise self._error(f"is an object or a scene without hinge joints; {QUADRUPED}")
        movers = np.unique(self.group[1:]).tolist()
        children: dict[int, list[int]] = {body: [] for body in (0, *movers)}
        depth = dict.fromkeys(children, 0)
        for body in movers:  # parents come first
            parent = int(self.group[model.body_parentid[body]])
            children[parent].append(body)
            depth[body] = depth[parent] + 1
        if max(depth.values()) > _MAX_CHAIN:
            raise self._error(f"has a chain of {max(depth.values())} joints; {QUADRUPED}")

        def longest(body: int) -> list[int]:
            return [body, *max(map(longest, children[body]), key=len, default=[])]

        def below(body: int) -> list[int]:
            return [body, *itertools.chain.from_iterable(map(below, children[body]))]

        # The base is the body with most chains: the root, or a body below a mount without a free joint.
        base = max(movers, key=lambda body: (len(children[body]), -body))
        robots = [str(model.body(body).name) for body in children[0] if len(children[body]) >= 4]
        if len(robots) > 1:
            raise self._error(f"contains {len(robots)} robots: {choices(robots)}; give a file with one")
        if len(children[base]) < 2 and len(children[0]) > len(children[base]):
            raise self._error("its legs are attached to the world; the base must be a body")
        chains = [longest(child) for child in children[base]]
        wheels = [chain[-1] for chain in chains if len(chain) > 2 and self._ends_in_wheel(chain)]
        if wheels and len(chains) == 4:
            raise self._error(describe_wheels(self._joint_labels(wheels), self.is_urdf))
        if len(chains) == 4 and (springs := [chain[-1] for chain in chains if self._slides(chain[-1])]):
            raise self._error(describe_springs(self._joint_labels(springs), self.is_urdf))
        lengths = [len(chain) for chain in chains]
        counts = [length for length in (2, 3) if lengths.count(length) == 4]
        legs = [chain for chain in chains if len(chain) in counts] if len(counts) == 1 else chains
        for first, *_ in (chain for chain in chains if chain not in legs):
            (name,) = self._joint_names([first])
            self.notes.append(f"joint '{name}' and the bodies below it are fixed, because they are not part of a leg")
            self.group[np.isin(self.group, below(first))] = base
        branches = [str(model.body(body).name) for leg in legs for body in leg[:-1] if len(children[body]) > 1]
        slides = [
            str(model.body(body).name)
            for leg in legs
            for body in leg
            if [model.jnt_type[joint] for joint in self._joints(body)] != [mjtJoint.mjJNT_HINGE.value]
        ]
        names = [self._joint_names(leg) for leg in legs]
        coupled = self._coupled({body for leg in legs for body in leg})
        check_legs(self.path, model.body(base).name, names, next(iter(branches), None), coupled, slides)
        if nameless := [body for leg in legs for body in leg if not self._joint_names([body])[0]]:
            raise self._error(f"{self._joint_labels(nameless)[0]} has no name; name the joints of all legs")
        return legs, base

    def _coupled(self, bodies: set[int]) -> str:
        """Return how an active equality constrains one of the bodies, such as "closed loops"; empty if none does."""
        model = self.model
        for k in np.flatnonzero(model.eq_active0):
            ends = [int(index) for index in (model.eq_obj1id[k], model.eq_obj2id[k]) if index >= 0]
            if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT.value:
                if held := [joint for joint in ends if int(self.group[model.jnt_bodyid[joint]]) in bodies]:
                    return f"a joint that follows another one or is held, '{model.joint(held[0]).name}'"
                continue
            if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE.value:
                ends = [int(model.site_bodyid[site]) for site in ends]
            elif model.eq_objtype[k] != mujoco.mjtObj.mjOBJ_BODY.value:
                return "tendons or flexible parts with constraints"
            if any(int(self.group[body]) in bodies for body in ends):
                return "closed loops"
        return ""

    def _joint_labels(self, bodies: list[int]) -> list[str]:
        """Return the names of the bodies' joints for messages; a joint without a name is described by its body."""
        names = zip(self._joint_names(bodies), bodies, strict=True)
        return [name or f"the joint of body '{self.model.body(body).name or body}'" for name, body in names]

    def _slides(self, body: int) -> bool:
        """Return whether a body's joint is prismatic."""
        return bool(self.model.jnt_type[int(self.hinge[body])] == mjtJoint.mjJNT_SLIDE.value)

    def _ends_in_wheel(self, chain: list[int]) -> bool:
        """Return whether a leg's last hinge turns a wheel."""
        above, last = (int(self.hinge[body]) for body in chain[-2:])
        hinges = (self.model.jnt_type[[above, last]] == mjtJoint.mjJNT_HINGE.value).all()
        points = self.shapes.surface_points(self.shapes.geom_ids(chain[-1]))
        return bool(hinges) and is_wheel(self.model, self.data, above, last, points)

    def _guess_forward(self, chains: list[list[int]]) -> str:
        """Guess the forward direction: normal to the knee axes, towards the legs with names such as front."""
        joints = self.hinge[chains]
        hips, knee = self.data.xanchor[joints[:, 0]], np.abs(self.data.xaxis[joints[0, -1]])
        axis = 0 if knee[1] > knee[0] else 1
        front = np.array([bool(_FRONT_NAMES.search(" ".join(self._joint_names(chain)))) for chain in chains])
        ahead = 1.0
        if front.sum() == 2:
            ahead = hips[front, axis].mean() - hips[~front, axis].mean()
        else:
            self.notes.append("forward is guessed: the joints' names do not say which legs are in front")
        return f"{'+' if ahead > 0 else '-'}{'xy'[axis]}"

    def _turn(self, angle: float) -> None:
        """Rotate all positions and frames about z by `angle` [rad], so that x is forward."""
        cos, sin = np.cos(angle).round(12), np.sin(angle).round(12)
        self._move(np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))

    def _move(self, turn: Array, origin: Array) -> None:
        """Express all positions and frames in another frame.

        Args:
            turn: rotation matrix (3, 3) from the present frame to the other one.
            origin: origin of the other frame in the present one (3,) [m].
        """
        data = self.data
        for points in (data.xpos, data.xipos, data.xanchor, data.geom_xpos):
            points[:] = (points - origin) @ turn.T
        data.xaxis[:] = data.xaxis @ turn.T
        for frames in (data.xmat, data.ximat, data.geom_xmat):
            frames[:] = (turn @ frames.reshape(-1, 3, 3)).reshape(-1, 9)

    def _body(self, mover: int) -> RigidBody:
        """Return the rigid body that moves with a body, including bodies fixed to it, in the base frame."""
        model, data, parts = self.model, self.data, []
        for body in np.flatnonzero((self.group == mover) & (model.body_mass > 0)):
            axes = data.ximat[body].reshape(3, 3)
            inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
            parts.append((RigidBody(float(model.body_mass[body]), data.xipos[body], inertia), np.eye(4)))
        if not parts:
            raise self._error(f"body '{model.body(mover).name}' has no mass; every moving part needs an inertia")
        return fuse(parts)

    def _hinges(self, chains: list[list[int]]) -> dict[str, Any]:
        """Return the fields of `ImportedRobot` on hinges; reject axes that are not along x and y of the base."""
        model, joints, along = self.model, self.hinge[chains], np.array((0, 1, 1)[-len(chains[0]) :])
        axes = self.data.xaxis[joints]
        if (
            len(chains[0]) == 3
            and (np.abs(axes[:, 0, 1]) > _MIN_AXIS_COSINE).all()
            and (np.abs(axes[:, 1, 0]) > _MIN_AXIS_COSINE).all()
        ):
            swing, abduction, _ = self._joint_names(chains[0])
            raise self._error(
                f"its hips swing before they abduct ('{swing}' turns about y, '{abduction}' about x): such legs are "
                "not supported; to train a similar robot, exchange these two joints of every leg in a copy of the file"
            )
        cosines = np.take_along_axis(axes, along[None, :, None], axis=2)[..., 0]
        for leg, k in np.argwhere(np.abs(np.abs(cosines) - 1) > _AXIS_TOLERANCE):
            (name,), (x, y, z) = self._joint_names([chains[leg][k]]), axes[leg, k]
            part = ("abduction", "hip", "knee")[k - len(along)]
            raise self._error(
                f"joint '{name}' should be the {part}, and its axis at zero is ({x:.2f}, {y:.2f}, {z:.2f}) with x "
                f"forward; it must be along {'xy'[along[k]]}"
            )
        if (stiff := joints[model.jnt_stiffness.reshape(model.njnt, -1)[joints, 0] > 0]).size:
            named = choices(str(model.joint(int(joint)).name) for joint in stiff)
            self.notes.append(f"springs at joints are left out, which changes the torques for standing: {named}")
        dofs = model.jnt_dofadr[joints]
        damping = model.dof_damping.reshape(model.nv, -1)[dofs, 0]
        servos = read_servos(model, joints, damping)
        limits = np.where(model.jnt_limited[joints][..., None], model.jnt_range[joints], np.nan)
        if (reason := explain_ranges(limits.reshape(-1, 2))) is not None:
            raise self._error(reason)
        speeds = [[self.speeds.get(name, np.nan) for name in self._joint_names(chain)] for chain in chains]
        return {
            "axis_points": self.data.xanchor[joints],
            "axes": np.eye(3)[along] * np.sign(cosines)[..., None],
            "limits": limits,
            "kp": servos.kp,
            "kd": servos.kd,
            "torque": servos.torque,
            "speed": np.array(speeds),
            "damping": np.where(servos.kd_is_damping, 0.0, damping),
            "damping_is_kd": bool(servos.kd_is_damping.any()),
            "friction": model.dof_frictionloss[dofs],
            "rotor_inertia": model.dof_armature[dofs],
        }

    def _foot(self, body: int, knee: Array) -> Foot:
        """Return the foot of a leg; see `find_foot`."""
        if (foot := find_foot(self.shapes, body, knee)) is None:
            raise self._error(f"'{self.model.body(body).name}' has neither a shape nor a foot link; add one")
        return foot

    def _box(self, base: int) -> tuple[Array, Array]:
        """Return centre and half side lengths of a box around the base's shapes, or else with the base's inertia."""
        if (geoms := self.shapes.geom_ids(base)).size:
            corners = self.shapes.hull_points(geoms)
            low, high = corners.min(axis=0), corners.max(axis=0)
            return (low + high) / 2, (high - low) / 2
        body = self._body(base)
        moments = np.diag(body.inertia)
        self.notes.append("the base has no shape: it is replaced by a box with the same inertia")
        return body.centre, np.sqrt(np.maximum(1.5 / body.mass * (moments.sum() - 2 * moments), 1e-4))

    def _order(self, hips: Array, feet: Array) -> list[int]:
        """Return the indices of the legs in the order of `LEGS` from hip and foot positions (4, 3)."""
        front, left = hips[:, 0] > hips[:, 0].mean(), feet[:, 1] > feet[:, 1].mean()
        corners = [np.flatnonzero((front == f) & (left == s)) for f in (True, False) for s in (True, False)]
        if any(len(corner) != 1 for corner in corners):
            raise self._error("its hips are not at four corners, one leg at each")
        return [int(corner[0]) for corner in corners]
