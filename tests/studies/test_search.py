"""Search without trainings: proposals, recorded results, and damaged journals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("optuna")

from surefoot.configuration import write_yaml
from surefoot.errors import SurefootError
from surefoot.studies.search import Search, SearchConfig, make_config
from surefoot.studies.search_space import get_value
from surefoot.studies.training import Training
from surefoot.studies.workers import ProgressReport

SPACE = """
ppo.learning_rate: {low: 0.0001, high: 0.01, log: true}
ppo.epochs: {low: 1, high: 9, int: true}
ppo.value_hidden: {choices: [[16, 16], [32, 32]]}
"""
STEPS = 1000


def make(folder: Path, seed: int = 3) -> SearchConfig:
    (folder / "space.yaml").write_text(SPACE)
    return make_config("gallop", folder / "space.yaml", seed, STEPS)


def settings(training: Training) -> tuple[Any, ...]:
    names = ("ppo.learning_rate", "ppo.epochs", "ppo.value_hidden")
    return training.config.seed, *(get_value(training.config, name) for name in names)


def evaluated(steps: int, value: float) -> dict[str, Any]:
    return {"steps": steps, "return_mean": value}


def finish(search: Search, training: Training, value: float, steps: int = STEPS) -> None:
    """Simulate a worker's training to some steps, with the same return in all evaluations, including its folder."""
    every = search.config.train.evaluate_every
    evaluations = tuple(evaluated(n * every, value) for n in range(1, steps // every + 1))
    training.path.mkdir(parents=True, exist_ok=True)
    write_yaml(training.path / "config.yaml", training.config)
    search.on_report(training, ProgressReport(steps, None, evaluations, True))


def values(search: Search) -> list[tuple[int, str, Any, Any]]:
    return [(trial.number, trial.state.name, trial.value, trial.params) for trial in search.study.trials]


def test_the_same_seed_proposes_the_same_trials_with_and_without_interruption(tmp_path: Path) -> None:
    evaluations = []
    for name, seed, stops in (("a", 3, False), ("b", 3, True), ("c", 4, False)):
        (tmp_path / name).mkdir()
        search, proposed = Search(make(tmp_path, seed), tmp_path / name, False), []
        while len(proposed) < 15:
            if stops:
                search = Search(search.config, tmp_path / name, True)
            training = next(search.trainings(100))
            proposed.append(settings(training))
            finish(search, training, training.config.ppo.learning_rate)
        evaluations.append(proposed)
        # Returns increase with the learning rate, and so do the sampler's last proposals.
        assert len({seed for seed, *_ in proposed}) == 15
    assert evaluations[0] == evaluations[1]
    assert not set(map(str, evaluations[0])) & set(map(str, evaluations[2]))


def test_an_interrupted_trial_resumes_as_the_same_trial(tmp_path: Path) -> None:
    search = Search(make(tmp_path), tmp_path, False)
    trials = search.trainings(4)
    first, second = next(trials), next(trials)
    assert not search.on_report(first, ProgressReport(100, None, (evaluated(100, 0.5),)))
    finish(search, second, 1.0)
    again = Search(search.config, tmp_path, True)
    assert again.counts == {"running": 1, "complete": 1}
    trials = again.trainings(4)
    taken = next(trials)
    assert taken == first
    # A worker's first report has all evaluations so far; recorded ones are kept.
    assert not again.on_report(taken, ProgressReport(200, None, (evaluated(100, 9.9), evaluated(200, 0.6))))
    assert again.study.trials[0].intermediate_values == {1: 0.5, 2: 0.6}
    finish(again, taken, 0.7)
    rest = list(trials)
    assert [training.group for training in rest] == ["trial_0002", "trial_0003"]
    for training in rest:
        finish(again, training, 0.1)
    assert again.counts == {"complete": 4}
    assert again.study.best_trial.number == 1
    assert list(Search(search.config, tmp_path, True).trainings(4)) == []


def test_a_poor_trial_is_pruned_after_a_third(tmp_path: Path) -> None:
    search = Search(make(tmp_path), tmp_path, False)
    trials = search.trainings(20)
    for _ in range(8):
        finish(search, next(trials), 1.0)
    bad, every = next(trials), search.config.train.evaluate_every
    pruned = [search.on_report(bad, ProgressReport(n * every, None, (evaluated(n * every, 0.2),))) for n in range(1, 5)]
    assert pruned == [False, False, False, True]
    finish(search, bad, 0.2, 4 * every)
    good = next(trials)
    assert not any(
        search.on_report(good, ProgressReport(n * every, None, (evaluated(n * every, 1.2),))) for n in range(1, 10)
    )
    finish(search, good, 1.2)
    failed = next(trials)
    search.on_change(failed, "failed", "the leg broke")
    assert [trial.state.name for trial in search.study.trials] == ["COMPLETE"] * 8 + ["PRUNED", "COMPLETE", "FAIL"]
    assert search.study.trials[10].user_attrs == {"why": "the leg broke"}
    assert search.study.trials[8].value == 0.2
    assert sum(search.importance().values()) == pytest.approx(1)


def test_incompatible_settings_fail_only_their_trial(tmp_path: Path) -> None:
    """One sample per update is fewer than the four minibatches, although each value by itself is valid."""
    (tmp_path / "space.yaml").write_text("num_envs: {choices: [1, 8]}\nsteps_per_update: {choices: [1, 8]}")
    config = make_config("gallop", tmp_path / "space.yaml", 0, STEPS)
    search = Search(config, tmp_path, False)
    yielded = list(search.trainings(12))
    failed = [trial for trial in search.study.trials if trial.state.name == "FAIL"]
    assert failed
    assert len(yielded) + len(failed) == 12
    assert all("gives fewer samples than" in trial.user_attrs["why"] for trial in failed)


def damaged(folder: Path, harm: Callable[[bytes], bytes]) -> tuple[Search, bytes]:
    """Return a search with three finished trials and one running trial, whose journal is damaged by `harm`."""
    search = Search(make(folder), folder, False)
    trials = search.trainings(4)
    for value in (0.1, 0.3, 0.2):
        finish(search, next(trials), value)
    last = next(trials)
    last.path.mkdir(parents=True)
    write_yaml(last.path / "config.yaml", last.config)
    content = harm(search.journal.read_bytes())
    search.journal.write_bytes(content)
    return search, content


@pytest.mark.parametrize("left", [1.0, 0.95, 0.6, 0.3, 0.0])
def test_an_incomplete_last_record_loses_nothing(tmp_path: Path, left: float) -> None:
    before, content = damaged(tmp_path, lambda content: content[: round(left * len(content)) - 3 * (left == 1.0)])
    wanted = [(number, params) for number, _, _, params in values(before)]
    search = Search(before.config, tmp_path, True)
    assert [note.count("\n") for note in search.notes] == [0] * bool(content)
    for training in search.trainings(4):
        number = int(training.group[-4:])
        # The worker detects the finished training, and reports the evaluations in its folder.
        finish(search, training, (0.1, 0.3, 0.2, 0.4)[number])
    assert [(number, params) for number, _, _, params in values(search)] == wanted
    assert [value for *_, value, _ in values(search)] == [0.1, 0.3, 0.2, 0.4]
    assert search.counts == {"complete": 4}


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda c: c[:100] + b"\n" + c[100:], r"trials\.log: line 1 of \d+ is not a record of a search; restore"),
        (lambda c: b"\x80\x81" + c, "line 1 of"),
        (lambda c: b"[1]\n" + c, "line 1 of"),
        (lambda c: c + b'{"op_code": 99}\n', r"trials\.log: Optuna can't read it"),
        (lambda c: c.replace(b'"op_code":4', b'"op_code":5'), "Optuna can't read it"),
    ],
)
def test_a_journal_with_other_damage_is_rejected_and_unchanged(
    tmp_path: Path, harm: Callable[[bytes], bytes], message: str
) -> None:
    before, content = damaged(tmp_path, harm)
    with pytest.raises(SurefootError, match=message) as refused:
        Search(before.config, tmp_path, True)
    assert "\n" not in str(refused.value)
    assert before.journal.read_bytes() == content


def test_another_search_is_rejected(tmp_path: Path) -> None:
    config = make(tmp_path)
    Search(config, tmp_path, False)
    with pytest.raises(SurefootError, match="already has a search; resume it with --resume"):
        Search(config, tmp_path, False)
    with pytest.raises(SurefootError, match="the search there has seed 3, this one 4; use the same"):
        Search(replace(config, seed=4), tmp_path, True)
    train = replace(config.train, steps=7)
    with pytest.raises(SurefootError, match=r"the search there has train\.steps 1000, this one 7"):
        Search(replace(config, train=train), tmp_path, True)
    one = {name: config.space[name] for name in ("ppo.epochs", "ppo.value_hidden")}
    with pytest.raises(SurefootError, match=r"there has ppo\.learning_rate Dimension\(low=0\.0001.*, this one None"):
        Search(replace(config, space=one), tmp_path, True)


def test_a_lock_of_a_killed_search_is_removed(tmp_path: Path) -> None:
    search = Search(make(tmp_path), tmp_path, False)
    Path(f"{search.journal}.lock").symlink_to(search.journal)
    again = Search(search.config, tmp_path, True)
    assert next(again.trainings(1)).group == "trial_0000"
    assert all(isinstance(json.loads(line), dict) for line in search.journal.read_text().splitlines())
