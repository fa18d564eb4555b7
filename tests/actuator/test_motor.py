"""Servo, DC motor and joint actuator at points calculated by hand, with the constants of the Minitaur's motor."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.actuator import joint_torque, motor_current, motor_friction, motor_torque, servo_duty
from surefoot.actuator.motor import joint_limit_kernel, overheat_kernel

VOLTAGE, KT, RESISTANCE, CLIP = 16.0, 0.0954, 0.186, 50.0
CURRENTS = np.array([0.0, 10, 20, 30, 40, 50, 60])
TORQUES = np.array([0.0, 1.0, 1.9, 2.45, 3.0, 3.25, 3.5])


def current(duty: float, speed: float) -> float:
    return float(motor_current(duty, speed, VOLTAGE, KT, RESISTANCE, CLIP))


def torque(amperes, strength=1.0):
    return motor_torque(amperes, strength, CURRENTS, TORQUES)


@pytest.mark.parametrize(
    ("duty", "speed", "expected"),
    [
        (1.0, 0.0, 86.0215),  # stall: 16 / 0.186
        (-1.0, 0.0, -86.0215),
        (0.5, 0.0, 43.0108),  # 8 / 0.186
        (1.0, 16.0 / 0.0954, 0.0),  # no load: back-EMF 0.0954 x 167.715 = 16 V
        (-1.0, -16.0 / 0.0954, 0.0),
        (1.0, 100.0, 34.7312),  # (16 - 9.54) / 0.186
        (0.5, 100.0, -8.2796),  # (8 - 9.54) / 0.186: the motor brakes
        (0.0, 100.0, -51.2903),  # -9.54 / 0.186
        (0.0, 0.0, 0.0),
        # The net voltage is clipped at 50 V.
        (1.0, 1000.0, -50 / 0.186),  # 16 - 95.4 = -79.4 V
        (1.0, -1000.0, 50 / 0.186),  # 16 + 95.4 = 111.4 V
        (1.0, 691.0, (16 - 65.9214) / 0.186),  # -49.9 V is within
    ],
)
def test_the_current_of_the_motor(duty: float, speed: float, expected: float):
    assert current(duty, speed) == pytest.approx(expected, abs=1e-4)


def test_torque_at_stall_and_at_a_working_point():
    assert torque(current(1.0, 0.0)) == 3.5
    # 34.7312 A is 0.47312 of the way from 30 A to 40 A: 2.45 + 0.47312 x 0.55
    assert torque(current(1.0, 100.0)) == pytest.approx(2.71022, abs=1e-5)


@pytest.mark.parametrize(
    ("amperes", "expected"),
    [
        *zip(CURRENTS, TORQUES, strict=True),
        (5.0, 0.5),
        (12.5, 1.225),  # 1 + 0.25 x 0.9
        (59.0, 3.475),
        (60.1, 3.5),
        (1e6, 3.5),
        (-5.0, -0.5),
        (-12.5, -1.225),
        (-1e6, -3.5),
    ],
)
def test_torque_at_between_and_beyond_the_tables_points(amperes: float, expected: float):
    assert torque(amperes) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("strength", [0.0, 0.8, 1.2])
def test_strength_scales_the_torque(strength: float):
    assert torque(60.0, strength) == pytest.approx(3.5 * strength)
    assert torque(-10.0, strength) == pytest.approx(-strength)


@pytest.mark.parametrize("speed", [0.5, 3.0, 100.0])
@pytest.mark.parametrize("friction", [0.01, 0.05])
def test_coulomb_friction_opposes_motion(speed: float, friction: float):
    assert motor_friction(speed, friction, 0.0) == pytest.approx(-friction, rel=2e-3)
    assert motor_friction(-speed, friction, 0.0) == pytest.approx(friction, rel=2e-3)


@pytest.mark.parametrize(
    ("speed", "coulomb", "viscous", "expected"),
    [
        (0.0, 0.05, 0.02, 0.0),
        (10.0, 0.0, 0.0, 0.0),
        (0.05, 0.05, 0.0, -0.0231059),  # tanh(0.05 / 0.1) = 0.462117
        (0.05, 0.05, 0.02, -0.0241059),  # and 0.02 x 0.05 = 0.001
        (-10.0, 0.05, 0.02, 0.25),
        (10.0, 0.0, 0.02, -0.2),
    ],
)
def test_friction_by_hand(speed: float, coulomb: float, viscous: float, expected: float):
    assert motor_friction(speed, coulomb, viscous) == pytest.approx(expected, abs=1e-7)


def test_friction_dissipates_power():
    speed = np.linspace(-20, 20, 101)
    assert np.all(motor_friction(speed, 0.05, 0.0) * speed <= 0)


@pytest.mark.parametrize(
    ("strength", "viscous", "time_constant"),
    [
        # J / b of a rotor with 0.003 kg m^2: 0.003 / 0.1.
        (0.0, 0.1, 0.030),
        (0.0, 0.02, 0.150),
        # Its back-EMF at duty 0 brakes it like 0.1 N m/A x K_t / R = 0.0512903 N m s/rad: 0.003 / 0.0512903, and
        # 0.003 / 0.1012903 with viscous friction.
        (1.0, 0.0, 0.058491),
        (1.0, 0.05, 0.029618),
    ],
)
def test_a_motor_that_turns_freely_slows_with_its_time_constant(strength: float, viscous: float, time_constant: float):
    inertia, dt, steps = 0.003, 1e-5, 3000
    speed = 10.0
    for _ in range(steps):
        braking = torque(current(0.0, speed), strength) + motor_friction(speed, 0.0, viscous)
        speed += braking / inertia * dt
    assert speed == pytest.approx(10.0 * np.exp(-steps * dt / time_constant), rel=1e-3)


def test_a_step_of_friction_does_not_reverse_a_motor():
    # (0.05 / 0.1 + 0.1) N m s/rad x 1 ms is below the minimum inertia of a Minitaur leg at one motor, 0.00064 kg m^2.
    speed = np.geomspace(1e-6, 100, 200)
    after = speed + motor_friction(speed, 0.05, 0.1) * 0.001 / 0.00064
    assert np.all(after > 0)
    assert np.all(after < speed)


def test_hot_time_grows_above_the_limit_and_resets_below_it():
    hot = 0.0
    for _ in range(5):
        hot = overheat_kernel(2.5, hot, 0.001, 2.45)
    assert hot == pytest.approx(0.005)
    assert overheat_kernel(-2.5, hot, 0.001, 2.45) == pytest.approx(0.006)
    assert overheat_kernel(2.45, hot, 0.001, 2.45) == 0.0
    assert overheat_kernel(0.0, hot, 0.001, 2.45) == 0.0


def test_the_motor_broadcasts_over_robots_and_motors(rng: np.random.Generator):
    duty, speed = rng.uniform(-1, 1, (5, 8)), rng.uniform(-50, 50, (5, 8))
    voltage, strength = rng.uniform(14, 17, (5, 1)), rng.uniform(0.8, 1.2, (5, 8))
    amperes = motor_current(duty, speed, voltage, KT, RESISTANCE, CLIP)
    answer = torque(amperes, strength)
    assert amperes.shape == answer.shape == (5, 8)
    expected = np.sign(amperes) * np.interp(np.abs(amperes), CURRENTS, TORQUES) * strength
    np.testing.assert_allclose(answer, expected, rtol=1e-14)
    np.testing.assert_allclose(amperes, (duty * voltage - KT * speed) / RESISTANCE, rtol=1e-14)
    assert motor_friction(speed, np.full(8, 0.05), np.full((5, 1), 0.02)).shape == (5, 8)


@pytest.mark.parametrize(
    ("target", "angle", "speed", "expected"),
    [
        (2.0, 2.0, 0.0, 0.0),
        (2.3, 2.0, 0.0, 0.3),
        (1.7, 2.0, 0.0, -0.3),
        (2.0, 2.0, 10.0, -0.15),  # damping: -0.015 x 10
        (2.0, 2.0, -10.0, 0.15),
        (2.3, 2.0, 10.0, 0.15),
        (3.5, 2.0, 0.0, 1.0),
        (0.0, 2.0, 0.0, -1.0),
        (2.0, 2.0, 1000.0, -1.0),
        (3.5, 2.0, 50.0, 0.75),  # the sum is clipped, not its parts: 1.5 - 0.75
    ],
)
def test_the_duty_of_the_servo(target: float, angle: float, speed: float, expected: float):
    assert servo_duty(target, angle, speed, 1.0, 0.015) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("target", "angle", "speed", "expected"),
    [
        (0.5, 0.5, 0.0, 0.0),
        (0.8, 0.5, 0.0, 9.0),  # 30 x 0.3
        (0.2, 0.5, 0.0, -9.0),
        (0.5, 0.5, 4.0, -2.0),  # damping: -0.5 x 4
        (0.5, 0.5, -4.0, 2.0),
        (0.8, 0.5, 4.0, 7.0),
        (10.5, 0.5, 0.0, 300.0),  # without the limit
    ],
)
def test_the_torque_of_a_joint_actuators_controller(target: float, angle: float, speed: float, expected: float):
    assert joint_torque(target, angle, speed, 30.0, 0.5) == pytest.approx(expected)


# An actuator with 20 N m up to 10 rad/s and no torque at 30 rad/s: 1 N m less per rad/s in between.
@pytest.mark.parametrize(
    ("torque", "speed", "expected"),
    [
        (5.0, 0.0, 5.0),
        (25.0, 0.0, 20.0),
        (-25.0, 0.0, -20.0),
        (25.0, 10.0, 20.0),
        (25.0, 15.0, 15.0),
        (-25.0, -15.0, -15.0),
        (14.0, 15.0, 14.0),  # below the limit
        (25.0, 20.0, 10.0),
        (25.0, 29.0, 1.0),
        (25.0, 30.0, 0.0),
        (25.0, 45.0, 0.0),  # not negative: the limit does not brake
        (-25.0, -45.0, 0.0),
        # A braking actuator has its full torque at any speed.
        (-25.0, 15.0, -20.0),
        (25.0, -15.0, 20.0),
        (-25.0, 45.0, -20.0),
        (-14.0, 45.0, -14.0),
        (0.0, 45.0, 0.0),
    ],
)
def test_the_torque_limit_of_a_joint_actuator_at_a_speed(torque: float, speed: float, expected: float):
    assert joint_limit_kernel(torque, speed, 20.0, 10.0, 30.0) == pytest.approx(expected, abs=1e-12)


def test_a_joint_actuator_with_equal_speeds_has_no_torque_above_them():
    assert joint_limit_kernel(25.0, 10.0, 20.0, 10.0, 10.0) == 20.0
    assert joint_limit_kernel(25.0, 10.001, 20.0, 10.0, 10.0) == 0.0
    assert joint_limit_kernel(-25.0, 10.001, 20.0, 10.0, 10.0) == -20.0


def test_nan_gives_neither_duty_nor_torque():
    assert np.isnan(current(np.nan, 0.0))
    assert np.isnan(torque(np.nan))
    for arguments in np.where(np.eye(3, dtype=bool), np.nan, 0.5):
        assert np.isnan(servo_duty(*arguments, 1.0, 0.015))
        assert np.isnan(joint_torque(*arguments, 30.0, 0.5))
    for speed in (0.0, 15.0, -15.0, 45.0):
        assert np.isnan(joint_limit_kernel(np.nan, speed, 20.0, 10.0, 30.0))


def test_servo_and_joint_actuator_broadcast_over_robots_and_motors(rng: np.random.Generator):
    target, angle, speed = rng.normal(size=(3, 5, 12))
    kp, kd = rng.uniform(10, 100, (5, 12)), rng.uniform(0, 2, 12)
    torques = joint_torque(target, angle, speed, kp, kd)
    expected = kp * (target - angle) - kd * speed
    np.testing.assert_allclose(torques, expected, rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(servo_duty(target, angle, speed, kp, kd), np.clip(expected, -1, 1), rtol=1e-13)
