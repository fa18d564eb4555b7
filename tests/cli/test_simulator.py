"""`--actuator`, `--control-latency` and `--servo-latency`: as words, and as a user gives them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from processes import refused, surefoot

from surefoot.cli.simulator import Simulator
from surefoot.errors import SurefootError
from surefoot.task.config import TaskConfig

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

TASK = TaskConfig(params={"voltage": 15.0, "control_latency": 0.02})


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# --- words ------------------------------------------------------------------------------------------------


def test_options_change_the_task():
    assert Simulator().of(TASK) == TASK
    task = Simulator("constraint", 0.0, 0.003).of(TASK)
    assert task == replace(
        TASK, actuator="constraint", params={"voltage": 15.0, "control_latency": 0.0, "servo_latency": 0.003}
    )


def test_settings_go_over_the_task_and_not_over_the_options():
    assert Simulator().of(TASK, {"control_latency": 0.01}).params["control_latency"] == 0.01
    with pytest.raises(SurefootError, match="control_latency is given twice"):
        Simulator(control_latency=0.0).of(TASK, {"control_latency": 0.01})


# --- commands ---------------------------------------------------------------------------------------------


def test_an_evaluation_in_another_simulator():
    results = []
    for words in ([], ["--actuator", "constraint", "--control-latency", "0", "--servo-latency", "0"]):
        done = surefoot("evaluate", "trot", "--episodes", "1", "--threads", "1", "--json", *words)
        results.append(json.loads(done.stdout))
    own, ideal = results
    assert (own["actuator"], own["set"]) == ("dc", {})
    assert (ideal["actuator"], ideal["set"]) == ("constraint", {"control_latency": 0.0, "servo_latency": 0.0})
    assert own["distance_mean"] != ideal["distance_mean"]


def test_a_sensitivity_study_in_another_simulator():
    Path("ranges.yaml").write_text("mass: [0.9, 1.1]\n")
    words = ["--values", "2", "--episodes", "1", "--duration", "0.12", "--threads", "1", "--ranges", "ranges.yaml"]
    results = []
    for more in ([], ["--actuator", "constraint", "--control-latency", "0"]):
        (policy,) = json.loads(surefoot("sensitivity", "trot", *words, "--json", *more).stdout)["policies"]
        results.append(policy)
    own, ideal = results
    assert (own["actuator"], own["params"]) == ("dc", {})
    assert (ideal["actuator"], ideal["params"]) == ("constraint", {"control_latency": 0.0})
    assert own["nominal_return"] != ideal["nominal_return"]


def test_a_training_takes_the_options():
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    words = "trot --actuator constraint --control-latency=0 --task.max-steps 60 --runs r --servo_latency 3e-3 --pushes"
    config, root = _parse(words.split())
    assert (config.task.actuator, root) == ("constraint", Path("r"))
    assert config.task.params == {"control_latency": 0.0, "servo_latency": 0.003}
    assert (config.task.max_steps, config.task.pushes.enabled) == (60, True)
    assert _parse(["trot"])[0].task.actuator == "dc"


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("evaluate trot --actuator servo", ("servo",)),
        ("train trot --actuator", ("--actuator",)),
        ("train trot --actuator --pushes", ("--actuator",)),
        ("train trot --servo-latency soon", ("--servo-latency", "soon")),
        ("train trot --control-latency 0 --task.params control_latency 0.01", ("control_latency", "twice")),
        ("evaluate trot --control-latency 1 --out o", ("control_latency is 1; minitaur allows 0 to 0.1",)),
        ("evaluate trot --servo-latency -0.001 --out o", ("servo_latency is -0.001; minitaur allows",)),
        (
            "evaluate trot --actuator constraint --thermal-protection --out o",
            ("thermal_protection is on; it requires actuator dc",),
        ),
        ("play trot --control-latency 1", ("control_latency is 1; minitaur allows 0 to 0.1",)),
        ("sensitivity trot --control-latency 1", ("control_latency is 1; minitaur allows 0 to 0.1",)),
        ("sensitivity trot --actuator servo", ("servo",)),
        ("evaluate trot --threads -1 --out o", ("threads is -1; it must be 0 or more",)),
        ("sensitivity trot --threads -1", ("threads is -1; it must be 0 or more",)),
        ("gap trot --to mujoco --threads -1", ("threads is -1; it must be 0 or more",)),
        ("train trot --control-latency 1", ("control_latency is 1; minitaur allows 0 to 0.1",)),
        ("train trot --actuator servo", ("servo",)),
        ("train trot --actuator constraint --task.thermal-protection", ("thermal_protection is on",)),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_done(line: str, parts: tuple[str, ...]):
    if line.startswith("train"):
        pytest.importorskip("torch")
    refused(surefoot(*line.split()), *parts)
    assert list(Path().iterdir()) == []
