"""Traces that a robot or a simulation recorded: read from folders, and assigned to their policies."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.robot import RobotDescription
from surefoot.task.partial_trace import SUFFIX, recover
from surefoot.task.trace import EpisodeTrace
from surefoot.world.ground import FLAT, Ground
from surefoot.world.terrain import is_map, make_terrain, read_map

RecordedTraces = list[tuple[Path, EpisodeTrace]]


def find_traces(folder: Path) -> RecordedTraces:
    """Return the trace of a file, or all traces in a folder and the folders in it, by path; one or more.

    A trace that was cut off by a crash of the control computer (.npz.partial) counts.
    """
    if folder.is_file():
        return [(folder, _load(folder))]
    if not folder.is_dir():
        raise SurefootError(f"trace folder {folder} does not exist; give a folder with traces (.npz)")
    paths = sorted(path for end in ("", SUFFIX) for path in folder.rglob(f"*.npz{end}") if path.is_file())
    if not paths:
        raise SurefootError(f"trace folder {folder} holds no traces (.npz), nor do the folders in it")
    return [(path, _load(path)) for path in paths]


def load_robot(path: Path, trace: EpisodeTrace) -> RobotDescription:
    """Return the robot of a trace, as `EpisodeTrace.load_robot`; errors name the trace's file."""
    with prefix_errors(f"trace file {path}"):
        return trace.load_robot()


def ground_for_trace(trace: EpisodeTrace, map_file: Path | None = None) -> Ground:
    """Return what a recorded robot stood on; the plane, where a trace does not hold it.

    Args:
        trace: the trace; of a map it has the name alone.
        map_file: a map, taken if it has this name.

    Raises:
        SurefootError: a terrain that does not exist.
    """
    if map_file is not None and map_file.name == trace.meta["terrain"]:
        return _read(map_file)
    return _made(trace.meta["terrain"], trace.meta["seed"] or 0)


_read = functools.lru_cache(maxsize=1)(read_map)


@functools.lru_cache(maxsize=16)
def _made(name: str, seed: int) -> Ground:
    # No map is read whose file a trace names.
    return make_terrain(name, seed) if ":" in name and not is_map(name) else FLAT


def save_runs(folder: Path, traces: Sequence[EpisodeTrace]) -> RecordedTraces:
    """Write traces to run_000.npz and on in a folder, in place of those that were there before."""
    for old in folder.glob("run_*.npz"):
        old.unlink()
    return [(trace.save(folder / f"run_{i:03d}.npz"), trace) for i, trace in enumerate(traces)]


def _load(path: Path) -> EpisodeTrace:
    return recover(path) if path.suffix == SUFFIX else EpisodeTrace.load(path)


def assign_to_policies(recorded: RecordedTraces, policies: Sequence[str], robot: str) -> dict[str, RecordedTraces]:
    """Return the traces of each policy, one or more, by the names in the traces.

    A trace without a name belongs to the policy if there is only one.

    Raises:
        SurefootError: a trace of another robot or policy, or a policy without a trace.
    """
    assigned: dict[str, RecordedTraces] = {name: [] for name in policies}
    for path, trace in recorded:
        if trace.meta["robot"] != robot:
            raise SurefootError(
                f"trace file {path}: is of robot '{trace.meta['robot']}'; the policies are for '{robot}'"
            )
        name = str(trace.meta["policy"]) or (policies[0] if len(policies) == 1 else "")
        if name not in assigned:
            what = f"is of policy '{name}'" if name else "names no policy"
            raise SurefootError(f"trace file {path}: {what}; policies: {choices(policies)}")
        assigned[name].append((path, trace))
    for name, traces in assigned.items():
        if not traces:
            raise SurefootError(f"no trace beside {recorded[0][0]} is of policy '{name}'; each policy needs 1 or more")
    return assigned
