"""Legged odometry: the velocity of the base that each foot implies while it stands, and the force that it carries.

A foot is a sphere of radius r with its centre at c in the base frame. While it rolls on the ground without slipping,
its lowest point is at rest. With the direction u of up and the angular velocity w_f of the foot's link, both in the
base frame, the base moves with

    v = w_f x r u  -  w x c  -  dc/dt        w_f = w + (a', cos a f', sin a f')

for abduction a and link angle f. Rolling is not small: it is the ratio of r to the length of the leg, 4 to 7 percent
of the distance. Derivatives are differences between two readings, so that v is the mean over the time between them, and
its sum the distance.

The force f of the ground on a foot follows from the motor torques t and the Jacobian J of the foot, with the inertia I
of the rotors; that of the links is left out:

    J^T f = -(t - I q'')
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from surefoot.arrays import Array
from surefoot.estimation.interface import MotionReadings
from surefoot.robot import FiveBar, RobotDescription
from surefoot.robot.leg import Legs

SINGULAR = 1e-3
"""Singular value of a Jacobian, over the length of the leg, at which its inverse is bounded: near a straight leg
torques say nothing about the force along it."""


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


def up_direction(roll_pitch_yaw: Array) -> Array:
    """Return the direction away from the ground in the base frame (N, 3), a unit vector; (0, 0, 1) of a level base."""
    roll, pitch = roll_pitch_yaw[:, 0], roll_pitch_yaw[:, 1]
    level = np.cos(pitch)
    return np.stack([-np.sin(pitch), np.sin(roll) * level, np.cos(roll) * level], axis=-1)


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
        self._floor = (SINGULAR * legs.length) ** 2 * np.eye(3)
        inertia = robot.nominal_params().get("rotor_inertia", 0.0)
        self._inertia = np.broadcast_to(np.asarray(inertia, float), (robot.num_motors,))[self._index]
        self._before: tuple[Array, ...] | None = None

    def reset(self) -> None:
        """Forget the readings before."""
        self._before = None

    def update(self, readings: MotionReadings) -> FootObservations:
        """Return what the feet imply for the time since the readings before; of the first ones, that they rest."""
        angles, speeds = readings.motor_angle[:, self._index], readings.motor_velocity[:, self._index]
        rate, duration = readings.angular_velocity_base, readings.duration[:, None, None]
        centre, link = self._legs.foot_position(angles) + self._mounts, self._legs.foot_link_angles(angles)
        old_centre, old_link, old_speeds, old_rate = self._before or (centre, link, speeds, rate)
        self._before = centre, link, speeds, rate
        up = up_direction(readings.roll_pitch_yaw)
        sole = self._radius * up[:, None]
        turn, (abduction, pitch) = ((rate + old_rate) / 2)[:, None], np.moveaxis((link - old_link) / duration, -1, 0)
        aside = (link[..., 0] + old_link[..., 0]) / 2
        of_link = turn + np.stack([abduction, np.cos(aside) * pitch, np.sin(aside) * pitch], axis=-1)
        velocity = (
            np.cross(of_link, sole) - np.cross(turn, (centre + old_centre) / 2) - (centre - old_centre) / duration
        )
        torque = readings.motor_torque[:, self._index] - self._inertia * (speeds - old_speeds) / duration
        return FootObservations(up, velocity, centre - sole, self._load(angles, torque, up))

    def _load(self, angles: Array, torque: Array, up: Array) -> Array:
        """Return the vertical forces (N, L) over an equal share of the weight, for torques (N, L, m) [N m]."""
        jacobian = self._legs.jacobian(angles)
        # J^T f = -t, so f . u = -t . J^+ u.
        square = jacobian @ np.swapaxes(jacobian, -1, -2) + self._floor
        along = np.linalg.solve(square, np.broadcast_to(up[:, None, :, None], (*square.shape[:-1], 1)))
        rates = (np.swapaxes(jacobian, -1, -2) @ along)[..., 0]
        return np.asarray(-(torque * rates).sum(axis=-1) / self._share)
