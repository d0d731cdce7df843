"""The posterior over sets of effects, from their evidence alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from bayessim_mjx.diagnosis.selection.models import BASE, Key
from bayessim_mjx.diagnosis.selection.numbers import ODDS, RELEVANCE
from bayessim_mjx.diagnosis.selection.search_state import log_prior


@dataclass(frozen=True)
class Weighed:
    """Posterior probabilities of the sets that were fitted, most likely first.

    A set with irrelevant effects is no explanation of its own: it counts for the set without them (`core`). Known
    parameters are averaged over the sets as they are, as an irrelevant effect may take a part of their values.

    Attributes:
        weight: {explanation: probability}; nats: {explanation: log of evidence and prior over those of the known
            parameters alone}. numbers: {set: free numbers of its effects}.
        sets: {set: probability}, every one by itself.
    """

    weight: Mapping[Key, float]
    nats: Mapping[Key, float]
    numbers: Mapping[Key, int]
    sets: Mapping[Key, float]

    @property
    def answer(self) -> Key:
        """Of the sets that are as likely as the most likely one (`Odds.mention`), that with the fewest numbers."""
        return min(self._within(ODDS.mention), key=lambda k: (len(k), self.numbers[k], -self.weight[k], sorted(k)))

    @property
    def beside(self) -> list[Key]:
        """The other sets that the evidence does not speak strongly against, most likely first."""
        return [k for k in self._within(ODDS.strong) if k != self.answer]

    @property
    def possible(self) -> list[Key]:
        """The sets by themselves that the evidence does not speak strongly against, and the answer."""
        best = max(self.sets.values())
        return list(dict.fromkeys([self.answer, *(k for k, w in self.sets.items() if w * ODDS.strong >= best)]))

    def to_dicts(self) -> list[dict[str, Any]]:
        """The sets with 99.9 % of the probability, and the known parameters alone, for JSON."""
        kept, whole = [], 0.0
        for key, weight in self.weight.items():
            kept += [key] if whole < 0.999 or key == BASE else []
            whole += weight
        base = self.nats[BASE]
        return [{"effects": sorted(k), "probability": self.weight[k], "nats": self.nats[k] - base} for k in kept]

    def _within(self, odds: float) -> list[Key]:
        best = max(self.weight.values())
        return [k for k, w in self.weight.items() if w * odds >= best]


def core(key: Key, excess: Mapping[Key, float]) -> Key:
    """The smallest subset of a set that leaves no relevant part of the gap more than the set.

    Args:
        excess: {set: held-out squared error above the noise, in noise variances}, of all sets that were fitted.
    """
    limit = excess[key] + RELEVANCE.noise + RELEVANCE.share * max(excess[BASE], 0.0)
    enough = [k for k in excess if k <= key and excess[k] <= limit]
    return min(enough, key=lambda k: (len(k), excess[k], sorted(k)))


def weighed(
    evidence: Mapping[Key, float], excess: Mapping[Key, float], numbers: Mapping[Key, int], candidates: int
) -> Weighed:
    """The posterior; `evidence` and `excess` (see `core`) have the empty set, the known parameters alone."""
    total = {k: e + log_prior(k, candidates) for k, e in evidence.items()}
    own, of = {k: excess[k] for k in evidence}, dict[Key, list[float]]()
    for key, nats in total.items():
        of.setdefault(core(key, own), []).append(nats - total[BASE])
    explained = {k: float(logsumexp(each)) for k, each in of.items()}
    return Weighed(_shares(explained), dict(explained), numbers, _shares(total))


def _shares(nats: Mapping[Key, float]) -> dict[Key, float]:
    """Probabilities by their logs, the greatest first."""
    whole = logsumexp(list(nats.values()))
    return {k: float(np.exp(nats[k] - whole)) for k in sorted(nats, key=lambda k: (-nats[k], len(k), sorted(k)))}
