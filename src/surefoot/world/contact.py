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

TANGENTIAL_DAMPING = 0.5
"""B_t / B. The sole's stiffness along the ground is nominally that into the ground; neither was measured."""
SPIN_SPEED = 0.1
"""Angular velocity w_0 [rad/s] at which a foot that turns on the spot meets its full resistance."""


@kernel
def foot_force_kernel(
    depth: float,
    velocity: Array,
    stretch: Array,
    friction: float,
    stiffness: float,
    shear_stiffness: float,
    damping: float,
    dt: float,
    force: Array,
) -> None:
    """Compute the force of the ground on one foot over the next step.

    Args:
        depth: how deep the lowest point of the foot is in the ground, d [m]; below 0 above it.
        velocity: velocity (3,) of that point in the world frame, z up [m/s].
        stretch: stretch (2,) of the sole along x and y, s [m]; updated.
        friction: coefficient mu.
        stiffness: K [N/m].
        shear_stiffness: K_t [N/m].
        damping: B [N s/m].
        dt: step [s].
        force: output (3,), world frame [N].
    """
    normal = stiffness * depth - damping * velocity[2]
    if depth <= 0.0 or normal <= 0.0:
        stretch[:] = 0.0
        force[:] = 0.0
        return
    force[2] = normal
    sliding_force_kernel(normal, velocity, stretch, friction, shear_stiffness, damping, dt, force)


@kernel
def sliding_force_kernel(
    normal: float,
    velocity: Array,
    stretch: Array,
    friction: float,
    shear_stiffness: float,
    damping: float,
    dt: float,
    force: Array,
) -> None:
    """Compute the force along the ground on a foot that is pressed against it with `normal` [N].

    It writes the first two numbers of `force`; all else is as in `foot_force_kernel`.
    """
    slide_damping = TANGENTIAL_DAMPING * damping
    stretch[0] += velocity[0] * dt
    stretch[1] += velocity[1] * dt
    force[0] = -(shear_stiffness * stretch[0] + slide_damping * velocity[0])
    force[1] = -(shear_stiffness * stretch[1] + slide_damping * velocity[1])
    bound = friction * normal
    tangential = math.hypot(force[0], force[1])
    if tangential > bound:
        force[0] *= bound / tangential
        force[1] *= bound / tangential
    # Sliding may only take from what the sole has stored: a stretch set from the force would create energy.
    held = shear_stiffness * math.hypot(stretch[0], stretch[1])
    if held > bound:
        stretch[0] *= bound / held
        stretch[1] *= bound / held


@kernel
def spinning_torque_kernel(normal: float, spin: float, coefficient: float) -> float:
    """Return the torque of the ground on one foot about the normal, t_n [N m].

    Args:
        normal: normal force f_n [N].
        spin: angular velocity w of the foot about the normal, up [rad/s].
        coefficient: spinning friction c [m].
    """
    return -coefficient * normal * min(max(spin / SPIN_SPEED, -1.0), 1.0)
