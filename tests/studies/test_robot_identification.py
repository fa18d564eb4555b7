"""Identification of a study's robots by surefoot's commands, which a script replaces."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from surefoot.configuration import read_yaml
from surefoot.errors import SurefootError
from surefoot.robot.randomization import load_ranges
from surefoot.studies import robot_identification
from surefoot.studies.hidden_robots import HiddenRobots, OtherMotors
from surefoot.studies.robot_identification import identify_robots, unidentified_robots

SCRIPT = """
import json, sys, time
from pathlib import Path
words = sys.argv[1:]
value = lambda name: words[words.index(name) + 1]
with Path("calls.jsonl").open("a") as file:
    file.write(json.dumps(words) + "\\n")
if words[0] == "emulate":
    print("robot on port-" + value("--hidden-seed"), flush=True)
    time.sleep(60)
if value("--port") == "port-2" and words[1] == "mass":
    sys.exit("surefoot: error: the robot has fallen")
with Path(value("--params")).open("a") as file:
    file.write(words[1] + "\\n")
"""
ROBOTS = HiddenRobots(
    (1, 2, 3), load_ranges("ensemble"), other_motors=OtherMotors((3,), {"voltage_clip": 6.0}), robot="minitaur"
)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "script.py").write_text(SCRIPT)
    monkeypatch.setattr(robot_identification, "SUREFOOT_COMMAND", (sys.executable, "script.py"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def calls() -> list[list[str]]:
    path = Path("calls.jsonl")
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_every_robot_is_identified_once_and_failures_do_not_stop_others() -> None:
    pytest.importorskip("tomli_w")
    ended: list[tuple[int, str]] = []
    folder, work = Path("robots"), Path("work")
    failed = identify_robots(ROBOTS, folder, work, 1, lambda seed, error: ended.append((seed, error)))
    assert list(failed) == [2]
    assert failed[2] == "experiment mass: surefoot: error: the robot has fallen (work/robot_2/mass.txt)"
    assert ended == [(1, ""), (2, failed[2]), (3, "")]
    # Experiments run in order, the first two on the rack; a robot's file appears when all are done.
    assert (folder / "robot_1.toml").read_text().split() == ["motor", "latency", "mass", "contact"]
    assert sorted(path.name for path in folder.iterdir()) == ["hidden.yaml", "robot_1.toml", "robot_3.toml"]
    emulated = [words for words in calls() if words[0] == "emulate"]
    assert ["--rack" in words for words in emulated[:4]] == [True, True, False, False]
    assert {words[words.index("--hidden-ranges") + 1] for words in emulated} == {"work/ranges.yaml"}
    assert load_ranges("work/ranges.yaml") == ROBOTS.ranges
    assert "voltage" in read_yaml(work / "ranges.yaml")
    robots = {words[words.index("--hidden-seed") + 1]: words[words.index("--robot") + 1] for words in emulated}
    assert robots == {"1": "minitaur", "2": "minitaur", "3": str((work / "other_motors").absolute())}
    hosts = {words[words.index("--robot") + 1] for words in calls() if words[0] == "identify"}
    assert hosts == {"minitaur"}  # the host has the data sheet

    # A second call tries only the remaining robot.
    before = len(calls())
    assert unidentified_robots(ROBOTS, folder) == [2]
    assert list(identify_robots(ROBOTS, folder, work, 1, lambda *_: None)) == [2]
    assert len(calls()) == before + 6


def test_a_stop_leaves_no_partial_file() -> None:
    count = 0

    def stopped() -> bool:
        nonlocal count
        count += 1
        return count > 3

    assert identify_robots(ROBOTS, Path("robots"), Path("work"), 1, lambda *_: None, stopped) == {}
    assert unidentified_robots(ROBOTS, Path("robots")) == [1, 2, 3]


def test_robots_of_other_settings_are_not_taken_for_the_studys() -> None:
    folder = Path("robots")
    ROBOTS.check_settings(folder)  # nothing is identified yet
    ROBOTS.write_settings(folder)
    (folder / "robot_1.toml").write_text("")
    ROBOTS.check_settings(folder)
    other_motors = OtherMotors((3,), {"voltage_clip": 6.0}, "another name in tables")
    replace(ROBOTS, seeds=(1, 2, 3, 4), starts=5, other_motors=other_motors).check_settings(folder)
    wrong = replace(ROBOTS, ranges={**ROBOTS.ranges, "voltage": (14.0, 15.0)}, world="mujoco")
    with pytest.raises(SurefootError, match=r"hidden\.yaml: .* with other robots\.ranges, robots\.world than"):
        identify_robots(wrong, folder, Path("work"), 1, lambda *_: None)
    assert not calls()
    # Their files must not stay beside robots of other settings either.
    with pytest.raises(SurefootError, match=r"with other robots\.world than"):
        replace(ROBOTS, seeds=(2, 3), world="mujoco").check_settings(folder)
    (folder / "hidden.yaml").unlink()
    with pytest.raises(SurefootError, match=r"hidden\.yaml: can't be read: No such file"):
        ROBOTS.check_settings(folder)
