"""Reader of any quadruped's URDF or MJCF with MuJoCo's parsers; the one module of this package that needs MuJoCo."""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
from mujoco import mjtGeom, mjtJoint
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.native_output import mujoco_errors
from surefoot.robot.importing.imported import ImportedJoint, ImportedLeg, ImportedRobot
from surefoot.robot.rigid_body import RigidBody, are_moments, fuse
from surefoot.robot.urdf_file import attribute, read_xml

FORWARD = {"+x": 0.0, "-x": np.pi, "+y": -np.pi / 2, "-y": np.pi / 2}
"""Directions in the file's frame that may be forward, and the turn about z that brings them to +x [rad]."""
_FRONT = re.compile(r"front|fore|(?:^|[^a-z])(?:f[lr]|[lr]f)(?:[^a-z]|$)", re.IGNORECASE)
_FOOT = re.compile(r"foot|toe|tip|sole|ankle", re.IGNORECASE)
_AXIS_TOLERANCE = 1e-3
"""How far an axis may be from the base's, as a cosine: files write pi/2 with five digits."""
_MESH_SUFFIXES = (".stl", ".obj", ".msh")
"""Kinds of mesh that MuJoCo reads."""
_PRODUCTS = dict.fromkeys(("ixy", "ixz", "iyz"), "0")


def read_robot(path: Path, forward: str | None = None, meshes: bool = True) -> ImportedRobot:
    """Read a quadruped from a URDF or MJCF.

    Args:
        path: the file.
        forward: direction in the file's frame that is forward, out of `FORWARD`; None: by the legs' names and axes.
        meshes: whether to read a URDF's meshes; without them the base is a box with its inertia.

    Raises:
        SurefootError: a file that can't be read, or a robot that is not a quadruped with legs of two or three hinges.
    """
    root = read_xml(path)
    if root.tag not in ("mujoco", "robot"):
        raise SurefootError(f"{path}: the root element is <{root.tag}>; a URDF's is <robot>, an MJCF's <mujoco>")
    notes: list[str] = []
    speeds = _prepare_urdf(root, path, meshes, notes) if root.tag == "robot" else {}
    with mujoco_errors(path):
        if root.tag == "mujoco":
            spec = mujoco.MjSpec.from_file(str(path))
        else:
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        spec.compiler.discardvisual = True
        spec.compiler.fusestatic = False
        for key in list(spec.keys):
            spec.delete(key)
        model = spec.compile()
    return _Reader(path, model, speeds, notes).read(forward)


def _prepare_urdf(root: ElementTree.Element, path: Path, meshes: bool, notes: list[str]) -> dict[str, float]:
    """Make a URDF ready for MuJoCo: no visuals, meshes by absolute path; return the joints' speed limits."""
    unreadable = set()
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for shape in link.findall("collision"):
            if (mesh := shape.find("geometry/mesh")) is None:
                continue
            file = _find_mesh(mesh.get("filename", ""), path) if meshes else None
            if file is not None and file.suffix.lower() in _MESH_SUFFIXES:
                mesh.set("filename", str(file))
                continue
            link.remove(shape)
            if file is not None:
                unreadable.add(file.name)
    if unreadable:
        notes.append(f"shapes that MuJoCo can't read are left out: {choices(sorted(unreadable))}")
    for old in root.findall("mujoco"):
        root.remove(old)
    compiler = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
    compiler.attrib |= {"strippath": "false", "fusestatic": "false", "discardvisual": "true"}
    compiler.attrib |= {"balanceinertia": "true", "inertiafromgeom": "false"}
    _prepare_inertias(root, path, notes)
    speeds = {}
    for joint in root.findall("joint"):
        try:
            speeds[joint.get("name", "")] = float(attribute(joint.find("limit"), "velocity"))
        except ValueError:
            continue
    return speeds


def _prepare_inertias(root: ElementTree.Element, path: Path, notes: list[str]) -> None:
    """Remove inertias of links without mass, and note those that no rigid body has."""
    count, odd = 0, []
    for link in root.findall("link"):
        if (inertial := link.find("inertial")) is None:
            continue
        tensor = inertial.find("inertia")
        try:
            mass = float(attribute(inertial.find("mass"), "value"))
            keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            xx, xy, xz, yy, yz, zz = (float(attribute(tensor, key, "0")) for key in keys)
        except ValueError:
            raise SurefootError(f"{path}: link '{link.get('name')}': its <inertial> has no numbers") from None
        if mass == 0.0 or tensor is None:
            link.remove(inertial)
            continue
        count += 1
        if mass > 0 and xx == yy == zz == 0.0:  # a point mass
            tensor.attrib |= _PRODUCTS
            continue
        whole = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = np.linalg.eigvalsh(whole) if np.isfinite(whole).all() else np.full(3, np.nan)
        if not (mass > 0 and are_moments(moments)):
            odd.append(str(link.get("name")))
        if not moments.min() > 0:
            tensor.attrib |= _PRODUCTS
    if not count:
        raise SurefootError(f"{path}: no link has an <inertial> with a mass; masses and inertias are needed")
    if odd:
        notes.append(f"inertias that no rigid body has, balanced: {choices(odd)}")


def _find_mesh(name: str, path: Path) -> Path:
    """Return the file of a mesh, beside the description or in a folder above it, as packages have it."""
    inside = Path(name.split("://", 1)[-1])
    # package://NAME/rest: the package's folder may have another name.
    parts = (inside, Path(*inside.parts[1:])) if len(inside.parts) > 1 else (inside,)
    for folder in path.resolve().parents[:6]:
        for part in parts:
            if (folder / part).is_file():
                return folder / part
    raise SurefootError(
        f"{path}: mesh '{name}' is not there; put it where the file names it, or leave out meshes (--no-meshes)"
    )


class _Reader:
    """Reader of a compiled model, at zero angles and with the base at the origin."""

    def __init__(self, path: Path, model: mujoco.MjModel, speeds: dict[str, float], notes: list[str]) -> None:
        self.path, self.model, self.speeds, self.notes = path, model, speeds, notes
        self.group = self._groups()
        self.data = mujoco.MjData(model)

    def _error(self, text: str) -> SurefootError:
        return SurefootError(f"{self.path}: {text}")

    def _joints(self, body: int) -> range:
        first = int(self.model.body_jntadr[body])
        return range(first, first + int(self.model.body_jntnum[body]))

    def _joint_name(self, body: int) -> str:
        return str(self.model.joint(self._joints(body)[0]).name)

    def _groups(self) -> NDArray[np.int64]:
        """Return for each body the body whose joint moves it; what has no joint is fixed to its parent."""
        model = self.model
        group = np.zeros(model.nbody, np.int64)
        for body in range(1, model.nbody):
            kinds = [int(model.jnt_type[j]) for j in self._joints(body)]
            if len(kinds) > 1 or set(kinds) - {int(mjtJoint.mjJNT_HINGE), int(mjtJoint.mjJNT_FREE)}:
                raise self._error(
                    f"body '{model.body(body).name}' has joints that are no single hinge; legs have hinges"
                )
            # Without a free joint, bodies on the world may be the base.
            top = not kinds and model.body_parentid[body] == 0 and mjtJoint.mjJNT_FREE not in model.jnt_type
            group[body] = body if kinds or top else group[model.body_parentid[body]]
        return group

    def read(self, forward: str | None) -> ImportedRobot:
        chains, base = self._chains()
        data = self.data
        mujoco.mj_resetData(self.model, data)
        for joint in self._joints(base):
            if self.model.jnt_type[joint] == mjtJoint.mjJNT_FREE:
                data.qpos[self.model.jnt_qposadr[joint] :][:7] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(self.model, data)
        forward = forward or self._guess_forward(chains)
        self._turn(FORWARD[forward])
        legs = self._in_order([self._leg(chain) for chain in chains])
        for source in dict.fromkeys(leg.foot_source for leg in legs):
            some = [leg for leg in legs if leg.foot_source == source]
            which = "feet" if some == legs else f"feet of {choices(leg.joints[-1].name for leg in some)}"
            radii = choices(dict.fromkeys(f"{leg.foot_radius:.3g}" for leg in some))
            self.notes.append(f"{which}: {source}, radius {radii} m")
        stem = self.path.stem if self.path.stem != "robot" else self.path.parent.name
        return ImportedRobot(
            name=re.sub(r"[^a-z0-9]+", "_", stem.lower()).strip("_"),
            path=self.path,
            base=self._body(base),
            base_box=self._box(base),
            legs=tuple(legs),
            forward=forward,
            notes=tuple(self.notes),
        )

    def _chains(self) -> tuple[list[list[int]], int]:
        """Return the four chains of moving bodies that hang from one base, and the base."""
        model = self.model
        movers = sorted({int(group) for group in self.group[1:]})
        if mjtJoint.mjJNT_HINGE not in model.jnt_type:
            raise self._error("nothing in it moves; a quadruped has four legs of hinges")
        children: dict[int, list[int]] = {body: [] for body in (0, *movers)}
        for body in movers:
            children[int(self.group[model.body_parentid[body]])].append(body)

        def longest(body: int) -> list[int]:
            return [body, *max(map(longest, children[body]), key=len, default=[])]

        def below(body: int) -> list[int]:
            return [body, *itertools.chain.from_iterable(map(below, children[body]))]

        # The base is what most legs hang from: the root, or below a mount without a free joint.
        base = max(movers, key=lambda body: (len(children[body]), -body))
        if len(children[base]) < 2 and len(children[0]) > len(children[base]):
            raise self._error("its legs hang from nothing that moves; the base needs to be a body")
        chains = [longest(child) for child in children[base]]
        legs = [chain for chain in chains if len(chain) in (2, 3)]
        if len(legs) != 4:
            legs = chains
        for chain in chains:
            if chain not in legs:
                name = self._joint_name(chain[0])
                self.notes.append(f"joint '{name}' and what hangs from it are held still: no leg's")
                self.group[np.isin(self.group, below(chain[0]))] = base
        if model.neq or any(len(children[body]) > 1 for chain in legs for body in chain[:-1]):
            what = "closed loops" if model.neq else "legs that branch and no loop that closes them"
            raise self._error(
                f"it has {what}; surefoot reads serial legs; a sheet for five-bar legs is written by hand"
            )
        if len(legs) != 4:
            raise self._error(f"{len(legs)} legs hang from '{model.body(base).name}'; a quadruped has 4")
        if len({len(chain) for chain in legs}) != 1 or len(legs[0]) > 3:
            counts = choices(str(len(chain)) for chain in legs)
            raise self._error(f"its legs have {counts} hinges; all must have 2, or all 3")
        return legs, base

    def _guess_forward(self, chains: list[list[int]]) -> str:
        """Return the direction that is forward: across the knees' axes, towards the legs whose names say front."""
        hips = np.array([self.data.xanchor[self._joints(chain[0])[0]] for chain in chains])
        knee = self.data.xaxis[self._joints(chains[0][-1])[0]]
        axis = 0 if abs(knee[1]) > abs(knee[0]) else 1
        front = np.array([bool(_FRONT.search(" ".join(map(self._joint_name, chain)))) for chain in chains])
        ahead = 1.0
        if front.sum() == 2:
            ahead = hips[front, axis].mean() - hips[~front, axis].mean()
        else:
            self.notes.append("forward is guessed: the joints' names do not say which legs are in front")
        return f"{'+' if ahead > 0 else '-'}{'xy'[axis]}"

    def _turn(self, angle: float) -> None:
        """Turn all places and frames about z [rad], so that x is forward."""
        cos, sin = np.cos(angle).round(12), np.sin(angle).round(12)
        turn, data = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]), self.data
        for places in (data.xpos, data.xipos, data.xanchor, data.xaxis, data.geom_xpos):
            places[:] = places @ turn.T
        for frames in (data.ximat, data.geom_xmat):
            frames[:] = (turn @ frames.reshape(-1, 3, 3)).reshape(-1, 9)

    def _body(self, mover: int) -> RigidBody:
        """Return what moves with a body as one, in the base's frame."""
        parts = []
        for body in np.flatnonzero((self.group == mover) & (self.model.body_mass > 0)):
            axes = self.data.ximat[body].reshape(3, 3)
            inertia = axes @ np.diag(self.model.body_inertia[body]) @ axes.T
            part = RigidBody(float(self.model.body_mass[body]), self.data.xipos[body].copy(), inertia)
            parts.append((part, np.eye(4)))
        if not parts:
            raise self._error(f"body '{self.model.body(mover).name}' has no mass; every moving part needs an inertia")
        return fuse(parts)

    def _leg(self, chain: list[int]) -> ImportedLeg:
        joints = []
        parts = (("abduction", 0), ("hip", 1), ("knee", 1))[-len(chain) :]
        for (part, axis), body in zip(parts, chain, strict=True):
            joints.append(self._hinge(self._joints(body)[0], part, axis))
        foot = self._foot(chain[-1], joints[-1].place)
        return ImportedLeg(tuple(joints), tuple(self._body(body) for body in chain), *foot)

    def _hinge(self, joint: int, part: str, along: int) -> ImportedJoint:
        """Return a joint that should turn about the base's x (0) or y axis (1)."""
        model, axis, name = self.model, self.data.xaxis[joint], str(self.model.joint(joint).name)
        if abs(abs(axis[along]) - 1) > _AXIS_TOLERANCE:
            raise self._error(
                f"joint '{name}' should be the {part}, and its axis at zero is "
                f"({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f}) with x forward; it must be along {'xy'[along]}"
            )
        exact = np.zeros(3)
        exact[along] = np.sign(axis[along])
        low, high = model.jnt_range[joint]
        dof = int(model.jnt_dofadr[joint])
        return ImportedJoint(
            name=name,
            place=self.data.xanchor[joint].copy(),
            axis=exact,
            limits=(float(low), float(high)) if model.jnt_limited[joint] else None,
            torque=self._torque(joint),
            speed=self.speeds.get(name),
            damping=float(np.ravel(model.dof_damping[dof])[0]),
            friction=float(model.dof_frictionloss[dof]),
            rotor_inertia=float(model.dof_armature[dof]),
        )

    def _torque(self, joint: int) -> float | None:
        """Return the torque limit of a joint: its own, or its actuator's."""
        model = self.model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        for k in np.flatnonzero(model.actuator_trnid[:, 0] == joint):
            gear = abs(float(model.actuator_gear[k, 0]))
            if model.actuator_forcelimited[k]:
                return gear * float(np.abs(model.actuator_forcerange[k]).max())
            if model.actuator_ctrllimited[k] and model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_NONE:
                return gear * float(np.abs(model.actuator_ctrlrange[k]).max())
        return None

    def _geoms(self, mover: int) -> list[int]:
        """Return the shapes that move with a body."""
        return np.flatnonzero(self.group[self.model.geom_bodyid] == mover).tolist()

    def _foot(self, body: int, knee: Array) -> tuple[Array, float, str]:
        """Return centre [m] and radius [m] of a leg's foot, and how it was recognized."""
        model, data, geoms = self.model, self.data, self._geoms(body)

        def from_knee(place: Array) -> float:
            return float(np.linalg.norm(place - knee))

        spheres = [g for g in geoms if model.geom_type[g] == mjtGeom.mjGEOM_SPHERE]
        if spheres:
            last = max(spheres, key=lambda g: from_knee(data.geom_xpos[g]))
            return data.geom_xpos[last].copy(), float(model.geom_size[last, 0]), "the last link's sphere"
        named = [b for b in np.flatnonzero(self.group == body) if _FOOT.search(model.body(int(b)).name)]
        if named:
            at = data.xpos[named[-1]].copy()
            return at, self._thickness(geoms, at), "a link named so"
        ends = [corner for g in geoms for corner in self._corners(g)]
        if not ends:
            raise self._error(f"'{model.body(body).name}' has neither a shape nor a link for its foot; add one")
        end = max(ends, key=from_knee)
        end = np.array([end[0], (np.min(ends, axis=0)[1] + np.max(ends, axis=0)[1]) / 2, end[2]])
        radius = self._thickness(geoms, end)
        return end + np.array([0.0, 0.0, radius]), radius, "the far end of the last link's shapes"

    def _thickness(self, geoms: list[int], place: Array) -> float:
        """Return a radius [m] for a foot: half of the width of the shape that is nearest to it."""
        usual = 0.06 * max(float(np.linalg.norm(place - self.data.xanchor[0])), 0.1)
        if not geoms:
            return usual
        nearest = min(geoms, key=lambda g: float(np.linalg.norm(self.data.geom_xpos[g] - place)))
        return float(np.clip(self.model.geom_aabb[nearest, 3:].min(), 0.3 * usual, usual))

    def _corners(self, geom: int) -> list[Array]:
        """Return points of a shape's hull: the vertices of a mesh, the corners of the box around another shape."""
        model = self.model
        if model.geom_type[geom] == mjtGeom.mjGEOM_MESH:
            # The box around a mesh has its principal axes: the box around that one would be too large.
            first = model.mesh_vertadr[model.geom_dataid[geom]]
            points = model.mesh_vert[first : first + model.mesh_vertnum[model.geom_dataid[geom]]].astype(float)
        else:
            signs = np.array(list(itertools.product((-1, 1), repeat=3)))
            points = model.geom_aabb[geom, :3] + model.geom_aabb[geom, 3:] * signs
        return list(self.data.geom_xpos[geom] + points @ self.data.geom_xmat[geom].reshape(3, 3).T)

    def _box(self, base: int) -> tuple[Array, Array]:
        """Return centre and half of the sides of a box around the base's shapes, or with its inertia."""
        corners = [corner for g in self._geoms(base) for corner in self._corners(g)]
        if corners:
            low, high = np.min(corners, axis=0), np.max(corners, axis=0)
            return (low + high) / 2, (high - low) / 2
        body = self._body(base)
        xx, yy, zz = np.diag(body.inertia)
        squares = 1.5 / body.mass * np.array([yy + zz - xx, xx + zz - yy, xx + yy - zz])
        self.notes.append("the base has no shape: a box with its inertia stands for it")
        return body.centre, np.sqrt(np.maximum(squares, 1e-4))

    def _in_order(self, legs: list[ImportedLeg]) -> list[ImportedLeg]:
        """Return the legs as front left, front right, back left and back right."""
        hips = np.array([leg.joints[-2].place for leg in legs])
        feet = np.array([leg.foot for leg in legs])
        front, left = hips[:, 0] > hips[:, 0].mean(), feet[:, 1] > feet[:, 1].mean()
        corners = [np.flatnonzero((front == f) & (left == s)) for f in (True, False) for s in (True, False)]
        if any(len(corner) != 1 for corner in corners):
            raise self._error("its hips are not at four corners, one leg at each")
        return [legs[int(corner[0])] for corner in corners]
