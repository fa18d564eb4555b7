"""Robots in MuJoCo's viewer, with a fake window."""

from __future__ import annotations

import multiprocessing
from unittest import mock

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.robot import RobotDescription

ROBOT = RobotDescription.load("minitaur")


class Window:
    """Fake viewer that is closed after some frames, and records the base's position in each."""

    def __init__(self, pictures: int) -> None:
        self.left, self.seen = pictures, []
        self.cam = mock.Mock()

    def __call__(self, model, data, **how: bool) -> Window:
        self.model, self.data = model, data
        return self

    def __enter__(self) -> Window:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def is_running(self) -> bool:
        self.left -= 1
        return self.left >= 0

    def sync(self) -> None:
        self.seen.append(self.data.xpos[self.model.body(ROBOT.base).id].copy())


def test_replay_shows_a_run_in_real_time_and_repeats_it(make_run, monkeypatch: pytest.MonkeyPatch):
    trace = make_run(1.0, arrays={"motor_angle": np.tile(ROBOT.resting_angles, (100, 1))})
    viewer = pytest.importorskip("mujoco.viewer")
    from surefoot.cli.helpers.viewer import replay

    window, length = Window(4), float(trace.time[-1])
    # The window opens at a clock time of 100 s.
    moments = iter([100.0, 100.0, 100.0 + trace.time[40], 100.0 + length - 1e-6, 100.0 + length + trace.time[20]])
    monkeypatch.setattr("surefoot.cli.helpers.viewer.time", mock.Mock(perf_counter=lambda: next(moments)))
    monkeypatch.setattr(viewer, "launch_passive", window)
    replay(ROBOT, trace)
    # Each step of the trace takes 10 ms and moves 10 mm.
    np.testing.assert_allclose([place[0] for place in window.seen], [0.01, 0.41, 1.0, 0.21], atol=0.0101)
    assert window.cam.trackbodyid == window.model.body(ROBOT.base).id


def test_emulate_viewer_shows_the_current_pose(monkeypatch: pytest.MonkeyPatch):
    viewer = pytest.importorskip("mujoco.viewer")
    from surefoot.cli.helpers import viewer as ours

    place = np.array([1.0, 2.0, 0.3])
    plant = mock.Mock(robot=ROBOT)
    plant.capture.side_effect = lambda: mock.Mock(position=place.copy(), quat=[1.0, 0.0, 0.0, 0.0])
    plant.vitals.return_value.motor_angle = ROBOT.resting_angles
    started: list[mock.Mock] = []

    def process(target, args, daemon) -> mock.Mock:
        assert daemon  # the viewer ends with the emulator, however that ends
        started.append(mock.Mock(run=lambda: target(*args)))
        return started[-1]

    context = mock.Mock(RawArray=multiprocessing.RawArray, Process=process)
    monkeypatch.setattr(ours.multiprocessing, "get_context", lambda how: context)
    monkeypatch.setattr(ours.signal, "signal", mock.Mock())
    shown = ours.EmulateViewer("minitaur", plant)
    started[0].start.assert_called_once_with()
    seen = []
    # Every 33 ms of robot time, not at each servo step.
    for now in (0, 10_000, 32_000, 33_000):
        place[0] += 1.0
        shown.update(now)
        window = Window(1)
        monkeypatch.setattr(viewer, "launch_passive", window)
        started[0].run()
        seen.append(window.seen[0].tolist())
    np.testing.assert_allclose(seen, [[2.0, 2.0, 0.3]] * 3 + [[5.0, 2.0, 0.3]], atol=1e-9)
    ours.signal.signal.assert_called_with(ours.signal.SIGINT, ours.signal.SIG_IGN)
    shown.close()
    started[0].terminate.assert_called_once_with()
