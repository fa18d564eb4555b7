"""Comparison of policies: common commands, and metrics with known values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.api.policies import load_policies
from surefoot.errors import SurefootError
from surefoot.evaluation.policy_table import (
    COLUMNS,
    common_commands,
    comparison_conditions,
    format_rows,
    measure,
    with_commands,
)
from surefoot.evaluation.rollout import run_episodes
from surefoot.robot.commands import CommandLimits
from surefoot.world.sim_world import SimWorld

LIMITS = CommandLimits((-1.0, 1.5), (-0.5, 0.4), (-1.0, 0.9), (3.0, 3.0, 6.0), (0.01, 0.01, 0.01))


def test_common_commands_are_within_the_limits_of_all_policies():
    other = replace(LIMITS, forward=(-0.5, 2.0), yaw_rate=(-2.0, 0.8))
    commands = common_commands([LIMITS, other], ["a", "b"])
    assert (commands.forward, commands.sideways, commands.yaw_rate) == ((-0.5, 1.5), (-0.5, 0.4), (-1.0, 0.8))
    with pytest.raises(SurefootError, match="policy 'b' follows no commands"):
        common_commands([LIMITS, None], ["a", "b"])


def test_the_error_of_a_standing_policy_is_the_command():
    (candidate,), robot = load_policies(["go2-steer"])
    commands = common_commands([candidate.policy.contract.commands], ["x"])
    task = with_commands(candidate.task, commands)
    # It is commanded to stand still, and does.
    still = replace(task, commands=replace(task.commands, stand=1.0))
    conditions = comparison_conditions(robot, {}, 2.0)
    traces = run_episodes(candidate.policy, conditions["nominal"].apply(still, robot), 2, SimWorld, threads=1)
    row = measure(traces, robot.weight)
    assert (row["falls"], row["episodes"]) == (0, 2)
    assert max(row[f"rmse_stride_{name}"] for name in ("forward", "sideways", "yaw_rate")) < 0.02
    assert np.isnan(row["cost_of_transport"])
    assert row["power"] == pytest.approx(sum(trace.energy.sum() for trace in traces) / 4.0, rel=0.01)
    assert 0 < row["hottest_heat"] < 50
    assert row["hottest_motor"] in robot.motor_names
    assert list(conditions) == ["nominal", "bullet", "table1", "pushes", "latency", "feet"]
    assert float(conditions["latency"].apply(task, robot).nominal(robot).control_latency[0]) == 0.02


def test_formatted_tables_have_one_row_per_policy():
    import pandas as pd

    row = dict.fromkeys(COLUMNS, 1.25) | {"falls": 3, "cost_of_transport": float("nan")}
    table = pd.DataFrame([{"policy": name, "condition": "nominal", "episodes": 32, **row} for name in ("a", "b")])
    first, second = format_rows(table, "nominal")
    assert (first["policy"], second["policy"]) == ("a", "b")
    assert first["falls"] == "3 of 32"
    assert first["error forward (m/s)"] == "1.250"
    assert first["cost of transport"] == "-"
    assert format_rows(table, "feet") == []
