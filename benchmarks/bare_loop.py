"""Idle loop that runs during a real-time measurement, to measure interruptions by the computer itself."""

from __future__ import annotations

import json
import subprocess
import sys


class BareLoop:
    """Process with the board's priority that only wakes up every 2 ms; its gaps are the computer's own delays."""

    _PROGRAM = """if True:
        import json, sys, threading, time
        from surefoot.deploy.pacer import BOARD_PRIORITY, real_time_priority
        ended, gaps = threading.Event(), []
        threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
        with real_time_priority(BOARD_PRIORITY):
            due = last = time.monotonic()
            while not ended.is_set():
                due = max(due + 0.002, last)
                time.sleep(max(due - time.monotonic(), 0.0))
                now = time.monotonic()
                gaps.append(1e3 * (now - last))
                last = now
        gaps.sort()
        print(json.dumps({"bare_p99_ms": gaps[int(0.99 * len(gaps))], "bare_max_ms": gaps[-1]}))
    """

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", self._PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def end(self) -> dict[str, float]:
        """End the process; return the 99th percentile and the maximum time between wake-ups [ms]."""
        summary: dict[str, float] = json.loads(self._process.communicate()[0])
        return summary
