"""`--randomize NAME` and `--randomize.ROW LOW HIGH`, as words and in commands."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from processes import surefoot

from surefoot.cli.helpers.simulator import ranges_help, take_ranges
from surefoot.errors import SurefootError
from surefoot.robot.randomization import ROWS, RandomizeConfig, load_ranges

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("onnx")

TABLE_1 = load_ranges("table1").ranges
NOTHING = RandomizeConfig()


def taken(words: list[str], base: RandomizeConfig) -> tuple[list[str], RandomizeConfig]:
    """Return the other words, and the Minitaur's ranges."""
    rest, given = take_ranges(words)
    return rest, given.of("minitaur", base)


def ranges_of(line: str, base: RandomizeConfig = NOTHING) -> dict[str, tuple[float, float]]:
    return taken(line.split(), base)[1].ranges


# --- words ------------------------------------------------------------------------------------------------


def test_without_options_all_stays():
    words = ["trot", "--steps", "100", "--set", "voltage=15"]
    rest, ranges = taken(words, load_ranges("table1"))
    assert rest == words == ["trot", "--steps", "100", "--set", "voltage=15"]
    assert ranges == load_ranges("table1")


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
def test_a_table_stands_in_place_of_the_task_s(line, ranges, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mine.yaml").write_text("voltage: [15, 16]\n")
    monkeypatch.chdir(tmp_path)
    assert ranges_of(line, RandomizeConfig(resistance=(0.1, 0.2))) == ranges


@pytest.mark.parametrize(
    "line",
    [
        "--randomize.latency 0.01 0.03",
        "--randomize.latency=0.01 0.03",
        "--randomize.latency 10e-3 3e-2",
        "--randomize.latency 0 1 --randomize.latency 0.01 0.03",
        "--randomize.latency none --randomize.latency 0.01 0.03",
    ],
)
def test_a_row(line):
    assert ranges_of(line) == {"latency": (0.01, 0.03)}
    base = RandomizeConfig(latency=(0.0, 0.04), mass=(0.9, 1.1))
    assert ranges_of(line, base) == {"mass": (0.9, 1.1), "latency": (0.01, 0.03)}
    for negative in ("--randomize.imu_bias -0.02 -0.01", "--randomize.imu-bias -0.02 -0.01"):
        assert ranges_of(negative) == {"imu_bias": (-0.02, -0.01)}


def test_every_row_can_be_given_and_dropped():
    full = RandomizeConfig(**{name: (0.1, 0.2) for name in ROWS})
    for row in ROWS:
        assert ranges_of(f"--randomize.{row} 0.1 0.2") == {row: (0.1, 0.2)}
        for line in (f"--randomize.{row} none", f"--randomize.{row}=none", f"--randomize.{row} None"):
            assert ranges_of(line, full) == {name: (0.1, 0.2) for name in ROWS if name != row}


@pytest.mark.parametrize(
    "line",
    [
        "--randomize table1 --randomize.latency 0.01 0.02 --randomize.mass none",
        "--randomize.latency 0.01 0.02 --randomize table1 --randomize.mass none",
        "--randomize.mass none --randomize.latency 0.01 0.02 --randomize=table1",
    ],
)
def test_rows_go_over_the_table_in_any_order(line):
    expected = {**TABLE_1, "latency": (0.01, 0.02)}
    del expected["mass"]
    assert ranges_of(line) == expected


def test_other_words_stay_in_order_and_those_behind_a_row_are_not_taken():
    for line in ("trot --randomize table1 --episodes 2", "--randomize=table1 trot --episodes 2"):
        rest, ranges = taken(line.split(), NOTHING)
        assert (rest, ranges.ranges) == (["trot", "--episodes", "2"], TABLE_1)
    rest, ranges = taken(["--randomize.latency", "0.01", "0.02", "trot", "--randomize.mass", "none", "-v"], NOTHING)
    assert (rest, ranges.ranges) == (["trot", "-v"], {"latency": (0.01, 0.02)})
    assert taken(["--randomize.mass=none", "trot"], NOTHING)[0] == ["trot"]


def test_what_only_begins_alike_is_left():
    words = ["--randomizer", "x", "--random", "--task.randomize.mass", "0.9", "1.1"]
    assert taken(words, NOTHING) == (words, NOTHING)


@pytest.mark.parametrize(
    ("line", "pieces"),
    [
        ("--randomize", ["--randomize has no value", "none, table1, or a YAML file"]),
        ("--randomize --json", ["--randomize has no value"]),
        ("--randomize tabel1", ["randomize 'tabel1' does not exist; choices: ensemble, none, table1"]),
        ("--randomize=", ["randomize '' does not exist"]),
        ("--randomize.colour 0 1", ["--randomize.colour is not a row", "choices: mass, motor_friction"]),
        ("--randomize. 0 1", ["--randomize. is not a row"]),
        ("--randomize.mass", ["--randomize.mass is nothing; it takes two numbers, LOW HIGH, or none"]),
        ("--randomize.mass 1.0", ["--randomize.mass is 1.0; it takes two numbers"]),
        ("--randomize.mass 1.0 --json", ["--randomize.mass is 1.0; it takes two numbers"]),
        ("--randomize.mass light heavy", ["--randomize.mass is light heavy; it takes two numbers"]),
        ("--randomize.mass 0.9 none", ["--randomize.mass is 0.9 none; it takes two numbers"]),
        ("--randomize.mass 1.1 0.9", ["randomize.mass is [1.1, 0.9]; the lower bound must come first"]),
        ("--randomize.mass nan 1", ["randomize.mass is [nan, 1]"]),
    ],
)
def test_words_that_do_not_fit_are_refused(line, pieces):
    with pytest.raises(SurefootError) as caught:
        taken(line.split(), NOTHING)
    assert "\n" not in str(caught.value)
    for piece in pieces:
        assert piece in str(caught.value)


def test_help_has_every_row():
    lines = ranges_help().splitlines()
    for row, (low, high) in TABLE_1.items():
        assert any(line.split() == [row, f"{low:g}", "to", f"{high:g}"] for line in lines), row
    for row in set(ROWS) - set(TABLE_1):
        assert any(row in line for line in lines), row
    assert max(map(len, lines)) <= 120


# --- commands ---------------------------------------------------------------------------------------------


def test_train_help_shows_the_table(tmp_path: Path):
    done = surefoot("train", "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert ranges_help() in done.stdout
    assert re.search(r"latency +0 to 0\.04\n", done.stdout)
    assert re.search(r"imu_bias +-0\.05 to 0\.05\n", done.stdout)


def test_an_evaluation_says_what_was_drawn(tmp_path: Path):
    words = ("evaluate", "trot", "--episodes", "2", "--json", "--seed", "3")
    ranges = ("--randomize", "table1", "--randomize.latency", "0.01", "0.02", "--randomize.mass", "none")
    drawn = surefoot(*words, *ranges, cwd=tmp_path)
    assert drawn.returncode == 0, drawn.stderr
    assert drawn.stdout.count("\n") == 1
    result = json.loads(drawn.stdout)
    assert result["falls"] in (0, 1, 2)
    expected = {row: list(given) for row, given in {**TABLE_1, "latency": (0.01, 0.02)}.items() if row != "mass"}
    assert result["randomize"] == expected
    # The same words draw the same, and without the options nothing is drawn.
    assert surefoot(*words, *ranges).stdout == drawn.stdout
    plain = json.loads(surefoot(*words).stdout)
    assert plain["randomize"] == {}
    assert plain["distance_mean"] != result["distance_mean"]


def test_a_run_keeps_its_ranges(tmp_path: Path):
    from surefoot.cli.train import _parse
    from surefoot.learn.run_folder import RunFolder

    line = "trot --randomize table1 --randomize.latency 0.01 0.02 --randomize.mass none"
    config, _ = _parse(line.split())
    folder = RunFolder.create_at(config, tmp_path / "run")
    expected = {**TABLE_1, "latency": (0.01, 0.02)}
    del expected["mass"]
    assert RunFolder.open(folder.path)[1].task.randomize.ranges == expected
    stored = yaml.safe_load((folder.path / "config.yaml").read_text())["task"]["randomize"]
    assert {row: tuple(given) for row, given in stored.items() if given is not None} == expected
    assert stored["mass"] is None
