"""What `run` shows of the loop to a person: the part of the round that is going on, and a line for each round."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from bayessim_mjx.loop.state import Loop, LoopState, RoundInfo
from bayessim_mjx.progress import Show, Silent
from bayessim_mjx.quantities import compact, duration, estimate, is_number, spread

if TYPE_CHECKING:
    from bayessim_mjx.rl import Policy


class Monitor(Protocol):
    """Observer of the loop while it runs; every method may do nothing."""

    def training(self, round_: int, metrics: dict[str, float], state: LoopState) -> None: ...
    def round(self, info: RoundInfo, policy: Policy) -> None: ...


@runtime_checkable
class PartMonitor(Monitor, Protocol):
    """A monitor that hears of the parts of a round after training too."""

    def part(self, round_: int, name: str) -> None: ...


class Watching:
    """A monitor that shows progress, and passes everything on to the caller's monitor.

    Args:
        show: where to. monitor: of the caller; None: there is none.
    """

    def __init__(self, show: Show, loop: Loop, monitor: Monitor | None):
        self.show, self.loop, self.monitor = show, loop, monitor

    def _of(self, round_: int, part: str) -> str:
        return f"round {round_ + 1}/{self.loop.settings.realIters}: {part}"

    def begin(self, round_: int) -> None:
        """Begin the training of a round."""
        self.show(self._of(round_, "training"), 0, self.loop.config.ppo.max_iterations)

    def training(self, round_: int, metrics: dict[str, float], state: LoopState) -> None:
        n = self.loop.config.ppo.max_iterations
        done = int(state.train.iteration) - (n * round_ if self.loop.settings.ftuneRL else 0)
        earned = metrics.get("Train/mean_reward")  # NaN until an episode has ended
        note = f"return {compact(earned)}" if is_number(earned) else ""
        self.show(self._of(round_, "training"), done, n, note)
        if self.monitor is not None:
            self.monitor.training(round_, metrics, state)

    def part(self, round_: int, name: str) -> None:
        """Begin a part of the round after training."""
        self.show(self._of(round_, name), 0, 1)
        if isinstance(self.monitor, PartMonitor):
            self.monitor.part(round_, name)

    def round(self, info: RoundInfo, policy: Policy) -> None:
        if self.monitor is not None:
            self.monitor.round(info, policy)
        if not isinstance(self.show, Silent):
            self.show.line(line_of(info))


def line_of(info: RoundInfo) -> str:
    """`round 1/2: return -84 +- 5, 2 min, mass 1.00 +- 0.06, ...`: median and 68 % of as many parameters as fit."""
    earned = estimate(info.returns.mean(), info.returns.std())
    line = f"round {info.round + 1}/{info.rounds}: return {earned}, {duration(sum(info.seconds.values()))}"
    if info.posterior is None:
        return line
    room = shutil.get_terminal_size().columns
    for name, r in sorted(info.posterior.describe().items(), key=lambda row: -row[1]["contraction"]):
        longer = f"{line}, {name} {spread(r['median'], r['q16'], r['q84'], r['sd'])}"
        if len(longer) > room:
            return f"{line} ..."
        line = longer
    return line
