"""Parts of self-contained pages: a frame with one style, table rows, images."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #22272e; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin-bottom: .2rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; } td, th { padding: .15rem .9rem .15rem 0; text-align: left; vertical-align: top; }
th { border-bottom: 1px solid #6b7480; font-weight: 600; } tr + tr td { border-top: 1px solid #e3e7eb; }
.n { text-align: right; font-variant-numeric: tabular-nums; }
td.n { white-space: nowrap; } th { vertical-align: bottom; }
.quiet { color: #6b7480; } img { max-width: 100%; }
code { font-size: .85em; overflow-wrap: anywhere; } figure { margin: 1rem 0; } .wide { overflow-x: auto; }
"""


def page(title: str, parts: Iterable[str]) -> str:
    """Return a complete page from HTML parts; the title is plain text."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n'
    )


def row(texts: Sequence[str], kinds: str, tag: str = "td") -> str:
    """Return a table row; `kinds` has one letter per column: n for numbers, t for text, h for HTML."""
    cells = (
        f"<{tag}{' class=n' if kind == 'n' else ''}>{text if kind == 'h' else escape(text)}</{tag}>"
        for text, kind in zip(texts, kinds, strict=True)
    )
    return f"<tr>{''.join(cells)}</tr>"


def image(png: bytes, alt: str) -> str:
    """Return a PNG as an embedded image."""
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def document(name: str) -> str:
    """Return the page in a file of this package, with the shared style and scripts inserted."""
    here = Path(__file__).parent
    text = (here / name).read_text("utf-8")
    for mark, part in (("/* page.css */", "page.css"), ("// plots.js", "plots.js"), ("// drive.js", "drive.js")):
        text = text.replace(mark, (here / part).read_text("utf-8").rstrip())
    return text
