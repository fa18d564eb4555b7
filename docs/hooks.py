"""Additions to mkdocs: files of the repository outside docs/, and a page of API reference for each package.

Links are written as they hold in the repository. In the site README.md is the first page, docs/ is the root, and all
other folders keep their paths; links are rewritten to that.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = (
    "CHANGELOG.md",
    "policies/README.md",
    "examples/first_hour.ipynb",
    "examples/sb3.py",
    "results/*/*.*",
    "results/*/parameters/*",
)
MODULES = sorted(path.stem for path in ROOT.glob("src/surefoot/[a-z]*.py"))
PACKAGES = sorted(path.parent.name for path in ROOT.glob("src/surefoot/*/__init__.py"))


def reference(title: str, modules: list[str]) -> str:
    """Return a page of API reference."""
    return "\n\n".join([f"# {title}", *(f"::: surefoot.{module}" for module in modules)])


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add README.md as the first page, the files outside docs/, and the API reference."""
    files.append(File.generated(config, "index.md", abs_src_path=str(ROOT / "README.md")))
    for path in sorted(path for pattern in OUTSIDE for path in ROOT.glob(pattern)):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    for name in PACKAGES:
        files.append(File.generated(config, f"reference/{name}.md", content=reference(f"surefoot.{name}", [name])))
    files.append(File.generated(config, "reference/shared.md", content=reference("Shared modules", MODULES)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite relative links from paths in the repository to paths in the site."""
    source = page.file.abs_src_path
    if source is None:
        return markdown
    folder = Path(source).relative_to(ROOT).parent.as_posix()

    def rewritten(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[1]))
        target = "index.md" if target == "README.md" else target.removeprefix("docs/")
        return f"]({posixpath.relpath(target, posixpath.dirname(page.file.src_uri) or '.')}"

    return re.sub(r"\]\((?!\w+:|#)([^)#\s]+)", rewritten, markdown)
