"""The training loop and its checkpoints."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from shipped_variants import maxitaur
from trained_policy import TINY

from surefoot.cli.main import main
from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.run_folder import RunFolder, read_checkpoint, write_checkpoint
from surefoot.learn.training_loop import TrainingLoop
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import load_ranges
from surefoot.world.sim_world import SimWorld

ROBOT_LEGS = RobotDescription.load("minitaur").leg_names


def tiny_config(**changes: object) -> TrainConfig:
    return from_mapping(TrainConfig, {**TINY, **changes}, base=load_train_config("trot"))


def train(root: Path, config: TrainConfig, stop_after: int | None = None) -> TrainingLoop:
    loop = TrainingLoop.create(config, RunFolder.create(config, root), SimWorld)
    updates = []
    loop.run(
        lambda *metrics: updates.append(metrics),
        lambda: stop_after is not None and len(updates) >= stop_after,
    )
    return loop


def resume(path: Path) -> TrainingLoop:
    folder, config = RunFolder.open(path)
    return TrainingLoop.resume(config, folder, SimWorld)


def same_weights(a: TrainingLoop, b: TrainingLoop) -> bool:
    first, second = a.learner.policy.state_dict(), b.learner.policy.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


@pytest.fixture(scope="module")
def whole(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainingLoop:
    return resume(shutil.copytree(trained, tmp_path_factory.mktemp("whole") / "run"))


def test_a_run_with_a_custom_robot_resumes_after_both_were_moved(whole: TrainingLoop, tmp_path: Path) -> None:
    robot = maxitaur(tmp_path / "my robot")
    config = from_mapping(TrainConfig, {"task": {"robot": str(robot)}}, base=tiny_config())
    loop = train(tmp_path / "runs", config, stop_after=4)
    policy = loop.folder.policy
    assert PolicyRuntime.load(policy).contract.figures["training"]["steps"] in (768, 1024)
    moved = shutil.move(loop.folder.path, tmp_path / "moved")
    shutil.rmtree(robot)
    (tmp_path / "runs").rename(tmp_path / "gone")
    loop = resume(Path(moved))
    loop.run(lambda *_: None)
    # It differs from the robot that ships with surefoot only in its name.
    assert same_weights(loop, whole)
    runtime = PolicyRuntime.load(loop.folder.policy)
    assert runtime.load_robot().name == "maxitaur"
    assert str(tmp_path) not in runtime.contract.to_json()


def test_a_run_has_its_best_policy_from_the_first_evaluation_on(tmp_path: Path) -> None:
    loop = TrainingLoop.create(tiny_config(), RunFolder.create(tiny_config(), tmp_path), SimWorld)
    seen = []
    loop.run(lambda metrics, evaluation: seen.append((evaluation is not None, loop.folder.policy.exists())))
    first = [evaluated for evaluated, _ in seen].index(True)
    assert [exists for _, exists in seen] == [False] * first + [True] * (len(seen) - first)


def test_the_table_of_a_reference_is_copied_into_the_run(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    columns = [f"{part}_{leg}" for part in ("swing", "extension") for leg in ROBOT_LEGS]
    rows = [",".join(["0.0"] * 4 + [str(1.9 + 0.1 * k)] * 4) for k in range(3)]
    table.write_text("\n".join([",".join(columns), *rows]))
    reference = {"kind": "table", "file": str(table), "period": 0.5}
    config = from_mapping(TrainConfig, {"task": {"reference": reference}}, base=tiny_config())
    path = RunFolder.create(config, tmp_path).path.rename(tmp_path / "moved")
    table.unlink()
    again = RunFolder.open(path)[1].task.reference
    assert again.file == str(path / "reference.csv")
    assert len(again.make(RobotDescription.load("minitaur")).rows) == 3


def test_a_height_map_is_copied_into_the_run(tmp_path: Path) -> None:
    np.savez(tmp_path / "hills.npz", heights=np.zeros((3, 3)), cell=1.0)
    config = from_mapping(
        TrainConfig, {"task": {"terrain": {"ground": str(tmp_path / "hills.npz")}}}, base=tiny_config()
    )
    path = RunFolder.create(config, tmp_path).path.rename(tmp_path / "moved")
    (tmp_path / "hills.npz").unlink()
    ground = RunFolder.open(path)[1].task.terrain.ground
    assert ground == str(path / "ground.npz")
    assert Path(ground).is_file()


def test_another_seed_gives_another_policy(whole: TrainingLoop, tmp_path: Path) -> None:
    other = train(tmp_path, tiny_config(seed=1), stop_after=1)
    assert other.folder.rows()[0]["std_mean"] != whole.folder.rows()[0]["std_mean"]


@pytest.mark.parametrize("stop_after", [1, 3])
def test_an_interrupted_run_ends_with_the_same_weights_to_the_last_bit(
    whole: TrainingLoop, tmp_path: Path, stop_after: int
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


def test_a_run_with_randomization_and_symmetry_resumes_exactly(tmp_path: Path) -> None:
    task = {**TINY["task"], "params": {}, "randomize": load_ranges("table1")}
    config = tiny_config(task=task, ppo={"symmetry": True, "fall_cost": 1.0}, steps=16 * 16 * 3)
    through = train(tmp_path / "through", config)
    stopped = train(tmp_path / "stopped", config, stop_after=2)
    resumed = resume(stopped.folder.path)
    resumed.run(lambda *_: None)
    assert same_weights(resumed, through)


def test_a_run_can_start_from_the_networks_of_another_run(whole: TrainingLoop, tmp_path: Path) -> None:
    config = tiny_config(start_from=str(whole.folder.path), seed=5, steps=256)
    loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path), SimWorld)
    last = whole.folder.load()["learner"]["algorithm"]["actor_state_dict"]
    first = loop.learner.policy.state_dict()
    assert all(torch.equal(first[key], last[key]) for key in last)
    assert loop.learner.steps == 0
    loop.run(lambda *_: None)
    assert not same_weights(loop, whole)
    # Resumed, it continues from its own state, not from the other run's.
    again = resume(loop.folder.path)
    assert same_weights(again, loop)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"num_envs": 128}, "it has the states of 16 robots; num_envs is 128"),
        ({"ppo": {"policy_hidden": [16]}}, "its networks do not fit the configuration: Unexpected key"),
    ],
)
def test_resume_rejects_a_configuration_that_does_not_fit_the_checkpoint(
    whole: TrainingLoop, change: dict, reason: str
) -> None:
    with pytest.raises(SurefootError, match=rf"latest\.ckpt: does not fit the run's config\.yaml: {reason}") as caught:
        TrainingLoop.resume(tiny_config(**change), whole.folder, SimWorld)
    assert "\n" not in str(caught.value)


def test_a_run_folder_contains_configuration_versions_and_checkpoints(whole: TrainingLoop) -> None:
    about = json.loads((whole.folder.path / "run.json").read_text())
    assert about["seed"] == 0
    assert about["packages"]["torch"].startswith("2.13.0")
    assert RunFolder.open(whole.folder.path)[1] == whole.config
    assert list(whole.folder.path.glob("events.out.tfevents.*"))
    assert len(list(whole.folder.checkpoints.glob("steps_*.ckpt"))) == 3


def test_the_error_for_a_cut_off_checkpoint_names_the_previous_one(whole: TrainingLoop, tmp_path: Path) -> None:
    folder = RunFolder(shutil.copytree(whole.folder.path, tmp_path / "run"))
    content = folder.latest.read_bytes()
    folder.latest.write_bytes(content[: len(content) // 2])
    with pytest.raises(SurefootError, match=r"broken.*previous\.ckpt next to it is intact, at 1024 steps") as error:
        folder.load()
    assert "\n" not in str(error.value)
    folder.previous.unlink()
    with pytest.raises(SurefootError, match=r"broken.*there is no older checkpoint to resume from"):
        folder.load()


def test_a_checkpoint_with_a_flipped_bit_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, {"weights": torch.arange(1000.0)})
    content = bytearray(path.read_bytes())
    content[-500] ^= 4
    path.write_bytes(content)
    with pytest.raises(SurefootError, match="broken"):
        read_checkpoint(path)


class Intruder:
    """An object that runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (self.command,)


@pytest.mark.parametrize("inside", ["array", "table"])
def test_a_checkpoint_that_would_run_code_is_rejected(tmp_path: Path, inside: str) -> None:
    """The digest is valid, because an attacker can compute it."""
    path, mark = tmp_path / "a.ckpt", tmp_path / "was-here"
    bad = Intruder(f"touch {mark}")
    write_checkpoint(path, {"steps": np.array([bad], object) if inside == "array" else bad})
    with pytest.raises(SurefootError, match=r"a\.ckpt: is not a checkpoint that surefoot wrote") as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value)
    assert not mark.exists()


@pytest.mark.parametrize("kind", [bool, np.int64, np.float32, np.float64])
def test_arrays_are_restored_to_the_last_bit(tmp_path: Path, kind: type) -> None:
    state = {"array": np.arange(6).reshape(2, 3).astype(kind), "stream": np.random.default_rng(3).bit_generator.state}
    write_checkpoint(tmp_path / "a.ckpt", state)
    again = read_checkpoint(tmp_path / "a.ckpt")
    assert again["array"].dtype == state["array"].dtype
    assert np.array_equal(again["array"], state["array"])
    assert again["stream"] == state["stream"]


def test_a_run_folder_of_another_format_is_rejected(tmp_path: Path) -> None:
    folder = RunFolder.create(tiny_config(), tmp_path)
    about = json.loads((folder.path / "run.json").read_text())
    (folder.path / "run.json").write_text(json.dumps({**about, "format": 99, "surefoot": "9.0"}))
    with pytest.raises(SurefootError, match=r"format 99 of surefoot 9\.0.*reads format 4"):
        RunFolder.open(folder.path)


def test_a_full_disk_leaves_the_old_checkpoint_intact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ckpt"
    write_checkpoint(path, {"steps": 1})

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SurefootError, match="No space left on device; files saved earlier are unchanged"):
        write_checkpoint(path, {"steps": 2})
    monkeypatch.undo()
    assert read_checkpoint(path) == {"steps": 1}
    assert [item.name for item in tmp_path.iterdir()] == ["a.ckpt"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_under_the_log_is_a_one_line_error(whole: TrainingLoop) -> None:
    folder = RunFolder(whole.folder.path)
    folder.metrics_log = Path("/dev/full")
    with pytest.raises(SurefootError, match="No space left on device; files saved earlier are unchanged"):
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
def test_a_configuration_out_of_bounds_is_rejected(changes: dict[str, object], rule: str) -> None:
    with pytest.raises(SurefootError, match=rule.replace(".", r"\.")):
        tiny_config(**changes)


def test_a_run_with_commands_logs_errors_and_reward_terms_to_both_loggers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    short = {**TINY, "steps": 256, "evaluate_every": 256, "task": {"max_steps": 80}}
    config = from_mapping(TrainConfig, short, base=load_train_config("go2-steer"))
    loops = []
    for logger in ("tensorboard", "wandb"):
        loop = TrainingLoop.create(config, RunFolder.create(config, tmp_path / logger), SimWorld, logger=logger)
        loop.run(lambda *_: None)
        loops.append(loop)
    assert same_weights(*loops)
    assert list(loops[1].folder.path.glob("wandb/offline-run-*/*.wandb"))
    (row,), (evaluation,) = loops[0].folder.rows(), loops[0].folder.evaluations()
    seconds = 0.016 * config.steps_per_update
    assert sum(row["reward"].values()) * seconds == pytest.approx(row["reward_rate"] * config.steps_per_update)
    assert set(row["reward"]) == set(config.task.reward)
    assert 0 < row["rmse"]["forward"] < 2
    assert set(evaluation["rmse"]) == {"forward", "sideways", "yaw_rate"}
    names = []
    for loop in loops:
        events = EventAccumulator(str(loop.folder.path))
        events.Reload()
        names.append(set(events.Tags()["scalars"]))
    assert {f"train/reward/{term}" for term in config.task.reward} | {"evaluation/rmse/forward"} <= names[0] == names[1]


def nothing(state: dict) -> None:
    state.clear()


def put(value: object, *keys: object):
    """Return a function that changes a state by setting a value; `...` removes the entry."""

    def change(state: dict) -> None:
        for key in keys[:-1]:
            state = state[key]
        if value is ...:
            del state[keys[-1]]
        else:
            state[keys[-1]] = value

    change.__name__ = f"{'.'.join(map(str, keys))} is {str(value)[:20]}"
    return change


def spoil(*keys: object, value: float = float("nan")):
    """Return a function that changes a state by setting the first number of an array or tensor to a value."""

    def change(state: dict) -> None:
        for key in keys:
            state = state[key]
        state.reshape(-1)[0] = value  # type: ignore[attr-defined]

    change.__name__ = f"{value} in {'.'.join(map(str, keys))}"
    return change


ALGORITHM = ("learner", "algorithm")
MOMENTS = (*ALGORITHM, "optimizer_state_dict", "state")
CHANGES = [
    *(nothing, put(..., "steps"), put(None, "steps"), put("x", "steps"), put(-1, "steps"), put(2.5, "steps")),
    *(put(..., "learner"), put(None, "learner"), put([], "learner"), put(7, "learner", "env")),
    *(put(..., "best"), put("x", "best"), put({"steps": 1}, "best"), put(None, "best", "falls")),
    *(put(torch.zeros(2), "best", "rmse"), put({}, "best_actor"), put(torch.zeros(3), "best_actor")),
    *(put(None, "seconds"), put(float("nan"), "seconds"), put([1], "seconds")),
    *(put("x", "learner", "learning_rate"), put(float("inf"), "learner", "learning_rate")),
    *(put(None, "learner", "torch"), put(torch.zeros(3), "learner", "torch"), put("x", "learner", "update_count")),
    *(put(10**30, "learner", "update_count"), put({}, *ALGORITHM), put(None, *ALGORITHM, "actor_state_dict")),
    *(put([], *ALGORITHM, "optimizer_state_dict"), put({}, *ALGORITHM, "optimizer_state_dict", "param_groups")),
    *(put(None, *MOMENTS, 0), put(torch.zeros(2), *MOMENTS, 0, "exp_avg"), put({}, *MOMENTS, 99)),
    *(put(None, "learner", "observation"), put(np.zeros((16, 1), np.float32), "learner", "observation", "policy")),
    *(put(..., "learner", "env", "history"), put(np.zeros(3), "learner", "env", "history")),
    *(put(None, "learner", "env", "world"), put("x", "learner", "env", "world", "engine")),
    *(spoil(*MOMENTS, 0, "step", value=-1.0), spoil(*MOMENTS, 0, "exp_avg_sq", value=-1.0)),
    *(put([], "learner", "env", "world", "streams"), put("x", "learner", "env", "world", "streams", 0, "state")),
    *(put(-5, "learner", "env", "world", "streams", 0, "state", "state"), spoil(*MOMENTS, 0, "exp_avg")),
    *(put(10**60, "learner", "env", "world", "streams", 0, "state", "inc"), spoil("best_actor", "mlp.0.weight")),
    *(spoil(*ALGORITHM, "actor_state_dict", "mlp.0.weight"), spoil(*ALGORITHM, "critic_state_dict", "mlp.0.bias")),
    *(spoil("learner", "observation", "policy"), spoil("learner", "env", "history")),
]


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_checkpoint_with_other_content_is_rejected_in_one_line(
    change, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The digest is valid, because an attacker can compute it."""
    folder = RunFolder(shutil.copytree(trained, tmp_path / "run"))
    state = folder.load()
    change(state)
    write_checkpoint(folder.latest, state)
    before = folder.metrics_log.read_bytes()
    assert main(["train", "--resume", str(folder.path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"surefoot: error: {folder.latest}: ")
    assert error.count("\n") == 1
    assert folder.metrics_log.read_bytes() == before


@pytest.mark.parametrize("state", [None, [1], {"steps": None}, {}])
def test_more_steps_are_rejected_for_a_checkpoint_without_steps(
    state: object, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(shutil.copytree(trained, tmp_path / "run"))
    write_checkpoint(folder.latest, state)  # type: ignore[arg-type]
    write_checkpoint(folder.previous, state)  # type: ignore[arg-type]
    assert main(["train", "--resume", str(folder.path), "--steps", "100000"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_warm_start_from_weights_that_are_not_finite_is_rejected(trained: Path, tmp_path: Path) -> None:
    for number, change in enumerate((spoil(*ALGORITHM, "actor_state_dict", "mlp.0.weight"), put(None, "learner"))):
        folder = RunFolder(shutil.copytree(trained, tmp_path / str(number)))
        state = folder.load()
        change(state)
        write_checkpoint(folder.latest, state)
        config = tiny_config(start_from=str(folder.path), steps=256)
        with pytest.raises(SurefootError, match="start_from"):
            TrainingLoop.create(config, RunFolder.create(config, tmp_path / "runs"), SimWorld)
