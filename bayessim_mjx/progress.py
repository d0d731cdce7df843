"""Progress of a computation in stages: bars on a terminal, elsewhere lines with counts and the time to go.

Functions that take long have an argument `progress`: None shows it where a person watches (`watched`), True always,
False never; a function `(stage, done, total)` is called instead.
"""

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, TextIO, runtime_checkable

from bayessim_mjx.quantities import duration

EVERY = 10.0  # s between two lines of one stage
BEAT = 30.0  # s without a line, such as while a program is compiled, after which one says that the stage still runs
BESIDE = 32  # columns of a terminal that a count and two times take beside a bar
WIDE = 100  # columns of a terminal that has room for long bars
ENDED = 8  # stages that stay on a terminal after their end; more would push the one that runs out of it


@runtime_checkable
class Show(Protocol):
    """Where progress goes."""

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """`done` of `total` parts of a stage are done; `note`: a result so far."""

    def line(self, text: str) -> None:
        """Print a result that stays on the screen."""


Wanted = bool | Callable[..., Any] | None  # an argument `progress`


def watched() -> bool:
    """Whether a person sees standard error: it is a terminal, or that of a notebook."""
    if sys.stderr.isatty():
        return True
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return getattr(shell, "kernel", None) is not None


class Silent:
    """Shows nothing."""

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        pass

    def line(self, text: str) -> None:
        pass


class Lines:
    """A line when a stage begins and every EVERY s while it lasts: elapsed time, stage, count, time to go.

    Args:
        file: where to; now: clock in seconds.
    """

    def __init__(self, file: TextIO, now: Callable[[], float] = time.monotonic):
        self.file, self.now, self.began = file, now, now()
        self.stage, self.since, self.first, self.reported = "", self.began, 0, 0.0
        self.done, self.at, self.total = 0, self.began, 1  # the last count, and when it was reached

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        now = self.now()
        if stage != self.stage:
            self.stage, self.since, self.first, self.reported = stage, now, done, -EVERY
            self.done, self.at = done, now
        if done != self.done:
            self.done, self.at = done, now
        self.total = total
        if now - self.reported >= EVERY:
            self.reported = now
            counted = f": {done} of {total}{self._left(now, done, total)}" if total > 1 else ""
            self.line(f"{now - self.began:6.1f} s  {stage}{counted}{f', {note}' if note else ''}")

    def line(self, text: str) -> None:
        print(text, file=self.file, flush=True)

    def beat(self) -> None:
        """Say that the stage still runs, after BEAT s without a line."""
        now = self.now()
        if self.stage and now - self.reported >= BEAT:
            self.reported = now
            counted = f": {self.done} of {self.total}" if self.total > 1 else ""
            self.line(f"{now - self.began:6.1f} s  {self.stage}{counted}, {duration(now - self.since)} so far")

    def _left(self, now: float, done: int, total: int) -> str:
        """Time to go in this stage at the pace of its last count; nothing where that time is over."""
        made = done - self.first
        if made <= 0 or done >= total:
            return ""
        left = (self.at - self.since) / made * (total - done) - (now - self.at)
        return f", about {duration(left)} left" if left > 0 else ""


class Bars:
    """A bar for each stage, with the time to go."""

    def __init__(self, bars: Any):
        self.bars = bars
        self.stages: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        if stage not in self.stages:
            for other in [task for task in self.bars.tasks if not task.finished]:
                known = other.total
                whole = {"count": f"{known:.0f}/{known:.0f}"} if known else {}
                self.bars.update(other.id, completed=known or 1, total=known or 1, **whole)
            self.stages[stage] = self.bars.add_task(stage, total=None, count="")
            for old in list(self.stages)[: -ENDED - 1]:
                self.bars.remove_task(self.stages.pop(old))
        room = max(self.bars.console.width - BESIDE - _bar(self.bars.console), 20)
        shown = f"{stage}, {note}" if note else stage
        shown = shown if len(shown) <= room else f"{shown[: room - 1]}…"
        many = total > 1  # a stage of one part has no share that is done: its bar moves from side to side
        count = dict(completed=done, total=total, count=f"{done}/{total}") if many else dict(total=None, count="")
        self.bars.update(self.stages[stage], description=shown, **count)

    def line(self, text: str) -> None:
        self.bars.console.print(text, highlight=False, markup=False)


def _bar(console: Any) -> int:
    """Choose the columns of a bar."""
    return 20 if console.width >= WIDE else 10


@contextlib.contextmanager
def beating(beat: Callable[[], None]) -> Iterator[None]:
    """Call a function every second, on a thread of its own, while the block lasts."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(1.0):
            beat()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def stages(headless: bool) -> Iterator[Show]:
    """Progress on stderr: bars on a terminal unless `headless`, else lines."""
    if headless or not sys.stderr.isatty():
        lines = Lines(sys.stderr)
        with beating(lines.beat):
            yield lines
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    words, count = (TextColumn(field, markup=False) for field in ("{task.description}", "{task.fields[count]}"))
    console = Console(stderr=True)
    columns = (SpinnerColumn(), words, BarColumn(_bar(console)), count, TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True, console=console) as bars:
        yield Bars(bars)


@contextlib.contextmanager
def shown(progress: Wanted) -> Iterator[Show]:
    """Where the progress of a function goes whose argument `progress` this is."""
    if callable(progress):
        yield _Caller(progress)
    elif progress or (progress is None and watched()):
        with stages(headless=False) as show:
            yield show
    else:
        yield Silent()


class _Caller(Silent):
    """Calls the user's function."""

    def __init__(self, function: Callable[..., Any]):
        self.function = function

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        self.function(stage, done, total)


class Worded(Silent):
    """Passes progress on, each stage in words for people."""

    def __init__(self, show: Show, words: Callable[[str], str]):
        self.show, self.words = show, words

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        self.show(self.words(stage), done, total, *([note] if note else []))

    def line(self, text: str) -> None:
        self.show.line(text)
