from __future__ import annotations

import json
from pathlib import Path

import pytest

from surefoot.cli.main import main

SHORT = ["--duration", "0.1"]


def test_motor_figure_without_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "figures" / "motor.png"
    assert main(["identify", "motor-figure", "--out", str(out), *SHORT]) == 0
    said = capsys.readouterr().out
    assert "servo and DC motor: " in said
    assert "rad RMS from target" in said
    assert out.read_bytes().startswith(b"\x89PNG")


def test_a_recording_of_one_world_against_the_models_in_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pybullet")
    log, out = tmp_path / "motor.csv", tmp_path / "motor.png"
    words = ["identify", "motor-figure", "--out", str(out), "--json"]
    assert main([*words, "--world", "bullet", "--record", str(log), "--duration", "0.5"]) == 0
    capsys.readouterr()
    assert main([*words, "--log", str(log)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["against"] == str(log)
    # The same laws in another engine come out the same; another law does not.
    assert told["rms_error"]["dc"] < 0.002
    assert told["rms_error"]["constraint"] > 5 * told["rms_error"]["dc"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["tail"],
            "'tail' is no experiment; choices: latency, motor, mass, contact, motor-figure, or --from-trace FOLDER",
        ),
        (["motor-figure", "--motor", "tail"], "motor 'tail' does not exist"),
        (["motor-figure", "--out", "motor.pdf"], "must end in .png"),
        (["motor-figure", "--frequency", "0"], "frequency is 0; it must be over 0"),
        (["motor-figure", "--log", "none.csv"], "none.csv: can't be read"),
        (["motor-figure", "--set", "mass=2"], "'mass' is no physical parameter"),
        (["motor-figure", "--world", "moon"], "world 'moon' does not exist"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["identify", *words]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
