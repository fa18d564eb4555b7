"""Runs for the page of the paper: all commands in order, without those whose result already exists.

`surefoot study paper` calls `main`.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from paper_page import evaluations_on_page, write_page
from rich.console import Console

from surefoot.cli.helpers.options import Ray, Workers, check_folder
from surefoot.cli.helpers.output import make_console
from surefoot.cli.study_paper import PaperCommand
from surefoot.configuration import read_yaml
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import atomic_write
from surefoot.tables import write_csv

QUICK_NOTE = (
    "A small version of everything from a single call: short trainings with one seed, few trials. It only shows that "
    "all parts work; the column 'how measured' describes the full version."
)
POLICIES = ("gallop", "trot", "trot-robust", "gallop-robust")
"""Tasks whose policies are on the page."""
HYBRIDS = ("trot-hybrid", "gallop-hybrid")
"""Tasks in the clone's examples: learned feedback on top of handcrafted trajectories."""
_PICTURES = ("learning_curve.png", "footfalls.png")


@dataclass(frozen=True)
class PaperRuns:
    """Settings of the runs."""

    root: Path
    """Folder of a clone of surefoot, for its studies and benchmarks."""
    folder: Path
    """Folder of all results."""
    quick: bool
    workers: Workers = 0
    ray: Ray = None
    console: Console = field(default_factory=lambda: make_console(stderr=True))

    def workers_options(self) -> list[str]:
        """Return the options of commands with parallel trainings."""
        return ["--workers", str(self.workers), *(["--ray", self.ray] if self.ray else [])]

    def quick_options(self, *words: object) -> list[str]:
        """Return the options of a command's small version; empty for the full version."""
        return list(map(str, words)) if self.quick else []

    def make_folder(self, name: str) -> Path:
        """Make a subfolder of the runs' folder; return its path."""
        path = self.folder / name
        path.mkdir(parents=True, exist_ok=True)
        return path


@dataclass(frozen=True)
class Stage:
    """Step of the runs."""

    makes: str
    """File that exists when the step is done, relative to the folder of the runs."""
    make: Callable[[PaperRuns], None]


def command(runs: PaperRuns, *words: object) -> None:
    """Run a command of surefoot in the folder of the runs.

    Raises:
        SurefootError: the command failed.
        KeyboardInterrupt: it was stopped.
    """
    from surefoot.cli.main import main

    argv = [str(word) for word in words]
    runs.console.print(shlex.join(["surefoot", *argv]), style="bold")
    with contextlib.chdir(runs.folder):
        code = main(argv)
    if code == 130:
        raise KeyboardInterrupt
    if code != 0:
        raise SurefootError(f"surefoot {shlex.join(argv)}: ended with exit code {code}")


def train(task: str, steps: int) -> Stage:
    """Train a task's policy, or resume an interrupted run; copy the policy file and figures."""

    def make(runs: PaperRuns) -> None:
        pattern = f"runs/{task}/*/config.yaml"
        if started := sorted(runs.folder.glob(pattern)):
            command(runs, "train", "--resume", started[-1].parent)
        else:
            source = runs.root / "examples" / f"{task}.yaml" if task in HYBRIDS else task
            command(runs, "train", source, "--out", "runs", *runs.quick_options("--steps", steps))
        (run,) = (path.parent for path in runs.folder.glob(pattern))
        target = runs.make_folder(f"policies/{task}")
        for name in _PICTURES:
            # A training without a finished episode has no learning curve.
            if (run / "figures" / name).exists():
                shutil.copy(run / "figures" / name, target / name)
        shutil.copy(run / "policy.onnx", target.with_suffix(".onnx"))

    return Stage(f"policies/{task}.onnx", make)


def evaluations(runs: PaperRuns) -> None:
    """Evaluate policies for the page's rows, with the options in the clone's results/evaluations.yaml."""
    names, rows = read_yaml(runs.root / "results" / "evaluations.yaml"), []
    for name in evaluations_on_page():
        policy, _, kind = name.partition("/")
        about = names["policies"].get(policy)
        path = runs.root / about["file"] if about else f"policies/{policy}.onnx"
        options = names["sets"][kind or "nominal"]["options"]
        if runs.quick:
            options = re.sub(r"--episodes \d+", "--episodes 5", options)
        with contextlib.redirect_stdout(io.StringIO()) as output:
            command(runs, "evaluate", path, *shlex.split(options), "--json")
        summary = json.loads(output.getvalue())
        rows.append({"name": name, **{key: one for key, one in summary.items() if not isinstance(one, dict)}})
    write_csv(runs.folder / "results" / "evaluations.csv", rows)


def motor_figure(runs: PaperRuns) -> None:
    """Fit both motor models to a motor with friction in Bullet."""
    log = "results/motor_log.csv"
    runs.make_folder("results")
    runs.make_folder("docs")
    friction = ("--world", "bullet", "--set", "motor_friction=0.02")
    command(runs, "identify", "motor-figure", *friction, "--out", log)
    with contextlib.redirect_stdout(io.StringIO()) as output:
        command(runs, "identify", "motor-figure", "--log", log, "--out", "docs/motor.png", "--json")
    atomic_write(runs.folder / "results" / "motor.json", output.getvalue())


def pushes_figure(runs: PaperRuns) -> None:
    """Draw falls over the push force."""
    policies = [f"policies/{task}.onnx" for task in POLICIES]
    words = ("--ranges", "none", "--push-force", 0, 220, "--values", 12, "--episodes", 20)
    small = runs.quick_options("--values", 4, "--episodes", 4)
    command(runs, "evaluate", "sensitivity", *policies, *words, *small, "--out", "results/push-force")
    shutil.copy(runs.folder / "results/push-force/push_force.png", runs.make_folder("docs") / "pushes.png")


def study(name: str, steps: int, *only: str) -> Stage:
    """Run a study of the clone; its small version has one seed and some of the groups."""

    def make(runs: PaperRuns) -> None:
        small = runs.quick_options("--steps", steps, "--seeds", 0, *(("--only", *only) if only else ()))
        command(runs, "study", runs.root / "studies" / f"{name}.yaml", *runs.workers_options(), *small)
        # A study some of whose trainings have failed also writes a report.
        (runs.make_folder(f"results/{name}") / "complete").touch()

    return Stage(f"results/{name}/complete", make)


def tune(gait: str, speed: float) -> Stage:
    """Tune a handcrafted gait."""
    makes = f"results/handcrafted/{gait}-{round(100 * speed)}.yaml"

    def make(runs: PaperRuns) -> None:
        runs.make_folder("results/handcrafted")
        # The gait is written after every generation; the final name marks the end of the tuning.
        part = Path(makes).with_suffix(".part.yaml")
        small = runs.quick_options("--generations", 12)
        command(runs, "study", "tune", "--gait", gait, "--speed", speed, "--out", part, *small)
        (runs.folder / part).rename(runs.folder / makes)

    return Stage(makes, make)


def script(runs: PaperRuns, name: str, *words: object) -> None:
    """Run a script of the clone in the folder of the runs."""
    path = runs.root / name
    argv = [sys.executable, str(path), *map(str, words)]
    runs.console.print(shlex.join(["python", *argv[1:]]), style="bold")
    if code := subprocess.run(argv, cwd=runs.folder).returncode:
        raise SurefootError(f"{path}: ended with exit code {code}")


def open_loop(task: str, name: str) -> Stage:
    """Run the reference of a task without feedback in every world."""
    makes = f"results/{name}.csv"

    def make(runs: PaperRuns) -> None:
        small = runs.quick_options("--episodes", 2)
        script(runs, "examples/open_loop.py", task, "--out", makes, *small)

    return Stage(makes, make)


def handcrafted(runs: PaperRuns) -> None:
    """Compare handcrafted gaits with learned ones."""
    policies = [f"policies/{task}.onnx" for task in (*POLICIES, *HYBRIDS)]
    small = runs.quick_options("--episodes", 5, "--conditions", "mujoco")
    script(runs, "benchmarks/handcrafted.py", "results/handcrafted", "--policies", *policies, *small)


def search(runs: PaperRuns) -> None:
    """Search settings of the gallop."""
    out = Path("results") / "search"
    resume = ["--resume"] if (runs.folder / out / "search.yaml").exists() else []
    small = runs.quick_options("--trials", 4, "--steps", 60_000)
    command(runs, "study", "search", "gallop", "--out", out, *runs.workers_options(), *small, *resume)


STAGES = (
    Stage("results/motor.json", motor_figure),
    *(train(task, steps) for task, steps in zip(POLICIES, (800_000, 300_000, 400_000, 800_000), strict=True)),
    Stage("results/evaluations.csv", evaluations),
    open_loop("trot", "open_loop"),
    open_loop("trot-cosine", "open_loop_cosine"),
    Stage("docs/pushes.png", pushes_figure),
    study(
        "reality-gap", 60_000, "baseline", "baseline_pushes", "improved_pushes", "small_randomized", "large_randomized"
    ),
    study("robustness", 60_000),
    study("from-scratch", 100_000),
    study("from-scratch-motors", 100_000, "strong_damped", "weak_light", "improved"),
    tune("trot", 0.6),
    tune("gallop", 1.2),
    *(train(task, 200_000) for task in HYBRIDS),
    Stage("results/handcrafted/table.csv", handcrafted),
    Stage("results/search/README.md", search),
)
"""All runs, in order."""


def make_all(runs: PaperRuns) -> bool:
    """Run the stages whose results are missing; return False if interrupted. The same call then continues.

    Raises:
        SurefootError: a command failed; other results are kept.
    """
    with describe_os_errors(runs.folder, "made"):
        size, own = runs.make_folder("") / "size.txt", "quick" if runs.quick else "full"
        if not size.exists():
            size.write_text(own)
        if (other := size.read_text().strip()) != own:
            raise SurefootError(f"{runs.folder}: has results of --{other}; give another --out for --{own}")
    for number, stage in enumerate(STAGES, start=1):
        done = (runs.folder / stage.makes).exists()
        runs.console.print(f"{number} of {len(STAGES)}: {stage.makes}{': exists' if done else ''}")
        if done:
            continue
        try:
            stage.make(runs)
        except KeyboardInterrupt:
            return False
        if not (runs.folder / stage.makes).exists():
            raise SurefootError(f"{stage.makes} was not made; see the output above")
    return True


def main(command: PaperCommand, again: str) -> int:
    """Write the page of a clone's results, or produce new results first; return the exit code.

    Args:
        command: the options.
        again: command line that continues after an interruption.

    Raises:
        SurefootError: a command or script failed, or results can't be read.
    """
    root, page, note = command.root, command.out or Path("paper.html"), ""
    if command.quick or command.full:
        from surefoot.studies.workers import check_address

        check_address(command.ray)
        root = (command.out or Path("paper-quick" if command.quick else "paper-full")).resolve()
        check_folder(root)
        page = root / "paper.html"
        runs = PaperRuns(command.root.resolve(), root, command.quick, command.workers, command.ray)
        if not make_all(runs):
            runs.console.print(f"Stopped. To continue:\n  {again}")
            return 130
        note = QUICK_NOTE if command.quick else ""
    missing = write_page(root, page, note, command.root)
    print(f"wrote {page}")
    for name in missing:
        print(f"missing: {name}")
    return 0
