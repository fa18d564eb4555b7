"""Invalid words of a command line are refused in one line, before anything is simulated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from processes import refused, surefoot

pytest.importorskip("mujoco")

from surefoot.cli.helpers.parsing import positional_words

INVALID = [
    ("train trot --seed 12345678901234567890123", "seed is 12345678901234567890123; it must be 4294967295 or less"),
    ("train trot --ppo.gamma nan", "ppo.gamma is nan; it must be a finite number"),
    ("train trot --ppo.gamma 2", "ppo.gamma is 2; it must be 1 or less"),
    ("train trot --task.history 1000000000", "history is 1000000000; it must be 100 or less"),
    ("train trot --ppo.policy-hidden", "--ppo.policy-hidden has no value"),
    ("train trot --name ../../x", "name is '../../x'; a name has letters"),
    ("train name.yaml", "name.yaml: name is '../../x'; a name has letters"),
    ("train digits.yaml", "digits.yaml: is not YAML"),
    ("train large.yaml", "fall_angle is 1000000"),
    ("train list.yaml", "list.yaml: train: it is [1]; it must be a table"),
    ("study name.yaml", "name is '../../x'; a name has letters"),
    ("evaluate trot --trace", "--trace has no value; it takes one or more"),
    ("evaluate trot --params /dev/zero", "/dev/zero: can't be read: not a regular file"),
    ("show trot --duration 1e30", "duration is 1e+30; it must be 3600 or less"),
    ("evaluate sensitivity trot --values 1000000000", "values is 1000000000; it must be 1000 or less"),
    ("emulate --duration 1e30", "duration is 1e+30; it must be 10000000 or less"),
    ("evaluate trot --actuator servo", "servo"),
    ("train trot --actuator --pushes", "--actuator"),
    ("train trot --servo-latency soon", "--servo-latency"),
    ("train trot --control-latency 0 --set control_latency=0.01", "control_latency is given twice"),
    ("evaluate trot --servo-latency -0.001 --out o", "servo_latency is -0.001; minitaur allows"),
    ("evaluate trot --actuator constraint --thermal-protection --out o", "it requires actuator dc"),
    ("train trot --actuator constraint --task.thermal-protection", "thermal_protection is on; it requires actuator dc"),
    ("show trot --control-latency 1", "control_latency is 1; minitaur allows 0 to 0.1"),
    (
        "train trot --randomize.control_latency 0.03 0.01",
        "[0.03, 0.01]; the lower bound must come first",
    ),
    ("train trot --randomize.control-latency 0 15", "[0, 15]; minitaur allows control_latency from 0 to 0.1 (unit: s)"),
    ("train ranges.yaml", "ranges.yaml: randomize.voltage is [16, 15]; the lower bound must come first"),
    ("evaluate trot --randomize.base_mass_ratio 80 120", "minitaur allows base_mass_ratio from 0.2 to 5"),
    ("evaluate trot --randomize nowhere", "'nowhere' does not exist; choices: ensemble, none, table1, or the path"),
    ("train walk", "task 'walk' does not exist; choices: gallop, gallop-robust, scratch, steer, steer-robust, terrain"),
    ("train gallop --num-envs few", "few"),
    ("train gallop --nun-envs 8", "nun-envs"),
    ("train gallop --robot spot", "robot 'spot': no such robot"),
    ("train trot --task.feedback.swing -2 2", "swing can be -2.300 to 2.300 rad"),
    ("train gallop --task.observations roll smell", "observation 'smell' does not exist; choices: roll, pitch"),
    ("train --resume nowhere", "nowhere: is not a run folder"),
    ("train --resume run --params robot.toml", "--params is not an option; for every option: surefoot train --help"),
    (
        "study serach trot",
        "'serach' is neither the file of a study (.yaml) nor an action; did you mean search? choices: run, search",
    ),
    ("show trot --duraton 3", "--duraton is not an option; did you mean --duration?"),
    ("train trot --task.robot go2", "--task.robot is not an option; did you mean --robot?"),
    ("train trot --task.reward.progres 1", "did you mean --task.reward.progress?"),
    ("show a.npz --html a.html", "--html is not an option; for every option: surefoot show --help"),
    ("show", "no POLICY and no TRACE is given; for every option: surefoot show --help"),
    ("show --world bullet", "no POLICY and no TRACE is given"),
    ("show trot --layout over", "--layout does not go with trot, a policy; for every option: surefoot show --help"),
    ("show a.npz --pushes", "--pushes does not go with a.npz, a recorded run"),
    ("show trot --world", "--world has no value"),
    ("gap trot --to-actuator d", "--to-actuator is 'd'; did you mean dc? choices: dc, constraint"),
    ("evalute trot", "'evalute' is not a command; did you mean evaluate? choices: train, adopt"),
    ("robot chek go2", "'chek' is not an action; did you mean check? choices: new, check, firmware"),
    ("evaluate tort", "policy 'tort' does not exist; did you mean trot? choices: gallop"),
    ("evaluate trot --robot g2", "did you mean go2? choices: go2, minitaur"),
    ("train key.yaml", "observation is not a key; did you mean observations? choices: name, robot"),
    ("evaluate sensitivity", "no policy is given"),
    ("evaluate sensitivity trot --duration 0", "duration is 0; it must be over 0"),
    ("evaluate sensitivity trot --world moon", "world 'moon' does not exist; choices: mujoco"),
    (
        "evaluate sensitivity trot --ranges table9",
        "'table9' does not exist; did you mean table1? choices: ensemble, none",
    ),
    ("evaluate sensitivity trot --out /dev/null/out", "/dev/null"),
    ("evaluate \udc80", "the arguments hold characters that can't be printed"),
]


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    ("line", "message"), INVALID, ids=[line.encode(errors="replace").decode() for line, _ in INVALID]
)
def test_invalid_option_is_refused_in_one_line(line: str, message: str, tmp_path: Path):
    if line.startswith(("train", "study")):
        pytest.importorskip("torch")
    if line.startswith("evaluate sensitivity"):
        pytest.importorskip("matplotlib")
    (tmp_path / "name.yaml").write_text("name: ../../x\ngroups: {a: {}}\n" if "study" in line else "name: ../../x\n")
    (tmp_path / "key.yaml").write_text("observation: [roll]\n")
    (tmp_path / "digits.yaml").write_text(f"fall_angle: {'9' * 6000}\n")
    (tmp_path / "large.yaml").write_text(f"fall_angle: 1{'0' * 400}\n")
    (tmp_path / "list.yaml").write_text("train: [1]\n")
    (tmp_path / "ranges.yaml").write_text("randomize: {voltage: [16, 15]}\n")
    before = sorted(tmp_path.iterdir())
    refused(surefoot(*line.split(" "), cwd=tmp_path), message)
    assert sorted(tmp_path.iterdir()) == before


def test_error_is_one_short_line_without_control_characters(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_text(f'"\\e[2J{"x" * 100_000}": 1\n')
    done = surefoot("evaluate", "trot", "--randomize", path)
    refused(done)
    assert len(done.stderr) < 2500
    assert "\033" not in done.stderr


@dataclass(frozen=True)
class Options:
    name: str = ""
    loud: bool = False
    values: tuple[float, ...] = ()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("a b", "a b"),
        ("--name a b", "b"),
        ("--name=a b", "b"),
        ("--loud a --name b", "a"),
        ("--no-such a b --help c", "b c"),
        ("--values 1 2 a", "2 a"),
        ("--loud", ""),
    ],
)
def test_positional_words_are_not_values_of_options(line: str, found: str):
    assert positional_words(line.split(), Options) == found.split()
