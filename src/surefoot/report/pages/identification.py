"""Report of an identification: a figure, and a self-contained page."""

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
    result: Identification, robot: RobotDescription, prior: PhysicalParams, folder: Path, source: str = ""
) -> list[Path]:
    """Write `report.png` and `report.html` to a folder; return both paths.

    Args:
        result: the identification.
        robot: its description.
        prior: parameters before, one row.
        folder: folder, which is created if it does not exist.
        source: description of the data's origin.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figure = identification_figure(result, robot, prior, folder / "report.png")
    path = folder / "report.html"
    atomic_write(path, page(result, robot, prior, figure.read_bytes(), source))
    return [figure, path]


def page(
    result: Identification, robot: RobotDescription, prior: PhysicalParams, figure: bytes, source: str = ""
) -> str:
    """Return the self-contained page with its figure (PNG); for the other arguments see `write_report`."""
    title = f"{result.experiment}: parameters of {result.robot}"
    count = sum(item.identifiable for item in result.estimates)
    facts = [("data", source), ("recorded", result.date), ("SHA-256", result.digest), ("surefoot", __version__)]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="quiet">{count} of {len(result.estimates)} parameters are identifiable from the data.</p>',
        *_section("Estimates", _estimates(result.estimates, robot, prior)),
        *_section(result.checks_title, _checks(result)),
        *_section("Hardly distinguishable", _correlations(result, robot)),
        *_section("Notes", "".join(f"<li>{escape(note)}</li>" for note in result.notes), "ul"),
        "<h2>Figures</h2>",
        html.image(figure, "intervals, series and correlations"),
        *_section("Data", "".join(f"<tr><td>{k}</td><td><code>{escape(v)}</code></td></tr>" for k, v in facts if v)),
    ]
    return html.page(title, parts)


def _section(title: str, content: str, kind: str = "table") -> list[str]:
    return [f"<h2>{escape(title)}</h2>", f"<{kind}>{content}</{kind}>"] if content else []


def _estimates(estimates: Sequence[ParameterEstimate], robot: RobotDescription, prior: PhysicalParams) -> str:
    rows = [html.row(("parameter", "prior", "estimate", "95 % interval", "unit"), "tnnnt", "th")]
    for item in estimates:
        unit = "" if item.unit == "1" else item.unit
        rows.append(html.row((full_name(item.label, robot), *cells(item, prior), unit), "tnnnt"))
    return "\n".join(rows)


def _checks(result: Identification) -> str:
    rows = [html.row((one.what, f"{one.before:.3g}", f"{one.after:.3g}", one.unit), "tnnt") for one in result.checks]
    return "".join([html.row(("RMS error of", "before", "after", "unit"), "tnnt", "th"), *rows]) if rows else ""


def _correlations(result: Identification, robot: RobotDescription) -> str:
    return "".join(
        html.row((full_name(one, robot), full_name(other, robot), f"{value:+.2f}"), "ttn")
        for one, other, value in result.correlations
    )
