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
        stretch: stretch (2,) of the sole along x and y, s [m]; updated.
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

    Stretch and force are those of the motion along x and y; where the ground slopes, z follows. All else is as in
    `foot_force_kernel`.
    """
    nx, ny, nz = normal
    along = velocity[0] * nx + velocity[1] * ny + velocity[2] * nz
    slip_x, slip_y = velocity[0] - along * nx, velocity[1] - along * ny
    slide_damping = TANGENTIAL_DAMPING * damping
    stretch[0] += slip_x * dt
    stretch[1] += slip_y * dt
    force[0] = -(shear_stiffness * stretch[0] + slide_damping * slip_x)
    force[1] = -(shear_stiffness * stretch[1] + slide_damping * slip_y)
    bound = friction * load
    tangential = math.hypot(force[0], force[1])
    if tangential > bound:
        force[0] *= bound / tangential
        force[1] *= bound / tangential
    # Sliding may only take from what the sole has stored: a stretch set from the force would create energy.
    held = shear_stiffness * math.hypot(stretch[0], stretch[1])
    if held > bound:
        stretch[0] *= bound / held
        stretch[1] *= bound / held
    force[2] = -(nx * force[0] + ny * force[1]) / nz


@kernel
def spinning_torque_kernel(load: float, spin: float, coefficient: float) -> float:
    """Return the torque of the ground on one foot about the normal, t_n [N m].

    Args:
        load: force along the normal f_n [N].
        spin: angular velocity w of the foot about the normal [rad/s].
        coefficient: spinning friction c [m].
    """
    return -coefficient * load * min(max(spin / SPIN_SPEED, -1.0), 1.0)
