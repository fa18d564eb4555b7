"""Reading of robots that surefoot never saw: any URDF or MJCF, through MuJoCo's parsers, as a tree of legs."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, accessible, choices
from surefoot.files import read_configuration
from surefoot.native_output import quiet
from surefoot.robot.importing.imported import ImportedJoint, ImportedLeg, ImportedRobot
from surefoot.robot.rigid_body import RigidBody, are_moments, fuse
from surefoot.robot.urdf import attribute

FORWARD = {"+x": 0.0, "-x": np.pi, "+y": -np.pi / 2, "-y": np.pi / 2}
"""Directions in the file's frame that may be forward, and the turn about z that brings them to +x [rad]."""
_FRONT = re.compile(r"front|fore|(?:^|[^a-z])(?:f[lr]|[lr]f)(?:[^a-z]|$)", re.IGNORECASE)
_FOOT = re.compile(r"foot|toe|tip|sole|ankle", re.IGNORECASE)
_ALONG = 1e-3
"""How far an axis may be from the base's, as a cosine: files write pi/2 with five digits."""
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_MESH = (".stl", ".obj", ".msh")
"""Kinds of mesh that MuJoCo reads."""


def read_robot(path: Path, forward: str | None = None, meshes: bool = True) -> ImportedRobot:
    """Read a quadruped from a URDF or MJCF.

    Args:
        path: the file.
        forward: direction in the file's frame that is forward, out of `FORWARD`; found from the legs' names and axes,
            if not given.
        meshes: whether to read a URDF's meshes; without them the base is a box with its inertia.

    Raises:
        SurefootError: a file that can't be read, or a robot that is not a quadruped with legs of two or three hinges.
    """
    spec, speeds, notes = _load(path, meshes)
    spec.compiler.discardvisual = True
    spec.compiler.fusestatic = False
    for key in list(spec.keys):
        spec.delete(key)
    try:
        with quiet():
            model = spec.compile()
    except ValueError as error:
        raise SurefootError(f"{path}: MuJoCo refuses it: {' '.join(str(error).split())}") from error
    return _Reader(path, model, speeds, notes).tree(forward)


def _load(path: Path, meshes: bool) -> tuple[Any, dict[str, float], list[str]]:
    """Return the file as MuJoCo's specification, the speed limits that a URDF states, and notes."""
    with accessible(path):
        content = read_configuration(path)
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise SurefootError(f"{path}: declares XML entities; a robot's description has none")
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise SurefootError(f"{path}: is not well-formed XML: {error}") from error
    notes: list[str] = []
    if root.tag not in ("mujoco", "robot"):
        raise SurefootError(f"{path}: the root element is <{root.tag}>; a URDF's is <robot>, an MJCF's <mujoco>")
    speeds = _prepare_urdf(root, path, meshes, notes) if root.tag == "robot" else {}
    try:
        with quiet():
            if root.tag == "mujoco":
                return mujoco.MjSpec.from_file(str(path)), speeds, notes
            return mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode")), speeds, notes
    except ValueError as error:
        raise SurefootError(f"{path}: MuJoCo refuses it: {' '.join(str(error).split())}") from error


def _prepare_urdf(root: ElementTree.Element, path: Path, meshes: bool, notes: list[str]) -> dict[str, float]:
    """Make a URDF ready for MuJoCo: no visuals, meshes by absolute path; return the joints' speed limits."""
    unread = set()
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for shape in link.findall("collision"):
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            if not meshes:
                link.remove(shape)
                continue
            found = _mesh_file(mesh.get("filename", ""), path)
            if found.suffix.lower() in _MESH:
                mesh.set("filename", str(found))
            else:
                unread.add(found.name)
                link.remove(shape)
    if unread:
        notes.append(f"shapes that MuJoCo can't read are left out: {choices(sorted(unread))}")
    for old in root.findall("mujoco"):
        root.remove(old)
    compiler = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    compiler.attrib |= {"strippath": "false", "fusestatic": "false", "discardvisual": "true"}
    compiler.attrib |= {"balanceinertia": "true", "inertiafromgeom": "false"}
    speeds = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        try:
            speeds[joint.get("name", "")] = float("" if limit is None else limit.get("velocity", ""))
        except ValueError:
            continue
    _check_inertias(root, path, notes)
    return speeds


def _check_inertias(root: ElementTree.Element, path: Path, notes: list[str]) -> None:
    """Leave out inertias of links without mass, and note those that are no rigid body's."""
    found, odd = 0, []
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is None:
            continue
        tensor = inertial.find("inertia")
        try:
            mass = float(attribute(inertial.find("mass"), "value"))
            xx, xy, xz, yy, yz, zz = (float(attribute(tensor, key, "0")) for key in _TENSOR)
        except ValueError:
            raise SurefootError(f"{path}: link '{link.get('name')}': its <inertial> has no numbers") from None
        if mass == 0.0 or tensor is None:
            link.remove(inertial)
            continue
        found += 1
        if mass > 0 and xx == yy == zz == 0.0:  # a point mass
            tensor.attrib |= dict.fromkeys(("ixy", "ixz", "iyz"), "0")
            continue
        whole = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = np.linalg.eigvalsh(whole) if np.isfinite(whole).all() else np.full(3, np.nan)
        if not (mass > 0 and are_moments(moments)):
            odd.append(str(link.get("name")))
        if not moments.min() > 0:
            tensor.attrib |= dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    if not found:
        raise SurefootError(f"{path}: no link has an <inertial> with a mass; masses and inertias are needed")
    if odd:
        notes.append(f"inertias that no rigid body has, balanced: {choices(odd)}")


def _mesh_file(name: str, path: Path) -> Path:
    """Return the file of a mesh, beside the description or in a folder above it, as packages have it."""
    inside = Path(name.split("://", 1)[-1])
    folders = (path.resolve().parent, *list(path.resolve().parents)[1:6])
    # package://NAME/rest: the package's folder may have another name.
    for folder in folders:
        for part in (inside, Path(*inside.parts[1:]) if len(inside.parts) > 1 else inside):
            if (folder / part).is_file():
                return folder / part
    raise SurefootError(
        f"{path}: mesh '{name}' is not there; put it where the file names it, or leave out meshes (--no-meshes)"
    )


class _Reader:
    """The steps from a compiled model to a tree."""

    def __init__(self, path: Path, model: mujoco.MjModel, speeds: dict[str, float], notes: list[str]) -> None:
        self.path, self.model, self.speeds, self.notes = path, model, speeds, notes
        self.data = mujoco.MjData(model)
        self.group = self._groups()

    def _fail(self, text: str) -> SurefootError:
        return SurefootError(f"{self.path}: {text}")

    def _groups(self) -> NDArray[np.int64]:
        """Return for each body the body whose joint moves it; what has no joint is fixed to its parent."""
        model = self.model
        group = np.zeros(model.nbody, np.int64)
        free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
        for body in range(1, model.nbody):
            joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            kinds = {int(model.jnt_type[j]) for j in joints}
            if len(joints) > 1 or kinds - {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_FREE)}:
                raise self._fail(
                    f"body '{model.body(body).name}' has joints that are no single hinge; legs have hinges"
                )
            top = not kinds and model.body_parentid[body] == 0 and not free
            group[body] = body if kinds or top else group[model.body_parentid[body]]
        return group

    def tree(self, forward: str | None) -> ImportedRobot:
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        chains, base = self._chains()
        free = model.body_jntnum[base] and model.jnt_type[model.body_jntadr[base]] == mujoco.mjtJoint.mjJNT_FREE
        if free:
            address = model.jnt_qposadr[model.body_jntadr[base]]
            data.qpos[address : address + 7] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)
        self.turn, chosen = self._forward(chains, forward)
        legs = [self._leg(chain) for chain in chains]
        names = self._order(legs)
        for how in dict.fromkeys(leg.foot_source for leg in legs):
            found = [leg for leg in legs if leg.foot_source == how]
            which = "feet" if found == legs else f"feet of {choices(leg.joints[-1].name for leg in found)}"
            radii = choices(dict.fromkeys(f"{leg.foot_radius:.3g}" for leg in found))
            self.notes.append(f"{which}: {how}, radius {radii} m")
        centre, half = self._box(base)
        return ImportedRobot(
            name=re.sub(
                r"[^a-z0-9]+", "_", (self.path.stem if self.path.stem != "robot" else self.path.parent.name).lower()
            ).strip("_"),
            path=self.path,
            base=self._body(base),
            base_box=(centre, half),
            legs=tuple(legs[k] for k in names),
            forward=chosen,
            notes=tuple(self.notes),
        )

    def _chains(self) -> tuple[list[list[int]], int]:
        """Return the four chains of moving bodies that hang from one base, and the base."""
        model = self.model
        movers = sorted({int(group) for group in self.group[1:]})
        if not any(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE for j in range(model.njnt)):
            raise self._fail("nothing in it moves; a quadruped has four legs of hinges")
        parent = {body: int(self.group[model.body_parentid[body]]) for body in movers}
        children: dict[int, list[int]] = {body: [] for body in (0, *movers)}
        for body in movers:
            children[parent[body]].append(body)

        def longest(body: int) -> list[int]:
            below = [longest(child) for child in children[body]]
            return [body, *max(below, key=len, default=[])]

        # The base is what most legs hang from: the root, or below a mount without a free joint.
        base = max(movers, key=lambda body: (len(children[body]), -body))
        if len(children[base]) < 2 and len(children[0]) > len(children[base]):
            raise self._fail("its legs hang from nothing that moves; the base needs to be a body")
        chains = [longest(child) for child in children[base]]
        legs = [chain for chain in chains if len(chain) in (2, 3)]
        if len(legs) != 4:
            legs = chains
        for chain in chains:
            if chain not in legs:
                self.notes.append(
                    f"joint '{self._joint_name(chain[0])}' and what hangs from it are held still: no leg's"
                )
                self.group[np.isin(self.group, self._below(chain[0], children))] = base
        if model.neq or any(len(children[body]) > 1 for chain in legs for body in chain[:-1]):
            what = "closed loops" if model.neq else "legs that branch and no loop that closes them"
            raise self._fail(f"it has {what}; surefoot reads serial legs; a sheet for five-bar legs is written by hand")
        if len(legs) != 4:
            raise self._fail(f"{len(legs)} legs hang from '{model.body(base).name}'; a quadruped has 4")
        if len({len(chain) for chain in legs}) != 1 or len(legs[0]) > 3:
            raise self._fail(
                f"its legs have {choices(str(len(chain)) for chain in legs)} hinges; all must have 2, or all 3"
            )
        return legs, base

    def _below(self, body: int, children: dict[int, list[int]]) -> list[int]:
        return [body, *(one for child in children[body] for one in self._below(child, children))]

    def _joint(self, body: int) -> int:
        return int(self.model.body_jntadr[body])

    def _joint_name(self, body: int) -> str:
        return str(self.model.joint(self._joint(body)).name)

    def _forward(self, chains: list[list[int]], given: str | None) -> tuple[Array, str]:
        """Return the turn (3, 3) from the file's frame to one with x forward, and the direction that was chosen."""
        if given is None:
            hips = np.array([self.data.xanchor[self._joint(chain[0])] for chain in chains])
            # Knees turn about the robot's left.
            across = self.data.xaxis[self._joint(chains[0][-1])]
            along_x = abs(across[1]) > abs(across[0])
            named = [bool(_FRONT.search(" ".join(map(self._joint_name, chain)))) for chain in chains]
            ahead = 1.0
            if sum(named) == 2:
                apart = hips[np.array(named)].mean(axis=0) - hips[~np.array(named)].mean(axis=0)
                ahead = float(np.sign(apart[0 if along_x else 1]))
            else:
                self.notes.append("forward is guessed: the joints' names do not say which legs are in front")
            given = f"{'+' if ahead > 0 else '-'}{'x' if along_x else 'y'}"
        angle = FORWARD[given]
        cos, sin = np.cos(angle).round(12), np.sin(angle).round(12)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]), given

    def _place(self, point: Array) -> Array:
        return self.turn @ point

    def _body(self, mover: int) -> RigidBody:
        """Return what moves with a body as one, in the base's frame."""
        parts = []
        for body in np.flatnonzero(self.group == mover):
            if self.model.body_mass[body] <= 0:
                continue
            turn = self.turn @ self.data.ximat[body].reshape(3, 3)
            inertia = turn @ np.diag(self.model.body_inertia[body]) @ turn.T
            parts.append(
                (RigidBody(float(self.model.body_mass[body]), self._place(self.data.xipos[body]), inertia), np.eye(4))
            )
        if not parts:
            raise self._fail(f"body '{self.model.body(mover).name}' has no mass; every moving part needs an inertia")
        return fuse(parts)

    def _leg(self, chain: list[int]) -> ImportedLeg:
        model, joints = self.model, []
        for place, body in enumerate(chain):
            number = self._joint(body)
            axis, name = self.turn @ self.data.xaxis[number], self._joint_name(body)
            wanted = (0, 1, 1)[place - len(chain)]
            if abs(abs(axis[wanted]) - 1) > _ALONG:
                what = ("abduction", "hip", "knee")[place - len(chain)]
                raise self._fail(
                    f"joint '{name}' should be the {what}, and its axis at zero is "
                    f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) with x forward; it must be along {'xy'[wanted]}"
                )
            exact = np.zeros(3)
            exact[wanted] = np.sign(axis[wanted])
            limited, span = bool(model.jnt_limited[number]), model.jnt_range[number]
            dof = int(model.jnt_dofadr[number])
            joints.append(
                ImportedJoint(
                    name=name,
                    place=self._place(self.data.xanchor[number]),
                    axis=exact,
                    limits=(float(span[0]), float(span[1])) if limited else None,
                    torque=self._torque(number),
                    speed=self.speeds.get(name),
                    damping=float(np.ravel(model.dof_damping[dof])[0]),
                    friction=float(model.dof_frictionloss[dof]),
                    rotor_inertia=float(model.dof_armature[dof]),
                )
            )
        foot = self._foot(chain[-1], joints[-1].place)
        return ImportedLeg(tuple(joints), tuple(self._body(body) for body in chain), *foot)

    def _torque(self, joint: int) -> float | None:
        """Return the torque limit of a joint: its own, or its actuator's."""
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        for k in range(model.nu):
            if model.actuator_trnid[k, 0] == joint:
                gear = abs(float(model.actuator_gear[k, 0]))
                if model.actuator_forcelimited[k]:
                    return gear * float(np.abs(model.actuator_forcerange[k]).max())
                if model.actuator_ctrllimited[k] and model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_NONE:
                    return gear * float(np.abs(model.actuator_ctrlrange[k]).max())
        return None

    def _foot(self, body: int, knee: Array) -> tuple[Array, float, str]:
        """Return centre [m] and radius [m] of a leg's foot, and what it was found by."""
        model, data = self.model, self.data
        bodies = np.flatnonzero(self.group == body)
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]
        spheres = [g for g in geoms if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_SPHERE]
        if spheres:
            best = max(spheres, key=lambda g: float(np.linalg.norm(self._place(data.geom_xpos[g]) - knee)))
            return self._place(data.geom_xpos[best]), float(model.geom_size[best, 0]), "the last link's sphere"
        named = [b for b in bodies if _FOOT.search(model.body(int(b)).name)]
        if named:
            at = self._place(data.xpos[named[-1]])
            return at, self._thickness(geoms, at), "a link named so"
        ends = [corner for g in geoms for corner in self._corners(g)]
        if not ends:
            raise self._fail(f"'{model.body(body).name}' has neither a shape nor a link for its foot; add one")
        lowest = max(ends, key=lambda point: float(np.linalg.norm(point - knee)))
        reach = np.array([lowest[0], (np.min(ends, axis=0)[1] + np.max(ends, axis=0)[1]) / 2, lowest[2]])
        radius = self._thickness(geoms, reach)
        return reach + np.array([0.0, 0.0, radius]), radius, "the far end of the last link's shapes"

    def _thickness(self, geoms: list[int], place: Array) -> float:
        """Return a radius [m] for a foot: half of the width of the shape that is nearest to it."""
        length = float(np.linalg.norm(place - self._place(self.data.xanchor[0]))) if len(self.data.xanchor) else 0.3
        usual = 0.06 * max(length, 0.1)
        if not geoms:
            return usual
        nearest = min(geoms, key=lambda g: float(np.linalg.norm(self._place(self.data.geom_xpos[g]) - place)))
        half = np.sort(self.model.geom_aabb[nearest, 3:])
        return float(np.clip(half[0], 0.3 * usual, usual))

    def _corners(self, geom: int) -> list[Array]:
        """Return points of a shape's hull: the vertices of a mesh, the corners of the box around another shape."""
        model, turn, place = self.model, self.data.geom_xmat[geom].reshape(3, 3), self.data.geom_xpos[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            # The box around a mesh has its principal axes: the box around that one would be too large.
            first = model.mesh_vertadr[model.geom_dataid[geom]]
            points = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[geom]]].astype(float)
        else:
            signs = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
            points = model.geom_aabb[geom, :3] + model.geom_aabb[geom, 3:] * signs
        return list((place + points @ turn.T) @ self.turn.T)

    def _box(self, base: int) -> tuple[Array, Array]:
        """Return centre and half of the sides of a box around the base's shapes, or with its inertia."""
        bodies = np.flatnonzero(self.group == base)
        corners = [c for g in range(self.model.ngeom) if self.model.geom_bodyid[g] in bodies for c in self._corners(g)]
        if corners:
            low, high = np.min(corners, axis=0), np.max(corners, axis=0)
            return (low + high) / 2, (high - low) / 2
        body = self._body(base)
        xx, yy, zz = np.diag(body.inertia)
        squares = 1.5 / body.mass * np.array([yy + zz - xx, xx + zz - yy, xx + yy - zz])
        self.notes.append("the base has no shape: a box with its inertia stands for it")
        return body.centre, np.sqrt(np.maximum(squares, 1e-4))

    def _order(self, legs: list[ImportedLeg]) -> list[int]:
        """Return the indices of front left, front right, back left and back right legs."""
        hips = np.array([leg.joints[-2].place for leg in legs])
        feet = np.array([leg.foot for leg in legs])
        front, left = hips[:, 0] > hips[:, 0].mean(), feet[:, 1] > feet[:, 1].mean()
        found = [np.flatnonzero((front == f) & (left == s)) for f in (True, False) for s in (True, False)]
        if any(len(index) != 1 for index in found):
            raise self._fail("its hips are not at four corners, one leg at each")
        return [int(index[0]) for index in found]
