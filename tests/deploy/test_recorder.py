"""Rows of a run, their growing file, and the resulting trace."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from surefoot.columns import RowLayout
from surefoot.deploy import background_file
from surefoot.deploy.background_file import BackgroundFile
from surefoot.deploy.recorder import Recorder
from surefoot.deploy.run_saver import next_free_path
from surefoot.errors import SurefootError
from surefoot.task.partial_trace import TraceHeader, recover, row_bytes

STEP = 0.006
META = {
    "robot": "minitaur",
    "world": "robot",
    "control_step": STEP,
    "leg_names": ["a", "b", "c", "d"],
    "motor_names": [f"m{k}" for k in range(8)],
    "observation_names": ["x", "y", "z"],
    "ended": "time",
}
HEAD = TraceHeader.of_robot(META, actions=8, robot_archive=b"", commands=False)
LAYOUT = HEAD.layout


def opened(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    return np.full(3, 10.0 * k), np.full(8, 20.0 * k), np.full(8, 30.0 * k), np.full(3, 40.0 * k)


@pytest.fixture
def recorded(a_state):
    """A recorder after steps 0 to 2: state k has roll k / 100 and energy k^2."""

    def state(k: int):
        return replace(a_state, roll_pitch_yaw=np.array([k / 100, 0.0, 0.0]), energy=float(k**2))

    recorder = Recorder(LAYOUT, STEP, 10)
    recorder.begin(state(0), 100.0)
    for k in range(4):
        recorder.complete_rows(k, state(k))
        if k < 3:
            recorder.start_row(*opened(k))
    return recorder, state


def test_a_row_has_values_of_its_start_and_the_state_at_its_end(recorded):
    recorder, _ = recorded
    assert recorder.steps == 3
    columns = LAYOUT.columns(recorder.rows)
    assert columns["time"] == pytest.approx([0.006, 0.012, 0.018])
    assert columns["roll_pitch_yaw"][:, 0] == pytest.approx([0.01, 0.02, 0.03])
    assert columns["observation"][:, 0].tolist() == [0.0, 10.0, 20.0]
    assert columns["feedback"][:, -1].tolist() == [0.0, 20.0, 40.0]
    assert columns["target"][:, -1].tolist() == [0.0, 30.0, 60.0]
    assert columns["energy"].tolist() == [1.0, 3.0, 5.0]


def test_the_accelerometer_of_a_robot_that_has_one_is_in_its_trace(a_state):
    assert "accelerometer" not in LAYOUT.widths
    head = TraceHeader.of_robot(META, 8, b"", commands=False, accelerometer=True)
    recorder = Recorder(head.layout, STEP, 10)
    forces = [np.array([0.1 * k, -0.2, 9.8]) for k in range(3)]
    recorder.begin(a_state, 100.0)
    for k, force in enumerate(forces):
        recorder.complete_rows(k, replace(a_state, accelerometer=force))
        recorder.start_row(*opened(k))
    # A reading that is not finite is left out like all others: the next row is that of a missed step.
    recorder.complete_rows(3, replace(a_state, accelerometer=np.array([0.0, np.nan, 0.0])))
    assert recorder.steps == 2
    np.testing.assert_array_equal(head.trace(recorder.rows, {}).accelerometer, forces[1:])


def test_missed_steps_repeat_the_target_that_servos_held(recorded):
    recorder, state = recorded
    recorder.start_row(*opened(3))
    recorder.complete_rows(6, state(6))
    assert recorder.steps == 6
    assert recorder.missed == [4, 5]
    columns = LAYOUT.columns(recorder.rows)
    assert np.diff(columns["time"]) == pytest.approx(STEP)
    assert columns["target"][3:, 0].tolist() == [90.0, 90.0, 90.0]
    assert columns["observation"][3:, 0].tolist() == [30.0, 30.0, 30.0]
    assert columns["energy"][3:].tolist() == [36.0 - 9.0, 0.0, 0.0]


def test_a_state_that_is_not_finite_completes_no_row(recorded):
    recorder, state = recorded
    recorder.start_row(*opened(3))
    recorder.complete_rows(4, replace(state(4), motor_velocity=np.full(8, np.nan)))
    assert recorder.steps == 3


def test_a_full_recorder_accepts_no_more_rows(recorded):
    recorder, state = recorded
    recorder.start_row(*opened(3))
    recorder.complete_rows(99, state(4))
    assert recorder.steps == 10


def test_energy_after_a_counter_reset_is_not_counted(recorded):
    recorder, state = recorded
    recorder.start_row(*opened(3))
    recorder.complete_rows(4, state(0))
    assert LAYOUT.columns(recorder.rows)["energy"][3] == 0.0


def test_quantities_that_are_not_measured_are_nan_in_the_trace(recorded):
    trace = HEAD.trace(recorded[0].rows, {})
    assert trace.num_steps == 3
    assert np.isnan(trace.base_position_world).all()
    assert np.isnan(trace.foot_contact).all()
    assert trace.motor_torque.shape == (3, 8)
    with pytest.raises(SurefootError, match="no control step was done"):
        HEAD.trace(recorded[0].rows[:0], {})


@pytest.fixture
def partial(recorded, tmp_path):
    """The partial file of the recorder's rows."""
    file = BackgroundFile(tmp_path / "run.partial", 0.1)
    file.add(HEAD.line())
    for row in recorded[0].rows:
        file.add(row_bytes(row[None]))
    file.close()
    assert file.error == ""
    return file.path


def test_a_partial_file_gives_the_same_trace(recorded, partial):
    trace = recover(partial)
    assert (trace.meta["ended"], trace.meta["reason"]) == ("fault", "cut off")
    whole = HEAD.trace(recorded[0].rows, {})
    for name in ("time", "target", "observation", "energy", "roll_pitch_yaw"):
        assert getattr(trace, name).tolist() == getattr(whole, name).tolist()


def test_an_incomplete_row_is_skipped(partial):
    partial.write_bytes(partial.read_bytes()[:-5])
    assert recover(partial).num_steps == 2


@pytest.mark.parametrize("commands", [0, 3])
def test_a_partial_file_of_version_1_is_read(recorded, tmp_path, commands):
    rows, path = recorded[0].rows, tmp_path / "run.npz.partial"
    counts = {"motors": 8, "legs": 4, "observations": 3, "actions": 8, "commands": commands}
    former = np.column_stack([rows[:, 0], 100.0 + rows[:, 0], rows[:, 1:], np.full((len(rows), commands), 0.5)])
    head = json.dumps({"kind": "surefoot-partial-trace", **counts, "meta": META})
    path.write_bytes(head.encode() + b"\n" + former.astype("<f8").tobytes())
    trace, whole = recover(path), HEAD.trace(rows, {})
    for name in ("time", "roll_pitch_yaw", "motor_torque", "observation", "feedback", "target", "energy"):
        assert getattr(trace, name).tolist() == getattr(whole, name).tolist()
    assert np.isfinite(trace.command).all() == bool(commands)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (None, "can't be read: No such file"),
        (b"", "is not a partial trace file"),
        (b"{}\n", "is not a partial trace file"),
        (b"[1]\n", "is not a partial trace file"),
        (b'{"kind": "other"}\n', "is not a partial trace file"),
        (b"\xff\xfe\n", "is not a partial trace file"),
        (TraceHeader(LAYOUT, {}).line(), "holds no complete control step"),
        (TraceHeader(RowLayout({}), {}).line() + bytes(800), "holds no complete control step"),
        (TraceHeader(LAYOUT, {}).line() + bytes(8 * LAYOUT.width), "trace: meta.robot, meta.world, .* are missing"),
        (HEAD.line().replace(b'"version": 2', b'"version": 3'), "is of version 3; surefoot reads versions 1 and 2"),
        (TraceHeader(RowLayout({"time": -1}), META).line() + bytes(800), "columns.time is -1; it must be 0 or more"),
        (
            TraceHeader(RowLayout({"base_quat_world": 4}), META, {"base_quat_world": np.zeros(3)}).line() + bytes(32),
            r"column base_quat_world \(T\+1, 4\) has 4 numbers in a row",
        ),
        (TraceHeader(RowLayout({"roll_pitch_yaw": 6}), META).line() + bytes(48), "has 6 numbers in a row"),
        (TraceHeader(RowLayout({"foot_position_world": 7}), META).line() + bytes(56), "has 7 numbers in a row"),
        (TraceHeader(RowLayout({"time": 1}), META).line() + bytes(8), "has shape"),
        (b'{"kind": "surefoot-partial-trace", "meta": {}, "motors": 8}', "is not a partial trace file: 'legs'"),
    ],
)
def test_a_file_that_is_not_a_partial_trace_is_rejected(content, match, tmp_path):
    path = tmp_path / "run.partial"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SurefootError, match=match):
        recover(path)


def test_a_file_that_cannot_be_opened_stops_recording(tmp_path):
    file = BackgroundFile(tmp_path / "none" / "run.partial", 0.1)
    file.add(b"row")
    file.close()
    assert file.error == "No such file or directory"


def test_an_error_that_the_disk_reports_at_the_end_is_stored(tmp_path):
    file = BackgroundFile(tmp_path / "run.partial", None)
    file.add(b"row")
    file._file.close()
    file._file = mock.Mock(close=mock.Mock(side_effect=OSError(28, "No space left on device")))
    file.close()
    assert file.error == "No space left on device"


def test_a_file_without_data_is_not_created(tmp_path):
    BackgroundFile(tmp_path / "run.partial", 0.1).close()
    assert list(tmp_path.iterdir()) == []


def test_a_blocked_disk_does_not_block_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(background_file, "CLOSE_TIMEOUT", 0.1)
    file = BackgroundFile(tmp_path / "run.partial", 0.1)
    file._writer.send_signal(signal.SIGSTOP)
    os.waitpid(file._writer.pid, os.WUNTRACED)  # on a busy computer it continues to read for a while
    start = time.monotonic()
    for _ in range(40):
        file.add(bytes(100_000))
    assert time.monotonic() - start < 5.0
    assert 25 < file.pending < 40
    file.close()
    assert file.error == "the disk does not respond"
    file._writer.kill()
    file._writer.wait()


def test_data_that_wait_for_a_slow_disk_are_written_in_order(tmp_path):
    file, pieces = BackgroundFile(tmp_path / "run.partial", 0.01), [bytes([k]) * 100_000 for k in range(40)]
    file._writer.send_signal(signal.SIGSTOP)
    for piece in pieces:
        file.add(piece)
    file._writer.send_signal(signal.SIGCONT)
    file.close()
    assert file.error == ""
    assert file.path.read_bytes() == b"".join(pieces)


def test_a_writer_that_is_killed_stops_recording(tmp_path):
    file = BackgroundFile(tmp_path / "run.partial", 0.1)
    file._writer.kill()
    file._writer.wait()
    file.add(b"row")
    assert file.error == "its process has ended"
    file.close()


def test_data_added_by_a_killed_process_are_in_the_file(tmp_path):
    program = """
import os, signal, sys
from pathlib import Path
from surefoot.columns import RowLayout
from surefoot.deploy import background_file
from surefoot.deploy.background_file import BackgroundFile

file = BackgroundFile(Path(sys.argv[1]), 0.1)
for k in range(300):
    file.add(b"%03d " % k * 200)
os.killpg(0, signal.SIGKILL)
"""
    path = tmp_path / "run.partial"
    done = subprocess.run([sys.executable, "-c", program, path], start_new_session=True, check=False)
    assert done.returncode == -signal.SIGKILL
    whole, end = b"".join(b"%03d " % k * 200 for k in range(300)), time.monotonic() + 30.0
    while (not path.exists() or path.read_bytes() != whole) and time.monotonic() < end:
        time.sleep(0.01)
    assert path.read_bytes() == whole


def test_file_numbers_skip_complete_and_partial_runs(tmp_path):
    assert next_free_path(tmp_path / "new").name == "run_000.npz"
    (tmp_path / "run_000.npz").touch()
    (tmp_path / "run_001.npz.partial").touch()
    assert next_free_path(tmp_path) == tmp_path / "run_002.npz"
