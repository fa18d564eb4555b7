"""Recorded traces of a robot or a simulation: find them in folders, and assign them to policies."""

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
    """Return the trace of a file, or all traces below a folder in order of their paths; at least one.

    Traces that a crash of the control computer cut off (.npz.partial) are included.
    """
    if folder.is_file():
        return [(folder, _load(folder))]
    if not folder.is_dir():
        raise SurefootError(f"trace folder {folder} does not exist; give a folder with traces (.npz)")
    paths = sorted(path for end in ("", SUFFIX) for path in folder.rglob(f"*.npz{end}") if path.is_file())
    if not paths:
        raise SurefootError(f"trace folder {folder} has no traces (.npz), nor have its subfolders")
    return [(path, _load(path)) for path in paths]


def load_robot(path: Path, trace: EpisodeTrace) -> RobotDescription:
    """Return the robot of a trace, see `EpisodeTrace.load_robot`; errors name the trace's file."""
    with prefix_errors(f"trace file {path}"):
        return trace.load_robot()


def ground_for_trace(trace: EpisodeTrace, map_file: Path | None = None) -> Ground:
    """Return the ground of a recorded run; flat ground if it is unknown.

    Args:
        trace: the trace, which stores only a map's name.
        map_file: map to use if it has this name.

    Raises:
        SurefootError: the terrain does not exist.
    """
    if map_file is not None and map_file.name == trace.meta["terrain"]:
        return _read(map_file)
    return _made(trace.meta["terrain"], trace.meta["seed"] or 0)


_read = functools.lru_cache(maxsize=1)(read_map)


@functools.lru_cache(maxsize=16)
def _made(name: str, seed: int) -> Ground:
    # Maps are not read by the name in a trace: traces may come from others.
    return make_terrain(name, seed) if ":" in name and not is_map(name) else FLAT


def save_runs(folder: Path, traces: Sequence[EpisodeTrace], name: str = "run") -> RecordedTraces:
    """Write traces as NAME_000.npz, NAME_001.npz, ... into a folder, and remove its earlier ones."""
    for old in folder.glob(f"{name}_*.npz"):
        old.unlink()
    return [(trace.save(folder / f"{name}_{i:03d}.npz"), trace) for i, trace in enumerate(traces)]


def _load(path: Path) -> EpisodeTrace:
    return recover(path) if path.suffix == SUFFIX else EpisodeTrace.load(path)


def assign_to_policies(recorded: RecordedTraces, policies: Sequence[str], robot: str) -> dict[str, RecordedTraces]:
    """Return the traces of each policy, at least one each, by the policy names in the traces.

    If there is only one policy, traces without a name belong to it.

    Raises:
        SurefootError: a trace is of another robot or policy, or a policy has no trace.
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
            raise SurefootError(f"policy '{name}' has no trace next to {recorded[0][0]}; each policy needs 1 or more")
    return assigned
