"""Headless Chromium, from the system or downloaded by Playwright. Without it, browser tests are skipped.

`python tests/chromium.py` downloads Chromium with Playwright if there is none.
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
"""Timeout of the download [s]."""


@functools.cache
def find_chromium() -> str | None:
    """Return the path of a working Chromium, or None."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if path := shutil.which(name):
            return path
    with contextlib.suppress(ImportError, OSError, subprocess.SubprocessError):
        from playwright.sync_api import sync_playwright

        with sync_playwright() as playwright:
            path = playwright.chromium.executable_path
        # A Chromium that lacks system libraries does not even print its version.
        subprocess.run([path, "--version"], check=True, capture_output=True, timeout=30)
        return path
    return None


def chromium_missing() -> str:
    """Return instructions to install Chromium; empty if it is installed."""
    if find_chromium() is not None:
        return ""
    python = os.path.relpath(INSTALL[0])
    command = " ".join([python if not python.startswith("..") else INSTALL[0], *INSTALL[1:]])
    return f"no Chromium on this computer; this installs it: {command}"


@contextmanager
def running_browser(gives_way: Path | None = None) -> Iterator[Browser]:
    """Context manager that runs Chromium.

    Args:
        gives_way: folder for a script that starts it with low priority, for tests that also run a control loop, since
            Chromium renders in software.
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
    """Return a small tab with long timeouts for a busy computer.

    Args:
        view: show the 3D view, which is rendered in software and would slow down a control loop or training.
    """
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(120_000)
    if not view:
        page.route("**/view?*", lambda route: route.fulfill(body="", content_type="text/html"))
    return page


def errors_of(page: Page) -> list[str]:
    """Return a list to which a tab's future errors are appended."""
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    return errors


def hold_stick(page: Page, forward: float, left: float) -> None:
    """Press the mouse on the joystick, and move it by fractions of its width; `page.mouse.up()` releases it."""
    page.locator("#stick").scroll_into_view_if_needed()
    box = page.locator("#stick").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - left * box["width"], y - forward * box["height"])


def main() -> None:
    """Download Chromium if there is none and the server can be reached."""
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
