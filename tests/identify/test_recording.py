"""Recordings are read as written, or rejected with a one-line error."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.recording import COMPLETE, Recording, load_recording
from surefoot.robot import RobotDescription

ARRAYS = ("sent_value", "time", "motor_angle", "temperature")


def saved(recording: Recording, path: Path, **meta: Any) -> Path:
    """Write a recording with changed metadata."""
    return replace(recording, meta={**recording.meta, **meta}).save(path)


def rejected(path: Path, robot: RobotDescription, experiment: str | None = None) -> str:
    with pytest.raises(SurefootError, match=f"^recording {path}: ") as caught:
        load_recording(path, robot, experiment)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_recording_is_read_as_written(recorded: Recording, robot: RobotDescription, tmp_path: Path):
    path = recorded.save(tmp_path / "deep" / "recording.npz")
    loaded = load_recording(path, robot, "motor")
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(recorded, name))
    assert json.loads(json.dumps(recorded.meta)) == loaded.meta
    assert loaded.digest == recorded.digest
    assert loaded.meta["ended"] == COMPLETE


def test_commands_in_lockstep_arrive_when_they_are_sent(recorded: Recording):
    # Within the time resolution of states.
    np.testing.assert_allclose(recorded.arrival, recorded.sent_time, atol=2e-5)
    assert abs(recorded.clock_offset) < 2e-5


def test_states_are_assigned_to_phases(recorded: Recording):
    lengths = [recorded.phase_states(k) for k in range(len(recorded.meta["phases"]))]
    assert all(one.stop <= other.start for one, other in pairwise(lengths))
    for phase, states in zip(recorded.meta["phases"], lengths, strict=True):
        assert states.stop - states.start == pytest.approx(phase["duration"] / recorded.meta["period"], abs=2)
    assert recorded.phase_states(99) == slice(0, 0)
    assert recorded.still_motors == frozenset()


def test_a_recording_without_a_needed_phase_is_rejected(recorded: Recording):
    assert recorded.require_phases("fit") == recorded.phases("fit") != []
    phases = [{**phase, "use": "transition"} for phase in recorded.meta["phases"]]
    with pytest.raises(SurefootError, match="the recording has no phase with the use 'fit'"):
        replace(recorded, meta={**recorded.meta, "phases": phases}).require_phases("fit")


def test_load_rejects_missing_and_foreign_files(robot: RobotDescription, tmp_path: Path):
    assert rejected(tmp_path / "none.npz", robot).endswith("can't be read: No such file or directory")
    text = tmp_path / "text.npz"
    text.write_text("hello")
    rejected(text, robot)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    assert "has schema None" in rejected(tmp_path / "other.npz", robot)
    np.savez(tmp_path / "odd.npz", meta=np.array("3"))
    assert "has schema None; surefoot reads schema 1" in rejected(tmp_path / "odd.npz", robot)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.9, 0.999, None])
def test_load_rejects_damaged_files(
    recorded: Recording, robot: RobotDescription, tmp_path: Path, fraction: float | None
):
    path = recorded.save(tmp_path / "recording.npz")
    content = bytearray(path.read_bytes())
    if fraction is None:
        content[len(content) // 2] ^= 16
    path.write_bytes(content if fraction is None else content[: int(fraction * len(content))])
    assert "no file of arrays" in rejected(path, robot)


def test_load_names_missing_and_unknown_entries(recorded: Recording, robot: RobotDescription, tmp_path: Path):
    path = tmp_path / "recording.npz"
    meta = {key: value for key, value in recorded.meta.items() if key not in ("period", "frames")}
    replace(recorded, meta=meta).save(path)
    assert rejected(path, robot).endswith("meta.period, meta.frames are missing; they must be given")
    recorded.save(path)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "voltage"}
    np.savez(path, more=np.zeros(2), **arrays)
    assert rejected(path, robot).endswith("missing or unknown: more, voltage")


def test_load_rejects_changed_data(recorded: Recording, robot: RobotDescription, tmp_path: Path):
    torque = recorded.motor_torque.copy()
    torque[100, 3] += 0.001
    path = replace(recorded, motor_torque=torque).save(tmp_path / "recording.npz")
    assert "was changed after it was recorded: its digest does not match" in rejected(path, robot)
    assert "is of experiment motor, not mass" in rejected(recorded.save(path), robot, "mass")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "has schema 2; surefoot reads schema 1"),
        ({"robot": "cat"}, "is of robot 'cat', not of 'minitaur'"),
        ({"motor_names": ["m"]}, "not of 'minitaur' with its motors"),
        ({"ended": "stopped by the operator"}, "stopped early: stopped by the operator"),
        ({"phases": [[]]}, "meta.phases[0] is []; it must be a table with keys from: name, mode, use, duration"),
        (
            {"phases": [{"name": "a", "mode": 1, "use": "fit", "duration": 0}]},
            "meta.phases[0].duration is 0; it must be over 0",
        ),
        ({"phases": 3}, "meta.phases is 3; it must be a list of values, each a table"),
        ({"mode_changes": [0.1]}, "meta.mode_changes[0] is 0.1; it must be a list of 2 values, each a number"),
        ({"frames": []}, "meta.frames is []; it must be a table with keys from: received, missing, damaged"),
        ({"resting_states": [1]}, "meta.resting_states is [1]; it must be a whole number"),
        ({"resting_states": -1}, "meta.resting_states is -1; it must be 0 or more"),
        ({"period": 10**400}, "meta.period is 1000"),
        ({"servo_period": 0}, "meta.servo_period is 0; it must be over 0"),
        ({"ended": None}, "meta.ended is None; it must be text"),
    ],
)
def test_load_rejects_invalid_entries(
    recorded: Recording, robot: RobotDescription, tmp_path: Path, change: Any, message: str
):
    assert message in rejected(saved(recorded, tmp_path / "a.npz", **change), robot)


@pytest.mark.parametrize("odd", ["time", "sent_value", "roll_pitch_yaw", "mode"])
def test_load_rejects_arrays_of_another_shape_or_type(
    recorded: Recording, robot: RobotDescription, tmp_path: Path, odd: str
):
    whole = getattr(recorded, odd)
    for k, array in enumerate((whole[:-1], whole.reshape(-1, 1, 1), np.array(0.0))):
        path = saved(replace(recorded, **{odd: array}), tmp_path / f"{k}.npz")
        assert re.search(r": \w+ has shape \([\d, ]*\), but must have \(", rejected(path, robot))
    path = saved(replace(recorded, **{odd: whole.astype("U5")}), tmp_path / "text.npz")
    assert rejected(path, robot).endswith(f": {odd} holds <U5, but must hold numbers")
    if np.any(whole.astype("?") != whole):  # a base on a rack is level throughout
        path = saved(replace(recorded, **{odd: whole.astype("?")}), tmp_path / "truth.npz")
        assert "its digest does not match" in rejected(path, robot)
