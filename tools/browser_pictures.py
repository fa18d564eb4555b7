"""Take screenshots of surefoot's pages with a real browser: PYTHONPATH=tests python tools/browser_pictures.py."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chromium import hold_stick, running_browser

FOLDER = Path(__file__).resolve().parents[1] / "docs"
SUREFOOT = (sys.executable, "-m", "surefoot")
WIDE = {"width": 1280, "height": 800}
LOADING = 4
"""Screenshots, 5 s apart, while a browser without graphics hardware loads the stairs; a hidden page does not."""


@contextmanager
def running(*words: str) -> Iterator[str]:
    """Run a command; yield the address or port in its first line of output."""
    process = subprocess.Popen([*SUREFOOT, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        yield (re.findall(r"http\S+|/dev/\S+", line) or [line])[0]
    finally:
        process.terminate()
        process.wait()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, running_browser(gives_way=Path(folder)) as browser:
        with running("drive", "go2-terrain", "--terrain", "stairs:0.10", "--page-port", "0") as address:
            page = browser.new_page(viewport=WIDE)
            page.goto(address)
            page.wait_for_function("document.getElementById('state').textContent.includes('m/s')")
            for _ in range(LOADING):
                page.wait_for_timeout(5000)
                page.screenshot()
            hold_stick(page, 0.25, 0.0)
            page.wait_for_timeout(5500)
            page.screenshot(path=FOLDER / "drive-wide.png")
            page.close()
        with running("emulate", "--robot", "go2", "--set", "servo_kp=40", "servo_kd=1") as port:
            words = [*("--port", port, "--browser", "--page-port", "0", "--out", folder)]
            with running("deploy", "go2-steer", *words) as address:
                page = browser.new_page(viewport=WIDE)
                page.goto(address)
                page.wait_for_function("document.getElementById('state').textContent.startsWith('run')", timeout=90_000)
                hold_stick(page, 0.28, 0.16)
                page.wait_for_timeout(9000)
                page.screenshot(path=FOLDER / "deploy-page.png")
        traces = [Path(folder) / f"go2-terrain, {world}.npz" for world in ("mujoco", "bullet")]
        for trace in traces:
            world = trace.stem.rpartition(" ")[2]
            words = ["--world", world, "--terrain", "stairs:0.10", "--command", "0.5", "0", "0", "--episodes", "1"]
            words += ["--push-force", "80", "120", "--duration", "6", "--out", str(trace.with_suffix(""))]
            subprocess.run([*SUREFOOT, "evaluate", "go2-terrain", *words], check=True)
            (trace.with_suffix("") / "episode_000.npz").rename(trace)
        written = Path(folder) / "show.html"
        subprocess.run([*SUREFOOT, "show", *traces, "--out", written], check=True)
        page = browser.new_page(viewport={"width": 1184, "height": 660})
        page.goto(written.as_uri())
        page.wait_for_function("document.body.dataset.ready === 'yes'")
        page.evaluate("playing = false; setTime(3.62)")
        page.wait_for_timeout(4000)
        page.screenshot(path=FOLDER / "show.png")
