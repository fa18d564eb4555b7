"""Identification of emulated robots with surefoot's commands: four experiments over the link, as an owner runs them.

Each robot is a separate process (`surefoot emulate`), which is accessible only through its link. It takes its time from
the host's frames, so that the estimates do not depend on the computer's load.
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
from surefoot.learn.folder_lock import folder_lock
from surefoot.studies.hidden_robots import HiddenRobots, other_motors_folder, robot_file, robot_name

SUREFOOT_COMMAND = (sys.executable, "-m", "surefoot")
EXPERIMENTS = {"motor": True, "latency": True, "mass": False, "contact": False}
"""Experiments in the order in which they run, and whether the robot is on its rack."""
_POLL_INTERVAL = 0.2
"""Time [s] between two checks whether the operator has stopped the study."""


@contextlib.contextmanager
def emulated_robot(*options: object) -> Iterator[str]:
    """Run `surefoot emulate --lockstep` with additional options, and yield the name of its port.

    Raises:
        SurefootError: the emulator does not start.
    """
    command = [*SUREFOOT_COMMAND, "emulate", "--lockstep", *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            words = process.stdout.readline().split()
            if not words:
                raise SurefootError(f"surefoot emulate {' '.join(command[4:])}: the emulator did not start")
            yield words[-1]
        finally:
            process.terminate()


def identify_robot(
    options: Sequence[object], path: Path, work: Path, robot: str, stopped: Callable[[], bool] = lambda: False
) -> bool:
    """Identify an emulated robot, and write its parameter file when all experiments are done.

    Args:
        options: options of `surefoot emulate`, without the rack.
        path: the parameter file.
        work: folder for recordings and reports; its earlier content is removed.
        robot: name or folder of the robot description that the owner has.
        stopped: returns whether the operator has stopped the study.

    Returns:
        Whether the file is written; False if the operator has stopped.

    Raises:
        SurefootError: an experiment failed.
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
    """Run an experiment; return False if the operator has stopped it."""
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
    """Return the seeds of the robots that are not identified yet."""
    return [seed for seed in robots.seeds if not robot_file(folder, seed).is_file()]


def identify_robots(
    robots: HiddenRobots,
    folder: Path,
    work: Path,
    workers: int,
    on_end: Callable[[int, str], None],
    stopped: Callable[[], bool] = lambda: False,
) -> dict[int, str]:
    """Identify all robots whose parameter files are missing, several in parallel.

    Args:
        robots: the robots.
        folder: folder of the parameter files.
        work: folder for recordings, reports and robot descriptions.
        workers: number of parallel identifications, each on one core; 0 means one per core.
        on_end: called after each identification with the robot's seed and the error in one line, or an empty string.
        stopped: returns whether the operator has stopped the study.

    Returns:
        Errors by the robot's seed.

    Raises:
        SurefootError: the folder has robots of other settings, or another process identifies robots here.
    """
    robots.check_settings(folder)
    robots.write_settings(folder)
    work.mkdir(parents=True, exist_ok=True)
    ranges = work / "ranges.yaml"
    write_yaml(ranges, to_mapping(robots)["ranges"])
    failed: dict[int, str] = {}

    def identify(seed: int) -> bool:
        true = robots.description(seed, other_motors_folder(work))
        options = ("--world", robots.world, "--robot", true, "--hidden-seed", seed, "--hidden-ranges", ranges)
        path, place = robot_file(folder, seed), work / robot_name(seed)
        return not stopped() and identify_robot((*options, "--seed", seed), path, place, robots.robot, stopped)

    with folder_lock(work, purpose="identifies robots"), ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        futures = {pool.submit(identify, seed): seed for seed in unidentified_robots(robots, folder)}
        for future in as_completed(futures):
            seed, error = futures[future], ""
            try:
                if not future.result():
                    continue
            except SurefootError as problem:
                if stopped():  # Ctrl-C also ends the child processes.
                    continue
                error = failed[seed] = " ".join(str(problem).split())
            on_end(seed, error)
    return failed
