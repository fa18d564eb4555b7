"""The live display, in a process of its own: drawing can never make the control loop wait.

The loop's process writes one line of JSON for each telling into a pipe that never blocks; what the pipe does not take
is dropped. `python -m surefoot.deploy.display` reads the lines and draws.
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
from collections.abc import Iterable, Sequence
from typing import Any, TextIO

import numpy as np

from surefoot.deploy.loop import RunMonitor, Snapshot

WINDOW = 1000
"""Steps over which the display tells lateness."""
_SCALE = 1e3


class LiveDisplay(RunMonitor):
    """Starts the display's process and feeds it.

    Args:
        title: of the display.
        module: what is run as the process; it ends with its input.
        stdout: of the process; this process's, if None.
    """

    def __init__(self, title: str, module: str = "surefoot.deploy.display", stdout: int | None = None) -> None:
        command = [sys.executable, "-m", module]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout)
        if (stdin := self._process.stdin) is None:
            raise RuntimeError("the display has no pipe")
        self._stdin, self._pipe = stdin, stdin.fileno()
        os.set_blocking(self._pipe, False)
        self._send(title=title)

    def _send(self, **message: Any) -> None:
        # Up to 4096 bytes a pipe takes whole or not at all. A display that is gone is no reason to stop.
        with contextlib.suppress(OSError):
            os.write(self._pipe, json.dumps(message).encode()[:4095] + b"\n")

    def phase(self, name: str, duration: float) -> None:
        """Tell what the robot does."""
        self._send(phase=name, left=duration)

    def warn(self, text: str) -> None:
        """Tell something that the operator should know."""
        self._send(warning=text)

    def recording(self, text: str) -> None:
        """Tell how recording goes."""
        self._send(recording=text)

    def tick(self, snapshot: Snapshot) -> None:
        """Tell how the loop does."""
        self._send(**self._about(snapshot))

    def _about(self, snapshot: Snapshot) -> dict[str, Any]:
        state = snapshot.state
        return {
            "phase": snapshot.phase,
            "left": round(snapshot.left, 1),
            "rate": round(snapshot.rate, 1),
            "lateness": [round(_SCALE * late, 3) for late in snapshot.lateness],
            "inference": None if math.isnan(snapshot.inference) else round(_SCALE * snapshot.inference, 3),
            "missed": snapshot.missed,
            "dropped": snapshot.dropped,
            "state_age": round(_SCALE * snapshot.state_age, 2),
            "voltage": round(state.voltage, 2),
            "temperature": float(np.max(state.temperature)),
            "roll": round(float(state.roll_pitch_yaw[0]), 3),
            "pitch": round(float(state.roll_pitch_yaw[1]), 3),
        }

    def close(self) -> None:
        """End the display; its last picture stays on the terminal."""
        with contextlib.suppress(OSError):
            self._stdin.close()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()


class RunMonitors(RunMonitor):
    """Several that monitor the same run; told as often as the first wants it."""

    def __init__(self, *monitors: RunMonitor) -> None:
        self._monitors, self.period = monitors, monitors[0].period

    def phase(self, name: str, duration: float) -> None:
        """Tell all what the robot does."""
        for monitor in self._monitors:
            monitor.phase(name, duration)

    def tick(self, snapshot: Snapshot) -> None:
        """Tell all how the loop does."""
        for monitor in self._monitors:
            monitor.tick(snapshot)

    def warn(self, text: str) -> None:
        """Tell all something that the operator should know."""
        for monitor in self._monitors:
            monitor.warn(text)

    def recording(self, text: str) -> None:
        """Tell all how recording goes."""
        for monitor in self._monitors:
            monitor.recording(text)

    def close(self) -> None:
        """It is over for all."""
        for monitor in self._monitors:
            monitor.close()


class PlainLines(RunMonitor):
    """A line for each phase and warning, for everything that is no terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr

    def _say(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=self._stream, flush=True)

    def phase(self, name: str, duration: float) -> None:
        """Tell what the robot does."""
        self._say(f"surefoot: {name}" + (f" ({duration:.1f} s)" if duration > 0 else ""))

    def warn(self, text: str) -> None:
        """Tell something that the operator should know."""
        self._say(f"surefoot: warning: {text}")

    def recording(self, text: str) -> None:
        """Tell how recording goes."""
        if text:
            self._say(f"surefoot: {text}")


def open_display(title: str, stream: TextIO | None = None) -> LiveDisplay | PlainLines:
    """Return a live display on a terminal, plain lines on any other stream; standard error, if none is given."""
    return LiveDisplay(title) if (stream or sys.stderr).isatty() else PlainLines(stream)


class StatusPanel:
    """What the display shows, from the messages that came."""

    def __init__(self) -> None:
        self.now: dict[str, Any] = {"phase": "", "title": "", "recording": ""}
        self.warnings: list[str] = []
        self._lateness: deque[float] = deque(maxlen=WINDOW)

    def take(self, message: dict[str, Any]) -> None:
        """Take a message."""
        self._lateness.extend(message.pop("lateness", ()))
        if "warning" in message:
            self.warnings.append(str(message.pop("warning")))
        self.now.update(message)

    def rows(self) -> list[tuple[str, str]]:
        """Name and text of each line."""
        now = self.now

        def text(key: str, form: str, unit: str) -> str:
            value = now.get(key)
            return "-" if value is None else f"{value:{form}} {unit}".rstrip()

        late = "-"
        if self._lateness:
            median, high, most = np.percentile(self._lateness, (50, 99, 100))
            late = f"{median:.2f} median, {high:.2f} 99 %, {most:.2f} max ms"
        return [
            ("phase", f"{now['phase']}, {now.get('left', 0.0):.1f} s left" if now.get("left") else str(now["phase"])),
            ("loop", text("rate", ".1f", "Hz")),
            ("lateness", late),
            ("inference", text("inference", ".2f", "ms")),
            ("missed steps", text("missed", "d", "")),
            ("lost frames", text("dropped", "d", "")),
            ("state age", text("state_age", ".1f", "ms")),
            ("battery", text("voltage", ".1f", "V")),
            ("hottest motor", text("temperature", ".0f", "degC")),
            ("roll, pitch", f"{text('roll', '+.2f', '')}, {text('pitch', '+.2f', 'rad')}"),
            ("recording", str(now["recording"]).removeprefix("recording ") or "-"),
        ]

    def draw(self) -> Any:
        """As Rich shows it."""
        from rich.console import Group
        from rich.panel import Panel
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for name, value in self.rows():
            table.add_row(Text(name, style="dim"), Text(value))
        parts: Sequence[Any] = [table, *(Text(f"! {text}", style="yellow") for text in self.warnings[-4:])]
        return Panel(Group(*parts), title=Text(str(self.now["title"])), title_align="left", width=64)


def show(lines: Iterable[str], stream: TextIO) -> None:
    """Draw on a terminal what messages tell until they end; a line that is no JSON object is passed over."""
    from rich.console import Console

    from surefoot.progress import ProgressDisplay

    picture = StatusPanel()
    with ProgressDisplay(Console(file=stream, force_terminal=True), picture.draw) as display:
        for line in lines:
            try:
                message = json.loads(line)
            except ValueError:
                continue
            if isinstance(message, dict):
                picture.take(message)
                display.refresh()


def main() -> None:
    """Run the display's process: it ends with its input, whatever signals its terminal sends."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(10)
    with contextlib.suppress(OSError, ValueError):
        show(sys.stdin, sys.stderr)


if __name__ == "__main__":
    main()
