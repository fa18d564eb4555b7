"""Report on the examination of an adopted policy: how it follows commands, and which mistake may explain it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from surefoot import __version__
from surefoot.adopt.diagnosis import FINAL_REPEATS, Diagnosis
from surefoot.adopt.examination import MAX_ERROR, MIN_GOOD_SCORE, TrialResult
from surefoot.check_result import CheckResult
from surefoot.files import atomic_write
from surefoot.report.pages import html

_MAX_CHANGES, _MIN_SCORE = 15, 0.05
"""Maximum number of changes on the page, and the minimum score of a listed change."""


def write_page(
    path: Path,
    name: str,
    world: str,
    diagnosis: Diagnosis,
    checks: Sequence[CheckResult],
    videos: Sequence[tuple[str, Path]],
) -> Path:
    """Write the report as a self-contained page.

    Args:
        path: file to write (.html).
        name: name of the policy.
        world: world in which it was simulated.
        diagnosis: diagnosis of the policy.
        checks: results of `check_answers`.
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
        f'<p class="quiet">Simulated in {escape(world)}, not run on a robot. surefoot {escape(__version__)}.</p>',
        f"<table>{''.join(rows)}</table>",
        "<h2>Changes tried</h2>",
        _tried(
            [
                diagnosis.baseline,
                *((diagnosis.with_true_velocity,) if diagnosis.with_true_velocity else ()),
                *diagnosis.variants,
                *(one for one in diagnosis.ranked[:_MAX_CHANGES] if one.score >= _MIN_SCORE),
            ],
            len(diagnosis.ranked),
        ),
        *_videos(videos),
    ]
    atomic_write(path, html.page(title, parts))
    return path


def _verdict(diagnosis: Diagnosis) -> str:
    """Return a sentence on how the policy follows commands, and on the change that is recommended."""
    own, mistake = diagnosis.baseline, diagnosis.mistake
    good, fell = int((own.scores >= MIN_GOOD_SCORE).sum()), int(own.fell.sum())
    text = (
        f"As it is, the policy follows {good} of {len(own.scores)} commands{f', and falls at {fell}' if fell else ''}."
    )
    if diagnosis.constants is not None:
        return f"{text} {diagnosis.constants.text}"
    if diagnosis.explaining_variant is not None and not diagnosis.is_confirmed:
        return f"{text} With {diagnosis.explaining_variant.text} it walks unchanged: its configuration may be right."
    if mistake is None or mistake.correction is None:
        return f"{text} No common mistake explains this." if good < len(own.scores) else text
    if not diagnosis.is_confirmed:
        return f"{text} A value is unusual, although it does not affect the motion. {mistake.correction.text}."
    after = int((mistake.scores >= MIN_GOOD_SCORE).sum())
    return f"{text} Most likely mistake: {mistake.correction.text}. With this correction it follows {after}."


def _tried(answers: Sequence[TrialResult], count: int) -> str:
    names = answers[0].commands
    rows = [html.row(("change", *names, "score"), f"t{'n' * len(names)}n", "th")]
    for answer in answers:
        scores = [f"{score:.2f}" for score in answer.scores]
        rows.append(html.row((answer.text, *scores, f"{answer.score:.2f}"), f"t{'n' * len(names)}n"))
    note = (
        f"{count} changes of the configuration, and other robots, were tried, each with one robot per command for some "
        f"commands. The best changes, listed here, were tried again with {FINAL_REPEATS} other robots per command; the "
        "first is the most likely. A change that leads to unusual values is less likely than its score. Score 1: "
        f"follows the command exactly; score 0: falls, or errs by {MAX_ERROR[0]:g} m/s forward, {MAX_ERROR[1]:g} m/s "
        f"sideways or {MAX_ERROR[2]:g} rad/s."
    )
    return f'<p class="quiet">{note}</p><div class="wide"><table>{"".join(rows)}</table></div>'


def _videos(videos: Sequence[tuple[str, Path]]) -> list[str]:
    parts = ["<h2>Videos</h2>", "<p>One robot receives all commands of the table in sequence.</p>"] if videos else []
    for title, path in videos:
        data = base64.b64encode(path.read_bytes()).decode()
        source = f'<video controls muted width="640" src="data:video/mp4;base64,{data}"></video>'
        parts.append(f"<figure>{source}<figcaption>{escape(title)}</figcaption></figure>")
    return parts
