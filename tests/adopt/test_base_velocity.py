"""Third-party policies that observe the velocity of the base: rejected, or adopted with an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

pytest.importorskip("torch")
pytest.importorskip("mujoco")

from third_party_policies import DATA, DEPLOY, LEGGED_GYM, MJLAB, POSE, Probe, Readings, perceptron

from surefoot.adopt import examination
from surefoot.adopt.adoption import adopt
from surefoot.adopt.builder import build_policy
from surefoot.adopt.diagnosis import Diagnosis, check_answers
from surefoot.adopt.examination import TrialResult, TrueVelocity, examine
from surefoot.adopt.exporting import EXPORTERS
from surefoot.adopt.specification import ObservationTerm, PolicySpecification
from surefoot.errors import SurefootError
from surefoot.estimation.interface import MotionReadings
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.policy.runtime import PolicyRuntime
from surefoot.rotations import quat_matrix
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.world.sim_world import SimWorld

OBSERVED = ("base_velocity", "angular_velocity", "gravity", "command", "joint_positions", "joint_speeds", "last_action")


@pytest.fixture
def specification(go2):
    return PolicySpecification(
        joints=go2.motor_names,
        default_pose=(0.0, 0.8, -1.5) * 4,
        kp=30.0,
        kd=0.8,
        control_step=0.02,
        action_scale=0.01,
        observations=tuple(ObservationTerm(term) for term in OBSERVED),
        base_velocity="estimate",
    )


def files_of(kind: str, folder):
    """Write a network that observes the velocity and its configuration; return the paths and the expected scale."""
    network, config = folder / "policy.onnx", folder / "config.yaml"
    network.write_bytes(perceptron(48))
    if kind == "mjlab":
        names = f"base_lin_vel,{MJLAB['observation_names']}"
        network.write_bytes(perceptron(48, properties={**MJLAB, "observation_names": names}))
        return network, None, 1.0
    if kind == "legged_gym":
        config = folder / "config.py"
        config.write_text(LEGGED_GYM.replace("num_observations = 45", "num_observations = 48"))
        return network, config, 2.0
    if kind == "rl_sar":
        (table,) = yaml.safe_load((DATA / "robot_lab" / "config.yaml").read_text()).values()
        table |= {"dt": 0.005, "decimation": 4, "lin_vel_scale": 1.5}
        table["observations"] = ["lin_vel", *table["observations"]]
        config.write_text(yaml.safe_dump({"go2/mine": table}))
        return network, config, 1.5
    if kind == "unitree_rl_lab":
        one = {"params": {}, "clip": None, "scale": [0.5] * 3, "history_length": 5}
        observations = {"base_lin_vel": one, **DEPLOY["observations"]}
        config.write_text(yaml.safe_dump({**DEPLOY, "observations": observations}, sort_keys=False))
        network.write_bytes(perceptron(5 * 38))
        return network, config, (0.5, 0.5, 0.5)
    table = {"default_pose": POSE.tolist(), "kp": 25, "kd": 0.5, "control_step": 0.02}
    table["observations"] = [{"term": term} for term in OBSERVED]
    table["default_pose"] = [0.0, 0.8, -1.5] * 4
    config.write_text(yaml.safe_dump(table))
    return network, config, 1.0


@pytest.mark.parametrize("kind", ["mjlab", "legged_gym", "rl_sar", "unitree_rl_lab", "manual"])
def test_the_velocity_is_rejected_with_the_way_out_and_adopted_with_the_option(go2, tmp_path, kind):
    network, config, scale = files_of(kind, tmp_path)
    with pytest.raises(SurefootError) as caught:
        adopt(network, kind, go2, "x", config)
    message = str(caught.value)
    assert "observation base_velocity is the speed of the base, which no sensor of a robot measures" in message
    assert message.endswith(
        "give --base-velocity estimate to adopt the policy with an estimate from the IMU and the legs"
    )
    assert "\n" not in message
    adopted = adopt(network, kind, go2, "x", config, {"base_velocity": "estimate"})
    assert adopted.specification.observations[0].term == "base_velocity"
    assert adopted.specification.observations[0].scale == scale
    assert "estimated from the IMU and the legs" in adopted.specification.notes["base_velocity"]
    contract = PolicyRuntime.parse(adopted.data).contract
    (part,) = [part for part in contract.observation if part.name == "base_velocity"]
    assert (part.unit, part.frame) == ("m/s", "base")
    assert task_from_contract(contract, go2).needs_base_velocity


def test_the_option_is_rejected_for_a_policy_that_does_not_observe_the_velocity(go2, tmp_path):
    network, config, _ = files_of("manual", tmp_path)
    table = yaml.safe_load(config.read_text())
    table["observations"] = table["observations"][1:]
    config.write_text(yaml.safe_dump(table))
    network.write_bytes(perceptron(45))
    with pytest.raises(SurefootError, match="does not observe the speed of the base: leave --base-velocity out"):
        adopt(network, "manual", go2, "x", config, {"base_velocity": "estimate"})


def test_an_unknown_name_of_the_velocity_names_the_way_out(go2, tmp_path):
    network, config, _ = files_of("rl_sar", tmp_path)
    config.write_text(config.read_text().replace("lin_vel,", "estimated_velocity,").replace("- lin_vel", "- est_vel"))
    with pytest.raises(SurefootError, match="as the term base_velocity of --from manual, --base-velocity estimate"):
        adopt(network, "rl_sar", go2, "x", config, {"base_velocity": "estimate"})


def test_the_policy_is_not_exported_to_frameworks_without_an_estimate(go2, tmp_path):
    network, config, _ = files_of("manual", tmp_path)
    data = adopt(network, "manual", go2, "x", config, {"base_velocity": "estimate"}).data
    for export in EXPORTERS.values():
        with pytest.raises(SurefootError, match="can't be exported: it observes base_velocity; the format does not"):
            export(PolicyRuntime.parse(data), data, go2, tmp_path / "theirs")


def test_the_network_gets_the_estimate_in_its_scale_and_history(go2, specification, run_controller):
    terms = [
        ObservationTerm("base_velocity", scale=2.0, steps=(1, 0)),
        ObservationTerm("joint_positions", steps=(1, 0)),
    ]
    spec = replace(specification, observations=tuple(terms), history_by="term")
    probe = Probe(30, 12)
    data = build_policy(spec, probe, go2, "probe", {})
    rng = np.random.default_rng(3)
    pose = np.array(spec.default_pose)
    readings = [
        Readings(rng.uniform(-0.1, 0.1, 3), rng.normal(0, 0.3, 3), pose + rng.normal(0, 0.05, 12), rng.normal(0, 1, 12))
        for _ in range(8)
    ]
    _, feedback, _ = run_controller(data, readings)
    observed = feedback[:, -30:]
    moments = [
        MotionReadings(
            np.array([0.02]),
            one.roll_pitch_yaw[None],
            one.angular_velocity_base[None],
            one.motor_angle[None],
            one.motor_velocity[None],
            np.zeros((1, 12)),
        )
        for one in readings
    ]
    estimator, expected = LeggedOdometry(go2), [np.zeros(3)]
    estimator.start(np.arange(1), moments[0])
    expected += [2.0 * estimator.update(one).velocity_base[0] for one in moments[1:]]
    older = [expected[0], *expected[:-1]]
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(observed[:, 3:6], expected, atol=1e-5)
    np.testing.assert_allclose(observed[:, :3], older, atol=1e-5)


def test_an_examination_can_replace_the_estimate_by_the_truth(go2, specification, monkeypatch):
    data = build_policy(replace(specification, action_scale=0.3), Probe(48, 12), go2, "probe", {})
    policy = PolicyRuntime.parse(data)
    task = task_from_contract(policy.contract, go2)
    env = LocomotionEnv(task, 2, SimWorld, threads=1)
    env.components.append(examination._TrueVelocities(np.array([True, False])))
    env.reset()
    for _ in range(20):
        env.step(np.zeros(env.action_space.shape))
    truth = env.state.truth
    to_base = quat_matrix(truth.base_quat_world).swapaxes(-1, -2)
    true = (to_base @ truth.base_velocity_world[..., None])[..., 0]
    np.testing.assert_allclose(env.state.base_velocity[0], true[0], atol=1e-12)
    assert np.abs(env.state.base_velocity[1] - true[1]).max() > 1e-4

    # The robots of one change out of three observe the truth.
    replaced = []

    class Recorded(examination._TrueVelocities):
        def __init__(self, rows):
            replaced.append(rows)
            super().__init__(rows)

    monkeypatch.setattr(examination, "_TrueVelocities", Recorded)
    results = examine(
        policy, go2, task, [None, TrueVelocity(), None], duration=0.1, threads=1, chosen=("stand", "forward")
    )
    assert results[1].text == "with the true speed of the base"
    assert [rows.tolist() for rows in replaced] == [[False] * 2 + [True] * 2 + [False] * 2]


def trial(change, error: float, fallen: int = 0) -> TrialResult:
    """A trial of 8 robots with two commands, an error of the speed forward, and a number of fallen robots."""
    command = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    motion = np.tile(command, (4, 1, 1)) + np.array([error, 0.01, 0.01])
    upright = np.ones((4, 2))
    upright.ravel()[:fallen] = 0.5
    return TrialResult(change, ("stand", "forward"), command, motion, upright)


@pytest.mark.parametrize(
    ("error", "fallen", "passed"), [(0.1, 0, True), (0.14, 0, True), (0.16, 0, False), (0.1, 1, False)]
)
def test_doctor_compares_the_estimate_with_the_truth(error, fallen, passed):
    diagnosis = Diagnosis.from_results([trial(None, error, fallen), trial(TrueVelocity(), 0.1)])
    assert diagnosis.mistake is None
    (check,) = [one for one in check_answers(diagnosis) if one.name == "base velocity"]
    assert check.passed is passed
    assert f"estimated: {fallen} of 8 robots fell, errors {error:.2f} m/s forward" in check.message
    assert "true: 0 of 8 robots fell, errors 0.10 m/s forward, 0.01 m/s sideways, 0.01 rad/s" in check.message


def test_policies_without_the_observation_have_no_such_check():
    diagnosis = Diagnosis.from_results([trial(None, 0.1)])
    assert [one.name for one in check_answers(diagnosis)] == ["stand", "forward", "specification"]
