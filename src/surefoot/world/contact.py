"""A rubber foot on the ground: a spring and damper into the ground, a spring that slides along it.

    normal      f_n = max(0, K d + B d')                     d: how deep the foot is in the ground [m]
    tangential  f_t = -(K_t s + B_t v), |f_t| <= mu f_n       s: stretch of the sole since it began to stick [m]
    spinning    t_n = -c f_n sat(w / w_0)                     w: angular velocity about the normal [rad/s]

While the foot sticks, s follows its motion; when it slides, K_t s is reduced to mu f_n. A
standing foot therefore sticks and does not creep. This is the spring-slider of Cundall and Strack (1979, "A discrete
numerical model for granular assemblies").

The spinning coefficient c is a length: rubber that touches with even pressure on a patch of radius a resists turning on
the spot with up to 2/3 mu a for each Newton of normal force (Coulomb friction, integrated over the patch).

Why not MuJoCo's own contact: its soft constraints tie the friction's stiffness to the normal one. With the measured
stiffness and damping of these feet (3000 N/m, 100 N s/m), a foot in a pyramidal friction cone creeps at 0.2 m/s under
10 N, and an elliptic cone that holds it costs three times the physics step while a robot flails.
"""

from __future__ import annotations

import math

from surefoot.actuator.compiled import kernel
from surefoot.arrays import Array

Vector = tuple[float, float, float]

TANGENTIAL_DAMPING = 0.5
"""B_t / B. The sole's stiffness along the ground is nominally that into the ground; neither was measured."""
WALL_NORMAL_Z = 0.5
"""Vertical part of a unit normal below which a contact is one at a wall, steeper than 60 degrees."""
SPIN_SPEED = 0.1
"""Angular velocity w_0 [rad/s] at which a foot that turns on the spot meets its full resistance."""


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
    """Compute the force of the ground on one foot over the next step; return its part along the normal, f_n [N].

    Args:
        depth: how deep the foot is in the ground, d [m]; below 0 above it.
        normal: unit normal of the ground where the foot is deepest, world frame.
        velocity: velocity (3,) of the foot there, world frame [m/s].
        stretch: stretch (3,) of the sole along the world's axes, s [m]; updated.
        friction: coefficient mu.
        stiffness: K [N/m].
        shear_stiffness: K_t [N/m].
        damping: B [N s/m].
        dt: step [s].
        force: output (3,), world frame [N].
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
    """Compute the force along the ground (3,) [N] on a foot that is pressed against it with a load [N].

    Stretch and force are those of the motion along two axes of the world: x and y on the ground, z and another one at a
    wall. The third component of the force follows from the normal. All else is as in `foot_force_kernel`.
    """
    # The axis that is nearest to the normal, and the two along the surface.
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
    # Sliding may only take from what the sole has stored: a stretch set from the force would create energy.
    held = shear_stiffness * math.hypot(stretch[a], stretch[b])
    if held > bound:
        stretch[a] *= bound / held
        stretch[b] *= bound / held
    force[n] = -(normal[a] * force[a] + normal[b] * force[b]) / normal[n]


@kernel
def spinning_torque_kernel(load: float, spin: float, coefficient: float) -> float:
    """Return the torque of the ground on one foot about the normal, t_n [N m].

    Args:
        load: force along the normal f_n [N].
        spin: angular velocity w of the foot about the normal [rad/s].
        coefficient: spinning friction c [m].
    """
    return -coefficient * load * min(max(spin / SPIN_SPEED, -1.0), 1.0)
