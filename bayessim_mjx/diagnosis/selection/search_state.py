"""The state of a search: all models fitted to one set of windows, compared with the noise and with the base model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.robot import contacts
from bayessim_mjx.diagnosis.selection.models import Key, Model
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, FLOOR, PRIORS, Budget
from bayessim_mjx.diagnosis.selection.screen import Screened, Secants
from bayessim_mjx.diagnosis.statistics import Gap


@dataclass(frozen=True)
class Settings:
    """Budgets of the search, by the robot's size.

    Attributes:
        screened: windows used in screening; iterations: of a fit.
        budget: time that the search may take.
        believed: share of the noise (rms) that is the sensors'; the rest bounds the error of the time step.
    """

    screened: int = EFFORT.windows
    iterations: int = EFFORT.steps
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
        """Return the gap between the base model and `model`, on held-out windows."""
        return Gap(self.base.total, model.total, self.noise * len(model.cost))

    def log_prior(self, key: Key) -> float:
        """`log_prior` of a set of effects, with the candidates of this search."""
        return log_prior(key, len(self.candidates))

    @property
    def rough(self) -> bool:
        """Whether something can touch: columns then hold only nearby, and fits need new ones at every step."""
        return contacts(self.fitter.simulator.physics)

    def begun(self, fit: Fit) -> Fit:
        """Return the fit from which models with more effects begin: with contacts at measured start states.

        A fit that lacks an effect may move its start states farther than their noise. Over contacts no step leads back,
        and the effect would find nothing to explain.
        """
        if (
            not self.rough or np.mean((fit.offsets / fit.spread) ** 2) < 1.0
        ):  # mean square of start states, in variances
            return fit
        if fit not in self._measured:
            self._measured[fit] = self.fitter.begin(fit.coordinates, fit.values)
        return self._measured[fit]

    def fresh(self, fit: Fit) -> list[int]:
        """Columns to difference again at every step: the effects'."""
        return list(range(len(self.fitter.base), len(fit.coordinates)))


def log_prior(key: Key, candidates: int) -> float:
    """Log prior of a set of effects over no effect: every candidate is missing with the same small probability."""
    odds = PRIORS.expected / max(candidates - PRIORS.expected, 1.0)
    return len(key) * float(np.log(odds))


def ranked(state: SearchState, size: int | None = None) -> list[Model]:
    """Fitted models by held-out error, best first; size: only those with so many effects."""
    chosen = [m for m in state.models.values() if size is None or len(m.effects) == size]
    return sorted(chosen, key=lambda m: m.total)
