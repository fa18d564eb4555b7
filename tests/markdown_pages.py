"""Links, headings and commands in Markdown pages."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    path
    for pattern in ("README.md", "CONTRIBUTING.md", "policies/README.md", "docs/*.md", "docs/decisions/*.md")
    for path in sorted(ROOT.glob(pattern))
]
LINK = re.compile(r"\]\((?!\w+:)([^)\s]+)\)")
FENCED = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
INDENTED = re.compile(r"(?:\A|^\n)((?: {4}[^\n]*\n|\n)+)", re.MULTILINE)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def links(text: str) -> list[str]:
    """Return the relative targets of links and images."""
    return LINK.findall(FENCED.sub("", COMMENT.sub("", text)))


def anchors(text: str) -> set[str]:
    """Return the anchors that Git hosts generate for the headings of a page."""
    found: set[str] = set()
    for title in re.findall(r"^#+ +(.+?) *$", FENCED.sub("", text), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", re.sub(r"\]\([^)]*\)", "]", title).lower()).replace(" ", "-")
        found.add(next(one for one in (slug, *(f"{slug}-{k}" for k in range(1, 99))) if one not in found))
    return found


def dead_links(page: Path) -> list[str]:
    """Return the relative links of a page to missing files or headings."""
    dead = []
    for link in links(page.read_text(encoding="utf-8")):
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        named = anchors(target.read_text(encoding="utf-8")) if target.suffix == ".md" and target.is_file() else {anchor}
        if not target.exists() or (anchor and anchor not in named):
            dead.append(link)
    return dead


def blocks(text: str) -> list[str]:
    """Return fenced shell blocks and indented blocks; lines continued by a backslash are joined."""
    text = COMMENT.sub("", text)
    fenced = [code for _, language, code in FENCED.findall(text) if language in ("", "bash", "sh")]
    return [re.sub(r"\\\n\s*", " ", block) for block in [*fenced, *INDENTED.findall(FENCED.sub("", text))]]


def lines(block: str) -> list[str]:
    """Return the commands in a block, without comments."""
    return [line for one in block.splitlines() if (line := re.split(r"\s#|\s&$|^#", one.strip())[0].strip())]


def commands(text: str) -> list[str]:
    """Return all commands `surefoot ...` on a page, in blocks and in sentences."""
    prose = FENCED.sub("", COMMENT.sub("", text))
    found = [line for block in blocks(text) for line in lines(block) if line.startswith("surefoot ")]
    return [" ".join(one.split()) for one in [*found, *re.findall(r"`(surefoot\s[^`]+)`", prose)]]
