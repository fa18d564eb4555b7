"""The report of an identification: one picture, and one page that holds everything."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from surefoot import __version__
from surefoot.files import atomic_write
from surefoot.identify.result import Identification, ParameterEstimate
from surefoot.report.figures.identification import cells, full_name, identification_figure
from surefoot.report.pages import html
from surefoot.robot import PhysicalParams, RobotDescription


def write_report(
    found: Identification, robot: RobotDescription, known: PhysicalParams, folder: Path, source: str = ""
) -> list[Path]:
    """Write `report.png` and `report.html` to a folder; returns both.

    Args:
        found: what was found.
        robot: its description.
        known: what was known before, one row.
        folder: made, if it does not exist.
        source: where the data come from.
    """
    folder.mkdir(parents=True, exist_ok=True)
    picture = identification_figure(found, robot, known, folder / "report.png")
    path = folder / "report.html"
    atomic_write(path, page(found, robot, known, picture.read_bytes(), source))
    return [picture, path]


def page(
    found: Identification, robot: RobotDescription, known: PhysicalParams, picture: bytes, source: str = ""
) -> str:
    """The page as HTML, which holds its picture (PNG) and loads nothing from elsewhere; else as `write_report`."""
    title = f"{found.experiment}: what it tells of {found.robot}"
    told = sum(item.identifiable for item in found.estimates)
    facts = [("data", source), ("recorded", found.date), ("SHA-256", found.digest), ("surefoot", __version__)]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="quiet">{told} of {len(found.estimates)} numbers are told by the data.</p>',
        *_section("Estimates", _estimates(found.estimates, robot, known)),
        *_section("Error on data that were not fitted", _checks(found)),
        *_section("What can hardly be told apart", _correlations(found, robot)),
        *_section("Notes", "".join(f"<li>{escape(note)}</li>" for note in found.notes), "ul"),
        "<h2>Pictures</h2>",
        html.picture(picture, "intervals, series and correlations"),
        *_section("Data", "".join(f"<tr><td>{k}</td><td><code>{escape(v)}</code></td></tr>" for k, v in facts if v)),
    ]
    return html.page(title, parts)


def _section(title: str, content: str, kind: str = "table") -> list[str]:
    return [f"<h2>{escape(title)}</h2>", f"<{kind}>{content}</{kind}>"] if content else []


def _estimates(estimates: Sequence[ParameterEstimate], robot: RobotDescription, known: PhysicalParams) -> str:
    rows = [html.row(("parameter", "before", "found", "95 % interval", "unit"), "tnnnt", "th")]
    for item in estimates:
        unit = "" if item.unit == "1" else item.unit
        rows.append(html.row((full_name(item.label, robot), *cells(item, known), unit), "tnnnt"))
    return "\n".join(rows)


def _checks(found: Identification) -> str:
    rows = [html.row((one.what, f"{one.before:.3g}", f"{one.after:.3g}", one.unit), "tnnt") for one in found.checks]
    return "".join([html.row(("RMS error of", "before", "after", "unit"), "tnnt", "th"), *rows]) if rows else ""


def _correlations(found: Identification, robot: RobotDescription) -> str:
    return "".join(
        html.row((full_name(one, robot), full_name(other, robot), f"{value:+.2f}"), "ttn")
        for one, other, value in found.correlations
    )
