"""Study on hidden robots: file, trainings, evaluation, tables and report."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("matplotlib")

from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import data_sheet_task
from surefoot.evaluation.statistics import proportion_interval, t_interval
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params, write_params
from surefoot.robot.randomization import load_ranges
from surefoot.studies.evaluations import EvaluationRun
from surefoot.studies.robot_comparison import (
    RobotComparison,
    episode_rows,
    parameter_rows,
    robot_tables,
    without_hidden_parts,
)
from surefoot.studies.robot_report import report_from_tables, write_robot_report
from surefoot.studies.robot_runs import robot_kind, robot_task
from surefoot.studies.study_config import StudyConfig, load_study, study_runs
from surefoot.studies.training import Training
from surefoot.task.config import load_task
from surefoot.task.trace import EpisodeTrace

STUDIES = Path(__file__).resolve().parents[2] / "studies"
MakeRun = Callable[..., EpisodeTrace]
MINITAUR = RobotDescription.load("minitaur")
TEXT = """
name: few
task: trot
seeds: [0, 1]
train: {steps: 1000, num_envs: 8}
robots:
  seeds: [1, 2, 3, 4]
  ranges: {table: ensemble, motor_offset: [-0.01, 0.01]}
  starts: 3
  other_motors: {seeds: [4], label: limited motors, actuator: {voltage_clip: 6.0}}
groups:
  plain: {label: I, identified: [body], train: {task: {actuator: constraint, params: {control_latency: 0.0}}}}
  whole: {label: III, identified: [body, motors, contact, sensors], train: {task: {params: {voltage: 15.5}}}}
  sheet: {seeds: [0, 1, 2]}
least_home_return: 3.0
primary_questions: [gap]
questions:
  gap: {text: the gap of III is smaller, figure: gap, pairs: [[plain, whole], [sheet, whole]], expect: less}
  none: {text: the gap of III lies within 0.5 m, figure: gap, group: whole, within: 0.5}
  falls: {text: falls, figure: falls, pairs: [[plain, whole], [sheet, whole]]}
"""


def study(folder: Path, text: str = TEXT) -> StudyConfig:
    (folder / "few.yaml").write_text(text)
    return load_study(folder / "few.yaml")


def write_robot(folder: Path, seed: int, **values: float) -> None:
    folder.mkdir(exist_ok=True)
    params = PhysicalParams.nominal(MINITAUR).with_values(MINITAUR, **values)
    write_params(folder / f"robot_{seed}.toml", MINITAUR, params, names=tuple(values))


def test_a_group_is_trained_for_each_identified_robot_or_for_the_data_sheet(tmp_path: Path) -> None:
    few, robots = study(tmp_path), tmp_path / "robots"
    write_robot(robots, 1, base_mass_ratio=1.1, voltage=14.5, control_latency=0.03, servo_kp=0.9)
    write_robot(robots, 3, base_mass_ratio=0.9)
    runs = {run.name: run for run in study_runs(few, tmp_path / "runs", robots=robots)}
    assert list(runs) == [
        *(f"{group} robot_{robot} seed 0" for group in ("plain", "whole") for robot in (1, 3)),
        "sheet seed 0",
        *(f"{group} robot_{robot} seed 1" for group in ("plain", "whole") for robot in (1, 3)),
        "sheet seed 1",
        "sheet seed 2",
    ]
    whole, plain = runs["whole robot_1 seed 1"], runs["plain robot_1 seed 0"]
    assert whole.path == tmp_path / "runs" / "whole" / "robot_1" / "seed_1"
    assert runs["sheet seed 2"].path == tmp_path / "runs" / "sheet" / "seed_2"
    # Values in settings take precedence; the servo gain belongs to the controller.
    assert whole.config.task.params == {"base_mass_ratio": 1.1, "voltage": 15.5, "control_latency": 0.03}
    assert plain.config.task.params == {"base_mass_ratio": 1.1, "control_latency": 0.0}
    assert whole.config.task.params_source == read_params(robots / "robot_1.toml", MINITAUR).source
    assert runs["sheet seed 0"].config.task.params == {}
    assert list({run.name for run in study_runs(few, tmp_path, ("sheet",))}) != []


def test_hidden_robots_have_the_ranges_and_description_of_the_study(tmp_path: Path) -> None:
    robots = study(tmp_path).hidden
    assert robots.ranges == {**load_ranges("ensemble"), "motor_offset": (-0.01, 0.01)}
    assert (robots.robot, robots.world, robots.starts) == ("minitaur", "bullet", 3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "identified: [body]",
            "identified: [servo_kd]",
            r"groups\.plain\.identified: servo_kd belongs to the controll",
        ),
        ("[plain, whole]", "[plain, hole]", r"questions\.gap: 'hole' is no group of the study; did you mean whole"),
        ("[gap]", "[falls]", "primary_questions: 'falls' is not a question with a claim"),
        ("least_home", "evaluate: [gap]\nleast_home", "robots: a study on robots is evaluated by runs"),
        ("seeds: [0, 1, 2]", "seeds: [0, 0]", r"groups\.sheet\.seeds is \[0, 0\]; all must be different"),
        ("table: ensemble", "table: assemble", "'assemble' does not exist; did you mean ensemble"),
    ],
)
def test_an_invalid_study_on_robots_is_rejected(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(SurefootError, match=message):
        study(tmp_path, TEXT.replace(old, new))


def test_identified_parameters_and_questions_need_robots(tmp_path: Path) -> None:
    plain = "task: trot\ngroups:\n  a: {identified: [body]}\n"
    with pytest.raises(SurefootError, match=r"groups\.a\.identified needs robots, and the study has none"):
        study(tmp_path, plain)
    asked = "task: trot\ngroups: {a: {}, b: {}}\nquestions: {q: {text: t, figure: gap, pairs: [[a, b]]}}\n"
    with pytest.raises(SurefootError, match="questions needs robots, and the study has none"):
        study(tmp_path, asked)


def test_the_study_of_the_papers_main_result_has_the_planned_design() -> None:
    main = load_study(STUDIES / "identified.yaml")
    assert main.hidden.seeds == tuple(range(201, 213))
    assert [main.hidden.family(seed) for seed in main.hidden.seeds].count("other") == 4
    trainings = {group: len(main.trained_on(group)) * len(main.seeds_of(group)) for group in main.groups}
    assert trainings == {group: 8 if group == "sheet" else 12 * 2 for group in main.groups}
    assert all(not group.identified or "body" in group.identified for group in main.groups.values())
    # Settings equal the earlier study's, except for the exploration, with which all groups learn.
    before = load_study(STUDIES / "reality-gap.yaml")
    for name in ("baseline", "baseline_pushes", "improved_pushes", "actuator_only", "latency_only"):
        assert main.groups[name].train == before.groups[name].train
    assert main.train["ppo"] == {**before.train["ppo"], "init_std": 0.5}
    same = {"steps": 0, "evaluate_every": 0, "ppo": {}}
    assert {**main.train, **same} == {**before.train, **same}
    assert main.primary_questions == ("smaller_gap", "higher_return", "no_gap")


# --- runs on robots ---------------------------------------------------------------------------------------


def test_a_policy_keeps_its_gains_and_control_step_on_a_robot(tmp_path: Path) -> None:
    robots, folder = study(tmp_path).hidden, tmp_path / "other"
    task, _ = load_task("trot")
    own = {"servo_kd": 0.06, "control_step": 0.008, "control_latency": 0.0}
    task = replace(task, actuator="constraint", params=own)
    on = robot_task(task, robots, 4, folder)
    assert (on.actuator, on.robot, on.randomize) == ("dc", str(folder), {})
    assert replace(on, params={}, robot=task.robot) == replace(data_sheet_task(task), params={})
    params, truth = on.nominal(RobotDescription.load(on.robot)), robots.params(4, folder)
    for name in PhysicalParams.names(MINITAUR):
        expected = own[name] if name in ("servo_kd", "control_step") else getattr(truth, name)[0]
        assert getattr(params, name)[0] == pytest.approx(expected), name
    assert robot_task(task, robots, 1, folder).robot == "minitaur"


def test_a_policy_runs_in_the_training_simulator_and_on_its_robots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_run: MakeRun
) -> None:
    robots, calls = study(tmp_path).hidden, list[tuple[str, str, float]]()

    def run(self: EvaluationRun, task: Any, world: str) -> list[Any]:
        calls.append((world, task.actuator, float(task.nominal(RobotDescription.load(task.robot)).voltage[0])))
        distance = 4.0 if world == "mujoco" else 1.0
        return [make_run(distance, 200.0, step=0.006, world=world, max_steps=100) for _ in range(3)]

    monkeypatch.setattr(EvaluationRun, "run", run)
    kind = robot_kind(robots, (2, 4), tmp_path / "other")
    task, _ = load_task("trot")
    task = replace(task, actuator="constraint", params={"voltage": 15.0})
    result, traces = kind.run(EvaluationRun(None, task, kind.settings, 1))  # type: ignore[arg-type]
    voltages = [float(robots.params(seed, tmp_path / "other").voltage[0]) for seed in (2, 4)]
    assert calls == [("mujoco", "constraint", 15.0), *(("bullet", "dc", voltage) for voltage in voltages)]
    assert [*dict.fromkeys(result["runs"]["world"])] == ["mujoco", "robot_2", "robot_4"]
    assert traces == {}
    figures = kind.read_metrics(result)
    assert figures["home"] - figures["on_robot"] == pytest.approx(3.0)
    assert figures["falls"] == 0
    # Other robots, ranges or motors are a different evaluation.
    other = replace(robots, other_motors=None)
    kinds = [kind, robot_kind(robots, (2,), tmp_path), robot_kind(other, (2, 4), tmp_path)]
    assert len({repr(one.settings) for one in kinds}) == 3


# --- tables and report ------------------------------------------------------------------------------------


def runs(home: float, on_robot: dict[int, float], fell: int = 0, fell_at_home: int = 0) -> dict[str, Any]:
    """Return two runs in the training simulator and two on each robot, of which `fell_at_home` and `fell` fell."""
    rows = [("mujoco", k, home + 0.2 * k - 0.1, k >= fell_at_home) for k in range(2)]
    for seed, level in on_robot.items():
        rows += [(f"robot_{seed}", k, level + 0.2 * k - 0.1, k >= fell) for k in range(2)]
    table = pd.DataFrame(rows, columns=["world", "run", "return", "balanced"])
    return {"runs": table.assign(distance=table["return"] + 0.5, fell=~table.balanced).to_dict("list")}


def comparison(few: StudyConfig) -> RobotComparison:
    parts = []
    for seed in (0, 1):
        for robot in (1, 2, 3, 4):
            # The group `whole` loses 0.1 to 0.25 m; `plain` loses 1.4 to 1.55 m and falls in half of its runs.
            for group, home, loss, fell in (("plain", 2.6, 1.4, 1), ("whole", 3.4, 0.1, 0)):
                training = Training(group, few_config(few, seed), Path(), f"robot_{robot}")
                level = home + 0.2 * seed - loss - 0.05 * (robot - 1)
                parts.append(episode_rows(training, runs(home + 0.2 * seed, {robot: level}, fell)))
    for seed in (0, 1, 2):
        training = Training("sheet", few_config(few, seed), Path())
        levels = {robot: 2.5 - 0.1 * robot + 0.1 * seed for robot in (1, 2, 3, 4)}
        parts.append(episode_rows(training, runs(3.5, levels, fell_at_home=int(seed == 0))))
    return RobotComparison(few, pd.concat(parts, ignore_index=True))


def few_config(few: StudyConfig, seed: int) -> Any:
    return replace(study_runs(few, Path(), ("sheet",))[0].config, seed=seed)


def test_a_group_on_a_robot_is_the_mean_over_seeds_and_starts(tmp_path: Path) -> None:
    table = comparison(study(tmp_path)).robots.set_index(["group", "robot"])
    plain, sheet = table.loc["plain", 3], table.loc["sheet", 4]
    assert (plain.seeds, plain.runs, plain.motors, sheet.motors) == (2, 4, "own", "other")
    assert (plain.home, plain.on_robot, plain.gap) == pytest.approx((2.7, 1.2, 1.5))
    assert (plain.home_falls, plain.falls, plain.far) == (0, 50, 0)
    assert (sheet.home_falls, sheet.falls) == pytest.approx((100 / 6, 0))
    assert (sheet.seeds, sheet.home, sheet.on_robot, sheet.gap) == pytest.approx((3, 3.5, 2.2, 1.3))
    # 3.4 - 0.1 -+ 0.1 + 0.5 m for seed 0 and 0.2 m more for seed 1: every run of the group `whole` is far.
    assert table.loc["whole", 1].far == 100


def test_claims_leave_out_a_group_that_did_not_learn(tmp_path: Path) -> None:
    made = comparison(study(tmp_path))
    assert made.not_learned == {"plain": "I did not learn: return 2.70 m in the training simulator, below 3 m"}
    gap, none = made.answers["gap"], made.answers["none"]
    assert [one.left_out for one in gap.comparisons] == [made.not_learned["plain"], ""]
    assert gap.verdict == "holds, without 1 of 2 comparisons"
    assert none.comparisons[0].interval.mean == pytest.approx(0.175)
    assert none.verdict == "holds"
    (fewer, _) = made.answers["falls"].comparisons
    assert (fewer.interval.mean, fewer.left_out) == (-50, "")
    assert made.families == ["all", "own", "other"]


def test_the_report_has_claims_groups_robots_and_figures(tmp_path: Path) -> None:
    few, out = study(tmp_path), tmp_path / "out"
    write_robot(tmp_path / "robots", 1, base_mass_ratio=1.1, voltage=14.5)
    out.mkdir()
    file = read_params(tmp_path / "robots" / "robot_1.toml", MINITAUR)
    truth = few.hidden.params(1, tmp_path / "other")
    mass = float(truth.base_mass_ratio[0])
    file = replace(file, tables={"intervals": {"base_mass_ratio": [mass - 0.01, mass + 0.01], "voltage": [1.0, 2.0]}})
    parameters = parameter_rows(few, {1: file}, tmp_path / "other")
    assert [(row["parameter"], row["inside"]) for row in parameters] == [("base_mass_ratio", True), ("voltage", False)]
    text = write_robot_report(comparison(few), parameters, out, "surefoot study few.yaml").read_text()
    for part in (
        "- **Primary.** The gap of III is smaller: **holds, without 1 of 2 comparisons**",
        "- I did not learn: return 2.70 m in the training simulator, below 3 m.",
        "## Robots with limited motors",
        "| `base_mass_ratio` | 1 of 1 |",
        "| `voltage` | 0 of 1 |",
        "| I | robot_3 | as in the data sheet | 2 | 2.70 | 1.20 | 1.50 | 0.0 | 50.0 | 0.0 |",
        "The policies of 'sheet' were trained once, on the robot of the data sheet",
    ):
        assert part in text, part
    names = {path.name for path in out.iterdir()}
    assert {f"returns_{family}.png" for family in ("all", "own", "other")} <= names
    tables = robot_tables(comparison(few), parameters)
    assert {f"{name}.csv" for name in tables} <= names
    assert all((out / f"returns_{family}.png").stat().st_size > 5000 for family in ("all", "own", "other"))
    assert len(tables["episodes"]) == 2 * 4 * 2 * 4 + 3 * (2 + 8)
    assert "Not complete" not in text
    # The policies of `sheet` are the same on all robots: the return in their simulator varies over policies only.
    home = tables["groups"].set_index(["group", "motors", "figure"]).loc[("sheet", "all", "home")]
    policies = t_interval(comparison(few).policies.groupby("seed").home.mean())
    assert (home["mean_low"], home["mean_high"]) == pytest.approx((policies.low, policies.high))
    # Intervals of percentages stay between 0 and 100: no fall in 16 runs, and one in two of 4 runs on each of 4 robots.
    whole, plain = (comparison(few).interval(group, "falls") for group in ("whole", "plain"))
    assert (whole.mean, whole.low, whole.high) == pytest.approx((0, 0, 100 * (1 - 0.025 ** (1 / 16))))
    assert (plain.mean, plain.low, plain.high) == pytest.approx((50, 24.65, 75.35), abs=0.01)
    sheet = comparison(few).interval("sheet", "far")
    assert 0 <= sheet.low <= sheet.mean <= sheet.high <= 100
    # The runs in the training simulator are the same for all robots: 1 of 6 fell, not 4 of 24.
    assert comparison(few).interval("sheet", "home_falls") == proportion_interval([0.5, 0, 0], 2).scale(100)
    assert report_from_tables(few, out, "surefoot study few.yaml") == text


def test_returns_of_other_rewards_have_no_unit(tmp_path: Path) -> None:
    few = study(tmp_path, TEXT.replace("num_envs: 8}", "num_envs: 8, task: {reward: {tilt: -1.0}}}"))
    made = comparison(few)
    assert made.not_learned["plain"] == "I did not learn: return 2.70 in the training simulator, below 3"
    groups = robot_tables(made, [])["groups"].set_index(["group", "motors", "figure"])
    assert [groups.unit["whole", "all", name] for name in ("home", "on_robot", "gap", "falls")] == ["", "", "", "%"]
    (tmp_path / "out").mkdir()
    assert "(m)" not in write_robot_report(made, [], tmp_path / "out", "command").read_text()


def test_groups_may_have_names_like_numbers_or_missing_values(tmp_path: Path) -> None:
    names = {"plain": "1", "whole": "NA", "sheet": "nan"}
    text = TEXT
    for old, new in names.items():
        text = text.replace(f"{old}:", f"'{new}':").replace(f"{old},", f"'{new}',").replace(f"{old}]", f"'{new}']")
    few, out = study(tmp_path, text), tmp_path / "out"
    out.mkdir()
    rows = comparison(study(tmp_path)).episodes
    made = RobotComparison(study(tmp_path, text), rows.assign(group=rows.group.map(names)))
    assert write_robot_report(made, [], out, "x").read_text() == report_from_tables(few, out, "x")


def test_true_values_are_those_that_an_experiment_can_find(tmp_path: Path) -> None:
    few, robots = study(tmp_path), tmp_path / "robots"
    folder = tmp_path / "other"
    rows = {}
    for seed in (1, 4):
        write_robot(robots, seed, imu_bias=0.01, motor_friction=0.03, servo_kp=1.01, motor_strength=0.9)
        file = read_params(robots / f"robot_{seed}.toml", MINITAUR)
        intervals = {"imu_bias": [[-1.0, 1.0]] * 2, "motor_friction": [[0.0, 1.0]] * 8, "servo_kp": [0.9, 1.1]}
        file = replace(file, tables={"intervals": {**intervals, "motor_strength": [[0.5, 1.5]] * 8}})
        for row in parameter_rows(few, {seed: file}, folder):
            rows.setdefault((seed, row["parameter"]), []).append(row)
    truth = few.hidden.params(1, folder)
    true = [row["true"] for row in rows[1, "imu_bias"]]
    assert true == pytest.approx(list(truth.imu_bias[0] + truth.imu_mount[0, :2]))
    true = [row["true"] for row in rows[1, "motor_friction"]]
    assert true == pytest.approx(list(truth.motor_friction[0] + truth.knee_friction[0]))
    same = without_hidden_parts(truth)
    assert (same.imu_mount[0, :2].tolist(), same.knee_friction.tolist()) == ([0, 0], [0])
    assert same.imu_mount[0, 2] == truth.imu_mount[0, 2]
    # One interval for all motors is one estimate.
    assert [(row["part"], row["true"], row["inside"]) for row in rows[1, "servo_kp"]] == [("", 1.0, True)]
    # The strength of motors of another family is relative to another curve.
    assert [row["inside"] for row in rows[1, "motor_strength"]] == [True] * 8
    assert [row["inside"] for row in rows[4, "motor_strength"]] == [None] * 8
    assert all(math.isnan(row["true"]) for row in rows[4, "motor_strength"])


def test_seeds_on_the_command_line_do_not_change_what_a_complete_study_is(tmp_path: Path) -> None:
    few = study(tmp_path)
    one, more = few.with_seeds((1,)), few.with_more_seeds((1, 7))
    assert [one.seeds_of(group) for group in few.groups] == [(1,)] * 3
    assert [more.seeds_of(group) for group in few.groups] == [(0, 1, 7), (0, 1, 7), (0, 1, 2, 7)]
    assert few.with_more_seeds((0,)) == few


def test_a_report_says_which_trainings_are_missing(tmp_path: Path) -> None:
    few, out = study(tmp_path), tmp_path / "out"
    out.mkdir()
    whole = comparison(few)
    rows = whole.episodes
    some = rows[(rows.group != "sheet") & ~((rows.group == "plain") & (rows.robot == "robot_2") & (rows.seed == 1))]
    assert whole.missing == {}
    text = write_robot_report(RobotComparison(few, some), [], out, "surefoot study few.yaml").read_text()
    missing = "1 of 8 trainings of 'I', 3 of 3 trainings of 'sheet'"
    assert f"**Not complete.** Not in this report: {missing}.\n" in text
    assert report_from_tables(few, out, "surefoot study few.yaml") == text
