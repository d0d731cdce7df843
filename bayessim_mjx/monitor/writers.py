"""Where figures go: TensorBoard always, and beside it files of plain text or Weights & Biases (`monitor.writers`)."""

from __future__ import annotations

import csv
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.monitor.writer import PurgeStep, TensorBoard, is_late, number

PLAIN = ("step", "tag", "value", "time")  # columns of a CSV file, keys of a JSONL line
TIMED = ("Train/mean_reward", "Train/mean_episode_length")
TIME_FOLDER = "rl_time"  # of rewards over seconds


class Writer(Protocol):
    """What a run's monitor writes to. Steps are whole numbers and never fall, but after a resume (`purge_step`)."""

    def scalars(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        """{tag: number} at `step`; None and NaN are left out."""

    def text(self, tag: str, text: str, step: int = 0, code: bool = False) -> None:
        """Markdown, or with `code` a text as it is."""

    def figure(self, tag: str, figure: Any, step: int) -> None:
        """Write a matplotlib figure, which the last writer closes."""

    def video(self, tag: str, frames: np.ndarray | None, fps: float, step: int) -> None:
        """Frames [T, H, W, 3] uint8; None is skipped."""

    def flush(self) -> None:
        """All that was written lies where it belongs."""

    def close(self) -> None:
        """Nothing more comes; a second call does nothing."""


def opened(
    path: Path,
    purge_step: PurgeStep = None,
    media: Path | None = None,
    more: Sequence[str] = (),
    run: Path | None = None,
) -> Writer:
    """Open the writer of one of a run's folders.

    Args:
        path: that folder, e.g. RUN/rl.
        purge_step: on resume, the first step that is written again (see `writer.purge`).
        media: for pictures and videos as plain files.
        more: `monitor.writers`, what to write to beside TensorBoard.
        run: the run's folder, which Weights & Biases' run is called after; None: `path`.
    """
    board = TensorBoard(path, purge_step, media)
    if not more:
        return board
    run = path if run is None else run
    name = "" if path == run else path.name
    return Several([*(_made(kind, path, purge_step, run, name) for kind in more), board])


def _made(kind: str, path: Path, purge_step: PurgeStep, run: Path, name: str) -> Writer:
    if kind == "wandb":
        from bayessim_mjx.monitor.wandb_writer import WandbWriter

        return WandbWriter(run, name)
    return Lines(path / f"scalars.{kind}", purge_step)


class Several:
    """Writes to all; TensorBoard is the last, as it closes figures."""

    def __init__(self, writers: Sequence[Writer]) -> None:
        self.writers = tuple(writers)

    def scalars(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        for writer in self.writers:
            writer.scalars(step, values, prefix)

    def text(self, tag: str, text: str, step: int = 0, code: bool = False) -> None:
        for writer in self.writers:
            writer.text(tag, text, step, code)

    def figure(self, tag: str, figure: Any, step: int) -> None:
        for writer in self.writers:
            writer.figure(tag, figure, step)

    def video(self, tag: str, frames: np.ndarray | None, fps: float, step: int) -> None:
        for writer in self.writers:
            writer.video(tag, frames, fps, step)

    def flush(self) -> None:
        for writer in self.writers:
            writer.flush()

    def close(self) -> None:
        for writer in self.writers:
            writer.close()


class Lines:
    """Scalars as lines of text, one number each: JSON objects (`.jsonl`) or a table of four columns (`.csv`)."""

    def __init__(self, path: Path, purge_step: PurgeStep = None) -> None:
        self.path, self.csv = path, path.suffix == ".csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        if purge_step is not None and path.exists():
            kept = [row for row in read(path) if not is_late([row["tag"]], int(row["step"]), purge_step)]
            with atomic.replacing(path, "w", newline="") as file:
                self._write(file, kept, begin=True)
        new = not path.exists() or not path.stat().st_size
        self.file = path.open("a", newline="")
        self._write(self.file, [], begin=new)

    def _write(self, file: Any, rows: Sequence[Mapping[str, Any]], begin: bool = False) -> None:
        if self.csv:
            table = csv.DictWriter(file, PLAIN)
            if begin:
                table.writeheader()
            table.writerows(rows)
        else:
            file.writelines(json.dumps(dict(row)) + "\n" for row in rows)

    def scalars(self, step: int, values: Mapping[str, Any], prefix: str = "") -> None:
        now, rows = round(time.time(), 3), []
        for tag, value in values.items():
            found = number(prefix + tag, value)
            if found is not None:  # JSON has no infinity
                shown = found if math.isfinite(found) else str(found)
                rows.append({"step": int(step), "tag": prefix + tag, "value": shown, "time": now})
        self._write(self.file, rows)

    def text(self, tag: str, text: str, step: int = 0, code: bool = False) -> None:
        """Texts and pictures are TensorBoard's."""

    def figure(self, tag: str, figure: Any, step: int) -> None:
        """As `text`."""

    def video(self, tag: str, frames: np.ndarray | None, fps: float, step: int) -> None:
        """As `text`."""

    def flush(self) -> None:
        self.file.flush()

    def close(self) -> None:
        self.file.close()


def read(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a file that `Lines` wrote; a last line that was cut short is left out."""
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if path.suffix == ".csv":
        rows = csv.DictReader(whole.splitlines())
        return [{**r, "step": int(r["step"]), "value": float(r["value"]), "time": float(r["time"])} for r in rows]
    return [json.loads(line) | {"value": float(json.loads(line)["value"])} for line in whole.splitlines()]


class Wall:
    """Writes `Train/mean_reward/time` and `Train/mean_episode_length/time`; x is whole seconds, one point in each.

    Seconds that the run has taken, pauses between its sessions left out (rsl_rl's `*/time` tags).

    Args:
        path: folder of the run; the events lie in its folder `rl_time`.
        resumed_at: None for a new run; else what `mark` said at the checkpoint that the run goes on from, -1 without.
        now: clock in seconds.
        writers: what to write to beside TensorBoard.
    """

    def __init__(
        self,
        path: Path,
        resumed_at: int | None = None,
        now: Callable[[], float] = time.perf_counter,
        writers: Sequence[str] = (),
    ):
        self.last = -1 if resumed_at is None else resumed_at
        self.now, self.started = now, now() - (self.last + 1)
        late = None if resumed_at is None else resumed_at + 1
        self.writer = opened(path / TIME_FOLDER, late, more=writers, run=path)

    def scalars(self, metrics: Mapping[str, Any]) -> None:
        """Write a point for the present second, unless it has one."""
        second = int(self.now() - self.started)
        values = {f"{tag}/time": metrics[tag] for tag in TIMED if tag in metrics}
        if values and second > self.last:
            self.writer.scalars(second, values)
            self.last = second

    def mark(self) -> int:
        """Close the present second to further points and return it: a checkpoint of now is resumed after it."""
        self.last = max(self.last, int(self.now() - self.started))
        return self.last

    def flush(self) -> None:
        self.writer.flush()

    def close(self) -> None:
        self.writer.close()


def marked(meta: Mapping[str, Any]) -> int:
    """Read the second of `mark` from a checkpoint's meta; -1 where it has none."""
    second = meta.get("seconds")
    return second if type(second) is int else -1
