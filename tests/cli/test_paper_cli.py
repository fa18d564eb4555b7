"""`surefoot paper`."""

from __future__ import annotations

from pathlib import Path

import pytest
from processes import refused, surefoot

pytest.importorskip("matplotlib")


def test_the_page_is_written_from_a_clone(repository: Path, tmp_path: Path):
    done = surefoot("paper", "--root", repository, "--out", tmp_path / "page.html")
    assert (done.returncode, done.stdout) == (0, f"wrote {tmp_path / 'page.html'}\n")
    assert (tmp_path / "page.html").read_text(encoding="utf-8").endswith("</html>\n")


def test_a_folder_without_results_and_a_name_of_another_kind_are_refused(tmp_path: Path):
    refused(surefoot("paper", "--root", tmp_path), str(tmp_path), "with the folder results")
    refused(surefoot("paper", "--out", "page.pdf"), "out page.pdf: the name must end in .html")
