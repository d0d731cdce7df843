"""Time that a search may take: each part has its share, and later parts are cut before earlier ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

Progress = Callable[[str, int, int], None]  # (what is being done, done, total)

KNOWN = "known parameters"  # on a stiff arm this fit alone took longer than the whole limit
SCREENING, SINGLES, TOGETHER = "screening", "single effects", "effects together"
LEAVING_OUT = "leaving out"  # the last part: the answer with each of its effects left out
PARTS = (KNOWN, SCREENING, SINGLES, TOGETHER, LEAVING_OUT, "stages", "whole logs")  # whole logs: of a stiff arm a fifth
# Share of the time at which a part of the search ends: all have as much, the last two after the search. It is the time
# that is left once the simulator is compiled: nothing before that is cut. Effects that a search misses when it is cut
# were not counted.
ENDS = {part: (i + 1) / len(PARTS) for i, part in enumerate(PARTS)}


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
        return self.spent > ENDS["stages"] * self.seconds

    def searching(self) -> Budget:
        """Return the budget of a search that begins now."""
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
    """Return a budget that begins now; None: no limit."""
    return Budget() if minutes is None else Budget(60.0 * minutes, time.monotonic())
