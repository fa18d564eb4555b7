"""Report of a synthetic identification with known values."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from surefoot import __version__
from surefoot.identify.result import Check, Identification, ParameterEstimate, Series
from surefoot.report.figures.identification import full_name, index_names, number, prior_value
from surefoot.report.pages.identification import identification_figure, page, write_report
from surefoot.robot import PhysicalParams, RobotDescription

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def prior(robot: RobotDescription) -> PhysicalParams:
    return PhysicalParams.nominal(robot)


def identification(motors: bool = True) -> Identification:
    """Return the result of a motor experiment or, without `motors`, of an experiment on the ground."""
    rng = np.random.default_rng(2)
    estimates = [
        ParameterEstimate("torque_constant", 0.0921, 0.0004, "N m/A"),
        ParameterEstimate("resistance", 0.2031, 0.003, "Ohm"),
        ParameterEstimate("servo_kp", 0.982, 0.006, "1/rad"),
        ParameterEstimate("servo_kd", 0.0153, 0.0001, "s/rad"),
        ParameterEstimate("servo_latency", 0.00312, 3e-5, "s"),
        ParameterEstimate("control_latency", 0.0181, 3e-5, "s"),
        ParameterEstimate("leg_mass_ratio", 1.04, 0.02, "1"),
        ParameterEstimate("leg_inertia_ratio", 1.0, 0.3, "1", identifiable=False),
        ParameterEstimate("imu_bias", 0.0121, 0.002, "rad", 0),
        ParameterEstimate("imu_bias", -0.0043, 0.002, "rad", 1),
        ParameterEstimate("voltage", 15.71, 0.02, "V", low=0.0),
    ]
    if motors:
        for name, middle, spread, unit in (("motor_strength", 0.93, 0.04, "1"), ("motor_friction", 0.02, 0.006, "N m")):
            for motor, value in enumerate(rng.normal(middle, spread, 8)):
                estimates.append(ParameterEstimate(name, value, spread / 8, unit, motor, motor != 5, low=0.0))
    time = np.linspace(0.0, 3.0, 1500)
    angle = 1.7 + 0.3 * np.sin(2 * np.pi * (0.5 + time) * time)
    current = np.arange(1.0, 40.0, 2.0)
    torque = 3.5 * np.tanh(current / 25)
    series = (
        Series("front_left_1_motor, not fitted", "time [s]", "angle [rad]", time, angle + 0.004 * rng.normal(size=1500),
               np.roll(angle, 8), angle),
        Series("front_left_1_motor, not fitted", "time [s]", "torque [N m]", time, np.gradient(angle, time) / 3,
               np.roll(np.gradient(angle, time) / 2.6, 8), np.gradient(angle, time) / 3.01),
        Series("torque of a motor of nominal strength", "current [A]", "torque [N m]", current,
               torque + 0.05 * rng.normal(size=len(current)), np.full(len(current), np.nan), torque, points=True),
    )  # fmt: skip
    return Identification(
        "motor",
        "minitaur",
        tuple(estimates),
        (Check("motor angles", 21.3, 2.1, "mrad"), Check("motor torques", 0.31, 0.043, "N m")),
        (("resistance", "torque_constant", -0.93), ("motor_strength[2]", "motor_friction[2]", 0.84)),
        ("back_right_2_motor never moves & is <unused>",),
        series if motors else (),
        {"torque_gain": [0.0] * 8},
        "ab" * 32,
        "2026-11-21T20:00:00+00:00",
    )


class Page(HTMLParser):
    """Parser that collects the texts of table cells, and all resources that a page would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.rows: list[list[str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [str(value) for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and "tr" in self.open:
            self.rows[-1][-1] += data


def test_report_writes_figure_and_page(robot: RobotDescription, prior: PhysicalParams, tmp_path: Path):
    picture, html = write_report(identification(), robot, prior, tmp_path / "a" / "b", "runs/recording.npz")
    assert (picture.name, html.name) == ("report.png", "report.html")
    assert picture.read_bytes().startswith(PNG)
    text = html.read_text(encoding="utf-8")
    parsed = Page(text)
    assert parsed.open == []
    # The page contains its figure and loads nothing.
    (source,) = parsed.loads
    assert base64.b64decode(source.removeprefix("data:image/png;base64,")) == picture.read_bytes()
    assert not re.search(r"https?:|url\(|<script|<link", text)


def test_page_contains_all_values(robot: RobotDescription, prior: PhysicalParams):
    text = page(identification(), robot, prior, PNG, "runs/recording.npz")
    rows: dict[str, list[str]] = {}
    for row in Page(text).rows:
        rows.setdefault(row[0], row[1:])
    assert rows["resistance"] == ["0.1860", "0.2031", "0.1972 to 0.2090", "Ohm"]
    assert rows["leg_inertia_ratio"] == ["1", "not identifiable", "", ""]
    assert rows["imu_bias pitch"] == ["0.0000", "-0.0043", "-0.0082 to -0.0004", "rad"]
    motors = [rows[f"motor_strength {name.removesuffix('_motor')}"] for name in robot.motor_names]
    assert [row[1] == "not identifiable" for row in motors] == [motor == 5 for motor in range(8)]
    assert rows["motor angles"] == ["21.3", "2.1", "mrad"]
    assert rows["data"] == ["runs/recording.npz"]
    assert rows["SHA-256"] == ["ab" * 32]
    assert rows["surefoot"] == [__version__]
    assert "back_right_2_motor never moves &amp; is &lt;unused&gt;" in text
    assert "24 of 27 parameters are identifiable from the data." in text


def test_page_has_no_empty_sections(robot: RobotDescription, prior: PhysicalParams, tmp_path: Path):
    bare = Identification("latency", "minitaur", (ParameterEstimate("servo_latency", 0.003, 1e-4, "s"),))
    text = page(bare, robot, prior, PNG)
    assert re.findall("<h2>(.*?)</h2>", text) == ["Estimates", "Figures", "Data"]
    for number_, parsed in enumerate((bare, identification(motors=False), Identification("mass", "minitaur", ()))):
        path = identification_figure(parsed, robot, prior, tmp_path / f"{number_}.png")
        assert path.read_bytes().startswith(PNG)


def test_components_have_names(robot: RobotDescription):
    assert full_name("voltage", robot) == "voltage"
    assert full_name("motor_strength[0]", robot) == f"motor_strength {robot.motor_names[0].removesuffix('_motor')}"
    assert full_name("torque_gain[7]", robot) == f"torque_gain {robot.motor_names[7].removesuffix('_motor')}"
    assert full_name("imu_bias[1]", robot) == "imu_bias pitch"
    assert full_name("base_offset[2]", robot) == "base_offset z"
    assert full_name("base_offset[7]", robot) == "base_offset[7]"
    assert index_names("voltage", robot) == ()


def test_prior_value_of_parameters(robot: RobotDescription, prior: PhysicalParams):
    prior_params = prior.with_values(robot, motor_strength=np.linspace(0.9, 1.04, 8))
    assert prior_value(ParameterEstimate("motor_strength", 1.0, 0.1, "1", 2), prior_params) == pytest.approx(0.94)
    assert prior_value(ParameterEstimate("motor_strength", 1.0, 0.1, "1"), prior_params) == pytest.approx(0.97)
    assert prior_value(ParameterEstimate("voltage", 1.0, 0.1, "V"), prior_params) == robot.dc_motor.voltage
    assert prior_value(ParameterEstimate("torque_gain", 1.0, 0.1, "1", 2), prior_params) is None


@pytest.mark.parametrize(
    ("value", "width", "message"),
    [
        (0.94321, 0.02, "0.943"),
        (15.4, 4.0, "15.4"),
        (1234.5, 300.0, "1234"),
        (0.0021234, 4e-5, "0.002123"),
        (0.0, 1e-9, "0"),
        (1 / 3, float("nan"), "0.3333"),
        (1 / 3, 0.0, "0.3333"),
        (float("nan"), 1.0, "nan"),
        (1.2345e-8, 1e-9, "1.23e-08"),
    ],
)
def test_numbers_are_rounded_according_to_their_interval(value: float, width: float, message: str):
    assert number(value, width) == message
