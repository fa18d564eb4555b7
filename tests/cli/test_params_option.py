"""`--params FILE`, `--actuator` and latencies: another simulator in training, evaluation, the gap and sensitivity."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from edited import edited_policy, maxitaur
from processes import refused, surefoot

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

from surefoot.cli.helpers.simulator import Simulator
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import write_params
from surefoot.task.config import TaskConfig
from surefoot.task.trace import EpisodeTrace

STRENGTH = (0.94, 0.97, 0.91, 1.0, 0.99, 0.93, 0.96, 0.98)
BIAS = (0.01, -0.02)
TEXT = f"""robot = "minitaur"
[params]
motor_strength = {list(STRENGTH)}
imu_bias = {list(BIAS)}
voltage = 15.4
servo_latency = 0.0021
servo_kp = 0.9
[fit]
error = 0.01
"""
VALUES = {"motor_strength": STRENGTH, "imu_bias": BIAS, "voltage": 15.4, "servo_latency": 0.0021, "servo_kp": 0.9}
AS_JSON = {name: list(value) if isinstance(value, tuple) else value for name, value in VALUES.items()}
SOURCE = {"file": "robot.toml", "sha256": hashlib.sha256(TEXT.encode()).hexdigest()}
ONE = ("--threads", "1")
SHORT = ("--episodes", "2", *ONE)
TASK = TaskConfig(params={"voltage": 15.0, "control_latency": 0.02})


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with robot.toml in it."""
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(TEXT)
    return tmp_path


def result(line: str, *more: str) -> dict[str, Any]:
    done = surefoot(*line.split(), *more, "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


# --- the task ---------------------------------------------------------------------------------------------


def test_a_file_stands_in_place_of_the_task_s_parameters():
    former = TaskConfig(params={"resistance": 0.2, "voltage": 14.0, "control_step": 0.008}, params_source={"file": "x"})
    task = Simulator(params=Path("robot.toml")).apply(former)
    assert task.params == {**VALUES, "control_step": 0.008}
    assert task.params_source == SOURCE
    assert Simulator().apply(task) == task


def test_options_and_settings_go_over_the_file():
    task = Simulator(servo_latency=0.001, params=Path("robot.toml")).apply(TaskConfig(), {"voltage": 15.0})
    assert task.params == {**VALUES, "servo_latency": 0.001, "voltage": 15.0}
    with pytest.raises(SurefootError, match="servo_latency is given twice"):
        Simulator(servo_latency=0.001, params=Path("robot.toml")).apply(TaskConfig(), {"servo_latency": 0.0})


def test_a_control_step_belongs_to_the_policy():
    robot = RobotDescription.load("minitaur")
    write_params(Path("all.toml"), robot, PhysicalParams.nominal(robot))
    own = robot.timing.control_step
    assert Simulator(params=Path("all.toml")).apply(TaskConfig()).params["control_step"] == own
    with pytest.raises(SurefootError, match=rf"all\.toml: control_step is {own:g}, and the task's is 0\.01"):
        Simulator(params=Path("all.toml")).apply(TaskConfig(params={"control_step": 0.01}))


def test_options_change_the_task():
    assert Simulator().apply(TASK) == TASK
    assert Simulator().apply(TASK, {"control_latency": 0.01}).params["control_latency"] == 0.01
    task = Simulator("constraint", 0.0, 0.003).apply(TASK)
    assert task == replace(
        TASK, actuator="constraint", params={"voltage": 15.0, "control_latency": 0.0, "servo_latency": 0.003}
    )


# --- commands that run a policy ---------------------------------------------------------------------------


def test_an_evaluation_on_the_robot_of_a_file():
    own = result("evaluate trot", *SHORT)
    found = result("evaluate trot --params robot.toml --out out", *SHORT)
    over = result("evaluate trot --params robot.toml --set voltage=15.0 --control-latency 0.01", *SHORT)
    assert (own["params"], own["params_source"], own["set"]) == ({}, {}, {})
    assert (found["params"], found["params_source"], found["set"]) == (AS_JSON, SOURCE, {})
    assert over["params"] == {**AS_JSON, "control_latency": 0.01, "voltage": 15.0}
    assert over["set"] == {"control_latency": 0.01, "voltage": 15.0}
    assert len({one["distance_mean"] for one in (own, found, over)}) == 3
    for path in Path("out").glob("*.npz"):
        meta = EpisodeTrace.load(path).meta
        assert meta["params"] == {**RobotDescription.load("minitaur").nominal_params(), **AS_JSON}
        assert meta["params_source"] == SOURCE


def test_what_is_drawn_replaces_its_rows_only():
    words = "evaluate trot --params robot.toml --randomize.motor-strength 0.8 0.9 --out out"
    found = result(words, *SHORT)
    assert found["randomize"] == {"motor_strength": [0.8, 0.9]}
    for path in sorted(Path("out").glob("*.npz")):
        params = EpisodeTrace.load(path).meta["params"]
        assert 0.8 <= min(params["motor_strength"]) < max(params["motor_strength"]) <= 0.9
        assert (params["imu_bias"], params["voltage"]) == (list(BIAS), 15.4)


def test_the_gap_has_the_robot_on_all_simulated_sides():
    words = "gap trot --to mujoco --params robot.toml --to-set voltage=14 --runs 2 --duration 0.3"
    (policy,) = result(words, *ONE)["policies"]
    assert policy["home"] == {"actuator": "dc", "params": AS_JSON, "params_source": SOURCE}
    assert policy["away"] == {"actuator": "dc", "params": {**AS_JSON, "voltage": 14.0}, "params_source": SOURCE}
    home, away = (EpisodeTrace.load(f"gap/trot/{world}/run_001.npz").meta for world in ("mujoco", "mujoco-away"))
    assert home["params"]["motor_strength"] == away["params"]["motor_strength"] == list(STRENGTH)
    assert (home["params"]["voltage"], away["params"]["voltage"]) == (15.4, 14.0)
    # Recorded runs stay as they are, and the robot stands beside them.
    shutil.copytree("gap/trot/mujoco-away", "recorded")
    before = [path.read_bytes() for path in sorted(Path("recorded").iterdir())]
    words = "gap trot --to trace recorded --params robot.toml --runs 2 --duration 0.3 --out told"
    again = result(words, *ONE)["policies"][0]
    assert again["worlds"][0] == policy["worlds"][0]
    assert again["worlds"][1]["return_mean"] == policy["worlds"][1]["return_mean"]
    assert [path.read_bytes() for path in sorted(Path("recorded").iterdir())] == before


def test_sensitivity_takes_the_robot_as_the_nominal_one():
    Path("ranges.yaml").write_text("voltage: [14.0, 15.4]\n")
    words = "sensitivity trot --values 2 --episodes 1 --duration 0.12 --ranges ranges.yaml --params robot.toml"
    (policy,) = result(words, *ONE)["policies"]
    assert (policy["params"], policy["params_source"]) == (AS_JSON, SOURCE)
    lines = [line.split(",") for line in Path("sensitivity/episodes.csv").read_text().splitlines()]
    returns = {line[lines[0].index("value")]: line[lines[0].index("return")] for line in lines[1:]}
    # The robot has 15.4 V, so that its world and that test world are one.
    assert float(returns["15.4"]) == pytest.approx(policy["nominal_return"], abs=1e-6)


def test_an_evaluation_and_a_sensitivity_study_in_another_simulator():
    Path("ranges.yaml").write_text("base_mass_ratio: [0.9, 1.1]\n")
    study = "sensitivity trot --values 2 --episodes 1 --duration 0.12 --ranges ranges.yaml"
    options = "--actuator constraint --control-latency 0"
    own, ideal = (result(f"evaluate trot --episodes 1 {more}", *ONE) for more in ("", f"{options} --servo-latency 0"))
    assert (own["actuator"], own["set"]) == ("dc", {})
    assert (ideal["actuator"], ideal["set"]) == ("constraint", {"control_latency": 0.0, "servo_latency": 0.0})
    assert own["distance_mean"] != ideal["distance_mean"]
    ((own,), (ideal,)) = (result(f"{study} {more}", *ONE)["policies"] for more in ("", options))
    assert (own["actuator"], own["params"]) == ("dc", {})
    assert (ideal["actuator"], ideal["params"]) == ("constraint", {"control_latency": 0.0})
    assert own["nominal_return"] != ideal["nominal_return"]


# --- training ---------------------------------------------------------------------------------------------

TINY = ["--num-envs", "8", "--steps-per-update", "8", "--steps", "128", "--evaluate-every", "64"]
TINY += ["--evaluation-episodes", "2", "--task.max-steps", "40", "--threads", "1", "--learning-threads", "1"]


def test_a_training_keeps_the_robot_in_its_configuration():
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    task = _parse(["trot", "--params", "robot.toml", *TINY])[0].task
    assert (task.params, task.params_source) == (VALUES, SOURCE)
    task = _parse(["trot", "--control-latency", "0.012", "--params=robot.toml"])[0].task
    assert task.params == {**VALUES, "control_latency": 0.012}
    task = _parse(["trot", "--task.params", "voltage", "15", "--params", "robot.toml"])[0].task
    assert task.params == {**VALUES, "voltage": 15.0}
    assert _parse(["trot"])[0].task.params_source == {}


def test_a_training_takes_the_options():
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    words = "trot --actuator constraint --control-latency=0 --task.max-steps 60 --runs r --servo_latency 3e-3 --pushes"
    config, command = _parse(words.split())
    assert (config.task.actuator, command.runs) == ("constraint", Path("r"))
    assert config.task.params == {"control_latency": 0.0, "servo_latency": 0.003}
    assert (config.task.max_steps, config.task.pushes.enabled) == (60, True)
    assert _parse(["trot"])[0].task.actuator == "dc"


def test_the_robot_of_the_file_may_be_named_in_the_same_words(here: Path):
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    maxitaur(here / "maxitaur")
    Path("other.toml").write_text(TEXT.replace("minitaur", "maxitaur"))
    words = ["trot", "--params", "other.toml", "--task.robot", "maxitaur"]
    assert _parse(words)[0].task.params == VALUES
    with pytest.raises(SurefootError, match="has parameters of robot 'minitaur', not of 'maxitaur'"):
        _parse(["trot", "--params", "robot.toml", "--task.robot", "maxitaur"])


def test_a_whole_training_evaluates_on_the_robot(here: Path):
    pytest.importorskip("torch")
    pytest.importorskip("imageio_ffmpeg")
    from surefoot.learn.run_folder import RunFolder
    from surefoot.policy.runtime import PolicyRuntime

    done = surefoot("train", "trot", "--params", "robot.toml", *TINY)
    assert done.returncode == 0, done.stderr
    (run,) = here.glob("runs/trot/*")
    told = json.loads((run / "evaluation.json").read_text())["without_pushes"]
    Path("robot.toml").unlink()
    config, policy = RunFolder.open(run)[1], run / "policy.onnx"
    assert (config.task.params, config.task.params_source) == (VALUES, SOURCE)
    contract, nominal = PolicyRuntime.load(policy).contract, RobotDescription.load("minitaur").nominal_params()
    assert (contract.voltage, contract.servo_kp, contract.servo_latency) == (15.4, 0.9, 0.0021)
    assert (contract.servo_kd, contract.control_latency) == (nominal["servo_kd"], nominal["control_latency"])
    own = result(f"evaluate {policy} --episodes 20 --seed 0")
    assert (own["params"], own["params_source"]) == (AS_JSON, SOURCE)
    for key in ("return_mean", "distance_mean", "power_mean", "falls"):
        assert own[key] == told[key], key


# --- what does not fit ------------------------------------------------------------------------------------

BAD = {
    "broken.toml": "[params",
    "bare.toml": "voltage = 15\n",
    "cat.toml": 'robot = "cat"\n[params]\nvoltage = 15\n',
    "name.toml": "[params]\nvolts = 15\n",
    "range.toml": "[params]\nmotor_strength = [1, 1, 1, 9, 1, 1, 1, 1]\n",
    "short.toml": "[params]\nmotor_strength = [1, 0.9]\n",
    "two.toml": "[params]\nvoltage = [15, 16]\n",
    "step.toml": "[params]\ncontrol_step = 0.008\n",
}
SAID = [
    ("nowhere.toml", "nowhere.toml: can't be read: No such file or directory"),
    ("broken.toml", "broken.toml: is not TOML"),
    ("bare.toml", "bare.toml: has no table [params]"),
    ("cat.toml", "cat.toml: has parameters of robot 'cat', not of 'minitaur'"),
    ("name.toml", "name.toml: 'volts' is not a physical parameter; choices: base_mass_ratio"),
    ("range.toml", "range.toml: motor_strength is 9; minitaur allows 0 to 2"),
    ("short.toml", "short.toml: motor_strength has shape (2,); it must fit (1, 8)"),
    ("two.toml", "two.toml: voltage has shape (2,); it must fit (1,)"),
    ("step.toml", "step.toml: control_step is 0.008, and the task's is 0.006"),
]


@pytest.mark.parametrize(
    "line",
    ["train trot", "evaluate trot --out o", "gap trot --to mujoco", "sensitivity trot", "play trot --out o.mp4"],
)
def test_a_file_that_does_not_fit_is_told_in_one_line(line: str, here: Path):
    if line.startswith("train"):
        pytest.importorskip("torch")
    for name, text in BAD.items():
        Path(name).write_text(text)
    before = sorted(here.iterdir())
    for name, told in SAID if line.startswith("evaluate") else SAID[2::6]:  # what all share is tried once
        refused(surefoot(*line.split(), "--params", name), f"surefoot: error: {told}")
        assert sorted(here.iterdir()) == before


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("evaluate --trace a.npz --params robot.toml", "--trace and --params are given"),
        ("evaluate --trace a.npz --control-latency 0", "--trace and --control-latency are given"),
        ("gap trot --from trace a --to trace b --params robot.toml", "--params is given, but nothing is simulated"),
    ],
)
def test_where_nothing_is_simulated_anew_it_is_refused(line: str, part: str):
    refused(surefoot(*line.split()), part)


def test_a_policy_with_another_control_step_keeps_it(here: Path):
    def change(contract: dict[str, Any]) -> None:
        contract.update(control_step=0.008, voltage=14.0)
        contract["task"].update(max_steps=20)

    edited_policy(here / "slow.onnx", change, "trot")
    Path("step.toml").write_text("[params]\ncontrol_step = 0.006\n")
    for words, step in (("--params robot.toml", 0.008), ("--params robot.toml --set control_step=0.007", 0.007)):
        found = result(f"evaluate slow.onnx {words}", *SHORT)
        assert found["params"] == {**AS_JSON, "control_step": step}
    told = surefoot("evaluate", "slow.onnx", "--params", "step.toml")
    assert told.returncode == 2
    assert "control_step is 0.006, and the task's is 0.008; it belongs to the policy" in told.stderr
