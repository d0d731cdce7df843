"""What would not show beside the named effects: other effects whose work their own parameters can do.

A bias beside a spring moves the spring's angle of rest; viscous friction beside friction by direction is part of it. No
logs of this kind tell whether both are there: the law that is named stands for them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.selection.laws import compatible
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Pool
from bayessim_mjx.diagnosis.selection.screen import Progress, judged, looked_at, projected, simulated

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """Shares of what an effect does, squared and in noises, that refitting other parameters hides.

    Rules of thumb: how often a hidden effect is told has not been counted.

    Attributes:
        hidden: at every starting point beside the answer, or more.
        shown: at one starting point beside the known parameters alone, or less.
        perhaps: by what was simulated on the known parameters: from here on it is simulated on the answer.
        most: candidates that are simulated; points: starting points of each, those that show most.
    """

    hidden: float = 0.98
    shown: float = 0.9
    perhaps: float = 0.8
    most: int = 16
    points: int = 4


LIMITS = Limits()


def beside(pool: Pool, answer: Model, say: Progress = lambda text, done, total: None) -> tuple[str, ...]:
    """Labels of candidates that would not show beside the answer's effects, but do without them."""
    if not answer.effects or not pool.secants.columns:
        return ()
    others = [c for c in pool.candidates if c.label in pool.secants.columns]
    others = [c for c in others if all(compatible(c, e) for e in answer.effects)]
    alone, likely = _shown(pool, pool.base, others), _shown(pool, answer, others)
    some = [c for c in others if alone[c.label][0][0] < LIMITS.shown and likely[c.label][0][0] > LIMITS.perhaps]
    some = sorted(some, key=lambda c: -likely[c.label][0][0])[: LIMITS.most]
    plans = [(i, point) for i, c in enumerate(some) for _, point in likely[c.label][: LIMITS.points]]
    own = looked_at(answer.fit, pool.settings.screened)
    columns = simulated(pool.fitter, answer.fit, some, plans, own, lambda _, done, all_: say("hidden", done, all_))
    found = judged(pool.fitter, answer.fit, some, columns, own)
    return tuple(some[i].label for i, each in found.items() if min(s.absorbed for s, _ in each) > LIMITS.hidden)


def _shown(pool: Pool, model: Model, candidates: Sequence[Candidate]) -> dict[str, list[tuple[float, Array]]]:
    """{label: (share that is hidden, starting point)}, what shows most first, without a simulation."""
    found = projected(pool.fitter, model.fit, candidates, pool.secants)
    each = {candidates[i].label: [(s.absorbed, point) for s, point in several] for i, several in found.items()}
    return {label: sorted(several, key=lambda pair: pair[0]) for label, several in each.items()}
