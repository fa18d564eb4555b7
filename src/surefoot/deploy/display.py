"""Live display of a run in a separate process, so that drawing never delays the control loop.

The process of the loop writes each event as a line of JSON into a non-blocking pipe; events are dropped if the pipe is
full. `python -m surefoot.deploy.display` reads the lines and draws.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, TextIO

import numpy as np

from surefoot.deploy.loop import RunMonitor, Snapshot

LATENESS_WINDOW = 1000
"""Number of control steps over which the display shows the lateness."""


class LiveDisplay(RunMonitor):
    """Monitor that starts a display process and sends it the events of the run.

    Args:
        title: title of the display.
        module: module that the process runs until its input ends.
        stdout: standard output of the process.
    """

    shows_speed = True

    def __init__(self, title: str, module: str = "surefoot.deploy.display", stdout: int | None = None) -> None:
        command = [sys.executable, "-m", module]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout)
        assert self._process.stdin is not None
        self._stdin = self._process.stdin
        os.set_blocking(self._stdin.fileno(), False)
        self._send(title=title)

    def _send(self, **message: Any) -> None:
        # Writes of up to 4096 bytes are atomic. If the display has ended, the run continues.
        with contextlib.suppress(OSError):
            os.write(self._stdin.fileno(), json.dumps(message).encode()[:4095] + b"\n")

    def phase(self, name: str, duration: float) -> None:
        """Show the phase of the run."""
        self._send(phase=name, left=duration)

    def warn(self, text: str) -> None:
        """Show a warning."""
        self._send(warning=text)

    def recording(self, text: str) -> None:
        """Show a message about the recording."""
        self._send(recording=text)

    def tick(self, snapshot: Snapshot) -> None:
        """Show the status of the control loop."""
        self._send(**self._message(snapshot))

    def _message(self, snapshot: Snapshot) -> dict[str, Any]:
        state = snapshot.state
        return {
            "phase": snapshot.phase,
            "left": round(snapshot.left, 1),
            "rate": round(snapshot.rate, 1),
            "lateness": [round(1e3 * late, 3) for late in snapshot.lateness],
            "inference": None if math.isnan(snapshot.inference) else round(1e3 * snapshot.inference, 3),
            "missed": snapshot.missed,
            "dropped": snapshot.dropped,
            "state_age": round(1e3 * snapshot.state_age, 2),
            "voltage": round(state.voltage, 2),
            "temperature": float(np.max(state.temperature)),
            "roll": round(float(state.roll_pitch_yaw[0]), 3),
            "pitch": round(float(state.roll_pitch_yaw[1]), 3),
            "speed": None if snapshot.speed is None else [round(one, 2) for one in snapshot.speed],
        }

    def close(self) -> None:
        """End the display; its last output stays on the terminal."""
        with contextlib.suppress(OSError):
            self._stdin.close()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()


class PlainLines(RunMonitor):
    """Monitor that prints a line on standard error for each phase and warning, for use without a terminal.

    As the first of two base classes, it also forwards each call to the second.
    """

    def phase(self, name: str, duration: float) -> None:
        """Print the phase of the run."""
        _print_line(name + (f" ({duration:.1f} s)" if duration > 0 else ""))
        super().phase(name, duration)

    def warn(self, text: str) -> None:
        """Print a warning."""
        _print_line(f"warning: {text}")
        super().warn(text)

    def recording(self, text: str) -> None:
        """Print a message about the recording."""
        _print_line(text)
        super().recording(text)


def _print_line(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(f"surefoot: {text}", file=sys.stderr, flush=True)


def open_display(title: str) -> LiveDisplay | PlainLines:
    """Return a live display if standard error is a terminal, plain lines otherwise."""
    return LiveDisplay(title) if sys.stderr.isatty() else PlainLines()


class StatusPanel:
    """Content of the display, updated by the messages of a `LiveDisplay`."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {"phase": "", "title": "", "recording": ""}
        self.warnings: list[str] = []
        self._lateness: deque[float] = deque(maxlen=LATENESS_WINDOW)

    def update(self, message: dict[str, Any]) -> None:
        """Process a message."""
        self._lateness.extend(message.pop("lateness", ()))
        if "warning" in message:
            self.warnings.append(str(message.pop("warning")))
        self.values.update(message)

    def rows(self) -> list[tuple[str, str]]:
        """Return the name and value of each line."""
        values = self.values

        def text(key: str, form: str, unit: str) -> str:
            value = values.get(key)
            return "-" if value is None else f"{value:{form}} {unit}".rstrip()

        late = "-"
        if self._lateness:
            median, high, maximum = np.percentile(self._lateness, (50, 99, 100))
            late = f"{median:.2f} median, {high:.2f} 99 %, {maximum:.2f} max ms"
        speed = "-"
        if values.get("speed") is not None:
            forward, left, distance = values["speed"]
            speed = f"{forward:.2f} forward, {left:+.2f} left m/s, {distance:.1f} m"
        return [
            ("phase", str(values["phase"]) + (f", {values['left']:.1f} s left" if values.get("left") else "")),
            ("loop", text("rate", ".1f", "Hz")),
            ("lateness", late),
            ("inference", text("inference", ".2f", "ms")),
            ("missed steps", text("missed", "d", "")),
            ("lost frames", text("dropped", "d", "")),
            ("state age", text("state_age", ".1f", "ms")),
            ("battery", text("voltage", ".1f", "V")),
            ("hottest motor", text("temperature", ".0f", "degC")),
            ("roll, pitch", f"{text('roll', '+.2f', '')}, {text('pitch', '+.2f', 'rad')}"),
            ("estimated speed", speed),
            ("recording", str(values["recording"]).removeprefix("recording ") or "-"),
        ]

    def draw(self) -> Any:
        """Return the content as a Rich panel."""
        from rich.console import Group
        from rich.panel import Panel
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for name, value in self.rows():
            table.add_row(Text(name, style="dim"), Text(value))
        warnings = [Text(f"! {text}", style="yellow") for text in self.warnings[-4:]]
        return Panel(Group(table, *warnings), title=Text(str(self.values["title"])), title_align="left", width=64)


def read_messages(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """Yield the messages of a `LiveDisplay`; invalid lines are skipped."""
    for line in lines:
        with contextlib.suppress(ValueError):
            message = json.loads(line)
            if isinstance(message, dict):
                yield message


def draw_messages(lines: Iterable[str], stream: TextIO) -> None:
    """Draw the messages of a run on a terminal until they end."""
    from rich.console import Console

    from surefoot.progress import ProgressDisplay

    panel = StatusPanel()
    with ProgressDisplay(Console(file=stream, force_terminal=True), panel.draw) as display:
        for message in read_messages(lines):
            panel.update(message)
            display.refresh()


def run_in_background() -> None:
    """Ignore signals of the terminal, since the process ends with its input, and use a low priority."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(10)


def main() -> None:
    """Run the display process."""
    run_in_background()
    with contextlib.suppress(OSError, ValueError):
        draw_messages(sys.stdin, sys.stderr)


if __name__ == "__main__":
    main()
