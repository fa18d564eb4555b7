"""Parallel trainings with Ray, on this machine or on a cluster, where trainings of lost computers are restarted.

Each worker is a process that trains for about a second per call and reports its progress. All decisions to continue,
prune or stop are thus made in the calling process, between two updates of a policy.
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
from surefoot.files import atomic_write
from surefoot.learn.run_config import copied_files
from surefoot.studies.training import Training
from surefoot.task.plugins import Plugin, register_plugin, registered_plugins

if TYPE_CHECKING:
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

LOCK_TIMEOUT = 120.0
"""Time [s] for which a worker waits for a folder's lock: a process whose parent died may first finish an update."""
MAX_ATTEMPTS = 3
"""Number of times that a training is started if its process dies, before it counts as failed."""
_REPORT_PERIOD = 1.0
"""Time [s] after which a worker reports, at the end of the current update."""
_CONNECT_TIMEOUT = 5.0
"""Time [s] within which a cluster must answer."""
_RETURNED_FILES = ("config.yaml", "run.json", "figures.jsonl", "policy.onnx")
"""Files that a computer without the shared folder sends back, in addition to the copies of robot and reference table.
The policy comes last, because it marks a finished run."""
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
    """Evaluations since the last report; in the first report, all so far."""
    finished: bool = False
    """Whether the training is finished and its policy exported."""
    files: dict[str, bytes] = field(default_factory=dict, repr=False)


@dataclass
class TrainingsOutcome:
    """Finished and failed trainings."""

    done: list[str] = field(default_factory=list)
    """Names of the finished trainings."""
    failed: dict[str, str] = field(default_factory=dict)
    """Errors of the failed trainings, in one line each, by name."""
    stopped: bool = False
    """Whether a stop was requested before all were finished."""


class Worker:
    """Worker process that runs one training after another, each in its folder.

    Args:
        folder: working directory, to which paths are relative.
        plugins: plug-ins with terms that the trainings use.
        words: words of the command line, which run folders store; defaults to this process's.
    """

    def __init__(self, folder: str, plugins: Sequence[Plugin] = (), words: Sequence[str] | None = None) -> None:
        os.makedirs(folder, exist_ok=True)
        os.chdir(folder)
        for plugin in plugins:
            register_plugin(plugin)
        self._words, self._lock = words, contextlib.ExitStack()
        self._loop: TrainingLoop | None = None

    def begin(self, training: Training) -> ProgressReport:
        """Begin a training, or resume it from its folder.

        Raises:
            SurefootError: the folder has another training, is in use, or is damaged.
        """
        from surefoot.learn.folder_lock import folder_lock
        from surefoot.learn.run_folder import RunFolder
        from surefoot.learn.training_loop import TrainingLoop
        from surefoot.world.registry import find_world

        # Free the previous training: `PpoLearner` freezes its objects for the garbage collector.
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
            metrics, evaluation = self._loop.step()
            if self._loop.finished:
                return self.end(export=True)
            if evaluation is not None or time.monotonic() > until:
                speed = None if math.isnan(metrics.speed_mean) else metrics.speed_mean
                return ProgressReport(metrics.steps, speed, () if evaluation is None else (vars(evaluation),))

    def end(self, export: bool) -> ProgressReport:
        """Export the policy, which marks the training as finished, or save a checkpoint to resume later."""
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
    """Start Ray on this machine, or join the cluster at the address HOST:PORT.

    Args:
        address: address of the cluster; None for this machine.
        workers: number of workers on this machine; 0 means one per core.

    Raises:
        SurefootError: Ray does not start, or the cluster does not accept this process.
        ModuleNotFoundError: Ray is not installed.
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    import ray

    options: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": True}
    if address is None:
        memory = 100 << 20  # for objects, which are all small
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
    """Check that a Ray cluster answers at an address; Ray itself would try for minutes.

    Raises:
        SurefootError: the address is not HOST:PORT, or no cluster answers.
        ModuleNotFoundError: Ray is not installed.
    """
    import grpc
    import ray  # noqa: F401

    if address is None:
        return
    if re.fullmatch(r"[\w.-]+:\d{1,5}", address) is None:
        raise SurefootError(f"ray is '{address}'; it must be HOST:PORT, as `ray start --head` prints it")
    with grpc.insecure_channel(address, options=[("grpc.enable_http_proxy", 0)]) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=_CONNECT_TIMEOUT)
        except grpc.FutureTimeoutError:
            raise SurefootError(
                f"ray is {address}: no Ray cluster answers within {_CONNECT_TIMEOUT:g} s; start one with "
                "`ray start --head`, or leave the option out to run on this machine"
            ) from None


def _one_line(error: BaseException) -> str:
    """Return an error as one line; without the name of its type if it is a SurefootError."""
    text = " ".join(str(error).split())[:500]
    return text if isinstance(error, SurefootError) else f"{type(error).__name__}: {text}"


@dataclass
class _Job:
    """Running training."""

    training: Training
    worker: Any
    is_new: bool
    """Whether its worker was created for it, and may have to wait for a processor."""
    begun: bool = False
    ends_as: str = ""
    """State after its requested end: stopped or pruned; otherwise empty."""


def run_trainings(
    trainings: Iterable[Training],
    workers: int,
    on_report: Callable[[Training, ProgressReport], bool],
    on_change: Callable[[Training, str, str], None],
    stops: Callable[[], int] = lambda: 0,
) -> TrainingsOutcome:
    """Run trainings on the Ray cluster that `ray_cluster` has started.

    Args:
        trainings: the trainings; the next one is requested when a worker is free.
        workers: number of parallel trainings; 0 means the cluster's number of processors.
        on_report: called about once per second and at the end of a training. If it returns True, the training is
            pruned: its current policy is exported.
        on_change: called when a training is "started", "done", "pruned", "stopped", "failed" (with the error in one
            line), or "lost" (its process died, and another one resumes it from its folder).
        stops: returns the number of requested stops: after one, workers save and end; after two, they are killed.
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
        # The number of processors decreases when a computer is lost.
        processors = max(1, int(ray.cluster_resources().get("CPU", 0)))
        for ref, job in list(running.items()) if len(running) + len(idle) > processors else ():
            if job.is_new and not job.begun and idle:
                # Its new worker waits for a processor that an idle worker occupies: use the idle worker.
                ray.kill(job.worker)
                del running[ref]
                job.worker, job.is_new = idle.pop(), False
                running[job.worker.begin.remote(job.training)] = job
        while not stop and len(running) < min(workers or processors, processors):
            training = lost.popleft() if lost else next(source, None)
            if training is None:
                # Release the processors of idle workers for workers that wait for one.
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
                    fail(job, "no worker can be created: is this version of surefoot on every computer of the cluster?")
                elif attempts[job.training.name] >= MAX_ATTEMPTS:
                    fail(job, f"its process died {MAX_ATTEMPTS} times; the last error: {_one_line(error)}")
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
    """Write the files of a finished training whose computer does not share the folder."""
    if training.policy.exists():
        return
    for name in sorted({*report.files, *_RETURNED_FILES}, key=lambda name: (name == _RETURNED_FILES[-1], name)):
        (training.path / name).parent.mkdir(parents=True, exist_ok=True)
        with describe_os_errors(training.path / name, "written"):
            atomic_write(training.path / name, report.files[name])
