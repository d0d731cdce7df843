"""Off-screen videos of MuJoCo motion: one world or a grid of worlds, with the physics parameters written over them.

Nothing here may stop a training run: without a working OpenGL `record` warns once and returns None.
"""

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor.rendering import render, warn_once
from bayessim_mjx.quantities import compact

STRIP = 16  # the strip's part of a picture's height is 1 / STRIP
INK = (20, 20, 20)


def record(
    mj_model: Any,
    qpos: np.ndarray | Sequence[np.ndarray],
    path: str | os.PathLike | None = None,
    fps: float = 30.0,
    width: int = 320,
    height: int = 240,
    camera: str | int | None = None,
    overlay_text: str | Mapping | Sequence | None = None,
    dt: float | None = None,
    title: str = "",
    captions: Sequence[str] | None = None,
    mocap: np.ndarray | None = None,
) -> np.ndarray | None:
    """Render qpos [T, nq] (or a list of them, one per world, shown as a grid) to frames [T', H, W, 3] uint8.

    Args:
        path: also save there (`.mp4` or `.gif`).
        fps: frames per second of the video.
        width, height: pixels of one world's picture.
        camera: name or number of a camera of the model; None: the model's first, else one fitted to the motion.
        overlay_text: lines or {name: value} written into the corner; with several worlds one entry per world.
        dt: seconds between rows of qpos. When given, rows are picked so that the video runs in real time.
        title, captions: one world only; a text, and one for each row of qpos [T]. They stand on a strip at the bottom,
            so that they never hide the robot.
        mocap: one world only; poses [T, nmocap, 7] of the model's mocap bodies, m and quaternions.
    Returns:
        None, with one warning, where no OpenGL works (or MUJOCO_GL=disable).
    """
    worlds = [np.asarray(q, np.float64) for q in (qpos if isinstance(qpos, list | tuple) else [qpos])]
    for world in worlds:
        if world.ndim != 2 or world.shape[1] != mj_model.nq or not len(world):
            raise ValueError(f"qpos has shape {world.shape}; expected [T, {mj_model.nq}] for this model, T >= 1")
    if captions is not None and (len(worlds) != 1 or len(captions) != len(worlds[0])):
        raise ValueError(f"{len(captions)} captions for {len(worlds)} world(s) of {len(worlds[0])} rows: one per row")
    picked = [_rows(len(world), dt, fps) for world in worlds]
    marks = None if mocap is None else [np.asarray(mocap)[picked[0]]]
    worlds = [world[rows] for world, rows in zip(worlds, picked, strict=True)]
    texts = [overlay_text] if len(worlds) == 1 else list(overlay_text or [None] * len(worlds))
    strip = 0 if captions is None else strip_of(height)
    try:
        tiles = render(mj_model, worlds, width, height - strip, camera, marks)
    except Exception as error:  # drivers fail in many ways, and no picture may end a run
        if isinstance(error, ValueError):
            raise
        warn_once(f"no video: rendering failed ({type(error).__name__}: {error})")
        tiles = None
    if tiles is None:
        return None
    frames = _grid([corner(tile, text) for tile, text in zip(tiles, texts, strict=True)])
    if captions is not None:
        frames = underline(frames, strip, title, [captions[row] for row in picked[0]])
    if path is not None:
        save(frames, path, fps)
    return frames


def model_at(env: Any, theta: Any) -> Any:
    """Make the MuJoCo model of one of our tasks with theta [d] in it, so that a longer rod is drawn longer."""
    return env.space.edit(env.spec(), np.asarray(theta)).compile() if len(env.space) else env.mj_model


def _rows(length: int, dt: float | None, fps: float) -> np.ndarray:
    if dt is None:
        return np.arange(length)
    count = max(1, round(length * dt * fps))
    return np.minimum((np.arange(count) / (fps * dt)).astype(int), length - 1)


def _grid(tiles: list[np.ndarray]) -> np.ndarray:
    """Tile [T, H, W, 3] pictures, as near to a square as they come; empty places stay white."""
    columns = int(np.ceil(np.sqrt(len(tiles))))
    rows = -(-len(tiles) // columns)
    length, height, width, _ = tiles[0].shape
    out = np.full((length, rows * height, columns * width, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        y, x = (i // columns) * height, (i % columns) * width
        out[:, y : y + height, x : x + width] = tile
    return out


def gif(frames: np.ndarray, fps: float) -> bytes:
    """Frames [T, H, W, 3] uint8 as an endless GIF; one palette for all frames, so that colours do not flicker."""
    from PIL import Image

    sample = np.concatenate(frames[np.linspace(0, len(frames) - 1, 8).astype(int)])
    palette = Image.fromarray(sample).quantize(255, dither=Image.Dither.NONE)
    pictures = [Image.fromarray(f).quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    buffer = io.BytesIO()
    duration = max(20, round(1000 / fps))  # viewers slow anything under 20 ms down to 100 ms
    pictures[0].save(buffer, "GIF", save_all=True, append_images=pictures[1:], duration=duration, loop=0)
    return buffer.getvalue()


def save(frames: np.ndarray, path: str | os.PathLike, fps: float) -> bool:
    """Save frames [T, H, W, 3] uint8 as `.gif` or `.mp4`. False, with a warning, where there is no ffmpeg."""
    path = Path(path)
    if path.suffix not in (".gif", ".mp4"):
        raise UserError(f"cannot save a video as {path.name!r}; allowed endings: .mp4, .gif")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        path.write_bytes(gif(frames, fps))
        return True
    try:
        _mp4(frames, path, fps)
    except Exception as error:
        warn_once(f"no mp4: {type(error).__name__}: {error}")
        return False
    return True


def _mp4(frames: np.ndarray, path: Path, fps: float) -> None:
    import subprocess

    import imageio_ffmpeg

    even = frames[:, : frames.shape[1] // 2 * 2, : frames.shape[2] // 2 * 2]  # yuv420p halves both sides
    source = [
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        f"{even.shape[2]}x{even.shape[1]}",
        "-r",
        f"{fps:g}",
        "-i",
        "-",
    ]
    target = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
    # Not imageio_ffmpeg.write_frames: it forks (preexec_fn), which JAX's threads do not survive for sure.
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", *source, *target]
    subprocess.run(command, input=even.tobytes(), check=True, capture_output=True)


def strip_of(height: int) -> int:
    """Pixels of a picture of `height` that the strip takes."""
    return height // STRIP


def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(os.path.join(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf"), size)


def corner(frames: np.ndarray, text: str | Mapping | Sequence | None) -> np.ndarray:
    """Write `text` on a light ground into the upper left corner, as many lines as leave the robot in sight."""
    if not text:
        return frames
    from PIL import Image, ImageDraw

    height, width = frames.shape[1:3]
    size = max(10, height // 26)
    font, place = _font(size), (size // 2, size // 3)
    lines = _lines(text)
    fit = max(2, int(0.4 * height / (1.3 * size)))
    words = "\n".join(lines if len(lines) <= fit else [*lines[: fit - 1], f"… {len(lines) - fit + 1} more"])
    box = ImageDraw.Draw(Image.new("RGB", (1, 1))).multiline_textbbox(place, words, font=font)
    area = (slice(0, min(height, int(box[3]) + size // 2)), slice(0, min(width, int(box[2]) + size // 2)))
    frames = frames.copy()
    for frame in frames:
        ground = Image.fromarray((0.25 * frame[area] + 0.75 * 255).astype(np.uint8))
        ImageDraw.Draw(ground).multiline_text(place, words, font=font, fill=INK)
        frame[area] = np.asarray(ground)
    return frames


def underline(frames: np.ndarray, strip: int, title: str, captions: Sequence[str]) -> np.ndarray:
    """Frames above a white strip with the title to the left and each frame's caption to the right.

    Args:
        frames: [T, H, W, 3] uint8.
        strip: its height in pixels.
        title: the same on all frames.
        captions: [T], one per frame.
    """
    from PIL import Image, ImageDraw

    length, height, width, _ = frames.shape
    size, edge = max(9, int(0.6 * strip)), strip // 2
    widest = max(captions, key=len)
    while size > 6 and _font(size).getlength(f"{title}   {widest}") > width - 2 * edge:
        size -= 1
    font = _font(size)
    start = width - edge - font.getlength(widest)  # the same for all, so that nothing jumps
    out = np.full((length, height + strip, width, 3), 255, np.uint8)
    for k, caption in enumerate(captions):
        ground = Image.new("RGB", (width, strip), "white")
        draw = ImageDraw.Draw(ground)
        draw.text((edge, strip // 2), title, font=font, fill=INK, anchor="lm")
        draw.text((start, strip // 2), caption, font=font, fill=INK, anchor="lm")
        out[k, :height], out[k, height:] = frames[k], np.asarray(ground)
    return out


def _lines(text: str | Mapping | Sequence) -> list[str]:
    if isinstance(text, Mapping):
        return [f"{k} {compact(v, 3)}" if isinstance(v, float | np.floating) else f"{k} {v}" for k, v in text.items()]
    return text.splitlines() if isinstance(text, str) else [str(line) for line in text]
