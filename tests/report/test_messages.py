"""Messages from tabs: keys that a page accepts, and messages that are rejected in one line."""

from __future__ import annotations

import dataclasses

import pytest

from surefoot.errors import SurefootError
from surefoot.report.pages.messages import DeployMessage, DriveMessage, TabMessage, read_message


def given(message: TabMessage) -> dict[str, object]:
    """Return the keys in a message."""
    return {name: value for name, value in dataclasses.asdict(message).items() if value is not None}


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ('{"command": [0.5, 0, -1], "moved": 1.8e12}', {"command": (0.5, 0.0, -1.0), "moved": 1.8e12}),
        ('{"set": ["motor_strength", 1]}', {"set": ("motor_strength", 1.0)}),
        ('{"push": [100, 90, 0.3]}', {"push": (100.0, 90.0, 0.3)}),
        ('{"pause": false, "restart": true}', {"pause": False, "restart": True}),
        ('{"terrain": ["flat"]}', {"terrain": ("flat",)}),
        ('{"terrain": ["stairs", 0.1], "ghost": ""}', {"terrain": ("stairs", 0.1), "ghost": ""}),
    ],
)
def test_a_page_accepts_its_own_keys(text: str, values: dict[str, object]):
    assert given(read_message(DriveMessage, text)) == values


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('{"set": []}', r"set is \[\]; it must be a list of 2 values: text, a number"),
        ('{"set": {}}', r"set is \{\}; it must be a list of 2 values"),
        ('{"set": ""}', r"set is ''; it must be"),
        ('{"set": {"a": 1}}', r"set is \{'a': 1\}; it must be"),
        ('{"command": {}}', r"command is \{\}; it must be a list of 3 values, each a number"),
        (f'{{"command": [{"9" * 400}, 0, 0]}}', r"command is \[9+\.\.\.9+, 0, 0\]; it must be"),
        ('{"command": [1e999, 0, 0]}', r"command\[0\] is inf; it must be 1e\+15 or less"),
        ('{"command": [NaN, 0, 0]}', "message is not JSON: NaN is not a number"),
        ('{"push": [20000, 0, 0.1]}', r"push\[0\] is 20000; it must be 10000 or less"),
        ('{"pause": 1}', "pause is 1; it must be true or false"),
        ('{"restart": 1}', "restart is 1; it must be True"),
        ('{"pause": null}', r"message is \{'pause': None\}; it must be an object"),
        ('{"policy": "a\\u0000b"}', "without NUL"),
        ('{"sett": 1}', r"sett is not a key; did you mean set\?"),
        ('{"\\u0000": 1}', r"'\\x00' is not a key"),
        ('{"stop": true}', "stop is not a key"),
        ("{}", r"message is \{\}; it must be an object"),
        ("3", "message is 3; it must be an object"),
        ("[" * 900 + "]" * 900, r"message is \[\[\[\[\.\.\.\]\]\]\]"),
        ("[" * 99_999, "message is not JSON"),
        ("9" * 5000, "message is not JSON"),
        (b"\xff\xfe\x00", "message is not JSON"),
        ("", "message is not JSON"),
    ],
)
def test_other_messages_are_rejected_with_value_and_rule(text: str | bytes, error: str):
    with pytest.raises(SurefootError, match=error):
        read_message(DriveMessage, text)


def test_the_page_of_a_robot_accepts_only_commands_and_two_buttons():
    assert read_message(DeployMessage, '{"stop": true}').stop
    assert read_message(DeployMessage, '{"damp": true}').damp
    with pytest.raises(SurefootError, match="stop is False"):
        read_message(DeployMessage, '{"stop": false}')
    with pytest.raises(SurefootError, match="set is not a key; choices: command, moved, stop, damp"):
        read_message(DeployMessage, '{"set": ["motor_strength", 1]}')
