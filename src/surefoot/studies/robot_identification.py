"""Identification of emulated robots by surefoot's own commands: four experiments over the link, as an owner does them.

A robot is a process of its own (`surefoot emulate`), and nothing but the link leads to it. It follows the times in the
host's frames, so that a robot's estimates do not depend on how busy the computer is.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from surefoot.configuration import to_mapping, write_yaml
from surefoot.errors import SurefootError
from surefoot.files import atomic_write
from surefoot.studies.hidden_robots import HiddenRobots, other_motors_folder, robot_file, robot_name

SUREFOOT_COMMAND = (sys.executable, "-m", "surefoot")
EXPERIMENTS = {"motor": True, "latency": True, "mass": False, "contact": False}
"""Whether the robot is on its rack, in the order in which they are made."""
_POLL_INTERVAL = 0.2
"""Time [s] between two looks whether the operator has stopped."""


@contextlib.contextmanager
def emulated_robot(*options: object) -> Iterator[str]:
    """Run `surefoot emulate --lockstep` with more options; give the name of its port.

    Raises:
        SurefootError: it does not start.
    """
    command = [*SUREFOOT_COMMAND, "emulate", "--lockstep", *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            words = process.stdout.readline().split()
            if not words:
                raise SurefootError(f"surefoot emulate {' '.join(command[4:])}: no robot")
            yield words[-1]
        finally:
            process.terminate()


def identify_robot(
    options: Sequence[object], path: Path, work: Path, robot: str, stopped: Callable[[], bool] = lambda: False
) -> bool:
    """Write a file with what the experiments find of an emulated robot; it appears when all are done.

    Args:
        options: of `surefoot emulate`, without the rack.
        path: the file of parameters.
        work: folder for recordings and reports; what it held is removed.
        robot: name or folder of the description that the owner has.
        stopped: whether the operator has stopped.

    Returns:
        whether the file is written; not if the operator has stopped.

    Raises:
        SurefootError: an experiment that ended early, or identified nothing.
    """
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    params = work / "params.toml"
    for name, rack in EXPERIMENTS.items():
        with emulated_robot(*options, *(["--rack"] if rack else [])) as port:
            words = ("--port", port, "--lockstep", "--yes", "--params", params, "--out", work / name, "--robot", robot)
            if not _run_experiment(name, list(map(str, words)), work / f"{name}.txt", stopped):
                return False
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, params.read_bytes())
    return True


def _run_experiment(name: str, words: list[str], log: Path, stopped: Callable[[], bool]) -> bool:
    """Run an experiment to its end; return false if the operator has stopped it."""
    with log.open("w", encoding="utf-8") as output:
        process = subprocess.Popen(
            [*SUREFOOT_COMMAND, "identify", name, *words], stdout=output, stderr=subprocess.STDOUT
        )
        try:
            while process.poll() is None:
                if stopped():
                    return False
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL_INTERVAL)
        finally:
            process.kill()
            process.wait()
    if process.returncode:
        lines = log.read_text(encoding="utf-8").splitlines()
        raise SurefootError(f"experiment {name}: {lines[-1] if lines else f'exit code {process.returncode}'} ({log})")
    return True


def unidentified_robots(robots: HiddenRobots, folder: Path) -> list[int]:
    """Return the seeds of robots that are not identified yet."""
    return [seed for seed in robots.seeds if not robot_file(folder, seed).is_file()]


def identify_robots(
    robots: HiddenRobots,
    folder: Path,
    work: Path,
    workers: int,
    on_end: Callable[[int, str], None],
    stopped: Callable[[], bool] = lambda: False,
) -> dict[int, str]:
    """Identify the robots whose files are missing in a folder, some at a time.

    Args:
        robots: the robots.
        folder: where their files go.
        work: folder for recordings, reports and descriptions.
        workers: how many at a time, each on one core; 0 means one a core.
        on_end: called with a robot's seed when it is identified, or with the error in one line.
        stopped: whether the operator has stopped.

    Returns:
        the errors, by the robot's seed.
    """
    work.mkdir(parents=True, exist_ok=True)
    ranges = work / "ranges.yaml"
    write_yaml(ranges, to_mapping(robots)["ranges"])
    failed: dict[int, str] = {}

    def identify(seed: int) -> bool:
        true = robots.description(seed, other_motors_folder(work))
        options = ("--world", robots.world, "--robot", true, "--hidden-seed", seed, "--hidden-ranges", ranges)
        path, place = robot_file(folder, seed), work / robot_name(seed)
        return not stopped() and identify_robot((*options, "--seed", seed), path, place, robots.robot, stopped)

    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        futures = {pool.submit(identify, seed): seed for seed in unidentified_robots(robots, folder)}
        for future in as_completed(futures):
            seed, error = futures[future], ""
            try:
                if not future.result():
                    continue
            except SurefootError as problem:
                if stopped():  # Ctrl-C ends the processes of a terminal, too.
                    continue
                error = failed[seed] = " ".join(str(problem).split())
            on_end(seed, error)
    return failed
