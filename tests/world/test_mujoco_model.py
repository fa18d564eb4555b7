"""The MuJoCo model compared with closed-form kinematics and conservation of energy."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from surefoot.robot import RobotDescription
from surefoot.world.ground import Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.mujoco_model import build_model, foot_geoms, resting_qpos


def test_bodies_collide_with_the_triangles_of_the_ground(robot: RobotDescription):
    rng = np.random.default_rng(0)
    ground = Ground.from_points(rng.uniform(-0.1, 0.1, (6, 5)), 0.2, (0.3, -0.1))
    model = build_model(robot, WorldConfig(ground=ground))
    data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
    data.qpos[2] = 10.0  # move the robot out of the way
    mujoco.mj_kinematics(model, data)
    for place in ground.center + rng.uniform(-0.39, 0.39, (200, 2)):
        down = mujoco.mj_ray(model, data, [*place, 1.0], [0.0, 0.0, -1.0], None, 1, -1, geom)
        assert 1.0 - down == pytest.approx(ground.height(place), abs=1e-5)


class Rack:
    """The robot with its base fixed in space, every loop closed at swing 0 and an extension."""

    def __init__(self, robot: RobotDescription, extension: float, gravity: bool) -> None:
        self.robot, self.model = robot, build_model(robot, WorldConfig(rack=True))
        if not gravity:
            self.model.opt.gravity[:] = 0.0
        self.data = mujoco.MjData(self.model)
        self.motors = [self.model.joint(name) for name in robot.motor_names]
        self.data.qpos[:] = resting_qpos(replace(robot, rest=(0.0, extension)), self.model)
        mujoco.mj_forward(self.model, self.data)

    @property
    def angles(self) -> np.ndarray:
        return self.robot.motor_sign * [self.data.qpos[joint.qposadr[0]] for joint in self.motors]

    def step(self, target: np.ndarray) -> None:
        """Step once with a stiff servo."""
        speeds = self.robot.motor_sign * [self.data.qvel[joint.dofadr[0]] for joint in self.motors]
        torque = 20.0 * (target - self.angles) - 0.4 * speeds
        for joint, value in zip(self.motors, self.robot.motor_sign * torque, strict=True):
            self.data.qfrc_applied[joint.dofadr[0]] = value
        mujoco.mj_step(self.model, self.data)

    def feet_from_axes(self) -> np.ndarray:
        """Return foot positions (legs, 2) in the legs' planes, x and z from the motor axis."""
        axes = [self.data.xanchor[self.model.joint(leg.motors[1]).id] for leg in self.robot.legs]
        return (self.data.geom_xpos[foot_geoms(self.robot, self.model)] - axes)[:, [0, 2]]

    def energy(self) -> float:
        mujoco.mj_energyPos(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        return float(self.data.energy.sum())


def foot_centre(robot: RobotDescription, angles: np.ndarray) -> np.ndarray:
    """Return the closed-form centre of the foot's sphere, which is one radius before its end."""
    bars = robot.five_bar
    _, knee = bars.knees(angles)
    end = bars.foot_in_plane(angles)
    return knee + (end - knee) * (1 - bars.foot_radius / bars.foot)


def test_the_model_has_the_descriptions_masses_and_coordinates(robot: RobotDescription):
    model = build_model(robot)
    assert model.body_mass.sum() == pytest.approx(7.473, abs=1e-6)
    # Turning about x through the common centre of mass at z = -0.0185 x 2.64 / 5.993 = -0.0081495:
    # 0.006837 + 3.353 x 0.0081495^2 + 2 (0.004147 + 1.32 (0.1265^2 + 0.0103505^2)) = 0.0578824
    assert model.body(robot.base).mass[0] == pytest.approx(5.993)
    assert sorted(model.body(robot.base).inertia)[0] == pytest.approx(0.0578824, rel=2e-2)
    # Six free, eight of motors and eight of knees.
    assert (model.nv, model.neq, model.opt.timestep) == (6 + 8 + 8, 4, 0.001)


@pytest.mark.parametrize("swing", [-0.5, 0.0, 0.5])
def test_feet_follow_the_closed_form_over_the_legs_range(robot: RobotDescription, swing: float):
    rack = Rack(robot, 1.5, gravity=False)
    pair = robot.leg_motor_index
    worst = 0.0
    path = np.concatenate([np.linspace(1.5, 2.6, 800), np.linspace(2.6, 0.7, 1400)])
    for k, extension in enumerate(path):
        angles = robot.pose_angles(np.full(4, swing * min(1, k / 300)), np.full(4, extension))
        rack.step(angles)
        if k % 10 == 0:
            expected = foot_centre(robot, rack.angles[pair])
            worst = max(worst, float(np.abs(rack.feet_from_axes() - expected).max()))
    np.testing.assert_allclose(rack.angles, angles, atol=0.05)  # the legs followed the path
    assert worst < 1e-3


def test_closed_form_agrees_with_the_urdf(robot: RobotDescription):
    rack = Rack(robot, 2.0, gravity=False)
    expected = foot_centre(robot, np.full(2, 2.0))
    np.testing.assert_allclose(rack.feet_from_axes(), np.tile(expected, (4, 1)), atol=1e-9)


@pytest.mark.parametrize("direction", [1, -1])
def test_freely_swinging_legs_conserve_energy(robot: RobotDescription, direction: int):
    rack = Rack(robot, 1.5, gravity=False)
    for name, joint, sign in zip(robot.motor_names, rack.motors, robot.motor_sign, strict=True):
        rack.data.qvel[joint.dofadr[0]] = 5.0 * sign * (1 if "_1_" in name else direction)
    for _ in range(20):  # let the knees absorb the initial motor speeds
        mujoco.mj_step(rack.model, rack.data)
    start, path = rack.energy(), []
    for _ in range(1000):
        mujoco.mj_step(rack.model, rack.data)
        path.append(rack.energy())
    assert start > 0.04  # J
    np.testing.assert_allclose(path, start, rtol=0.02)


@pytest.mark.parametrize(("step", "share"), [(0.001, 0.05), (0.00025, 0.005)])
def test_falling_legs_convert_potential_to_kinetic_energy(robot: RobotDescription, step: float, share: float):
    rack = Rack(robot, 1.5, gravity=True)
    rack.model.opt.timestep = step
    start, kinetic = rack.energy(), []
    for _ in range(round(1 / step)):
        mujoco.mj_step(rack.model, rack.data)
        mujoco.mj_energyVel(rack.model, rack.data)
        kinetic.append(rack.data.energy[1])
    assert max(kinetic) > 0.5  # J
    # The error of a first-order integrator is proportional to its step, or less.
    assert rack.energy() == pytest.approx(start, abs=share * max(kinetic))


def test_friction_is_the_data_sheets_and_not_the_urdfs(tmp_path: Path):
    shutil.copytree(RobotDescription.load("solo8").folder, tmp_path / "solo8")
    urdf = tmp_path / "solo8" / "solo8.urdf"
    joint = '<joint name="FL_HFE" type="revolute">'
    text = urdf.read_text().replace(joint, f'{joint}<dynamics damping="0.5" friction="0.3"/>')
    assert "dynamics" in text
    urdf.write_text(text)
    model = build_model(RobotDescription.load(tmp_path / "solo8"))
    assert not model.dof_damping.any()
    assert not model.dof_frictionloss.any()
