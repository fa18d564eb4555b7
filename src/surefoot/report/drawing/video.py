"""Videos (MP4) of a robot's run, rendered in software and encoded as H.264 by imageio-ffmpeg's ffmpeg."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.report.drawing.mesh import Mesh
from surefoot.report.drawing.renderer import Camera, View, draw
from surefoot.robot.appearance import Appearance
from surefoot.world.ground import FLAT, Ground

_THREADS, _BATCH = 2, 16
"""Number of rendering threads, and number of frames rendered before they are encoded."""
INK, PANEL = (34, 39, 46), (255, 255, 255, 190)
_REACH = 6.0
"""Standard deviations of the smoothing's weights beyond which samples are left out."""


def render_video(
    appearance: Appearance,
    poses: Mapping[str, Array],
    times: ArrayLike,
    path: str | Path,
    *,
    follow: str,
    overlay: Sequence[str],
    camera: Camera = Camera(),  # noqa: B008, it is frozen
    ground: Ground = FLAT,
    fps: int = 50,
    size: tuple[int, int] = (960, 540),
) -> Path:
    """Write a real-time video (MP4, H.264, yuv420p) of moving links.

    Args:
        appearance: visual parts of the links.
        poses: poses (T, 4, 4) in the world frame at `times`, by link.
        times: times (T,) [s], strictly increasing.
        path: file to write (.mp4), atomically.
        follow: link that the camera follows.
        overlay: text at the top left for each of `times`, with one or more lines.
        camera: camera.
        ground: ground under the links.
        fps: frames per second; poses are interpolated.
        size: width and height [px], even numbers.
    """
    import imageio_ffmpeg

    path, times = Path(path), np.asarray(times, float)
    if path.suffix.lower() != ".mp4":
        raise SurefootError(f"video {path}: the name must end in .mp4")
    mesh, stack = Mesh(appearance, list(poses)), np.stack(list(poses.values()), axis=1)
    track_times, track = _smooth_track(times, poses[follow][:, :2, 3], camera.smoothing)
    clock = times[0] + np.arange(max(int((times[-1] - times[0]) * fps + 1e-6), 1)) / fps

    def frame(now: float) -> bytes:
        place = [np.interp(now, track_times, part) for part in track.T]
        picture = draw(mesh, interpolate_poses(times, stack, now), View(camera, place, size, ground))
        write_label(picture, overlay[int(np.abs(times - now).argmin())])
        content: bytes = picture.tobytes()
        return content

    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
    writer = imageio_ffmpeg.write_frames(
        f"file:{temporary}",  # without the prefix, ffmpeg interprets a colon in the path as a protocol
        size,
        fps=fps,
        codec="libx264",
        pix_fmt_out="yuv420p",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=["-crf", "23", "-preset", "veryfast", "-movflags", "+faststart"],
    )
    try:
        # Create the file first: if that fails, ffmpeg's error would contain its whole command.
        temporary.touch()
        writer.send(None)
        # Rendering releases Python's lock: two threads, since ffmpeg uses a third.
        with ThreadPoolExecutor(_THREADS) as pool:
            for start in range(0, len(clock), _BATCH):
                for picture in pool.map(frame, clock[start : start + _BATCH]):
                    writer.send(picture)
        writer.close()
        os.replace(temporary, path)
    except OSError as error:
        raise SurefootError(f"video {path}: can't be written: {error.strerror or 'ffmpeg failed'}") from error
    finally:
        writer.close()
        temporary.unlink(missing_ok=True)
    return path


def interpolate_poses(times: Array, poses: Array, now: float) -> Array:
    """Interpolate poses (T, B, 4, 4) at `times` linearly, with orthonormal axes; return poses (B, 4, 4) at `now`."""
    after = min(max(int(np.searchsorted(times, now)), 1), len(times) - 1)
    before = max(after - 1, 0)
    span = times[after] - times[before]
    fraction = float(np.clip((now - times[before]) / span, 0.0, 1.0)) if span > 0 else 0.0
    pose: Array = (1.0 - fraction) * poses[before] + fraction * poses[after]
    x = pose[:, :3, 0] / np.linalg.norm(pose[:, :3, 0], axis=1, keepdims=True)
    z = np.cross(x, pose[:, :3, 1])
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    pose[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    return pose


def write_label(picture: Image.Image, text: str) -> None:
    """Write text (one or more lines) on a light panel at the top left of an image."""
    if not text:
        return
    unit = picture.height / 540
    font = label_font(max(round(19 * unit), 11))
    pen = ImageDraw.Draw(picture, "RGBA")
    margin, padding = 14 * unit, 10 * unit
    box = pen.multiline_textbbox((margin + padding, margin + padding), text, font=font, spacing=5 * unit)
    pen.rounded_rectangle(
        (box[0] - padding, box[1] - padding, box[2] + padding, box[3] + padding), radius=7 * unit, fill=PANEL
    )
    pen.multiline_text((margin + padding, margin + padding), text, fill=INK, font=font, spacing=5 * unit)


@functools.lru_cache(maxsize=8)
def label_font(size: int) -> Any:
    """Return Pillow's built-in font, which is available on every machine."""
    return ImageFont.load_default(size)


def _smooth_track(times: Array, track: Array, smoothing: float) -> tuple[Array, Array]:
    """Return times and positions (K, 2) of a camera that follows a smoothed track (T, 2).

    The track is smoothed by local linear regression with Gaussian weights; unlike a mean, it does not lag at the ends.
    """
    if smoothing <= 0 or len(times) < 3:
        return times, track
    clock = np.linspace(times[0], times[-1], max(int((times[-1] - times[0]) * 20), 2))
    rough = np.stack([np.interp(clock, times, part) for part in track.T], axis=-1)
    step = float(clock[1] - clock[0])
    width = min(int(np.ceil(_REACH * smoothing / step)), len(clock) - 1)
    lag = step * np.arange(-width, width + 1)
    weight = np.exp(-0.5 * (lag / smoothing) ** 2)

    def sums(values: Array, power: int) -> Array:
        """Return at each time the sum of weighted values (K,) times a power of their lag."""
        return np.convolve(values, (weight * lag**power)[::-1])[width : width + len(clock)]

    m0, m1, m2 = (sums(np.ones(len(clock)), power) for power in range(3))
    smooth = [(m2 * sums(part, 0) - m1 * sums(part, 1)) / (m0 * m2 - m1**2) for part in rough.T]
    return clock, np.stack(smooth, axis=-1)
