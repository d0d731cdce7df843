"""How logs are cut into windows: how long, how many, and how finely these may be simulated."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.quadratic import RULES
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import Physics


@dataclass(frozen=True)
class Cutting:
    """How logs are cut into windows, and how many are simulated. Choices between seconds and accuracy, not counted.

    Attributes:
        window: s; shorter where contacts make it a lottery (`Discretisation.lottery`).
        limits: (up to so many dofs, windows).
        budget: sub-steps of one simulation of all windows; in proportion less for robots of more than `many` dofs.
        simulations: of all windows, that a whole search takes: where time is limited no finer integrator makes it take
            longer.
        fewest: windows that are simulated whatever the budget.
        least: windows, with fewer nothing can be held out.
    """

    window: float = 0.5
    limits: tuple[tuple[int, int], ...] = ((1, 160), (3, 96), (7, 64), (100, 48))
    budget: int = 24000
    many: int = 3
    simulations: int = 2500
    fewest: int = 24
    least: int = 6

    @property
    def shortest(self) -> float:
        """s, control period, of which the fewest windows take the whole budget; faster logs are resampled."""
        return self.window * self.fewest / self.budget

    def at_most(self, nv: int, quick: bool = False) -> int:
        """Windows of a robot of so many degrees of freedom, whatever its time step."""
        return self.fewest if quick else next(n for dofs, n in self.limits if nv <= dofs)

    def shared(self, effort: int, nv: int) -> int:
        """Return an effort that is as much less as a robot has more than `many` degrees of freedom."""
        return effort * min(self.many, nv) // nv

    def most(self, physics: Physics, length: int, quick: bool = False) -> int:
        """Most windows of so many control steps that are simulated at once."""
        afforded = max(self.fewest, self.shared(self.budget, int(physics.mj_model.nv)) // (length * physics.substeps))
        return min(self.at_most(physics.mj_model.nv, quick), afforded)

    def finest(self, physics: Physics, count: int, length: int) -> int:
        """How many times the sub-steps the budget allows when at most half of `count` windows are given up for it."""
        return max(
            1,
            self.shared(self.budget, int(physics.mj_model.nv))
            // (length * physics.substeps * max(self.fewest, (count + 1) // 2)),
        )


CUTTING = Cutting()


class TooLittleData(Exception):
    """There is something to look at, but not enough to hold anything out; the text says what is missing."""


def too_few(logs: Sequence[Log], dt: float, seconds: float = CUTTING.window, found: int | None = None) -> str:
    """Say how much motion is lacking, with numbers; "" where logs hold enough windows.

    Args:
        dt: s, control period; seconds: of a window; found: windows that were cut, None: as many as fit.
    """
    length = max(round(seconds / dt), RULES.parts)
    steps = [int(log.duration / dt + 1e-6) for log in logs]
    window, longest, count = length * dt, max(steps), sum(n // length for n in steps) if found is None else found
    if longest < length:
        return (
            f"the longest log has {longest * dt:.3g} s; diagnose needs windows of {window:.2g} s, better some seconds"
        )
    if count < CUTTING.least:
        needs = f"{CUTTING.least}, or {CUTTING.least * window:.2g} s of motion, better half a minute"
        return f"the logs hold {count} windows of {window:.2g} s; diagnose needs {needs}"
    return ""


def windows_of(
    physics: Physics,
    logs: Sequence[Log],
    group: str | None,
    use_qvel: bool,
    seconds: float = CUTTING.window,
    first: int = 1,
) -> Callable[..., windows.Windows]:
    """(factor, limit) -> the windows with that many times the sub-steps of `physics`, by default the same ones.

    first: the coarsest factor that will be asked for, for which the number of windows is chosen.
    """
    dt = physics.dt
    length = max(round(seconds / dt), RULES.parts)
    if lacking := too_few(logs, dt, seconds):
        raise TooLittleData(lacking)
    most = CUTTING.most(physics, length)
    own = max(min(CUTTING.fewest, most), most // first)

    @functools.cache
    def cuts(factor: int, limit: int = own, centred: bool = True, late: float = 0.0) -> windows.Windows:
        return windows.cut(
            [log.shifted(late) for log in logs] if late else logs,
            physics.mj_model,
            dt,
            physics.substeps * factor,
            length,
            limit=limit,
            group=group,
            use_qvel=use_qvel,
            centred=centred,
            enough=CUTTING.fewest,
        )

    if lacking := too_few(logs, dt, seconds, len(cuts(1))):
        raise TooLittleData(lacking)
    return cuts
