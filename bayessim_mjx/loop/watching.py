"""What `run` shows of the loop to a person: the part of the round that is going on, and a line for each round."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bayessim_mjx.loop.state import Loop, LoopState, RoundInfo
from bayessim_mjx.progress import Show
from bayessim_mjx.quantities import compact, duration, estimate, is_number, spread

if TYPE_CHECKING:
    from bayessim_mjx.loop.outer_loop import Monitor
    from bayessim_mjx.rl import Policy

MOST = 4  # parameters in the line of a round; no source: they fit on a line of a terminal


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
        """The training of a round begins."""
        self.show(self._of(round_, "training"), 0, self.loop.config.ppo.max_iterations)

    def training(self, round_: int, metrics: dict[str, float], state: LoopState) -> None:
        n = self.loop.config.ppo.max_iterations
        done = int(state.train.iteration) - (n * round_ if self.loop.settings.ftuneRL else 0)
        earned = metrics.get("Train/mean_reward")  # NaN until an episode has ended
        note = f"return {compact(earned)}" if is_number(earned) else ""
        self.show(self._of(round_, "training"), done, n, note)
        if self.monitor is not None:
            self.monitor.training(round_, metrics, state)
        if done >= n:
            self.show(self._of(round_, "evaluation, simulation, inference"), 0, 1)

    def round(self, info: RoundInfo, policy: Policy) -> None:
        if self.monitor is not None:
            self.monitor.round(info, policy)
        self.show.line(line_of(info))


def line_of(info: RoundInfo) -> str:
    """`round 1/2: return -84 +- 5, mass 1.00 +- 0.06, ..., 2 min`: median and 68 % of the narrowest parameters."""
    parts = [f"round {info.round + 1}/{info.rounds}: return {estimate(info.returns.mean(), info.returns.std())}"]
    if info.posterior is not None:
        rows: list[tuple[str, Any]] = sorted(info.posterior.describe().items(), key=lambda row: -row[1]["contraction"])
        parts += [f"{name} {spread(r['median'], r['q16'], r['q84'], r['sd'])}" for name, r in rows[:MOST]]
        parts += [f"and {len(rows) - MOST} more parameters"] if len(rows) > MOST else []
    return ", ".join([*parts, duration(sum(info.seconds.values()))])
