"""Checks of a robot's masses, inertias and left-right symmetry, and warnings of its import."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, pass_if, warn_if
from surefoot.errors import choices
from surefoot.robot import RobotDescription
from surefoot.robot.importing.rules import read_warnings
from surefoot.robot.mirror import asymmetry, mirror_legs, side_difference
from surefoot.robot.rigid_body import are_valid_moments, describe_gyration, first_with_count
from surefoot.robot.urdf import Link

MIRROR_TOLERANCE = 0.02
"""Maximum relative difference between left and right masses and lengths."""


def check_file(robot: RobotDescription) -> Iterator[CheckResult]:
    """Yield a warning with likely mistakes that the import found in the robot's file, if any."""
    remedy = "correct the file and import it again, or delete the lines `# likely wrong` in robot.toml"
    if warnings := read_warnings(robot):
        yield warn_if("file", "; ".join(warnings), "", remedy)


def check_masses(robot: RobotDescription) -> CheckResult:
    """Check that inertias are physically possible, and plausible for the sizes of the links."""
    urdf = robot.urdf.fuse_fixed_links()
    links, total, length = urdf.links, robot.urdf.total_mass, robot.leg_geometry.length
    heaviest = max(link.mass for link in links.values()) / total
    message = f"{total:.2f} kg, {heaviest:.0%} in one body"
    if invalid := [
        name for name, link in links.items() if not are_valid_moments(np.linalg.eigvalsh(link.body.inertia))
    ]:
        rule = (
            f"; no rigid body has the inertia of {choices(invalid)}: a principal moment must not exceed the sum of the "
            "other two"
        )
        return pass_if("masses", False, message, rule, "correct these inertias in the URDF", total)
    ends: dict[str, list[Array]] = {name: [] for name in links}
    for joint in urdf.joints.values():
        ends[joint.parent].append(joint.frame[:3, 3])
    size = 2 * length + robot.body_length
    findings = [finding for name, link in links.items() if (finding := _gyration(name, link, ends[name], size))]
    large, small = ([text for too_large, text in findings if too_large is kind] for kind in (True, False))
    remedy = "set each <inertial> to the inertia from the CAD program, or of a box of each link's size and mass"
    if large:
        return fail_if("masses", f"{message}; {first_with_count(large)}", message, remedy, total)
    return warn_if("masses", f"{message}; {first_with_count(small)}" if small else None, message, remedy, total)


def _gyration(name: str, link: Link, ends: list[Array], robot_size: float) -> tuple[bool, str] | None:
    """Return whether a link's inertia is too large (True) or too small (False) for its shapes and joints, and why.

    None for a plausible inertia; see `describe_gyration`.
    """
    body = link.body
    moments, _ = body.principal()
    corners = [shape.corners for shape in link.collisions]
    points = np.concatenate([np.zeros((1, 3)), *corners, *(end[None] for end in ends)])
    described = describe_gyration(name, body.mass, moments, points - body.centre, robot_size)
    # Collision shapes of legs are thin cylinders, so only boxes (the base) tell which inertia is too small.
    return (
        described
        if described is None or described[0] or any(shape.kind == "box" for shape in link.collisions)
        else None
    )


def check_sides(robot: RobotDescription) -> CheckResult:
    """Compare left and right legs: positions of hips, lengths of links, and masses."""
    links, joints = robot.urdf.fuse_fixed_links().links, robot.urdf.joints
    masses = [sum(links[joints[name].child].mass for name in (*leg.motors, *leg.knees)) for leg in robot.legs]
    differing = []
    for leg, (other, distance) in enumerate(mirror_legs(robot)):
        apart = distance > MIRROR_TOLERANCE * robot.leg_geometry.length
        if other == leg or apart or abs(masses[leg] - masses[other]) > MIRROR_TOLERANCE * masses[leg]:
            differing.append(robot.leg_names[leg])
    remedy = "correct positions and lengths of links and masses of legs, or continue if the robot is built so"
    if differing:
        rule = f"{choices(differing)}: no mirror image within {MIRROR_TOLERANCE:.0%} of the leg length and mass"
        return CheckResult("left and right", False, rule, remedy)
    difference, length = side_difference(robot), robot.leg_geometry.length
    if difference.length > MIRROR_TOLERANCE * length:
        rule = (
            f"; lengths may differ by at most {MIRROR_TOLERANCE:.0%} of the leg length, "
            f"{1e3 * MIRROR_TOLERANCE * length:.2g} mm"
        )
        return CheckResult("left and right", False, difference.text + rule, remedy)
    if (reason := asymmetry(robot)) is not None:
        return warn_if("left and right", f"{reason}: training does not use mirrored samples", "", remedy)
    near = "" if difference.length < 1e-6 else f" within {1e3 * difference.length:.1g} mm"
    return CheckResult("left and right", True, f"left and right are mirror images{near}")
