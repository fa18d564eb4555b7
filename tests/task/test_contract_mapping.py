"""Contracts made from tasks, and tasks made from contracts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

from surefoot.api.policies import find_policy
from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract, contract_fields
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.contract_mapping import contract_from_task, make_contract, task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.task.height_scan import POLICY_GRID, ScanConfig
from surefoot.task.reference_config import TableReferenceConfig
from surefoot.task.terrain import TerrainConfig
from surefoot.world.sim_world import SimWorld

ROBOT = RobotDescription.load("minitaur")


def contract_of(task: TaskConfig) -> Contract:
    """Return the contract of a task's policy after a round trip through its file."""
    return Contract.from_json(make_contract(LocomotionEnv(task, 1, SimWorld)).to_json())


@pytest.mark.parametrize(("task", "robot"), [("trot", "minitaur"), ("steer", "go2"), ("scratch", "solo8")])
def test_an_environment_of_the_task_of_a_contract_has_the_same_contract(task: str, robot: str):
    contract = contract_of(replace(load_task(task, robot)[0], max_steps=77))
    again = task_from_contract(contract)
    assert (again.robot, again.max_steps) == (robot, 77)
    assert again.physics_step == 0.0  # a longer step belongs to the training
    same = replace(contract, config_hash=contract_of(again).config_hash)
    assert contract_of(again) == replace(same, task={**contract.task, "physics_step": 0.0})


def test_the_contract_of_a_perceptive_policy_has_grid_and_age_of_its_map():
    task = load_task("trot")[0]
    scan = ScanConfig(noise=0.03, delay=5)
    task = replace(task, observations=(*task.observations, "height_scan"), terrain=TerrainConfig(scan=scan))
    contract = contract_of(task)
    assert contract.height_map is not None
    assert (contract.height_map.ahead, contract.height_map.left) == POLICY_GRID.scale(ROBOT)
    assert contract.height_map.age == pytest.approx(5 * 0.006)
    assert contract.task["terrain"]["scan"] == {"noise": 0.03, "drift": 0.02, "shift": 0.02, "holes": 0.02}
    assert task_from_contract(contract, ROBOT).terrain.scan == scan
    assert make_contract(LocomotionEnv(load_task("trot")[0], 1, SimWorld)).height_map is None


def test_the_task_of_a_contract_has_the_parameters_of_training():
    params = {"voltage": 15.0, "imu_bias": (0.1, -0.2)}
    task = replace(load_task("trot")[0], params=params, params_source={"file": "robot.toml"})
    again = task_from_contract(contract_of(task))
    assert (again.params, again.params_source) == (params, task.params_source)


@pytest.mark.parametrize("policy", ["go2-steer", "pupper_v2-trot", "solo8-scratch", "gallop"])
def test_a_released_policy_states_each_fact_once(policy: str):
    contract = PolicyRuntime.load(find_policy(policy)).contract
    again = make_contract(LocomotionEnv(task_from_contract(contract), 1, SimWorld))
    for name in ("reference", "low", "high", "rest", "commands", "columns", "servo_kp", "servo_kd", "control_step"):
        assert getattr(again, name) == getattr(contract, name), name


def test_a_table_comes_from_the_contract_and_not_from_its_file(tmp_path: Path):
    columns = [f"{part}_{leg}" for part in ("swing", "extension") for leg in ROBOT.leg_names]
    table = np.hstack([np.zeros((4, 4)), np.array([[1.8], [2.0], [1.9], [2.0]]) * np.ones((1, 4))])
    np.savez(tmp_path / "t.npz", **dict(zip(columns, table.T, strict=True)))
    reference = TableReferenceConfig(file=str(tmp_path / "t.npz"), period=0.5)
    contract = contract_of(TaskConfig(reference=reference))
    (tmp_path / "t.npz").unlink()
    again = task_from_contract(contract).reference.make(ROBOT)
    assert np.allclose(again.pose([0.125])[:, 1], 2.0)


def test_stated_fields_are_not_in_the_contracts_task():
    task = load_task("terrain-seeing", "go2")[0]
    robot = RobotDescription.load("go2")
    contract, whole = contract_from_task(task, robot), to_mapping(task)
    stated = contract_fields(TaskConfig)
    assert {name for name in whole if name not in contract.task} == {name for name in stated if "." not in name}
    for table in ("commands", "params"):
        missing = {f"{table}.{key}" for key in whole[table] if key not in contract.task[table]}
        assert missing == {name for name in stated if name.partition(".")[2] in whole[table]} != set()


@pytest.mark.parametrize(("table", "key"), [("commands", "forward"), ("params", "control_step"), ("", "history")])
def test_a_contract_that_states_a_field_again_in_its_task_is_rejected(table: str, key: str):
    contract = PolicyRuntime.load(find_policy("go2-steer")).contract
    task = {**contract.task, table: {**contract.task[table], key: 1}} if table else {**contract.task, key: 1}
    name = f"task.{table}.{key}" if table else f"task.{key}"
    with pytest.raises(SurefootError, match=f"^{name} is not a key; the contract states it outside the task"):
        task_from_contract(replace(contract, task=task))


def test_a_task_with_an_unknown_key_is_rejected():
    contract = PolicyRuntime.load(find_policy("trot")).contract
    with pytest.raises(SurefootError, match=r"task.colour is not a key"):
        task_from_contract(replace(contract, task={**contract.task, "colour": "red"}))
