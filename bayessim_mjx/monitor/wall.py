"""Rewards over the seconds that a run has taken, pauses between its sessions left out (rsl_rl's `*/time` tags)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx.monitor.writers import opened

TAGS = ("Train/mean_reward", "Train/mean_episode_length")
FOLDER = "rl_time"


class Wall:
    """Writes `Train/mean_reward/time` and `Train/mean_episode_length/time`; x is whole seconds, one point in each.

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
        self.writer = opened(path / FOLDER, late, more=writers, run=path)

    def scalars(self, metrics: Mapping[str, Any]) -> None:
        """Write a point for the present second, unless it has one."""
        second = int(self.now() - self.started)
        values = {f"{tag}/time": metrics[tag] for tag in TAGS if tag in metrics}
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
