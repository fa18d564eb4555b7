"""Servos and torque limits of an MJCF's actuators, and the order of its motors.

A PD controller is an actuator with an affine bias: `<position>`, or `<general>` with `biastype="affine"`. With gear g
its torque is g (k u + b_0 + b_1 g q + b_2 g qdot), so at the joint k_p = -b_1 g^2 and k_d = -b_2 g^2. Two actuators of
a joint (`<position>` and `<velocity>`) add up. If there is no velocity term, the joint's damping is the controller's
k_d, as in models for MJX and in MuJoCo Menagerie.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import mjtBias, mjtTrn
from numpy.typing import NDArray

from surefoot.arrays import Array

_JOINT = (mjtTrn.mjTRN_JOINT.value, mjtTrn.mjTRN_JOINTINPARENT.value)
_MIN_GAIN = 1e-6
"""Minimum gain [N m/rad] and damping [N m s/rad]; smaller values count as none."""


class Servos(NamedTuple):
    """Servo gains and torque limits of joints; arrays have the shape of the joints, NaN for missing values."""

    kp: Array
    """Stiffness of the controller [N m/rad]."""
    kd: Array
    """Damping of the controller [N m s/rad]."""
    kd_is_damping: NDArray[np.bool_]
    """Whether the joint's damping is the controller's kd instead of friction."""
    torque: Array
    """Torque limit [N m]."""


def read_servos(model: mujoco.MjModel, joints: NDArray[np.int64], dampings: Array) -> Servos:
    """Read servo gains and torque limits of joints (...); `dampings` (...) [N m s/rad] are the joints' dampings."""
    gains = np.array([_gains(model, int(joint)) for joint in joints.ravel()]).reshape(*joints.shape, 2)
    kp, kd = gains[..., 0], gains[..., 1]
    has_servo = kp > _MIN_GAIN
    from_damping = has_servo & ~(kd > _MIN_GAIN) & (dampings > _MIN_GAIN)
    kd = np.where(from_damping, dampings, kd)
    return Servos(
        kp=np.where(has_servo, kp, np.nan),
        kd=np.where(has_servo & (kd > _MIN_GAIN), kd, np.nan),
        kd_is_damping=from_damping,
        torque=np.vectorize(lambda joint: _torque(model, joint), otypes=[float])(joints),
    )


def motor_order(model: mujoco.MjModel, names: Sequence[str]) -> tuple[str, ...]:
    """Return the joints `names` in the order of their actuators; empty if a joint has no actuator."""
    driven = [str(model.joint(int(model.actuator_trnid[k, 0])).name) for k in _joint_actuators(model)]
    order = tuple(name for name in dict.fromkeys(driven) if name in names)
    return order if len(order) == len(names) else ()


def _joint_actuators(model: mujoco.MjModel, joint: int | None = None) -> list[int]:
    """Return the actuators of a joint, or of all joints."""
    on_joints = [k for k in range(model.nu) if model.actuator_trntype[k] in _JOINT]
    return [k for k in on_joints if joint is None or model.actuator_trnid[k, 0] == joint]


def _gains(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Return the total stiffness and damping of a joint's controllers."""
    kp = kd = 0.0
    for k in _joint_actuators(model, joint):
        if model.actuator_biastype[k] == mjtBias.mjBIAS_AFFINE.value:
            gear = float(model.actuator_gear[k, 0])
            kp -= float(model.actuator_biasprm[k, 1]) * gear**2
            kd -= float(model.actuator_biasprm[k, 2]) * gear**2
    return kp, kd


def _torque(model: mujoco.MjModel, joint: int) -> float:
    """Return the smallest torque limit of a joint and its first limited actuator; NaN if there is none."""
    limits = [float(np.abs(model.jnt_actfrcrange[joint]).max())] if model.jnt_actfrclimited[joint] else []
    for k in _joint_actuators(model, joint):
        gear, own = abs(float(model.actuator_gear[k, 0])), []
        if model.actuator_forcelimited[k]:
            own.append(gear * float(np.abs(model.actuator_forcerange[k]).max()))
        if model.actuator_ctrllimited[k] and _is_motor(model, k):
            own.append(_motor_gain(model, k) * gear * float(np.abs(model.actuator_ctrlrange[k]).max()))
        if own:
            return min(limits + own)
    return min(limits, default=math.nan)


def _is_motor(model: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator's control signal is a torque, instead of a target angle or speed."""
    if model.actuator_biastype[actuator] == mjtBias.mjBIAS_NONE.value:
        return True
    _, position, speed = model.actuator_biasprm[actuator, :3]
    return not position and not math.isclose(_motor_gain(model, actuator), -speed)


def _motor_gain(model: mujoco.MjModel, actuator: int) -> float:
    """Return the force of a motor per unit of its control signal."""
    return abs(float(model.actuator_gainprm[actuator, 0]))
