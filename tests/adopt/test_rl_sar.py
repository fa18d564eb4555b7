"""Policies of rl_sar: what is adopted computes what rl_sar's own arithmetic does, which is written out here."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import yaml
from foreign import DATA, Readings, perceptron

from surefoot.adopt.adoption import adopt
from surefoot.adopt.formats import rl_sar
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

FILES = {"himloco": DATA / "himloco" / "himloco.pt", "robot_lab": DATA / "robot_lab" / "policy.pt"}


@pytest.fixture(scope="session")
def adopted(go2):
    return {name: adopt(path, "rl_sar", go2, name) for name, path in FILES.items()}


class RlSar:
    """rl_sar's deployment of a policy in 32-bit numbers, from its sources (`rl_sdk.cpp`, `observation_buffer.cpp`)."""

    def __init__(self, name: str) -> None:
        (self.config,) = yaml.safe_load((FILES[name].parent / "config.yaml").read_text()).values()
        self.history: list[np.ndarray] = []
        self.actions = np.zeros(12, np.float32)

    def _array(self, key: str) -> np.ndarray:
        return np.array(self.config[key], np.float32)

    def observe(self, readings: Readings, command: np.ndarray) -> np.ndarray:
        """Return the network's input."""
        mapping = self.config["joint_mapping"]
        q = readings.quaternion.astype(np.float32)
        w, xyz, down = q[0], q[1:], np.array([0, 0, -1], np.float32)
        gravity = down * (2 * w * w - 1) - np.cross(xyz, down) * w * 2 + xyz * np.dot(xyz, down) * 2
        position = readings.motor_angle[mapping].astype(np.float32) - self._array("default_dof_pos")
        terms = {
            "commands": command.astype(np.float32) * self._array("commands_scale"),
            "ang_vel": readings.angular_velocity_base.astype(np.float32) * self._array("ang_vel_scale"),
            "gravity_vec": gravity,
            "dof_pos": position * self._array("dof_pos_scale"),
            "dof_vel": readings.motor_velocity[mapping].astype(np.float32) * self._array("dof_vel_scale"),
            "actions": self.actions,
        }
        limit = self.config["clip_obs"]
        observation = np.clip(np.concatenate([terms[name] for name in self.config["observations"]]), -limit, limit)
        if not self.config["observations_history"]:
            return observation
        length = max(self.config["observations_history"]) + 1
        self.history = [observation, *(self.history or [observation] * length)][:length]
        return np.concatenate([self.history[age] for age in self.config["observations_history"]])

    def targets(self, actions: np.ndarray) -> np.ndarray:
        """Return the motors' angles for the network's output."""
        self.actions = np.clip(actions, self._array("clip_actions_lower"), self._array("clip_actions_upper"))
        angles = np.zeros(12, np.float32)
        angles[self.config["joint_mapping"]] = self.actions * self._array("action_scale") + self._array(
            "default_dof_pos"
        )
        return angles


@pytest.mark.parametrize("name", FILES)
def test_observations_are_those_of_rl_sar(name, go2, random_readings, probe_observations):
    specification = rl_sar.read(FILES[name].parent / "config.yaml", go2)
    mine, commands = probe_observations(specification, random_readings)
    theirs, expected = RlSar(name), []
    for readings, command in zip(random_readings, commands, strict=True):
        expected.append(theirs.observe(readings, command))
        theirs.targets(expected[-1][:12])
    np.testing.assert_allclose(mine, expected, atol=1e-6, rtol=2e-7)


@pytest.mark.parametrize("name", FILES)
def test_targets_are_those_of_rl_sar(name, go2, adopted, random_readings, run_controller):
    module, theirs = torch.jit.load(FILES[name]).eval(), RlSar(name)
    targets, feedback, commands = run_controller(adopted[name].data, random_readings)
    low, high = go2.motor_limits
    outside = 0
    for k, readings in enumerate(random_readings):
        with torch.no_grad():
            action = module(torch.from_numpy(theirs.observe(readings, commands[k]))[None]).numpy()[0]
        # torch and onnxruntime sum 32-bit numbers in another order.
        theirs.targets(action)
        np.testing.assert_allclose(feedback[k, 12:], theirs.actions, atol=5e-6, rtol=5e-6)
        expected = theirs.targets(feedback[k, 12:].astype(np.float32))
        outside += np.sum((expected < low) | (expected > high))
        np.testing.assert_allclose(targets[k], np.clip(expected, low, high), atol=1e-6)
    assert outside > 10  # readings are beyond a walk's, and the joints' limits hold


def test_a_contract_says_what_rl_sars_files_say(adopted):
    contract = PolicyRuntime.parse(adopted["himloco"].data).contract
    assert (contract.robot, contract.history, contract.control_step) == ("go2", 6, 0.02)
    assert (contract.servo_kp, contract.servo_kd) == (40.0, 1.0)
    assert contract.action_names[:2] == ("angle.FR_hip_joint", "angle.FR_thigh_joint")
    assert len(contract.action_names) == 24
    assert contract.reference is None
    assert contract.figures["adopted"]["format"] == "rl_sar"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observations": ["ang_vel", "lin_vel"]}, "observation 'lin_vel' is the speed of the base, which no sensor"),
        ({"observations": ["ang_vel", "ang_speed"]}, "observation 'ang_speed' is unknown; known are commands"),
        ({"rl_kp": None}, "rl_kp is missing; it must be given"),
        ({"rl_kp": [20.0] * 11}, "kp has 11 numbers; there are 12 joints"),
        ({"joint_mapping": [0] * 12}, "joint_mapping is [0, 0"),
        ({"wheel_indices": [3]}, "robots with wheels can't be adopted"),
        ({"default_dof_pos": [0.0, 0.8, 1.5] * 4}, "default_pose can't be one of go2"),
        ({"observations": ["ang_vel", "gravity_vec"]}, "the network takes 45 numbers; the observations are 6"),
    ],
)
def test_configurations_that_do_not_fit_are_refused_in_one_line(tmp_path, go2, change, message):
    (config,) = yaml.safe_load((FILES["robot_lab"].parent / "config.yaml").read_text()).values()
    changed = {key: value for key, value in {**config, **change}.items() if value is not None}
    path, base = tmp_path / "robot_lab" / "config.yaml", tmp_path / "base.yaml"
    path.parent.mkdir()
    path.write_text(yaml.safe_dump({"go2/robot_lab": changed}))
    base.write_text((DATA / "base.yaml").read_text())
    network = tmp_path / "policy.onnx"
    network.write_bytes(perceptron(45))
    with pytest.raises(SurefootError) as caught:
        adopt(network, "rl_sar", go2, "x", path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
