"""Draw docs/doctor.svg, the doctor's report of a wrong joint order in a terminal: python tools/terminal_picture.py."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml
from rich.console import Console
from rich.terminal_theme import DEFAULT_TERMINAL_THEME
from rich.text import Text

ROOT = Path(__file__).resolve().parents[1]
PATH = ROOT / "docs" / "doctor.svg"
SOURCE, KEY = ROOT / "data" / "rl_sar" / "robot_lab", "go2/robot_lab"
COLUMNS = 132
FAILED = 3
"""Exit code of an examination with a failed check."""
LEFT_OUT = re.compile(r"backward|right|turn {4}|curve|see the line")
"""Redundant lines of the output."""


def swapped(folder: Path) -> None:
    """Write the specification of a published policy with its left and right joints exchanged."""
    specification = yaml.safe_load((SOURCE / "config.yaml").read_text(encoding="utf-8"))
    mapping = specification[KEY]["joint_mapping"]
    specification[KEY]["joint_mapping"] = [number for leg in (3, 0, 9, 6) for number in mapping[leg : leg + 3]]
    folder.mkdir()
    (folder / "config.yaml").write_text(yaml.safe_dump(specification), encoding="utf-8")
    for name in ("policy.pt", "../base.yaml"):
        (folder / name).resolve().write_bytes((SOURCE / name).read_bytes())


def run(folder: Path, *words: str) -> list[str]:
    """Run a command; return the lines of its output."""
    environment = {**os.environ, "COLUMNS": str(COLUMNS)}
    command = [sys.executable, "-m", "surefoot", *words]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, FAILED):
        raise SystemExit(done.stderr)
    return [f"$ surefoot {' '.join(words)}", *done.stdout.splitlines()]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "rl_sar"
        folder.mkdir()
        swapped(folder / "policy")
        adopted = run(folder, "adopt", "policy/policy.pt", "--from", "rl_sar", "--robot", "go2", "--out", "policy.onnx")
        examined = run(folder, "doctor", "policy.onnx")
    print("\n".join([*adopted, *examined]))
    console = Console(record=True, width=COLUMNS, file=open(os.devnull, "w"))  # noqa: SIM115
    for line in [adopted[0], "", *examined]:
        if line.startswith("$"):
            console.print(Text(line, style="bold"))
        elif not LEFT_OUT.search(line):
            console.print(Text(line, style="red" if line.startswith("FAIL") else ""))
    picture = console.export_svg(title="surefoot doctor", theme=DEFAULT_TERMINAL_THEME)
    # Use fonts of the reader's computer, so that nothing is loaded from the network.
    picture = re.sub(r"@font-face \{.*?\}\s*", "", picture, flags=re.DOTALL)
    PATH.write_text(
        picture.replace("Fira Code,", "ui-monospace, Menlo, Consolas, 'DejaVu Sans Mono',"), encoding="utf-8"
    )
