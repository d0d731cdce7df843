"""TensorBoard event files: scalars, texts, figures and GIF videos, and pictures kept beside them in a `media` folder.

Nothing here needs torch or moviepy. A resumed run takes the steps it is about to repeat out of the old event files.
"""

import io
import math
import os
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx import atomic

FLUSH = 10.0  # s
PurgeStep = int | Mapping[str, int] | None


def records(path: Path) -> Iterator[tuple[bytes, Any]]:
    """Yield (raw record with its checksums, `Event`) of one event file; one cut short or damaged ends it quietly."""
    from google.protobuf.message import DecodeError
    from tensorboardX.proto.event_pb2 import Event

    data = path.read_bytes()
    at = 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, at)  # TFRecord: u64 length, u32 crc, data, u32 crc
        end = at + 12 + length + 4
        if end > len(data):
            return
        try:
            event = Event.FromString(data[at + 12 : end - 4])
        except DecodeError:
            return
        yield data[at:end], event
        at = end


def event_files(folder: str | os.PathLike) -> list[Path]:
    """Event files of one TensorBoard run, oldest first."""
    return sorted(Path(folder).glob("events.out.tfevents.*"))


def purge(folder: str | os.PathLike, step: int | Mapping[str, int]) -> int:
    """Take events at or after `step` out of the event files in `folder`; returns how many went.

    `step` is one number, or {tag prefix: number} where tags count different things (`{"BayesSim": 3, "Train": 600}`);
    tags without a matching prefix stay, and "" is a prefix of every tag. Files are replaced atomically; a folder
    that is a link stays as it is.
    """
    dropped = 0
    if Path(folder).is_symlink():
        return 0
    for path in event_files(folder):
        old = list(records(path))
        kept = [raw for raw, event in old if not _late_event(event, step)]
        if len(kept) < len(old):
            atomic.write_bytes(path, b"".join(kept))
            dropped += len(old) - len(kept)
    return dropped


def _late_event(event: Any, step: int | Mapping[str, int]) -> bool:
    return event.HasField("summary") and is_late([value.tag for value in event.summary.value], event.step, step)


def is_late(tags: Sequence[str], at: int, step: int | Mapping[str, int]) -> bool:
    """Whether what stands at step `at` under `tags` is written again by a run that goes on at `step` (see `purge`)."""
    if isinstance(step, Mapping):
        return any(tag.startswith(prefix) and at >= first for prefix, first in step.items() for tag in tags)
    return at >= step


class TensorBoard:
    """Event files of one TensorBoard run.

    Args:
        path: folder of the run (made if it is not there).
        purge_step: on resume, the first step that will be written again, see `purge`. None keeps everything.
        media: folder for the pictures and videos that are shown, as plain files; None: `path/media`.
    """

    _closed = False

    def __init__(self, path: str | os.PathLike, purge_step: PurgeStep = None, media: str | os.PathLike | None = None):
        self.path = Path(path)
        self.media = Path(media) if media is not None else self.path / "media"
        if purge_step is not None:
            purge(self.path, purge_step)
        # A file's name holds whole seconds only: without a suffix a quick restart would overwrite the file before it.
        suffix = f".{len(event_files(self.path)):04d}"
        single = purge_step if isinstance(purge_step, int | None) else purge_step.get("")
        self._file = _file(self.path, suffix)
        self._flushed = time.monotonic()
        if single is not None:
            self._event(int(single), session_log={"status": 1})  # START: readers drop later events of earlier files

    def scalars(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        """Write {tag: number} (Python, NumPy or device scalars) at `step`. None and NaN are left out."""
        for tag, value in values.items():
            found = number(prefix + tag, value)
            if found is not None:
                from tensorboardX.summary import scalar

                self._event(int(step), summary=scalar(prefix + tag, found))

    def text(self, tag: str, text: str, step: int = 0, code: bool = False) -> None:
        """Write Markdown; `code` shows it as it is, line for line (a YAML file, say)."""
        if code:
            text = "\n".join("    " + line for line in text.splitlines())
        from tensorboardX.summary import text as text_of

        self._event(int(step), summary=text_of(tag, text))

    def figure(self, tag: str, figure: Any, step: int) -> None:
        """Write a matplotlib figure as PNG at its own dpi, keep the file, and close the figure."""
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        self._image(tag, buffer.getvalue(), step)
        self._keep(tag, step, ".png", lambda path: path.write_bytes(buffer.getvalue()))
        figure.clear()
        if "matplotlib.pyplot" in sys.modules:  # a figure from pyplot is also held by pyplot
            sys.modules["matplotlib.pyplot"].close(figure)

    def video(self, tag: str, frames: np.ndarray | None, fps: float, step: int) -> None:
        """Write frames [T, H, W, 3] uint8 as a GIF in the image tab and keep an mp4. None (no OpenGL) is skipped."""
        from bayessim_mjx.monitor import video

        if frames is None:
            return
        self._image(tag, video.gif(frames, fps), step)
        self._keep(tag, step, ".mp4", lambda path: video.save(frames, path, fps))

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        """Write what is not yet on the disk and close the event file; a second call does nothing."""
        if not self._closed:
            self._closed = True  # also where that fails: it is not tried twice
            self._file.close()

    def __enter__(self) -> "TensorBoard":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _image(self, tag: str, encoded: bytes, step: int) -> None:
        from PIL import Image
        from tensorboardX.proto.summary_pb2 import Summary

        width, height = Image.open(io.BytesIO(encoded)).size
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
        self._event(int(step), summary=Summary(value=[Summary.Value(tag=tag, image=image)]))

    def _event(self, step: int, **content: Any) -> None:
        """Write one event, here and now: a full disk is this call's error, where a thread's would be lost."""
        from tensorboardX.proto.event_pb2 import Event

        self._file.write_event(Event(wall_time=time.time(), step=step, **content))
        if time.monotonic() - self._flushed > FLUSH:
            self._flushed = time.monotonic()
            self._file.flush()

    def _keep(self, tag: str, step: int, suffix: str, write: Callable[[Path], Any]) -> None:
        self.media.mkdir(parents=True, exist_ok=True)
        name = "".join(c if c.isalnum() or c in "._-" else "_" for c in tag)
        write(self.media / f"{name}_{int(step):06d}{suffix}")


def _file(folder: Path, suffix: str) -> Any:
    """Open a new event file; the caller writes, flushes and closes it."""
    from tensorboardX.event_file_writer import EventsWriter

    folder.mkdir(parents=True, exist_ok=True)
    return EventsWriter(str(folder / "events"), suffix)


def number(tag: str, value: Any) -> float | None:
    """Convert a scalar of Python, NumPy or a device; None for None and NaN."""
    if value is None:
        return None
    array = np.asarray(value)
    if array.size != 1:
        raise ValueError(f"scalar {tag!r} has shape {array.shape}; a scalar has one element")
    number = float(array.reshape(()))
    return None if math.isnan(number) else number
