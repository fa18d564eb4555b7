"""Write the visual meshes of the released robots: src/surefoot/robot/*/looks.npz.

All shapes are convex prisms or solids of revolution, defined for the left side and mirrored to the right. Positions are
in the links' frames, x forward, y left, z up, in m. Lengths follow the robots' URDFs. Run it after a change:
python tools/visuals.py
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from surefoot.robot import RobotDescription
from surefoot.robot.appearance import VISUALS_FILE, Appearance, VisualPart

SIDES = 20
"""Number of corners of a circle."""
AXES = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
"""Indices of an outline's two axes and its prism's axis, in right-handed order."""

Color = tuple[float, float, float]
Solid = tuple[np.ndarray, np.ndarray]
"""Points (P, 3) and triangles (F, 3)."""

BLACK, RUBBER, DARK, GRAPHITE = (0.09, 0.095, 0.10), (0.13, 0.13, 0.135), (0.17, 0.18, 0.20), (0.27, 0.285, 0.31)
SILVER, ALUMINIUM, WHITE = (0.62, 0.64, 0.67), (0.76, 0.78, 0.81), (0.88, 0.88, 0.86)
YELLOW, ORANGE, BLUE, GLASS = (0.97, 0.74, 0.09), (0.93, 0.43, 0.10), (0.16, 0.33, 0.56), (0.62, 0.88, 0.98)


def loft(rings: Sequence[np.ndarray]) -> Solid:
    """Return the solid through rings with the same number of points, closed by the first and last ring."""
    count, last = len(rings[0]), len(rings) - 1
    k = np.arange(count)
    after = (k + 1) % count
    faces = []
    for step in range(last):
        a, b = step * count, (step + 1) * count
        faces += [np.stack([a + k, a + after, b + after], 1), np.stack([a + k, b + after, b + k], 1)]
    fan = np.stack([np.zeros(count - 2, int), k[1:-1], k[2:]], 1)
    faces += [fan[:, ::-1], fan + last * count]
    return np.concatenate(rings), np.concatenate(faces)


def circle(x: float, y: float, radius: float, start: float = 0.0, end: float = 2 * np.pi, count: int = SIDES) -> list:
    """Return points on a circle, or on an arc between two angles."""
    angles = np.linspace(start, end, count, endpoint=end - start < 2 * np.pi - 1e-9)
    return [(x + radius * np.cos(a), y + radius * np.sin(a)) for a in angles]


def hull(points: Iterable[tuple[float, float]]) -> np.ndarray:
    """Return the convex hull (N, 2) of points, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted({(round(x, 6), round(y, 6)) for x, y in points})

    def turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    sides: list[list[tuple[float, float]]] = []
    for points_in_order in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for point in points_in_order:
            while len(chain) > 1 and turn(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        sides.append(chain[:-1])
    return np.array(sides[0] + sides[1])


def inset(outline: np.ndarray, by: float) -> np.ndarray:
    """Return a convex outline moved inwards."""
    along = np.roll(outline, -1, axis=0) - outline
    normal = np.stack([along[:, 1], -along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
    corner = normal + np.roll(normal, 1, axis=0)
    return outline - 2 * by * corner / np.sum(corner**2, axis=1, keepdims=True)


def prism(axis: str, outline: np.ndarray, low: float, high: float, bevel: float = 0.0) -> Solid:
    """Return a prism along an axis from low to high; the outline's coordinates are in the order of `AXES`."""
    u, v, w = AXES[axis]
    rings = []
    for place, cut in ((low, bevel), (low + bevel, 0.0), (high - bevel, 0.0), (high, bevel)):
        ring = np.empty((len(outline), 3))
        ring[:, [u, v]], ring[:, w] = inset(outline, cut) if cut else outline, place
        rings.append(ring)
    return loft(rings if bevel else rings[1:3])


def box(x: Sequence[float], y: Sequence[float], z: Sequence[float], round_: float = 0.0, axis: str = "x") -> Solid:
    """Return a box between two positions along each axis, with edges rounded about one axis and beveled at its ends."""
    spans = [sorted(span) for span in (x, y, z)]
    u, v, w = AXES[axis]
    radius = max(round_, 1e-5)
    corners = [
        point
        for a, shift in zip(spans[u], (radius, -radius), strict=True)
        for b, move in zip(spans[v], (radius, -radius), strict=True)
        for point in circle(a + shift, b + move, radius, count=12 if round_ else 4)
    ]
    return prism(axis, hull(corners), *spans[w], bevel=0.6 * round_)


def bar(a: Sequence[float], b: Sequence[float], y: Sequence[float], bevel: float = 0.002) -> Solid:
    """Return a flat bar along y between two round ends (x, z, radius)."""
    ends = [(z, x) for px, pz, radius in (a, b) for x, z in circle(px, pz, radius)]
    return prism("y", hull(ends), *sorted(y), bevel=bevel)


def plate(points: Sequence[tuple[float, float]], y: Sequence[float], radius: float, bevel: float) -> Solid:
    """Return a plate along y with rounded corners at points (x, z)."""
    return prism("y", hull([(z, x) for px, pz in points for x, z in circle(px, pz, radius)]), *sorted(y), bevel=bevel)


def turned(axis: str, profile: Sequence[tuple[float, float]], at: Sequence[float] = (0, 0, 0)) -> Solid:
    """Return a solid of revolution about an axis through a point; its profile has positions on the axis and radii."""
    u, v, w = AXES[axis]
    rings = []
    for place, radius in sorted(profile, key=lambda pair: pair[0]):
        ring = np.zeros((SIDES, 3))
        ring[:, [u, v]], ring[:, w] = circle(0, 0, radius), place
        rings.append(ring + at)
    return loft(rings)


def disc(y: Sequence[float], radius: float, x: float = 0.0, z: float = 0.0, bevel: float = 0.003, axis="y") -> Solid:
    """Return a flat cylinder with beveled rims, from low to high along its axis."""
    low, high = sorted(y)
    profile = [(low, radius - bevel), (low + bevel, radius), (high - bevel, radius), (high, radius - bevel)]
    return turned(axis, profile, (x, 0, z) if axis == "y" else (0, x, z))


def ball(radius: float, at: Sequence[float] = (0, 0, 0)) -> Solid:
    """Return a sphere."""
    tilts = np.linspace(-0.47, 0.47, 11) * np.pi
    return turned("z", [(radius * np.sin(t), radius * np.cos(t)) for t in tilts], at)


def rod(a: Sequence[float], b: Sequence[float], radius: float) -> Solid:
    """Return a cylinder between two points."""
    a, b = np.array(a, float), np.array(b, float)
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 else [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    ring = np.array([x * side + y * np.cross(along, side) for x, y in circle(0, 0, radius, count=14)])
    return loft([a + ring, b + ring])


def mirrored(solid: Solid, axis: int) -> Solid:
    """Return a solid mirrored along an axis."""
    points = solid[0].copy()
    points[:, axis] *= -1
    return points, solid[1][:, ::-1]


class Drawing:
    """Solids of a robot, by link and color."""

    def __init__(self) -> None:
        self.solids: dict[tuple[str, Color], list[Solid]] = {}

    def add(self, link: str, color: Color, *solids: Solid) -> None:
        """Add solids of a color to a link."""
        self.solids.setdefault((link, color), []).extend(solids)

    def add_legs(self, draw: Callable[[Callable[..., None], bool], None]) -> None:
        """Add four legs with a function that draws a left leg.

        Args:
            draw: called with a function that adds solids to a link of the leg, and whether it is a front leg.
        """
        for end in ("front", "back"):
            for side in ("left", "right"):

                def add(link: str, color: Color, *solids: Solid, end: str = end, side: str = side) -> None:
                    solids = solids if side == "left" else tuple(mirrored(solid, 1) for solid in solids)
                    self.add(f"{end}_{side}_{link}", color, *solids)

                draw(add, end == "front")


def both(*solids: Solid) -> list[Solid]:
    """Return solids of the left side and their mirror images."""
    return [*solids, *(mirrored(solid, 1) for solid in solids)]


def go2(drawing: Drawing) -> None:
    """Draw Go2: a dark trunk with a head, round hips, broad thighs, thin shanks, rubber feet."""
    base = [
        (GRAPHITE, [box((-0.135, 0.14), (-0.094, 0.094), (-0.052, 0.058), 0.022)]),
        (GRAPHITE, [box((-0.245, 0.21), (-0.052, 0.052), (-0.048, 0.056), 0.016)]),
        (DARK, [box((-0.20, 0.16), (-0.062, 0.062), (0.05, 0.068), 0.007)]),
        (SILVER, both(box((-0.10, 0.105), (0.0915, 0.0965), (-0.014, 0.022), 0.0016))),
        (SILVER, both(rod((-0.17, 0.045, 0.078), (0.135, 0.045, 0.078), 0.0055))),
        (DARK, both(*(rod((x, 0.045, 0.066), (x, 0.045, 0.08), 0.0055) for x in (-0.17, 0.135)))),
    ]
    face = [(0.20, -0.036), (0.292, -0.032), (0.322, 0.0), (0.312, 0.036), (0.262, 0.056), (0.20, 0.05)]
    base += [
        (GRAPHITE, [plate(face, (-0.056, 0.056), 0.012, 0.014)]),
        (BLACK, [box((0.318, 0.336), (-0.036, 0.036), (-0.008, 0.026), 0.006)]),
        (GLASS, [box((0.332, 0.3385), (-0.03, 0.03), (0.014, 0.02), 0.0015)]),
        (SILVER, [disc((0.33, 0.339), 0.009, z=0.002, axis="x")]),
        (DARK, [turned("z", [(-0.085, 0.016), (-0.08, 0.03), (-0.055, 0.036), (-0.04, 0.03)], (0.275, 0, 0))]),
        (BLACK, [box((-0.262, -0.238), (-0.038, 0.038), (-0.03, 0.036), 0.006)]),
    ]
    for color, solids in base:
        drawing.add("base", color, *solids)

    def leg(add: Callable[..., None], front: bool) -> None:
        along = (-0.052, 0.048) if front else (-0.048, 0.052)
        add("hip", DARK, disc(along, 0.043, axis="x", bevel=0.006))
        add("hip", GRAPHITE, box((-0.034, 0.034), (0.0, 0.062), (-0.034, 0.034), 0.01, "y"))
        add("upper", DARK, disc((-0.04, 0.026), 0.046, bevel=0.006))
        add("upper", SILVER, disc((0.02, 0.03), 0.03, bevel=0.004))
        add("upper", GRAPHITE, bar((0.0, -0.015, 0.038), (0.0, -0.213, 0.02), (-0.017, 0.017), 0.006))
        add("upper", DARK, disc((-0.021, 0.021), 0.019, z=-0.213))
        add("lower", DARK, bar((0.0, 0.0, 0.0155), (0.006, -0.105, 0.0125), (-0.011, 0.011), 0.004))
        add("lower", DARK, bar((0.006, -0.105, 0.0125), (0.0, -0.205, 0.009), (-0.010, 0.010), 0.004))
        add("foot", RUBBER, ball(0.022))

    drawing.add_legs(leg)


def minitaur(drawing: Drawing) -> None:
    """Draw Minitaur: an aluminium frame, disc motors on both sides of each rail's ends, legs of bars and rods."""
    base = [
        (DARK, [box((-0.15, 0.15), (-0.06, 0.06), (-0.0435, 0.036), 0.006)]),
        (ALUMINIUM, both(box((-0.155, 0.155), (0.06, 0.065), (-0.0435, 0.0435), 0.0012))),
        (ALUMINIUM, [box((-0.15, 0.15), (-0.062, 0.062), (0.036, 0.041), 0.0015)]),
        (ALUMINIUM, [box((x - 0.01, x + 0.01), (-0.118, 0.118), (-0.0285, -0.0085), 0.001) for x in (-0.135, 0.135)]),
        (BLUE, [box((0.064, 0.136), (-0.036, 0.036), (0.041, 0.118), 0.009, "z")]),
        (BLACK, [box((0.132, 0.14), (-0.026, 0.026), (0.07, 0.1), 0.003)]),
        (GLASS, [disc((0.138, 0.143), 0.009, x=y, z=0.085, bevel=0.002, axis="x") for y in (-0.014, 0.014)]),
        (BLACK, [box((-0.13, 0.04), (-0.035, 0.035), (0.041, 0.064), 0.004)]),
        (ORANGE, [box((-0.1, -0.085), (-0.0355, 0.0355), (0.041, 0.0645), 0.0)]),
    ]
    for color, solids in base:
        drawing.add("base", color, *solids)
    for side in ("left", "right"):
        drawing.add(f"{side}_rail", SILVER, box((-0.2375, 0.2375), (-0.01, 0.01), (-0.01, 0.01), 0.002))
        for x, y in ((x, y) for x in (-1, 1) for y in (-1, 1)):
            arm = (x * 0.172, x * 0.2475), sorted((y * 0.062, y * 0.067)), (-0.016, 0.016)
            across = (x * 0.172, x * 0.18), sorted((y * 0.008, y * 0.067)), (-0.016, 0.016)
            drawing.add(f"{side}_rail", ALUMINIUM, box(*arm, 0.001), box(*across, 0.001))
            drawing.add(f"{side}_rail", BLACK, disc((y * 0.0385, y * 0.0615), 0.03, x=x * 0.2375))
    bell = [(-0.0105, 0.030), (-0.0085, 0.0405), (-0.005, 0.0425), (0.005, 0.0425), (0.0085, 0.0405), (0.0105, 0.030)]

    def leg(add: Callable[..., None], front: bool) -> None:
        # Motor 1 is the inner motor; its links are outside of it, and motor 2's links are inside.
        for number, out in (("1", 1), ("2", -1)):
            add(f"{number}_rotor", BLACK, turned("y", bell))
            add(
                f"{number}_rotor",
                SILVER,
                turned("y", [(-0.0035, 0.0427), (-0.003, 0.0432), (0.003, 0.0432), (0.0035, 0.0427)]),
            )
            add(f"{number}_rotor", ORANGE, disc((out * 0.009, out * 0.0112), 0.016, bevel=0.001))
            add(f"{number}_upper", ALUMINIUM, bar((0, 0, 0.0195), (0, 0.101, 0.0105), (-0.004, 0.004), 0.001))
            add(f"{number}_upper", DARK, disc((out * -0.004, out * 0.0095), 0.007, z=0.101, bevel=0.001))
            length = 0.2 if number == "1" else 0.224
            add(f"{number}_lower", SILVER, rod((0, 0, 0), (0, 0, length), 0.0055))
            add(f"{number}_lower", DARK, disc((-0.0055, 0.0055), 0.0105, bevel=0.001))
        add("1_lower", DARK, disc((-0.0055, 0.0055), 0.009, z=0.2, bevel=0.001))
        add("2_lower", ORANGE, rod((0, 0, 0.212), (0, 0, 0.2315), 0.0085), ball(0.0085, (0, 0, 0.2315)))

    drawing.add_legs(leg)


def solo8(drawing: Drawing) -> None:
    """Draw Solo 8: a flat body and legs of light printed parts with dark motors."""
    base = [
        (WHITE, [box((-0.155, 0.155), (-0.052, 0.052), (-0.022, 0.022), 0.008)]),
        (DARK, [box((-0.11, 0.10), (-0.042, 0.042), (0.018, 0.0265), 0.003)]),
        (BLUE, [box((0.11, 0.145), (-0.042, 0.042), (0.0205, 0.0265), 0.002)]),
        (SILVER, both(*(rod((x, 0.028, 0.024), (x, 0.028, 0.031), 0.006) for x in (-0.08, 0.07)))),
        (WHITE, [box((s * 0.155, s * 0.212), (-0.03, 0.03), (-0.018, 0.018), 0.006) for s in (-1, 1)]),
        (BLUE, [box((0.209, 0.2145), (-0.024, 0.024), (-0.012, 0.012), 0.002)]),
    ]
    for x in (-0.19, 0.19):
        base += [
            (WHITE, both(box((x - 0.034, x + 0.034), (0.026, 0.088), (-0.0255, 0.0265), 0.009, "y"))),
            (DARK, both(disc((0.086, 0.1), 0.0245, x=x))),
        ]
    for color, solids in base:
        drawing.add("base", color, *solids)

    def leg(add: Callable[..., None], front: bool) -> None:
        add("upper", WHITE, bar((0, 0, 0.0265), (0, -0.16, 0.0185), (0.002, 0.027), 0.004))
        add("upper", DARK, disc((0.02, 0.031), 0.0175), disc((-0.005, 0.004), 0.02))
        add("upper", SILVER, disc((0.026, 0.033), 0.006, bevel=0.001))
        add("upper", SILVER, bar((0, -0.045, 0.006), (0, -0.125, 0.005), (0.024, 0.029), 0.001))
        add("upper", DARK, disc((0.0, 0.03), 0.012, z=-0.16))
        add("lower", WHITE, bar((0, 0, 0.0155), (0, -0.06, 0.0095), (0.0, 0.016), 0.003))
        add("lower", WHITE, bar((0, -0.06, 0.0095), (0, -0.155, 0.0055), (0.002, 0.014), 0.003))
        add("lower", DARK, disc((-0.006, 0.018), 0.008, bevel=0.001))
        add("foot", RUBBER, ball(0.009), disc((-0.007, 0.007), 0.0092, bevel=0.002))

    drawing.add_legs(leg)


def pupper_v2(drawing: Drawing) -> None:
    """Draw Pupper: a black body with yellow ends, yellow thighs, small black motors."""
    base = [
        (BLACK, [box((-0.062, 0.158), (-0.046, 0.046), (-0.046, 0.03), 0.006)]),
        (YELLOW, both(box((-0.028, 0.124), (0.0455, 0.0515), (-0.049, 0.031), 0.0018))),
        (BLACK, both(*(disc((0.048, 0.0535), 0.011, x=x, z=-0.009, bevel=0.001) for x in (0.0, 0.048, 0.096)))),
        (YELLOW, [plate([(0.15, -0.044), (0.164, -0.04), (0.17, -0.004), (0.15, 0.028)], (-0.05, 0.05), 0.005, 0.006)]),
        (
            YELLOW,
            [plate([(-0.054, -0.044), (-0.072, -0.036), (-0.07, 0.02), (-0.054, 0.028)], (-0.05, 0.05), 0.005, 0.006)],
        ),
        (BLACK, [box((0.168, 0.178), (-0.03, 0.03), (-0.026, -0.006), 0.003)]),
        (GLASS, [disc((0.175, 0.1805), 0.006, x=y, z=-0.016, bevel=0.001, axis="x") for y in (-0.017, 0.017)]),
        (YELLOW, [box((-0.05, 0.146), (-0.04, 0.04), (0.028, 0.0345), 0.002)]),
        (BLACK, [box((0.0, 0.11), (-0.026, 0.026), (0.033, 0.0385), 0.002)]),
    ]
    for color, solids in base:
        drawing.add("base", color, *solids)

    def leg(add: Callable[..., None], front: bool) -> None:
        add("hip", BLACK, disc((-0.058, 0.006), 0.0165, axis="x"))
        add("hip", YELLOW, box((-0.045, -0.008), (0.004, 0.025), (-0.0165, 0.0165), 0.004, "y"))
        add("upper", BLACK, disc((-0.016, 0.012), 0.0185))
        add("upper", SILVER, disc((0.01, 0.0145), 0.011, bevel=0.001))
        add("upper", YELLOW, bar((0, 0, 0.0165), (0, -0.08, 0.0105), (-0.012, 0.004), 0.003))
        add("upper", BLACK, disc((-0.014, 0.006), 0.0075, z=-0.08, bevel=0.001))
        add("lower", BLACK, bar((0, 0, 0.0085), (0, -0.106, 0.0045), (-0.006, 0.002), 0.0015))
        add("foot", RUBBER, ball(0.0095))

    drawing.add_legs(leg)


def appearance(draw: Callable[[Drawing], None]) -> Appearance:
    """Return the visual meshes that a function draws, with one part per link and color."""
    drawing = Drawing()
    draw(drawing)
    parts = []
    for (link, color), solids in drawing.solids.items():
        points, faces = zip(*solids, strict=True)
        starts = np.cumsum([0, *map(len, points[:-1])])
        shifted = np.concatenate([part + start for part, start in zip(faces, starts, strict=True)])
        parts.append(VisualPart(link, np.concatenate(points).astype(np.float32), shifted.astype(np.int32), color))
    return Appearance(tuple(parts))


ROBOTS = {draw.__name__: draw for draw in (go2, minitaur, pupper_v2, solo8)}

if __name__ == "__main__":
    for name, draw in ROBOTS.items():
        path: Path = RobotDescription.load(name).folder / VISUALS_FILE
        visuals = appearance(draw)
        visuals.save(path)
        print(f"{name}: {sum(len(part.faces) for part in visuals.parts)} triangles, {path.stat().st_size / 1e3:.0f} kB")
