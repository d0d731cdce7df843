"""The selection by evidence: from candidates to the answer, what stands beside it, and their probabilities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from bayessim_mjx.diagnosis.evidence.estimates import at_its_mean, estimated
from bayessim_mjx.diagnosis.evidence.search import Search
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import singles
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import Alternative, Decision, closed_elsewhere
from bayessim_mjx.diagnosis.selection.fits import Fits
from bayessim_mjx.diagnosis.selection.pool import Pool, Progress
from bayessim_mjx.diagnosis.selection.selected import Selection, concluded
from bayessim_mjx.diagnosis.selection.sets import Key, Weighed
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried


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
    at_its_mean(search.weighing, found.answer)
    decision = decided(pool, found, say)
    names = np.unique(fitter.simulator.windows.group)
    chosen = {int(g): search.weighing.without(int(g)).answer for g in names} if len(names) > 1 and found.answer else {}
    elsewhere = closed_elsewhere(decision.table, chosen)
    whole = concluded(pool, decision, say, along_ridges=False)
    own = estimated(search.weighing, found)
    return replace(whole, weighed=found, estimated=own, chosen=chosen, elsewhere=elsewhere)


def decided(pool: Pool, found: Weighed, say: Progress) -> Decision:
    """The most likely set, and the others that the evidence does not speak strongly against, as a decision."""
    table = Fits(pool, say).table
    others = [k for k in found.beside if k and not found.answer < k]
    rivals = tuple(_alternative(k, found, table.closed(k)) for k in others)
    return Decision(found.answer, found.answer, rivals, table)


def _alternative(key: Key, found: Weighed, closed: float) -> Alternative:
    return Alternative(key, found.nats[found.answer] - found.nats[key], closed)
