"""Time that a search may take: each part has its share, and later parts are cut before earlier ones."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

Progress = Callable[[str, int, int], None]  # (what is being done, done, total)

# Share of the time at which a part ends, so that those after it have theirs; what follows the search has the rest.
# Of the time that is there once the simulator is compiled: nothing cuts what comes before.
# A choice: what a search that was cut misses was not counted.
KNOWN = "known parameters"  # their fit ends there, wherever it came to: on a stiff arm it alone took longer than all
SCREENING, SINGLES, TOGETHER = "screening", "single effects", "effects together"
LEAVING_OUT = "leaving out"  # the last part: what is named with each effect left out, simulated held out
ENDS = {
    KNOWN: 0.1, SCREENING: 0.18, SINGLES: 0.3, TOGETHER: 0.45, LEAVING_OUT: 0.68,
}  # fmt: skip

ROOM = 0.8  # of the time, after which nothing is begun that can be left out: whole logs of a stiff arm took a fifth


@dataclass(frozen=True)
class Budget:
    """Until when the search may go on.

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
        """Whether nothing should begin that a verdict can do without: it compiles programs of its own."""
        return self.spent > ROOM * self.seconds

    def searching(self) -> Budget:
        """The same for a search that begins now."""
        return replace(self, fixed=min(self.spent, self.seconds)) if self.limited else self

    def left(self, part: str) -> float:
        """Seconds until a part has to end; infinite where there is no limit."""
        if not self.limited:
            return self.seconds
        return self.fixed + (self.seconds - self.fixed) * ENDS[part] - self.spent

    def over(self, part: str) -> bool:
        """Whether a part has had its time."""
        return self.left(part) <= 0.0


def begun(minutes: float | None) -> Budget:
    """A budget that begins now; None: no limit."""
    return Budget() if minutes is None else Budget(60.0 * minutes, time.monotonic())
