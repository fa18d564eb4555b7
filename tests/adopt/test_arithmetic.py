"""Adopted policies match the arithmetic of their own framework on hundreds of random states.

Observations, and the targets of an action, agree to 1e-6; actions of the network as far as two runtimes do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
import yaml
from third_party_deployers import IsaacLab, LeggedGym, RlSar
from third_party_policies import DATA, DEPLOY, GYM_ORDER, LAB_ORDER, LEGGED_GYM, LONG, MJLAB, POSE, perceptron

from surefoot.adopt.adoption import FORMATS, adopt

RUN = 100
"""Number of control steps after which memory and histories are reset."""
ACTION = DEPLOY["actions"]["JointPositionAction"]


@dataclass
class Case:
    """The files of a policy, and its deployment in its own framework."""

    format: str
    network: Path
    deployer: Callable[[], Any]
    states: int = 300

    @cached_property
    def run(self) -> Callable[[np.ndarray], np.ndarray]:
        """The network from observations (N, O) to actions (N, 12), in the framework's runtime."""
        if self.network.suffix == ".pt":
            module = torch.jit.load(self.network).eval()
            return lambda observations: module(torch.from_numpy(observations)).detach().numpy()
        session = onnxruntime.InferenceSession(self.network)
        return lambda observations: np.array([session.run(None, {"obs": one[None]})[0][0] for one in observations])


def rl_sar_case(folder: Path, name: str, file: str) -> Case:
    config = DATA / name / "config.yaml"
    (table,) = yaml.safe_load(config.read_text()).values()
    return Case("rl_sar", DATA / name / file, partial(RlSar, table))


def unitree_case(folder: Path, by_step: bool, scale_first: bool) -> Case:
    network, config = folder / "policy.onnx", folder / "deploy.yaml"
    data = {
        **DEPLOY,
        "observations": {"use_gym_history": by_step, "scale_first": scale_first, **DEPLOY["observations"]},
    }
    config.write_text(yaml.safe_dump(data, sort_keys=False))
    network.write_bytes(perceptron(35 * 5))
    layout = [
        ("base_ang_vel", (-2, 2), 0.2, 5),
        ("projected_gravity", None, 1.0, 5),
        ("command", None, [1, 1, 2], 5),
        ("joint_pos", (-100, 100), 1.0, 5),
        ("joint_vel", None, 0.05, 5),
        ("phase", None, 1.0, 5),
    ]
    deployer = partial(
        IsaacLab, LAB_ORDER, POSE, layout, ACTION["scale"], ACTION["clip"], by_step, scale_first, 0.02 / 0.7
    )
    return Case("unitree_rl_lab", network, deployer, 200 if by_step or scale_first else 300)


def mjlab_case(folder: Path, long: bool) -> Case:
    network = folder / "policy.onnx"
    length, clip = (3, (-1.5, 1.5)) if long else (1, None)
    layout = [
        ("base_ang_vel", clip, 0.25 if long else 1.0, length),
        ("projected_gravity", None, 1.0, length),
        ("joint_pos", None, 1.0, length),
        ("joint_vel", None, 0.05 if long else 1.0, length),
        *([] if long else [("actions", None, 1.0, 1)]),
        ("command", None, 1.0, 1),
    ]
    network.write_bytes(perceptron(93 if long else 45, properties=MJLAB | (LONG if long else {})))
    pose = [0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2
    return Case(
        "mjlab", network, partial(IsaacLab, GYM_ORDER, pose, layout, [0.373, 0.373, 0.3] * 4), 300 if long else 200
    )


def legged_gym_case(folder: Path) -> Case:
    network, config = folder / "policy.onnx", folder / "config.py"
    config.write_text(LEGGED_GYM)
    network.write_bytes(perceptron(45))
    pose = [0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5]
    return Case("legged_gym", network, partial(LeggedGym, GYM_ORDER, pose, 0.25))


CASES = {
    "himloco": partial(rl_sar_case, name="himloco", file="himloco.pt"),
    "robot_lab": partial(rl_sar_case, name="robot_lab", file="policy.pt"),
    "unitree_rl_lab": partial(unitree_case, by_step=False, scale_first=False),
    "unitree_rl_lab, by step": partial(unitree_case, by_step=True, scale_first=False),
    "unitree_rl_lab, scaled first": partial(unitree_case, by_step=False, scale_first=True),
    "mjlab": partial(mjlab_case, long=False),
    "mjlab, histories": partial(mjlab_case, long=True),
    "legged_gym": legged_gym_case,
}


@pytest.fixture(params=CASES)
def case(request, tmp_path):
    return CASES[request.param](tmp_path)


def runs(readings: list[Any]) -> Iterator[list[Any]]:
    """Split readings into runs."""
    for start in range(0, len(readings), RUN):
        yield readings[start : start + RUN]


def test_observations_match_the_framework(go2, case, random_readings, probe_observations):
    kind = FORMATS[case.format]
    config = case.network.parent / kind.configs[0] if kind.configs else case.network
    specification = kind.read(config, go2, {})
    for part in runs(random_readings[: case.states]):
        mine, commands = probe_observations(specification, part)
        theirs, expected = case.deployer(), []
        for readings, command in zip(part, commands, strict=True):
            expected.append(theirs.observe(readings, command))
            theirs.targets(expected[-1][:12])  # the action of the probe, which outputs its observation
        np.testing.assert_allclose(mine, expected, rtol=0, atol=1e-6)


def test_targets_match_the_framework(go2, case, random_readings, run_controller):
    data = adopt(case.network, case.format, go2, "policy").data
    for part in runs(random_readings[: case.states]):
        mine, feedback, commands = run_controller(data, part)
        theirs, observed, expected = case.deployer(), [], []
        keeps = feedback.shape[1] == 24  # the policy stores its last action if it observes it
        for k, (readings, command) in enumerate(zip(part, commands, strict=True)):
            observed.append(theirs.observe(readings, command))
            action = feedback[k, 12:] if keeps else case.run(observed[-1][None])[0]
            expected.append(theirs.targets(action.astype(np.float32)))
        np.testing.assert_allclose(mine, np.clip(expected, *go2.motor_limits), rtol=0, atol=1e-6)
        if keeps:  # runtimes add 32-bit numbers in different orders
            np.testing.assert_allclose(feedback[:, 12:], case.run(np.array(observed)), rtol=5e-6, atol=5e-6)
