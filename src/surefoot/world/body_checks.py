"""Checks of a robot's masses, inertias and sides, and of what was noted about the file that it was made from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, judge, warn_if
from surefoot.errors import choices
from surefoot.robot import RobotDescription
from surefoot.robot.importing.rules import read_warnings
from surefoot.robot.mirror import MAX_SIDE_DIFFERENCE, side_difference
from surefoot.robot.rigid_body import are_valid_moments, describe_gyration, first_with_count
from surefoot.robot.urdf import Link

MIRROR_TOLERANCE = 0.02
"""Share by which mirrored masses and lengths may differ."""


def check_file(robot: RobotDescription) -> Iterator[CheckResult]:
    """Yield a warning with what the import found likely wrong in the file, if it did."""
    remedy = "correct the file and import it again, or delete the lines `# likely wrong` in robot.toml"
    if found := read_warnings(robot):
        yield warn_if("file", "; ".join(found), "", remedy)


def check_masses(robot: RobotDescription) -> CheckResult:
    """Compare inertias with what rigid bodies, and bodies of the links' sizes, have."""
    urdf = robot.urdf.fuse_fixed_links()
    links, total, length = urdf.links, robot.urdf.total_mass, robot.leg_geometry.length
    share = max(link.mass for link in links.values()) / total
    message = f"{total:.2f} kg, {share:.0%} in one body"
    if odd := [name for name, link in links.items() if not are_valid_moments(np.linalg.eigvalsh(link.body.inertia))]:
        rule = (
            f"; no rigid body has the inertia of {choices(odd)}: none of the moments may be over the sum of the others"
        )
        return judge("masses", False, message, rule, "correct these inertias in the URDF", total)
    ends: dict[str, list[Array]] = {name: [] for name in links}
    for joint in urdf.joints.values():
        ends[joint.parent].append(joint.frame[:3, 3])
    size = 2 * length + robot.body_length
    words = [described for name, link in links.items() if (described := _gyration(name, link, ends[name], size))]
    large, small = ([text for too_large, text in words if too_large is kind] for kind in (True, False))
    remedy = "take the inertia of a box of each link's size and mass in its <inertial>, or the CAD program's"
    if large:
        return fail_if("masses", f"{message}; {first_with_count(large)}", message, remedy, total)
    return warn_if("masses", f"{message}; {first_with_count(small)}" if small else None, message, remedy, total)


def _gyration(name: str, link: Link, ends: list[Array], robot_size: float) -> tuple[bool, str] | None:
    """Return whether a link's inertia is too large or too small for its shapes and joints; see `describe_gyration`."""
    body = link.body
    moments, _ = body.principal()
    corners = [shape.corners for shape in link.collisions]
    points = np.concatenate([np.zeros((1, 3)), *corners, *(end[None] for end in ends)])
    described = describe_gyration(name, body.mass, moments, points - body.centre, robot_size)
    # What is written of a leg are thin cylinders: only the base's shape shows what is too small.
    return (
        described
        if described is None or described[0] or any(shape.kind == "box" for shape in link.collisions)
        else None
    )


def check_sides(robot: RobotDescription) -> CheckResult:
    """Compare the legs with those across the middle plane: places of hips, lengths of links, masses."""
    links, joints = robot.urdf.fuse_fixed_links().links, robot.urdf.joints
    masses = [sum(links[joints[name].child].mass for name in (*leg.motors, *leg.knees)) for leg in robot.legs]
    differing = []
    for leg, mirror in enumerate(robot.leg_mounts * [1.0, -1.0, 1.0]):
        distances = np.linalg.norm(robot.leg_mounts - mirror, axis=1)
        other = int(np.argmin(distances))
        apart = distances[other] > MIRROR_TOLERANCE * robot.leg_geometry.length
        if other == leg or apart or abs(masses[leg] - masses[other]) > MIRROR_TOLERANCE * masses[leg]:
            differing.append(robot.leg_names[leg])
    remedy = "correct places and lengths of links and masses of legs, or go on if the robot is built so"
    if differing:
        rule = f"{choices(differing)}: no mirror image within {MIRROR_TOLERANCE:.0%} of the leg's length and mass"
        return CheckResult("left and right", False, rule, remedy)
    difference, length = side_difference(robot), robot.leg_geometry.length
    most = 1e3 * MAX_SIDE_DIFFERENCE * length
    if difference.length > MIRROR_TOLERANCE * length:
        rule = f"; lengths may differ by {MIRROR_TOLERANCE:.0%} of the leg, {1e3 * MIRROR_TOLERANCE * length:.2g} mm"
        return CheckResult("left and right", False, difference.text + rule, remedy)
    if difference.length > MAX_SIDE_DIFFERENCE * length:
        rule = f"{difference.text}: training goes without mirrored samples, which it learns from up to {most:.2g} mm"
        return warn_if("left and right", rule, "", remedy)
    near = "" if difference.length < 1e-6 else f" within {1e3 * difference.length:.1g} mm"
    return CheckResult("left and right", True, f"left and right are mirror images{near}")
