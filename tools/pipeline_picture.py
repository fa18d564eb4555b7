"""Draw docs/pipeline.png, the steps from a robot file to a running robot: python tools/pipeline_picture.py."""

from __future__ import annotations

from pathlib import Path

from matplotlib.patches import FancyBboxPatch

from surefoot.report.figures.style import BLUE, GREEN, INK, ORANGE, QUIET, new_figure

PATH = Path(__file__).resolve().parents[1] / "docs" / "pipeline.png"
WIDTH, HEIGHT = 1.5, 0.62
BOXES = {
    "file": (0.0, 2.0, "robot file\nURDF or MJCF", QUIET),
    "sheet": (2.7, 2.0, "data sheet\nrobot.toml", QUIET),
    "other": (2.7, 0.6, "third-party\npolicy", QUIET),
    "policy": (5.4, 1.4, "policy file\nnetwork + contract", BLUE),
    "worlds": (8.5, 2.8, "Bullet, randomized\nrobots, terrain", ORANGE),
    "emulated": (8.5, 1.4, "emulated robot", ORANGE),
    "robot": (8.5, 0.0, "your robot", GREEN),
    "params": (5.4, 0.0, "identified\nparameters", QUIET),
}
"""Center, text and color of each box."""
ARROWS = (
    ("file", "sheet", "robot new"),
    ("sheet", "policy", "train"),
    ("other", "policy", "adopt"),
    ("policy", "worlds", "evaluate, gap"),
    ("policy", "emulated", "deploy"),
    ("policy", "robot", "doctor, deploy"),
    ("robot", "params", "identify"),
    ("params", "policy", "train --params"),
)
"""Start and end box of each arrow, and its command."""


def edge(box: str, toward: str) -> tuple[float, float]:
    """Return the point on the border of a box at which an arrow to another box begins."""
    x, y = BOXES[box][:2]
    dx, dy = BOXES[toward][0] - x, BOXES[toward][1] - y
    if dx == 0:
        return x, y + (0.5 * HEIGHT if dy > 0 else -0.5 * HEIGHT)
    return x + (0.5 * WIDTH if dx > 0 else -0.5 * WIDTH), y


def main() -> None:
    """Draw boxes and arrows."""
    with new_figure(PATH, (8.6, 3.3)) as (_, (axes,)):
        for x, y, text, color in BOXES.values():
            corner = (x - 0.5 * WIDTH, y - 0.5 * HEIGHT)
            style = {"boxstyle": "round,pad=0.02,rounding_size=0.08", "facecolor": "white", "edgecolor": color}
            axes.add_patch(FancyBboxPatch(corner, WIDTH, HEIGHT, linewidth=1.6, **style))
            axes.text(x, y, text, ha="center", va="center", fontsize=8.5, color=INK)
        for begin, end, command in ARROWS:
            (x, y), (x_end, y_end) = edge(begin, end), edge(end, begin)
            line = {"arrowstyle": "-|>", "color": QUIET, "linewidth": 1.2}
            axes.annotate("", (x_end, y_end), (x, y), arrowprops=line)
            middle = 0.5 * (x + x_end), 0.5 * (y + y_end)
            behind = {"facecolor": "white", "edgecolor": "none", "pad": 1}
            axes.text(*middle, command, ha="center", va="center", fontsize=8, family="DejaVu Sans Mono", bbox=behind)
        axes.set(xlim=(-0.85, 9.35), ylim=(-0.35, 3.15), xticks=[], yticks=[])
        axes.grid(False)
        axes.spines[:].set_visible(False)


if __name__ == "__main__":
    main()
