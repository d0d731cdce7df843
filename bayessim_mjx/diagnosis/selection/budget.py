"""Time that a search may take: each part has its share, and later parts are cut before earlier ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

Progress = Callable[[str, int, int], None]  # (what is being done, done, total)

# Shares of the time at which a part of the search ends; the stages after the search have the rest. They are shares of
# the time that is left once the simulator is compiled: nothing before that is cut. A choice: the effects that a search
# misses when it is cut were not counted.
KNOWN = "known parameters"  # on a stiff arm this fit alone took longer than the whole limit
SCREENING, SINGLES, TOGETHER = "screening", "single effects", "effects together"
LEAVING_OUT = "leaving out"  # the last part: the answer with each of its effects left out
ENDS = {
    KNOWN: 0.1, SCREENING: 0.18, SINGLES: 0.3, TOGETHER: 0.45, LEAVING_OUT: 0.68,
}  # fmt: skip

ROOM = 0.8  # share of the time after which no optional stage begins: whole logs of a stiff arm took a fifth


@dataclass(frozen=True)
class Budget:
    """The time that a search may take.

    Attributes:
        seconds: for the whole diagnosis; infinite: as long as it takes.
        began: reading of `now` when it began; now: clock in seconds.
        fixed: s that passed until the search could begin.
    """

    seconds: float = float("inf")
    began: float = 0.0
    now: Callable[[], float] = time.monotonic
    fixed: float = 0.0

    @property
    def limited(self) -> bool:
        return self.seconds < float("inf")

    @property
    def spent(self) -> float:
        """Seconds since it began."""
        return self.now() - self.began

    @property
    def late(self) -> bool:
        """Whether it is too late to begin a stage that the verdict does not need: it compiles its own programs."""
        return self.spent > ROOM * self.seconds

    def searching(self) -> Budget:
        """The budget of a search that begins now."""
        return replace(self, fixed=min(self.spent, self.seconds)) if self.limited else self

    def left(self, part: str) -> float:
        """Seconds until a part has to end; infinite where there is no limit."""
        if not self.limited:
            return self.seconds
        return self.fixed + (self.seconds - self.fixed) * ENDS[part] - self.spent

    def over(self, part: str) -> bool:
        """Whether the time of a part is over."""
        return self.left(part) <= 0.0


def begun(minutes: float | None) -> Budget:
    """A budget that begins now; None: no limit."""
    return Budget() if minutes is None else Budget(60.0 * minutes, time.monotonic())
