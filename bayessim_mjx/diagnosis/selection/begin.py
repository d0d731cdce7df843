"""What the search begins with: the known parameters alone, and all candidates screened on top."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.budget import KNOWN, SCREENING
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.pool import AFRESH, Pool, Progress, polish
from bayessim_mjx.diagnosis.selection.screen import SIZES, screen
from bayessim_mjx.diagnosis.selection.tried import Settings


def begin(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
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
    settings = _affordable(candidates, settings, each)
    pool = Pool(fitter, candidates, settings, nominal, base, keep=keep)
    if pool.rough:
        (pool.base,) = polish(pool, [base])
        fit = pool.base.fit
    pool.models[frozenset()] = pool.base
    keep(pool)
    over = functools.partial(settings.budget.over, SCREENING) if settings.budget.limited else None
    pool.screened = screen(fitter, pool.begun(fit), candidates, settings.screened, say, pool.secants, over)
    return pool


def _affordable(candidates: Sequence[Candidate], settings: Settings, seconds: float) -> Settings:
    """Fewer windows to screen on where time is limited; seconds: that a simulation of a window took."""
    budget = settings.budget
    if not budget.limited:
        return settings
    points = max(sum(len(c.probes) for c in candidates), 1)
    windows = budget.left(SCREENING) / max(seconds, 1e-9) / points
    return replace(settings, screened=int(min(max(windows, SIZES.fewest), settings.screened)))
