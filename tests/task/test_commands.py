"""Commands: ranges, random commands, schedules and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scripted_world import COMMAND_LIMITS as LIMITS

from surefoot.errors import SurefootError
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.commands import CommandConfig, CommandSampler, CommandSchedule, read_schedule

STEP = np.array([0.1])


def test_relative_ranges_are_in_natural_units_of_the_legs() -> None:
    go2 = RobotDescription.load("go2")
    length = go2.leg_geometry.length
    limits = CommandConfig(relative=True, forward=(-0.5, 0.75), sideways=(-0.2, 0.2), yaw_rate=(-0.2, 0.2)).limits(go2)
    assert limits is not None
    assert limits.forward == pytest.approx((-0.5 * np.sqrt(GRAVITY * length), 0.75 * np.sqrt(GRAVITY * length)))
    assert limits.yaw_rate[1] == pytest.approx(0.2 * np.sqrt(GRAVITY / length))


def test_legs_without_abduction_get_no_sideways_command() -> None:
    minitaur = RobotDescription.load("minitaur")
    relative = CommandConfig(relative=True, forward=(0, 1), sideways=(-0.2, 0.2)).limits(minitaur)
    assert relative is not None
    assert relative.sideways == (0.0, 0.0)
    with pytest.raises(SurefootError, match=r"commands.sideways is not zero; the legs of minitaur have no abduction"):
        CommandConfig(forward=(0, 1), sideways=(-0.2, 0.2)).limits(minitaur)


def test_without_ranges_there_are_no_commands() -> None:
    assert CommandConfig().limits(RobotDescription.load("go2")) is None


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"forward": (0.5, 1.0)}, r"commands.forward is \[0.5, 1\] m/s; it must go from 0 or less"),
        ({"yaw_rate": (-1.0, -0.5)}, r"commands.yaw_rate is \[-1, -0.5\] rad/s"),
    ],
)
def test_a_range_must_include_zero(ranges: dict[str, tuple[float, float]], message: str) -> None:
    with pytest.raises(SurefootError, match=message):
        CommandConfig(**ranges).limits(RobotDescription.load("go2"))


def test_a_range_that_is_reversed_is_rejected() -> None:
    with pytest.raises(SurefootError, match=r"commands\.hold is \[3, 2\]; the lower bound must come first"):
        CommandConfig(hold=(3.0, 2.0))


def test_a_command_out_of_range_is_clamped_and_reported() -> None:
    command, changed = LIMITS.clamp([3.0, 0.1, -1.5])
    assert command.tolist() == [2.0, 0.1, -1.0]
    assert changed == "forward 3 to 2 m/s, yaw_rate -1.5 to -1 rad/s"
    assert LIMITS.clamp([2.0, 0.0, 0.0])[1] == ""


@pytest.mark.parametrize("bad", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0]])
def test_a_command_must_have_three_numbers(bad: list[float]) -> None:
    with pytest.raises(SurefootError, match="command"):
        LIMITS.clamp(bad)


def test_a_robot_draws_the_same_commands_in_any_batch() -> None:
    config = CommandConfig(forward=(-1, 1), yaw_rate=(-1, 1), hold=(1.0, 2.0))
    few, many = (CommandSampler(config, LIMITS, count, seed=3) for count in (2, 5))
    for sampler in (few, many):
        sampler.reset(np.arange(len(sampler.command)))
        for k in range(60):
            sampler.update(np.full(len(sampler.command), 0.1 * k))
    assert np.array_equal(few.command, many.command[:2])
    assert few.drawn.min() >= 3  # 6 s of commands that each hold for at most 2 s


def test_random_commands_fill_their_ranges_and_include_standing() -> None:
    config = CommandConfig(forward=(-1, 1), yaw_rate=(-1, 1), stand=0.2, straight=0.3)
    sampler = CommandSampler(config, LIMITS, 4000, seed=1)
    sampler.reset(np.arange(4000))
    stands = LIMITS.in_deadband(sampler.command)
    straight = ~stands & (sampler.command[:, 2] == 0)
    assert stands.mean() == pytest.approx(0.2, abs=0.02)
    assert straight.mean() == pytest.approx(0.3, abs=0.03)
    forward = sampler.command[~stands, 0]
    assert (forward.min(), forward.max()) == pytest.approx((-1.0, 2.0), abs=0.01)
    assert abs(np.mean(forward) - 0.5) < 0.05


def test_slow_random_commands_get_more_forward_or_backward_speed() -> None:
    limits = CommandLimits(
        forward=(-0.3, 2.0), sideways=(-0.5, 0.5), yaw_rate=(-1, 1), acceleration=(1, 1, 1), deadband=(0.01,) * 3
    )
    fast, any_speed = (
        CommandSampler(CommandConfig(forward=(-1, 1), stand=0.2, slowest=slowest), limits, 4000, seed=1)
        for slowest in (0.4, 0.0)
    )
    for sampler in (fast, any_speed):
        sampler.reset(np.arange(4000))
    speed, drawn = (np.linalg.norm(sampler.command[:, :2], axis=1) for sampler in (fast, any_speed))
    slow = any_speed.command.any(axis=1) & (drawn < 0.8)
    assert np.array_equal(fast.command[~slow], any_speed.command[~slow])
    assert np.array_equal(fast.command[:, 1:], any_speed.command[:, 1:])
    ahead = slow & (any_speed.command[:, 0] > 0)
    assert speed[ahead] == pytest.approx(0.8)  # 0.4 of 2 m/s
    assert fast.command[slow & ~ahead, 0] == pytest.approx(-0.3)


def test_a_ramp_scales_the_first_commands() -> None:
    config = CommandConfig(forward=(-1, 1), stand=0.0, ramp=10)
    sampler = CommandSampler(config, LIMITS, 500, seed=1)
    sampler.reset(np.arange(500))
    assert np.abs(sampler.command[:, 0]).max() <= 0.2  # a tenth of the maximum, 2 m/s


def test_a_schedule_holds_each_command_until_the_next() -> None:
    schedule = CommandSchedule([[(1.0, 0.5, 0.0, 0.0), (2.0, 5.0, 0.0, -1.0)]], LIMITS, 1)
    assert schedule.at([0.0, 0.99, 1.0, 1.5, 2.0, 90.0])[:, 0].tolist() == [0.0, 0.0, 0.5, 0.5, 2.0, 2.0]
    assert schedule.at(2.0).tolist() == [2.0, 0.0, -1.0]


def test_robots_follow_the_rows_of_each_in_turn() -> None:
    config = CommandConfig(forward=(-1, 2), yaw_rate=(-1, 1), each=((0.5, 0.0, 0.0), (0.0, 0.0, 0.3)))
    source = config.make_generator(LIMITS, 3, seed=0)
    source.reset(np.arange(3))
    assert source.command.tolist() == [[0.5, 0.0, 0.0], [0.0, 0.0, 0.3], [0.5, 0.0, 0.0]]
    source.update(np.full(3, 7.0))
    assert source.command[1].tolist() == [0.0, 0.0, 0.3]


def test_a_schedule_and_commands_for_each_robot_exclude_each_other() -> None:
    with pytest.raises(SurefootError, match=r"commands\.schedule and commands\.each are given"):
        CommandConfig(each=((0.5, 0.0, 0.0),), schedule=((0.0, 0.5, 0.0, 0.0),))


def test_a_command_file_is_read(tmp_path: Path) -> None:
    file = tmp_path / "commands.csv"
    file.write_text("time,forward,sideways,yaw_rate\n0,0.5,0,0\n\n2,0,0,1\n")
    assert read_schedule(file) == ((0.0, 0.5, 0.0, 0.0), (2.0, 0.0, 0.0, 1.0))
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())  # as Excel writes it
    assert len(read_schedule(file)) == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its first line is"),
        ("t,x\n0,1\n", "its first line is 't,x'; a command file is CSV"),
        ("time,forward,sideways,yaw_rate\n", "has no row"),
        ("time,forward,sideways,yaw_rate\n" + "0,1,0,0\n" * 130_000, "it has 1040031 bytes; at most 1000000 are read"),
        ("time," + "x" * 200_000, "field larger than field limit"),
        ("time,forward,sideways,yaw_rate\n0,fast,0,0\n", "could not convert"),
        ("time,forward,sideways,yaw_rate\n0,nan,0,0\n", r"schedule\[0\]\[1\] is nan; it must be a finite number"),
        (
            "time,forward,sideways,yaw_rate\n0,1,0\n",
            r"schedule\[0\] is \[0.0, 1.0, 0.0\]; it must be a list of 4 values",
        ),
        ("time,forward,sideways,yaw_rate\n1,1,0,0\n1,0,0,0\n", "row 2 is at 1 s; times start at 0 s or later"),
    ],
)
def test_a_file_without_commands_is_rejected(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "commands.csv"
    file.write_text(text)
    with pytest.raises(SurefootError, match=message):
        read_schedule(file)
