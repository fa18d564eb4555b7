"""Training runs: the same seed, interrupted or not, ends with the same weights; accidents lose nothing."""

from __future__ import annotations

import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.run import TrainingRun
from surefoot.learn.run_folder import RunFolder, read_checkpoint, write_checkpoint
from surefoot.robot.randomization import load_ranges
from surefoot.world.sim_world import SimWorld

# Noise, pushes, ends of episodes and an evaluation all fall into these few updates.
TINY = {
    "num_envs": 16,
    "steps_per_update": 16,
    "steps": 16 * 16 * 5,
    "evaluate_every": 600,
    "evaluation_episodes": 2,
    "checkpoint_every": 512,
    "threads": 1,
    "learning_threads": 1,
    "task": {
        "max_steps": 40,
        "params": {"imu_noise": 0.02},
        "pushes": {"enabled": True, "period": 0.1, "duration": 0.03},
    },
}


def tiny_config(**changes: object) -> TrainConfig:
    return from_mapping(TrainConfig, {**TINY, **changes}, base=load_train_config("trot"))


def train(root: Path, config: TrainConfig, stop_after: int | None = None) -> TrainingRun:
    run = TrainingRun(config, RunFolder.create(config, root), SimWorld)
    updates = []
    run.run(
        lambda *figures: updates.append(figures),
        lambda: stop_after is not None and len(updates) >= stop_after,
    )
    return run


def resume(path: Path) -> TrainingRun:
    folder, config = RunFolder.open(path)
    return TrainingRun(config, folder, SimWorld, resume=True)


def same_weights(a: TrainingRun, b: TrainingRun) -> bool:
    first, second = a.trainer.policy.state_dict(), b.trainer.policy.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> TrainingRun:
    return train(tmp_path_factory.mktemp("whole"), tiny_config())


def test_another_seed_goes_another_way(whole: TrainingRun, tmp_path: Path) -> None:
    other = train(tmp_path, tiny_config(seed=1), stop_after=1)
    assert other.folder.rows()[0]["std_mean"] != whole.folder.rows()[0]["std_mean"]


@pytest.mark.parametrize("stop_after", [1, 3])
def test_a_run_of_the_same_seed_ends_alike_to_the_last_bit_though_it_was_interrupted(
    whole: TrainingRun, tmp_path: Path, stop_after: int
) -> None:
    stopped = train(tmp_path, tiny_config(), stop_after)
    assert not stopped.finished
    again = resume(stopped.folder.path)
    again.run(lambda *_: None)
    assert again.finished
    assert same_weights(whole, again)
    assert again.best == whole.best
    timings = {"rollout_seconds", "learn_seconds", "seconds"}
    rows = [[{k: v for k, v in row.items() if k not in timings} for row in r.folder.rows()] for r in (whole, again)]
    assert rows[0] == rows[1]


def test_a_run_with_drawn_parameters_and_symmetry_resumes_exactly(tmp_path: Path) -> None:
    task = {**TINY["task"], "params": {}, "randomize": load_ranges("table1")}
    config = tiny_config(task=task, ppo={"symmetry": True, "fall_cost": 1.0}, steps=16 * 16 * 3)
    through = train(tmp_path / "through", config)
    stopped = train(tmp_path / "stopped", config, stop_after=2)
    resumed = resume(stopped.folder.path)
    resumed.run(lambda *_: None)
    assert same_weights(resumed, through)


def test_a_run_starts_with_anothers_networks_and_goes_its_own_way(whole: TrainingRun, tmp_path: Path) -> None:
    config = tiny_config(start_from=str(whole.folder.path), seed=5, steps=256)
    run = TrainingRun(config, RunFolder.create(config, tmp_path), SimWorld)
    last = whole.folder.load()["trainer"]["algorithm"]["actor_state_dict"]
    first = run.trainer.policy.state_dict()
    assert all(torch.equal(first[key], last[key]) for key in last)
    assert run.trainer.steps == 0
    run.run(lambda *_: None)
    assert not same_weights(run, whole)
    # Resumed, it goes on from its own state, also when the other run is gone.
    again = resume(run.folder.path)
    assert same_weights(again, run)


def test_networks_that_do_not_fit_are_refused(whole: TrainingRun, tmp_path: Path) -> None:
    config = tiny_config(start_from=str(whole.folder.path), ppo={"policy_hidden": [16]})
    with pytest.raises(SurefootError, match=r"start_from: the other run's networks do not fit"):
        TrainingRun(config, RunFolder.create(config, tmp_path), SimWorld)
    config = tiny_config(start_from=str(tmp_path / "nowhere"))
    with pytest.raises(SurefootError, match=r"nowhere: is not a run folder"):
        TrainingRun(config, RunFolder.create(config, tmp_path), SimWorld)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"num_envs": 128}, "it has the states of 16 robots; num_envs is 128"),
        ({"ppo": {"policy_hidden": [16]}}, "its networks do not fit the configuration: Unexpected key"),
    ],
)
def test_resume_refuses_a_configuration_that_does_not_fit_the_checkpoint(
    whole: TrainingRun, change: dict, reason: str
) -> None:
    with pytest.raises(SurefootError, match=rf"latest\.ckpt: does not fit the run's config\.yaml: {reason}") as caught:
        TrainingRun(tiny_config(**change), whole.folder, SimWorld, resume=True)
    assert "\n" not in str(caught.value)


def test_folder_holds_what_the_run_was_made_with(whole: TrainingRun) -> None:
    about = json.loads((whole.folder.path / "run.json").read_text())
    assert about["seed"] == 0
    assert about["packages"]["torch"].startswith("2.13.0")
    assert RunFolder.open(whole.folder.path)[1] == whole.config
    assert list(whole.folder.path.glob("events.out.tfevents.*"))
    assert len(list(whole.folder.checkpoints.glob("steps_*.ckpt"))) == 3


def test_cut_off_checkpoint_is_refused_and_the_one_before_named(whole: TrainingRun, tmp_path: Path) -> None:
    folder = RunFolder(shutil.copytree(whole.folder.path, tmp_path / "run"))
    content = folder.latest.read_bytes()
    folder.latest.write_bytes(content[: len(content) // 2])
    with pytest.raises(SurefootError, match=r"broken.*previous\.ckpt beside it is whole, at 1024 steps") as error:
        folder.load()
    assert "\n" not in str(error.value)
    folder.previous.unlink()
    with pytest.raises(SurefootError, match=r"broken.*there is no older checkpoint to resume from"):
        folder.load()


def test_one_flipped_bit_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, {"weights": torch.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[-500] ^= 4
    path.write_bytes(content)
    with pytest.raises(SurefootError, match="broken"):
        read_checkpoint(path)


class Intruder:
    """Runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (self.command,)


@pytest.mark.parametrize("inside", ["array", "table"])
def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path, inside: str) -> None:
    """With a digest that fits: whoever writes such a file writes that too."""
    path, mark = tmp_path / "a.ckpt", tmp_path / "was-here"
    bad = Intruder(f"touch {mark}")
    write_checkpoint(path, {"steps": np.array([bad], object) if inside == "array" else bad})
    with pytest.raises(SurefootError, match=r"a\.ckpt: is not a checkpoint that surefoot wrote") as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value)
    assert not mark.exists()


@pytest.mark.parametrize("kind", [bool, np.int64, np.float32, np.float64])
def test_arrays_come_back_to_the_last_bit(tmp_path: Path, kind: type) -> None:
    state = {"array": np.arange(6).reshape(2, 3).astype(kind), "stream": np.random.default_rng(3).bit_generator.state}
    write_checkpoint(tmp_path / "a.ckpt", state)
    again = read_checkpoint(tmp_path / "a.ckpt")
    assert again["array"].dtype == state["array"].dtype
    assert np.array_equal(again["array"], state["array"])
    assert again["stream"] == state["stream"]


def test_folder_of_another_version_is_refused(tmp_path: Path) -> None:
    folder = RunFolder.create(tiny_config(), tmp_path)
    about = json.loads((folder.path / "run.json").read_text())
    (folder.path / "run.json").write_text(json.dumps({**about, "format": 99, "surefoot": "9.0"}))
    with pytest.raises(SurefootError, match=r"format 99, by surefoot 9\.0.*reads format 3"):
        RunFolder.open(folder.path)


def test_full_disk_leaves_the_old_checkpoint_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, {"steps": 1})

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SurefootError, match="No space left on device; what was saved before is untouched"):
        write_checkpoint(path, {"steps": 2})
    monkeypatch.undo()
    assert read_checkpoint(path) == {"steps": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["a.ckpt"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_full_disk_under_the_log_is_told_in_one_line(whole: TrainingRun) -> None:
    folder = RunFolder(whole.folder.path)
    folder.figures_log = Path("/dev/full")
    with pytest.raises(SurefootError, match="No space left on device; checkpoints are untouched"):
        folder.log({"steps": 1})


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"num_envs": 0}, "num_envs is 0; it must be 1 or more"),
        ({"steps": -5}, "steps is -5; it must be 1 or more"),
        ({"seed": -1}, "seed is -1; it must be 0 or more"),
        ({"num_envs": 1, "steps_per_update": 2}, "each minibatch needs one or more"),
        ({"ppo": {"lr": 1}}, "ppo.lr is not a key; choices: policy_hidden"),
        ({"ppo": {"epochs": "many"}}, "ppo.epochs is 'many'; it must be a whole number"),
    ],
)
def test_impossible_runs_are_refused(changes: dict[str, object], rule: str) -> None:
    with pytest.raises(SurefootError, match=rule.replace(".", r"\.")):
        tiny_config(**changes)


def test_rank_prefers_no_falls_over_return(whole: TrainingRun) -> None:
    assert whole.best is not None
    steady = replace(whole.best, falls=0, pushed_falls=0, return_mean=1.0)
    assert steady.rank > replace(steady, falls=1, return_mean=5.0).rank
    assert steady.rank > replace(steady, pushed_falls=2, return_mean=1.2).rank
