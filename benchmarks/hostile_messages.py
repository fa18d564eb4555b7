"""Invalid messages to pages, generated at random from a grammar of their keys, for `fuzz.py` and tests of pages."""

from __future__ import annotations

import json
import random
import time
from dataclasses import fields

from websockets import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from surefoot.errors import SurefootError
from surefoot.report.pages.messages import DeployMessage, DriveMessage, TabMessage, read_message
from surefoot.robot.params import PARAMETERS
from surefoot.world.terrain import KINDS

LIMIT = 2000
"""Maximum length of a message in bytes; the page closes the connection of a tab that sends a longer one."""
ATOMS = (
    *("null", "true", "false", "0", "-1", "1", "0.5", "1e308", "-1e308", "1e999", "NaN", "-Infinity", "9" * 400),
    *('""', '"x"', '"\\u0000"', '"\\ud800"', '"../../etc/passwd"', '"flat"', '"stairs"', '"html"', '"motor_strength"'),
    *(
        f'"{"a" * 1500}"',
        "[]",
        "{}",
        "[[]]",
        "[{}]",
        '{"a": 1}',
        "[" * 300 + "]" * 300,
        '{"a":' * 200 + "1" + "}" * 200,
    ),
)
"""Values that are valid JSON, and some that are not."""
NUMBERS = ("0", "-0.0", "1", "-1", "0.5", "3", "0.1", "1e-300", "1e4", "-1e4", "1e15", "-1e15", "1e30")
TERRAINS = ("flat", *KINDS, "ice")
SHAPES: dict[str, tuple[tuple[str, ...], ...]] = {
    "command": (NUMBERS, NUMBERS, NUMBERS),
    "set": (tuple(json.dumps(name) for name in (*PARAMETERS, "imu_bias.roll")), NUMBERS),
    "push": (NUMBERS, NUMBERS, ("0.1", "0.3", "1", *NUMBERS)),
    "terrain": (tuple(map(json.dumps, TERRAINS)), NUMBERS),
}
"""Values of the right type, possibly out of range, by key; a message takes one from each list."""
FOREIGN = ('""', '"left"', '"__class__"', '"\\u0000"', '"\\ud800"', f'"{"k" * 1000}"', "1")
BROKEN = ("", "{", "\0", '{"set": [', b"\xff\xfe", b"\x00" * 50, "9" * 1900, "[" * 1900, "x" * 1_000_000)
"""Messages that are not JSON."""


def draw_value(rng: random.Random, depth: int = 0) -> str:
    """Return a random value of any type and size: an atom, a list or an object of values."""
    kind = rng.random()
    if kind < 0.5 or depth > 2:
        return rng.choice(ATOMS)
    values = [draw_value(rng, depth + 1) for _ in range(rng.randrange(6))]
    if kind < 0.85:
        return f"[{','.join(values)}]"
    return "{" + ",".join(f'"{k}": {value}' for k, value in enumerate(values)) + "}"


def draw_message(rng: random.Random, kind: type[TabMessage]) -> str | bytes:
    """Return a random message, with keys that the page knows or without."""
    form = rng.random()
    if form < 0.1:
        return rng.choice(BROKEN)
    if form < 0.3 and (shapes := [item.name for item in fields(kind) if item.name in SHAPES]):
        name = rng.choice(shapes)
        return f'{{"{name}": [{",".join(map(rng.choice, SHAPES[name]))}]}}'
    keys = [f'"{item.name}"' for item in fields(kind)]
    names = rng.choices([*keys, *keys, *FOREIGN], k=rng.choice((1, 1, 1, 2, 3)))
    return "{" + ",".join(f"{name}: {draw_value(rng)}" for name in names) + "}"


def open_tab(address: str, patience: float = 20.0) -> ClientConnection:
    """Connect to the page at an address as the tab that drives."""
    host, end = address.split("/")[2], time.monotonic() + patience
    tab = connect(f"ws://{host}/socket", origin=f"http://{host}", open_timeout=patience, close_timeout=0.2)  # type: ignore[arg-type]
    while not json.loads(tab.recv(timeout=max(end - time.monotonic(), 0.0))).get("driver"):
        pass
    return tab


def send_messages(address: str, kind: type[TabMessage], rng: random.Random, count: int, patience: float) -> str:
    """Send random messages to a page, each followed by a valid command, until one asks the robot to stop.

    Returns:
        A description of the failure; empty if the page acts on each valid command within `patience` [s].
    """
    text: str | bytes = ""
    try:
        tab = open_tab(address, patience)
        for number in range(count):
            text = draw_message(rng, kind)
            tab.send(text)
            if len(text) > LIMIT:
                _await_close(tab, patience)
                tab = open_tab(address, patience)
            elif _asks_to_stop(kind, text):
                break
            _steer(tab, kind, 0.1 + 0.4 * number / count, patience)
        tab.close()
    except (ConnectionClosed, OSError, TimeoutError) as error:
        shown = repr(text if len(text) < 200 else text[:200])
        return f"its page does not answer after the message {shown}: {type(error).__name__}: {error}"
    return ""


def _await_close(tab: ClientConnection, patience: float) -> None:
    """Read until the page closes a connection."""
    end = time.monotonic() + patience
    try:
        while True:
            tab.recv(timeout=max(end - time.monotonic(), 0.0))
    except ConnectionClosed:
        return


def _asks_to_stop(kind: type[TabMessage], text: str | bytes) -> bool:
    """Return whether a message makes the robot sit down or damp its motors."""
    try:
        message = read_message(kind, text)
    except SurefootError:
        return False
    return isinstance(message, DeployMessage) and bool(message.stop or message.damp)


def _steer(tab: ClientConnection, kind: type[TabMessage], speed: float, patience: float) -> None:
    """Send a speed [m/s], and read until the page reports it as the robot's command.

    Raises:
        TimeoutError: it does not report it within `patience` [s].
    """
    runs = {"pause": False} if kind is DriveMessage else {}
    again, end = 0.0, time.monotonic() + patience
    while (now := time.monotonic()) < end:
        if now > again:  # a robot's page forgets a command after a second
            tab.send(json.dumps({"command": [speed, 0, 0], **runs}))
            again = now + 0.5
        command = json.loads(tab.recv(timeout=end - now)).get("report", {}).get("command") or [0.0]
        if abs(command[0] - speed) < 1e-3:
            return
    raise TimeoutError("no command acts")
