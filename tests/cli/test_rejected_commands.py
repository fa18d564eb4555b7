"""Invalid words of a command line are rejected in one line, before anything is simulated or written."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from processes import assert_rejected, surefoot
from rejected_commands import FILES, REJECTED_COMMANDS, REPOSITORY, MakeRun, RejectedCommand

from surefoot.api.extras import install_command


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "refusal",
    REJECTED_COMMANDS,
    ids=[re.sub(r"[^ -~]", "?", f"{one.hidden and f'no {one.hidden}: '}{one.line}") for one in REJECTED_COMMANDS],
)
def test_a_command_is_rejected_in_one_line(
    refusal: RejectedCommand, make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in refusal.needs:
        pytest.importorskip(package)
    words = refusal.line.replace("REPOSITORY", str(REPOSITORY)).split(" ")
    for name in FILES.keys() & words:
        content = FILES[name]
        if isinstance(content, str):
            (tmp_path / name).write_text(content)
        else:
            content(tmp_path / name, make_run)
    parts = refusal.parts
    if refusal.hidden:
        monkeypatch.setitem(sys.modules, refusal.hidden, None)
        parts = (f"this needs {refusal.hidden}, which is not installed: {install_command(*refusal.parts)}\n",)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    done = surefoot(*words, cwd=tmp_path)
    done.stderr = "".join(line for line in done.stderr.splitlines(True) if ": warning: " not in line)
    assert_rejected(done, *parts)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
