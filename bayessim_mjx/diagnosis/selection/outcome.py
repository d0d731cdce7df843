"""The whole selection: from candidates to the model that the logs call for, its rivals and its parts, frozen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection import bounds, chosen, heldout, predicted_gain, search, verdict, weak_directions
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.race import Progress, Race
from bayessim_mjx.diagnosis.selection.screen import Screened
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried
from bayessim_mjx.diagnosis.selection.verdict import Rival
from bayessim_mjx.diagnosis.selection.weak_directions import Ridges


@dataclass(frozen=True, eq=False)
class Outcome(Tried):
    """What the selection came to.

    Attributes:
        answer: the model that is named (`base` where nothing is).
        rivals: {label of one of its effects: what may stand in its place}.
        subsets: {labels: the model with these of its effects}, every one refitted; {} of one effect or of too many.
        promised: share of the base model's gap that its effects promised to close before any was fitted, {label: part}.
        along: what was simulated along its weak directions.
        elsewhere: share of the gap closed on operating conditions that had no part in the choice; NaN where that is not
            known.
    """

    fitter: Fitter
    candidates: tuple[Candidate, ...]
    settings: Settings
    nominal: Fit
    base: Model
    models: Mapping[frozenset[str], Model]
    screened: tuple[Screened, ...]
    answer: Model
    rivals: Mapping[str, tuple[Rival, ...]]
    subsets: Mapping[frozenset[str], Model] = field(default_factory=dict)
    promised: tuple[float, Mapping[str, float]] = (0.0, MappingProxyType({}))
    along: Ridges | None = None
    elsewhere: float = float("nan")

    @property
    def ambiguous(self) -> bool:
        """Whether something else than what contains an effect as a special case would do as well."""
        return any(not r.contains for rivals in self.rivals.values() for r in rivals)

    def reopened(self) -> Race:
        """A race that goes on from here."""
        found = dict(self.models), list(self.screened)
        return Race(self.fitter, self.candidates, self.settings, self.nominal, self.base, self.answer, *found)


def select(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    say: Progress,
    keep: Callable[[Tried], None] = lambda tried: None,
    criteria: Criteria | None = None,
) -> Outcome:
    """Race the candidates on the windows of `fitter`.

    Args:
        keep: called with what was tried so far.
        criteria: of one decision over all models tried; None: the rules of the race, step by step.
    """
    if criteria is None:
        race = search.run(fitter, candidates, settings, say, keep)
        race.winner = bounds.widened(race, _verified(race, say), say)
        ruling = verdict.rule(race, say)
    else:
        race, ruling = chosen.run(fitter, candidates, settings, criteria, say, keep)
    return concluded(race, ruling, say)


def concluded(race: Race, ruling: verdict.Ruling, say: Progress) -> Outcome:
    """The outcome of a race: the answer where data and beliefs together put it, and its parts."""
    answer, along = bounds.widened(race, ruling.model, say), None
    if answer.effects:
        answer, along = weak_directions.settled(race.fitter, answer)
        race.models[frozenset(c.label for c in answer.effects)] = race.winner = answer
    subsets = verdict.subsets(race, answer, say) if len(answer.effects) > 1 else {}
    total, each = predicted_gain.promised(race, answer.effects) if answer.effects else (0.0, {})
    found = frozen(race, answer, ruling.rivals)
    return replace(found, subsets=subsets, promised=(total, each), along=along, elsewhere=ruling.elsewhere)


def frozen(race: Race, answer: Model, rivals: Mapping[str, Sequence[Rival]]) -> Outcome:
    """What a race tried, and an answer with its rivals."""
    return Outcome(
        fitter=race.fitter,
        candidates=tuple(race.candidates),
        settings=race.settings,
        nominal=race.nominal,
        base=race.base,
        models=MappingProxyType(dict(race.models)),
        screened=tuple(race.screened),
        answer=answer,
        rivals=MappingProxyType({label: tuple(found) for label, found in rivals.items()}),
    )


def _verified(race: Race, say: Progress) -> Model:
    """The winner without effects that do not help when held-out windows are really simulated (not by linearisation)."""
    fitter, model = race.fitter, race.winner
    if model.effects:
        model = heldout.steadied(fitter, model)
    steps = fitter.simulator.windows.steps
    while model.effects:
        full = heldout.predict(fitter, model).cost(steps).mean()
        smaller = [heldout.steadied(fitter, search.without(race, model, e, say)) for e in model.effects]
        error = [heldout.predict(fitter, m).cost(steps).mean() for m in smaller]
        helps = [statistics.share_of_gap(float(e - full), float(e)) for e in error]
        least = int(np.argmin(helps))
        if helps[least] > race.settings.more / 2:
            return model
        model = smaller[least]
    return model
