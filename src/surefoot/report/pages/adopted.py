"""The page of an adopted policy's examination: how it follows commands, and which mistake explains it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from surefoot import __version__
from surefoot.adopt.examination import Answer, Diagnosis
from surefoot.check_result import CheckResult
from surefoot.files import atomic_write
from surefoot.report.pages import html

_LISTED = 15
"""Changes on the page."""


def write_page(
    path: Path,
    name: str,
    world: str,
    diagnosis: Diagnosis,
    checks: Sequence[CheckResult],
    videos: Sequence[tuple[str, Path]],
) -> Path:
    """Write the page, which loads nothing from elsewhere.

    Args:
        path: .html to write.
        name: the policy's.
        world: where it was simulated.
        diagnosis: of the policy.
        checks: what `check_answers` says.
        videos: titles and files (.mp4).
    """
    title = f"{name}: does it follow commands?"
    labels = {True: "pass", False: "FAIL", None: "not done"}
    rows = [html.row(("check", "", "result", "to do"), "tttt", "th")]
    for check in checks:
        rows.append(
            html.row((check.name, labels[check.passed], check.message, "" if check.passed else check.remedy), "tttt")
        )
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="quiet">Simulated in {escape(world)}; one robot for each command and each usual mistake. '
        f"No robot has run it. surefoot {escape(__version__)}.</p>",
        f"<table>{''.join(rows)}</table>",
        "<h2>What was tried</h2>",
        _tried([diagnosis.own, *diagnosis.ranked[:_LISTED]]),
        *_videos(videos),
    ]
    atomic_write(path, html.page(title, parts))
    return path


def _tried(answers: Sequence[Answer]) -> str:
    names = answers[0].commands
    rows = [html.row(("change", *names, "score"), f"t{'n' * len(names)}n", "th")]
    for answer in answers:
        text = "as it is" if answer.correction is None else answer.correction.text
        scores = [f"{score:.2f}" for score in answer.scores]
        rows.append(html.row((text, *scores, f"{answer.score:.2f}"), f"t{'n' * len(names)}n"))
    note = "Scores: 1 follows the command exactly; 0 falls, or errs by .5 m/s forward, .4 m/s sideways or .8 rad/s."
    return f'<p class="quiet">{note}</p><div class="wide"><table>{"".join(rows)}</table></div>'


def _videos(videos: Sequence[tuple[str, Path]]) -> list[str]:
    parts = ["<h2>Videos</h2>"] if videos else []
    for title, path in videos:
        data = base64.b64encode(path.read_bytes()).decode()
        source = f'<video controls muted width="640" src="data:video/mp4;base64,{data}"></video>'
        parts.append(f"<figure>{source}<figcaption>{escape(title)}</figcaption></figure>")
    return parts
