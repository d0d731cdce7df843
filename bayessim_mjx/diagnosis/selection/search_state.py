"""The state of a search: all models fitted to one set of windows, compared with the noise and with the base model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.simulable import contacts
from bayessim_mjx.diagnosis.gap import Gap
from bayessim_mjx.diagnosis.selection.budget import Budget
from bayessim_mjx.diagnosis.selection.models import Key, Model
from bayessim_mjx.diagnosis.selection.screen import Screened, Secants

FLOOR = 1.3  # noise standard deviations (rms) up to which an error needs no explanation; docs/decisions/at_noise.md
EXPECTED = 1.0  # prior number of effects that a simulator lacks; no effect is as likely as one
LEFT = 1.0  # mean square of start states, in their variances, from which fits with contacts begin at measured ones
ASTRAY = 10.0  # noise standard deviations (rms) from which on a fit's derivatives change at every step


@dataclass(frozen=True)
class Settings:
    """Budgets of the search, by the robot's size.

    Attributes:
        screened: windows used in screening; iterations, tolerance: of a fit.
        fresh: base columns are differenced again during a fit if there are at most so many.
        budget: time that the search may take.
        believed: share of the noise (rms) that is the sensors'; the rest bounds the error of the time step.
    """

    screened: int = 96
    iterations: int = 12
    tolerance: float = 5e-3
    fresh: int = 6
    believed: float = 1.0
    budget: Budget = Budget()


@dataclass(eq=False)
class SearchState:
    """What a search has fitted so far.

    Attributes:
        nominal: the simulator as delivered; base: the known parameters alone; models: by the labels of their effects.
        screened: the candidates' best starting points; secants: what each point does to some windows.
        cut_short: labels of candidates for which no time was left; skipped: {part of the search: models for which none
            was}.
        vain: sets that gained too little on some windows to be fitted on all.
        keep: called with the state after each batch of fits.
    """

    fitter: Fitter
    candidates: Sequence[Candidate]
    settings: Settings
    nominal: Fit
    base: Model
    models: dict[Key, Model] = field(default_factory=dict)
    screened: list[Screened] = field(default_factory=list)
    cut_short: set[str] = field(default_factory=set)
    skipped: dict[str, int] = field(default_factory=dict)
    vain: set[Key] = field(default_factory=set)
    keep: Callable[[SearchState], None] = lambda state: None
    secants: Secants = field(default_factory=Secants)
    _measured: dict[Fit, Fit] = field(default_factory=dict, repr=False)

    @property
    def noise(self) -> float:
        """Expected cost of a window under a perfect model."""
        return float(self.fitter.size)

    def above_noise(self, model: Model) -> bool:
        """Whether the model's held-out error needs an explanation.

        The error of the time step may be smaller than its bound, so a model with effects has to reach the sensors'
        noise alone.
        """
        return self.gap(model).rms > FLOOR * (self.settings.believed if model.effects else 1.0)

    def gap(self, model: Model) -> Gap:
        """The gap between the base model and `model`, on held-out windows."""
        return Gap(self.base.total, model.total, self.noise * len(model.cost))

    def log_prior(self, key: Key) -> float:
        """`log_prior` of a set of effects, with the candidates of this search."""
        return log_prior(key, len(self.candidates))

    @property
    def rough(self) -> bool:
        """Whether something can touch: columns then hold only nearby, and fits need new ones at every step."""
        return contacts(self.fitter.simulator.physics)

    def begun(self, fit: Fit) -> Fit:
        """The fit from which models with more effects begin: with contacts at measured start states, if it left them.

        A fit that lacks an effect may move its start states farther than their noise. Over contacts no step leads back,
        and the effect would find nothing to explain.
        """
        if not self.rough or np.mean((fit.offsets / self.fitter.spread) ** 2) < LEFT:
            return fit
        if fit not in self._measured:
            self._measured[fit] = self.fitter.begin(fit.coordinates, fit.values)
        return self._measured[fit]

    def fresh(self, fit: Fit) -> list[int]:
        """Columns to difference again: effects' at every step, known parameters' at every third if they are few.

        Far from the logs, where columns change at every step, known parameters' at every step too.
        """
        base = len(self.fitter.base)
        turn = base <= self.settings.fresh and (self.astray(fit) or len(fit.history) % 3 == 0)
        return list(range(0 if turn else base, len(fit.coordinates)))

    def astray(self, fit: Fit) -> bool:
        """Whether a fit is so far from the logs that its derivatives hold only where it is."""
        return fit.cost > ASTRAY**2 * self.noise * len(fit.r)


def log_prior(key: Key, candidates: int) -> float:
    """Log prior of a set of effects over no effect: every candidate is missing with the same small probability."""
    odds = EXPECTED / max(candidates - EXPECTED, 1.0)
    return len(key) * float(np.log(odds))


def ranked(state: SearchState, size: int | None = None) -> list[Model]:
    """Fitted models by held-out error, best first; size: only those with so many effects."""
    chosen = [m for m in state.models.values() if size is None or len(m.effects) == size]
    return sorted(chosen, key=lambda m: m.total)
