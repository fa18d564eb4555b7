"""A simulated batch of robots distributed over processes, for engines without threads.

Every process has a `SimWorld` with consecutive robots. Random numbers depend on a robot's index in the whole batch, so
that results are identical to the bit for any number of processes.
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
from surefoot.world.interface import SensorReadings, SimState, Simulation, WorldConfig
from surefoot.world.registry import WORLDS
from surefoot.world.sim_world import SimWorld, check_batch

Rows = TypeVar("Rows", SensorReadings, SimState)

_EXIT_TIMEOUT = 2.0
"""Time [s] for a process to exit before it is killed."""
_PER_ROBOT_ARRAYS = ("engine", "control_steps", "noise", "diverged", "starts", "headings")
"""Arrays of a world's state with one row per robot."""
_idle_processes: list[subprocess.Popen[bytes]] | None = None
"""Processes that wait for the next world, or None outside a `worker_pool`."""


@contextlib.contextmanager
def worker_pool() -> Iterator[None]:
    """Context in which worlds reuse the worker processes of closed worlds, since starting one takes seconds.

    At its end, idle processes are terminated.
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
    """Start a worker process, which imports this package but not the user's script."""
    package = str(Path(__file__).resolve().parents[2])
    paths = [package, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        # One thread each, because computations are too small for several threads.
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    }
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "surefoot.world.process_worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        # Ctrl-C on the terminal should only reach the owner process, which ends its workers.
        process_group=0,
    )


def _release(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Release the processes of a world, which have no unread answers: keep them in the pool, or terminate them."""
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
    """Concatenate readings or true states of consecutive robots."""
    measured = [item.name for item in fields(parts[0]) if getattr(parts[0], item.name) is not None]
    return type(parts[0])(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in measured})


def _join_arrays(parts: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """Concatenate the arrays of states of consecutive robots, by name."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _select_rows(arrays: dict[str, Array], rows: slice) -> dict[str, Array]:
    """Select the rows of some robots from the arrays of a state, by name."""
    return {name: array[rows] for name, array in arrays.items()}


class ProcessWorld:
    """A `Simulation` stepped by `config.threads` processes. See `SimWorld` for arguments and errors.

    The processes end with this object, when it is closed, or with the owner process. In a `worker_pool` they wait for
    the next world. If a process ends unexpectedly, the next call raises a `SurefootError`.
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
        self._slices = [slice(first, last) for first, last in itertools.pairwise(bounds)]
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
                        "num_envs": part.stop - part.start,
                        "params": self.params.rows(np.arange(part.start, part.stop)),
                        "first": part.start,
                    }
                    for part in self._slices
                ],
            )
        except BaseException:
            self._abort()
            raise

    def close(self) -> None:
        """Close this world, and end its processes or return them to the `worker_pool`."""
        self._finalizer()

    def _abort(self) -> None:
        """Terminate the processes in any state."""
        if self._finalizer.detach() is not None:
            _terminate(self._processes)

    def _call(self, method: str, arguments: Sequence[Any]) -> list[Any]:
        """Call a method in all processes, each with its own arguments, and return the results in order.

        Raises:
            SurefootError: a closed world, or a process that has ended.
            Exception: an exception that a process raised.
        """
        if not self._finalizer.alive:
            raise SurefootError("this world is closed, or one of its processes has ended")
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
            self._abort()  # unread answers would be mistaken for answers to the next request
            raise
        for succeeded, answer in replies:
            if not succeeded:
                raise answer
        return [answer for _, answer in replies]

    def _split_arguments(self, *arguments: Any) -> list[tuple[Any, ...]]:
        """Split arrays with one row per robot between the processes; None is passed on."""
        return [tuple(None if item is None else item[rows] for item in arguments) for rows in self._slices]

    def _store_truths(self, replies: list[tuple[SensorReadings, SimState, int]]) -> SensorReadings:
        readings, truths, divergences = zip(*replies, strict=True)
        self._truths, self.divergences = list(truths), sum(divergences)
        return _join(readings)

    def _split_index(self, index: ArrayLike | None) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Split robot indices between processes: for each, positions in `index` and robot indices in that process."""
        rows = np.arange(self.num_envs) if index is None else np.atleast_1d(np.asarray(index, np.int64))
        rows = np.where(rows < 0, rows + self.num_envs, rows)
        if np.any((rows < 0) | (rows >= self.num_envs)):
            raise IndexError(f"the world has {self.num_envs} robots; index is {rows.tolist()}")
        split = []
        for part in self._slices:
            positions = np.flatnonzero((rows >= part.start) & (rows < part.stop))
            split.append((positions, rows[positions] - part.start))
        return split

    def reset(self, index: ArrayLike | None = None) -> SensorReadings:
        """Reset the robots at `index` (default: all) to the resting pose; return the readings of all robots."""
        return self._store_truths(self._call("reset", [(rows,) for _, rows in self._split_index(index)]))

    def step(self, target: ArrayLike, active: NDArray[np.bool_] | None = None) -> SensorReadings:
        """Hold motor angles (N, M) [rad] for one control step of each active robot; return the readings at its end."""
        angles = np.broadcast_to(np.asarray(target, float), (self.num_envs, self.robot.num_motors))
        return self._store_truths(self._call("step", self._split_arguments(angles, active)))

    def readings(self) -> SensorReadings:
        """Return the current readings again."""
        return _join(self._call("readings", self._split_arguments()))

    def truth(self) -> SimState:
        """Return the true state, in arrays that the caller may modify."""
        if self._truths is None:
            self._truths = self._call("truth", self._split_arguments())
        return _join(self._truths)

    def foot_positions(self) -> Array:
        """Return the centres of the spherical feet in the world frame (N, L, 3) [m]."""
        return np.concatenate(self._call("foot_positions", self._split_arguments()))

    def set_params(self, index: ArrayLike, params: PhysicalParams) -> None:
        """Set the physical parameters of the robots at `index`, one row per robot; see `SimWorld.set_params`."""
        rows = np.atleast_1d(np.asarray(index, np.int64))
        params.check(self.robot)
        self._truths = None
        self._call("set_params", [(own, params.rows(places)) for places, own in self._split_index(index)])
        self.params.set_rows(rows, params)

    def place(self, index: ArrayLike, starts: Array, headings: Array) -> None:
        """Set positions and headings at which robots start after their next reset; see `SimWorld.place`."""
        positions, angles = np.asarray(starts, float), np.asarray(headings, float)
        self._call("place", [(own, positions[rows], angles[rows]) for rows, own in self._split_index(index)])

    def push(self, force_world: ArrayLike) -> None:
        """Set the force (N, 3) [N] on each base's centre of mass in the world frame, until the next call."""
        self._call("push", self._split_arguments(np.asarray(force_world, float)))

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the world, in the same format as `SimWorld`."""
        states = self._call("get_state", self._split_arguments())
        own = [part.stop - part.start for part in self._slices]
        # Each state has the random streams of its robots' sensors, then the streams of their starts.
        sensors = [stream for state, n in zip(states, own, strict=True) for stream in state["streams"][:n]]
        starts = [stream for state, n in zip(states, own, strict=True) for stream in state["streams"][n:]]
        return {
            **_join_arrays([{key: state[key] for key in _PER_ROBOT_ARRAYS} for state in states]),
            **{part: _join_arrays([state[part] for state in states]) for part in ("actuation", "params")},
            "streams": sensors + starts,
            "divergences": sum(state["divergences"] for state in states),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state from `get_state` of a `ProcessWorld` with any number of processes, or of a `SimWorld`."""
        params = PhysicalParams(**state["params"])
        params.check(self.robot)
        self.params.set_rows(np.arange(self.num_envs), params)
        count, parts = self.num_envs, []
        for number, rows in enumerate(self._slices):
            sensors, starts = state["streams"][:count][rows], state["streams"][count:][rows]
            own = {
                **_select_rows({key: state[key] for key in _PER_ROBOT_ARRAYS}, rows),
                **{part: _select_rows(state[part], rows) for part in ("actuation", "params")},
                "streams": [*sensors, *starts],
                "divergences": state["divergences"] if number == 0 else 0,
            }
            parts.append((own,))
        self._truths = None
        self.divergences = sum(self._call("set_state", parts))


def process_count(num_envs: int, config: WorldConfig) -> int:
    """Return the number of processes: `config.threads`, or one per core if that is 0, but at most one per robot."""
    return max(1, min(config.threads or os.cpu_count() or 1, num_envs))


def make_distributed_world(
    robot: RobotDescription, num_envs: int, params: PhysicalParams | None, seed: int, config: WorldConfig, engine: str
) -> Simulation:
    """Return a `ProcessWorld`, or a `SimWorld` in this process if one process is enough.

    Raises:
        SurefootError: see `SimWorld`; or more robots than the processes can hold.
    """
    processes, limit = process_count(num_envs, config), WORLDS[engine].max_robots
    if limit is not None and num_envs > limit * processes:
        raise SurefootError(
            f"num_envs is {num_envs}; world {engine} holds up to {limit} robots in each of {processes} processes"
        )
    make = SimWorld if processes == 1 else ProcessWorld
    return make(robot, num_envs, params, seed, config, engine)
