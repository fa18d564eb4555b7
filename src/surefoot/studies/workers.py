"""Many trainings on Ray, a few at a time: on this machine, or on a cluster, where those of lost computers start again.

Each worker is a process that trains for about a second a call and reports its progress. So all decisions, to go on, to
prune or to stop, are made in the process that called, between two updates of a policy.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import re
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from surefoot.errors import SurefootError, describe_os_errors
from surefoot.learn.run_config import copied_files
from surefoot.studies.training import Training
from surefoot.task.plugins import Plugin, register_plugin, registered_plugins

if TYPE_CHECKING:
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

LOCK_TIMEOUT = 120.0
"""How long [s] a worker waits for another process to leave a folder: one that lost its parent may need an update."""
MAX_ATTEMPTS = 3
"""Times that a training is begun, if its processes die, before it is given up."""
_REPORT_PERIOD = 1.0
"""Time [s] after which a worker reports, at the next end of an update."""
_CONNECT_TIMEOUT = 5.0
"""How long [s] a cluster may take to answer."""
_RETURNED_FILES = ("config.yaml", "run.json", "figures.jsonl", "policy.onnx")
"""Files that a computer without the shared folder sends back beside the copies of robot and table; the policy, which
marks the end, comes last."""
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # no warning about graphics cards
    "RAY_worker_niceness": "0",  # the priority of this process, not the lowest
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # deaths are reported here, in one line
}


@dataclass(frozen=True)
class ProgressReport:
    """Progress of a training."""

    steps: int = 0
    speed: float | None = None
    """Mean speed of episodes that ended in the last update [m/s]; None if none did."""
    evaluations: tuple[dict[str, Any], ...] = ()
    """Evaluations since the last report; all so far, when the training begins."""
    finished: bool = False
    """Whether it is over: its policy is exported."""
    files: dict[str, bytes] = field(default_factory=dict, repr=False)


@dataclass
class TrainingsOutcome:
    """Which trainings were finished, and which failed."""

    done: list[str] = field(default_factory=list)
    """Names of those that are over."""
    failed: dict[str, str] = field(default_factory=dict)
    """Error of each that failed, in one line, by name."""
    stopped: bool = False
    """Whether a stop was requested, with trainings left."""


class Worker:
    """A process that trains: one training after another, each in its folder.

    Args:
        folder: the folder that paths count from.
        plugins: plug-ins whose terms the trainings use.
        words: the command's words, which run folders name; those of this process, if None.
    """

    def __init__(self, folder: str, plugins: Sequence[Plugin] = (), words: Sequence[str] | None = None) -> None:
        os.makedirs(folder, exist_ok=True)
        os.chdir(folder)
        for plugin in plugins:
            register_plugin(plugin)
        self._words, self._lock = words, contextlib.ExitStack()
        self._loop: TrainingLoop | None = None

    def begin(self, training: Training) -> ProgressReport:
        """Begin a training, or go on from the state of its folder.

        Raises:
            SurefootError: the folder is another training's, in use, or damaged.
        """
        from surefoot.learn.folder_lock import folder_lock
        from surefoot.learn.run_folder import RunFolder
        from surefoot.learn.training_loop import TrainingLoop
        from surefoot.world.registry import find_world

        # Free the training before, which a `PpoLearner` hides from the collector.
        gc.unfreeze()
        gc.collect()
        self._training = training
        with describe_os_errors(training.path, "made"):
            training.path.mkdir(parents=True, exist_ok=True)
        self._lock.enter_context(folder_lock(training.path, LOCK_TIMEOUT))
        training.check()
        state = training.state
        if state == "new":
            RunFolder.create_at(training.config, training.path, self._words)
        folder, config = RunFolder.open(training.path)
        training = replace(training, config=config)
        if state == "finished":
            return self._last_report(folder)
        make_loop = TrainingLoop.resume if state == "started" else TrainingLoop.create
        self._loop = make_loop(training.config, folder, find_world(training.config.world))
        if self._loop.finished:
            return self.end(export=True)
        return ProgressReport(self._loop.learner.steps, evaluations=tuple(folder.evaluations()))

    def advance(self) -> ProgressReport:
        """Train until the next report is due."""
        assert self._loop is not None
        until = time.monotonic() + _REPORT_PERIOD
        while True:
            figures, evaluation = self._loop.step()
            if self._loop.finished:
                return self.end(export=True)
            if evaluation is not None or time.monotonic() > until:
                speed = None if math.isnan(figures.speed_mean) else figures.speed_mean
                return ProgressReport(figures.steps, speed, () if evaluation is None else (vars(evaluation),))

    def end(self, export: bool) -> ProgressReport:
        """Export the policy, which marks the training as finished, or save the state to go on another time."""
        assert self._loop is not None
        loop, self._loop = self._loop, None
        if not (export and self._training.trial):
            loop.save()
        loop.close()
        if export:
            loop.export(loop.folder.policy, last=self._training.trial)
            return self._last_report(loop.folder)
        self._lock.close()
        return ProgressReport(loop.learner.steps)

    def _last_report(self, folder: RunFolder) -> ProgressReport:
        if self._training.trial:
            shutil.rmtree(folder.checkpoints, ignore_errors=True)
        self._lock.close()
        names = (*_RETURNED_FILES, *copied_files(folder.path))
        files = {name: (folder.path / name).read_bytes() for name in names}
        return ProgressReport(folder.rows()[-1]["steps"], None, tuple(folder.evaluations()), True, files)


@contextlib.contextmanager
def ray_cluster(address: str | None, workers: int = 0) -> Iterator[None]:
    """Start Ray on this machine for a number of workers, 0 for one a core, or join the cluster at HOST:PORT.

    Raises:
        SurefootError: Ray does not start, or the cluster has no place for this process.
        ModuleNotFoundError: Ray is not installed.
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    import ray

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": True}
    if address is None:
        memory = 100 << 20  # of objects, all small
        options |= {"num_cpus": workers or os.cpu_count(), "include_dashboard": False}
        options["object_store_memory"] = memory
    try:
        ray.init(address or "local", **options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        where = f"the cluster at {address}" if address else "Ray"
        raise SurefootError(f"{where} can't be used: {_one_line(error)}") from None
    try:
        yield
    finally:
        ray.shutdown()


def check_address(address: str | None) -> None:
    """Refuse the address of a cluster where no Ray answers; Ray itself would try for minutes.

    Raises:
        SurefootError: no HOST:PORT, or no answer.
        ModuleNotFoundError: Ray is not installed.
    """
    import grpc
    import ray  # noqa: F401

    if address is None:
        return
    if re.fullmatch(r"[\w.-]+:\d{1,5}", address) is None:
        raise SurefootError(f"ray is '{address}'; it must be HOST:PORT, as `ray start --head` shows it")
    with grpc.insecure_channel(address, options=[("grpc.enable_http_proxy", 0)]) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=_CONNECT_TIMEOUT)
        except grpc.FutureTimeoutError:
            raise SurefootError(
                f"ray is {address}: no Ray answers there within {_CONNECT_TIMEOUT:g} s; start one by "
                "`ray start --head`, or leave the option out to run on this machine"
            ) from None


def _one_line(error: BaseException) -> str:
    """Return an error as one line: the message alone, if it is for users."""
    text = " ".join(str(error).split())[:500]
    return text if isinstance(error, SurefootError) else f"{type(error).__name__}: {text}"


@dataclass
class _Job:
    """A training under way."""

    training: Training
    worker: Any
    is_new: bool
    """Whether the worker was made for it, and may have to wait for a processor."""
    begun: bool = False
    ends_as: str = ""
    """Its state once the worker has ended it: stopped or pruned."""


def run_trainings(
    trainings: Iterable[Training],
    workers: int,
    on_report: Callable[[Training, ProgressReport], bool],
    on_change: Callable[[Training, str, str], None],
    stops: Callable[[], int] = lambda: 0,
) -> TrainingsOutcome:
    """Run trainings on Ray, which `ray_cluster` has started.

    Args:
        trainings: the trainings; the next one is taken when a worker is free for it.
        workers: how many run at a time; 0 means as many as the cluster has processors.
        on_report: called about once a second and at the end of a training; true prunes it: its policy is exported as
            it is.
        on_change: called when a training is "started", "done", "pruned", "stopped", "failed" (with the error in one
            line), or "lost": its process died, and it goes on from its folder in another one.
        stops: number of stops requested: one lets the workers save and end, two end them at once.
    """
    import ray

    make_worker: Any = ray.remote(num_cpus=1)(Worker)
    outcome, source = TrainingsOutcome(), iter(trainings)
    running: dict[Any, _Job] = {}
    idle: list[Any] = []
    lost: deque[Training] = deque()
    attempts: dict[str, int] = {}

    def change(training: Training, state: str, error: str = "") -> None:
        if state == "failed":
            outcome.failed[training.name] = error
        elif state in ("done", "pruned"):
            outcome.done.append(training.name)
        on_change(training, state, error)

    def fail(job: _Job, error: str) -> None:
        ray.kill(job.worker)
        change(job.training, "failed", error)

    while True:
        stop = stops()
        for ref, job in list(running.items()) if stop else ():
            if stop > 1 or not job.begun:
                ray.kill(job.worker)
                del running[ref]
                change(job.training, "stopped")
        # A computer that is lost takes its processors with it.
        processors = max(1, int(ray.cluster_resources().get("CPU", 0)))
        for ref, job in list(running.items()) if len(running) + len(idle) > processors else ():
            if job.is_new and not job.begun and idle:
                # It waits for the processor of an idle worker.
                ray.kill(job.worker)
                del running[ref]
                job.worker, job.is_new = idle.pop(), False
                running[job.worker.begin.remote(job.training)] = job
        while not stop and len(running) < min(workers or processors, processors):
            training = lost.popleft() if lost else next(source, None)
            if training is None:
                # Idle workers give their processors to those that wait for one.
                for worker in idle:
                    ray.kill(worker)
                idle.clear()
                break
            is_new = not idle
            worker = make_worker.remote(os.getcwd(), registered_plugins(), sys.argv[1:]) if is_new else idle.pop()
            attempts[training.name] = attempts.get(training.name, 0) + 1
            running[worker.begin.remote(training)] = _Job(training, worker, is_new)
            change(training, "started")
        if not running:
            break
        ready, _ = ray.wait(list(running), timeout=0.2)
        for ref in ready:
            job = running.pop(ref)
            try:
                report: ProgressReport = ray.get(ref)
            except ray.exceptions.RayTaskError as error:
                fail(job, _one_line(error.cause))
                continue
            except ray.exceptions.RayError as error:
                if getattr(error, "actor_init_failed", False):
                    fail(job, "no worker can be made: is this version of surefoot on every computer of the cluster?")
                elif attempts[job.training.name] >= MAX_ATTEMPTS:
                    fail(job, f"its process died {MAX_ATTEMPTS} times, at last so: {_one_line(error)}")
                else:
                    lost.append(job.training)
                    change(job.training, "lost")
                continue
            job.begun = True
            if report.finished:
                _store_files(job.training, report)
            prune = (report.finished or not job.ends_as) and on_report(job.training, report)
            if report.finished or job.ends_as:
                idle.append(job.worker)
                change(job.training, job.ends_as or "done")
            elif stop or prune:
                job.ends_as = "pruned" if prune else "stopped"
                running[job.worker.end.remote(prune)] = job
            else:
                running[job.worker.advance.remote()] = job
    outcome.stopped = bool(stop)
    return outcome


def _store_files(training: Training, report: ProgressReport) -> None:
    """Write the files from a computer that does not share the folder."""
    if training.policy.exists():
        return
    for name in sorted({*report.files, *_RETURNED_FILES}, key=lambda name: (name == _RETURNED_FILES[-1], name)):
        (training.path / name).parent.mkdir(parents=True, exist_ok=True)
        (training.path / name).write_bytes(report.files[name])
