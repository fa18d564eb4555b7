"""The runs behind the page of the paper: every command in order, each skipped once its result is there."""

from __future__ import annotations

import contextlib
import io
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from surefoot.cli.helpers.options import Ray, Workers
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import atomic_write

QUICK_NOTE = (
    "A small version of everything, made in one go: short trainings of one seed, few trials. It shows that all "
    "parts work, and no more: the column 'how measured' describes the full version."
)
POLICIES = ("gallop", "trot", "trot-robust", "gallop-robust")
"""Tasks whose policies stand on the page."""
HYBRIDS = ("trot-hybrid", "gallop-hybrid")
"""Tasks of the clone's examples: learned feedback on top of handcrafted trajectories."""
_PICTURES = ("learning_curve.png", "footfalls.png")


@dataclass(frozen=True)
class Runs:
    """Where and how the runs are made."""

    root: Path
    """A clone of surefoot: its studies and benchmarks."""
    folder: Path
    """Folder for everything that is made."""
    quick: bool
    """Small versions."""
    workers: Workers = 0
    ray: Ray = None
    console: Console = field(default_factory=lambda: Console(stderr=True, highlight=False, soft_wrap=True))

    def many(self) -> list[str]:
        """Return the words that say where many trainings run."""
        return ["--workers", str(self.workers), *(["--ray", self.ray] if self.ray else [])]

    def small(self, *words: object) -> list[str]:
        """Return the words that make a command small; none for the full version."""
        return list(map(str, words)) if self.quick else []


@dataclass(frozen=True)
class Stage:
    """One step: what it makes, and how."""

    makes: str
    """File that is there when it is done, from the folder of the runs."""
    make: Callable[[Runs], None]
    """Make it."""


def command(runs: Runs, *words: object) -> None:
    """Run a command of surefoot in the folder of the runs; raise `SurefootError` or `KeyboardInterrupt` if it fails."""
    from surefoot.cli.main import main

    given = [str(word) for word in words]
    runs.console.print(shlex.join(["surefoot", *given]), style="bold")
    with contextlib.chdir(runs.folder):
        code = main(given)
    if code == 130:
        raise KeyboardInterrupt
    if code != 0:
        raise SurefootError(f"surefoot {shlex.join(given)}: ended with exit code {code}")


def train(task: str, steps: int) -> Stage:
    """Train a policy of a task, from a run that was stopped if there is one, and keep file and figures."""

    def make(runs: Runs) -> None:
        begun = sorted((runs.folder / "runs" / task).glob("*/config.yaml"))
        if begun:
            command(runs, "train", "--resume", begun[-1].parent)
        else:
            given = runs.root / "examples" / f"{task}.yaml" if task in HYBRIDS else task
            command(runs, "train", given, "--runs", "runs", *runs.small("--steps", steps))
        (run,) = (path.parent for path in (runs.folder / "runs" / task).glob("*/config.yaml"))
        target = runs.folder / "policies"
        (target / task).mkdir(parents=True, exist_ok=True)
        for name in _PICTURES:
            # A training in which no episode has ended has no curve.
            if (run / "figures" / name).exists():
                shutil.copy(run / "figures" / name, target / task / name)
        shutil.copy(run / "policy.onnx", target / f"{task}.onnx")

    return Stage(f"policies/{task}.onnx", make)


def evaluate(makes: str, task: str, *words: object, quick: tuple[object, ...] = ()) -> Stage:
    """Evaluate a policy; keep what `--json` prints."""

    def make(runs: Runs) -> None:
        path = runs.folder / makes
        path.parent.mkdir(parents=True, exist_ok=True)
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            command(runs, "evaluate", f"policies/{task}.onnx", *words, *runs.small(*quick), "--json")
        atomic_write(path, said.getvalue())

    return Stage(makes, make)


def motor_figure(runs: Runs) -> None:
    """Let both models of the motor follow what a motor with friction did in Bullet."""
    log = "results/motor.csv"
    (runs.folder / "results").mkdir(exist_ok=True)
    (runs.folder / "docs").mkdir(exist_ok=True)
    friction = ("--world", "bullet", "--set", "motor_friction=0.02")
    command(runs, "identify", "motor-figure", "--record", log, *friction, "--out", "docs/motor.png")
    command(runs, "identify", "motor-figure", "--log", log, "--out", "docs/motor.png")


def pushes_figure(runs: Runs) -> None:
    """Draw falls over the force of every push."""
    (runs.folder / "docs").mkdir(exist_ok=True)
    policies, small = [f"policies/{task}.onnx" for task in POLICIES], runs.small("--values", 4, "--episodes", 4)
    words = (*("--ranges", "none", "--push-force", 0, 220, "--values", 12, "--episodes", 20), *small)
    command(runs, "sensitivity", *policies, *words, "--out", "results/push-force")
    shutil.copy(runs.folder / "results" / "push-force" / "push_force.png", runs.folder / "docs" / "pushes.png")


def study(name: str, steps: int, *only: str) -> Stage:
    """Run a study of the clone; its small version has one seed and some of the groups."""

    def make(runs: Runs) -> None:
        small = runs.small("--steps", steps, "--seeds", 0, *(("--only", *only) if only else ()))
        command(runs, "study", runs.root / "studies" / f"{name}.yaml", *runs.many(), *small)

    return Stage(f"results/{name}/summary.json", make)


def tune(gait: str, speed: float) -> Stage:
    """Tune a handcrafted gait."""
    makes = f"results/handcrafted/{gait}-{round(100 * speed)}.yaml"

    def make(runs: Runs) -> None:
        (runs.folder / makes).parent.mkdir(parents=True, exist_ok=True)
        # The gait is written after every generation: whole only under its own name.
        part = Path(makes).with_suffix(".part.yaml")
        command(runs, "tune", "--gait", gait, "--speed", speed, "--out", part, *runs.small("--generations", 12))
        (runs.folder / part).rename(runs.folder / makes)

    return Stage(makes, make)


def handcrafted(runs: Runs) -> None:
    """Compare handcrafted gaits with learned ones."""
    script, policies = (
        runs.root / "benchmarks" / "handcrafted.py",
        [f"policies/{task}.onnx" for task in (*POLICIES, *HYBRIDS)],
    )
    words = [sys.executable, str(script), "results/handcrafted", "--policies", *policies]
    small = runs.small("--episodes", 5, "--conditions", "mujoco")
    runs.console.print(shlex.join(["python", *words[1:], *small]), style="bold")
    code = subprocess.run([*words, *small], cwd=runs.folder).returncode
    if code != 0:
        raise SurefootError(f"{script}: ended with exit code {code}")


def search(runs: Runs) -> None:
    """Search settings of the gallop."""
    out = Path("results") / "search"
    again = ["--resume"] if (runs.folder / out / "search.yaml").exists() else []
    small = runs.small("--trials", 4, "--steps", 60_000)
    command(runs, "search", "gallop", "--out", out, *runs.many(), *small, *again)


STAGES = (
    Stage("docs/motor.png", motor_figure),
    *(train(task, steps) for task, steps in zip(POLICIES, (800_000, 300_000, 400_000, 800_000), strict=True)),
    *(evaluate(f"results/policies/{task}.json", task) for task in POLICIES),
    *(evaluate(f"results/policies/{task}-ensemble.json", task, "--world", "ensemble") for task in POLICIES),
    *(
        evaluate(
            f"results/pushes/{task}-{world}-{low}-{high}.json",
            *(task, "--world", world, "--episodes", 100, "--push-force", low, high),
            quick=("--episodes", 10),
        )
        for task in ("trot-robust", "gallop-robust")
        for world in ("mujoco", "bullet")
        for low, high in ((20, 40), (60, 60), (130, 220))
    ),
    Stage("docs/pushes.png", pushes_figure),
    study(
        "reality-gap", 60_000, "baseline", "baseline_pushes", "improved_pushes", "small_randomized", "large_randomized"
    ),
    study("robustness", 60_000),
    study("from-scratch", 100_000),
    tune("trot", 0.6),
    tune("gallop", 1.2),
    *(train(task, 200_000) for task in HYBRIDS),
    Stage("results/handcrafted/table.csv", handcrafted),
    Stage("results/search/README.md", search),
)
"""All runs, in order."""


def make_all(runs: Runs) -> bool:
    """Make what is missing; returns false if that was stopped, and then the same again goes on.

    Raises:
        SurefootError: a command that did not end well; the others' results are kept.
    """
    with describe_os_errors(runs.folder, "made"):
        runs.folder.mkdir(parents=True, exist_ok=True)
    for number, stage in enumerate(STAGES, start=1):
        done = (runs.folder / stage.makes).exists()
        runs.console.print(f"{number} of {len(STAGES)}: {stage.makes}{': is there' if done else ''}")
        if done:
            continue
        try:
            stage.make(runs)
        except KeyboardInterrupt:
            return False
        if not (runs.folder / stage.makes).exists():
            raise SurefootError(f"{stage.makes} was not made; see what was said above")
    return True
