"""Recorded traces: search in folders and assignment to policies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluation.recorded import assign_to_policies, find_traces, ground_for_trace, save_runs
from surefoot.task.trace import EpisodeTrace

MakeRun = Callable[..., EpisodeTrace]


def test_traces_are_found_in_all_subfolders(tmp_path: Path, make_run: MakeRun):
    places = [tmp_path / "b.npz", tmp_path / "a" / "deep" / "x.npz", tmp_path / "a" / "a.npz"]
    for distance, place in enumerate(places):
        make_run(float(distance)).save(place)
    (tmp_path / "notes.txt").write_text("not a trace")
    recorded = find_traces(tmp_path)
    assert [path for path, _ in recorded] == sorted(places)
    assert [path for path, _ in find_traces(places[1])] == [places[1]]


def test_the_ground_of_a_trace_is_generated_and_never_read_from_a_file(tmp_path: Path, make_run: MakeRun):
    ground = ground_for_trace(make_run(terrain="blocks:0.1", seed=3))
    assert ground is ground_for_trace(make_run(2.0, terrain="blocks:0.1", seed=3))
    assert (ground.corners != ground_for_trace(make_run(terrain="blocks:0.1", seed=4)).corners).any()
    for name in ("flat", "field", "map.npz", str(tmp_path / "a:1.npz"), "stairs:0.1.png"):
        assert ground_for_trace(make_run(terrain=name)).is_flat
    with pytest.raises(SurefootError, match="terrain stairs: size is 99 m"):
        ground_for_trace(make_run(terrain="stairs:99"))


def test_a_map_file_is_the_ground_of_traces_with_its_name(tmp_path: Path, make_run: MakeRun):
    heights = np.zeros((41, 41))
    heights[30:] = 0.2
    np.savez(tmp_path / "hill.npz", heights=heights, cell=0.1)
    trace = make_run(terrain="hill.npz")
    assert ground_for_trace(trace, tmp_path / "hill.npz").height(np.array([1.5, 0.0])) == pytest.approx(0.2)
    assert ground_for_trace(trace).is_flat
    assert ground_for_trace(make_run(terrain="other.npz"), tmp_path / "hill.npz").is_flat


def test_find_traces_rejects_a_folder_without_traces(tmp_path: Path):
    with pytest.raises(SurefootError, match="nowhere does not exist"):
        find_traces(tmp_path / "nowhere")
    with pytest.raises(SurefootError, match="has no traces"):
        find_traces(tmp_path)


def test_find_traces_rejects_a_damaged_file(tmp_path: Path, make_run: MakeRun):
    make_run().save(tmp_path / "good.npz")
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "zcut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SurefootError, match=r"zcut.npz: is cut off, damaged"):
        find_traces(tmp_path)


def test_save_runs_removes_earlier_runs(tmp_path: Path, make_run: MakeRun):
    save_runs(tmp_path, [make_run(), make_run()])
    save_runs(tmp_path, [make_run()])
    assert [path.name for path in tmp_path.iterdir()] == ["run_000.npz"]


def test_traces_are_assigned_to_policies_by_name(make_run: MakeRun):
    recorded = [(Path(f"{i}.npz"), make_run(policy=name)) for i, name in enumerate(("gallop", "trot", "gallop"))]
    assigned = assign_to_policies(recorded, ["trot", "gallop"], "minitaur")
    assert {name: [path.stem for path, _ in traces] for name, traces in assigned.items()} == {
        "trot": ["1"],
        "gallop": ["0", "2"],
    }


def test_a_trace_without_a_policy_belongs_to_the_only_one(make_run: MakeRun):
    recorded = [(Path("a.npz"), make_run(policy="")), (Path("b.npz"), make_run(policy="trot"))]
    assert len(assign_to_policies(recorded, ["trot"], "minitaur")["trot"]) == 2
    with pytest.raises(SurefootError, match=r"a.npz: names no policy; policies: trot, gallop"):
        assign_to_policies(recorded, ["trot", "gallop"], "minitaur")


@pytest.mark.parametrize(
    ("policies", "robot", "message"),
    [
        (["gallop"], "minitaur", r"a.npz: is of policy 'trot'; policies: gallop"),
        (["trot", "gallop"], "minitaur", r"policy 'gallop' has no trace next to a.npz"),
        (["trot"], "spot", r"a.npz: is of robot 'minitaur'; the policies are for 'spot'"),
    ],
)
def test_assign_rejects_traces_of_another_policy_or_robot(
    policies: list[str], robot: str, message: str, make_run: MakeRun
):
    with pytest.raises(SurefootError, match=message):
        assign_to_policies([(Path("a.npz"), make_run())], policies, robot)
