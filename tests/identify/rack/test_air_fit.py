"""A recording of the experiment in the air is a log that a replay with the robot's own parameters repeats."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

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
    """Unfold, two seconds of the chirp of all joints, and two that are not fitted."""
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
    assert motion.moving.all()
    errors = replay_motion(motion, go2, PhysicalParams.nominal(go2), Replayer(go2, 1, torques=False))
    # At up to 9 rad/s, the servo step in which a command arrives counts.
    assert errors.rms < 2e-3
    # With another latency it would not be as near: readings have their own times.
    late = PhysicalParams.nominal(go2).with_values(go2, control_latency=0.02)
    assert replay_motion(motion, go2, late, Replayer(go2, 1, torques=False)).rms > 2 * errors.rms
