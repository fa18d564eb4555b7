"""Any choice of observations in any order, from task to environment to contract."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("torch")

from scripted_world import ScriptedWorld

from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.contract_mapping import make_contract
from surefoot.task.env import LocomotionEnv
from surefoot.task.leg_config import WaveConfig
from surefoot.task.observation import IMU_AND_MOTORS_12D, PARTS, Observer, gravity, phase
from surefoot.task.reference_config import SineReferenceConfig
from surefoot.world.interface import SensorReadings

WIDTHS = {
    **dict.fromkeys(("roll", "pitch", "roll_rate", "pitch_rate"), 1),
    **{"motor_angles": 8, "motor_speeds": 8, "yaw_rate": 1, "reference_phase": 2, "last_action": 8, "gravity": 3},
}
choices_of_parts = st.permutations(sorted(WIDTHS)).flatmap(
    lambda names: st.integers(1, len(names)).map(lambda count: tuple(names[:count]))
)


@pytest.fixture(scope="module")
def make_env():
    """Return a function that makes an environment with these observations; each reading is a unique number."""

    class NumberedWorld(ScriptedWorld):
        def readings(self) -> SensorReadings:
            robots = 1000.0 * np.arange(self.num_envs)[:, None]
            return SensorReadings(
                time=self.time.copy(),
                roll_pitch_yaw=robots + np.arange(1.0, 4.0),
                angular_velocity_base=robots + np.arange(4.0, 7.0),
                motor_angle=robots + np.arange(10.0, 18.0),
                motor_velocity=robots + np.arange(20.0, 28.0),
            )

    def make(names: tuple[str, ...], history: int = 1) -> LocomotionEnv:
        # A period of 4 control steps: the phase of the k-th one is k quarters.
        wave = WaveConfig(amplitude=0.1, frequency=1 / 0.024)
        reference = SineReferenceConfig(swing=wave, extension=WaveConfig(offset=2.0))
        feedback = FeedbackConfig((-0.5, 0.5), (-0.5, 0.5))
        task = TaskConfig(observations=names, history=history, reference=reference, feedback=feedback)
        return LocomotionEnv(task, 2, NumberedWorld)

    return make


def expected(name: str, robot: int, steps: int) -> list[float]:
    """Return the values of an observation after a number of control steps with action 0.5, worked by hand."""
    start = 1000.0 * robot
    quarter = [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)][steps % 4]
    return {
        "roll": [start + 1],
        "pitch": [start + 2],
        "roll_rate": [start + 4],
        "pitch_rate": [start + 5],
        "yaw_rate": [start + 6],
        "motor_angles": [start + 10 + k for k in range(8)],
        "motor_speeds": [start + 20 + k for k in range(8)],
        "reference_phase": list(quarter),
        "last_action": [0.25 if steps else 0.0] * 8,
        "gravity": [
            math.sin(start + 2),
            -math.sin(start + 1) * math.cos(start + 2),
            -math.cos(start + 1) * math.cos(start + 2),
        ],
    }[name]


def check(env: LocomotionEnv, names: tuple[str, ...], history: int) -> Contract:
    """Check space, values and contract of an environment with these observations; return the contract."""
    width = sum(WIDTHS[name] for name in names)
    assert env.single_observation_space.shape == (width * history,)
    env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(np.full((2, 8), 0.5))
    for robot in range(2):
        newest_first = [n for back in range(history) for name in names for n in expected(name, robot, 3 - back)]
        np.testing.assert_allclose(observation[robot], newest_first, atol=1e-6)
    contract = make_contract(env)
    assert tuple(part.name for part in contract.observation) == names
    assert len(contract.columns) == len(set(contract.columns)) == width
    assert (contract.history, contract.width) == (history, width * history)
    assert Contract.from_json(contract.to_json()) == contract
    return contract


def test_every_part_of_an_observation_is_tested():
    assert set(PARTS) == {*WIDTHS, "command", "memory", "height_scan", "footholds", "over_holes", "base_velocity"}
    assert (PARTS["roll_rate"].unit, PARTS["roll_rate"].frame) == ("rad/s", "base, about x")


@settings(max_examples=30)
@given(names=choices_of_parts, history=st.integers(1, 3))
def test_an_observation_has_any_parts_in_any_order(make_env, names, history):
    check(make_env(names, history), names, history)


def test_the_papers_twelve_numbers(make_env):
    contract = check(make_env(IMU_AND_MOTORS_12D), IMU_AND_MOTORS_12D, 1)
    assert contract.columns == (
        *("roll", "pitch", "roll_rate", "pitch_rate"),
        *("angle.front_left_2_motor", "angle.front_left_1_motor", "angle.back_left_2_motor", "angle.back_left_1_motor"),
        *("angle.front_right_1_motor", "angle.front_right_2_motor"),
        *("angle.back_right_1_motor", "angle.back_right_2_motor"),
    )
    assert TaskConfig().observations == IMU_AND_MOTORS_12D


def test_gravity_is_the_direction_down_in_the_base_frame():
    level, nose_down, left_up = np.array([[0, 0, 1], [0, 0.3, 1], [0.3, 0, 1]], float)
    np.testing.assert_allclose(gravity(level[None]), [[0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(gravity(nose_down[None]), [[math.sin(0.3), 0, -math.cos(0.3)]], atol=1e-12)
    np.testing.assert_allclose(gravity(left_up[None]), [[0, -math.sin(0.3), -math.cos(0.3)]], atol=1e-12)


def test_memory_is_the_last_output_and_moves_nothing():
    task = TaskConfig(robot="go2", observations=("memory", "last_action"), action="angle", memory=2)
    env = LocomotionEnv(task, 2, ScriptedWorld)
    feedback = np.concatenate([np.tile(env.robot.resting_angles, (2, 1)), [[1.5, -300.0], [2.5, 40.0]]], axis=1)
    observation, *_ = env.step(env.gait.action(feedback))
    np.testing.assert_allclose(observation, np.roll(feedback, 2, axis=1), rtol=1e-6)
    np.testing.assert_allclose(env.state.target, feedback[:, :-2], atol=1e-12)
    observation, _ = env.reset()
    assert not observation.any()
    contract = make_contract(env)
    assert contract.columns[:3] == ("memory.0", "memory.1", "last_angle.FR_hip_joint")
    assert contract.action_names[-3:] == ("angle.RL_calf_joint", "memory.0", "memory.1")


def test_another_order_is_another_contract(make_env):
    one, other = (make_contract(make_env(names)) for names in (("roll", "pitch"), ("pitch", "roll")))
    assert one.columns == other.columns[::-1]
    assert one.config_hash != other.config_hash


@pytest.mark.parametrize(
    ("names", "pieces"),
    [
        (("roll", "yaw"), ["observation 'yaw' does not exist", "choices: roll, pitch", "last_action"]),
        ((), ["observations is empty", "choices: roll"]),
        (("roll", "pitch", "roll"), ["roll, pitch, roll", "names must not repeat"]),
    ],
)
def test_invalid_observations_are_rejected_in_one_line(robot, names, pieces):
    with pytest.raises(SurefootError) as caught:
        Observer(robot, names)
    assert "\n" not in str(caught.value)
    for piece in pieces:
        assert piece in str(caught.value)


def test_phase_without_a_period_is_rejected():
    with pytest.raises(SurefootError, match="'reference_phase' needs a periodic reference"):
        phase(np.zeros(2), None)
