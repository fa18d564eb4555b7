"""EpisodeTrace: checks of arrays and meta, and files that are read completely or rejected."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped_variants import maxitaur

from surefoot.columns import columns_of
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

LEGS = ["front_left", "back_left", "front_right", "back_right"]


def trace_arguments(steps: int = 5, motors: int = 8, observations: int = 3) -> dict[str, Any]:
    """Return the arguments of a valid trace of random numbers."""
    rng = np.random.default_rng(0)
    widths = {
        **dict.fromkeys(("roll_pitch_yaw", "angular_velocity_base"), 3),
        **dict.fromkeys(("motor_angle", "motor_velocity", "motor_torque", "target"), motors),
        **{"observation": observations, "feedback": 2 * len(LEGS)},
    }
    return {
        **{name: rng.normal(size=(steps, width)) for name, width in widths.items()},
        "time": 0.006 * np.arange(1, steps + 1),
        "base_position_world": rng.normal(size=(steps + 1, 3)),
        "base_quat_world": np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)),
        "energy": rng.random(steps),
        "foot_contact": rng.random((steps, len(LEGS))),
        "meta": {
            "robot": "minitaur",
            "world": "mujoco",
            "policy": "trot",
            "seed": 3,
            "control_step": 0.006,
            "leg_names": LEGS,
            "motor_names": [f"m{i}" for i in range(motors)],
            "observation_names": [f"o{i}" for i in range(observations)],
            "params": {"mass": np.array([7.473]), "count": np.int64(2)},
            "ended": "time",
        },
    }


def rewrite(path: Path, **changed: Any) -> None:
    """Rewrite the .npz file with changed arrays (None removes one)."""
    with np.load(path) as file:
        arrays = dict(file)
    arrays.update(changed)
    np.savez_compressed(path, **{k: v for k, v in arrays.items() if v is not None})


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Return the path of a valid trace file."""
    return EpisodeTrace(**trace_arguments(steps=200)).save(tmp_path / "episode.npz")


def test_a_saved_trace_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    trace = EpisodeTrace(**trace_arguments())
    back = EpisodeTrace.load(trace.save(tmp_path / "deep" / "er" / "episode.npz"))
    for name in trace_arguments():
        if name != "meta":
            np.testing.assert_array_equal(getattr(trace, name), getattr(back, name))
    assert back.meta == trace.meta
    assert np.isnan(back.foot_position_world).all()
    assert back.foot_position_world.shape == (5, 4, 3)


def test_a_trace_contains_only_robots_that_do_not_ship(tmp_path: Path) -> None:
    robot = RobotDescription.load(maxitaur(tmp_path / "mine"))
    arguments = trace_arguments()
    plain = EpisodeTrace(**arguments).save(tmp_path / "plain.npz")
    with np.load(plain) as file:
        assert "robot" not in file
    arguments["meta"]["robot"] = "maxitaur"
    with pytest.raises(
        SurefootError, match="is of robot 'maxitaur', which is not built in; give its folder with --robot"
    ):
        EpisodeTrace(**arguments).load_robot()
    path = EpisodeTrace(**arguments, robot_archive=robot.archive).save(tmp_path / "carried.npz")
    shutil.rmtree(robot.folder)
    assert EpisodeTrace.load(path).load_robot().name == "maxitaur"
    rewrite(path, robot=np.zeros((2, 2)))
    with pytest.raises(SurefootError, match="robot must hold bytes"):
        EpisodeTrace.load(path)


@pytest.mark.parametrize(("width", "fits"), [(8, True), (12, True), (9, False)])
def test_feedback_has_two_or_three_columns_per_leg_or_one_per_motor(width: int, fits: bool) -> None:
    arguments = trace_arguments(motors=12) | {"feedback": np.zeros((5, width))}
    refusal = pytest.raises(SurefootError, match=r"feedback has shape \(5, 9\)")
    with nullcontext() if fits else refusal:
        EpisodeTrace(**arguments)


def test_meta_gets_defaults_and_plain_json_types() -> None:
    meta = EpisodeTrace(**trace_arguments()).meta
    assert meta["schema"] == 1
    assert meta["energy_weight"] == 0.008
    assert meta["max_steps"] == 1000
    assert meta["params"] == {"mass": [7.473], "count": 2}
    json.dumps(meta)


def test_arrays_are_copies_and_read_only() -> None:
    arguments = trace_arguments()
    trace = EpisodeTrace(**arguments)
    arguments["energy"][0] = 99.0
    assert trace.energy[0] < 1.0
    with pytest.raises(ValueError, match="read-only"):
        trace.energy[0] = 0.0


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("motor_angle", np.zeros((5, 7)), r"motor_angle has shape \(5, 7\), but must have \(5, 8\)"),
        ("base_position_world", np.zeros((5, 3)), r"must have \(6, 3\)"),
        ("feedback", np.zeros((5, 4)), r"must have \(5, 8\)"),
        ("time", np.array([0.1, 0.2, 0.2, 0.3, 0.4]), "strictly increasing"),
        ("time", np.array([0.0, 0.2, 0.3, 0.4, 0.5]), "strictly increasing"),
        ("energy", np.array([1.0, 1.0, np.nan, 1.0, 1.0]), "energy row 2 is nan"),
        ("energy", -np.ones(5), "0 or above"),
        ("base_position_world", np.full((6, 3), np.inf), "finite or NaN"),
        ("base_quat_world", np.ones((6, 4)), "unit quaternions"),
        ("foot_contact", np.full((5, 4), 1.5), "0 to 1"),
        ("motor_saturation", np.full((5, 8), 1.5), "0 to 1"),
        ("motor_saturation", np.zeros((5, 3)), r"must have \(5, 8\)"),
        ("energy", np.full(5, "x"), "energy holds <U1, but must hold numbers"),
    ],
)
def test_invalid_arrays_are_rejected(name: str, value: np.ndarray, match: str) -> None:
    with pytest.raises(SurefootError, match=match):
        EpisodeTrace(**{**trace_arguments(), name: value})


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"ended": "tired"}, "time, fall, fault, stopped"),
        ({"control_step": 0.0}, "meta.control_step is 0; it must be over 0"),
        ({"max_steps": True}, "meta.max_steps is True; it must be a whole number"),
        ({"energy_weight": "much"}, "meta.energy_weight is 'much'; it must be a number"),
        ({"leg_names": ["a", "a", "b", "c"]}, "leg_names"),
        ({"params": {"f": lambda: None}}, "JSON"),
        ({"lead": "early"}, "trace: meta.lead is 'early'; it must be a number or nothing"),
        ({"missed_steps": [0.5]}, r"meta.missed_steps\[0\] is 0.5; it must be a whole number"),
    ],
)
def test_invalid_meta_is_rejected(change: dict[str, Any], match: str) -> None:
    arguments = trace_arguments()
    arguments["meta"] |= change
    with pytest.raises(SurefootError, match=match):
        EpisodeTrace(**arguments)


def test_missing_meta_is_named_and_an_episode_without_steps_rejected() -> None:
    arguments = trace_arguments()
    del arguments["meta"]["world"]
    with pytest.raises(SurefootError, match="world is missing"):
        EpisodeTrace(**arguments)
    with pytest.raises(SurefootError, match="at least one control step"):
        EpisodeTrace(**trace_arguments(steps=0))


def test_a_file_cut_off_anywhere_is_rejected(saved: Path) -> None:
    whole = saved.read_bytes()
    for size in np.linspace(0, len(whole) - 1, 40).astype(int):
        saved.write_bytes(whole[:size])
        with pytest.raises(SurefootError, match=r"episode\.npz: is cut off"):
            EpisodeTrace.load(saved)


def test_a_flipped_byte_never_passes_as_other_numbers(saved: Path) -> None:
    whole = saved.read_bytes()
    good = EpisodeTrace.load(saved)
    for at in np.linspace(0, len(whole) - 1, 150).astype(int):
        damaged = bytearray(whole)
        damaged[at] ^= 0x55
        saved.write_bytes(damaged)
        try:
            trace = EpisodeTrace.load(saved)
        except SurefootError as error:
            assert "episode.npz" in str(error)  # noqa: PT017
            assert "\n" not in str(error)  # noqa: PT017
        else:  # a byte without effect, such as a date in the archive
            for name in columns_of(EpisodeTrace):
                np.testing.assert_array_equal(getattr(trace, name), getattr(good, name), err_msg=name)
            assert trace.meta == good.meta


def test_other_files_are_rejected(tmp_path: Path, saved: Path) -> None:
    with pytest.raises(SurefootError, match=r"none\.npz: can't be read: No such file"):
        EpisodeTrace.load(tmp_path / "none.npz")
    text = tmp_path / "text.npz"
    text.write_text("hello")
    with pytest.raises(SurefootError, match=r"is cut off, damaged or no file of arrays"):
        EpisodeTrace.load(text)
    other = tmp_path / "other.npz"
    np.savez(other, x=np.zeros(3))
    with pytest.raises(SurefootError, match="not an episode trace: it has no meta"):
        EpisodeTrace.load(other)
    np.savez(other, meta=np.array("[" * 10_000))
    with pytest.raises(SurefootError, match="not an episode trace: it has no meta"):
        EpisodeTrace.load(other)
    meta = EpisodeTrace.load(saved).meta
    deep = json.dumps({**meta, "params": {}}).replace('"params": {}', f'"params": {{"a": {"[" * 900}{"]" * 900}}}')
    np.savez(other, meta=np.array(deep))
    with pytest.raises(SurefootError, match="meta is nested too deep"):
        EpisodeTrace.load(other)
    rewrite(saved, energy=None)
    with pytest.raises(SurefootError, match="missing or unknown energy"):
        EpisodeTrace.load(saved)
    rewrite(saved, meta=np.array(json.dumps({**meta, "schema": 2})))
    with pytest.raises(SurefootError, match="schema is 2; choices: 1"):
        EpisodeTrace.load(saved)


def test_pickles_are_never_opened(saved: Path) -> None:
    rewrite(saved, energy=np.array([{"a": 1}], dtype=object))
    with pytest.raises(SurefootError, match="no file of arrays"):
        EpisodeTrace.load(saved)


def test_a_failed_save_leaves_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    trace = EpisodeTrace(**trace_arguments())

    def out_of_space(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", out_of_space)
    with pytest.raises(OSError, match="No space"):
        trace.save(saved)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == ["episode.npz"]


def test_the_name_must_end_in_npz(tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match=r"must end in \.npz"):
        EpisodeTrace(**trace_arguments()).save(tmp_path / "episode.json")
