"""Commands: their groups, former names, and subcommands."""

from __future__ import annotations

import importlib

import pytest
from processes import assert_rejected, surefoot

from surefoot.cli import identify, robot, robot_firmware, study
from surefoot.cli.main import COMMANDS, GROUPS, RENAMED_COMMANDS

ACTIONS = {
    "evaluate": {"sensitivity"},
    "identify": {**identify.ACTIONS, **dict.fromkeys(identify.EXPERIMENTS)},
    "robot": robot.ACTIONS,
    "robot firmware": robot_firmware.ACTIONS,
    "study": study.ACTIONS,
}


@pytest.mark.parametrize("name", RENAMED_COMMANDS)
def test_a_renamed_command_names_its_replacement(name: str):
    done = surefoot(name, "x", "--help")
    assert_rejected(done, f"'{name}' is not a command any more; use surefoot ")
    assert name not in COMMANDS
    for text in RENAMED_COMMANDS[name].split("surefoot ")[1:]:
        command, *rest = text.split()
        assert command in COMMANDS
        assert not rest or rest[0].isupper() or rest[0] in ACTIONS[command]


def test_the_usage_lists_every_command_in_its_group():
    usage = surefoot("--help").stdout
    assert surefoot().stderr == usage
    assert usage.index("\npolicies:\n  train ") < usage.index("\nwatching:\n") < usage.index("\nresearch:\n")
    for title, group in GROUPS.items():
        section = usage.split(f"{title}:\n")[1].split("\n\n")[0].splitlines()
        assert [line.split()[0] for line in section] == list(group)
    assert len(COMMANDS) == sum(map(len, GROUPS.values()))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_module(name: str):
    assert callable(importlib.import_module(f"surefoot.cli.{name}").main)


@pytest.mark.parametrize("command", ["robot", "robot firmware", "study"])
def test_a_command_with_subcommands_lists_them(command: str):
    done, silent = surefoot(*command.split(), "--help"), surefoot(*command.split())
    assert (done.returncode, silent.returncode) == (0, 2)
    assert done.stdout == silent.stderr
    assert done.stdout.startswith(f"usage: surefoot {command} ACTION ...\n")
    assert [line.split()[0] for line in done.stdout.splitlines() if line.startswith("  ")] == list(ACTIONS[command])
