"""A batch of robots spread over processes, for an engine that steps its robots one after another.

Every process has a `SimWorld` of consecutive robots that draw the random numbers of their place in the whole batch,
so results do not depend on the number of processes, to the last bit.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import subprocess
import sys
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.actuation import SHARED_ARRAYS
from surefoot.world.interface import SensorReadings, SimState, Simulation, WorldConfig
from surefoot.world.registry import WORLDS
from surefoot.world.sim_world import SimWorld, check_batch

Rows = TypeVar("Rows", SensorReadings, SimState)

_EXIT_TIMEOUT = 2.0
"""Time [s] that a process has to end by itself."""
_ROWS = ("engine", "control_steps", "noise", "diverged", "starts", "headings")
"""Arrays of a world's state with a row for each robot."""
_idle_processes: list[subprocess.Popen[bytes]] | None = None
"""Processes that wait for the next world; None where none are kept."""


@contextlib.contextmanager
def worker_pool() -> Iterator[None]:
    """Let the processes of a world serve the next one: to start one and load the physics takes seconds.

    With the context end those that no world has then.
    """
    global _idle_processes
    before, pool = _idle_processes, list[subprocess.Popen[bytes]]()
    _idle_processes = pool
    try:
        yield
    finally:
        _idle_processes = before
        _terminate(pool)


def _start() -> subprocess.Popen[bytes]:
    """Start a process that waits for requests; it imports this package, and nothing of the user's script."""
    package = str(Path(__file__).resolve().parents[2])
    paths = [package, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        # One core each: what they compute is too small to be shared between threads.
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    }
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "surefoot.world.process_worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        # Ctrl-C on the terminal is for the process that was started by hand; it ends these.
        process_group=0,
    )


def _release(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Let the processes of a world go, none of which has an answer that was not read."""
    if _idle_processes is None:
        _terminate(processes)
    else:
        _idle_processes.extend(processes)


def _terminate(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
    for process in processes:
        try:
            process.wait(_EXIT_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _join(parts: Sequence[Rows]) -> Rows:
    """Join readings or truths of consecutive robots."""
    columns = {item.name: np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(parts[0])}
    return type(parts[0])(**columns)


def _join_arrays(parts: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """Join arrays of a state by name, of consecutive robots."""
    return {
        name: array if name in SHARED_ARRAYS else np.concatenate([part[name] for part in parts])
        for name, array in parts[0].items()
    }


def _select_rows(arrays: dict[str, Array], share: slice) -> dict[str, Array]:
    """Return of arrays of a state by name the rows of some robots."""
    return {name: array if name in SHARED_ARRAYS else array[share] for name, array in arrays.items()}


class ProcessWorld:
    """A `Simulation` whose robots are stepped by several processes; arguments and errors are those of `SimWorld`.

    The processes, `config.threads` of them, end with this object, when it is closed, or with the process that owns it;
    with `worker_pool` they wait for the next world. One that ends on its own causes a `SurefootError`.
    """

    def __init__(
        self,
        robot: RobotDescription,
        num_envs: int,
        params: PhysicalParams | None,
        seed: int,
        config: WorldConfig,
        engine: str,
    ) -> None:
        check_batch(num_envs, params)
        self.robot, self.num_envs, self.config = robot, num_envs, config
        self.params = PhysicalParams.nominal(robot, num_envs) if params is None else params.rows(np.arange(num_envs))
        count = process_count(num_envs, config)
        bounds = [num_envs * k // count for k in range(count + 1)]
        self._shares = [slice(first, last) for first, last in itertools.pairwise(bounds)]
        self._truths: list[SimState] | None = None
        self.divergences = 0
        self._processes: list[subprocess.Popen[bytes]] = []
        self._finalizer = weakref.finalize(self, _release, self._processes)
        self._processes.extend(_idle_processes.pop() if _idle_processes else _start() for _ in range(count))
        shared = {"robot": robot, "seed": seed, "config": replace(config, threads=1), "engine": engine}
        try:
            self._call(
                "make",
                [
                    {
                        **shared,
                        "num_envs": share.stop - share.start,
                        "params": self.params.rows(np.arange(share.start, share.stop)),
                        "first": share.start,
                    }
                    for share in self._shares
                ],
            )
        except BaseException:
            self._abort()
            raise

    def close(self) -> None:
        """End the processes, or keep them for the next world within a `worker_pool`; this world is closed."""
        self._finalizer()

    def _abort(self) -> None:
        """End the processes, whatever state they are in."""
        if self._finalizer.detach() is not None:
            _terminate(self._processes)

    def _call(self, method: str, arguments: Sequence[Any]) -> list[Any]:
        """Send each process its own arguments; return their answers in order, or raise the error that one reports."""
        if not self._finalizer.alive:
            raise SurefootError("this world is closed, or one of its processes is gone")
        replies = []
        try:
            for process, own in zip(self._processes, arguments, strict=True):
                assert process.stdin is not None
                pickle.dump((method, own), process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
                process.stdin.flush()
            for process in self._processes:
                assert process.stdout is not None
                replies.append(pickle.load(process.stdout))
        except (BrokenPipeError, EOFError, pickle.UnpicklingError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_EXIT_TIMEOUT)
            self._abort()
            raise SurefootError(
                f"a process of the simulated world ended on its own (exit code {process.returncode}); "
                "it may have run out of memory"
            ) from error
        except BaseException:
            self._abort()  # answers that were not read would be taken for those to the next request
            raise
        for succeeded, answer in replies:
            if not succeeded:
                raise answer
        return [answer for _, answer in replies]

    def _split_arguments(self, *arguments: Any) -> list[tuple[Any, ...]]:
        """Return the arguments of every process: arrays with a row for each robot are cut to its share."""
        return [tuple(None if item is None else item[share] for item in arguments) for share in self._shares]

    def _store_truths(self, replies: list[tuple[SensorReadings, SimState, int]]) -> SensorReadings:
        readings, truths, divergences = zip(*replies, strict=True)
        self._truths, self.divergences = list(truths), sum(divergences)
        return _join(readings)

    def _split_index(self, index: ArrayLike | None) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Return for each process the places in `index` of its robots, and their numbers there."""
        rows = np.arange(self.num_envs) if index is None else np.atleast_1d(np.asarray(index, np.int64))
        rows = np.where(rows < 0, rows + self.num_envs, rows)
        if np.any((rows < 0) | (rows >= self.num_envs)):
            raise IndexError(f"the world has {self.num_envs} robots; index is {rows.tolist()}")
        split = []
        for share in self._shares:
            places = np.flatnonzero((rows >= share.start) & (rows < share.stop))
            split.append((places, rows[places] - share.start))
        return split

    def reset(self, index: ArrayLike | None = None) -> SensorReadings:
        """Bring the robots at `index` (all, if none is given) to the resting pose; return readings of all robots."""
        return self._store_truths(self._call("reset", [(rows,) for _, rows in self._split_index(index)]))

    def step(self, target: ArrayLike, active: NDArray[np.bool_] | None = None) -> SensorReadings:
        """Hold motor angles (N, M) [rad] for one control step of each (active) robot; return readings at its end."""
        angles = np.broadcast_to(np.asarray(target, float), (self.num_envs, self.robot.num_motors))
        return self._store_truths(self._call("step", self._split_arguments(angles, active)))

    def readings(self) -> SensorReadings:
        """Return the present readings again."""
        return _join(self._call("readings", self._split_arguments()))

    def truth(self) -> SimState:
        """Return the true state; the arrays belong to the caller."""
        if self._truths is None:
            self._truths = self._call("truth", self._split_arguments())
        return _join(self._truths)

    def foot_positions(self) -> Array:
        """Return the centres of the rounded feet in the world frame [m], (N, L, 3)."""
        return np.concatenate(self._call("foot_positions", self._split_arguments()))

    def set_params(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Give the robots at `index` other physical parameters, one row each; see `SimWorld.set_params`."""
        rows = np.atleast_1d(np.asarray(index, np.int64))
        params.check(self.robot)
        self._truths = None
        self._call("set_params", [(own, params.rows(places)) for places, own in self._split_index(index)])
        self.params.set_rows(rows, params)

    def place(self, index: ArrayLike, starts: Array, headings: Array) -> None:
        """Let robots rest at other places and headings from their next reset on; see `SimWorld.place`."""
        places, turned = np.asarray(starts, float), np.asarray(headings, float)
        self._call("place", [(own, places[rows], turned[rows]) for rows, own in self._split_index(index)])

    def push(self, force_world: ArrayLike) -> None:
        """Set the force (N, 3) [N] on each base's centre of mass from now on, in the world frame."""
        self._call("push", self._split_arguments(np.asarray(force_world, float)))

    def get_state(self) -> dict[str, Any]:
        """Return the whole state of the world, as a single `SimWorld` does."""
        states = self._call("get_state", self._split_arguments())
        own = [share.stop - share.start for share in self._shares]
        # Each part has the streams of its robots' sensors, then those of their starts.
        sensors = [stream for state, n in zip(states, own, strict=True) for stream in state["streams"][:n]]
        starts = [stream for state, n in zip(states, own, strict=True) for stream in state["streams"][n:]]
        return {
            **_join_arrays([{key: state[key] for key in _ROWS} for state in states]),
            **{part: _join_arrays([state[part] for state in states]) for part in ("actuation", "params")},
            "streams": sensors + starts,
            "divergences": sum(state["divergences"] for state in states),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state`, exactly; the state may come from any number of processes, or from a `SimWorld`."""
        params = PhysicalParams(**state["params"])
        params.check(self.robot)
        self.params.set_rows(np.arange(self.num_envs), params)
        count, parts = self.num_envs, []
        for number, share in enumerate(self._shares):
            sensors, starts = state["streams"][:count][share], state["streams"][count:][share]
            own = {
                **_select_rows({key: state[key] for key in _ROWS}, share),
                **{part: _select_rows(state[part], share) for part in ("actuation", "params")},
                "streams": [*sensors, *starts],
                "divergences": state["divergences"] if number == 0 else 0,
            }
            parts.append((own,))
        self._truths = None
        self.divergences = sum(self._call("set_state", parts))


def process_count(num_envs: int, config: WorldConfig) -> int:
    """Return the number of processes for so many robots: as given, one a core if 0, at most one a robot."""
    return max(1, min(config.threads or os.cpu_count() or 1, num_envs))


def make_distributed_world(
    robot: RobotDescription, num_envs: int, params: PhysicalParams | None, seed: int, config: WorldConfig, engine: str
) -> Simulation:
    """Return simulated robots: in this process if one is enough, else on `config.threads` processes.

    Raises:
        SurefootError: as `SimWorld`, or more robots than so many processes can hold.
    """
    processes, most = process_count(num_envs, config), WORLDS[engine].max_robots
    if most is not None and num_envs > most * processes:
        raise SurefootError(
            f"num_envs is {num_envs}; world {engine} holds up to {most} robots in each of {processes} processes"
        )
    make = SimWorld if processes == 1 else ProcessWorld
    return make(robot, num_envs, params, seed, config, engine)
