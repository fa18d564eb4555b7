"""Write docs/gallery.html: short runs of the released policies on flat ground, on a page that opens without surefoot.

Run it after a policy has changed: python tools/gallery.py
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from surefoot.api.policies import SEARCH_PATHS, find_policy, load_policy, run_policy
from surefoot.evaluation.conditions import Condition
from surefoot.files import atomic_write
from surefoot.report.pages.recorded_runs import ShownTrace, recording_page

SECONDS = 5.0
ELSEWHERE = {"go2-terrain", "go2-terrain-seeing"}
"""Policies for terrain, which docs/terrain.md describes."""
STEPS = ((0.0, 0.7, 0.0, 0.0), (1.7, 0.5, 0.0, 0.8), (3.4, 0.0, 0.8, 0.0))
"""Commands of steered policies: start [s], and fractions of the maximum forward speed, sideways speed and yaw rate."""


def recorded(name: str, push_force: tuple[float, float] | None = None) -> ShownTrace:
    """Return a run of a released policy, with pushes if their minimum and maximum force [N] are given."""
    policy, robot, task = load_policy(find_policy(name), None)
    task = Condition(push_force=push_force, duration=SECONDS).apply(task, robot)
    if (limits := task.commands.limits(robot)) is not None:
        maxima = (limits.forward[1], limits.sideways[1], limits.yaw_rate[1])
        rows = tuple(
            (begin, *(fraction * top for fraction, top in zip(fractions, maxima, strict=True)))
            for begin, *fractions in STEPS
        )
        task = replace(task, commands=replace(task.commands, schedule=rows))
    (trace,) = run_policy(policy, task, 1, "mujoco", seed=0, name=name)
    return ShownTrace(name, robot, trace)


if __name__ == "__main__":
    names = sorted({path.stem for path in SEARCH_PATHS[-1].glob("*.onnx")} - ELSEWHERE)
    page = recording_page([recorded(name) for name in names], "one")
    path = Path(__file__).resolve().parents[1] / "docs" / "gallery.html"
    atomic_write(path, page)
    print(f"{path.name}: {len(names)} policies, {len(page) / 1e6:.2f} MB")
