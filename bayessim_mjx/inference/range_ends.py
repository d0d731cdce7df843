"""Ends of ranges at which a posterior piles up: the truth probably lies beyond them.

The range can then move (compare EDGE, Kamaras et al. 2025, arXiv 2510.26656, which moves the support to where the mode
goes). Here it only grows, so that the prior over it, restricted to the range before, is the prior of before: what was
simulated there stays of use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference.numbers import NEGLIGIBLE
from bayessim_mjx.parameters.ranged import Ranged
from bayessim_mjx.quantities import percent

# mass of the posterior in the outer NEGLIGIBLE of a range, five times that of the prior; source: rule of thumb, not
# counted
PILED = 0.25


@dataclass(frozen=True)
class Pile:
    """Mass of a posterior at one end of a parameter's range.

    Attributes:
        name: of the parameter.
        upper: which end of its range.
        mass: within the outer 5 % of the range.
        limit: where that end is.
        moved: where it is in the next round; None: it was not asked to move.
    """

    name: str
    upper: bool
    mass: float
    limit: float
    moved: float | None = None

    def sentence(self) -> str:
        side, way = ("upper", "raise") if self.upper else ("lower", "reduce")
        text = f"{self.name}: {percent(self.mass)} of the posterior lies at the {side} end of its range; "
        if self.moved is None:
            return text + f"{way} its limit {self.limit:.4g} if that is physically possible"
        if self.moved == self.limit:
            return text + f"its limit {self.limit:.4g} stays: nothing beyond it can be simulated"
        return text + f"its limit moves from {self.limit:.4g} to {self.moved:.4g}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        values = {"name": self.name, "upper": self.upper, "mass": self.mass, "limit": self.limit}
        return values if self.moved is None else {**values, "moved": self.moved}


def piles(posterior: Distribution) -> list[Pile]:
    """List the ends with more than a quarter of the posterior, densest at the end itself; parameters in order."""
    theta, weights = posterior.quadrature()
    u = np.asarray(jax.vmap(posterior.space.to_unit)(theta), np.float64)
    w = np.asarray(weights, np.float64)
    found = []
    for i, name in enumerate(posterior.names):
        for upper in (False, True):
            away = 1 - u[:, i] if upper else u[:, i]
            outer, next_ = w[away <= NEGLIGIBLE].sum(), w[(away > NEGLIGIBLE) & (away <= 2 * NEGLIGIBLE)].sum()
            if outer > PILED and outer > next_:
                limit = (posterior.space.high if upper else posterior.space.low)[i]
                found.append(Pile(name, upper, float(outer), float(limit)))
    return found


def moved(space: Ranged, found: Sequence[Pile], lowest: np.ndarray, highest: np.ndarray) -> tuple[Ranged, list[Pile]]:
    """Move each end by the width of its range, as far as it may; return the next round's space and the piles.

    Widths of a log-uniform prior are those of the logarithm. Physics ends at lowest, highest [d].
    """
    low, high = np.array(space.low, np.float64), np.array(space.high, np.float64)
    new = []
    for pile in found:
        i = space.index(pile.name)
        log = space.parameters[i].prior == "loguniform"
        grown = np.clip(_grown(pile.upper, low[i], high[i], log), lowest[i], highest[i])
        scale = np.log if log else np.asarray
        way = (scale(grown) - scale(pile.limit)) * (1 if pile.upper else -1)
        far = way >= NEGLIGIBLE * (scale(high[i]) - scale(low[i]))
        new.append(replace(pile, moved=float(np.float32(grown)) if far else pile.limit))
    for pile in new:
        assert pile.moved is not None
        (high if pile.upper else low)[space.index(pile.name)] = pile.moved
    return Ranged(space.start, low, high), new


def _grown(upper: bool, low: float, high: float, log: bool) -> float:
    """Move an end by the width of its range; a limit above 0 stays above it, as under a log-uniform prior."""
    if upper:
        return high * high / low if log else high + (high - low)
    if log:
        return low * low / high
    return max(2 * low - high, low * low / high) if low > 0 else 2 * low - high


__all__ = ["Pile", "moved", "piles"]
