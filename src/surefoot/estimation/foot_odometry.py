"""Legged odometry: the velocity of the base that each foot implies while it stands, and the force that it carries.

A foot is a sphere of radius r with its centre at c in the base frame. While it rolls on the ground without slipping,
its lowest point is at rest. With the direction u of up and the angular velocity w_f of the foot's link, both in the
base frame, the base moves with

    v = w_f x r u  -  w x c  -  dc/dt        w_f = w + (a', cos a f', sin a f')

for abduction a and link angle f. Rolling is not small: it is the ratio of r to the length of the leg, 4 to 7 percent
of the distance. Derivatives are differences between two readings, so that v is the mean over the time between them, and
its sum the distance.

The force f of the ground on a foot follows from the motor torques t and the Jacobian J of the foot, with the inertia I
of the rotors; the inertia of the links is left out:

    J^T f = -(t - I q'')
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from surefoot.arrays import Array
from surefoot.estimation.interface import MotionReadings
from surefoot.robot import FiveBar, RobotDescription
from surefoot.robot.leg import Legs
from surefoot.rotations import up_direction

SINGULAR = 1e-3
"""Singular value of a Jacobian, over the length of the leg, at which its inverse is bounded: near a straight leg
torques say nothing about the force along it."""
DIFFERENCE = 1e-4
"""Difference of motor angles [rad] with which the Jacobians are taken."""


@dataclass(frozen=True)
class FootObservations:
    """What the feet of N robots with L legs imply; vectors are in the base frame."""

    up: Array
    """Unit vector away from the ground (N, 3)."""
    velocity: Array
    """Velocity of the base if the foot rolls on the ground (N, L, 3) [m/s]."""
    contact_point: Array
    """Lowest point of each foot, from the base's origin (N, L, 3) [m]."""
    load: Array
    """Vertical force of the ground on each foot over an equal share of the weight (N, L)."""


def foot_radii(robot: RobotDescription) -> Array:
    """Return the radius of each foot's sphere (L,) [m]."""
    if isinstance(robot.leg_geometry, FiveBar):
        return np.full(len(robot.legs), robot.leg_geometry.foot_radius)
    links = robot.urdf.links
    spheres = [[shape.size[0] for shape in links[leg.foot].collisions if shape.kind == "sphere"] for leg in robot.legs]
    return np.array([radii[0] if radii else 0.0 for radii in spheres])


def cross(one: Array, other: Array) -> Array:
    """Return the cross product of vectors (..., 3), in a third of the time that numpy's takes for a few."""
    product = np.empty(np.broadcast_shapes(one.shape, other.shape))
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (one, other))
    product[..., 0], product[..., 1], product[..., 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return product


class FootOdometry:
    """Turns readings of N robots into what their feet imply, from one control step to the next."""

    def __init__(self, robot: RobotDescription) -> None:
        legs: Legs = robot.leg_geometry
        self._radius = foot_radii(robot)[:, None]
        if isinstance(legs, FiveBar):
            # The sheet's five-bar leg ends at the sole; the sphere's centre is above it.
            legs = replace(legs, foot=legs.foot - legs.foot_radius, foot_radius=0.0)
        self._legs = legs
        self._mounts, self._index = robot.leg_mounts, robot.leg_motor_index
        self._share = robot.weight / len(robot.legs)
        motors = self._index.shape[1]
        self._changes = DIFFERENCE * np.concatenate([np.zeros((1, motors)), np.eye(motors)])[:, None, None]
        self._floor = (SINGULAR * legs.length) ** 2 * np.eye(3)
        inertia = robot.nominal_params().get("rotor_inertia", 0.0)
        self._inertia = np.broadcast_to(np.asarray(inertia, float), (robot.num_motors,))[self._index]
        self._before: tuple[Array, ...] | None = None

    def reset(self) -> None:
        """Forget the readings before."""
        self._before = None

    def update(self, readings: MotionReadings) -> FootObservations:
        """Return what the feet imply for the time since the readings before; of the first ones, that they rest."""
        angles, speeds, torque = (
            np.take(values, self._index, axis=1)
            for values in (readings.motor_angle, readings.motor_velocity, readings.motor_torque)
        )
        rate, duration = readings.angular_velocity_base, readings.duration[:, None, None]
        # With `Legs.jacobian` an update takes half as long again: for one robot the number of operations counts, not
        # their size.
        places = self._legs.foot_position(angles + self._changes)
        link, jacobian = self._legs.foot_link_angles(angles, places[0]), (places[1:] - places[0]) / DIFFERENCE
        centre = places[0] + self._mounts
        old_centre, old_link, old_speeds, old_rate = self._before or (centre, link, speeds, rate)
        self._before = centre, link, speeds, rate
        up = up_direction(readings.roll_pitch_yaw)
        sole = self._radius * up[:, None]
        turn, change = ((rate + old_rate) / 2)[:, None], (link - old_link) / duration
        aside, pitch = (link[..., 0] + old_link[..., 0]) / 2, change[..., 1]
        of_link = np.empty_like(centre)
        of_link[..., 0], of_link[..., 1], of_link[..., 2] = change[..., 0], np.cos(aside) * pitch, np.sin(aside) * pitch
        of_link += turn
        velocity = cross(of_link, sole) - cross(turn, (centre + old_centre) / 2) - (centre - old_centre) / duration
        torque = torque - self._inertia * ((speeds - old_speeds) / duration)
        return FootObservations(up, velocity, centre - sole, self._load(jacobian, torque, up))

    def _load(self, jacobian: Array, torque: Array, up: Array) -> Array:
        """Return the vertical forces (N, L) over an equal share of the weight.

        Args:
            jacobian: of the feet, (m, N, L, 3) [m/rad].
            torque: of the motors, (N, L, m) [N m].
            up: direction of up, (N, 3).
        """
        # J^T f = -t, so f . u = -t . J^+ u = -(J t) . (J J^T)^-1 u.
        rows = jacobian.transpose(1, 2, 0, 3)
        square = rows.swapaxes(-1, -2) @ rows + self._floor
        along = np.linalg.solve(square, up[:, None, :, None])[..., 0]
        moved = (torque[..., None, :] @ rows)[..., 0, :]
        return np.asarray(-(moved * along).sum(axis=-1) / self._share)
