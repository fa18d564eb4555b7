"""Sensitivity: test worlds, returns over the same time, and values at which a gait fails."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import ArrayLike, NDArray
from run_tables import sensitivity_table
from scripted_world import ScriptedWorld

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")


from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.evaluation.sensitivity import Sensitivity, find_gait_limits, make_test_worlds, row_unit, run_sensitivity
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import Ranges, RelativeRange, load_ranges
from surefoot.task.config import TaskConfig, load_task
from surefoot.world.interface import SensorReadings
from surefoot.world.sim_world import SimWorld

MASS, LATENCY = "base_mass_ratio", "control_latency"


class Constant:
    """Controller with constant feedback that records the number of robots in each call."""

    def __init__(self) -> None:
        self.counts: list[int] = []

    def feedback(self, observation: ArrayLike) -> NDArray[np.float64]:
        self.counts.append(len(np.asarray(observation)))
        return np.tile(np.repeat([0.05, -0.02], 4), (self.counts[-1], 1))


class Reactive:
    """Controller with feedback proportional to the measured roll, so that latency matters."""

    def feedback(self, observation: ArrayLike) -> NDArray[np.float64]:
        return np.clip(0.5 * np.asarray(observation, float)[:, :1] + np.linspace(-0.05, 0.05, 8), -0.2, 0.2)


class Walker(ScriptedWorld):
    """Base that moves at 1 m/s per unit of friction with 10 W, and tilts or diverges at a set time."""

    fall_time: Callable[[PhysicalParams], NDArray[np.float64]] = staticmethod(lambda p: np.full(p.num_envs, math.inf))
    diverge_time = math.inf

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.speed, self.power = self.params.contact_friction, np.full(self.num_envs, 10.0)

    def step(self, target: Any, active: Any = None) -> SensorReadings:
        readings = super().step(target, active)
        self.diverged = self.time > self.diverge_time - 1e-9
        self.position[self.diverged] = 0.0
        self.tilt[:, 0] = self.time > self.fall_time(self.params) - 1e-9
        return readings


def trot(max_steps: int = 100, **changes: Any) -> TaskConfig:
    task, _ = load_task("trot")
    return replace(task, max_steps=max_steps, **changes)


def scripted_world(**attributes: Any) -> Any:
    return type("World", (Walker,), attributes)


def of_row(result: Sensitivity, row: str, column: str) -> list[list[Any]]:
    """Return a column of the episodes in a row's test worlds, world by world."""
    tests = result.tests[result.tests.row == row]
    return [part.tolist() for _, part in tests.groupby("value")[column]]


def test_table_1_gives_ten_worlds_per_parameter(robot: RobotDescription):
    worlds = make_test_worlds(load_ranges("table1"), PhysicalParams.nominal(robot))
    assert len(worlds) == 120
    assert worlds[0][:2] == (MASS, 0.8)
    latency = [value for row, value, _ in worlds if row == LATENCY]
    assert np.allclose(latency, np.arange(10) * 0.04 / 9)
    assert latency[-1] == 0.04
    minitaur, go2 = RobotDescription.load("minitaur"), RobotDescription.load("go2")
    assert {row_unit(row, minitaur) for row, *_ in worlds} == {"", "N m", "s", "V", "rad"}
    assert (row_unit("servo_kp", minitaur), row_unit("servo_kp", go2)) == ("1/rad", "N m/rad")


def test_worlds_are_evenly_spaced_and_include_the_ends(robot: RobotDescription):
    ranges: Ranges = {MASS: (0.9, 1.1), "voltage": (15.0, 15.0)}
    worlds = make_test_worlds(ranges, PhysicalParams.nominal(robot), 3)
    assert [world[:2] for world in worlds] == [(MASS, 0.9), (MASS, 1.0), (MASS, 1.1), ("voltage", 15.0)]
    with pytest.raises(SurefootError, match="the table of ranges is empty"):
        make_test_worlds({}, PhysicalParams.nominal(robot))


def test_a_relative_range_scales_the_values_of_all_motors():
    robot = RobotDescription.load("go2")
    nominal = PhysicalParams.nominal(robot)
    least, greatest = make_test_worlds({"motor_friction": RelativeRange(scale=(0.5, 1.5))}, nominal, 2)
    assert np.ptp(nominal.motor_friction) > 0
    np.testing.assert_allclose(least[2], 0.5 * nominal.motor_friction[0])
    assert greatest[1] == pytest.approx(1.5 * nominal.motor_friction.mean())


def test_returns_are_over_the_same_time_in_all_worlds():
    ranges: Ranges = {"control_step": (0.003, 0.020), "contact_friction": (0.5, 1.0)}
    policy = Constant()
    result = run_sensitivity(policy, trot(), scripted_world(), ranges=ranges, values=2, episodes=2, duration=0.6)
    # 0.6 s at 1 m/s and 10 W with w = 0.008 m/J: 0.6 - 0.048, whether in 200 control steps or in 30.
    assert np.allclose(of_row(result, "control_step", "return"), [[0.552] * 2] * 2)
    assert np.allclose(of_row(result, "contact_friction", "return"), [[0.252] * 2, [0.552] * 2])
    assert np.allclose(of_row(result, "contact_friction", "speed"), [[0.5] * 2, [1.0] * 2])
    assert np.allclose(result.nominal["return"], 0.552)
    assert result.nominal_values == pytest.approx({"control_step": 0.006, "contact_friction": 1.0})
    assert not result.tests.fell.any()
    # The policy gets 10 robots up to 30 control steps, 8 up to 100, 2 up to 200.
    assert policy.counts == [10] * 30 + [8] * 70 + [2] * 100


def test_an_episode_has_the_number_of_control_steps_nearest_to_its_duration():
    ranges: Ranges = {"control_step": (0.007, 0.017)}
    result = run_sensitivity(Constant(), trot(), scripted_world(), ranges=ranges, values=2, episodes=1, duration=0.1)
    # 14 control steps of 7 ms and 6 of 17 ms.
    assert np.allclose(result.tests["return"], np.array([0.098, 0.102]) * 0.92)


def test_a_falling_robots_return_counts_up_to_the_fall():
    world = scripted_world(fall_time=staticmethod(lambda p: np.where(p.voltage > 15.9, math.inf, 0.3)))
    ranges: Ranges = {"voltage": (15.0, 16.0), MASS: (0.8, 1.2)}
    result = run_sensitivity(Constant(), trot(), world, ranges=ranges, values=2, episodes=3, duration=0.6)
    assert of_row(result, "voltage", "fell") == [[True] * 3, [False] * 3]
    assert np.allclose(of_row(result, "voltage", "return"), [[0.276] * 3, [0.552] * 3])
    assert np.allclose(result.tests.speed, 1.0)
    assert result.fall_rate == 0.25


def test_divergence_counts_as_a_fall_one_step_earlier():
    world = scripted_world(diverge_time=0.3)
    ranges: Ranges = {MASS: (0.8, 1.2)}
    result = run_sensitivity(Constant(), trot(), world, ranges=ranges, values=2, episodes=1, duration=0.6)
    assert result.tests.fell.all()
    # The 50th control step is lost; the robot was at 0.294 m after 0.294 s.
    assert np.allclose(result.tests["return"], 0.294 * 0.92)
    assert np.allclose(result.tests.speed, 1.0)


def test_the_duration_defaults_to_the_tasks():
    ranges: Ranges = {"control_step": (0.003, 0.020)}
    result = run_sensitivity(Constant(), trot(100), scripted_world(), ranges=ranges, values=2, episodes=1)
    assert np.allclose(result.tests["return"], 0.552)
    task = trot(100, params={"control_step": 0.012})
    slower = run_sensitivity(Constant(), task, scripted_world(), ranges=ranges, values=2, episodes=1)
    assert np.allclose(slower.tests["return"], 1.104)
    assert slower.nominal_values["control_step"] == 0.012


def test_robots_are_pushed_only_with_the_option():
    worlds: list[Walker] = []

    def make(*arguments: Any) -> Walker:
        worlds.append(Walker(*arguments))
        return worlds[-1]

    task = trot(pushes=replace(trot().pushes, enabled=True, probability=0.5), randomize=load_ranges("table1"))
    ranges: Ranges = {MASS: (0.8, 1.2)}
    for pushes in (False, True):
        run_sensitivity(Constant(), task, make, ranges=ranges, values=2, episodes=1, duration=1.3, pushes=pushes)
    assert worlds[0].pushes == 0
    # At the start, at its restart, and for the one push at 1.2 s: on and off.
    assert worlds[1].pushes == 4


def test_an_episode_equals_the_one_of_evaluate():
    max_steps = 220  # with a push after 200
    task = trot(max_steps, pushes=replace(trot().pushes, enabled=True, probability=1.0))
    ranges: Ranges = {
        MASS: (0.8, 1.2),
        "motor_strength": (0.8, 1.1),
        "control_step": (0.003, 0.02),
        LATENCY: (0.0, 0.04),
    }
    options: dict[str, Any] = {"ranges": ranges, "values": 2, "episodes": 2, "seed": 7, "threads": 1}
    result = run_sensitivity(Reactive(), task, SimWorld, pushes=True, **options)
    assert list(result.worlds.row[::2]) == list(ranges)
    checked: list[tuple[dict[str, float], int, int]] = [  # parameters, control steps and index of the world
        ({}, max_steps, 0),
        ({MASS: 1.2}, max_steps, 2),
        ({"motor_strength": 0.8}, max_steps, 3),
        ({"control_step": 0.003}, 2 * max_steps, 5),
        ({LATENCY: 0.04}, max_steps, 8),
    ]
    for params, steps, world in checked:
        same = replace(task, params=params, max_steps=steps)
        runs = measure_runs(run_episodes(Reactive(), same, 2, SimWorld, seed=7, threads=1))[["return", "speed"]]
        episodes = result.episodes[["return", "speed"]][2 * world : 2 * world + 2]
        assert np.allclose(episodes, runs, rtol=0, atol=1e-9), params
    assert result.tests["return"].round(9).is_unique


def test_the_result_does_not_depend_on_the_number_of_parallel_robots():
    ranges: Ranges = {"motor_strength": (0.8, 1.1), "control_step": (0.003, 0.02)}
    shares: list[float] = []
    options: dict[str, Any] = {"ranges": ranges, "values": 3, "episodes": 2, "seed": 7, "threads": 1}
    whole = run_sensitivity(Reactive(), trot(30), SimWorld, **options)
    for robots in (1, 6):  # one world at a time, two at a time
        parts = run_sensitivity(Reactive(), trot(30), SimWorld, robots=robots, progress=shares.append, **options)
        pd.testing.assert_frame_equal(parts.episodes, whole.episodes, check_exact=True)
        assert shares[-1] == pytest.approx(1.0)
        assert shares == sorted(shares)
        shares.clear()


def made_up(
    returns: dict[str, list[float]], falls: dict[str, list[int]] | None = None, nominal: float = 10.0, fell: int = 0
) -> Sensitivity:
    """Return results with 4 episodes per world for 0 to 40 ms of latency and other rows, from returns and falls."""
    spans = {LATENCY: (0.0, 0.04), MASS: (0.8, 1.2), "motor_friction": (0.0, 0.05)}
    centres = {LATENCY: 0.02, MASS: 1.0, "motor_friction": 0.0}
    worlds = [(row, float(x)) for row, means in returns.items() for x in np.linspace(*spans[row], len(means))]
    downs = [n for row, means in returns.items() for n in (falls or {}).get(row, [0] * len(means))]
    spread = np.array([-1.0, 1.0, -1.0, 1.0])
    table = np.array([mean for means in returns.values() for mean in means])[:, None] + spread
    around = {row: centres[row] for row in returns}, nominal + spread, np.arange(4) < fell
    return sensitivity_table("trot", worlds, table, np.arange(4) < np.array(downs)[:, None], around)


def test_aggregates_by_hand():
    study = made_up({LATENCY: [4.0, 8.0]}, {LATENCY: [3, 0]})
    assert study.worlds.return_mean.tolist() == [4.0, 8.0]
    # Four samples at distance 1 from their mean: variance 4/3, and 4/3/4 of the mean.
    assert np.allclose(study.worlds.return_error, math.sqrt(1 / 3))
    assert (study.mean, study.std, study.fall_rate) == (6.0, pytest.approx(math.sqrt(8)), 0.375)
    assert study.rows == (LATENCY,)
    once = replace(study, episodes=study.episodes[study.episodes.run == 0])
    assert once.worlds.return_error.isna().all()


def test_the_nearest_failure_comes_first():
    study = made_up(
        {
            MASS: [10, 10, 10, 10, 1],
            LATENCY: [10, 10, 10, 4, 3],
            "motor_friction": [10, 9, 8, 8, 7],
        },
        {MASS: [0, 0, 0, 0, 4], LATENCY: [0, 0, 0, 1, 3]},
    )
    latency, mass = find_gait_limits(study).itertuples()
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
        # If the nominal return is not positive, only falls count.
        ([-5.0, -5.0], [0, 2], [(0.04, 0, 0)]),
    ],
)
def test_failures_are_found_on_both_sides_of_nominal(
    returns: list[float], falls: list[int], breaks: list[tuple[float, int, int]]
):
    result = find_gait_limits(made_up({LATENCY: returns}, {LATENCY: falls}, nominal=10.0 if returns[0] > 0 else -1.0))
    assert [(item.value, item.beyond, item.broken_beyond) for item in result.itertuples()] == [
        (pytest.approx(value), beyond, broken) for value, beyond, broken in breaks
    ]


def test_the_table_has_one_row_per_test_world():
    study = made_up({LATENCY: [4.0, 8.0], MASS: [5.0, 6.0]}, {LATENCY: [3, 0]})
    error, deviation = pytest.approx(math.sqrt(1 / 3)), pytest.approx(math.sqrt(4 / 3))
    numbers = {"return_mean": 4.0, "return_error": error, "return_std": deviation}
    about = {"row": LATENCY, "unit": "s", "value": 0.0, "episodes": 4}
    assert study.worlds.iloc[0].to_dict() == about | numbers | {"speed_mean": 0.5, "falls": 3}
    last = study.worlds.iloc[-1]
    assert (last.row, last.unit, last.value, last.return_mean) == (MASS, "", 1.2, 6.0)


def test_results_survive_json():
    study = made_up({LATENCY: [4.0, 8.0]}, {LATENCY: [3, 0]})
    again = Sensitivity.from_mapping(json.loads(json.dumps(study.to_mapping(), allow_nan=False)), "trot")
    assert again.nominal_values == study.nominal_values
    pd.testing.assert_frame_equal(again.episodes, study.episodes[list(again.episodes)])


def test_nominal_values_are_the_tasks():
    ranges: Ranges = {LATENCY: (0.0, 0.04), "motor_strength": (0.8, 1.2), MASS: (0.8, 1.2)}
    task = trot(params={"motor_strength": 0.9})
    result = run_sensitivity(Constant(), task, scripted_world(), ranges=ranges, values=2, episodes=1, duration=0.1)
    assert result.nominal_values == pytest.approx({LATENCY: 0.02, "motor_strength": 0.9, MASS: 1.0})
