"""A real browser: Chromium of the system's packages, without a window; tests that need one are skipped without it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
in_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this computer; the page is not tried in one")


@contextmanager
def running_browser(gives_way: Path | None = None) -> Iterator[Browser]:
    """Start Chromium, and end it.

    Args:
        gives_way: folder for a script that starts it with low priority, where a control loop runs beside it: it draws
            with the processor here.
    """
    from playwright.sync_api import sync_playwright

    program = CHROMIUM
    if gives_way is not None:
        script = gives_way / "chromium"
        script.write_text(f'#!/bin/sh\nexec nice -n 15 {CHROMIUM} "$@"\n')
        script.chmod(0o755)
        program = str(script)
    with sync_playwright() as playwright:
        words = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=program, args=words)
        yield browser
        browser.close()


def errors_of(page: Page) -> list[str]:
    """Return a list that gets what goes wrong in a tab from now on."""
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    return wrong


def hold_stick(page: Page, forward: float, left: float) -> None:
    """Press the mouse on the page's joystick and move it by shares of its width; `page.mouse.up()` lets go."""
    page.locator("#stick").scroll_into_view_if_needed()
    box = page.locator("#stick").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - left * box["width"], y - forward * box["height"])
