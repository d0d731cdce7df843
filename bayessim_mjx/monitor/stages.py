"""Progress of a computation in stages: bars on a terminal, elsewhere lines with counts and the time to go."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, TextIO

from bayessim_mjx.quantities import duration

Say = Callable[[str, int, int], None]  # (what is being done, done, total)
EVERY = 10.0  # s between two lines of one stage


class Lines:
    """A line when a stage begins and every EVERY s while it lasts: elapsed time, stage, count, time to go.

    Args:
        file: where to; now: clock in seconds.
    """

    def __init__(self, file: TextIO, now: Callable[[], float] = time.monotonic):
        self.file, self.now, self.began = file, now, now()
        self.stage, self.since, self.first, self.reported = "", self.began, 0, 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = self.now()
        if stage != self.stage:
            self.stage, self.since, self.first, self.reported = stage, now, done, -EVERY
        if now - self.reported >= EVERY:
            self.reported = now
            counted = f": {done} of {total}{self._left(now, done, total)}" if total > 1 else ""
            print(f"{now - self.began:6.1f} s  {stage}{counted}", file=self.file, flush=True)

    def _left(self, now: float, done: int, total: int) -> str:
        """Time to go in this stage, from what was done in it."""
        made = done - self.first
        return (
            f", about {duration((now - self.since) / made * (total - done))} left" if made > 0 and done < total else ""
        )


@contextlib.contextmanager
def stages(headless: bool) -> Iterator[Say]:
    """A function (what, done, total) that shows it on stderr: a bar with the time to go, or lines."""
    if headless or not sys.stderr.isatty():
        yield Lines(sys.stderr)
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    text, bar = TextColumn("{task.description}"), BarColumn()
    columns = (SpinnerColumn(), text, bar, MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                for other in tasks.values():
                    bars.update(other, completed=bars.tasks[other].total)
                tasks[stage] = bars.add_task(stage, total=max(total, 1))
            bars.update(tasks[stage], completed=done, total=max(total, 1))

        yield show
