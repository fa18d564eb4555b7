"""Recorded traces: found in folders, given to their policies, refused where they do not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from surefoot.errors import SurefootError
from surefoot.evaluate.recorded import by_policy, find_traces, world_of
from surefoot.task.trace import EpisodeTrace

MakeRun = Callable[..., EpisodeTrace]


def test_traces_are_found_in_all_folders_below(tmp_path: Path, make_run: MakeRun):
    places = [tmp_path / "b.npz", tmp_path / "a" / "deep" / "x.npz", tmp_path / "a" / "a.npz"]
    for distance, place in enumerate(places):
        make_run(float(distance)).save(place)
    (tmp_path / "notes.txt").write_text("not a trace")
    found = find_traces(tmp_path)
    assert [path for path, _ in found] == sorted(places)
    assert [path for path, _ in find_traces(places[1])] == [places[1]]


def test_where_there_are_no_traces(tmp_path: Path):
    with pytest.raises(SurefootError, match="nowhere does not exist"):
        find_traces(tmp_path / "nowhere")
    with pytest.raises(SurefootError, match="holds no traces"):
        find_traces(tmp_path)


def test_a_damaged_file_is_named(tmp_path: Path, make_run: MakeRun):
    make_run().save(tmp_path / "good.npz")
    whole = (tmp_path / "good.npz").read_bytes()
    (tmp_path / "zcut.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SurefootError, match=r"zcut.npz: cut off or damaged"):
        find_traces(tmp_path)


def test_traces_of_several_worlds_are_refused(make_run: MakeRun):
    found = [(Path("a.npz"), make_run(world="robot")), (Path("b.npz"), make_run(world="bullet"))]
    assert world_of(found[:1]) == "robot"
    with pytest.raises(SurefootError, match="several worlds: bullet, robot"):
        world_of(found)


def test_traces_go_to_the_policies_that_they_name(make_run: MakeRun):
    found = [(Path(f"{i}.npz"), make_run(policy=name)) for i, name in enumerate(("gallop", "trot", "gallop"))]
    given = by_policy(found, ["trot", "gallop"], "minitaur")
    assert {name: [path.stem for path, _ in traces] for name, traces in given.items()} == {
        "trot": ["1"],
        "gallop": ["0", "2"],
    }


def test_a_trace_without_a_name_is_the_only_policy_s(make_run: MakeRun):
    found = [(Path("a.npz"), make_run(policy="")), (Path("b.npz"), make_run(policy="trot"))]
    assert len(by_policy(found, ["trot"], "minitaur")["trot"]) == 2
    with pytest.raises(SurefootError, match=r"a.npz: names no policy; policies: trot, gallop"):
        by_policy(found, ["trot", "gallop"], "minitaur")


@pytest.mark.parametrize(
    ("policies", "robot", "message"),
    [
        (["gallop"], "minitaur", r"a.npz: is of policy 'trot'; policies: gallop"),
        (["trot", "gallop"], "minitaur", r"no trace beside a.npz is of policy 'gallop'"),
        (["trot"], "spot", r"a.npz: is of robot 'minitaur'; the policies are for 'spot'"),
    ],
)
def test_what_does_not_fit_is_refused(policies: list[str], robot: str, message: str, make_run: MakeRun):
    with pytest.raises(SurefootError, match=message):
        by_policy([(Path("a.npz"), make_run())], policies, robot)
