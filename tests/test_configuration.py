"""Hostile YAML and TOML, bounds of fields, names of files, quoted values, and size limits of files."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from surefoot.configuration import Within, check_bounds, from_mapping, is_number, read_toml, read_yaml, to_mapping
from surefoot.errors import SurefootError, check_name, quote
from surefoot.files import CONFIGURATION_BYTES, check_readable, read_configuration, remove_abandoned


def yaml(folder: Path, text: str) -> dict[str, Any]:
    (folder / "a.yaml").write_text(text)
    return read_yaml(folder / "a.yaml")


BOMB = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 12))


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "it contains more than 200000 values"),
        (MERGES, "it contains more than 200000 values"),
        ("a: &a [*a]", "a value that contains itself"),
        ("a: " + "[" * 5000 + "]" * 5000, "it is nested more than 50 levels deep"),
        ("a: " + "9" * 6000, "is not YAML"),
        ("a: !!timestamp x", "is not YAML"),
        ("a: !!int x", "is not YAML"),
        ("a: !!bool x", "is not YAML"),
    ],
    ids=["aliases", "merges", "itself", "deep", "digits", "date", "int", "bool"],
)
def test_hostile_yaml_is_rejected_in_one_line(tmp_path: Path, text: str, message: str):
    with pytest.raises(SurefootError, match=message) as caught:
        yaml(tmp_path, text)
    assert len(str(caught.value)) < 500


def test_dates_are_text(tmp_path: Path):
    assert yaml(tmp_path, "a: 2020-01-01\nb: 2020-13-45\n") == {"a": "2020-01-01", "b": "2020-13-45"}


def test_moderate_aliases_and_merges_are_read(tmp_path: Path):
    assert yaml(tmp_path, "a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: *a\n") == {
        "a": {"x": 1},
        "b": {"x": 1, "y": 2},
        "c": {"x": 1},
    }


@pytest.mark.parametrize("text", ["a = " + "[" * 5000 + "]" * 5000, "a = " + "9" * 6000, "a", "\xff"])
def test_hostile_toml_is_rejected_in_one_line(tmp_path: Path, text: str):
    (tmp_path / "a.toml").write_text(text, encoding="latin-1")
    with pytest.raises(SurefootError, match=r"a\.toml: is not TOML"):
        read_toml(tmp_path / "a.toml")


@dataclass(frozen=True)
class Config:
    """A field of each type."""

    number: Annotated[float, Within(0, 1, exclusive=True)] = 0.5
    count: Annotated[int, Within(1, 10)] | None = None
    units: tuple[Annotated[int, Within(1, 10)], ...] = ()
    free: float = 0.0
    word: str = ""
    anything: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the bounds of all fields."""
        check_bounds(self, "c")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"number": float("nan")}, "c.number is nan; it must be a finite number"),
        ({"number": 0.0}, "c.number is 0; it must be over 0"),
        ({"number": 2.0}, "c.number is 2; it must be 1 or less"),
        ({"count": 0}, "c.count is 0; it must be 1 or more"),
        ({"units": (3, 11)}, r"c.units\[1\] is 11; it must be 10 or less"),
        ({"free": float("inf")}, "c.free is inf; it must be 1e.15 or less"),
        ({"count": 10**400}, "c.count is 1000.*000; it must be 10 or less"),
        ({"anything": {"a": [10**400]}}, r"c.anything.a\[0\] is 1000"),
        ({"word": "a\0b"}, "c.word is .* Unicode text"),
        ({"word": "x" * 5000}, "c.word is .* 4096 characters"),
        ({"word": "\udc80"}, "c.word is .* Unicode text"),
    ],
)
def test_values_out_of_bounds_are_rejected(values: dict[str, Any], message: str):
    with pytest.raises(SurefootError, match=f"^{message}"):
        Config(**values)


def test_values_within_bounds_are_accepted():
    Config(number=1.0, count=10, units=(1, 10), free=-1e15, word="\u00e9", anything={"a": [True, None, 1]})


def test_a_number_too_large_for_a_float_is_rejected():
    with pytest.raises(SurefootError, match=r"^free is 1000.* it must be a finite number"):
        from_mapping(Config, {"free": 10**400})
    assert not is_number(10**400)


@dataclass(frozen=True)
class Choices:
    """Fields with a few choices, and a list of values of different types."""

    level: Literal[1, 2] = 1
    on: Literal[True] | None = None
    setting: tuple[str, float] = ("a", 1.0)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"level": True}, "level is True; choices: 1, 2"),
        ({"on": 1}, "on is 1; it must be True or nothing"),
        ({"setting": []}, r"setting is \[\]; it must be a list of 2 values: text, a number"),
        ({"x\0": 1}, r"'x\\x00' is not a key; choices: level, on, setting"),
        ({"k" * 101: 1}, "'k+\\.\\.\\.k+' is not a key"),
    ],
)
def test_invalid_choices_keys_and_lists_are_rejected_with_the_rule(data: dict[str, Any], message: str):
    with pytest.raises(SurefootError, match=f"^{message}"):
        from_mapping(Choices, data)
    assert from_mapping(Choices, {"level": 2, "on": True, "setting": ["b", 2]}) == Choices(2, True, ("b", 2.0))


@dataclass(frozen=True)
class Circle:
    """One of two shapes."""

    kind: Literal["circle"] = "circle"
    radius: Annotated[float, Within(0, 10)] = 1.0
    place: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Box:
    """The other shape."""

    kind: Literal["box"] = "box"
    width: float = 2.0
    place: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Drawing:
    """A table with one of the two shapes."""

    shape: Circle | Box = field(default_factory=Circle)


@pytest.mark.parametrize(
    ("data", "shape"),
    [
        ({}, Circle()),
        ({"radius": 2}, Circle(radius=2.0)),
        ({"kind": "box", "width": 3.0, "place": [1, 2]}, Box(width=3.0, place=(1.0, 2.0))),
        ({"kind": "box", "radius": 1}, Box()),  # a key of the other kind, with that kind's default
        ({"kind": "circle", "width": 2.0, "radius": 4.0}, Circle(radius=4.0)),
    ],
)
def test_the_key_kind_selects_the_dataclass(data: dict[str, Any], shape: Circle | Box):
    assert from_mapping(Drawing, {"shape": data}) == Drawing(shape)
    assert from_mapping(Drawing, to_mapping(Drawing(shape))) == Drawing(shape)


def test_a_base_of_another_kind_provides_the_common_fields():
    base = Drawing(Circle(radius=3.0, place=(1.0, 2.0)))
    assert from_mapping(Drawing, {"shape": {"radius": 4.0}}, base=base).shape == Circle("circle", 4.0, (1.0, 2.0))
    assert from_mapping(Drawing, {"shape": {"kind": "box"}}, base=base).shape == Box(place=(1.0, 2.0))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"kind": "ring"}, r"shape.kind is 'ring'; choices: circle, box"),
        ({"kind": ["box"]}, r"shape.kind is \['box'\]; choices: circle, box"),
        ({"radius": 11}, r"shape.radius is 11; it must be 10 or less"),
        (
            {"kind": "box", "radius": 2.0},
            r"shape.radius is not a key of kind box, but of circle; keys of kind box: kind, ",
        ),
        ({"kind": "box", "radius": "wide"}, r"shape.radius is 'wide'; it must be a number"),
        ({"kind": "box", "widht": 2.0}, r"shape.widht is not a key; did you mean width\? choices: kind, width, place"),
        (3, r"shape is 3; it must be a table with keys from: kind, radius, place"),
    ],
)
def test_a_table_that_matches_no_kind_is_rejected_in_one_line(data: Any, message: str):
    with pytest.raises(SurefootError, match=f"^{message}"):
        from_mapping(Drawing, {"shape": data})


@pytest.mark.parametrize("name", ["trot", "gallop-robust", "_1", "A" * 100])
def test_a_plain_name_is_accepted(name):
    check_name("name", name)


@pytest.mark.parametrize("name", ["", ".", "..", "../../x", "a/b", "a b", "a.b", "-x", "a\n", "\u00e9", "A" * 101])
def test_names_that_are_not_plain_file_names_are_rejected(name):
    with pytest.raises(SurefootError, match=r"^name is .*letters, digits, - and _ only"):
        check_name("name", name)


def test_a_quoted_value_is_shortened():
    bomb: list[object] = ["x"]
    for _ in range(60):
        bomb = [bomb] * 9
    for value in (bomb, {"a": bomb}, "x" * 10**6, 10**4000, list(range(10**5))):
        assert len(quote(value)) < 300
    assert quote([0, 1.5, "a"]) == "[0, 1.5, 'a']"
    assert quote(16**4000) == "a number of too many digits"


def test_a_configuration_must_be_a_regular_file_of_limited_size(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"x" * CONFIGURATION_BYTES)
    assert len(read_configuration(path)) == CONFIGURATION_BYTES
    path.write_bytes(b"x" * (CONFIGURATION_BYTES + 1))
    with pytest.raises(OSError, match=f"{CONFIGURATION_BYTES + 1} bytes"):
        read_configuration(path)


@pytest.mark.timeout(10)
def test_only_regular_files_are_read(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        for read in (check_readable, read_configuration):
            with pytest.raises(OSError, match=r"not a regular file|Is a directory"):
                read(path)


def test_only_unfinished_files_of_killed_processes_are_removed(tmp_path: Path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    gone = [tmp_path / f".fresh.ckpt.{pid}.tmp" for pid in (dead.pid, 10**30)]
    kept = [tmp_path / name for name in (f".fresh.ckpt.{os.getpid()}.tmp", "fresh.ckpt", ".a.tmp", f"b.{dead.pid}.tmp")]
    for path in (*gone, *kept):
        path.touch()
    remove_abandoned(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(kept)
