"""Speed of the `surefoot drive` page: frames per second, delay from joystick to command, real-time factor.

Headless Chromium, which renders in software, moves the joystick. Both run on this machine and share its cores.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import threading
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from surefoot.api.drive_page import DrivePage
from surefoot.report.pages.server import PageServer
from surefoot.report.pages.view import RobotView

_COUNT = "window.pictures = 0; const count = () => { ++window.pictures; requestAnimationFrame(count); }; count()"


def held(tabs: list[Page]) -> str:
    """Return the memory of this process and of the pages' scripts as text."""
    pages = [int(tab.evaluate("performance.memory.usedJSHeapSize")) / 1e6 for tab in tabs]
    resident = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS"))
    return f"{int(resident.split()[1]) / 1e3:.0f} MB; scripts of the tabs {', '.join(f'{one:.0f} MB' for one in pages)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", default="go2-steer", help="without commands, there is no delay to measure")
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--tabs", type=int, default=1)
    parser.add_argument(
        "--hours", type=float, default=0.0, help="hours to simulate afterwards at full speed, to measure memory"
    )
    options = parser.parse_args()
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        raise SystemExit("no Chromium on this computer")
    drive, view, stop = DrivePage(options.policy, "mujoco"), RobotView(), threading.Event()
    page = PageServer(None, 0, view.port)
    thread = threading.Thread(target=drive.run, args=(page, view, stop))
    thread.start()
    with sync_playwright() as playwright:
        words = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=path, args=words)
        tabs = [browser.new_page(viewport={"width": 600, "height": 420}) for _ in range(options.tabs)]
        for tab in tabs:
            tab.goto(page.address)
            tab.wait_for_function("document.getElementById('state').textContent.includes('m/s')")
        box = tabs[0].locator("#stick").bounding_box()
        assert box is not None
        x, y, reach = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, 0.4 * box["width"]
        tabs[0].mouse.move(x, y)
        tabs[0].mouse.down()
        tabs[0].evaluate(_COUNT)
        drive.delays.clear()
        begin, sent, simulated = time.perf_counter(), view.frames, drive.robot.time
        while (passed := time.perf_counter() - begin) < options.duration:
            tabs[0].mouse.move(x + reach * math.sin(passed), y - reach * math.cos(passed))
            time.sleep(0.03)
        shown, passed = tabs[0].evaluate("window.pictures"), time.perf_counter() - begin
        kept, sent = (drive.robot.time - simulated) / passed, view.frames - sent
        memory = [held(tabs)]
        if options.hours:
            end, drive.speed = drive.robot.time + 3600.0 * options.hours, 1e6
            while drive.robot.time < end:
                tabs[0].mouse.move(x + reach * math.sin(time.time()), y - reach * math.cos(time.time()))
                time.sleep(0.03)
            memory.append(held(tabs))
        browser.close()
    stop.set()
    thread.join()
    page.stop()
    view.stop()
    delays = 1e3 * np.array(drive.delays)
    print(f"load of {os.cpu_count()} cores {os.getloadavg()[0]:.1f}, tabs {options.tabs}")
    print(f"frames sent: {sent / passed:.1f} /s, rendered in software: {shown / passed:.1f} /s")
    if delays.size:
        middle, late = np.quantile(delays, [0.5, 0.99])
        print(f"joystick to command, ms: median {middle:.1f}, 99 % {late:.1f}, of {len(delays)}")
    print(f"real-time factor {kept:.3f}")
    print("memory: " + f"; after {options.hours:g} h of simulated driving ".join(memory))


if __name__ == "__main__":
    main()
