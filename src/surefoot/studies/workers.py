"""Many trainings on Ray, a few at a time: on this machine, or on a cluster, where those of lost computers start again.

Each worker is a process that trains for about a second whenever it is asked to, and tells how far it is. So all
decisions are made here, in the process that asked, between two updates of a policy: to go on, to prune, to stop.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import re
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from surefoot.errors import SurefootError, describe_os_errors
from surefoot.studies.training import Training

if TYPE_CHECKING:
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop
    from surefoot.studies.evaluations import FindWorld

PATIENCE = 120.0
"""How long [s] a worker waits for another process to leave a folder: one that lost its parent may need an update."""
TRIES = 3
"""Times that a training is begun, if its processes die, before it is given up."""
_BETWEEN = 1.0
"""Time [s] after which a worker tells how far it is, at the next end of an update."""
_CONNECTING = 5.0
"""How long [s] a cluster may take to answer."""
_FILES = ("config.yaml", "run.json", "figures.jsonl", "policy.onnx")
"""What comes back from a computer that does not share the folder."""
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # It would warn about graphics cards.
    "RAY_worker_niceness": "0",  # As fast as this process, not after everything else on the machine.
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # What dies is told here, in one line.
}


@dataclass(frozen=True)
class Told:
    """How far a training is."""

    steps: int = 0
    """Control steps so far."""
    speed: float | None = None
    """Mean speed of episodes that ended in the last update [m/s]; None if none did."""
    evaluations: tuple[dict[str, Any], ...] = ()
    """Evaluations that are new; all so far, when the training begins."""
    finished: bool = False
    """Whether it is over: its policy is exported."""
    files: dict[str, bytes] = field(default_factory=dict, repr=False)
    """Files of a training that is over, by name."""


@dataclass
class Outcome:
    """What became of trainings."""

    done: list[str] = field(default_factory=list)
    """Names of those that are over."""
    failed: dict[str, str] = field(default_factory=dict)
    """Names of those that failed, each with one line that says why."""
    stopped: bool = False
    """Whether a stop was requested, with trainings left."""


class Worker:
    """A process that trains: one training after another, each in its folder.

    Args:
        find_world: returns what makes the simulation of a world, by name.
        folder: the folder that paths count from.
    """

    def __init__(self, find_world: FindWorld, folder: str) -> None:
        os.makedirs(folder, exist_ok=True)
        os.chdir(folder)
        self._find_world, self._held = find_world, contextlib.ExitStack()
        self._loop: TrainingLoop | None = None

    def begin(self, training: Training) -> Told:
        """Take a training from wherever its folder is.

        Raises:
            SurefootError: the folder is another training's, in use, or damaged.
        """
        from surefoot.learn.folder_lock import folder_lock
        from surefoot.learn.run_folder import RunFolder
        from surefoot.learn.training_loop import TrainingLoop

        # The one before is gone for good: what a `PpoLearner` froze out of the collector's sight too.
        gc.unfreeze()
        gc.collect()
        self._training = training
        with describe_os_errors(training.path, "made"):
            training.path.mkdir(parents=True, exist_ok=True)
        self._held.enter_context(folder_lock(training.path, PATIENCE))
        training.check()
        state = training.state
        if state == "new":
            folder = RunFolder.create_at(training.config, training.path)
        else:
            folder, config = RunFolder.open(training.path)
            training = replace(training, config=config)
        if state == "finished":
            return self._over(folder)
        make_world = self._find_world(training.config.world)
        self._loop = TrainingLoop(training.config, folder, make_world, resume=state == "started")
        if self._loop.finished:
            return self.end(export=True)
        return Told(self._loop.learner.steps, evaluations=tuple(folder.evaluations()))

    def advance(self) -> Told:
        """Train until there is something to tell."""
        assert self._loop is not None
        until = time.monotonic() + _BETWEEN
        while True:
            figures, evaluation = self._loop.step()
            if self._loop.finished:
                return self.end(export=True)
            if evaluation is not None or time.monotonic() > until:
                speed = None if math.isnan(figures.speed_mean) else figures.speed_mean
                return Told(figures.steps, speed, tuple(vars(one) for one in (evaluation,) if one is not None))

    def end(self, export: bool) -> Told:
        """Save the training to go on another time, or export its policy: that is what makes it finished."""
        assert self._loop is not None
        loop, self._loop = self._loop, None
        if not (export and self._training.trial):
            loop.save()
        loop.close()
        if export:
            loop.export(loop.folder.policy, last=self._training.trial)
            return self._over(loop.folder)
        self._held.close()
        return Told(loop.learner.steps)

    def _over(self, folder: RunFolder) -> Told:
        if self._training.trial:
            shutil.rmtree(folder.checkpoints, ignore_errors=True)
        self._held.close()
        files = {name: (folder.path / name).read_bytes() for name in _FILES}
        return Told(folder.rows()[-1]["steps"], None, tuple(folder.evaluations()), True, files)


@contextlib.contextmanager
def ray_cluster(address: str | None, workers: int = 0) -> Iterator[None]:
    """Start Ray on this machine for so many workers, 0 for one a core, or join the cluster at HOST:PORT.

    Raises:
        SurefootError: Ray does not start, or the cluster has no place for this process.
        ModuleNotFoundError: Ray is not installed.
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    import ray

    how: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": True}
    if address is None:
        memory = 100 << 20  # Nothing large is passed around.
        how |= {"num_cpus": workers or os.cpu_count(), "include_dashboard": False, "object_store_memory": memory}
    try:
        ray.init(address or "local", **how)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        where = f"the cluster at {address}" if address else "Ray"
        raise SurefootError(f"{where} can't be used: {_one_line(error)}") from None
    try:
        yield
    finally:
        ray.shutdown()


def check_address(address: str | None) -> None:
    """Refuse the address of a cluster where nothing listens that could be Ray, which itself would try for minutes.

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
            grpc.channel_ready_future(channel).result(timeout=_CONNECTING)
        except grpc.FutureTimeoutError:
            raise SurefootError(
                f"ray is {address}: no Ray answers there within {_CONNECTING:g} s; start one by `ray start --head`, or "
                "leave the option out to run on this machine"
            ) from None


def _one_line(error: BaseException) -> str:
    """Return an error as one line: the message alone, if it is for users."""
    text = " ".join(str(error).split())[:500]
    return text if isinstance(error, SurefootError) else f"{type(error).__name__}: {text}"


@dataclass
class _Slot:
    """A training under way."""

    training: Training
    worker: Any
    fresh: bool
    """Whether the worker was made for it, and may have to wait for a processor."""
    begun: bool = False
    ends_as: str = ""
    """What it will be once the worker has ended it: stopped or pruned."""


def run_trainings(
    trainings: Iterable[Training],
    find_world: FindWorld,
    workers: int,
    on_told: Callable[[Training, Told], bool],
    on_change: Callable[[Training, str, str], None],
    stops: Callable[[], int] = lambda: 0,
) -> Outcome:
    """Run trainings on Ray, which `ray_cluster` has started.

    Args:
        trainings: what is to be done; the next one is taken when a worker is free for it.
        find_world: returns what makes the simulation of a world, by name.
        workers: how many run at a time; 0 means as many as the cluster has processors.
        on_told: called with how far a training is, about once a second and when it is over; true prunes it: its
            policy is exported as it is.
        on_change: called when a training is "started", "done", "pruned", "stopped", "failed", or "lost", which means
            that its process died, so that it goes on from its folder in another one; with one line that says why.
        stops: number of stops requested: one lets the workers save and end, two end them at once.
    """
    import ray

    make_worker: Any = ray.remote(num_cpus=1)(Worker)
    outcome, source = Outcome(), iter(trainings)
    running: dict[Any, _Slot] = {}
    idle: list[Any] = []
    lost: deque[Training] = deque()
    tries: dict[str, int] = {}

    def change(training: Training, what: str, why: str = "") -> None:
        if what == "failed":
            outcome.failed[training.name] = why
        elif what in ("done", "pruned"):
            outcome.done.append(training.name)
        on_change(training, what, why)

    def fail(slot: _Slot, why: str) -> None:
        ray.kill(slot.worker)
        change(slot.training, "failed", why)

    while True:
        asked = stops()
        for ref, slot in list(running.items()) if asked else ():
            if asked > 1 or not slot.begun:
                ray.kill(slot.worker)
                del running[ref]
                change(slot.training, "stopped")
        # A computer that is lost takes its processors with it.
        processors = max(1, int(ray.cluster_resources().get("CPU", 0)))
        for ref, slot in list(running.items()) if len(running) + len(idle) > processors else ():
            if slot.fresh and not slot.begun and idle:
                # It waits for the processor of an idle worker.
                ray.kill(slot.worker)
                del running[ref]
                slot.worker, slot.fresh = idle.pop(), False
                running[slot.worker.begin.remote(slot.training)] = slot
        while not asked and len(running) < min(workers or processors, processors):
            training = lost.popleft() if lost else next(source, None)
            if training is None:
                # Their processors are for those that wait for one.
                for worker in idle:
                    ray.kill(worker)
                idle.clear()
                break
            fresh = not idle
            worker = make_worker.remote(find_world, os.getcwd()) if fresh else idle.pop()
            tries[training.name] = tries.get(training.name, 0) + 1
            running[worker.begin.remote(training)] = _Slot(training, worker, fresh)
            change(training, "started")
        if not running:
            break
        ready, _ = ray.wait(list(running), timeout=0.2)
        for ref in ready:
            slot = running.pop(ref)
            try:
                told: Told = ray.get(ref)
            except ray.exceptions.RayTaskError as error:
                fail(slot, _one_line(error.cause))
                continue
            except ray.exceptions.RayError as error:
                if getattr(error, "actor_init_failed", False):
                    fail(slot, "no worker can be made: is this version of surefoot on every computer of the cluster?")
                elif tries[slot.training.name] >= TRIES:
                    fail(slot, f"its process died {TRIES} times, at last so: {_one_line(error)}")
                else:
                    lost.append(slot.training)
                    change(slot.training, "lost")
                continue
            slot.begun = True
            if told.finished:
                _take(slot.training, told)
            prune = (told.finished or not slot.ends_as) and on_told(slot.training, told)
            if told.finished or slot.ends_as:
                idle.append(slot.worker)
                change(slot.training, slot.ends_as or "done")
            elif asked or prune:
                slot.ends_as = "pruned" if prune else "stopped"
                running[slot.worker.end.remote(prune)] = slot
            else:
                running[slot.worker.advance.remote()] = slot
    outcome.stopped = bool(asked)
    return outcome


def _take(training: Training, told: Told) -> None:
    """Keep what comes from a computer that does not share the folder."""
    if training.policy.exists():
        return
    training.path.mkdir(parents=True, exist_ok=True)
    # The policy comes last: it makes the training finished.
    for name in _FILES:
        (training.path / name).write_bytes(told.files[name])
