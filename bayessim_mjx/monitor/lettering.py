"""Text on the frames of a video: over a corner of the picture, and on a strip below it."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.quantities import compact

STRIP = 16  # the strip's part of a picture's height is 1 / STRIP
INK = (20, 20, 20)


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
