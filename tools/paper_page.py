"""Page that compares the paper's tables, figures and numbers with surefoot's results, which are read from files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from pathlib import Path
from typing import Literal

from result_numbers import BRACES, NotMeasured, cell, substitute

from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import prefix_errors
from surefoot.files import atomic_write
from surefoot.report.pages.html import image, page, row

CONTENT = Path(__file__).with_name("paper.yaml")
NOT_MEASURED = "not measured"
VERDICTS = {
    "reproduced": "Reproduced",
    "same": "Same direction, not significant",
    "mixed": "Mixed evidence",
    "differs": "Differs",
    "untestable": "Not testable without a robot",
}
"""Classes of the scorecard in order, with their titles."""
_MAX_NUMBER = 30
"""Maximum number of characters of a numeric cell; a longer cell is wrapped as text."""


@dataclass(frozen=True)
class PaperClaim:
    """Claim of the paper, and whether surefoot reproduces it."""

    claim: str
    verdict: Literal["reproduced", "same", "mixed", "differs", "untestable"]
    surefoot: str
    """surefoot's result; numbers as in `result_numbers.fill`."""
    where: str
    """Page with the measurement, relative to `docs`."""
    readme: str = ""
    """Words about it in README, in a sentence with the name of its class; empty if README leaves it out."""


@dataclass(frozen=True)
class PaperItem:
    """Line of the comparison."""

    what: str
    paper: str
    """The paper's number with its unit, or its words."""
    surefoot: str
    """surefoot's number or words, with numbers as in `result_numbers.fill`."""
    how: str = ""
    """Measurement of surefoot's number: episodes, seeds, and the samples of the interval."""
    each: tuple[str, ...] = ()
    """The line is repeated for each entry: {0} is the text before ` = `, {1} the text after it."""

    def lines(self) -> list[PaperItem]:
        """Return one item per entry of `each`."""
        return [
            replace(self, what=substitute(self.what, one), surefoot=substitute(self.surefoot, one), each=())
            for one in self.each or [""]
        ]


@dataclass(frozen=True)
class PaperPicture:
    """surefoot's counterpart of a figure of the paper."""

    file: str
    """Path relative to the root of the repository; with a *, one picture per matching file."""
    caption: str
    """Caption; a * is replaced by the text that matches the * in the path."""

    def find_files(self, root: Path) -> list[tuple[Path, str]]:
        """Return the existing files with their captions."""
        start, _, end = self.file.partition("*")
        paths = [path for path in sorted(root.glob(self.file)) if path.is_file()]
        names = [path.relative_to(root).as_posix().removeprefix(start).removesuffix(end) for path in paths]
        return [(path, self.caption.replace("*", name)) for path, name in zip(paths, names, strict=True)]


@dataclass(frozen=True)
class PaperSection:
    """Section about a table, figure or claim of the paper."""

    title: str
    paper: str
    """Method and result of the paper."""
    surefoot: str = ""
    """Differences in surefoot's method, and its result; numbers as in `result_numbers.fill`."""
    commands: tuple[str, ...] = ()
    """Commands that reproduce surefoot's numbers."""
    items: tuple[PaperItem, ...] = ()
    pictures: tuple[PaperPicture, ...] = ()


@dataclass(frozen=True)
class PaperContent:
    """All text of the page."""

    title: str
    about: str
    claims: tuple[PaperClaim, ...]
    differences: tuple[str, ...]
    """The main differences between paper and surefoot."""
    sections: tuple[PaperSection, ...]


def evaluations_on_page() -> list[str]:
    """Return the names of rows of `results/evaluations.csv` that the page uses, such as `trot/ensemble-test`."""
    sections = load_content().sections
    texts = [line.surefoot for section in sections for item in section.items for line in item.lines()]
    texts += [section.surefoot for section in sections]
    return sorted({name for text in texts for name in re.findall(r"\{evaluations ([\w/-]+):", text)})


@cache
def load_content() -> PaperContent:
    """Return the text of the page."""
    with prefix_errors(CONTENT):
        return from_mapping(PaperContent, read_yaml(CONTENT))


def claims(root: Path, verdict: str, missing: list[str]) -> list[tuple[str, str, str]]:
    """Return claim, result and page of each claim with a verdict."""
    return [
        (one.claim, _fill(root, one.surefoot, missing), one.where)
        for one in load_content().claims
        if one.verdict == verdict
    ]


def claims_markdown(root: Path, verdict: str) -> str:
    """Return the claims with a verdict as a Markdown table for a page in `docs`."""
    lines = [f"| {claim} | {text} [Results]({page}) |" for claim, text, page in claims(root, verdict, [])]
    return "\n".join(["| the paper | surefoot |", "|---|---|", *lines]) + "\n"


def claims_summary() -> str:
    """Return a sentence with the number of claims in each class."""
    verdicts = [one.verdict for one in load_content().claims]
    same, mixed, differs, untestable = (verdicts.count(one) for one in ("same", "mixed", "differs", "untestable"))
    return (
        f"Of {len(verdicts)} claims of the paper: {verdicts.count('reproduced')} reproduced, {same} in the same "
        f"direction and not significant, {mixed} with mixed evidence, {differs} different, {untestable} not testable "
        "without a robot."
    )


def write_page(root: Path, path: Path, note: str = "", clone: Path | None = None) -> list[str]:
    """Write the page; return the names of missing result files.

    Args:
        root: folder with `results`, `docs` and `policies`.
        path: path of the page (.html).
        note: remark about all results, at the top.
        clone: folder with the results for the scorecard; defaults to `root`.

    Raises:
        SurefootError: a result file can't be read, or lacks a row or number.
    """
    content = load_content()
    missing: list[str] = []
    parts = [f"<h1>{escape(content.title)}</h1>", f"<p>{escape(content.about)}</p>"]
    if note:
        parts.append(f"<p><b>{escape(note)}</b></p>")
    parts += ["<h2>Scorecard</h2>", f"<p>{claims_summary()}</p>"]
    for verdict, title in VERDICTS.items():
        rows = [
            (escape(claim), f"{_code(escape(text))} <span class=quiet>{_shown(where)}</span>")
            for claim, text, where in claims(clone or root, verdict, missing)
        ]
        parts += [f"<h3>{title}</h3>", _table([("the paper", "surefoot"), *rows], ["hh"] * (len(rows) + 1))]
    parts.append(_contents([section.title for section in content.sections]))
    parts += [
        "<h2>Main differences</h2>",
        "<ul>",
        *(f"<li>{escape(text)}</li>" for text in content.differences),
        "</ul>",
    ]
    parts += _all_differences(root)
    for number, section in enumerate(content.sections, start=1):
        parts += [f'<h2 id="s{number}">{escape(section.title)}</h2>', f"<p><b>Paper:</b> {escape(section.paper)}</p>"]
        if section.surefoot:
            parts.append(f"<p><b>surefoot:</b> {escape(_fill(root, section.surefoot, missing))}</p>")
        if section.items:
            lines: list[tuple[str, ...]] = [("", "paper", "surefoot", "difference", "how measured")]
            for item in section.items:
                lines += [_line(root, one, missing) for one in item.lines()]
            for k in range(len(lines) - 1, 1, -1):
                lines[k] = (*lines[k][:-1], "as above") if lines[k][-1] == lines[k - 1][-1] != "" else lines[k]
            columns = [k for k in range(len(lines[0])) if any(line[k] for line in lines[1:])]
            kinds = [
                "".join("n" if k in (1, 2) and len(line[k]) < _MAX_NUMBER else "t" for k in columns) for line in lines
            ]
            parts.append(_table([[line[k] for k in columns] for line in lines], kinds))
        for one in section.pictures:
            files = one.find_files(root)
            for source, caption in files:
                figure = image(source.read_bytes(), caption)
                parts.append(f"<figure>{figure}<figcaption class=quiet>{escape(caption)}</figcaption></figure>")
            if not files:
                missing.append(one.file)
        parts += [f"<p><code>{escape(command)}</code></p>" for command in section.commands]
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, page(content.title, parts))
    return list(dict.fromkeys(missing))


def _shown(where: str) -> str:
    """Return the path of a page relative to the root of the repository."""
    name = where.partition("#")[0]
    return name.removeprefix("../").removesuffix("/README.md") if name.startswith("../") else f"docs/{name}"


def _table(rows: Sequence[Sequence[str]], kinds: Sequence[str]) -> str:
    """Return a table that scrolls if it is too wide; the first row is its header."""
    lines = (row(*both, "td" if i else "th") for i, both in enumerate(zip(rows, kinds, strict=True)))
    return f"<div class=wide><table>{''.join(lines)}</table></div>"


def _contents(titles: Sequence[str]) -> str:
    """Return the table of contents with links to the sections."""
    links = (f'<li><a href="#s{number}">{escape(title)}</a></li>' for number, title in enumerate(titles, start=1))
    return f"<nav aria-label=Contents><ul>{''.join(links)}</ul></nav>"


def _fill(root: Path, text: str, missing: list[str]) -> str:
    """Return a text with numbers of results filled in; missing files are added to `missing`."""

    def number(match: re.Match[str]) -> str:
        try:
            return cell(root, match[1])
        except NotMeasured:
            missing.append(f"results/{match[1].rpartition(': ')[0]}")
            return NOT_MEASURED

    return BRACES.sub(number, text)


def _line(root: Path, item: PaperItem, missing: list[str]) -> tuple[str, ...]:
    """Return the cells of an item's line."""
    text = _fill(root, item.surefoot, missing)
    if NOT_MEASURED in text:
        text = NOT_MEASURED
    return item.what, item.paper, text, difference(item.paper, text), item.how


def difference(paper: str, surefoot: str) -> str:
    """Return the difference of two numbers with the same unit in words, such as `25% less`; empty for other texts.

    Text between number and unit (± or an interval) is surefoot's uncertainty.
    """
    one = re.fullmatch(r"(\d*\.?\d+)( \D\S*)?", paper)
    other = re.fullmatch(r"(-?\d*\.?\d+)(?: ± \S+| \[(\S+), (\S+)\])?( \D\S*)?", surefoot)
    if one is None or other is None or one[2] != other[4]:
        return ""
    expected, measured = float(one[1]), float(other[1])
    if other[2] and float(other[2]) <= expected <= float(other[3]):
        return "the interval contains the paper's value"
    change = measured / expected - 1
    if abs(change) < 0.005:
        return "the same"
    return f"{abs(change):.0%} {'more' if change > 0 else 'less'}" if change < 2 else f"{1 + change:.1f} times as much"


def _all_differences(root: Path) -> list[str]:
    """Return the tables of `docs/paper-differences.md`, collapsed."""
    path = root / "docs" / "paper-differences.md"
    if not path.is_file():
        return []
    # Every section's table has its own header, which becomes a row with the section's title in a single table.
    text = re.sub(r"^## (.+)\n\n\| [^|]+\|", r"| **\1** |", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    lines = [line.strip("|").split("|") for line in text.splitlines() if line[:2] == "| "]
    cells = [[_inline(cell.strip()) for cell in line] for line in lines]
    rows = "".join(row(line, "hhhh") for line in cells if len(line) == 4)
    return [f"<details><summary>Every difference</summary><table>{rows}</table></details>"]


def _inline(markdown: str) -> str:
    """Convert bold type and code of a cell to HTML, and links to their texts."""
    text = re.sub(r"\[(.+?)\]\([^)]*\)", r"\1", escape(markdown))
    return _code(re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", text))


def _code(text: str) -> str:
    """Convert code in Markdown to HTML."""
    return re.sub(r"`(.+?)`", r"<code>\1</code>", text)
