"""Commands of a page, run in order in an empty folder as by a reader, but with short trainings and episodes."""

from __future__ import annotations

import contextlib
import glob
import re
import shlex
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path

from markdown_pages import COMMENT, FENCED, ROOT, lines
from processes import serve_page, surefoot

LIMITS = {"--steps": 256, "--episodes": 2, "--duration": 1, "--trials": 2}
"""Maximum values of options."""
RESUMED_STEPS = 384
"""Total steps of a resumed training."""
SHORT = {
    "train": {
        **{"--steps": 256, "--num-envs": 8, "--steps-per-update": 16, "--evaluate-every": 128},
        **{"--evaluation-episodes": 2, "--task.max-steps": 30, "--threads": 1},
    },
    "evaluate": {"--episodes": 2},
    "gap": {"--episodes": 1},
}
"""Options that shorten a command, unless the page sets them."""
FULL_SIZE = ("--help", "--resume", "--trace", "--command-grid")
"""Options with which commands do not accept those of `SHORT`."""
SENSITIVITY = {"--values": 2, "--episodes": 1}
IGNORED = ("pip", "python3", "tensorboard", "make", "ping", "sudo", "git", "cmake", "CYCLONEDDS_HOME")
"""Programs on pages that are not run here; README's `make` and `pip` commands have separate tests."""


@dataclass
class PageRun:
    """Run of all commands on a page.

    Attributes:
        folder: working folder.
        elsewhere: commands that are not run here, by a part of the line, with the test that runs them.
        before: arguments of commands that create files that the page presupposes.
        names: values of placeholders on the page, such as FOLDER; RUN is the newest training.
        ran: lines that were run.
    """

    folder: Path
    elsewhere: dict[str, str] = field(default_factory=dict)
    before: tuple[tuple[str, ...], ...] = ()
    names: dict[str, str] = field(default_factory=dict)
    ran: list[str] = field(default_factory=list)

    def run(self, page: Path) -> None:
        """Run all blocks of a page.

        Raises:
            AssertionError: a command fails, or an entry of `elsewhere` does not occur on the page.
        """
        text, unused = COMMENT.sub("", page.read_text(encoding="utf-8")), set(self.elsewhere)
        with contextlib.chdir(self.folder):
            for words in self.before:
                done = surefoot(*words)
                assert done.returncode == 0, done.stderr
            for _, language, code in FENCED.findall(text):
                if language == "yaml":
                    self._save(code)
                elif language == "python" and "surefoot.task.plugins" in code:
                    Path("plugin.py").write_text(code, encoding="utf-8")
                elif language == "bash":
                    for line in lines(re.sub(r"\\\n\s*", " ", code)):
                        if parts := [part for part in self.elsewhere if part in line]:
                            unused -= set(parts)
                        else:
                            self._command(line)
        assert not unused, f"{page.name} no longer has {unused}"

    def _save(self, code: str) -> None:
        """Write a block to the file that its first line names, such as `# quick-trot.yaml`."""
        if name := re.match(r"# (\w[\w.-]*\.yaml)", code):
            Path(name[1]).write_text(code, encoding="utf-8")

    def _command(self, line: str) -> None:
        program, *words = shlex.split(line)
        if program in IGNORED or "=" in program:
            return
        assert program == "surefoot", line
        command, *words = [one for word in words for one in self._filled(word)]
        words = shortened(command, words)
        print("surefoot", command, shlex.join(words))
        if serves_a_page(command, words):
            with serve_page(command, *words, cwd=self.folder) as address:
                assert urllib.request.urlopen(address).status == 200
        else:
            done = surefoot(command, *words)
            assert done.returncode == 0, f"{line}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        self.ran.append(line)

    def _filled(self, word: str) -> list[str]:
        """Return an argument with patterns replaced by the newest matching file, and placeholders by their values."""
        word = {"RUN": "runs/*/*", **self.names}.get(word, word)
        return sorted(glob.glob(word), key=lambda path: Path(path).stat().st_mtime)[-1:] if "*" in word else [word]


def serves_a_page(command: str, words: list[str]) -> bool:
    """Return whether a command serves a page until it is stopped."""
    return command == "drive" or (command == "show" and words[0].endswith(".npz") and "--out" not in words)


def shortened(command: str, words: list[str]) -> list[str]:
    """Return the arguments of a command with options that shorten it."""
    if any(word in FULL_SIZE for word in words):
        options = {}
    elif command == "evaluate" and words[0] == "sensitivity":
        options = SENSITIVITY
    else:
        options = SHORT.get(command, {})
    limits = {**LIMITS, "--steps": RESUMED_STEPS} if "--resume" in words else LIMITS
    words = [
        str(min(float(word), limits[before])).removesuffix(".0") if before in limits else word
        for before, word in zip(["", *words], words, strict=False)
    ]
    return [
        *words,
        *(str(part) for option, value in options.items() if option not in words for part in (option, value)),
    ]


def page_path(name: str) -> Path:
    """Return the path of a page of docs/."""
    return ROOT / "docs" / f"{name}.md"
