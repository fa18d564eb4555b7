"""Study configuration: trainings of a group, their folders and states."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from surefoot.configuration import write_yaml
from surefoot.errors import SurefootError
from surefoot.learn.config import load_train_config
from surefoot.robot.randomization import load_ranges
from surefoot.studies.study_config import GroupConfig, StudyConfig, group_config, load_study, study_runs
from surefoot.studies.training import CHECKPOINT_EVERY, Training

STUDY = """
task: trot
seeds: [3, 5]
train: {steps: 1000, num_envs: 8, task: {max_steps: 70}}
groups:
  plain: {train: {task: {pushes: {enabled: false}, randomize: none}}}
  drawn: {label: Drawn, train: {steps: 2000, task: {randomize: table1, observations: [roll, motor_angles]}}}
evaluate: [table1]
"""


def study_file(folder: Path, text: str = STUDY) -> Path:
    path = folder / "walks.yaml"
    path.write_text(text)
    return path


def test_groups_combine_the_studys_settings_with_their_own(tmp_path: Path) -> None:
    study, trot = load_study(study_file(tmp_path)), load_train_config("trot")
    plain, drawn = (group_config(study, name) for name in ("plain", "drawn"))
    assert study.name == "walks"
    assert (plain.steps, drawn.steps, plain.num_envs) == (1000, 2000, 8)
    assert plain.task.pushes == replace(trot.task.pushes, enabled=False)
    assert plain.task.pushes.probability == 0.25
    assert drawn.task.pushes == trot.task.pushes
    assert drawn.task.reference == trot.task.reference
    assert drawn.task.observations == ("roll", "motor_angles")
    assert (plain.task.max_steps, drawn.task.max_steps) == (70, 70)
    assert plain.ppo == trot.ppo
    assert plain.task.randomize == {}
    assert drawn.task.randomize == load_ranges("table1")
    assert (study.label("plain"), study.label("drawn")) == ("plain", "Drawn")
    # Runs share cores and save checkpoints often.
    assert (plain.threads, plain.learning_threads, plain.checkpoint_every) == (1, 1, CHECKPOINT_EVERY)


def test_a_groups_ranges_replace_the_studys(tmp_path: Path) -> None:
    (tmp_path / "few.yaml").write_text("leg_mass_ratio: [0.9, 1.1]\n")
    text = (
        "train: {task: {randomize: table1}}\n"
        "groups:\n  a: {train: {task: {randomize: few.yaml}}}\n"
        "  b: {train: {task: {randomize: {table: table1, voltage: [15, 16]}}}}"
    )
    study = load_study(study_file(tmp_path, text))
    assert group_config(study, "a").task.randomize == {"leg_mass_ratio": (0.9, 1.1)}
    assert group_config(study, "b").task.randomize == load_ranges("table1") | {"voltage": (15.0, 16.0)}


def test_a_table_of_ranges_is_for_the_studys_robot(tmp_path: Path) -> None:
    (tmp_path / "go2-walk.yaml").write_text("{base: trot, robot: go2}")
    ranges = "{train: {task: {randomize: table1}}}"
    study = load_study(study_file(tmp_path, f"{{task: go2-walk.yaml, groups: {{a: {{}}, b: {ranges}}}}}"))
    assert group_config(study, "b").task.randomize == load_ranges("table1", tmp_path, "go2")
    assert "voltage" not in group_config(study, "b").task.randomize


def test_the_path_of_a_task_is_relative_to_the_file_of_the_study(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("max_steps: 33\ntrain: {num_envs: 4}\n")
    study = load_study(study_file(tmp_path, "{task: mine.yaml, groups: {a: {}}}"))
    config = group_config(study, "a")
    assert (config.task.max_steps, config.num_envs) == (33, 4)


def test_runs_go_seed_by_seed_into_fixed_folders(tmp_path: Path) -> None:
    study = load_study(study_file(tmp_path))
    runs = study_runs(study, tmp_path / "runs")
    assert [(run.group, run.config.seed) for run in runs] == [("plain", 3), ("drawn", 3), ("plain", 5), ("drawn", 5)]
    assert runs[1].path == tmp_path / "runs" / "drawn" / "seed_3"
    assert [run.group for run in study_runs(study, tmp_path, ("drawn",))] == ["drawn", "drawn"]
    with pytest.raises(SurefootError, match="group 'fast' is not in the study; choices: plain, drawn"):
        study_runs(study, tmp_path, ("fast",))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seeds: [0]", "groups is missing"),
        ("groups: {}", "groups is empty"),
        ("groups: {../a: {}}", "name is '../a'; a name has letters"),
        ("{groups: {a: {}}, seeds: [1, 1]}", "seeds is .1, 1.; .* all different"),
        ("{groups: {a: {}}, seeds: []}", "1 or more"),
        ("{groups: {a: {}}, speed: 3}", "speed is not a key"),
        ("groups: {a: {train: {stepps: 3}}}", "groups.a.train.stepps is not a key"),
        ("groups: {a: {train: {steps: 0}}}", "steps is 0; it must be 1 or more"),
        ("groups: {a: {train: {task: {randomize: table9}}}}", "table9' does not exist"),
        ("{groups: {a: {}}, train: {task: {pushes: {probability: 2}}}}", "probability is 2"),
        ("{groups: {a: {}}, task: walk}", "walk' does not exist; choices: .*scratch, steer, .*, terrain, trot"),
        ("{groups: {a: {}}, compare: [[a, b]]}", "compare: 'b' is no group of the study; choices: a"),
        ("{groups: {a: {}, b: {}}, compare: [[a, b], [b, a]]}", "compare: b and a are compared twice"),
        ("{groups: {a: {}}, compare: [[a, a]]}", "compare: 'a' is compared with itself"),
        ("{groups: {a: {}, b: {}}, effects: {x: [[a, b]]}}", "effects.x: it has 1 pairs, of a, b; it needs 2 or more"),
        ("{groups: {a: {}, b: {}, c: {}}, effects: {x: [[a, b], [a, c]]}}", "without a group in common"),
        ("{groups: {a: {}, b: {}}, effects: {x: [[a, b], [c, d]]}}", "effects.x: 'c' is no group of the study"),
        ("{groups: {a: {}}, bars: {others: [a]}}", "bars.others: this name belongs to the groups that are in no set"),
        ("{groups: {a: {label: x}, b: {label: x}}}", "groups: two groups have the label 'x'"),
        ("{groups: {a: {}, b: {label: a}}}", "groups: two groups have the label 'a'"),
        ("{groups: {a: {}}, top: 0}", "top is 0; it must be 1 or more"),
        ("{groups: {a: {}}, top: [1]}", "top is .1.; it must be a whole number"),
        ("{groups: {a: {}}, bars: {x: [b]}}", "bars.x: 'b' is no group of the study; choices: a"),
        ("{groups: {a: {}}, bars: {x: [a, a]}}", "bars.x is .'a', 'a'.; it needs 1 group or more, all different"),
        ("{groups: {a: {}}, bars: {x: []}}", "bars.x is ..; it needs 1 group or more"),
        ("{groups: {a: {}}, bars: {../x: [a]}}", "name is '../x'; a name has letters"),
        ("{groups: {a: {}}, bars: [a]}", "bars is .'a'.; it must be a table"),
        ("{groups: {a: {}}, findings: [{groups: [b], text: x}]}", "findings.0.: 'b' is no group of the study"),
        ("{groups: {a: {}}, findings: [{groups: [a]}]}", "findings.0..text is missing"),
        ("{groups: {a: {}}, findings: [{groups: [a], text: x}]}", "findings.0.: a form neither a set of bars"),
    ],
)
def test_load_study_rejects_invalid_files(text: str, message: str, tmp_path: Path) -> None:
    path = study_file(tmp_path, text)
    with pytest.raises(SurefootError, match=message) as error:
        load_study(path)
    assert str(error.value).startswith(str(path))


def test_all_pairs_are_compared_by_default() -> None:
    study = StudyConfig(groups={name: GroupConfig() for name in "abc"})
    assert study.pairs == (("a", "b"), ("a", "c"), ("b", "c"))
    assert replace(study, compare=(("c", "a"),)).pairs == (("c", "a"),)


def make_run(folder: Path, **changes: object) -> Training:
    config = replace(load_train_config("trot"), **changes)  # type: ignore[arg-type]
    return Training("a", config, folder)


def store(run: Training, file: str) -> None:
    (run.path / "checkpoints").mkdir(parents=True, exist_ok=True)
    write_yaml(run.path / "config.yaml", run.config)
    (run.path / file).write_bytes(b"")


def test_the_state_of_a_run_follows_from_its_files(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    assert run.state == "new"
    store(run, "run.json")
    assert run.state == "new"
    store(run, "checkpoints/latest.ckpt")
    assert run.state == "started"
    store(run, "policy.onnx")
    assert run.state == "finished"


def test_a_run_with_other_settings_is_rejected(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", steps=5000)
    make_run(run.path, steps=6000).check()
    store(run, "checkpoints/latest.ckpt")
    run.check()
    make_run(run.path, steps=5000, threads=2, checkpoint_every=77).check()
    with pytest.raises(SurefootError, match=r"run: was trained with steps 5000, and the study asks for 6000; continue"):
        make_run(run.path, steps=6000).check()
    with pytest.raises(SurefootError, match=r"steps 5000, and the study asks for 4000; move the folder"):
        make_run(run.path, steps=4000).check(extend=True)
    task = replace(run.config.task, pushes=replace(run.config.task.pushes, probability=0.5))
    with pytest.raises(SurefootError, match=r"with task.pushes.probability 0.25, and the study asks for 0.5"):
        make_run(run.path, steps=6000, task=task).check(extend=True)
    (run.path / "config.yaml").write_text("steps: many\n")
    with pytest.raises(SurefootError, match="move the folder away"):
        run.check()


def test_extend_reopens_a_finished_run(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", steps=5000, checkpoint_every=123)
    store(run, "checkpoints/latest.ckpt")
    store(run, "policy.onnx")
    longer = make_run(run.path, steps=9000)
    longer.checkpoint.unlink()
    with pytest.raises(SurefootError, match=r"run: has no checkpoint, so that its 5,000 control steps can't be contin"):
        longer.check(extend=True)
    store(run, "checkpoints/latest.ckpt")
    longer.check(extend=True)
    run.extend()
    assert run.state == "finished"
    longer.extend()
    longer.check()
    assert longer.state == "started"
    assert yaml.safe_load((run.path / "config.yaml").read_text())["checkpoint_every"] == 123


@pytest.mark.parametrize("name", ["from-scratch", "reality-gap", "robustness"])
def test_released_studies_can_be_read(name: str, repository: Path) -> None:
    study = load_study(repository / "studies" / f"{name}.yaml")
    assert len(study.seeds) >= study.top
    assert set().union(*study.bars.values()) <= set(study.groups)


def test_the_state_of_a_study_is_read_without_torch() -> None:
    script = "import sys, surefoot.studies.study_config, surefoot.studies.workers; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], timeout=60, check=False).returncode == 0
