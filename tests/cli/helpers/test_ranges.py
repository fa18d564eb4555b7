"""`--randomize TABLE` and `--randomize.NAME LOW HIGH`: parsing, and effect in commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from processes import surefoot

from surefoot.cli.helpers.ranges import ranges_help, take_ranges
from surefoot.errors import SurefootError
from surefoot.robot.params import PARAMETERS
from surefoot.robot.randomization import Ranges, RelativeRange, load_ranges

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("onnx")

TABLE_1 = load_ranges("table1")
WITHOUT_MASS = {name: interval for name, interval in TABLE_1.items() if name != "leg_mass_ratio"}


def taken(line: str, base: Ranges | None = None) -> tuple[list[str], Ranges]:
    """Return the other arguments, and the Minitaur's ranges."""
    rest, options = take_ranges(line.split())
    return rest, options.apply("minitaur", base)


# --- words ------------------------------------------------------------------------------------------------


def test_words_without_options_keep_the_ranges():
    line = "trot --steps 100 --set voltage=15 --randomizer x --random --task.randomize.voltage 15 16"
    assert taken(line, TABLE_1) == (line.split(), TABLE_1)


@pytest.mark.parametrize(
    ("line", "ranges"),
    [
        ("--randomize table1", TABLE_1),
        ("--randomize=table1", TABLE_1),
        ("--randomize table1 --randomize none", {}),
        ("--randomize none --randomize table1", TABLE_1),
        ("--randomize mine.yaml", {"voltage": (15.0, 16.0)}),
        ("--randomize=mine.yaml", {"voltage": (15.0, 16.0)}),
    ],
)
def test_table_replaces_the_tasks_ranges(line: str, ranges: Ranges, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mine.yaml").write_text("voltage: [15, 16]\n")
    monkeypatch.chdir(tmp_path)
    assert taken(line, {"resistance": (0.1, 0.2)})[1] == ranges


LATENCY: Ranges = {"control_latency": (0.01, 0.03)}


@pytest.mark.parametrize(
    ("line", "ranges"),
    [
        ("--randomize.control_latency 0.01 0.03", LATENCY),
        ("--randomize.control-latency=0.01 0.03", LATENCY),
        ("--randomize.control_latency 10e-3 3e-2", LATENCY),
        ("--randomize.control_latency 0 1 --randomize.control_latency 0.01 0.03", LATENCY),
        ("--randomize.control_latency none --randomize.control_latency 0.01 0.03", LATENCY),
        ("--randomize.imu-bias -0.02 -0.01", {"imu_bias": (-0.02, -0.01)}),
        ("--randomize.servo_kp scale 0.9 1.1", {"servo_kp": RelativeRange(scale=(0.9, 1.1))}),
        ("--randomize.servo_kp=scale 0.9 1.1", {"servo_kp": RelativeRange(scale=(0.9, 1.1))}),
        ("--randomize.motor-offset add -0.1 0.1", {"motor_offset": RelativeRange(add=(-0.1, 0.1))}),
        (
            "--randomize table1 --randomize.voltage 14 15 --randomize.leg-mass-ratio none",
            WITHOUT_MASS | {"voltage": (14.0, 15.0)},
        ),
        (
            "--randomize.leg_mass_ratio=None --randomize.voltage 14 15 --randomize=table1",
            WITHOUT_MASS | {"voltage": (14.0, 15.0)},
        ),
    ],
)
def test_option_changes_the_range_of_one_parameter(line: str, ranges: Ranges):
    assert taken(f"{line} trot -v") == (["trot", "-v"], ranges)


@pytest.mark.parametrize(
    ("line", "pieces"),
    [
        ("--randomize", ["--randomize has no value", "none, table1, or a YAML file"]),
        ("--randomize --json", ["--randomize has no value"]),
        ("--randomize tabel1", ["randomize 'tabel1' does not exist; did you mean table1? choices: ensemble"]),
        ("--randomize=", ["randomize '' does not exist"]),
        ("--randomize.colour 0 1", ["'colour' is not a physical parameter; choices: base_mass_ratio"]),
        ("--randomize. 0 1", ["'' is not a physical parameter"]),
        ("--randomize.latency 0 1", ["'latency' is not a physical parameter; did you mean servo_latency?"]),
        ("--randomize.voltage", ["--randomize.voltage is nothing; it takes LOW HIGH, scale LOW HIGH, add LOW HIGH"]),
        ("--randomize.voltage 1.0", ["--randomize.voltage is 1.0; it takes LOW HIGH"]),
        ("--randomize.voltage scale 1.0 --json", ["--randomize.voltage is scale 1.0; it takes LOW HIGH"]),
        ("--randomize.voltage low high", ["--randomize.voltage is low high; it takes LOW HIGH"]),
        ("--randomize.voltage 0.9 none", ["--randomize.voltage is 0.9 none; it takes LOW HIGH"]),
    ],
)
def test_invalid_ranges_are_rejected_in_one_line(line: str, pieces: list[str]):
    with pytest.raises(SurefootError) as caught:
        taken(line)
    assert "\n" not in str(caught.value)
    for piece in pieces:
        assert piece in str(caught.value)


def test_train_help_lists_every_parameter():
    done = surefoot("train", "--help")
    assert done.returncode == 0
    assert ranges_help() in done.stdout
    lines = ranges_help().splitlines()
    for name, (low, high) in TABLE_1.items():
        assert [name, f"{low:g}", "to", f"{high:g}"] in [line.split() for line in lines]
    for name in set(PARAMETERS) - set(TABLE_1):
        assert any(name in line for line in lines), name
    assert max(map(len, lines)) <= 120


# --- commands ---------------------------------------------------------------------------------------------


def test_evaluate_reports_its_ranges(tmp_path: Path):
    words = ("evaluate", "trot", "--episodes", "2", "--json", "--seed", "3")
    ranges = ("--randomize", "table1", "--randomize.voltage", "14", "15", "--randomize.leg_mass_ratio", "none")
    drawn = surefoot(*words, *ranges, cwd=tmp_path)
    assert drawn.returncode == 0, drawn.stderr
    assert drawn.stdout.count("\n") == 1
    result = json.loads(drawn.stdout)
    assert result["falls"] in (0, 1, 2)
    expected = WITHOUT_MASS | {"voltage": (14.0, 15.0)}
    assert result["randomize"] == {name: list(interval) for name, interval in expected.items()}
    # The same options give the same parameters; without the options nothing is randomized.
    assert surefoot(*words, *ranges).stdout == drawn.stdout
    plain = json.loads(surefoot(*words).stdout)
    assert plain["randomize"] == {}
    assert plain["distance_mean"] != result["distance_mean"]


def test_run_folder_keeps_its_ranges(tmp_path: Path):
    from surefoot.cli.train import _parse
    from surefoot.learn.run_folder import RunFolder

    config, _ = _parse(["trot", "--randomize", "table1", "--randomize.servo_kp", "scale", "0.9", "1.1"])
    folder = RunFolder.create_at(config, tmp_path / "run")
    expected = {**TABLE_1, "servo_kp": RelativeRange(scale=(0.9, 1.1))}
    assert RunFolder.open(folder.path)[1].task.randomize == expected
    stored = yaml.safe_load((folder.path / "config.yaml").read_text())["task"]["randomize"]
    assert stored["servo_kp"]["scale"] == [0.9, 1.1]
    assert tuple(stored["voltage"]) == TABLE_1["voltage"]
