"""Chromium without a window: the system's, or one that Playwright has fetched. Without it, its tests are skipped.

`python tests/chromium.py` has Playwright fetch one, if there is none.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

in_browser = pytest.mark.browser
INSTALL = (sys.executable, "-m", "playwright", "install", "chromium")
_FETCH_TIMEOUT = 300
"""Longest time [s] of a download."""


@functools.cache
def find_chromium() -> str | None:
    """Return the path of a Chromium that runs; None if there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if path := shutil.which(name):
            return path
    with contextlib.suppress(ImportError, OSError, subprocess.SubprocessError):
        from playwright.sync_api import sync_playwright

        with sync_playwright() as playwright:
            path = playwright.chromium.executable_path
        # One that lacks libraries of the system does not even print its version.
        subprocess.run([path, "--version"], check=True, capture_output=True, timeout=30)
        return path
    return None


def chromium_missing() -> str:
    """Return how to get a Chromium; nothing, if there is one."""
    if find_chromium() is not None:
        return ""
    python = os.path.relpath(INSTALL[0])
    command = " ".join([python if not python.startswith("..") else INSTALL[0], *INSTALL[1:]])
    return f"no Chromium on this computer; this installs it: {command}"


@contextmanager
def running_browser(gives_way: Path | None = None) -> Iterator[Browser]:
    """Start Chromium, and end it.

    Args:
        gives_way: folder for a script that starts it with low priority, for tests with a control loop beside it:
            Chromium draws in software.
    """
    from playwright.sync_api import sync_playwright

    program = find_chromium()
    if gives_way is not None:
        script = gives_way / "chromium"
        script.write_text(f'#!/bin/sh\nexec nice -n 15 {program} "$@"\n')
        script.chmod(0o755)
        program = str(script)
    with sync_playwright() as playwright:
        words = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=program, args=words)
        yield browser
        browser.close()


def new_page(browser: Browser, width: int, height: int, view: bool = True) -> Page:
    """Return a small tab, which is drawn in software here, with patience for a busy computer.

    Args:
        view: with the 3D view; drawn by all processors, it takes the time that a control loop or training beside needs.
    """
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(120_000)
    if not view:
        page.route("**/view?*", lambda route: route.fulfill(body="", content_type="text/html"))
    return page


def errors_of(page: Page) -> list[str]:
    """Return a list that collects the errors of a tab from now on."""
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    return errors


def hold_stick(page: Page, forward: float, left: float) -> None:
    """Press the mouse on the page's joystick and move it by shares of its width; `page.mouse.up()` lets go."""
    page.locator("#stick").scroll_into_view_if_needed()
    box = page.locator("#stick").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - left * box["width"], y - forward * box["height"])


def main() -> None:
    """Fetch a Chromium, if there is none and its server can be reached."""
    if find_chromium() is not None:
        return
    print("surefoot: fetching Chromium for the tests of pages, once", flush=True)
    environment = os.environ | {"PLAYWRIGHT_DOWNLOAD_CONNECTION_TIMEOUT": "5000"}  # [ms]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        subprocess.run(INSTALL, capture_output=True, timeout=_FETCH_TIMEOUT, env=environment)
    find_chromium.cache_clear()
    if find_chromium() is None:
        print("surefoot: no Chromium could be fetched; tests of pages are left out")


if __name__ == "__main__":
    main()
