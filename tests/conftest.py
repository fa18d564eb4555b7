"""Settings and fixtures for all tests."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import gc
import os
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from _pytest.runner import runtestprotocol
from chromium import chromium_missing
from compiled_firmware import qemu_missing
from hypothesis import settings
from processes import BUSY, BareLoop, Emulator, emulators
from xdist.scheduler import LoadFileScheduling

from surefoot.report.figures import style
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from surefoot.studies.comparison import Comparison

os.environ.setdefault("MPLBACKEND", "Agg")

# The same examples on every run and machine; slowness is not a failure (pytest-timeout detects hangs).
settings.register_profile("surefoot", deadline=None, derandomize=True)
settings.load_profile("surefoot")

LONG = (
    *("cli/test_study_cli", "cli/test_study_search_cli", "test_newcomer", "cli/test_drive_cli", "identify/test_fits"),
    *("test_examples", "cli/test_train_page_cli", "deploy/test_fault_table", "cli/test_identify_cli"),
    *("cli/test_deploy_cli", "world/test_agreement", "adopt/test_arithmetic", "cli/test_evaluate_cli"),
    *("cli/test_gap_cli", "adopt/test_networks", "cli/test_robot_firmware_cli", "cli/test_rejected_commands"),
    *("cli/test_printed_commands", "cli/test_doctor_cli", "studies/test_study_report", "learn/test_training_loop"),
    *("identify/test_experiment_runner", "world/test_engines", "identify/motion/test_torque_fit"),
    *("world/test_process_world", "cli/test_params_option", "cli/test_train_cli", "adopt/test_rl_sar", "test_robots"),
)
"""Test files with the longest durations."""
REALTIME = "surefoot/realtime"
"""Key of the names of real-time tests in pytest's cache."""
NEEDS = {"browser": chromium_missing, "qemu": qemu_missing}
"""Requirements of tests by marker: a function that returns what is missing on this computer, or an empty text."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Return a number of workers larger than the number of processors, since tests often wait for their processes."""
    return min(3 * (os.cpu_count() or 1) // 2, 5)


class RealTimeLast(LoadFileScheduling):
    """Scheduler that runs each file's tests on one worker, for shared fixtures, and all real-time tests on one worker.

    A worker keeps the fixtures of a file, such as robots and browsers, until its next test; they would disturb
    real-time tests.
    """

    @functools.cached_property
    def _realtime(self) -> set[str]:
        return set(self.config.cache.get(REALTIME, ()))

    def _split_scope(self, nodeid: str) -> str:
        return "in real time" if nodeid in self._realtime else super()._split_scope(nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling | None:
    """Use the scheduler that runs real-time tests after all other tests."""
    return RealTimeLast(config, log) if hasattr(config, "cache") and config.getvalue("dist") == "loadfile" else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Order tests: files with the longest durations first, for an even load, and real-time tests last.

    pytest-xdist (`--dist loadfile`) distributes work in this order.
    """
    first = {Path(__file__).parent / f"{name}.py": rank for rank, name in enumerate(LONG)}
    assert all(path.exists() for path in first), "LONG names files that have moved"
    items.sort(key=lambda item: (item.get_closest_marker("realtime") is not None, first.get(item.path, len(LONG))))
    if cache := getattr(config, "cache", None):  # none with `-p no:cacheprovider`
        cache.set(REALTIME, [item.nodeid for item in items if item.get_closest_marker("realtime")])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    """Exclude imported objects from garbage collection, since each deployment collects garbage before it starts."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test whose requirements are missing on this computer."""
    for marker, missing in NEEDS.items():
        if item.get_closest_marker(marker) and (what := missing()):
            pytest.skip(what)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """With pytest-xdist, run a test marked `realtime` while no other test is running."""
    cache = getattr(item.config, "cache", None)
    if not hasattr(item.config, "workerinput") or cache is None:
        return (yield)
    # Other tests hold a shared lock; a real-time test waits for the exclusive lock.
    with (cache.mkdir("turns") / "running").open("w") as running:
        fcntl.flock(running, fcntl.LOCK_EX if item.get_closest_marker("realtime") else fcntl.LOCK_SH)
        return (yield)


@pytest.hookimpl(specname="pytest_runtest_protocol")
def pytest_try_again_in_real_time(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Repeat a test marked `realtime` up to three times if it failed on a busy computer; then skip it.

    The computer is busy if a bare loop is also late: one with the highest priority during the test, which the test
    can't delay, or one with normal priority after the test. If neither was late, the failure counts.
    """
    if item.get_closest_marker("realtime") is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for left in (3, 2, 1, 0):
        with BareLoop(priority=90) as beside:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        failed = [report for report in reports if report.failed]
        if not failed:
            break
        with BareLoop(priority=0) as after:
            time.sleep(1.0)
        late = max(beside.worst, after.worst)
        if late < BUSY:
            break
        for report in failed if not left else ():
            why = f"too busy for real time, a bare loop was {1e3 * late:.1f} ms late: {report.longreprtext}"
            report.outcome, report.longrepr = "skipped", (str(item.path), item.location[1] or 0, why)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the resolution of figures and videos to save time."""
    monkeypatch.setattr(style, "DPI", 40)
    with contextlib.suppress(ImportError):  # of the extra `report`
        from surefoot.report.drawing.video import render_video

        monkeypatch.setitem(render_video.__kwdefaults__, "size", (320, 180))


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a random generator with the same initial state in every test."""
    return np.random.default_rng(20180426)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Return the root of the repository."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def robot() -> RobotDescription:
    """Return the released robot minitaur."""
    return RobotDescription.load("minitaur")


@pytest.fixture(scope="session")
def trained(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a very short training of `trot`. It is shared: copy it before changing it."""
    from trained_policy import trained_run

    cache = getattr(request.config, "cache", None)  # none with `-p no:cacheprovider`
    return trained_run(tmp_path_factory.mktemp("trained") if cache is None else cache.mkdir("trained"))


@pytest.fixture
def emulate() -> Iterator[Callable[..., Emulator]]:
    """Return a function that starts emulated robots with arguments of `surefoot emulate`; they end with the test."""
    pytest.importorskip("mujoco")
    with emulators() as start:
        yield start


@pytest.fixture(scope="session")
def make_run() -> Callable[..., EpisodeTrace]:
    """Return a function that makes a run with a given distance [m] and energy [J], and control steps of `step` [s].

    A distance of NaN means that it was not measured; `arrays` replace columns of the trace, which are zero by default.
    """

    def make(
        distance: float = 3.0,
        energy: float = 100.0,
        steps: int = 100,
        step: float = 0.01,
        arrays: dict[str, np.ndarray] | None = None,
        **meta: Any,
    ) -> EpisodeTrace:
        shapes = {"roll_pitch_yaw": 3, "angular_velocity_base": 3, "observation": 1}
        motors = ("motor_angle", "motor_velocity", "motor_torque", "feedback", "target")
        position = np.zeros((steps + 1, 3))
        position[:, 0] = np.linspace(0.0, distance, steps + 1)
        trace_columns: dict[str, Any] = {
            **{name: np.zeros((steps, width)) for name, width in (shapes | dict.fromkeys(motors, 8)).items()},
            "time": step * np.arange(1, steps + 1),
            "base_position_world": position if np.isfinite(distance) else np.full_like(position, np.nan),
            "base_quat_world": np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)),
            "energy": np.full(steps, energy / steps),
            "foot_contact": np.ones((steps, 4)),
            "motor_saturation": np.zeros_like((arrays or {}).get("target", np.zeros((steps, 8)))),
            **(arrays or {}),
        }
        about = {
            "robot": "minitaur",
            "world": "mujoco",
            "policy": "trot",
            "control_step": step,
            "leg_names": ["front_left", "back_left", "front_right", "back_right"],
            "motor_names": [f"m{i}" for i in range(8)],
            "observation_names": ["roll"],
            "energy_weight": 0.008,
            "ended": "time",
        }
        return EpisodeTrace(**trace_columns, meta=about | meta)

    return make


@pytest.fixture
def gap_comparison() -> Callable[..., Comparison]:
    """Return three groups with runs in the home and target world, with known results.

    The gaps of group a's policies are 1 m, 1.1 m, ...; b's policies have no gap and cover three metres; c's policies
    fall in the home world.
    """
    pytest.importorskip("gymnasium")
    import pandas as pd

    from surefoot.studies.comparison import Comparison, policy_row
    from surefoot.studies.study_config import GroupConfig, PublishedFinding, StudyConfig

    steady, at = (True, True, True), np.arange(1, 11) * 1e5
    means = {"speed_mean": 0.5, "falls": 0, "episodes": 1, "seconds": 120.0}
    log = [{"steps": int(steps), "return_mean": steps * 1e-6, **means} for steps in at]

    def runs(world: str, level: float, spread: float, balanced: tuple[bool, ...]) -> pd.DataFrame:
        """Return three runs with a distance of return plus 0.5 m; falls happen after 250 steps."""
        returns, stood = level + spread * np.array([-1.0, 0.0, 1.0]), np.array(balanced)
        steps = np.where(stood, 1000.0, 250.0)
        speed = (returns + 0.5) / (0.006 * steps)
        columns = {"return": returns, "distance": returns + 0.5, "speed": speed, "power": 10.0, "steps": steps}
        return pd.DataFrame({"world": world, "run": range(3), **columns, "fell": ~stood, "balanced": stood})

    def policy(
        seed: int, level: float, gap: float, away: tuple[bool, ...] = steady, home: tuple[bool, ...] = steady
    ) -> dict[str, Any]:
        nominal = {"run": list(range(20)), "return": [level] * 20, "speed": [level / 6] * 20, "fell": [False] * 20}
        worlds = [
            runs("mujoco", level, 0.1, home),
            runs("bullet", level - gap, 0.3, away),
            runs("mujoco-described", level - gap / 2, 0.2, away),
        ]
        results = {"nominal": {"runs": nominal}, "gap": {"runs": pd.concat(worlds).to_dict("list")}}
        return policy_row("", seed, log, results)

    def make(seeds: int = 5) -> Comparison:
        groups = {
            "a": [policy(s, 2.0 + 0.2 * s, 1.0 + 0.1 * s, (True, s > 2, False)) for s in range(seeds)],
            "b": [policy(s, 3.0 + 0.1 * s, 0.0) for s in range(seeds)],
            "c": [policy(s, 0.1, 0.0, home=(False, False, True)) for s in range(seeds)],
        }
        rows = [row | {"group": group} for group, policies in groups.items() for row in policies]
        labels = {"a": "first", "b": "second", "c": "third", "absent": ""}
        study = StudyConfig(
            groups={name: GroupConfig(label) for name, label in labels.items()},
            name="gaps",
            evaluate=("gap",),
            compare=(("a", "b"), ("a", "c")),
            bars={"both": ("a", "b", "absent")},
            findings=(
                PublishedFinding(("a", "b"), "the second did better."),
                PublishedFinding(("a", "b", "absent"), "all was well."),
            ),
        )
        return Comparison(study, pd.DataFrame(rows))

    return make
