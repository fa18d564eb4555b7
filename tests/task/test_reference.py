"""Reference gaits: sinusoids and tables, at points worked by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from references import read_reference

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.periodic_references import SineReference, Wave
from surefoot.task.reference import Feedforward, Reference

ROBOT = RobotDescription.load("minitaur")
LEGS = ROBOT.leg_names
DIAGONAL = {"front_left": 0.0, "back_left": np.pi, "front_right": np.pi, "back_right": 0.0}
TROT = {
    "kind": "sine",
    "swing": {"amplitude": 0.3, "frequency": 2.0, "phase": DIAGONAL},
    "extension": {"amplitude": 0.35, "frequency": 2.0, "phase": DIAGONAL, "offset": 2.0},
}
ROWS = {
    "kind": "table",
    "period": 0.8,
    "rows": {
        "swing": {leg: [0.0, 0.4, 0.0, -0.4] for leg in LEGS},
        "extension": {leg: [2.0, 2.0, 2.2, 1.8] for leg in LEGS},
    },
}
FOOT = {
    "kind": "foot",
    "foot": {
        **{"frequency": 2.0, "stroke": 0.1, "clearance": 0.03, "duty_factor": 0.6, "height": 0.2},
        **{"offset": 0.01, "depth": 0.005, "phase": {leg: 0.5 * (k in (1, 2)) for k, leg in enumerate(LEGS)}},
    },
}


def table(part: str, **other: list[float]) -> dict[str, Any]:
    """Return `ROWS` with changed poses of some legs."""
    rows = ROWS["rows"]
    return ROWS | {"rows": rows | {part: rows[part] | other}}


def foot(**other: Any) -> dict[str, Any]:
    return {"kind": "foot", "foot": FOOT["foot"] | other}


def test_no_reference_is_zero_at_all_times():
    reference = read_reference({}, ROBOT)
    pose = reference.pose(np.array([0.0, 0.3, 7.0]))
    assert pose.shape == (3, 2, 4)
    assert not pose.any()
    assert reference.period is None
    assert reference.extent() == ((0, 0), (0, 0))


# Two hertz: a quarter of a period is 0.125 s.
@pytest.mark.parametrize(
    ("time", "sine"), [(0.0, 0.0), (0.125, 1.0), (0.25, 0.0), (0.375, -1.0), (1 / 24, 0.5), (0.625, 1.0)]
)
def test_sine_at_known_phases(time: float, sine: float):
    swing, extension = np.moveaxis(read_reference(TROT, ROBOT).pose([time]), -2, 0)
    one = np.array([1, -1, -1, 1])
    np.testing.assert_allclose(swing, [0.3 * sine * one], atol=1e-12)
    np.testing.assert_allclose(extension, [2.0 + 0.35 * sine * one], atol=1e-12)


@pytest.mark.parametrize(("frequencies", "period"), [((2.0, 3.0), 1.0), ((1.5, 1.5), 2 / 3), ((1.0, np.sqrt(2)), None)])
def test_the_common_period_of_two_frequencies(frequencies: tuple[float, float], period: float | None):
    legs = ("a", "b")
    waves = {
        name: Wave(np.ones(2), np.full(2, frequency), np.zeros(2), np.zeros(2))
        for name, frequency in zip(("swing", "extension"), frequencies, strict=True)
    }
    assert SineReference(legs, waves).period == (None if period is None else pytest.approx(period))


def test_extent_covers_every_leg():
    np.testing.assert_allclose(read_reference(TROT, ROBOT).extent(), ((-0.3, 0.3), (1.65, 2.35)))
    offset = dict(zip(LEGS, (0.0, 0.1, -0.2, 0.0), strict=True))
    data = {"kind": "sine", "swing": {"amplitude": -0.3, "frequency": 1.0, "offset": offset}}
    np.testing.assert_allclose(read_reference(data, ROBOT).extent()[0], (-0.5, 0.4))


# A wave without amplitude does not matter.
@pytest.mark.parametrize(
    ("swing", "extension", "amplitude", "period"),
    [
        *((2.0, 2.0, 0.1, 0.5), (2.0, 4.0, 0.1, 0.5), (4.0, 2.0, 0.1, 0.5), (0.0, 2.0, 0.1, 0.5)),
        *((2.0, 3.1, 0.1, None), (0.0, 0.0, 0.1, None), (3.1, 2.0, 0.0, 0.5)),
    ],
)
def test_the_period_is_common_to_swing_and_extension(
    swing: float, extension: float, amplitude: float, period: float | None
):
    waves = {"swing": {"amplitude": amplitude, "frequency": swing}}
    waves["extension"] = {"amplitude": 0.1, "frequency": extension}
    assert read_reference({"kind": "sine", **waves}, ROBOT).period == period


# Rows are at 0, 0.2, 0.4 and 0.6 s, and the first row follows the last.
@pytest.mark.parametrize(
    ("time", "swing", "extension"),
    [
        (0.0, 0.0, 2.0),
        (0.1, 0.2, 2.0),
        (0.2, 0.4, 2.0),
        (0.45, -0.1, 2.1),
        (0.6, -0.4, 1.8),
        (0.7, -0.2, 1.9),
        (0.8, 0.0, 2.0),
        (0.9, 0.2, 2.0),
        (8.1, 0.2, 2.0),
    ],
)
def test_a_table_is_interpolated_linearly_and_repeats(time: float, swing: float, extension: float):
    got = read_reference(ROWS, ROBOT).pose([time])
    np.testing.assert_allclose(got, [[np.full(4, swing), np.full(4, extension)]], atol=1e-12)


def columns() -> dict[str, list[float]]:
    return {f"{part}_{leg}": ROWS["rows"][part][leg] for part in ("swing", "extension") for leg in LEGS}


def write(path: Path, table: dict[str, list[float]]) -> Path:
    if path.suffix == ".npz":
        np.savez(path, **{name: np.array(values) for name, values in table.items()})
    else:
        lines = [",".join(table), *(",".join(map(str, row)) for row in zip(*table.values(), strict=True))]
        path.write_text("\n".join(lines) + "\n")
    return path


def from_file(path: Path) -> Reference:
    return read_reference({"kind": "table", "file": str(path), "period": 0.8}, ROBOT)


@pytest.mark.parametrize("name", ["gait.csv", "gait.npz"])
def test_a_reference_from_a_file_equals_one_from_its_rows(tmp_path: Path, name: str):
    write(tmp_path / name, columns())
    time = np.linspace(0, 2, 37)
    assert np.array_equal(from_file(tmp_path / name).pose(time), read_reference(ROWS, ROBOT).pose(time))


def test_columns_are_matched_by_name(tmp_path: Path):
    table = columns()
    table["swing_back_right"] = [0.1, 0.1, 0.1, 0.1]
    reference = from_file(write(tmp_path / "gait.csv", dict(reversed(table.items()))))
    np.testing.assert_allclose(reference.pose([0.2])[:, 0], [[0.4, 0.4, 0.4, 0.1]])


# The straight leg is l = 0.101 + 0.240 m long: its natural frequency is sqrt(9.81 / 0.341) / 2 pi = 0.8536453 Hz.
def test_a_foot_reference_may_use_relative_units():
    lengths = ("stroke", "clearance", "height", "offset", "depth")
    absolute = foot(**{"frequency": 2.0 * 0.8536453} | {name: 0.341 * FOOT["foot"][name] * 3 for name in lengths})
    relative = foot(**{name: 3 * FOOT["foot"][name] for name in lengths})
    time = np.linspace(0, 1, 41)
    poses = [read_reference(data, ROBOT).pose(time) for data in (relative | {"relative": True}, absolute)]
    np.testing.assert_allclose(*poses, atol=1e-6)
    again = read_reference(read_reference(relative | {"relative": True}, ROBOT).to_dict(), ROBOT)
    np.testing.assert_array_equal(again.pose(time), poses[0])


@pytest.mark.parametrize("data", [{}, TROT, ROWS, FOOT])
def test_a_periodic_reference_has_no_feedforward_and_no_commands(data):
    reference = read_reference(data, ROBOT)
    assert reference.feedforward == Feedforward(0.0, 0.0, 0.0)
    assert (reference.following, reference.over_holes, reference.is_clipped) == (None, None, False)
    assert (reference.foothold_radius, reference.touch_clearance) == (0.0, 0.0)
    cycles = 1 / reference.period if reference.period else 0.0
    np.testing.assert_array_equal(reference.frequency(np.zeros((3, 3))), [cycles] * 3)
    np.testing.assert_array_equal(reference.load(), [0.25] * 4)


def test_rates_of_a_sinusoid_are_its_derivatives():
    reference, time = read_reference(TROT, ROBOT), np.linspace(0, 1, 17)
    angle, sign = 4 * np.pi * time[:, None], np.array([1, -1, -1, 1])
    # Differences over 4 and 20 ms are smaller by a factor of sin(x) / x: by 1e-4 and 2.6e-3.
    np.testing.assert_allclose(reference.pose_rate(time)[:, 0], 0.3 * 4 * np.pi * np.cos(angle) * sign, atol=1e-3)
    second = -0.3 * (4 * np.pi) ** 2 * np.sin(angle) * sign
    np.testing.assert_allclose(reference.pose_acceleration(time)[:, 0], second, atol=0.15)


@pytest.mark.parametrize("data", [{}, TROT, ROWS, FOOT])
def test_to_dict_describes_the_same_reference(data):
    reference = read_reference(data, ROBOT)
    again = read_reference(reference.to_dict(), ROBOT)
    time = np.linspace(0, 2, 41)
    assert np.array_equal(reference.pose(time), again.pose(time))
    assert again.to_dict() == reference.to_dict()


@pytest.mark.parametrize(
    ("data", "pieces"),
    [
        ({"kind": "square"}, ["reference.kind is 'square'", "none, sine, table, foot, follow"]),
        (
            {"kind": "sine", "swign": {}},
            ["reference.swign is not a key", "did you mean swing? choices: kind, abduction, swing, extension"],
        ),
        ({"kind": "sine", "swing": {"amp": 1.0}}, ["reference.swing.amp is not a key", "amplitude, frequency"]),
        ({"kind": "sine", "swing": {"amplitude": "big"}}, ["reference.swing.amplitude is 'big'", "a number or"]),
        ({"kind": "sine", "swing": {"amplitude": np.inf}}, ["reference.swing.amplitude is inf"]),
        ({"kind": "sine", "swing": {"frequency": -1.0}}, ["reference.swing.frequency is -1", "0 or more"]),
        ({"kind": "sine", "abduction": {"offset": 0.1}}, ["reference.abduction is not zero", "no abduction"]),
        (
            {"kind": "sine", "swing": {"phase": {"front_left": 0.0, "back_left": 0.0, "front_right": 0.0}}},
            ["reference.swing.phase lacks back_right"],
        ),
        (
            {"kind": "sine", "swing": {"phase": DIAGONAL | {"tail": 0.0}}},
            ["reference.swing.phase.tail is not a key", "choices: front_left"],
        ),
        (
            TROT | {"foot": {"height": 0.1}},
            ["reference.foot is not a key of kind sine, but of foot, follow", "kind, abduction, swing, extension"],
        ),
        (
            {"swing": {"amplitude": 0.1}},
            ["swing is not a key of kind none, but of sine; keys of kind none: kind"],
        ),
        (FOOT | {"weight_feedforward": 1.0}, ["reference.weight_feedforward is not a key of kind foot, but of follow"]),
        (foot(stroke={"front_left": 0.1}), ["reference.foot.stroke lacks back_left"]),
        (foot(stroke=1e300), ["reference.foot.stroke is 1e+300", "10 or less"]),
        (foot(duty_factor=1.0), ["reference.foot.duty_factor is 1", "0.95 or less"]),
        (foot(frequency=0.0), ["reference.foot.frequency is 0", "0.01 or more"]),
        (foot(frequency={"front_left": 1.0}), ["reference.foot.frequency is {'front_left': 1.0}", "a number"]),
        (foot(height=0.4), ["the foot of front_left", "below its motors, out of the leg's reach"]),
        (foot(clearance={**dict.fromkeys(LEGS, 0.02), "back_right": 0.19}), ["the foot of back_right", "reach"]),
        (FOOT | {"kind": "follow"}, ["reference.kind is follow; it needs commands"]),
        (FOOT | {"kind": "follow", "stride_gain": 4.0}, ["reference.stride_gain is 4; it must be 3 or less"]),
        ({**ROWS, "period": 0.0}, ["reference.period is 0", "over 0"]),
        ({**ROWS, "period": None}, ["reference.period is missing"]),
        ({**ROWS, "rows": 4}, ["reference.rows is 4", "a table of"]),
        ({**ROWS, "rows": None}, ["reference.file is missing"]),
        ({**ROWS, "rows": {part: {leg: [1.0] for leg in LEGS} for part in ROWS["rows"]}}, ["has 1 row", "2 or more"]),
        ({**ROWS, "rows": {"swing": ROWS["rows"]["swing"]}}, ["reference.rows lacks extension"]),
        ({**ROWS, "rows": ROWS["rows"] | {"swing": {"front_left": [0.0]}}}, ["reference.rows.swing lacks back_left"]),
        (table("swing", back_left=[0.0]), ["reference.rows: columns differ in length (1, 4)"]),
        (table("swing", back_left=[0.0, np.nan, 0.0, 0.0]), ["reference.rows.swing.back_left[1] is nan"]),
    ],
)
def test_an_invalid_reference_is_rejected_in_one_line(data, pieces):
    with pytest.raises(SurefootError) as caught:
        read_reference(data, ROBOT)
    message = str(caught.value)
    assert "\n" not in message
    for piece in pieces:
        assert piece in message


@pytest.mark.parametrize("name", ["gait.csv", "gait.npz"])
@pytest.mark.parametrize(
    ("table", "piece"),
    [
        (
            {key: values for key, values in columns().items() if key != "extension_back_left"},
            "has no column extension_back_left; a table has columns swing_front_left",
        ),
        (columns() | {"swing_back_left": [0.0, np.nan, 0.0, 0.0]}, "row 2 of the table is not finite"),
        ({key: values[:1] for key, values in columns().items()}, "has 1 row(s); a periodic reference needs 2"),
        ({key: [] for key in columns()}, "has 0 row(s); a periodic reference needs 2"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*input contained no data")
def test_an_invalid_file_is_rejected_in_one_line(tmp_path: Path, name: str, table, piece: str):
    assert_rejected(write(tmp_path / name, table), piece)


def assert_rejected(path: Path, piece: str) -> None:
    with pytest.raises(SurefootError) as caught:
        from_file(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert piece in message


@pytest.mark.parametrize(
    ("name", "content", "piece"),
    [
        ("gait.txt", b"", "is not a .csv or .npz file"),
        ("gait.npz", b"not a zip", "can't be read as a table"),
        ("gait.npz", b"", "can't be read as a table"),
        ("gait.npz", b"PK\x03\x04 and no more", "can't be read as a table"),
        ("gait.npz", b"\x93NUMPY\x01\x00", "can't be read as a table"),
        ("gait.csv", b"", "can't be read as a table"),
        ("gait.csv", b"a,b\n1,2,3\n", "can't be read as a table"),
        ("gait.csv", b"\xff\xfe\x00\x01", "gait.csv: "),
        ("gait.csv", b"a,b\n1,2\n", "has no column swing_front_left"),
        ("gait.csv", None, "can't be read"),
        ("gait.npz", None, "can't be read"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*Empty input file", "ignore:.*input contained no data")
def test_a_file_without_a_table_is_rejected_in_one_line(tmp_path: Path, name: str, content: bytes | None, piece: str):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert_rejected(tmp_path / name, piece)


def test_npz_columns_of_unequal_length_are_rejected(tmp_path: Path):
    assert_rejected(
        write(tmp_path / "gait.npz", columns() | {"swing_back_left": [0.0, 0.1]}), "columns differ in length (2, 4)"
    )
