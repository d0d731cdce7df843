"""Models that were tried on the same windows, and how they compare: with the noise, with the base model, in pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.models import Comparison, Model, compare
from bayessim_mjx.diagnosis.selection.screen import Screened


@dataclass(frozen=True)
class Settings:
    """Thresholds and budgets of the race, fixed before any data are seen.

    Attributes:
        relevance: an effect must close this share of the gap above the noise; more: a further effect, of what the
            others leave; least: and of the whole gap; drop: and lower the cost by this share.
        evidence: and gain this many nats plus the logarithm of the number of candidates (family-wise).
        t: and improve windows of all conditions: mean over standard error by conditions, as a normal deviate.
        floor: a model within this factor of the noise (rms) is not improved further.
        believed: share of the noise (rms) that is the sensors'; the rest is what the time step may be worth at most.
        tie: rivals are models whose share of the gap closed is within this of the winner's.
        singles, pairs: how many candidates are fitted, and of how many all pairs; screened: windows looked at in
            screening.
        most: effects in one model; iterations: of a fit; fresh: base columns are differenced anew if
            there are at most so many.
    """

    relevance: float = 0.05
    more: float = 0.15
    least: float = 0.003
    drop: float = 0.03
    evidence: float = 5.0
    t: float = 2.0
    floor: float = 1.3
    believed: float = 1.0
    tie: float = 0.04
    singles: int = 48
    pairs: int = 7
    most: int = 5
    screened: int = 96
    iterations: int = 12
    tolerance: float = 5e-3
    fresh: int = 6
    starts: int = 20


class Tried:
    """What was tried, by a race that goes on or that has ended.

    Attributes:
        nominal: the simulator as delivered; base: the known parameters alone; models: by the labels of their effects.
    """

    fitter: Fitter
    candidates: Sequence[Candidate]
    settings: Settings
    nominal: Fit
    base: Model
    models: Mapping[frozenset[str], Model]
    screened: Sequence[Screened]

    @property
    def noise(self) -> float:
        """Expected cost of a window under a perfect model."""
        return float(self.fitter.size)

    def better(self, old: Model, new: Model) -> Comparison:
        return compare(old, new, self.fitter.simulator.windows.group, self.noise)

    def at_noise(self, model: Model, factor: float = 1.0) -> bool:
        """Whether the model predicts as well as the noise (of `factor` times the variance) allows."""
        return model.total <= factor * self.noise * len(model.cost)

    def above_noise(self, model: Model) -> bool:
        """Whether the model's held-out error is worth explaining.

        Errors of the time step may be smaller than feared: what has effects already has to reach the sensors' noise.
        """
        share = self.settings.believed if model.effects else 1.0
        return model.total > (share * self.settings.floor) ** 2 * self.noise * len(model.cost)

    def closure(self, model: Model) -> float:
        """Share of the base model's squared gap above the noise that `model` closes, held out; at most 1.

        The noise alone is the floor: the best of many models tried is below its own expected error by selection.
        """
        return 1.0 - self.left(model)

    def left(self, model: Model) -> float:
        """Share of the base model's squared gap above the noise that `model` leaves."""
        noise = self.noise * len(model.cost)
        return statistics.share_of_gap(max(model.total - noise, 0.0), self.base.total, noise)

    def _above(self, model: Model) -> float:
        return model.total - self.noise * len(model.cost)


def ranked(tried: Tried, size: int | None = None) -> list[Model]:
    """Models tried, best first; `size`: those of so many effects."""
    chosen = [m for m in tried.models.values() if size is None or len(m.effects) == size]
    return sorted(chosen, key=lambda m: m.total)
