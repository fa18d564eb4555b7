"""Components of an environment: their selection and order, and how to add a new one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exact_resume import assert_resumes_exactly
from numpy.typing import NDArray
from scripted_world import ScriptedWorld

from surefoot.task import components as registry
from surefoot.task.component import Component, Privileged
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.state import EnvState
from surefoot.world.sim_world import SimWorld


def names(task: TaskConfig, **options: Any) -> list[str]:
    env = LocomotionEnv(task, 2, SimWorld, threads=1, **options)
    return [type(component).__name__ for component in env.components]


def test_a_task_has_the_components_that_it_needs_and_no_others() -> None:
    assert names(load_task("gallop")[0]) == ["TrueState", "EpisodeMetrics"]
    trot = ["TrueState", "ReferencePhase", "Pusher", "EpisodeMetrics"]
    assert [name for name in names(load_task("trot-robust")[0]) if name != "RandomizedParams"] == trot
    seeing = names(load_task("terrain-seeing", "go2")[0], step_info=True)
    follows = ["CommandFollower", "ContactReflex", "Footholds", "FootholdError", "VelocityTracking", "ReferencePhase"]
    starts = ["TrueState", "TerrainCurriculum", "EpisodeStarts", "TrueHeights", "HeightScan"]
    assert seeing[:11] == [*starts, *follows]
    assert seeing[-2:] == ["EpisodeMetrics", "StepInfo"]


@pytest.mark.parametrize("task", ["terrain-seeing", "terrain-robust", "steer-robust"])
def test_components_save_state_under_different_names(task: str) -> None:
    env = LocomotionEnv(load_task(task, "go2")[0], 2, SimWorld, threads=1)
    arrays = [*env.state.arrays(), *(name for one in env.components for name in one.arrays())]
    streams = [name for one in env.components for name in one.streams]
    assert len(set(arrays)) == len(arrays)
    assert len(set(streams)) == len(streams)


class Load(Component):
    """A load cell under each foot with noise and a memory of the last reading."""

    prefix = "load"
    changing = ("reading",)

    def __init__(self, calls: list[str]) -> None:
        self.calls, self.reading = calls, np.zeros(2)
        self._streams = [np.random.default_rng(k) for k in range(2)]

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        return {"load_streams": self._streams}

    def before_reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        self.calls.append(f"before_reset {rows.tolist()}")

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        self.calls.append(f"reset {rows.tolist()}")
        self.reading[rows] = 0.0

    def before_step(self, state: EnvState) -> None:
        self.calls.append("before_step")

    def measure(self, state: EnvState) -> None:
        assert state.reward_terms == {} or "measure" in self.calls
        self.calls.append("measure")

    def after_step(self, state: EnvState) -> None:
        self.calls.append(f"after_step {state.reward.shape}")
        self.reading += [stream.uniform() for stream in self._streams]

    def privileged(self, state: EnvState) -> Privileged:
        return [(["load"], self.reading[:, None])]

    def info(self, state: EnvState) -> Mapping[str, Any]:
        return {"load": self.reading.copy()}

    def metrics(self) -> Mapping[str, Any]:
        return {"load": float(self.reading.mean())}


@pytest.fixture
def with_load(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Add a custom component to every environment, and return the calls of its hooks."""
    calls: list[str] = []
    made = registry.make_components
    monkeypatch.setattr("surefoot.task.env.make_components", lambda setup: [*made(setup), Load(calls)])
    return calls


def test_a_new_component_only_needs_registration(with_load: list[str]) -> None:
    env = LocomotionEnv(replace(load_task("gallop")[0], max_steps=2), 2, ScriptedWorld)
    assert with_load == ["before_reset [0, 1]", "reset [0, 1]"]
    with_load.clear()
    env.world.tilt[1, 0] = 1.0
    *_, info = env.step(np.zeros((2, 8)))
    # Robot 1 fell and was reset in the same step.
    steps = ["before_step", "measure", "after_step (2,)", "before_reset [1]", "reset [1]"]
    assert with_load == steps
    reading = env.component(Load).reading
    assert (info["load"] > 0).all()
    assert (reading > 0).tolist() == [True, False]
    assert env.privileged_columns[-1] == "load"
    np.testing.assert_allclose(env.privileged()[:, -1], reading, rtol=1e-6)
    assert env.metrics() == {"load": pytest.approx(reading.mean())}


def test_a_new_component_is_part_of_an_exact_resume(with_load: list[str]) -> None:
    env = LocomotionEnv(load_task("gallop")[0], 2, SimWorld, threads=1)
    action = np.zeros((2, 8))
    env.step(action)
    assert_resumes_exactly(env, [action] * 3)
    state, first = env.get_state(), env.step(action)[-1]["load"]
    env.set_state(state)
    assert np.array_equal(env.step(action)[-1]["load"], first)


def test_the_component_on_the_architecture_page_works(monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "architecture.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(class .*?)^```", page, re.MULTILINE | re.DOTALL)
    exec(code, names_of_the_page := dict(globals()))
    contact_time, made = names_of_the_page["ContactTime"], registry.make_components
    monkeypatch.setattr("surefoot.task.env.make_components", lambda setup: [*made(setup), contact_time(2, 4)])
    env = LocomotionEnv(load_task("gallop")[0], 2, SimWorld, threads=1)
    action = np.zeros((2, 8))
    for _ in range(5):
        env.step(action)
    assert env.privileged_columns[-4:] == [f"contact_time_{k}" for k in range(4)]
    assert (env.component(contact_time).seconds > 0).any()
    assert_resumes_exactly(env, [action] * 3)
