"""`--params FILE`, `--actuator` and latencies: changed simulators in training, evaluation, gap and sensitivity."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from processes import surefoot
from shipped_variants import maxitaur

pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")

from surefoot.cli.helpers.simulator import Simulator
from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import Condition
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


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working folder that contains robot.toml."""
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(TEXT)
    return tmp_path


def result(line: str, *more: str) -> dict[str, Any]:
    done = surefoot(*line.split(), *more, "--json")
    assert done.returncode == 0, done.stderr
    output: dict[str, Any] = json.loads(done.stdout)
    return output


# --- the task ---------------------------------------------------------------------------------------------


FILE = Path("robot.toml")
TASK = TaskConfig(params={"resistance": 0.2, "voltage": 15.0, "control_step": 0.008}, params_source={"file": "x"})


@pytest.mark.parametrize(
    ("simulator", "settings", "changes"),
    [
        (Simulator(), (), {}),
        (Simulator(params=FILE), (), {"params": {**VALUES, "control_step": 0.008}, "params_source": SOURCE}),
        (
            Simulator(servo_latency=0.001, params=FILE),
            ("voltage=15",),
            {
                "params": {**VALUES, "control_step": 0.008, "servo_latency": 0.001, "voltage": 15.0},
                "params_source": SOURCE,
            },
        ),
        (
            Simulator("constraint", control_latency=0.0),
            ("voltage=14",),
            {"actuator": "constraint", "params": {**TASK.params, "control_latency": 0.0, "voltage": 14.0}},
        ),
    ],
)
def test_file_replaces_parameters_and_options_override_it(
    simulator: Simulator, settings: tuple[str, ...], changes: dict[str, Any]
):
    assert simulator.condition([settings]).simulate(TASK) == replace(TASK, **changes)


def test_latency_given_twice_is_rejected():
    with pytest.raises(SurefootError, match="servo_latency is given twice"):
        Simulator(servo_latency=0.001).condition([("servo_latency=0",)])


def test_control_step_of_a_file_must_equal_the_tasks():
    robot = RobotDescription.load("minitaur")
    write_params(Path("all.toml"), robot, PhysicalParams.nominal(robot))
    own = robot.timing.control_step
    assert Condition(params_file=Path("all.toml")).simulate(TaskConfig()).params["control_step"] == own
    with pytest.raises(SurefootError, match=rf"all\.toml: control_step is {own:g}, and the task's is 0\.01"):
        Condition(params_file=Path("all.toml")).simulate(TaskConfig(params={"control_step": 0.01}))


# --- commands that run a policy ---------------------------------------------------------------------------


def test_evaluate_uses_the_parameters_of_a_file():
    own = result("evaluate trot", *SHORT)
    file = result("evaluate trot --params robot.toml --out out", *SHORT)
    words = "--set voltage=15.0 --control-latency 0.01 --actuator constraint"
    both = result(f"evaluate trot --params robot.toml {words}", *SHORT)
    assert (own["actuator"], own["params"], own["params_source"], own["set"]) == ("dc", {}, {}, {})
    assert (file["params"], file["params_source"], file["set"]) == (AS_JSON, SOURCE, {})
    assert both["params"] == {**AS_JSON, "control_latency": 0.01, "voltage": 15.0}
    assert (both["actuator"], both["set"]) == ("constraint", {"control_latency": 0.01, "voltage": 15.0})
    assert len({one["distance_mean"] for one in (own, file, both)}) == 3
    for path in Path("out").glob("*.npz"):
        meta = EpisodeTrace.load(path).meta
        assert meta["params"] == {**RobotDescription.load("minitaur").nominal_params(), **AS_JSON}
        assert meta["params_source"] == SOURCE


def test_gap_uses_the_parameters_in_all_worlds():
    words = "gap trot --to mujoco --params robot.toml --to-set voltage=14 --episodes 2 --duration 0.3"
    (policy,) = result(words, *ONE)["policies"]
    assert policy["home"] == {"actuator": "dc", "params": AS_JSON, "params_source": SOURCE}
    assert policy["away"] == {"actuator": "dc", "params": {**AS_JSON, "voltage": 14.0}, "params_source": SOURCE}
    home, away = (EpisodeTrace.load(f"gap/trot/{world}/run_001.npz").meta for world in ("mujoco", "mujoco-away"))
    assert home["params"]["motor_strength"] == away["params"]["motor_strength"] == list(STRENGTH)
    assert (home["params"]["voltage"], away["params"]["voltage"]) == (15.4, 14.0)
    # Recorded runs are unchanged, and are compared with the robot of the file.
    shutil.copytree("gap/trot/mujoco-away", "recorded")
    before = [path.read_bytes() for path in sorted(Path("recorded").iterdir())]
    words = "gap trot --to trace recorded --params robot.toml --episodes 2 --duration 0.3 --out result"
    again = result(words, *ONE)["policies"][0]
    assert again["worlds"][0] == policy["worlds"][0]
    assert again["worlds"][1]["return_mean"] == policy["worlds"][1]["return_mean"]
    assert [path.read_bytes() for path in sorted(Path("recorded").iterdir())] == before


def test_sensitivity_uses_the_parameters_as_nominal():
    Path("ranges.yaml").write_text("voltage: [14.0, 15.4]\n")
    words = "evaluate sensitivity trot --values 2 --episodes 1 --duration 0.12 --ranges ranges.yaml --params robot.toml"
    (policy,) = result(words, *ONE)["policies"]
    assert (policy["params"], policy["params_source"]) == (AS_JSON, SOURCE)
    lines = [line.split(",") for line in Path("sensitivity/episodes.csv").read_text().splitlines()]
    returns = {line[lines[0].index("value")]: line[lines[0].index("return")] for line in lines[1:]}
    # The robot has 15.4 V, so that its nominal world equals the test world with 15.4 V.
    assert float(returns["15.4"]) == pytest.approx(policy["nominal_return"], abs=1e-6)


# --- training ---------------------------------------------------------------------------------------------

TINY = ["--num-envs", "8", "--steps-per-update", "8", "--steps", "128", "--evaluate-every", "64"]
TINY += ["--evaluation-episodes", "2", "--task.max-steps", "40", "--threads", "1", "--learning-threads", "1"]


def test_train_uses_simulator_options_and_file():
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    words = "trot --actuator constraint --control-latency=0 --task.max-steps 60 --out r --servo_latency 3e-3 --pushes"
    config, command = _parse(words.split())
    assert (config.task.actuator, command.out) == ("constraint", Path("r"))
    assert config.task.params == {"control_latency": 0.0, "servo_latency": 0.003}
    assert (config.task.max_steps, config.task.pushes.enabled) == (60, True)
    task = _parse(["trot", "--set", "voltage=15", "--control-latency", "0.012", "--params=robot.toml"])[0].task
    assert (task.params, task.params_source) == ({**VALUES, "control_latency": 0.012, "voltage": 15.0}, SOURCE)
    assert _parse(["trot-robust"])[0].task.pushes.enabled
    assert not _parse(["trot-robust", "--no-pushes"])[0].task.pushes.enabled
    task = _parse(["trot"])[0].task
    assert (task.actuator, task.params_source) == ("dc", {})


def test_training_ignores_gains_estimated_by_an_identification():
    """The robot uses the gains of the contract, so an error of an estimate would act twice."""
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    found = '[identified_by]\nservo_kp = "motor"\nvoltage = "motor"\n'
    Path("found.toml").write_text(TEXT + found)
    task = _parse(["trot", "--params", "found.toml"])[0].task
    assert task.params == {name: value for name, value in VALUES.items() if name != "servo_kp"}
    task = _parse(["trot", "--params", "found.toml", "--set", "servo_kp=1.1"])[0].task
    assert task.params == {**VALUES, "servo_kp": 1.1}
    # A simulation of the identified robot uses them, and so does a training with gains that were set by hand.
    assert Condition(params_file=Path("found.toml")).simulate(TaskConfig()).params == VALUES
    assert _parse(["trot", "--params", "robot.toml"])[0].task.params == VALUES


def test_train_rejects_a_file_of_another_robot_than_named(here: Path):
    pytest.importorskip("torch")
    from surefoot.cli.train import _parse

    maxitaur(here / "maxitaur")
    Path("other.toml").write_text(TEXT.replace("minitaur", "maxitaur"))
    words = ["trot", "--params", "other.toml", "--robot", "maxitaur"]
    assert _parse(words)[0].task.params == VALUES
    with pytest.raises(SurefootError, match="has parameters of robot 'minitaur', not of 'maxitaur'"):
        _parse(["trot", "--params", "robot.toml", "--robot", "maxitaur"])


def test_training_evaluates_on_the_robot_of_its_file(here: Path):
    pytest.importorskip("torch")
    pytest.importorskip("imageio_ffmpeg")
    from surefoot.learn.run_folder import RunFolder
    from surefoot.policy.runtime import PolicyRuntime

    done = surefoot("train", "trot", "--params", "robot.toml", *TINY)
    assert done.returncode == 0, done.stderr
    (run,) = here.glob("runs/trot/*")
    evaluation = json.loads((run / "evaluation.json").read_text())["without_pushes"]
    Path("robot.toml").unlink()
    config, policy = RunFolder.open(run)[1], run / "policy.onnx"
    assert (config.task.params, config.task.params_source) == (VALUES, SOURCE)
    contract, nominal = PolicyRuntime.load(policy).contract, RobotDescription.load("minitaur").nominal_params()
    assert (contract.voltage, contract.servo_kp, contract.servo_latency) == (15.4, 0.9, 0.0021)
    assert (contract.servo_kd, contract.control_latency) == (nominal["servo_kd"], nominal["control_latency"])
    own = result(f"evaluate {policy} --episodes 20 --seed 0")
    assert (own["params"], own["params_source"]) == (AS_JSON, SOURCE)
    for key in ("return_mean", "distance_mean", "power_mean", "falls"):
        assert own[key] == evaluation[key], key
