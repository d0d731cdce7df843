"""All numbers of the search that somebody chose: beliefs and limits that decide answers, and effort.

docs/decisions/numbers.md has each with its source and with the answers that change where it is halved or doubled. What
`selection` and `evidence` have besides are ends and steps of numerical grids, beside the formula that needs them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Priors:
    """What is believed before any data are seen; docs/decisions/numbers.md.

    Attributes:
        expected: number of effects that a simulator lacks; no effect is as likely as one.
        sizes: of an effect, shares of its range that are as likely. Nobody knows the size of what is missing (Jeffreys,
            Theory of Probability, 1961, sec. 3.1). Of 120 logs of noise one useless number gains two nats in one, four
            numbers in none (23a3163). Upwards a range grows by as much as the last is below 1.
        least: share of a joint's force scale (N m or N) that the best law leaves: two integrators of one robot differ
            by as much. The force scale itself is the largest missing force that is usual.
        noise: standard deviation of the logarithm of the sensors' noise about its estimate from the logs. Not measured.
        times: s of each s between rows, to which times agree between simulators. Measured: .07 of a time step of half a
            period, single effects in MuJoCo C at a tenth of the step.
        laws: share of the distance from neutral, to which other numbers of a law agree between simulators. Measured:
            with it 235 of 263 recorded 90 % intervals hold (249db4c), without it 209, with twice as much 245.
    """

    expected: float = 1.0
    sizes: tuple[float, ...] = (1.0, 0.1, 0.01)
    least: float = 3e-4
    noise: float = 0.2
    times: float = 0.03
    laws: float = 0.01

    @property
    def usual(self) -> float:
        """Median of the missing force's amplitude: between the least and the force scale itself."""
        return math.sqrt(self.least)

    @property
    def spread(self) -> float:
        """Standard deviation of its logarithm: both ends are two of them off."""
        return -math.log(self.least) / 4


@dataclass(frozen=True)
class Relevance:
    """How much an effect has to change to be relevant, however significant (docs/decisions/relevance_and_odds.md).

    Attributes:
        share: of the squared gap that the known parameters leave; laws of two simulators differ by as much. Also of a
            fit's cost, that a step has to gain.
        noise: noise variances, which are added; less does not show in the motion.
    """

    share: float = 0.003
    noise: float = 0.1


@dataclass(frozen=True)
class Odds:
    """Odds between two explanations (Kass and Raftery, J. Am. Stat. Assoc. 90, 1995, sec. 3.2).

    Attributes:
        mention: below it the difference is not worth more than a bare mention: the simpler one is named.
        strong: below it the evidence is not "strong": both stand.
    """

    mention: float = 3.0
    strong: float = 20.0


@dataclass(frozen=True)
class Effort:
    """How much is fitted and simulated; docs/decisions/numbers.md has the answers that more or less changes.

    Attributes:
        sets: that a round fits around a set, with one, two and three effects more. Of as many as the first those within
            `margin` are brought to convergence, as many as it has entries may widen their ranges, as many as in all are
            fitted in lockstep; so many places are screened closely.
        rounds: of whatever is repeated until it gains nothing, at most; steps on some of the windows.
        margin: nats below the leading set, within which a promised set is fitted, and a fit goes on.
        windows: that screening simulates. Half of them rank starts, where there are as many.
        steps: of a fit at most; it ends before where a step gains an irrelevant share of its cost (`Relevance.share`).
        close: times the best cost, up to which a fit on some windows goes on.
    """

    sets: tuple[int, ...] = (6, 4, 2)
    rounds: int = 5
    margin: float = 30.0
    windows: int = 48
    steps: int = 12
    close: float = 4.0

    @property
    def batch(self) -> int:
        """Models that are fitted in lockstep, candidates that a look at a set simulates."""
        return sum(self.sets)

    @property
    def points(self) -> int:
        """Starting points of each of these candidates: as many in all as windows."""
        return self.windows // self.batch


PRIORS, RELEVANCE, ODDS, EFFORT = Priors(), Relevance(), Odds(), Effort()
# Share of what an effect does, squared and in noises, from which on refitting other parameters hides it. A rule of
# thumb: how often a hidden effect is reported has not been counted.
HIDDEN = 0.98
FLOOR = 1.3  # noise standard deviations (rms) up to which an error needs no explanation; docs/decisions/at_noise.md


# Time that a search may take: each part has its share, and later parts are cut before earlier ones


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
