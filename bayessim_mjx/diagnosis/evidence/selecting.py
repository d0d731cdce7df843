"""The selection by evidence: from candidates to the answer, what stands beside it, and their probabilities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from bayessim_mjx.diagnosis.evidence.search import Search
from bayessim_mjx.diagnosis.selection.sets import Key, Weighed
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import heldout, singles
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import Alternative, Decision
from bayessim_mjx.diagnosis.selection.fits import Fits
from bayessim_mjx.diagnosis.selection.pool import Pool, Progress
from bayessim_mjx.diagnosis.selection.selected import Selection, concluded
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried

ODDS = 20.0  # a set that is less likely than the answer by this factor does not stand beside it


def select(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    criteria: Criteria,
    say: Progress,
    keep: Callable[[Tried], None] = lambda tried: None,
) -> Selection:
    """What the logs on the windows of `fitter` call for; `keep` is called with what was tried so far."""
    pool = singles.begin(fitter, candidates, settings, criteria, say, keep)
    search = Search(pool, say)
    found = search.run()
    keep(pool)
    answer = found.answer
    if answer:
        (pool.models[answer],) = heldout.refitted(fitter, [pool.models[answer]])
    selection = concluded(pool, decided(pool, found, say), say)
    return replace(selection, weighed=found)


def decided(pool: Pool, found: Weighed, say: Progress) -> Decision:
    """The most likely set, and the others that are not much less likely, as a decision."""
    table = Fits(pool, say).table
    answer = found.answer
    others = [k for k, w in found.weight.items() if k and k != answer and w * ODDS > found.weight[answer]]
    rivals = tuple(_alternative(k, answer, found, table.closed(k)) for k in others if not answer < k)
    return Decision(answer, answer, rivals, table)


def _alternative(key: Key, answer: Key, found: Weighed, closed: float) -> Alternative:
    return Alternative(key, found.nats[answer] - found.nats[key], closed)
