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
    on_rack: bool = False

    def place(self, rack: bool) -> None:
        """Start the robot on its rack or on the floor, unless it is there."""
        if self.robot is None or self.on_rack != rack:
            self.stop()
            self.robot, self.on_rack = Emulator(*self.options, *(["--rack"] if rack else [])), rack

    def stop(self) -> None:
        """Stop the robot."""
        if self.robot is not None:
            self.robot.stop()
            self.robot = None

    def _command(self, line: str) -> None:
        _, command, *words = shlex.split(line)
        if command == "emulate":
            self.options = tuple(words)
            self.place(rack=False)
        elif command == "identify":
            self.place(EXPERIMENTS[words[0]].rack)
            done = surefoot("identify", *words, "--yes")
            assert done.returncode == 0, f"{line}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        else:
            # The deployed runs are shortened to 1 s, the training's episodes to less.
            super()._command(f"{line} --duration 1" if command == "gap" else line)
            return
        self.ran.append(line)


@pytest.mark.slow
def test_a_robot_is_identified_and_its_policy_trained_deployed_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for name in ("motor", "latency", "mass", "contact"):
        experiment = EXPERIMENTS[name]
        monkeypatch.setitem(EXPERIMENTS, name, replace(experiment, plan=partial(short_plan, experiment)))
    monkeypatch.setattr("surefoot.identify.fitting.MAX_ITERATIONS", 3)
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
