"""Models that were tried on the same windows, and how they compare with the noise and with the base model."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.gap import Gap
from bayessim_mjx.diagnosis.selection.budget import Budget
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.screen import Screened

FLOOR = 1.3  # noise standard deviations (rms): an error within it is not worth explaining; a rule of thumb


@dataclass(frozen=True)
class Settings:
    """Budgets of the search, by the robot's size.

    Attributes:
        screened: windows looked at in screening; iterations, tolerance: of a fit.
        fresh: base columns are differenced anew if there are at most so many.
        budget: time that the search may take.
        believed: share of the noise (rms) that is the sensors'; the rest is what the time step may be worth at most.
    """

    screened: int = 96
    iterations: int = 12
    tolerance: float = 5e-3
    fresh: int = 6
    believed: float = 1.0
    budget: Budget = Budget()


class Tried:
    """What was tried, by a search that goes on or that has ended.

    Attributes:
        nominal: the simulator as delivered; base: the known parameters alone; models: by the labels of their effects.
        cut_short: labels of candidates for which no time was left; skipped: {part of the search: models for which none
            was}.
    """

    fitter: Fitter
    candidates: Sequence[Candidate]
    settings: Settings
    nominal: Fit
    base: Model
    models: Mapping[frozenset[str], Model]
    screened: Sequence[Screened]
    cut_short: Collection[str]
    skipped: Mapping[str, int]

    @property
    def noise(self) -> float:
        """Expected cost of a window under a perfect model."""
        return float(self.fitter.size)

    def above_noise(self, model: Model) -> bool:
        """Whether the model's held-out error is worth explaining.

        Errors of the time step may be smaller than feared: what has effects already has to reach the sensors' noise.
        """
        return self.gap(model).rms > FLOOR * (self.settings.believed if model.effects else 1.0)

    def gap(self, model: Model) -> Gap:
        """From the base model to `model`, held out."""
        return Gap(self.base.total, model.total, self.noise * len(model.cost))


def ranked(tried: Tried, size: int | None = None) -> list[Model]:
    """Models tried, best first; `size`: those of so many effects."""
    chosen = [m for m in tried.models.values() if size is None or len(m.effects) == size]
    return sorted(chosen, key=lambda m: m.total)
