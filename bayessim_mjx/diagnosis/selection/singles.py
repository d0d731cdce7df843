"""What every search begins with: the known parameters alone, all candidates screened on top, single effects fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection.bounds import widen_leading
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.pool import Pool, Progress, fit_models, polish
from bayessim_mjx.diagnosis.selection.screen import screen
from bayessim_mjx.diagnosis.selection.tried import Settings

FEW = 4  # single effects that are fitted, for the table, where nothing is to be explained


def begin(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    criteria: Criteria,
    say: Progress = lambda text, done, total: None,
    keep: Callable[[Pool], None] = lambda pool: None,
) -> Pool:
    """The pool with the single effects; `keep` is called with it after the known parameters and at the end."""
    nominal = fitter.begin(fitter.base)
    say("known parameters", 0, 1)
    start = replace(nominal, A=nominal.A.copy())  # in the memory order of later steps: sums round alike
    (fit,) = fitter.iterate([start], 10, lambda f: range(len(f.coordinates)))
    fit = fitter.refresh(fit)
    base = scored(fitter, fit, ())
    pool = Pool(fitter, candidates, settings, criteria, nominal, base)
    if pool.rough:
        (pool.base,) = polish(pool, [base])
        fit = pool.base.fit
    pool.models[frozenset()] = pool.base
    keep(pool)
    say("screening", 0, 1)
    pool.screened = screen(fitter, fit, candidates, settings.screened)
    if not pool.above_noise(pool.base):
        fit_models(pool, [(pool.base, s) for s in pool.screened[:FEW]], "single effects", say)
        return pool
    led = [s for s in pool.screened if s.candidate.label in settings.first]
    others = [s for s in pool.screened if s.gain > 0 and s.candidate.label not in settings.first]
    promising = [*led, *others][: max(settings.singles, len(led))]
    fit_models(pool, [(pool.base, s) for s in promising], "single effects", say)
    widen_leading(pool, say)
    keep(pool)
    return pool
