"""Legged odometry: the velocity of the base that each foot implies while it stands, and the force that it carries.

A foot is a sphere of radius r with its centre at c in the base frame. While it rolls on the ground without slipping,
its lowest point is at rest. With the direction u of up and the angular velocity w_f of the foot's link, both in the
base frame, the base moves with

    v = w_f x r u  -  w x c  -  dc/dt        w_f = w + (a', cos a f', sin a f')

for abduction a and link angle f. Rolling is not small: it is the ratio of r to the length of the leg, 4 to 7 percent
of the distance. Derivatives are differences between two readings, so that v is the mean over the time between them, and
its sum the distance.

The force f of the ground on a foot follows from the motor torques less the inertia of the rotors; the inertia of the
links is left out. The sole is a spring with the stiffness K and the damping B_t of the data sheet (`world.contact`), so
that a standing foot moves by s:

    K s + B_t ds/dt = -f        v = (v of a foot that rolls without slipping) + ds/dt

Without this term a Minitaur's trot is estimated 1 percent too slow, and a gallop 3 percent too fast.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.estimation.interface import MotionReadings
from surefoot.robot import FiveBar, RobotDescription
from surefoot.robot.leg import Legs
from surefoot.rotations import up_direction

SHEAR_DAMPING = 0.5
"""Ratio of the damping of a sole along the ground to its damping normal to the ground, as in `world.contact`."""
_CROSS = np.cross(np.eye(3), np.eye(3)[:, None]).reshape(3, 9)
"""For a vector b, b @ _CROSS, reshaped to (3, 3), is the matrix B with a @ B = a x b for each vector a."""


class FootObservations(NamedTuple):
    """What the feet of N robots with L legs imply; vectors are in the base frame."""

    up: Array
    """Unit vector away from the ground (N, 3)."""
    cross_turn: Array
    """Matrices (N, 3, 3): rows times a matrix are their cross products with the mean angular velocity [rad/s]."""
    velocity: Array
    """Velocity of the base if the foot stands (N, L, 3) [m/s]."""
    height: Array
    """Height of each foot's lowest point above the base's origin (N, L) [m]; negative below it."""
    load: Array
    """Vertical force of the ground on each foot over an equal share of the weight (N, L)."""
    is_finite: bool
    """Whether velocities and loads are finite: legs can close and torques are known."""


def foot_radii(robot: RobotDescription) -> Array:
    """Return the radius of each foot's sphere (L,) [m]."""
    if isinstance(robot.leg_geometry, FiveBar):
        return np.full(len(robot.legs), robot.leg_geometry.foot_radius)
    links = robot.urdf.links
    spheres = [[shape.size[0] for shape in links[leg.foot].collisions if shape.kind == "sphere"] for leg in robot.legs]
    return np.array([radii[0] if radii else 0.0 for radii in spheres])


class FootOdometry:
    """Turns readings of N robots into what their feet imply, from one control step to the next."""

    def __init__(self, robot: RobotDescription) -> None:
        legs: Legs = robot.leg_geometry
        self._radius = foot_radii(robot)
        if isinstance(legs, FiveBar):
            # The sheet's five-bar leg ends at the sole; the sphere's centre is above it.
            legs = replace(legs, foot=legs.foot - legs.foot_radius, foot_radius=0.0)
        self._legs = legs
        self._mounts, index = np.pad(robot.leg_mounts, ((0, 0), (0, 2))), robot.leg_motor_index
        self._shape = (-1, *index.shape)
        self._order = None if np.array_equal(index.ravel(), np.arange(robot.num_motors)) else index
        self._share = robot.weight / len(robot.legs)
        inertia = robot.nominal_params().get("rotor_inertia", 0.0)
        inertia = np.broadcast_to(np.asarray(inertia, float), (robot.num_motors,))[index]
        self._inertia = inertia if inertia.any() else None
        contact = robot.contact
        self._compliance = 1.0 / contact.stiffness
        self._sole_time = SHEAR_DAMPING * contact.damping / contact.stiffness
        self._before: tuple[Array, ...] | None = None

    def reset(self) -> None:
        """Forget the readings before."""
        self._before = None

    def start(self, rows: NDArray[np.int64], readings: MotionReadings) -> None:
        """Take the first readings of some robots (n,), which rest; all robots must start at first."""
        others, self._before = self._before, None
        self.update(readings)
        if others is not None and self._before is not None:
            for own, first in zip(others, self._before, strict=True):
                own[rows] = first
            self._before = others

    def arrays(self) -> dict[str, Array]:
        """Return the readings before, which an exact resume needs, by name; their first axis is the robots."""
        return dict(zip(("feet", "motor_velocity", "angular_velocity", "sole"), self._before or (), strict=False))

    def update(self, readings: MotionReadings) -> FootObservations:
        """Return what the feet imply for the time since the readings before; of the first ones, that they rest."""
        angles, speeds, torque = (
            values.reshape(self._shape) if self._order is None else values.take(self._order, axis=1)
            for values in (readings.motor_angle, readings.motor_velocity, readings.motor_torque)
        )
        rate, duration = readings.angular_velocity_base, readings.duration[:, None, None]
        feet = self._legs.foot_kinematics(angles)
        pose = feet.pose
        pose += self._mounts
        old_pose, old_speeds, old_rate, sole = self._before or (pose, speeds, rate, None)
        change, mean = (pose - old_pose) / duration, 0.5 * (pose + old_pose)
        axes = np.empty((len(rate), 2, 3))
        axes[:, 0], axes[:, 1] = up_direction(readings.roll_pitch_yaw), 0.5 * (rate + old_rate)
        # Per foot, the turn of its link times its radius, and its centre: what crosses `axes`.
        arms = np.empty((*pose.shape[:-1], 6))
        arms[..., :3], arms[..., 3:], pitch = axes[:, 1:], mean[..., :3], change[..., 4]
        if feet.abduction is None:
            arms[..., 1] += pitch
        else:
            cos, sin, _, _ = feet.abduction
            arms[..., 0] += change[..., 3]
            arms[..., 1] += cos * pitch
            arms[..., 2] += sin * pitch
        arms[..., :3] *= self._radius[:, None]
        cross = axes @ _CROSS
        velocity = arms @ cross.reshape(-1, 6, 3) - change[..., :3]
        if self._inertia is not None:
            torque = torque - self._inertia * ((speeds - old_speeds) / duration)
        force, upward = feet.force(torque), axes[:, 0, :, None]
        load = (force @ upward)[..., 0] / self._share
        # Implicit Euler: the force of the sole's spring follows the force on the foot.
        sole = force if sole is None else sole
        step = (force - sole) / (duration + self._sole_time)
        moved = velocity - self._compliance * step
        is_finite = math.isfinite(np.add.reduce(moved, axis=None))
        if not is_finite:
            step = np.where(np.isfinite(step), step, 0.0)
            sole, moved = np.where(np.isfinite(sole), sole, 0.0), velocity - self._compliance * step
        self._before = pose, speeds.copy(), rate.copy(), sole + step * duration
        height = (pose[..., :3] @ upward)[..., 0] - self._radius
        return FootObservations(axes[:, 0], cross[:, 1].reshape(-1, 3, 3), moved, height, load, is_finite)
