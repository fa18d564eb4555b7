"""The sensitivity study: test worlds, returns over the same time, and words that name what breaks a gait."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scripted import ScriptedWorld

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")


from surefoot.errors import SurefootError
from surefoot.evaluate.rollout import run_episodes
from surefoot.evaluate.runs import Runs
from surefoot.evaluate.sensitivity import (
    Nominal,
    Sensitivity,
    TestWorld,
    find_breaks,
    make_test_worlds,
    row_unit,
    run_sensitivity,
)
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import Ranges, load_ranges
from surefoot.tables import write_csv
from surefoot.task.config import TaskConfig, load_task
from surefoot.world.interface import Readings
from surefoot.world.sim_world import SimWorld

MASS, LATENCY = "base_mass_ratio", "control_latency"


class Constant:
    """Gives the same feedback whatever it sees, and counts the robots that it was asked about."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def feedback(self, observation: ArrayLike) -> NDArray[np.float64]:
        self.asked.append(len(np.asarray(observation)))
        return np.tile(np.repeat([0.05, -0.02], 4), (self.asked[-1], 1))


class Reactive:
    """Answers the roll that it sees, so that latency matters."""

    def feedback(self, observation: ArrayLike) -> NDArray[np.float64]:
        return np.clip(0.5 * np.asarray(observation, float)[:, :1] + np.linspace(-0.05, 0.05, 8), -0.2, 0.2)


class Walker(ScriptedWorld):
    """A base that goes 1 m/s for each unit of friction, takes 10 W, and tilts or diverges on a date."""

    fall_time: Callable[[PhysicalParams], NDArray[np.float64]] = staticmethod(lambda p: np.full(p.num_envs, math.inf))
    diverge_time = math.inf

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.speed, self.power = self.params.contact_friction, np.full(self.num_envs, 10.0)

    def step(self, target: Any, active: Any = None) -> Readings:
        readings = super().step(target, active)
        self.diverged = self.time > self.diverge_time - 1e-9
        self.position[self.diverged] = 0.0
        self.tilt[:, 0] = self.time > self.fall_time(self.params) - 1e-9
        return readings


def trot(max_steps: int = 100, **changes: Any) -> TaskConfig:
    task, _ = load_task("trot")
    return replace(task, max_steps=max_steps, **changes)


def scripted(**attributes: Any) -> Any:
    return type("World", (Walker,), attributes)


def of_row(result: Sensitivity, row: str, part: NDArray[Any]) -> list[Any]:
    return part[result.of_row(row)].tolist()


def test_table_1_gives_ten_worlds_a_parameter(robot: RobotDescription):
    worlds = make_test_worlds(load_ranges("table1"), PhysicalParams.nominal(robot))
    assert len(worlds) == 120
    assert worlds[0] == TestWorld(MASS, 0.8)
    latency = [world.value for world in worlds if world.row == LATENCY]
    assert np.allclose(latency, np.arange(10) * 0.04 / 9)
    assert latency[-1] == 0.04
    assert {row_unit(world.row) for world in worlds} == {"", "N m", "s", "V", "rad"}


def test_worlds_are_the_ends_and_what_lies_between(robot: RobotDescription):
    ranges: Ranges = {MASS: (0.9, 1.1), "voltage": (15.0, 15.0)}
    worlds = make_test_worlds(ranges, PhysicalParams.nominal(robot), 3)
    mass = tuple(TestWorld(MASS, value) for value in (0.9, 1.0, 1.1))
    assert worlds == (*mass, TestWorld("voltage", 15.0))


def test_returns_by_hand_over_the_same_time():
    ranges: Ranges = {"control_step": (0.003, 0.020), "contact_friction": (0.5, 1.0)}
    policy = Constant()
    result = run_sensitivity(policy, trot(), scripted(), ranges=ranges, values=2, episodes=2, duration=0.6)
    # 0.6 s at 1 m/s and 10 W with w = 0.008 m/J: 0.6 - 0.048, whether in 200 control steps or in 30.
    assert result.returns.shape == result.fell.shape == result.speed.shape == (4, 2)
    assert np.allclose(of_row(result, "control_step", result.returns), 0.552)
    assert np.allclose(of_row(result, "contact_friction", result.returns), [[0.252] * 2, [0.552] * 2])
    assert np.allclose(of_row(result, "contact_friction", result.speed), [[0.5] * 2, [1.0] * 2])
    assert np.allclose(result.nominal.returns, 0.552)
    assert result.nominal.values == pytest.approx({"control_step": 0.006, "contact_friction": 1.0})
    assert not result.fell.any()
    # Robots whose time is over are not asked about: 10 until 30 control steps, 8 until 100, 2 until 200.
    assert policy.asked == [10] * 30 + [8] * 70 + [2] * 100


def test_an_episode_ends_with_the_control_step_nearest_to_its_duration():
    ranges: Ranges = {"control_step": (0.007, 0.017)}
    result = run_sensitivity(Constant(), trot(), scripted(), ranges=ranges, values=2, episodes=1, duration=0.1)
    # 14 control steps of 7 ms and 6 of 17 ms.
    assert np.allclose(result.returns[:, 0], np.array([0.098, 0.102]) * 0.92)


def test_a_robot_that_falls_counts_to_its_fall():
    world = scripted(fall_time=staticmethod(lambda p: np.where(p.voltage > 15.9, math.inf, 0.3)))
    ranges: Ranges = {"voltage": (15.0, 16.0), MASS: (0.8, 1.2)}
    result = run_sensitivity(Constant(), trot(), world, ranges=ranges, values=2, episodes=3, duration=0.6)
    assert of_row(result, "voltage", result.fell) == [[True] * 3, [False] * 3]
    assert np.allclose(of_row(result, "voltage", result.returns), [[0.276] * 3, [0.552] * 3])
    assert np.allclose(result.speed, 1.0)
    assert result.fall_rate == 0.25


def test_a_robot_that_diverges_fell_where_it_was():
    world = scripted(diverge_time=0.3)
    ranges: Ranges = {MASS: (0.8, 1.2)}
    result = run_sensitivity(Constant(), trot(), world, ranges=ranges, values=2, episodes=1, duration=0.6)
    assert result.fell.all()
    # The 50th control step is lost; the robot was at 0.294 m after 0.294 s.
    assert np.allclose(result.returns, 0.294 * 0.92)
    assert np.allclose(result.speed, 1.0)


def test_the_default_time_is_the_task_s():
    ranges: Ranges = {"control_step": (0.003, 0.020)}
    result = run_sensitivity(Constant(), trot(100), scripted(), ranges=ranges, values=2, episodes=1)
    assert np.allclose(result.returns, 0.552)
    task = trot(100, params={"control_step": 0.012})
    slower = run_sensitivity(Constant(), task, scripted(), ranges=ranges, values=2, episodes=1)
    assert np.allclose(slower.returns, 1.104)
    assert slower.nominal.values["control_step"] == 0.012


def test_robots_are_pushed_only_when_asked():
    made: list[Walker] = []

    def make(*arguments: Any) -> Walker:
        made.append(Walker(*arguments))
        return made[-1]

    task = trot(pushes=replace(trot().pushes, enabled=True, probability=0.5), randomize=load_ranges("table1"))
    ranges: Ranges = {MASS: (0.8, 1.2)}
    for pushes in (False, True):
        run_sensitivity(Constant(), task, make, ranges=ranges, values=2, episodes=1, duration=1.3, pushes=pushes)
    assert made[0].pushes == 0
    # Of the start, its restart, and the one push at 1.2 s: on and off.
    assert made[1].pushes == 4


def test_an_episode_is_the_one_that_evaluate_runs():
    max_steps = 220  # a push comes after 200
    task = trot(max_steps, pushes=replace(trot().pushes, enabled=True, probability=1.0))
    ranges: Ranges = {
        MASS: (0.8, 1.2),
        "motor_strength": (0.8, 1.1),
        "control_step": (0.003, 0.02),
        LATENCY: (0.0, 0.04),
    }
    options: dict[str, Any] = {"ranges": ranges, "values": 2, "episodes": 2, "seed": 7, "threads": 1}
    result = run_sensitivity(Reactive(), task, SimWorld, pushes=True, **options)
    assert [world.row for world in result.worlds[::2]] == list(ranges)
    checked: list[tuple[dict[str, float], int, Any, Any]] = [
        ({}, max_steps, result.nominal.returns, result.nominal.speed),
        ({MASS: 1.2}, max_steps, result.returns[1], result.speed[1]),
        ({"motor_strength": 0.8}, max_steps, result.returns[2], result.speed[2]),
        ({"control_step": 0.003}, 2 * max_steps, result.returns[4], result.speed[4]),
        ({LATENCY: 0.04}, max_steps, result.returns[7], result.speed[7]),
    ]
    for params, steps, returns, speed in checked:
        same = replace(task, params=params, max_steps=steps)
        runs = Runs.of_traces(run_episodes(Reactive(), same, 2, SimWorld, seed=7, threads=1))
        assert np.allclose([returns, speed], [runs.returns, runs.speed], rtol=0, atol=1e-9), params
    assert len(np.unique(result.returns.round(9))) == result.returns.size


def test_robots_side_by_side_change_nothing_but_the_memory():
    ranges: Ranges = {"motor_strength": (0.8, 1.1), "control_step": (0.003, 0.02)}
    seen: list[float] = []
    options: dict[str, Any] = {"ranges": ranges, "values": 3, "episodes": 2, "seed": 7, "threads": 1}
    whole = run_sensitivity(Reactive(), trot(30), SimWorld, **options)
    for robots in (1, 6):  # a world at a time, two at a time
        parts = run_sensitivity(Reactive(), trot(30), SimWorld, robots=robots, progress=seen.append, **options)
        assert parts.worlds == whole.worlds
        for name in ("returns", "fell", "speed"):
            np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
            np.testing.assert_array_equal(getattr(parts.nominal, name), getattr(whole.nominal, name))
        assert seen[-1] == pytest.approx(1.0)
        assert seen == sorted(seen)
        seen.clear()


def test_progress_counts_to_the_end():
    seen: list[float] = []
    ranges: Ranges = {"control_step": (0.003, 0.020)}
    world = scripted(fall_time=staticmethod(lambda p: np.where(p.control_step < 0.005, 0.3, math.inf)))
    options: dict[str, Any] = {"ranges": ranges, "values": 2, "episodes": 1, "duration": 0.6}
    run_sensitivity(Constant(), trot(), world, progress=seen.append, **options)
    # 100 nominal steps, 200 of 3 ms of which a fall spares the second half, 30 of 20 ms.
    assert seen == sorted(seen)
    assert seen[0] == pytest.approx(3 / 330)
    assert seen[-1] == 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episodes": 0}, "episodes is 0; it must be 1 or more"),
        ({"seed": -1}, "seed is -1; it must be 0 or more"),
        ({"values": 1}, "values is 1; it must be 2 or more"),
        ({"ranges": {}}, "the table of ranges is empty"),
        ({"duration": 0.0}, "duration is 0 s; it must be over 0"),
        ({"duration": math.nan}, "duration is nan s"),
        ({"ranges": {"voltage": (1.0, 16.0)}}, r"randomize.voltage is \[1, 16\]; minitaur allows voltage"),
    ],
)
def test_what_does_not_fit_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(SurefootError, match=message):
        run_sensitivity(Constant(), trot(), scripted(), **{"ranges": load_ranges("table1"), **options})


def made_up(
    returns: dict[str, list[float]], falls: dict[str, list[int]] | None = None, nominal: float = 10.0, fell: int = 0
) -> Sensitivity:
    """A study of 4 episodes a world over 0 to 40 ms of latency and other rows, from mean returns and falls."""
    spans = {LATENCY: (0.0, 0.04), MASS: (0.8, 1.2), "motor_friction": (0.0, 0.05)}
    centres = {LATENCY: 0.02, MASS: 1.0, "motor_friction": 0.0}
    worlds, means, downs = [], [], []
    for row, values in returns.items():
        worlds += [TestWorld(row, float(value)) for value in np.linspace(*spans[row], len(values))]
        means += values
        downs += (falls or {}).get(row, [0] * len(values))
    shape = (len(worlds), 4)
    spread = np.array([-1.0, 1.0, -1.0, 1.0])
    return Sensitivity(
        policy="trot",
        worlds=tuple(worlds),
        returns=np.array(means)[:, None] + spread,
        fell=np.arange(4) < np.array(downs)[:, None],
        speed=np.full(shape, 0.5),
        nominal=Nominal({row: centres[row] for row in returns}, nominal + spread, np.arange(4) < fell, np.full(4, 0.5)),
    )


def test_aggregates_by_hand():
    study = made_up({LATENCY: [4.0, 8.0]}, {LATENCY: [3, 0]})
    assert study.mean_return.tolist() == [4.0, 8.0]
    # Four numbers at 1 from their mean: variance 4/3, and 4/3/4 of the mean.
    assert np.allclose(study.standard_error, math.sqrt(1 / 3))
    assert (study.mean, study.std, study.fall_rate) == (6.0, 2.0, 0.375)
    assert study.rows == (LATENCY,)
    once = replace(study, returns=study.returns[:, :1], fell=study.fell[:, :1], speed=study.speed[:, :1])
    assert np.isnan(once.standard_error).all()


def test_the_nearest_break_comes_first():
    study = made_up(
        {
            MASS: [10, 10, 10, 10, 1],
            LATENCY: [10, 10, 10, 4, 3],
            "motor_friction": [10, 9, 8, 8, 7],
        },
        {MASS: [0, 0, 0, 0, 4], LATENCY: [0, 0, 0, 1, 3]},
    )
    latency, mass = find_breaks(study)
    assert (latency.row, latency.value, latency.above, latency.fraction) == (
        LATENCY,
        0.03,
        True,
        pytest.approx(0.5),
    )
    assert (latency.falls, latency.mean_return, latency.beyond, latency.broken_beyond) == (1, 4.0, 1, 1)
    assert (mass.row, mass.value, mass.fraction, mass.falls) == (
        MASS,
        pytest.approx(1.2),
        pytest.approx(1.0),
        4,
    )


@pytest.mark.parametrize(
    ("returns", "falls", "breaks"),
    [
        ([10] * 5, [0, 0, 0, 0, 1], []),
        ([10] * 5, [3, 0, 0, 2, 4], [(0.03, 1, 1), (0.0, 0, 0)]),
        ([10] * 5, [4, 4, 0, 3, 4], [(0.03, 1, 1), (0.01, 1, 1)]),
        ([10, 10, 10, 4, 10], [0] * 5, [(0.03, 1, 0)]),
        ([10] * 9, [0] * 5 + [4, 0, 0, 4], [(0.025, 3, 1)]),
        # Without a return worth halving, falls alone count.
        ([-5.0, -5.0], [0, 2], [(0.04, 0, 0)]),
    ],
)
def test_breaks_on_both_sides_everywhere_never_and_here_and_there(
    returns: list[float], falls: list[int], breaks: list[tuple[float, int, int]]
):
    found = find_breaks(made_up({LATENCY: returns}, {LATENCY: falls}, nominal=10.0 if returns[0] > 0 else -1.0))
    assert [(item.value, item.beyond, item.broken_beyond) for item in found] == [
        (pytest.approx(value), beyond, broken) for value, beyond, broken in breaks
    ]


def test_tables_hold_the_worlds_and_the_raw_episodes(tmp_path: Path):
    study = made_up({LATENCY: [4.0, 8.0], MASS: [5.0, 6.0]}, {LATENCY: [3, 0]})
    first, *_, last = study.world_rows()
    numbers = {"return_mean": 4.0, "return_error": pytest.approx(math.sqrt(1 / 3)), "return_std": 1.0}
    about = {"policy": "trot", "row": LATENCY, "unit": "s", "value": 0.0, "episodes": 4}
    assert first == about | numbers | {"speed_mean": 0.5, "falls": 3}
    assert (last["row"], last["unit"], last["value"], last["return_mean"]) == (MASS, "", 1.2, 6.0)
    with write_csv(tmp_path / "e.csv", study.episode_rows()).open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * 4
    assert [row["return"] for row in rows[:4]] == ["9", "11", "9", "11"]
    assert {(row["row"], row["value"]) for row in rows[:4]} == {("nominal", "")}
    assert [int(row["fell"]) for row in rows[4:8]] == [1, 1, 1, 0]
    again = np.array([float(row["return"]) for row in rows[4:]]).reshape(4, 4)
    assert np.array_equal(again, study.returns)


def test_results_come_back_from_json():
    study = made_up({LATENCY: [4.0, 8.0]}, {LATENCY: [3, 0]})
    again = Sensitivity.from_mapping(json.loads(json.dumps(study.to_mapping(), allow_nan=False)), "trot")
    assert again.to_mapping() == study.to_mapping()
    assert again.episode_rows()[4:] == study.episode_rows()[4:]


def test_the_robot_s_nominal_values_are_told():
    ranges: Ranges = {LATENCY: (0.0, 0.04), "motor_strength": (0.8, 1.2), MASS: (0.8, 1.2)}
    task = trot(params={"motor_strength": 0.9})
    result = run_sensitivity(Constant(), task, scripted(), ranges=ranges, values=2, episodes=1, duration=0.1)
    assert result.nominal.values == pytest.approx({LATENCY: 0.02, "motor_strength": 0.9, MASS: 1.0})
