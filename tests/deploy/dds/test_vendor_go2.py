"""Messages and services with a robot that uses the vendor's classes: `tests/vendor_go2.py`, in another process."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from surefoot.deploy.dds import low_level
from surefoot.deploy.dds.low_level import LOW_STATE

pytest.importorskip("cyclonedds")
pytest.importorskip("mujoco")
pytest.importorskip("unitree_sdk2py.idl.default", exc_type=ImportError)
from go2_robot import worker_domain

from surefoot.deploy.dds import bus, services, types

pytestmark = pytest.mark.sdk
DOMAIN = worker_domain(200)
ROBOT = Path(__file__).parents[2] / "vendor_go2.py"


@pytest.mark.realtime
def test_a_robot_of_the_vendors_classes_reads_and_writes_the_same_messages() -> None:
    here = bus.Bus("lo", DOMAIN)
    states = here.reader(bus.LOW_STATE_TOPIC, types.LowState, 64)
    commands = here.writer(bus.LOW_COMMAND_TOPIC, types.LowCmd)
    command = low_level.new_command()
    motors = command["motor_cmd"][:12]
    motors["dq"] = 0.0
    motors["kp"], motors["kd"] = 20.0, 1.0

    def move(angle: float, valid: bool) -> np.ndarray:
        """Command the front left leg outward for 0.2 s; return the hip angles in the last state."""
        motors["q"] = goal + np.where(np.arange(12) == 3, angle, 0.0)
        for _ in range(20):
            data = low_level.encode(command)
            commands.write(data if valid else data[:-1] + bytes((data[-1] ^ 1,)))
            time.sleep(0.01)
        return low_level.decode(LOW_STATE, states.take(64)[-1])["motor_state"]["q"][:12:3].astype(float)

    words = [sys.executable, str(ROBOT), "--domain", str(DOMAIN), "--controller"]
    robot = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert robot.stdin is not None
        assert robot.stdout is not None
        assert robot.stdout.readline() == "robot is ready\n"
        switcher = services.Client(here, services.MOTION_SWITCHER)
        assert services.mode_name(switcher.call(services.CHECK_MODE)) == services.OWN_CONTROLLER
        services.Client(here, services.SPORT).call(services.STAND_DOWN)
        time.sleep(0.7)
        switcher.call(services.RELEASE_MODE)
        assert services.mode_name(switcher.call(services.CHECK_MODE)) == ""
        state = low_level.decode(LOW_STATE, states.take(64)[-1])
        goal = state["motor_state"]["q"][:12].astype(float)
        lying = move(0.0, valid=True)
        np.testing.assert_allclose(move(0.4, valid=False), lying, atol=0.02)
        moved = move(0.4, valid=True) - lying
        assert moved[1] > 0.2
        assert np.abs(moved[[0, 2, 3]]).max() < 0.05
        robot.stdin.write("damaged\n")
        robot.stdin.flush()
        time.sleep(0.1)
        with pytest.raises(low_level.BadMessageError, match="checksum"):
            low_level.decode(LOW_STATE, states.take(64)[-1])
    finally:
        robot.kill()
        robot.communicate()
