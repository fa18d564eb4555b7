"""Tables of `benchmarks/raibert.py`, from rows with known results."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("onnxruntime")
pytest.importorskip("matplotlib")

from raibert import DEFINITIONS, comparison, gait_rows


def gait(name: str, family: str, speed: float, power: float, fell: float = 0.0) -> dict[str, Any]:
    """Return an episode of a gait whose power is the same by all definitions."""
    row = {"gait": name, "family": family, "stance_duration": 0.2, "standing_height": 0.2, "episode": 0.0}
    return {**row, "fell": fell, "speed": speed, "turned": 0.0, **dict.fromkeys(DEFINITIONS, power)}


RUNS = [
    *(gait(f"seed_{k}", "learned", speed, 40.0) for k, speed in enumerate((0.5, 0.5, 0.6))),
    gait("slow", "raibert", 0.4, 40.0),
    gait("fast", "raibert", 0.6, 60.0),
    gait("fast", "raibert", float("nan"), float("nan"), fell=1.0),
    gait("steady", "raibert", 0.6, 80.0),
    gait("tuned", "tuned", 0.5, 10.0),
]


def test_episodes_with_a_fall_are_counted_and_left_out_of_the_means():
    rows = {row["gait"]: row for row in gait_rows(RUNS)}
    assert (rows["fast"]["episodes"], rows["fast"]["falls"], rows["fast"]["duty"]) == (2, 1, 60.0)
    assert (rows["slow"]["episodes"], rows["slow"]["falls"], rows["slow"]["speed"]) == (1, 0, 0.4)


def test_learned_gaits_are_compared_with_the_grid_at_their_own_speeds():
    table = comparison(gait_rows(RUNS))
    assert [row["definition"] for row in table] == list(DEFINITIONS)
    # Without the gait that falls: 60 W at 0.5 m/s, between 40 W at 0.4 and 80 W at 0.6 m/s; the tuned gait is left out.
    assert table[0]["best"] == pytest.approx((60 + 60 + 80) / 3)
    assert table[0]["less_power"] == pytest.approx(100 * (1 / 3 + 1 / 3 + 1 / 2) / 3)
    assert table[0]["less_power_of_each"] == "33, 33, 50"
    assert (table[0]["trots_in_range"], table[0]["settings_in_range"]) == (1, 1)
    assert table[0]["less_in_range"] == pytest.approx(50.0)
