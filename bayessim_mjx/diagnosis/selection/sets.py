"""The posterior over sets of effects, from their evidence alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.selection.accuracy import Posterior

Key = frozenset[str]  # labels of a model's effects
BASE: Key = frozenset()  # the known parameters alone
EXPECTED = (
    1.0  # effects that a simulator lacks, before any log is seen; the known parameters alone are as likely as one
)


def log_prior(key: Key, candidates: int) -> float:
    """Of a set: each of the candidates is missing with the same small probability (so many are expected)."""
    odds = EXPECTED / max(candidates - EXPECTED, 1.0)
    return len(key) * float(np.log(odds))


@dataclass(frozen=True)
class Relevance:
    """What an effect has to change to matter, however surely it is there.

    Attributes:
        share: of the gap's square that the known parameters leave: laws of two simulators differ by as much.
        noise: and so many noise variances: less does not show in the motion.
    """

    share: float = 0.003
    noise: float = 0.1


RELEVANCE = Relevance()


@dataclass(frozen=True)
class Odds:
    """Odds between two explanations (Kass and Raftery, J. Am. Stat. Assoc. 90, 1995, sec. 3.2).

    Attributes:
        mention: below it the difference is not worth more than a bare mention: the simpler one is named.
        strong: below it the evidence is not "strong": both stand.
    """

    mention: float = 3.0
    strong: float = 20.0


ODDS = Odds()


@dataclass(frozen=True)
class Weighed:
    """Posterior probabilities of the sets that were fitted, most likely first.

    Sets with an effect that does not matter are no explanations of their own: they are left out.

    Attributes:
        weight: {set: probability}; nats: {set: log of evidence and prior over those of the known parameters alone}.
        numbers: {set: free numbers of its effects}.
    """

    weight: Mapping[Key, float]
    nats: Mapping[Key, float]
    numbers: Mapping[Key, int]

    @property
    def answer(self) -> Key:
        """Of the sets that are as likely as the most likely one (`Odds.mention`), that with the fewest numbers."""
        return min(self._within(ODDS.mention), key=lambda k: (len(k), self.numbers[k], -self.weight[k], sorted(k)))

    @property
    def beside(self) -> list[Key]:
        """The other sets that the evidence does not speak strongly against, most likely first."""
        return [k for k in self._within(ODDS.strong) if k != self.answer]

    def told(self) -> list[dict[str, Any]]:
        """The sets that hold all but a thousandth of the probability, and the known parameters alone, for JSON."""
        kept, whole = [], 0.0
        for key, weight in self.weight.items():
            kept += [key] if whole < 0.999 or key == BASE else []
            whole += weight
        return [{"effects": sorted(k), "probability": self.weight[k], "nats": self.nats[k]} for k in kept]

    def _within(self, odds: float) -> list[Key]:
        best = max(self.weight.values())
        return [k for k, w in self.weight.items() if w * odds >= best]


@dataclass(frozen=True, eq=False)
class Estimated:
    """Posterior of the answer's numbers.

    Attributes:
        mean: `[k]`, where the fit could not be moved there not its values; covariance: `[k, k]`.
        sheet: the data sheet's accuracies behind it.
        noise: `[C]`, most likely noise of each channel, in what was estimated from the logs.
        step: most probable step `[k]` from the answer's fit, of residuals `[W, n]` at its values.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    sheet: Posterior
    noise: NDArray[np.float64]
    step: Callable[[NDArray[np.float64]], NDArray[np.float64]]


def relevant(sizes: Iterable[float], gap: float) -> bool:
    """Whether every effect of a set matters; where the known parameters alone leave no more than noise, none does.

    Args:
        sizes: by how much each changes the motion, mean square in noise variances.
        gap: squared error that the known parameters leave above the noise, in noise variances.
    """
    least = RELEVANCE.noise + RELEVANCE.share * gap if gap > RELEVANCE.noise else np.inf
    return all(size > least for size in sizes)


def weighed(evidence: Mapping[Key, float], numbers: Mapping[Key, int], candidates: int) -> Weighed:
    """The posterior; `evidence` has the empty set, the known parameters alone."""
    total = {k: e + log_prior(k, candidates) for k, e in evidence.items()}
    base, best = total[BASE], max(total.values())
    each = {k: float(np.exp(t - best)) for k, t in total.items()}
    whole = sum(each.values())
    order = sorted(total, key=lambda k: (-total[k], len(k), sorted(k)))
    return Weighed({k: each[k] / whole for k in order}, {k: total[k] - base for k in order}, numbers)
