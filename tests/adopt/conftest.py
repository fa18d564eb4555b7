"""Random readings, and adopted policies that run step by step as on a robot's computer."""

from __future__ import annotations

import io

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

from third_party_policies import DATA, Probe, Readings

from surefoot.adopt.builder import build_policy, check_specification
from surefoot.deploy.controller import Controller
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription


@pytest.fixture(scope="session")
def go2():
    return RobotDescription.load("go2")


@pytest.fixture(scope="session")
def random_readings():
    """Readings of 1000 control steps of a stumbling robot."""
    rng = np.random.default_rng(5)
    angles = np.array([0.0, 0.8, -1.5] * 4)
    return [
        Readings(rng.uniform(-0.5, 0.5, 3), rng.normal(0, 1, 3), angles + rng.normal(0, 0.2, 12), rng.normal(0, 3, 12))
        for _ in range(1000)
    ]


@pytest.fixture
def run_controller(go2, a_go2_state):
    """Return a function that runs a policy file on readings and returns targets, feedback and commands."""

    def run(data, readings, command=(0.7, -0.3, 0.5)):
        controller = Controller(PolicyRuntime.parse(data), go2)
        columns = list(controller.contract.columns)
        at = columns.index("command_forward") if "command_forward" in columns else None
        results = []
        for k, one in enumerate(readings):
            if at is not None:
                controller.set_command(command)
            observation = controller.observe(k * controller.contract.control_step, a_go2_state(one))
            target = controller.compute_target(0.0, observation)
            observed_command = np.zeros(3) if at is None else controller.observation[at : at + 3].copy()
            results.append((target.copy(), controller.feedback.copy(), observed_command))
        return [np.array(part) for part in zip(*results, strict=True)]

    return run


@pytest.fixture
def a_go2_state():
    """Return a function that converts readings to a state message."""
    from surefoot.deploy.messages import State

    def make(one: Readings) -> State:
        return State(
            session=1,
            mode=1,
            reason=0,
            command=0,
            command_age=0.0,
            dropped=0,
            motor_angle=one.motor_angle,
            motor_velocity=one.motor_velocity,
            motor_torque=np.zeros(12),
            roll_pitch_yaw=one.roll_pitch_yaw,
            angular_velocity_base=one.angular_velocity_base,
            energy=0.0,
            voltage=28.0,
            temperature=np.full(12, 30.0),
        )

    return make


@pytest.fixture
def probe_observations(go2, run_controller):
    """Return a function that computes the network's observations (T, O) from readings, and the commands (T, 3).

    The network's action is the first part of its observation.
    """

    def probe(specification, readings):
        width = check_specification(specification, go2)
        data = build_policy(specification, Probe(width, len(specification.joints)), go2, "probe", {})
        _, feedback, commands = run_controller(data, readings)
        return feedback[:, -width:], commands

    return probe


@pytest.fixture(scope="session")
def robot_lab(go2, tmp_path_factory):
    """Path of the policy robot_lab of rl_sar, adopted from an ONNX file."""
    from surefoot.adopt.adoption import adopt
    from surefoot.adopt.torchscript_tracing import trace

    folder = tmp_path_factory.mktemp("robot_lab") / "robot_lab"
    folder.mkdir()
    model, _ = trace(io.BytesIO((DATA / "robot_lab" / "policy.pt").read_bytes()), 45, 3)
    (folder / "policy.onnx").write_bytes(model)
    (folder / "config.yaml").write_text((DATA / "robot_lab" / "config.yaml").read_text())
    (folder.parent / "base.yaml").write_text((DATA / "base.yaml").read_text())
    path = folder.parent / "robot_lab.onnx"
    path.write_bytes(adopt(folder / "policy.onnx", "rl_sar", go2, "robot_lab").data)
    return path
