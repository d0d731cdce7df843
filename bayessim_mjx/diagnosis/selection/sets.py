"""The posterior over sets of effects, from their evidence alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

Key = frozenset[str]
EXPECTED = 1.0  # effects that a simulator lacks, before any log is seen; the known parameters alone are as likely as one


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
class Weighed:
    """Posterior probabilities of the sets that were fitted, most likely first.

    Sets with an effect that does not matter are no explanations of their own: they are left out.

    Attributes:
        weight: {set: probability}; nats: {set: log of evidence and prior over those of the known parameters alone}.
    """

    weight: Mapping[Key, float]
    nats: Mapping[Key, float]

    @property
    def answer(self) -> Key:
        return next(iter(self.weight))


def core(key: Key, excess: Mapping[Key, float]) -> Key:
    """The least subset of a set that leaves no relevant part of the gap more.

    Args:
        excess: {set: held-out squared error above the noise, in noise variances}, of all sets that were fitted.
    """
    limit = excess[key] + RELEVANCE.noise + RELEVANCE.share * max(excess[frozenset()], 0.0)
    enough = [k for k in excess if k <= key and excess[k] <= limit]
    return min(enough, key=lambda k: (len(k), excess[k], sorted(k)))


def weighed(evidence: Mapping[Key, float], excess: Mapping[Key, float], candidates: int) -> Weighed:
    """The posterior; `evidence` and `excess` (see `core`) have the empty set, the known parameters alone."""
    own = {k: excess[k] for k in evidence}
    total = {k: e + log_prior(k, candidates) for k, e in evidence.items() if core(k, own) == k}
    base, best = total[frozenset()], max(total.values())
    each = {k: float(np.exp(t - best)) for k, t in total.items()}
    whole = sum(each.values())
    order = sorted(total, key=lambda k: (-total[k], len(k), sorted(k)))
    return Weighed({k: each[k] / whole for k in order}, {k: total[k] - base for k in order})
