"""Videos are valid MP4 files that show a moving robot; nearer objects hide farther ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from surefoot.errors import SurefootError

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
pytest.importorskip("PIL.Image")
from PIL import Image  # noqa: E402

pytest.importorskip("numba")
from surefoot.report.drawing.mesh import Mesh  # noqa: E402
from surefoot.report.drawing.renderer import Camera, View, draw  # noqa: E402
from surefoot.report.drawing.video import _smooth_track, interpolate_poses, render_video  # noqa: E402
from surefoot.robot.appearance import Appearance, triangulate_shape  # noqa: E402
from surefoot.robot.urdf import Shape  # noqa: E402

RED, GREEN, BLUE = (230, 30, 30), (30, 200, 30), (30, 30, 230)
SIZE = (320, 180)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    """Return a pure translation."""
    transform = np.eye(4)
    transform[:3, 3] = x, y, z
    return transform


def looks(shapes: Sequence[Shape]) -> Appearance:
    return Appearance(tuple(map(triangulate_shape, shapes)))


def render_frame(
    shapes: Sequence[Shape],
    poses: dict[str, NDArray[np.float64]],
    size: tuple[int, int] = SIZE,
    camera: Camera | None = None,
) -> Image.Image:
    """Draw an image from the camera, which looks at the first body."""
    camera, stack = camera or Camera(), np.stack(list(poses.values()))
    return draw(Mesh(looks(shapes), list(poses)), stack, View(camera, stack[0, :2, 3], size))


def colored(picture: object, color: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Return the mask (H, W) of pixels with a pure colour, whose channel is far above the others."""
    pixels = np.asarray(picture, dtype=float)
    channel = int(np.argmax(color))
    others = np.delete(pixels, channel, axis=-1).max(axis=-1)
    return pixels[..., channel] > 1.8 * others


SHAPES = [
    Shape("base", "box", (0.15, 0.065, 0.0435), pose(), RED),
    Shape("leg", "cylinder", (0.02, 0.08), pose(), GREEN),
    Shape("leg", "sphere", (0.03,), pose(z=-0.08), GREEN),
]


@pytest.fixture
def walker() -> dict[str, Any]:
    """Return a video of one second: a red base moves forward, and a green leg swings."""
    times = np.linspace(0.0, 1.0, 51)
    base = np.stack([pose(x=1.2 * t, z=0.2) for t in times])
    leg = np.stack([pose(x=1.2 * t + 0.25 * np.sin(6 * t), y=-0.1, z=0.12) for t in times])
    film = {"appearance": looks(SHAPES), "poses": {"base": base, "leg": leg}, "times": times, "follow": "base"}
    return film | {"overlay": [""] * len(times), "size": SIZE}


def decode(path: Path) -> tuple[dict, NDArray[np.uint8]]:
    """Return ffmpeg's description of a file, and its frames (N, H, W, 3)."""
    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    return about, np.stack([np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader])


def test_the_camera_follows_a_local_line_through_the_track() -> None:
    # Local linear regression repeats a line, also at its ends, and needs no memory for far samples.
    times = np.arange(0.0, 600.0, 0.02)
    line = np.stack([0.5 * times, 3.0 - 0.1 * times], axis=-1)
    clock, smooth = _smooth_track(times, line, 0.4)
    np.testing.assert_allclose(smooth, np.stack([0.5 * clock, 3.0 - 0.1 * clock], axis=-1), atol=1e-6)
    # A step is a smooth transition around its middle.
    short = times[:500]
    clock, smooth = _smooth_track(short, np.where(short < 5.0, 0.0, 1.0)[:, None], 0.4)
    assert np.interp([4.0, 5.0, 6.0], clock, smooth[:, 0]) == pytest.approx([0.006, 0.5, 0.994], abs=0.02)
    weight = np.exp(-0.5 * ((clock[None] - clock[:, None]) / 0.4) ** 2)
    lag, rough = clock[None] - clock[:, None], np.interp(clock, short, np.where(short < 5.0, 0.0, 1.0))
    m0, m1, m2 = ((weight * lag**k).sum(axis=1) for k in range(3))
    whole = (m2 * (weight @ rough) - m1 * ((weight * lag) @ rough)) / (m0 * m2 - m1**2)
    np.testing.assert_allclose(smooth[:, 0], whole, atol=1e-6)


def test_a_video_decodes_and_follows_the_base(walker, tmp_path: Path) -> None:
    path = render_video(path=tmp_path / "new" / "run.mp4", fps=25, **walker)
    about, frames = decode(path)
    assert about["codec"] == "h264"
    assert about["pix_fmt"].startswith("yuv420p")
    assert about["fps"] == 25
    assert frames.shape == (25, 180, 320, 3)
    assert [p.name for p in path.parent.iterdir()] == ["run.mp4"]
    assert path.stat().st_size < 300_000

    reds = np.array([np.argwhere(colored(f, RED)).mean(axis=0) for f in frames])
    greens = np.array([np.argwhere(colored(f, GREEN)).mean(axis=0) for f in frames])
    assert np.ptp(reds[:, 1]) < 8  # the camera stays with the base
    assert np.ptp(greens[:, 1]) > 30  # the leg swings
    corner = frames[:, -40:, :60].astype(float)
    assert np.abs(np.diff(corner, axis=0)).mean() > 1.0  # the ground runs by
    assert frames[0].std() > 15  # not blank


def test_a_file_name_may_contain_a_colon(walker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    render_video(path="slope:25.mp4", fps=10, **walker)
    assert [path.name for path in tmp_path.iterdir()] == ["slope:25.mp4"]


def test_overlay_is_dark_text_on_a_light_panel(walker, tmp_path: Path) -> None:
    texts = [f"{t:.2f} s" for t in walker["times"]]
    path = render_video(path=tmp_path / "b.mp4", fps=10, **walker | {"overlay": texts})
    panel = decode(path)[1][0][5:25, 5:60].astype(float)
    assert panel.min() < 120 < 220 < panel.max()  # dark letters on a light panel


def test_nearer_shapes_cover_farther_ones() -> None:
    poses = {"near": pose(y=-0.3, z=0.15), "far": pose(y=0.3, z=0.15)}
    camera = Camera(offset=(0.0, -1.5, 0.05))
    near, far = (
        Shape("near", "box", (0.2, 0.05, 0.1), pose(), RED),
        Shape("far", "box", (0.1, 0.05, 0.05), pose(), BLUE),
    )
    for shapes in ([near, far], [far, near]):
        picture = render_frame(shapes, poses, camera=camera)
        assert colored(picture, RED).sum() > 500
        assert colored(picture, BLUE).sum() == 0


def test_overlapping_boxes_are_ordered_by_depth_not_by_centres() -> None:
    # The small box hides the far end of the long one, although the long one's centre is nearer to the camera.
    poses = {"long": pose(z=0.15), "small": pose(x=-0.9, y=-0.09, z=0.15)}
    shapes = [
        Shape("small", "box", (0.05, 0.03, 0.05), pose(), RED),
        Shape("long", "box", (1.0, 0.05, 0.1), pose(), BLUE),
    ]
    camera = Camera(offset=(1.2, -0.8, 0.2))

    def red(*drawn: Shape) -> int:
        return int(colored(render_frame(drawn, poses, camera=camera), RED).sum())

    assert red(shapes[0]) > 30
    assert red(*shapes) == red(*shapes[::-1]) > 0.9 * red(shapes[0])


@pytest.mark.parametrize(("kind", "size"), [("box", (0.1, 0.1, 0.1)), ("cylinder", (0.1, 0.1)), ("sphere", (0.1,))])
def test_solids_are_drawn_with_the_right_size(kind: str, size: tuple[float, ...]) -> None:
    camera = Camera(offset=(0.0, -10.0, 0.0), height=0.5, field_of_view=4.0)  # nearly parallel rays
    picture = render_frame([Shape("b", kind, size, pose(), RED)], {"b": pose(z=0.5)}, size=(200, 200), camera=camera)
    rows, columns = np.nonzero(colored(picture, RED))
    expected = 0.2 * 100 / (10.0 * np.tan(np.radians(2.0)))
    assert np.ptp(rows) + 1 == pytest.approx(expected, abs=3)
    assert np.ptp(columns) + 1 == pytest.approx(expected, abs=3)
    area = {"box": 1.0, "cylinder": 1.0, "sphere": np.pi / 4}[kind]
    assert len(rows) == pytest.approx(area * expected**2, rel=0.06)


def test_a_shapes_frame_is_in_its_links_frame() -> None:
    frame = pose(x=0.1)
    frame[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z of the shape along x of the link
    shape = Shape("b", "cylinder", (0.01, 0.2), frame, RED)
    camera = Camera(offset=(0.0, -10.0, 0.0), height=0.5, field_of_view=4.0)
    picture = render_frame([shape], {"b": pose(z=0.5)}, size=(200, 200), camera=camera)
    rows, columns = np.nonzero(colored(picture, RED))
    scale = 100 / (10.0 * np.tan(np.radians(2.0)))
    assert columns.mean() == pytest.approx(100 + 0.1 * scale, abs=2)  # forward is to the right
    assert np.ptp(columns) == pytest.approx(0.4 * scale, abs=3)
    assert np.ptp(rows) < 10


def test_a_shadow_lies_on_the_ground(walker) -> None:
    now = {body: p[0] for body, p in walker["poses"].items()}
    aloft = {body: p @ pose(z=5.0) for body, p in now.items()}
    camera = Camera(height=0.1)
    low = np.asarray(render_frame(SHAPES, now, camera=camera), float)
    bare = np.asarray(render_frame(SHAPES, aloft, camera=camera), float)
    robot = colored(low, RED) | colored(low, GREEN)
    darker = (bare.sum(axis=-1) - low.sum(axis=-1) > 60) & ~robot
    assert 200 < darker.sum() < 0.3 * darker.size


def test_poses_between_two_times_are_interpolated_without_shrinking() -> None:
    turn, half = np.eye(4), np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    half[:2, :2] = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    poses = np.stack([pose(z=0.2), pose(z=0.2) @ turn])[:, None]
    np.testing.assert_allclose(interpolate_poses(np.array([0.0, 1.0]), poses, 0.5)[0], pose(z=0.2) @ half, atol=1e-12)


def test_a_box_behind_the_camera_is_not_drawn() -> None:
    camera = Camera(offset=(0.0, -1.0, 0.3))
    shapes = [Shape("a", "box", (0.1, 0.1, 0.1), pose(), RED), Shape("b", "box", (0.5, 0.5, 0.5), pose(), BLUE)]
    picture = render_frame(shapes, {"a": pose(z=0.1), "b": pose(y=-3.0)}, camera=camera)
    assert colored(picture, RED).sum() > 200
    assert colored(picture, BLUE).sum() == 0


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("run.gif", r"^video run\.gif: the name must end in \.mp4$"),
        ("/proc/x.mp4", r"^video /proc/x\.mp4: can't be written: No such file or directory$"),
    ],
)
def test_a_path_that_is_not_a_video_or_not_writable_is_rejected(
    walker: dict[str, Any], path: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SurefootError, match=message):
        render_video(**walker | {"path": path})
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_no_file(walker, tmp_path: Path) -> None:
    with pytest.raises(AttributeError):
        render_video(path=tmp_path / "run.mp4", fps=10, **walker | {"overlay": [*[""] * 40, *[3] * 11]})
    assert list(tmp_path.iterdir()) == []
