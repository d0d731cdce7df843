"""What every search begins with: the known parameters alone, all candidates screened on top; then single effects."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.beam import CLOSE
from bayessim_mjx.diagnosis.selection.bounds import widen_leading
from bayessim_mjx.diagnosis.selection.budget import KNOWN, SCREENING, SINGLES
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.pool import AFRESH, Pool, Progress, fit_models, polish
from bayessim_mjx.diagnosis.selection.screen import SIZES, Screened, screen
from bayessim_mjx.diagnosis.selection.tried import Settings

FEW = 4  # single effects that are fitted, for the table, where nothing is to be explained
# Single effects that are fitted alone: LEAST of them in the order of their screening, whatever they promise, and those
# that promise more than the share WORTH of the best. Of 26 recorded cases the true one was among the first three; with
# both rules 20 of 21 fresh single effects were named or told (benchmarks/results.md, 2e04a14).
LEAST = 8
WORTH = 0.02
# and so many of them however little they promise beside what was proposed: a promise is linear, and of an effect a
# hundred times the noise a share remains (of those 26 cases the true one was among the first three)
SURE = 3
# What a fit of a single effect from one start takes of simulations of all windows, about; further starts of an effect.
SIMULATIONS, OTHERS = 40, 3


def begin(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    criteria: Criteria,
    say: Progress = lambda text, done, total: None,
    keep: Callable[[Pool], None] = lambda pool: None,
) -> Pool:
    """The pool with the known parameters; `keep` is called with it after each part, also of what follows."""

    def in_time(made: int, fits: Sequence[Fit], running: Sequence[int]) -> Sequence[int]:
        return () if made > 1 and settings.budget.over(KNOWN) else running

    say("compiling the simulator", 0, 1)
    nominal = fitter.begin(fitter.base)
    settings = replace(settings, budget=settings.budget.searching())
    say("known parameters", 0, 1)
    began, before = settings.budget.now(), fitter.simulator.rollouts
    fit = nominal
    for _ in range(2):  # the second time from start states' columns of its own
        (fit,) = fitter.iterate([replace(fit, **AFRESH)], 10, lambda f: range(len(f.coordinates)), keep=in_time)
        fit = fitter.refresh(fit)
        if settings.budget.over(KNOWN):
            break
    base = scored(fitter, fit, ())
    each = (settings.budget.now() - began) / max(fitter.simulator.rollouts - before, 1)
    settings = _affordable(candidates, settings, each, fit)
    pool = Pool(fitter, candidates, settings, criteria, nominal, base, keep=keep)
    if pool.rough:
        (pool.base,) = polish(pool, [base])
        fit = pool.base.fit
    pool.models[frozenset()] = pool.base
    keep(pool)
    over = functools.partial(settings.budget.over, SCREENING) if settings.budget.limited else None
    pool.screened = screen(fitter, pool.begun(fit), candidates, settings.screened, say, pool.secants, over)
    return pool


def fit_singles(pool: Pool, say: Progress = lambda text, done, total: None) -> None:
    """Single effects in the pool: the first ones, and those that promise to come near what is fitted already."""
    if not pool.above_noise(pool.base):
        fit_models(pool, [(pool.base, s) for s in pool.screened[:FEW]], SINGLES, say)
        return
    near = CLOSE * min(m.total for m in pool.models.values())
    ranked = promising(pool.screened, pool.settings)
    some = [s for i, s in enumerate(ranked) if i < SURE or pool.base.total - s.gain < near]
    fit_models(pool, [(pool.base, s) for s in some], SINGLES, say)
    widen_leading(pool, say)
    pool.keep(pool)


def promising(screened: Sequence[Screened], settings: Settings) -> list[Screened]:
    """Candidates that are fitted alone: those that come first whatever they promise, then the best of the screening."""
    led = [s for s in screened if s.candidate.label in settings.first]
    others = [s for s in screened if s.gain > 0 and s.candidate.label not in settings.first]
    best = max((s.gain for s in others), default=0.0)
    kept = [s for i, s in enumerate(others) if i < LEAST or s.gain > WORTH * best]
    return [*led, *kept][: max(settings.singles, len(led))]


def _affordable(candidates: Sequence[Candidate], settings: Settings, seconds: float, fit: Fit) -> Settings:
    """Fewer windows to screen on, and fewer single effects and starts of each, where time is limited.

    Args:
        seconds: that a simulation of a window took in this fit.
    """
    budget = settings.budget
    if not budget.limited:
        return settings
    seconds = max(seconds, 1e-9)
    points = max(sum(len(c.probes) for c in candidates), 1)
    windows = budget.left(SCREENING) / seconds / points
    starts = int((budget.left(SINGLES) - max(budget.left(SCREENING), 0.0)) / (SIMULATIONS * len(fit.r) * seconds))
    return replace(
        settings,
        screened=int(min(max(windows, SIZES.fewest), settings.screened)),
        singles=min(max(starts, SURE), settings.singles),
        starts=min(max(starts - settings.singles, 0) // OTHERS, settings.starts),
    )
