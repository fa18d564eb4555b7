"""README is short, and pages for newcomers have short sentences."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PLAIN = (
    *("start", "train", "own-gait", "own-reward", "own-robot", "own-learner", "own-hardware", "go2", "cluster"),
    *("python", "firmware", "adopt"),
)
"""Pages of Start and How-to."""
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+(?:,\d{3})*(?:\.\d+)?|\.\d+)(?![\w.]*\w)")
NOT_PROSE = re.compile(r"<!--.*?-->|```.*?```|^(?: {4}|\|)[^\n]*$|^#+ [^\n]*$", re.DOTALL | re.MULTILINE)


def sentences(text: str) -> list[str]:
    """Return the sentences of a page's prose; items of a list begin a new one. Targets of links are left out."""
    text = re.sub(r"\]\([^)]*\)", "]", NOT_PROSE.sub("\n", text))
    parts = re.split(r"\n\s*\n|\n(?=[-*>] |\d+\. )", text)
    return [one for part in parts for one in re.split(r"(?<=[.!?])(?:\*\*)?\s+", " ".join(part.split())) if one]


def test_sentences_are_found():
    page = "# A page\n\nIt goes .5 m/s. So\ndo [two](b.md#2.5).\n- One\n- Two\n\n    code 1\n\n| 1 | 2 |\n<!-- 3. -->\n"
    assert sentences(page) == ["It goes .5 m/s.", "So do [two].", "- One", "- Two"]
    assert NUMBER.findall("At 3 of 20, 1,000 N and -.5 m/s; Go2, MuJoCo 3.11.") == ["3", "20", "1,000", "-.5", "3.11"]


def test_readme_has_at_most_100_lines_of_100_characters():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 100
    assert [line for line in lines if len(line) > 100] == []


def test_no_sentence_of_readme_has_more_than_two_numbers():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [one for one in sentences(text) if len(NUMBER.findall(one)) > 2] == []


def test_readme_has_no_words_that_it_does_not_explain():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"12-D|4-D|table I\b|hybrid|CMA-ES", text, re.IGNORECASE) == []


@pytest.mark.parametrize("page", PLAIN)
def test_sentences_of_a_page_have_fewer_than_thirty_words(page: str):
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    assert [one for one in sentences(text) if len(one.split()) >= 30] == []


def test_no_page_and_no_message_installs_from_an_index():
    files = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*.ipynb")]
    wrong = [path.name for path in files if re.search(r"pip install '?\"?surefoot", path.read_text(encoding="utf-8"))]
    assert wrong == []


def test_messages_in_troubleshooting_are_those_of_the_code():
    symptoms = re.findall(r"^- \*\*(.*)\*\*", (ROOT / "docs" / "troubleshooting.md").read_text("utf-8"), re.MULTILINE)
    messages = [message for line in symptoms for message in re.findall(r"`([^`]+)`", line) if " " in message]
    files = [*ROOT.glob("src/**/*.py"), ROOT / "Makefile"]
    source = re.sub(r'"\s*\n\s*f?"', "", "\n".join(path.read_text(encoding="utf-8") for path in files))
    values = re.compile(r"\.\.\.|\b[NX]\b|MODULE|policy\.onnx")
    parts = {part.strip(" ':") for message in messages for part in values.split(message)}
    assert len(messages) > 10
    assert [part for part in parts if part not in source] == []
