"""Metrics of evaluations as text, and notes on standing robots."""

from __future__ import annotations

from surefoot.api.episodes import standing_note, summary_rows
from surefoot.evaluation.footfalls import FEET, STANDING_REASON

SUMMARY = {
    "episodes": 2,
    "falls": 0,
    "steps_mean": 300.0,
    **dict.fromkeys(("speed_mean", "power_mean", "return_mean", "distance_mean", "drift_mean"), 0.001),
    **dict.fromkeys(("speed_std", "return_std"), 0.0),
    "cost_of_transport_mean": None,
    "gait": "other",
    "gait_reason": STANDING_REASON,
    "duty_factor": dict.fromkeys(FEET, 1.0),
    "phases": dict.fromkeys(FEET),
    "saturation": {"hip": 0.02, "knee": 0.31},
    "hottest_motor": "knee",
    "hottest_heat": 6.84,
}
FOLLOWING = {
    name: {"forward": value, "sideways": 0.02, "yaw_rate": 0.1} for name, value in (("rmse", 0.2), ("rmse_stride", 0.1))
}
COSTS = {"progress": 1.0, "transport_cost": -3.0}


def texts(summary: dict) -> dict[str, str]:
    return {row[""]: row["mine"] for row in summary_rows({"mine": summary})}


def test_a_note_explains_why_the_reward_makes_a_robot_stand() -> None:
    assert texts(SUMMARY)["gait"] == "stands: no foot leaves the ground"
    note = standing_note(SUMMARY, COSTS)
    assert note is not None
    assert "learned to stand: moving costs more reward than it earns (progress 1, transport_cost -3)" in note
    assert note.endswith("see docs/troubleshooting.md")
    assert standing_note(SUMMARY | {"gait_reason": "no stride repeats"}, COSTS) is None
    # A robot that was commanded to stand needs no explanation.
    still = FOLLOWING | {"rmse": {"forward": 0.01, "sideways": 0.01, "yaw_rate": 0.0}}
    assert standing_note(SUMMARY | still, COSTS) is None
    assert standing_note(SUMMARY | FOLLOWING, COSTS) is not None


def test_a_gait_without_a_name_is_described_by_its_reason() -> None:
    reason = "the fore feet alternate and the hind feet do not"
    assert texts(SUMMARY | {"gait_reason": reason})["gait"] == f"other: {reason}"
    assert texts(SUMMARY | {"gait": "trot", "gait_reason": ""})["gait"] == "trot"


def test_tracking_errors_come_first_and_heat_and_saturation_are_listed() -> None:
    rows = texts(SUMMARY | FOLLOWING | {"success": 0.5})
    assert list(rows)[:4] == [
        "falls",
        "RMSE: forward, sideways, yaw rate",
        "stride-averaged RMSE: forward, sideways, yaw rate",
        "success",
    ]
    assert rows["heat of the hottest motor"] == "6.8 W, knee"
    assert rows["saturation of the worst motor"] == "31% of the time"
