"""Write results/NAME/README.md from its template and the result files of commands.

    python tools/result_pages.py [NAME ...]     # write the pages that are out of date
    python tools/result_pages.py --check        # print one line per difference; exit code 1

A template, results/NAME/README.template, is Markdown with sources in braces, as in tools/result_numbers.py:

    `trot` walks {evaluations trot: speed_mean .2} m/s; {evaluations trot/table1: falls of episodes} episodes fall.

A table has one row per item of a list; {0} is the item, {1} the text after its first ` = `, and so on:

    :::table trot, solo8-trot = Solo 8
    | policy | speed [m/s] | falls with table I |
    |---|---:|---:|
    | `{0}` | {evaluations {0}: speed_mean .2} | {evaluations {0}/table1: falls of episodes} |
    :::

Rows without {0} appear once. The list `all of FILE` is the first column of a CSV file. A backslash at the end of a line
continues it.

Studies and searches have no template: their reports are written from the study's tables, with the command in the
current page.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from pathlib import Path

from result_numbers import fill, find_file, first_column, substitute

from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.files import atomic_write

ROOT = Path(__file__).resolve().parents[1]
TEMPLATES = ("results/*/README.template", "policies/README.template")
REPORTS = ("from-scratch", "from-scratch-motors", "identified", "reality-gap", "robustness", "search")
"""Folders of studies and of a search in results/; a study's file is studies/NAME.yaml."""
TABLE = re.compile(r"^:::table +(?P<items>[^\n]+)\n(?P<rows>.+?)^:::\n", re.DOTALL | re.MULTILINE)
CONTINUED = re.compile(r"\\\n *")


def table_rows(root: Path, items: str, rows: str) -> str:
    """Return the rows of a table with {0} replaced by each item; their sources are not filled in yet."""
    whole = re.fullmatch(r"all of (\S+)", items.strip())
    listed = first_column(find_file(root, whole[1]))[1:] if whole else re.split(r",\s+", items.strip())
    return "".join(
        substitute(row, item) for row in rows.splitlines(keepends=True) for item in (listed if "{0}" in row else [""])
    )


def write_page(root: Path, template: str) -> str:
    """Return the page of a template, with numbers from the result files.

    Raises:
        SurefootError: a source does not exist; the message names the template's paragraph.
    """
    text = CONTINUED.sub("", template)
    written, end = "", 0
    for match in [*TABLE.finditer(text), None]:
        between = text[end : match.start() if match else len(text)]
        table = table_rows(root, match["items"], match["rows"]) if match else ""
        # A source may continue on the next line.
        for paragraph in re.split(r"(?<=\n)(?=\n)", between + table):
            with prefix_errors(paragraph.strip()[:80].replace("\n", " ")):
                written += fill(root, paragraph)
        end = match.end() if match else end
    return written


def write_report(root: Path, name: str) -> str:
    """Return the report of a study or a search from its tables.

    Raises:
        SurefootError: the page with the command, or a table, is missing.
    """
    from surefoot.studies import robot_report, search_report, study_report
    from surefoot.studies.study_config import load_study

    folder = root / "results" / name
    with describe_os_errors(folder):
        match = re.search(r"```sh\n(.+?)\n```", (folder / "README.md").read_text(encoding="utf-8"), re.DOTALL)
        if match is None:
            raise SurefootError(f"{folder / 'README.md'}: has no command")
        if (folder / "search.yaml").is_file():
            return search_report.report_from_tables(folder, match[1])
        study = load_study(root / "studies" / f"{name}.yaml")
        write = study_report.report_from_tables if study.robots is None else robot_report.report_from_tables
        return write(study, folder, match[1])


def changes(old: str, new: str) -> list[str]:
    """Return one line of text for each difference between two versions of a page."""
    matcher = difflib.SequenceMatcher(None, first := old.splitlines(), second := new.splitlines(), autojunk=False)
    return [
        f"{i + 1}: has {' / '.join(first[i:i_end])!r}, the results {' / '.join(second[j:j_end])!r}"
        for kind, i, i_end, j, j_end in matcher.get_opcodes()
        if kind != "equal"
    ]


def pages(names: list[str]) -> list[Path]:
    """Return the pages of result folders; all without names.

    Raises:
        SurefootError: a folder has neither a template nor a report.
    """
    found = {path.parent.name: path.with_suffix(".md") for one in TEMPLATES for path in sorted(ROOT.glob(one))}
    found |= {name: ROOT / "results" / name / "README.md" for name in REPORTS}
    if unknown := [name for name in names if name not in found]:
        raise SurefootError(f"{', '.join(unknown)}: no such template; there are {', '.join(found)}")
    return [found[name] for name in names or found]


def main(argv: list[str] | None = None) -> int:
    """Write or check the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="folders below results/; defaults to all")
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a page is out of date")
    arguments = parser.parse_args(argv)
    wrong = 0
    for page in pages(arguments.names):
        template, name = page.with_suffix(".template"), page.parent.name
        old = page.read_text(encoding="utf-8") if page.is_file() else ""
        try:
            is_report = name in REPORTS
            new = write_report(ROOT, name) if is_report else write_page(ROOT, template.read_text(encoding="utf-8"))
        except SurefootError as error:
            print(f"{page.parent.relative_to(ROOT)}: {error}")
            wrong += 1
            continue
        if new == old:
            continue
        if arguments.check:
            wrong += 1
            for line in changes(old, new):
                print(f"{page.relative_to(ROOT)}:{line}")
        else:
            atomic_write(page, new)
            print(f"wrote {page.relative_to(ROOT)}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
