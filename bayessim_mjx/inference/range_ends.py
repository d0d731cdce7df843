"""Where a posterior piles up at the wall of a parameter's range: the truth probably lies beyond it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from bayessim_mjx.distributions import Distribution

OUTER = 0.05  # of the range, in unit coordinates: mass of the prior that lies there
PILED = 0.25  # mass of the posterior that does not get there by chance


class Pile(NamedTuple):
    """Mass of a posterior at one wall."""

    name: str
    upper: bool
    mass: float  # within the outer 5 % of the range
    limit: float  # where the wall is

    def sentence(self) -> str:
        side, way = ("upper", "raise") if self.upper else ("lower", "reduce")
        return (
            f"{self.name}: {100 * self.mass:.0f} % of the posterior lies at the {side} end of its range; "
            f"{way} its limit {self.limit:.4g} if that is physically possible"
        )


def piles(posterior: Distribution) -> list[Pile]:
    """Walls at which more than a quarter of the posterior lies, densest at the wall itself; parameters in order."""
    theta, weights = posterior.quadrature()
    u = np.asarray(jax.vmap(posterior.space.to_unit)(theta), np.float64)
    w = np.asarray(weights, np.float64)
    found = []
    for i, name in enumerate(posterior.names):
        for upper in (False, True):
            away = 1 - u[:, i] if upper else u[:, i]
            outer, next_ = w[away <= OUTER].sum(), w[(away > OUTER) & (away <= 2 * OUTER)].sum()
            if outer > PILED and outer > next_:
                limit = (posterior.space.high if upper else posterior.space.low)[i]
                found.append(Pile(name, upper, float(outer), float(limit)))
    return found
