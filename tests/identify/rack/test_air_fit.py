"""A replay with the robot's true parameters reproduces a recording of the air experiment."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from processes import EmulatorHere, emulators

pytest.importorskip("mujoco")

from surefoot.deploy.display import PlainLines
from surefoot.deploy.links import open_link
from surefoot.deploy.robot_link import LinkLostError
from surefoot.identify.experiment_runner import run_plan
from surefoot.identify.motion.replay_errors import replay_motion
from surefoot.identify.rack.air_fit import motion_from_phases
from surefoot.identify.rack.air_plan import air_plan
from surefoot.identify.recording import COMPLETE, Recording
from surefoot.identify.replay import Replayer
from surefoot.robot import PhysicalParams, RobotDescription


@pytest.fixture(scope="module")
def go2() -> RobotDescription:
    return RobotDescription.load("go2")


@pytest.fixture(scope="module")
def recording(go2: RobotDescription) -> Recording:
    """Recording of the unfolding, two seconds of the chirp of all joints, and two held-out seconds."""
    plan = air_plan(go2)
    phases = {phase.name: phase for phase in plan.phases}
    short = (
        phases["unfold"],
        replace(phases["chirp of all"], duration=2.0),
        phases["centre"],
        replace(phases["chirp back"], duration=2.0),
    )
    with emulators(EmulatorHere) as start:
        port = start("--robot", "go2", "--lockstep", "--rack", "--ideal-sensors").port
        link = open_link(port, go2.num_motors, lockstep=True)
        try:
            link.connect()
            return run_plan(link, replace(plan, phases=short), go2, PlainLines())
        finally:
            with suppress(LinkLostError, OSError):
                link.close()


def test_the_recording_states_the_gains_of_the_robot(go2: RobotDescription, recording: Recording):
    assert recording.meta["ended"] == COMPLETE
    nominal = PhysicalParams.nominal(go2)
    for name in ("servo_kp", "servo_kd"):
        np.testing.assert_allclose(recording.meta["gains"][name], getattr(nominal, name)[0])


@pytest.mark.parametrize("use", ["fit", "check"])
def test_a_replay_repeats_the_recording(go2: RobotDescription, recording: Recording, use: str):
    motion = motion_from_phases(recording, use)
    assert motion.rack
    assert np.ptp(motion.time) == pytest.approx(2.0, abs=0.1)
    assert motion.moving_joints.all()
    replayer, nominal = Replayer(go2, 1, torques=False), PhysicalParams.nominal(go2)

    def error(late: float) -> float:
        latency = float(nominal.control_latency[0]) + late
        return replay_motion(motion, go2, nominal.with_values(go2, control_latency=latency), replayer).rms

    # At up to 9 rad/s, the servo step in which a command begins to act counts, and a tenth of a millisecond of latency.
    assert error(0.0) < 2e-4
    assert min(error(-0.0003), error(0.0003)) > 2 * error(0.0)


def commands_of_readings(recording: Recording, age: float) -> dict[bytes, bytes]:
    """Return the command that begins to act when each reading is taken, if commands are `age` older than reported [s].

    Readings that repeat, as of a robot that does not move yet, are left out.
    """
    motion = motion_from_phases(replace(recording, command_age=recording.command_age + age), "fit")
    np.testing.assert_allclose(motion.read_time, motion.time, atol=1e-9)
    keys = [angle.tobytes() for angle in motion.motor_angle]
    return {key: command.tobytes() for key, command in zip(keys, motion.command, strict=True) if keys.count(key) == 1}


def test_a_command_acts_from_the_servo_step_after_its_arrival(recording: Recording):
    """Ages of commands are rounded to 10 us; a command that arrives as a servo step begins acts in it."""
    assert not motion_from_phases(recording, "fit").computed_clock
    exact = commands_of_readings(recording, 0.0)
    assert len(exact) > 900
    for age in (-1e-5, 1e-5):
        rounded = commands_of_readings(recording, age)
        same = exact.keys() & rounded.keys()
        assert len(same) > 900
        assert all(exact[key] == rounded[key] for key in same)
    # A command that comes half a millisecond later waits for the next step.
    late = commands_of_readings(recording, -5e-4)
    keys = list(exact)
    waiting = [late[then] == exact[now] for now, then in pairwise(keys) if then in late]
    assert len(waiting) > 900
    assert all(waiting)
