"""The benchmark of rivals: its protocol, the load of the machine, and the processes that it runs."""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import processor_time
import pytest
from processor_time import Stopwatch, TooBusy, busy_seconds, check_idle
from worker_process import Worker, WorkerError

BENCHMARKS = Path(processor_time.__file__).parent
STAT = "cpu  100 20 30 4000 50 6 7 8 90 9\ncpu0 1 2 3 4 5 6 7 8 9 10\nintr 5\n"


def test_the_time_of_guests_and_of_waiting_is_not_counted():
    ticks = os.sysconf("SC_CLK_TCK")
    assert busy_seconds(STAT) == (100 + 20 + 30 + 6 + 7 + 8) / ticks
    with pytest.raises(ValueError, match="first word"):
        busy_seconds("intr 5\n")


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return wall time, processor time and busy time, which the test sets; no time passes otherwise."""
    now = [0.0, 0.0, 0.0]
    monkeypatch.setattr(processor_time, "_now", lambda: tuple(now))
    monkeypatch.setattr(processor_time.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(processor_time.time, "process_time", lambda: now[1])
    return now


def test_a_stopwatch_counts_while_it_runs(clocks: list[float]):
    watch = Stopwatch()
    watch.start()
    clocks[:] = 10.0, 15.0, 16.0
    assert (watch.wall, watch.cpu, watch.other_cores) == (10.0, 15.0, 0.1)
    watch.stop()
    clocks[:] = 110.0, 20.0, 216.0  # a pause in which others work
    watch.start()
    clocks[:] = 120.0, 35.0, 234.0
    watch.stop()
    assert watch.times() == {"seconds": 20.0, "cpu_seconds": 30.0, "other_cores": 0.2}


def test_where_the_system_does_not_say_it_the_load_is_unknown(clocks: list[float]):
    clocks[2] = math.nan
    watch = Stopwatch()
    watch.start()
    clocks[0] = 1.0
    assert watch.other_cores is None


@pytest.mark.parametrize(("other", "idle"), [(0.04, True), (0.06, False), (2.0, False)])
def test_a_busy_machine_is_rejected(other: float, idle: bool, clocks: list[float], monkeypatch: pytest.MonkeyPatch):
    def sleep(seconds: float) -> None:
        clocks[0] += seconds
        clocks[1] += 0.01
        clocks[2] += 0.01 + other * seconds

    monkeypatch.setattr(processor_time.time, "sleep", sleep)
    if not idle:
        with pytest.raises(TooBusy, match=rf"other processes use {other:.2f} cores; .*add --anyway"):
            check_idle(anyway=False)
    measured, found = check_idle(anyway=not idle)
    assert measured == idle
    assert found == pytest.approx(other)


SERVER = """
import sys
from worker_process import WorkerError, serve

def add(a, b):
    print("text of a library")
    return a + b

def fail():
    raise WorkerError("no such file")

def end():
    sys.exit(7)

def threads():
    import os
    return os.environ["OMP_NUM_THREADS"]

serve({one.__name__: one for one in (add, fail, end, threads)})
"""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the path of a script that answers requests."""
    monkeypatch.setenv("PYTHONPATH", str(BENCHMARKS))
    path = tmp_path / "server.py"
    path.write_text(SERVER)
    return path


def test_a_process_answers_requests(server: Path):
    with Worker(sys.executable, server, 3) as worker:
        assert worker.ask("add", a=2, b=3) == 5
        with pytest.raises(WorkerError, match=r"^no such file$"):
            worker.ask("fail")
        assert worker.ask("threads") == "3"
        with pytest.raises(WorkerError, match=r"^server.py: ended with exit code 7 in 'end'"):
            worker.ask("end")
        with pytest.raises(WorkerError, match="exit code 7"):
            worker.ask("add", a=2, b=3)


def test_a_missing_interpreter_is_one_line(tmp_path: Path):
    with pytest.raises(WorkerError, match=r"nothing: can't be started: No such file or directory$"):
        Worker(tmp_path / "nothing", "rivals_mjbatch.py", 1)


STEP = 0.02


def poses_of(velocity: np.ndarray, roll: np.ndarray | None = None, yaw: float = 0.3) -> dict[str, np.ndarray]:
    """Return poses of robots that start at a yaw, from velocities (T, N, 3) in the heading frame, rolls (T + 1, N)."""
    steps, robots, _ = velocity.shape
    yaws = yaw + np.cumsum(np.concatenate([np.zeros((1, robots)), STEP * velocity[:, :, 2]]), axis=0)
    cos, sin = np.cos(yaws[:-1]), np.sin(yaws[:-1])
    x, y = velocity[:, :, 0], velocity[:, :, 1]
    world = np.stack([cos * x - sin * y, sin * x + cos * y, 0 * x], axis=-1)
    position = np.concatenate([np.zeros((1, robots, 3)), np.cumsum(STEP * world, axis=0)])
    tilts = np.zeros_like(yaws) if roll is None else roll
    (cy, sy), (cr, sr) = ((np.cos(angle / 2), np.sin(angle / 2)) for angle in (yaws, tilts))
    quat = np.stack([cy * cr, cy * sr, sy * sr, sy * cr], axis=-1)
    return {"time": np.repeat(STEP * np.arange(steps + 1)[:, None], robots, axis=1), "position": position, "quat": quat}


def test_errors_of_a_worked_example():
    from command_following import SECONDS, command_errors

    steps = round(SECONDS / STEP)
    commands = np.array([[0.5, 0.2, -0.6], [-0.3, 0.0, 0.4]])
    velocity = np.tile(commands, (steps, 1, 1))
    velocity[:75] = 9.0  # the first 1.5 s are left out
    velocity[75:, 0] += [0.12, -0.05, 0.3]
    velocity[75:, 1] += [-0.16, 0.05, 0.1]
    row = command_errors(poses_of(velocity), commands)
    assert [row[name] for name in ("falls", "episodes")] == [0, 2]
    expected = {"forward": math.sqrt((0.12**2 + 0.16**2) / 2), "sideways": 0.05, "yaw_rate": math.sqrt(0.05)}
    expected["planar"] = math.hypot(expected["forward"], 0.05)
    assert {name: row[name] for name in expected} == pytest.approx(expected, abs=6e-5)  # rounded


def test_errors_count_up_to_a_fall():
    from command_following import SECONDS, command_errors

    steps = round(SECONDS / STEP)
    commands = np.zeros((4, 3))
    velocity, roll = np.zeros((steps, 4, 3)), np.zeros((steps + 1, 4))
    velocity[:, :, 0] = 0.1
    velocity[200:, 0, 0], roll[200:, 0] = 7.0, 0.51  # falls
    roll[200:, 1] = 0.49  # does not
    roll[10:, 2] = -2.0  # falls before anything counts
    poses = poses_of(velocity, roll)
    poses["time"][250:, 3] = poses["time"][250, 3]  # the simulation ended: diverged
    poses["position"][250:, 3] = poses["position"][250, 3]
    row = command_errors(poses, commands)
    assert (row["falls"], row["episodes"]) == (3, 4)
    assert row["forward"] == pytest.approx(0.1)
    nothing = command_errors({name: values[:, [2]] for name, values in poses.items()}, commands[:1])
    assert nothing["falls"] == 1
    assert math.isnan(nothing["planar"])


def test_a_run_with_another_control_step_that_ends_on_time_is_no_fall():
    from command_following import SECONDS, command_errors

    poses = poses_of(np.zeros((400, 1, 3)))
    poses["time"] = np.minimum(0.0157 * np.arange(401)[:, None], 0.0157 * math.floor(SECONDS / 0.0157))
    assert command_errors(poses, np.zeros((1, 3)))["falls"] == 0


def test_commands_fill_their_ranges():
    from command_following import draw_commands
    from rivals import HIGH, LOW

    commands = draw_commands(128, LOW, HIGH)
    assert (commands >= LOW).all()
    assert (commands <= HIGH).all()
    assert (np.ptp(commands, axis=0) > 0.9 * (HIGH - LOW)).all()
    assert (draw_commands(128, LOW, HIGH) == commands).all()


def test_points_are_evenly_spaced_and_contain_the_times_that_are_reported():
    from rivals import REPORTED, checkpoint_times

    times = checkpoint_times(720.0)
    assert set(REPORTED) < set(times)
    assert (times[0], times[-1]) == (11.9, 720.0)
    ratios = np.divide(times[1:], times[:-1])
    assert ratios.max() < 1.27
    assert checkpoint_times(12.0) == [11.9, 12.0]


def point(seconds: float, planar: float, falls: int = 0, **more: Any) -> dict[str, Any]:
    return {"seconds": seconds, "planar": planar, "falls": falls, "episodes": 128, **more}


@pytest.mark.parametrize(
    ("run", "time"),
    [
        ([point(10, 0.4), point(40, 0.1)], 20.0),  # straight in logarithms
        ([point(10, 0.15), point(40, 0.1)], 10.0),
        ([point(10, 0.4, 9), point(20, 0.1, 9), point(40, 0.1)], 40.0),  # too many fell
        ([point(10, math.nan, 128), point(20, 0.1, 6)], 20.0),
        ([point(10, 0.4), point(40, 0.2)], math.nan),  # not below
    ],
)
def test_the_time_to_an_error(run: list[dict[str, Any]], time: float):
    from rivals import first_below

    assert first_below(run, 0.2) == pytest.approx(time, nan_ok=True)


def rows_of(system: str, robot: str, seed: int, start: float) -> list[dict[str, Any]]:
    """Return a training whose error halves when the time doubles, from 0.4 m/s at `start` s."""
    from rivals import CASES

    columns = {"system": system, "robot": robot, "seed": seed, "threads": 2, "yaw_rate": 0.2, "idle": True}
    columns |= {f"{name}_{case}": None for case in CASES for name in ("planar", "yaw_rate", "falls")}
    columns |= {"other_cores": 0.01, "samples": 5000}
    return [point(start * 2**k, 0.4 / 2**k, **columns, cpu_seconds=start * 2**k * 1.5) for k in range(3)]


def test_tables_and_figure_of_trainings(tmp_path: Path):
    pytest.importorskip("matplotlib")
    from rivals import write_learning

    rows = [row for seed in (0, 1) for row in rows_of("surefoot", "go1", seed, 20 + 10 * seed)]
    rows += rows_of("mjbatch", "go1", 0, 80) + rows_of("mjbatch", "go1", 1, 60)[:2]
    table = {row["name"]: row for row in write_learning(tmp_path, rows, True)}
    own, rival = table["surefoot go1"], table["mjbatch go1"]
    assert [own[f"seconds_to_0.2{end}"] for end in ("", "_low", "_high")] == pytest.approx([50.0, 40.0, 60.0], abs=0.11)
    assert [own[f"ratio_0.3{end}"] for end in ("_low", "_high")] == pytest.approx([2.0, 4.0], abs=0.01)
    assert [one["reached_0.1"] for one in (own, rival)] == [0, 0]  # 0.1 is not below 0.1
    assert own["seconds_to_0.1"] is None
    assert rival["reached_0.2"] == 1  # the second ended at 0.2
    assert rival["seconds_to_0.2"] is None
    assert own["ratio_0.2"] is None
    runs = (tmp_path / "runs.csv").read_text().splitlines()
    assert len(runs) == 5
    at_60 = runs[0].split(",").index("planar_at_60")
    assert [line.split(",")[at_60] for line in runs[1:]] == ["0.1", "0.2", "0.4", "0.4"]
    assert (tmp_path / "learning.png").stat().st_size > 10_000


def test_throughput_is_compared_in_turns():
    from rivals import Throughput, throughput_rows

    layers = {}
    for name, cpu in (("mjbatch", (1.0, 2.0)), ("world", (0.5, 0.5))):
        layers[name] = Throughput(None, layer=name)  # type: ignore[arg-type]
        layers[name].turns = [
            {"steps": 1000, "cpu_seconds": one, "seconds": 2 * one, "other_cores": load}
            for one, load in zip(cpu, (0.0, 0.3), strict=True)
        ]
    wall = {name: [turn["steps"] / turn["seconds"] for turn in layer.turns] for name, layer in layers.items()}
    base, world = throughput_rows(layers, wall)
    assert (base["cpu_ratio"], base["steps_per_cpu_second"], base["other_cores"]) == (1.0, 750, 0.2)
    assert (base["seconds"], base["cpu_seconds"]) == (6.0, 3.0)
    assert (world["cpu_ratio"], world["cpu_ratio_low"], world["wall_ratio"]) == (3.0, 2.5, 3.0)
    alone = throughput_rows({"world": layers["world"]}, wall)
    assert alone[0]["cpu_ratio"] is None


EXAMPLE = '''
import os
import types

import mujoco_menagerie
import numpy as np
import processor_time
import torch

clock = [0.0]
processor_time.time = types.SimpleNamespace(perf_counter=lambda: clock[0], process_time=lambda: 1.5 * clock[0])
SEED, POLICY, TIMESTEP, CTRL_DT, HORIZON, NUM_ENVS, STAND = 0, os.path.dirname(__file__) + "/p.pt", 0.004, 0.02, 2, 3, 0
SPEC = mujoco_menagerie.get("unitree_go1").spec("go1")


class Batch:
    def __init__(self, model, num, num_threads=0):
        self.threads = num_threads


class Go1:
    """Each robot moves at the speed that the policy says, but the last one lies on its back."""

    def __init__(self, num_envs, seed=0):
        assert Batch(None, num_envs).threads == 2
        self.qpos = np.zeros((num_envs, 19))
        self.qpos[:, 3] = 1.0
        self.qpos[-1, 3:5] = 0.0, 1.0
        self.command, self.until = np.zeros((num_envs, 3)), np.zeros(num_envs)

    def obs(self):
        assert np.isinf(self.until).all()
        return self.command.astype(np.float32)

    def step(self, action):
        self.qpos[:, :2] += CTRL_DT * action[:, :2]


class ActorCritic(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gain = torch.nn.Parameter(torch.zeros(()))

    def forward(self, obs):
        return self.gain * obs, None


def build_model():
    raise AssertionError


def progress(*_):
    raise AssertionError


def update(net, batch):
    clock[0] += 0.05
    with torch.no_grad():
        net.gain += 0.01
    return batch


def train():
    net = ActorCritic()
    for iteration in range(1000):
        update(net, iteration)
        torch.save(net.state_dict(), POLICY)
        progress(iteration)
'''


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Return a folder with an example that has the names of mjbatch's."""
    examples = tmp_path / "clone" / "examples"
    examples.mkdir(parents=True)
    (examples / "go1_joystick.py").write_text(EXAMPLE)
    (tmp_path / "go1.xml").write_text("<mujoco/>")
    return examples.parent


def test_a_rivals_training_is_stopped_and_evaluated_at_its_points(clone: Path, tmp_path: Path):
    pytest.importorskip("torch")
    from command_following import command_errors

    commands = np.array([[0.5, 0.2, 0.0], [0.5, 0.2, 0.0]])
    with Worker(sys.executable, "rivals_mjbatch.py", 2) as worker:
        rows = worker.ask(
            "train", clone=str(clone), model=str(tmp_path / "go1.xml"), seed=3, threads=2, times=[0.01, 0.19, 0.21],
            commands=commands.tolist(), seconds=6.0, folder=str(tmp_path),
        )  # fmt: skip
    assert [row["seconds"] for row in rows] == pytest.approx([0.05, 0.2, 0.25])
    assert [row["cpu_seconds"] for row in rows] == pytest.approx([0.075, 0.3, 0.375])
    assert [row["samples"] for row in rows] == [6, 24, 30]
    for row in rows:
        errors = command_errors(np.load(row["nominal"]), commands)
        gain = 0.01 * row["samples"] / 6
        assert errors["falls"] == 1  # the robot that lies on its back
        assert errors["forward"] == pytest.approx(0.5 * (1 - gain), abs=1e-6)
    assert (tmp_path / "policy.pt").is_file()
    assert sorted(path.name for path in (clone / "examples").glob("*.*")) == ["go1_joystick.py"]


def test_a_clone_of_something_else_is_rejected(clone: Path, tmp_path: Path):
    pytest.importorskip("torch")
    about: dict[str, str] = {"model": str(tmp_path / "go1.xml")}
    example = clone / "examples" / "go1_joystick.py"
    with Worker(sys.executable, "rivals_mjbatch.py", 1) as worker:
        with pytest.raises(WorkerError, match=r"--mjbatch .*elsewhere: it has no examples/go1_joystick.py"):
            worker.ask("about", clone=str(tmp_path / "elsewhere"), **about)
        example.write_text("import no_such_module_of_a_rival\n")
        with pytest.raises(WorkerError, match=r"--mjbatch-python .*: can't import .*: No module named"):
            worker.ask("about", clone=str(clone), **about)
        example.write_text("SEED = 0\n")
        with pytest.raises(WorkerError, match="has no Batch, Go1, ActorCritic"):
            worker.ask("about", clone=str(clone), **about)


ENVPOOL = """
import types
import numpy as np

def make_gymnasium(task, num_envs, num_threads, seed):
    if task != "Go1JoystickFlatTerrain-v1":
        raise KeyError(task)

    def step(actions):
        assert actions.shape == (num_envs, 12)
        assert (abs(actions) <= 1.0).all()

    return types.SimpleNamespace(reset=lambda: None, step=step, action_space=np.zeros(12))
"""


def test_envpool_is_timed_where_it_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with Worker(sys.executable, "rivals_envpool.py", 1) as worker:
        with pytest.raises(
            WorkerError, match=r"--envpool-python .*: can't make Go1Joystick.*: No module named 'envpool'"
        ):
            worker.ask("about")
        (tmp_path / "envpool.py").write_text(ENVPOOL)
        (tmp_path / "envpool-1.2.7.dist-info").mkdir()
        (tmp_path / "envpool-1.2.7.dist-info" / "METADATA").write_text("Name: envpool\nVersion: 1.2.7\n")
        assert worker.ask("about") == {"envpool": "1.2.7"}
        turn = worker.ask("turn", num_envs=3, threads=1, seconds=0.01)
    assert turn["steps"] % 15 == 0
    assert turn["steps"] > 0
    assert turn["seconds"] >= 0.01


def test_every_command_lasts_as_long_whatever_the_control_step(tmp_path: Path):
    pytest.importorskip("torch")
    from dataclasses import replace

    from rivals_surefoot import TASK, write_poses

    from surefoot.learn.config import load_train_config
    from surefoot.learn.ppo_learner import PpoLearner
    from surefoot.world.sim_world import SimWorld

    config = load_train_config(TASK, "go2")
    learner = PpoLearner(replace(config, num_envs=2, threads=1, learning_threads=1), SimWorld)
    commands = [(0.3, 0.0, 0.0), (0.0, 0.1, 0.2), (0.0, 0.0, 0.0)]
    duration = 0.2
    for ranges, steps in (({}, 13), ({"control_step": (0.008, 0.020)}, None)):
        write_poses(learner, commands, duration, ranges, tmp_path / "poses.npz")
        poses = np.load(tmp_path / "poses.npz")
        assert poses["position"].shape == (*poses["time"].shape, 3)
        assert poses["time"].shape[1] == 3
        if steps is not None:
            assert len(poses["time"]) == 1 + steps
        assert (poses["time"][0] == 0.0).all()
        assert ((poses["time"][-1] >= duration - 0.002) & (poses["time"][-1] <= duration + 0.02)).all()
        assert np.linalg.norm(poses["quat"], axis=-1) == pytest.approx(1.0)
    ends = np.count_nonzero(np.diff(poses["time"], axis=0), axis=0)
    assert len(set(ends.tolist())) > 1  # robots with other control steps


def test_a_busy_machine_ends_the_run_in_one_line_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    import rivals

    busy = {"clock": 0.0}

    def now() -> tuple[float, float, float]:
        busy["clock"] += 1.0
        return busy["clock"], 0.0, 2 * busy["clock"]

    monkeypatch.setattr(processor_time, "_now", now)
    monkeypatch.setattr(processor_time.time, "sleep", lambda _: None)
    model = tmp_path / "go1.xml"
    with pytest.raises(ValueError, match=r"go1.xml: no such file; name the MJCF"):
        rivals.main(rivals.Command(model, out=tmp_path / "out"))
    model.write_text("<mujoco/>")
    with pytest.raises(TooBusy, match=r"other processes use 2\.00 cores"):
        rivals.main(rivals.Command(model, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    command = rivals.Command(model, out=tmp_path / "out", anyway=True)
    assert not rivals.begin(command, "throughput", {"cores": 2})
    assert not rivals.begin(command, "learning", {"cores": 4})
    written = json.loads((tmp_path / "out" / "machine.json").read_text())
    assert [written[part]["cores"] for part in ("throughput", "learning")] == [2, 4]
    assert written["learning"]["idle"] is False
