"""Commands of docs/close-the-gap.md on its emulated robot, with short experiments and a short training."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest
from markdown_pages import FENCED, ROOT, lines
from page_commands import PageRun
from processes import Emulator, surefoot
from short_experiments import short_plan

from surefoot.identify.registry import EXPERIMENTS
from surefoot.robot import RobotDescription
from surefoot.robot.params_file import read_params

for package in ("torch", "mujoco", "pybullet", "matplotlib"):
    pytest.importorskip(package)

PAGE = ROOT / "docs" / "close-the-gap.md"


@dataclass
class RobotPageRun(PageRun):
    """Run of a page with an emulated robot, which is hung on its rack and put on the floor as experiments require."""

    robot: Emulator | None = None
    options: tuple[str, ...] = ()
    """Options of `surefoot emulate` on the page."""

    def place(self, *rack: str) -> None:
        """Start the robot again, with or without `--rack`."""
        self.stop()
        self.robot = Emulator(*self.options, *rack)

    def stop(self) -> None:
        """Stop the robot."""
        if self.robot is not None:
            self.robot.stop()
            self.robot = None

    def _command(self, line: str) -> None:
        _, command, *words = shlex.split(line)
        if command == "emulate":
            self.options = tuple(words)
            self.place()
        elif command == "identify":
            self.place(*(["--rack"] if EXPERIMENTS[words[0]].rack else []))
            done = surefoot("identify", *words, "--yes")
            assert done.returncode == 0, f"{line}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        else:
            super()._command(line)
            return
        self.ran.append(line)


@pytest.mark.slow
def test_a_robot_is_identified_and_its_policy_trained_deployed_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("motor", "latency", "mass", "contact"):
        experiment = EXPERIMENTS[name]
        monkeypatch.setitem(EXPERIMENTS, name, replace(experiment, plan=partial(short_plan, experiment)))
    _, start, steps = PAGE.read_text(encoding="utf-8").partition("\n## 1. ")
    page = tmp_path / "steps.md"
    page.write_text(start + steps, encoding="utf-8")
    run = RobotPageRun(tmp_path)
    try:
        run.run(page)
    finally:
        run.stop()
    found = read_params(tmp_path / "robot.toml", RobotDescription.load("minitaur"))
    assert {"motor_strength", "control_latency", "base_mass_ratio", "contact_friction"} <= set(found.names)
    assert found.params.base_mass_ratio[0] > 1.05  # The robot is heavier than its data sheet.
    for folder in ("before", "after"):
        assert list((tmp_path / folder).glob("*.npz"))


def test_the_overview_has_the_commands_of_the_steps():
    text = PAGE.read_text(encoding="utf-8")
    first, *rest = ([shlex.split(line) for line in lines(code)] for _, _, code in FENCED.findall(text))
    steps = [words for block in rest for words in block]
    for words in first:
        options = {word for word in words if word.startswith("--")}
        assert any(words[:2] == step[:2] and options <= set(step) for step in steps), words
