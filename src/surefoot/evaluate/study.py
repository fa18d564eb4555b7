"""Evaluations of a trained policy, kept beside it: each is made once for a policy file and its settings."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from surefoot import __version__
from surefoot.configuration import to_mapping
from surefoot.evaluate.kinds import KINDS, FindWorld, Result
from surefoot.evaluate.rollout import task_from_contract
from surefoot.files import whole_file
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.randomize import load_ranges
from surefoot.task.trace import EpisodeTrace


def kept(policy: Path, kind: str) -> Result | None:
    """The kept result of an evaluation of a policy file as it is now; None if there is none that holds."""
    try:
        record = json.loads(_place(policy, kind).read_text(encoding="utf-8"))
        of = record["of"]
        if "ranges" in of:
            of["ranges"] = _drawn(of["ranges"])
        return record["result"] if of == _identity(policy, kind) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def evaluate(policy: Path, kind: str, find_world: FindWorld, threads: int = 0) -> Result:
    """Evaluate a policy file, or give the kept result; a new one is kept in `evaluations/` beside the file.

    Traces that the kind of evaluation finds worth keeping go to `evaluations/KIND/WORLD/run_000.npz` and on.

    Args:
        policy: the file.
        kind: a kind of evaluation.
        find_world: gives what makes worlds of a name; the kind's settings say which it takes.
        threads: threads of the simulation; 0 means one a core.

    Raises:
        SurefootError: a file that is no policy, or a world that there is not.
    """
    found = kept(policy, kind)
    if found is not None:
        return found
    runtime, what = PolicyRuntime.load(policy), KINDS[kind]
    made = what.run(runtime, task_from_contract(runtime.contract), find_world, what.settings, threads)
    place = _place(policy, kind)
    place.parent.mkdir(exist_ok=True)
    # Before the result: where that is, traces are.
    for world, traces in made.traces.items():
        _keep_traces(place.with_suffix("") / world, traces)
    with whole_file(place) as file:
        file.write(json.dumps({"of": _identity(policy, kind), "result": made.result}).encode() + b"\n")
    return made.result


def _keep_traces(folder: Path, traces: list[EpisodeTrace]) -> None:
    """Write the traces of one world, and leave none of an evaluation before."""
    for old in folder.glob("run_*.npz"):
        old.unlink()
    for number, trace in enumerate(traces):
        trace.save(folder / f"run_{number:03d}.npz")


def _place(policy: Path, kind: str) -> Path:
    return policy.parent / "evaluations" / f"{kind}.json"


def _identity(policy: Path, kind: str) -> dict[str, Any]:
    """What a result belongs to: the policy file and everything that decides what is done with it."""
    settings = dict(KINDS[kind].settings)
    if "ranges" in settings:
        settings["ranges"] = _drawn(to_mapping(load_ranges(settings["ranges"])))
    return {"surefoot": __version__, "policy": hashlib.sha256(policy.read_bytes()).hexdigest(), **settings}


def _drawn(ranges: dict[str, Any]) -> dict[str, Any]:
    """Ranges without the rows that stay nominal: a row that a later version has does not make a result another one."""
    return {row: bounds for row, bounds in ranges.items() if bounds is not None}
