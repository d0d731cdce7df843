"""Time to go."""

import time
from collections.abc import Callable


class Clock:
    """Time to go, from the mean duration of the steps done here; compiling is not counted as a step's time."""

    def __init__(self, total: int, done: int = 0, now: Callable[[], float] = time.monotonic):
        self.total, self.done, self.now = total, done, now
        self.first, self.begun, self.excluded = done, now(), 0.0

    def exclude(self, seconds: float) -> None:
        self.excluded += seconds

    def advance(self, to: int | None = None) -> None:
        self.done = self.done + 1 if to is None else to

    def eta(self) -> float | None:
        """Seconds to go; None before the first step is done."""
        steps = self.done - self.first
        if steps <= 0:
            return None
        return max(self.now() - self.begun - self.excluded, 0.0) / steps * max(self.total - self.done, 0)
