"""Contact model of rubber feet: a spring-damper normal to the ground, and a spring-slider along it.

    normal      f_n = max(0, K d + B d')                     d: penetration [m]
    tangential  f_t = -(K_t s + B_t v), |f_t| <= mu f_n       s: shear of the sole since it began to stick [m]
    spinning    t_n = -c f_n sat(w / w_0)                     w: angular velocity about the normal [rad/s]

While the foot sticks, s follows its motion. When it slides, K_t s is limited to mu f_n. A standing foot therefore
sticks and does not creep. This is the spring-slider of Cundall and Strack (1979, "A discrete numerical model for
granular assemblies").

The spinning coefficient c is a length: a circular contact patch of radius a with uniform pressure resists spinning with
up to 2/3 mu a per newton of normal force (Coulomb friction, integrated over the patch).

MuJoCo's own contact is not used because its soft constraints couple the tangential stiffness to the normal stiffness.
With the measured stiffness and damping of these feet (3000 N/m, 100 N s/m), a foot with a pyramidal friction cone
creeps at 0.2 m/s under 10 N, and an elliptic cone that holds it triples the time of a physics step while a robot
flails.
"""

from __future__ import annotations

import math

from surefoot.actuator.compiled import kernel
from surefoot.arrays import Array

Vector = tuple[float, float, float]

TANGENTIAL_DAMPING = 0.5
"""Ratio B_t / B. The tangential stiffness nominally equals the normal stiffness; both tangential values were not
measured."""
WALL_NORMAL_Z = 0.5
"""Vertical component of the unit normal below which a contact is a wall contact (steeper than 60 degrees)."""
SPIN_SPEED = 0.1
"""Angular velocity w_0 [rad/s] at which the spinning resistance reaches its maximum."""


@kernel
def foot_force_kernel(
    depth: float,
    normal: Vector,
    velocity: Array,
    stretch: Array,
    friction: float,
    stiffness: float,
    shear_stiffness: float,
    damping: float,
    dt: float,
    force: Array,
) -> float:
    """Compute the force of the ground on one foot for the next step, and return its normal component f_n [N].

    Args:
        depth: penetration d [m]; negative above the ground.
        normal: unit normal of the ground at the deepest point of the foot, world frame.
        velocity: velocity of the foot at this point, world frame (3,) [m/s].
        stretch: shear s of the sole along the world's axes (3,) [m]; modified in place.
        friction: friction coefficient mu.
        stiffness: normal stiffness K [N/m].
        shear_stiffness: tangential stiffness K_t [N/m].
        damping: normal damping B [N s/m].
        dt: step [s].
        force: output, force in the world frame (3,) [N].
    """
    nx, ny, nz = normal
    load = stiffness * depth - damping * (velocity[0] * nx + velocity[1] * ny + velocity[2] * nz)
    if depth <= 0.0 or load <= 0.0:
        stretch[:] = 0.0
        force[:] = 0.0
        return 0.0
    friction_force_kernel(load, normal, velocity, stretch, friction, shear_stiffness, damping, dt, force)
    force[0] += load * nx
    force[1] += load * ny
    force[2] += load * nz
    return load


@kernel
def friction_force_kernel(
    load: float,
    normal: Vector,
    velocity: Array,
    stretch: Array,
    friction: float,
    shear_stiffness: float,
    damping: float,
    dt: float,
    force: Array,
) -> None:
    """Compute the tangential force (3,) [N] of the ground on a foot with the normal force `load` [N].

    Shear and force are computed along two world axes: x and y on the ground, z and a horizontal axis at a wall. The
    third component of the force follows from the normal. See `foot_force_kernel` for the other arguments.
    """
    # The axis closest to the normal, and the two axes along the surface.
    n = 2 if abs(normal[2]) >= WALL_NORMAL_Z else 0 if abs(normal[0]) > abs(normal[1]) else 1
    a, b = (n + 1) % 3, (n + 2) % 3
    along = velocity[0] * normal[0] + velocity[1] * normal[1] + velocity[2] * normal[2]
    slip_a, slip_b = velocity[a] - along * normal[a], velocity[b] - along * normal[b]
    slide_damping = TANGENTIAL_DAMPING * damping
    stretch[n] = 0.0
    stretch[a] += slip_a * dt
    stretch[b] += slip_b * dt
    force[a] = -(shear_stiffness * stretch[a] + slide_damping * slip_a)
    force[b] = -(shear_stiffness * stretch[b] + slide_damping * slip_b)
    bound = friction * load
    tangential = math.hypot(force[a], force[b])
    if tangential > bound:
        force[a] *= bound / tangential
        force[b] *= bound / tangential
    # Sliding may only release energy that the sole has stored: shear computed from the total force would create energy.
    elastic = shear_stiffness * math.hypot(stretch[a], stretch[b])
    if elastic > bound:
        stretch[a] *= bound / elastic
        stretch[b] *= bound / elastic
    force[n] = -(normal[a] * force[a] + normal[b] * force[b]) / normal[n]


@kernel
def spinning_torque_kernel(load: float, spin: float, coefficient: float) -> float:
    """Return the spinning torque t_n of the ground on one foot about the normal [N m].

    Args:
        load: normal force f_n [N].
        spin: angular velocity w of the foot about the normal [rad/s].
        coefficient: coefficient c of spinning friction [m].
    """
    return -coefficient * load * min(max(spin / SPIN_SPEED, -1.0), 1.0)
