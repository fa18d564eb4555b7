"""Evaluate the policies in results/evaluations.yaml, and write their metrics to results/evaluations.csv.

    python benchmarks/evaluations.py                 # missing and stale rows
    python benchmarks/evaluations.py 'trot*' gallop/bullet --again

A row is called POLICY (options of the set `nominal`) or POLICY/SET; `surefoot evaluate` with the row's command prints
its metrics. A row is stale if the policy's file, its training or the options have changed. `policies` in the YAML file
lists policies that do not ship: a file in the repository, or a `training` (the words after `surefoot train`), whose run
is in a folder of its name in `--runs`; `--train` trains missing ones. A name in braces is another policy's run:
`--start-from {steer-spot}`. Without its run, the row of such a policy is kept unchanged.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import re
import shlex
import sys
from contextlib import redirect_stdout
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from surefoot.api.policies import released_policies
from surefoot.cli import evaluate, train
from surefoot.configuration import read_yaml
from surefoot.evaluation.statistics import proportion_interval
from surefoot.tables import read_csv, write_csv

ROOT = Path(__file__).resolve().parents[1]
NAMES, TABLE = (ROOT / "results" / f"evaluations.{kind}" for kind in ("yaml", "csv"))
METRICS = (
    *("robot", "world", "episodes", "falls", "falls_percent_low", "falls_percent_high"),
    *("speed_mean", "speed_std", "power_mean", "return_mean", "return_std", "cost_of_transport_mean", "drift_mean"),
    *("distance_mean", "steps_mean", "saturation", "gait"),
    *(f"{kind}_{name}" for kind in ("rmse", "rmse_stride") for name in ("forward", "sideways", "yaw_rate")),
)
COLUMNS = ("name", *METRICS, "command", "training", "digest")


def named_rows(names: dict[str, Any]) -> dict[str, tuple[str, str]]:
    """Return policy and options of each row that the YAML file lists."""
    known = [*released_policies(), *names["policies"]]
    rows: dict[str, tuple[str, str]] = {}
    for name, one in names["sets"].items():
        for pattern in one["policies"]:
            chosen = [policy for policy in known if fnmatch(policy, pattern)]
            assert chosen, f"{NAMES.name}: set {name}: no policy is called {pattern}"
            rows |= {policy if name == "nominal" else f"{policy}/{name}": (policy, one["options"]) for policy in chosen}
    return rows


def find_file(policy: str, others: dict[str, Any], runs: Path, may_train: bool = False) -> Path | None:
    """Return a policy's file, or None if the run of its training is missing.

    Args:
        policy: name of the policy.
        others: policies that do not ship, by name.
        runs: folder of trainings.
        may_train: whether to train missing policies.
    """
    about = others.get(policy, {})
    if "training" not in about:
        return ROOT / about["file"] if about else released_policies()[policy]
    found = sorted(runs.joinpath(policy).rglob("evaluation.json"))
    if not found and may_train:
        training = about["training"]
        for first in re.findall(r"{(.+?)}", training):
            path = find_file(first, others, runs, may_train)
            assert path is not None
            training = training.replace(f"{{{first}}}", shlex.quote(str(path.parent)))
        words = ["--threads", "1", "--learning-threads", "1", "--out", str(runs / policy)]
        train.main([*shlex.split(training), *words])
        found = sorted(runs.joinpath(policy).rglob("evaluation.json"))
    return found[-1].with_name("policy.onnx") if found else None


def describe(policy: str, options: str, about: dict[str, str], path: Path | None) -> dict[str, str]:
    """Return the columns that tell whether a row is up to date; without the digest if the policy's file is missing."""
    command = f"surefoot evaluate {about.get('file', policy)} {options}".strip()
    digest = {"digest": hashlib.sha256(path.read_bytes()).hexdigest()[:12]} if path else {}
    return {"command": command, "training": about.get("training", ""), **digest}


def read_table() -> dict[str, dict[str, Any]]:
    """Return the rows by name."""
    return {row["name"]: row for row in read_csv(TABLE)}


def measure(path: Path, options: str, threads: int) -> dict[str, Any]:
    """Return the metrics of an evaluation."""
    with redirect_stdout(io.StringIO()) as output:
        evaluate.main([str(path), *shlex.split(options), "--threads", str(threads), "--json"])
    summary = json.loads(output.getvalue())
    falls = proportion_interval([summary["falls"] / summary["episodes"]], summary["episodes"]).scale(100)
    errors = {f"{kind}_{k}": x for kind in ("rmse", "rmse_stride") for k, x in summary.get(kind, {}).items()}
    worst = max((value for value in summary["saturation"].values() if value is not None), default=None)
    row = {**summary, **errors, **falls.columns("falls_percent"), "saturation": worst}
    return {name: f"{row[name]:.9g}" if isinstance(row.get(name), float) else row.get(name) for name in METRICS}


def main() -> int:
    """Run the selected evaluations, and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", default=["*"], help="names of rows, or patterns such as 'go2-*/bullet'")
    parser.add_argument("--again", action="store_true", help="also rows that are up to date")
    parser.add_argument("--train", action="store_true", help="train missing policies")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "evaluations", help="folder of these trainings")
    parser.add_argument("--threads", type=int, default=0)
    arguments = parser.parse_args()
    names = read_yaml(NAMES)
    named = named_rows(names)
    selected = [name for name in named if any(fnmatch(name, pattern) for pattern in arguments.rows)]
    assert selected, f"no row is called {' or '.join(arguments.rows)}"
    for name in selected:
        policy, options = named[name]
        about = names["policies"].get(policy, {})
        path = find_file(policy, names["policies"], arguments.runs, arguments.train)
        made = describe(policy, options, about, path)
        fresh = read_table().get(name, {}).items() >= made.items()
        if path is None and not fresh:
            print(f"{name}: missing or stale, and {arguments.runs} has no run of the policy")
        if path is None or (fresh and not arguments.again):
            continue
        print(name, flush=True)
        row = {"name": name, **measure(path, options, arguments.threads), **made}
        rows = {**read_table(), name: row}  # read again: another process may have written rows
        write_csv(TABLE, [{key: rows[one].get(key) for key in COLUMNS} for one in sorted(rows) if one in named])
    return 0


if __name__ == "__main__":
    sys.exit(main())
