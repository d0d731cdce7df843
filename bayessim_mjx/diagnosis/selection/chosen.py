"""The selection by one decision: single effects, the beam search, and what it decides as a ruling."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import beam, search
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import Alternative, Selection, closed_elsewhere, order
from bayessim_mjx.diagnosis.selection.fits import Fits
from bayessim_mjx.diagnosis.selection.race import Progress, Race, compatible, special_cases
from bayessim_mjx.diagnosis.selection.tried import Settings
from bayessim_mjx.diagnosis.selection.verdict import Rival, Ruling

TOLD = 8  # rivals of one effect, single ones first


def run(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    criteria: Criteria,
    say: Progress,
    keep: Callable[[Race], None] = lambda race: None,
) -> tuple[Race, Ruling]:
    """The race of single effects, the search from there, and its ruling; `keep` is called after each stage."""
    race = search.begin(fitter, candidates, settings, say, keep)
    ruling, _ = ruled(race, criteria, say)
    keep(race)
    return race, ruling


def ruled(race: Race, criteria: Criteria, say: Progress) -> tuple[Ruling, Selection]:
    """What one decision makes of a race whose single effects are fitted."""
    selection = beam.search(Fits(race, say), criteria)
    race.winner = race.models[selection.answer]
    rivals = {e.label: _rivals(race, e, selection) for e in race.winner.effects}
    table = selection.table
    elsewhere = closed_elsewhere(table, order(table.laws), criteria) if selection.answer else float("nan")
    return Ruling(race.winner, rivals, elsewhere), selection


def _rivals(race: Race, effect: Candidate, selection: Selection) -> list[Rival]:
    """What may stand in an effect's place, the fewest effects first."""
    found = [a for a in selection.rivals if effect.label not in a.key and a.key - selection.answer]
    return [_rival(race, effect, a, selection) for a in found[:TOLD]]


def _rival(race: Race, effect: Candidate, found: Alternative, selection: Selection) -> Rival:
    model = race.models[found.key]
    others = tuple(e for e in model.effects if e.label not in selection.answer)
    contains = any(effect.effect in special_cases(o) and o.where == effect.where for o in others)
    same = any(o.effect == effect.effect and not compatible(o, effect) for o in others)
    behind = max(race.closure(race.winner) - found.closed, 0.0)
    why = phrases.CONTAINS if contains else phrases.close_by(found.nats, behind)
    return Rival(others, model, found.closed, why, contains or same, found.nats)
