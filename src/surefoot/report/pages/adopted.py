"""The page of an adopted policy's examination: how it follows commands, and which mistake explains it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from surefoot import __version__
from surefoot.adopt.diagnosis import FINAL_REPEATS, Diagnosis
from surefoot.adopt.examination import GOOD, MAX_ERROR, Answer
from surefoot.check_result import CheckResult
from surefoot.files import atomic_write
from surefoot.report.pages import html

_LISTED, _SHOWN = 15, 0.05
"""Changes on the page at most, and the least score of one."""


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
        f"<p>{escape(_verdict(diagnosis))}</p>",
        f'<p class="quiet">Simulated in {escape(world)}; no robot has run it. surefoot {escape(__version__)}.</p>',
        f"<table>{''.join(rows)}</table>",
        "<h2>What was tried</h2>",
        _tried(
            [
                diagnosis.own,
                *diagnosis.guesses,
                *(one for one in diagnosis.ranked[:_LISTED] if one.score >= _SHOWN),
            ],
            len(diagnosis.ranked),
        ),
        *_videos(videos),
    ]
    atomic_write(path, html.page(title, parts))
    return path


def _verdict(diagnosis: Diagnosis) -> str:
    """Return in words how the policy follows commands, and what should be changed."""
    own, mistake = diagnosis.own, diagnosis.mistake
    good, fell = int((own.scores >= GOOD).sum()), int(own.fell.sum())
    text = (
        f"As it is, the policy follows {good} of {len(own.scores)} commands{f' and falls at {fell}' if fell else ''}."
    )
    if diagnosis.constants is not None:
        return f"{text} {diagnosis.constants.text}"
    if diagnosis.explained is not None and not diagnosis.is_confirmed:
        return f"{text} With {diagnosis.explained.text} it walks as it is: its configuration may be right."
    if mistake is None or mistake.correction is None:
        return f"{text} No usual mistake explains it." if good < len(own.scores) else text
    if not diagnosis.is_confirmed:
        return f"{text} A number is unusual, although robots do not show it. {mistake.correction.text}."
    after = int((mistake.scores >= GOOD).sum())
    return f"{text} Most likely mistake: {mistake.correction.text}. With that changed it follows {after}."


def _tried(answers: Sequence[Answer], count: int) -> str:
    names = answers[0].commands
    rows = [html.row(("change", *names, "score"), f"t{'n' * len(names)}n", "th")]
    for answer in answers:
        scores = [f"{score:.2f}" for score in answer.scores]
        rows.append(html.row((answer.text, *scores, f"{answer.score:.2f}"), f"t{'n' * len(names)}n"))
    note = (
        f"{count} changes of the configuration, and other robots, were tried, each with one robot for each of some "
        f"commands; the best again, those below, with {FINAL_REPEATS} other robots for each command. The most likely is the "
        "first; one that leads to unusual numbers is less likely than its score. Scores: 1 follows the command "
        f"exactly; 0 falls, or errs by {MAX_ERROR[0]:g} m/s forward, {MAX_ERROR[1]:g} m/s sideways or "
        f"{MAX_ERROR[2]:g} rad/s."
    )
    return f'<p class="quiet">{note}</p><div class="wide"><table>{"".join(rows)}</table></div>'


def _videos(videos: Sequence[tuple[str, Path]]) -> list[str]:
    parts = ["<h2>Videos</h2>", "<p>One robot is given all commands of the first table in turn.</p>"] if videos else []
    for title, path in videos:
        data = base64.b64encode(path.read_bytes()).decode()
        source = f'<video controls muted width="640" src="data:video/mp4;base64,{data}"></video>'
        parts.append(f"<figure>{source}<figcaption>{escape(title)}</figcaption></figure>")
    return parts
