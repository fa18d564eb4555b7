"""Traces that were recorded before, by a robot or by a simulation, found in a folder and given to their policies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from surefoot.errors import SurefootError, choices
from surefoot.task.partial_trace import SUFFIX, recover
from surefoot.task.trace import EpisodeTrace

Recorded = list[tuple[Path, EpisodeTrace]]


def find_traces(folder: Path) -> Recorded:
    """All traces in a folder and the folders in it, by path; or the one of a file.

    What a robot's computer had recorded when it died (.npz.partial) is a trace too. One or more are expected.
    """
    if folder.is_file():
        return [(folder, _load(folder))]
    if not folder.is_dir():
        raise SurefootError(f"trace folder {folder} does not exist; give a folder with traces (.npz)")
    paths = sorted(path for end in ("", SUFFIX) for path in folder.rglob(f"*.npz{end}") if path.is_file())
    if not paths:
        raise SurefootError(f"trace folder {folder} holds no traces (.npz), nor do the folders in it")
    return [(path, _load(path)) for path in paths]


def save_runs(folder: Path, traces: Sequence[EpisodeTrace]) -> Recorded:
    """Write traces to run_000.npz and on in a folder, and leave none of those that were there before."""
    for old in folder.glob("run_*.npz"):
        old.unlink()
    return [(trace.save(folder / f"run_{i:03d}.npz"), trace) for i, trace in enumerate(traces)]


def _load(path: Path) -> EpisodeTrace:
    return recover(path) if path.suffix == SUFFIX else EpisodeTrace.load(path)


def world_of(found: Recorded) -> str:
    """Name of the one world that traces were recorded in."""
    names = sorted({str(trace.meta["world"]) for _, trace in found})
    if len(names) > 1:
        raise SurefootError(
            f"traces beside {found[0][0]} come from several worlds: {choices(names)}; give one folder for each"
        )
    return names[0]


def by_policy(found: Recorded, policies: Sequence[str], robot: str) -> dict[str, Recorded]:
    """Give traces of a robot to the policies that they name, one or more to each; one alone also gets the nameless."""
    given: dict[str, Recorded] = {name: [] for name in policies}
    for path, trace in found:
        if trace.meta["robot"] != robot:
            said = f"is of robot '{trace.meta['robot']}'"
            raise SurefootError(f"trace file {path}: {said}; the policies are for '{robot}'")
        name = str(trace.meta["policy"]) or (policies[0] if len(policies) == 1 else "")
        if name not in given:
            said = f"is of policy '{name}'" if name else "names no policy"
            raise SurefootError(f"trace file {path}: {said}; policies: {choices(policies)}")
        given[name].append((path, trace))
    for name, traces in given.items():
        if not traces:
            raise SurefootError(f"no trace beside {found[0][0]} is of policy '{name}'; each policy needs 1 or more")
    return given
