"""Evaluations of a study's policies: worlds, metrics and the cache of results."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

pytest.importorskip("gymnasium")

from surefoot.errors import SurefootError
from surefoot.evaluation.runs import measure_runs
from surefoot.robot.randomization import load_ranges
from surefoot.studies import evaluations
from surefoot.studies.evaluations import (
    EVALUATIONS,
    EvaluationRun,
    Result,
    Traces,
    cached_result,
    evaluate,
    evaluation_names,
    gap_from_result,
    stored_result,
)
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.trace import EpisodeTrace

POLICY: Any = SimpleNamespace(contract=SimpleNamespace(name="walker"))


class Rollouts:
    """Stand-in for simulations: records calls, and returns traces that slide forward."""

    def __init__(self, make_run: Callable[..., EpisodeTrace]) -> None:
        self.calls: list[dict[str, Any]] = []
        self.make_run = make_run

    def __call__(
        self, policy: Any, task: TaskConfig, episodes: int, make: Any, seed: int, threads: int, **names: str
    ) -> list[EpisodeTrace]:
        self.calls.append({"task": task, "episodes": episodes, "make": make, "seed": seed, "threads": threads, **names})
        far = {"mujoco": 3.5, "ensemble": 1.5}[names["world_name"]]
        options = {"step": 0.006, "world": names["world_name"], "max_steps": 100}
        ended = "fall" if names["world_name"] == "ensemble" else "time"
        made = [self.make_run(far + 0.1 * i, 200.0, **options) for i in range(episodes - 1)]
        return [*made, self.make_run(0.5, 120.0, 60, ended=ended, **options)]


@pytest.fixture
def rollouts(monkeypatch: pytest.MonkeyPatch, make_run: Callable[..., EpisodeTrace]) -> Rollouts:
    made, gap = Rollouts(make_run), EVALUATIONS["gap"]
    monkeypatch.setattr(evaluations, "run_episodes", made)
    monkeypatch.setattr(evaluations, "find_world", lambda name: f"makes {name}")
    monkeypatch.setitem(EVALUATIONS, "gap", replace(gap, settings={**gap.settings, "episodes": 3}))
    return made


def run(kind: str, threads: int = 1) -> tuple[Result, Traces]:
    return EVALUATIONS[kind].run(EvaluationRun(POLICY, baseline(), EVALUATIONS[kind].settings, threads))


def baseline() -> TaskConfig:
    """Return a task in the baseline simulator with pushes and randomization."""
    task, _ = load_task("trot")
    return replace(
        task,
        actuator="constraint",
        params={"control_latency": 0.0, "servo_latency": 0.0},
        pushes=replace(task.pushes, enabled=True),
        randomize=load_ranges("table1"),
    )


def test_nominal_episodes_run_in_the_training_simulator(rollouts: Rollouts) -> None:
    run("nominal")
    (call,) = rollouts.calls
    assert (call["make"], call["world_name"], call["episodes"]) == ("makes mujoco", "mujoco", 20)
    assert call["task"].actuator == "constraint"
    assert call["task"].params == baseline().params
    assert not call["task"].pushes.enabled
    assert not call["task"].randomize


def test_gap_runs_are_in_the_training_simulator_and_on_the_data_sheets_robot(rollouts: Rollouts) -> None:
    result, stored = run("gap", 2)
    home, away, described = rollouts.calls
    assert (described["make"], described["task"]) == (home["make"], away["task"])
    assert (home["make"], home["world_name"]) == ("makes mujoco", "mujoco")
    assert (away["make"], away["world_name"]) == ("makes ensemble", "ensemble")
    assert (home["task"].actuator, home["task"].params) == ("constraint", baseline().params)
    assert (away["task"].actuator, away["task"].params) == ("dc", {})
    for call in rollouts.calls:
        assert (call["episodes"], call["threads"], call["policy_name"]) == (3, 2, "walker")
        assert not call["task"].pushes.enabled
        assert not call["task"].randomize
        # These are not the episodes that select policies.
        assert call["seed"] != EVALUATIONS["nominal"].settings["seed"]
    assert {world: len(traces) for world, traces in stored.items()} == dict.fromkeys(
        ("mujoco", "ensemble", "mujoco-described"), 3
    )
    away_runs = gap_from_result(result, "walker").in_world("ensemble")
    expected = measure_runs(stored["ensemble"])
    pd.testing.assert_frame_equal(away_runs[list(expected)].reset_index(drop=True), expected)
    json.dumps(result, allow_nan=False)


def test_metrics_of_a_gap_are_means_over_its_runs(rollouts: Rollouts) -> None:
    result, _ = run("gap")
    figures = EVALUATIONS["gap"].read_metrics(result)
    # Distances 3.5, 3.6, 0.5 m (training simulator) and 1.5, 1.6, 0.5 m; 100, 100, 60 steps of 2 J at 0.008 m/J.
    spent = 0.008 * 2 * (100 + 100 + 60) / 3
    assert figures["gap_home"] == pytest.approx(7.6 / 3 - spent)
    assert figures["gap_away"] == pytest.approx(3.6 / 3 - spent)
    assert figures["gap"] == pytest.approx(4.0 / 3)
    assert figures["gap_balanced"] == pytest.approx(200 / 3)
    assert figures["gap_distance"] == pytest.approx(3.6 / 3)
    assert figures["gap_speed"] == pytest.approx((1.5 / 0.6 + 1.6 / 0.6 + 0.5 / 0.36) / 3)
    assert figures["gap_power"] == pytest.approx(2 / 0.006)
    assert gap_from_result(result, "walker").gap("ensemble").mean == pytest.approx(4.0 / 3)


def test_world_names_come_from_the_settings() -> None:
    assert EVALUATIONS["nominal"].world_names == ("mujoco",)
    assert EVALUATIONS["gap"].world_names == ("mujoco", "ensemble")
    assert EVALUATIONS["gap_test"].settings == EVALUATIONS["gap"].settings | {"away": "ensemble-test", "episodes": 40}
    with pytest.raises(SurefootError, match="'luck' is no kind of evaluation; choices: nominal, table1"):
        evaluation_names(("luck",))


@pytest.fixture
def policy(tmp_path: Path, repository: Path) -> Path:
    """Return a policy file in its own folder."""
    shutil.copy(repository / "policies" / "trot.onnx", tmp_path / "policy.onnx")
    return tmp_path / "policy.onnx"


def test_a_gap_is_measured_once_and_its_traces_are_stored(policy: Path, rollouts: Rollouts) -> None:
    folder = policy.parent / "evaluations" / "gap"
    (folder / "ensemble").mkdir(parents=True)
    (folder / "ensemble" / "run_007.npz").write_bytes(b"of an evaluation before")
    assert stored_result(policy, "gap") is None
    result = evaluate(policy, "gap")
    names = [
        f"{world}/run_{number:03d}.npz" for world in ("ensemble", "mujoco-described", "mujoco") for number in range(3)
    ]
    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*.npz")) == names
    stored = measure_runs([EpisodeTrace.load(path) for path in sorted((folder / "ensemble").iterdir())])
    assert stored["return"].tolist() == result["runs"]["return"][3:6]
    assert evaluate(policy, "gap") == stored_result(policy, "gap") == result
    assert len(rollouts.calls) == 3


def test_a_cached_result_belongs_to_a_policy_and_its_settings(policy: Path) -> None:
    made: list[int] = []

    def make() -> dict[str, int]:
        made.append(len(made))
        return {"number": made[-1]}

    settings = {"world": "mujoco", "energy_weight": 0.008}
    assert [cached_result(policy, "fresh", settings, make) for _ in range(2)] == [{"number": 0}] * 2
    assert cached_result(policy, "fresh", {**settings, "energy_weight": 0.004}, make) == {"number": 1}
    policy.write_bytes(policy.read_bytes() + b"\0")
    assert cached_result(policy, "fresh", {**settings, "energy_weight": 0.004}, make) == {"number": 2}
