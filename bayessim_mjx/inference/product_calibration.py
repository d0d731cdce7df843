"""Posteriors of several trajectories, judged as they are used: products of a network's factors on simulated sets.

A network's errors at one theta are shared by all trajectories there, so a product of n factors narrows as 1 / sqrt(n)
while its bias stays. Sets of trajectories simulated at one theta each show by how much a product is over-confident, and
after how many trajectories another one no longer helps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.compat import program
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference.fit import combine
from bayessim_mjx.inference.numbers import DOUBT, ROUNDED, SURE
from bayessim_mjx.inference.temperature import LEVELS, gain_at, tempered

# factors on standard deviations, tried: 64 sets do not show less than a step, 8.6 %. source: docs/inference.md, several
# trajectories
FACTORS = np.geomspace(1.0, 12.0, 31)


@dataclass(frozen=True)
class Count:
    """Results of posteriors of `trajectories` trajectories each on simulated sets.

    Attributes:
        widening: factor on standard deviations with the highest mean log density at the truths.
        gain: mean log posterior over prior at the truths, nats, so widened, on sets that did not choose the factor.
        error: its standard error.
        plain: the same without widening.
        levels: credible level of each truth [m], widened by the factor of the other sets: uniform where calibrated.
    """

    trajectories: int
    widening: float
    gain: float
    error: float
    plain: float
    levels: np.ndarray

    def coverage(self, level: float) -> float:
        """Share of truths in the region of highest density that should hold `level`."""
        return float(np.mean(self.levels <= level))


@dataclass(frozen=True)
class Sets:
    """The result for n = 1, 2, 4 ... trajectories.

    Attributes:
        counts: on sets at draws of the prior, or of what the round was simulated from.
        near: on sets of the last of these numbers at draws of the posterior itself, one row a turn of
            `local_recalibration.recalibrated`.
        move: [d] by which products there are moved, in the coordinates of their chart; None: not at all.
        known: real trajectories that are multiplied, where they are more than those of a set.
        settled: whether the last sets at the posterior's draws asked for no more.
    """

    counts: tuple[Count, ...]
    near: tuple[Count, ...] = ()
    move: np.ndarray | None = None
    known: int = 0
    settled: bool = True

    @property
    def saturates_at(self) -> int:
        """After how many trajectories another one does not raise the gain any more."""
        best = self.counts[0]
        for one in self.counts[1:]:
            if one.gain > best.gain:
                best = one
        return best.trajectories

    def at(self, trajectories: int) -> Count:
        """Find the row of so many trajectories, or of the next smaller number that was judged."""
        return max((c for c in self.counts if c.trajectories <= trajectories), key=lambda c: c.trajectories)

    def widening(self, trajectories: int) -> float:
        """Factor on standard deviations that a posterior of so many trajectories is used with.

        Beyond the number that was judged the error that trajectories share stays, while their product narrows: b^2 of
        w^2 = 1 + n b^2 is that of the last number, and at least what no sets can tell from nothing, a step of FACTORS.
        """
        one = self.at(trajectories)
        judged = max([one.widening, *(c.widening for c in self.near[-1:] if c.trajectories == one.trajectories)])
        more = trajectories / one.trajectories
        if more <= 1:
            return judged
        return float(np.sqrt(1 + (max(judged, float(FACTORS[1])) ** 2 - 1) * more))

    def used(self, product: Distribution, trajectories: int) -> Distribution:
        """Move and widen a product of so many trajectories' posteriors, as it is used."""
        last = self.counts[-1].trajectories
        here = moved(product, self.move) if self.at(trajectories).trajectories == last else product
        return tempered(here, self.widening(trajectories))

    @property
    def off(self) -> list[tuple[float, float, float]]:
        """(region, share of truths in it, its standard error) where the last count's regions hold too few, at 1 %.

        Where its posterior lies, or else on average over the prior.
        """
        for one in (*self.near[-1:], self.counts[-1]):
            errors = [float(np.sqrt(level * (1 - level) / len(one.levels))) for level in LEVELS]
            held = [(level, one.coverage(level), error) for level, error in zip(LEVELS, errors, strict=True)]
            if found := [row for row in held if row[1] < row[0] - SURE * row[2]]:
                return found
        return []

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        rows = [_plain(c) for c in self.counts]
        numbers = {"carried": self.saturates_at, "sets": len(self.counts[-1].levels), "counts": rows}
        numbers |= {"near": [_plain(c) for c in self.near]}
        numbers |= {"known": self.multiplied, "widening": self.widening(self.multiplied), "settled": self.settled}
        return {**numbers, "move": None if self.move is None else [float(x) for x in self.move]}

    @property
    def multiplied(self) -> int:
        """Number of real trajectories whose posteriors are multiplied."""
        return max(self.known, self.counts[-1].trajectories)

    @property
    def saturation(self) -> str:
        """A sentence on the number of trajectories that sharpen the posterior."""
        last = self.counts[-1].trajectories
        if self.saturates_at == last:
            return f"each of the {last} trajectories sharpened the posterior"
        return f"only {self.saturates_at} of {last} trajectories sharpen the posterior"

    def sentence(self) -> str:
        """One line for a person."""
        last, many = self.counts[-1], self.multiplied
        widening = self.widening(many)
        text = f"with {many} trajectories standard deviations are widened {widening:.2f} times"
        if many > last.trajectories:
            judged = self.widening(last.trajectories)
            text += (
                f" ({judged:.2f} for simulated sets of {last.trajectories}: their error is shared by all trajectories)"
            )
        elif widening > last.widening:
            text += f" ({last.widening:.2f} on average over the prior, more where the posterior lies)"
        if self.move is not None:
            text += "; near the posterior the network is biased; each factor is moved by that bias"
        if not self.settled:
            text += "; the last simulated sets needed more: the product is too narrow"
        if self.saturates_at < last.trajectories:
            text += f"; {self.saturation}"
        return text


def _plain(c: Count) -> dict[str, Any]:
    coverage = {f"{level:g}": c.coverage(level) for level in LEVELS}
    numbers = {"trajectories": c.trajectories, "widening": c.widening, "gain": c.gain, "se": c.error}
    return {**numbers, "coverage": coverage}


def counts_to(trajectories: int) -> list[int]:
    """1, 2, 4, ... up to `trajectories`, which is the last."""
    below = [2**k for k in range(trajectories.bit_length()) if 2**k < trajectories]
    return [*below, trajectories]


def judge(
    factors: Sequence[Sequence[Distribution]],
    thetas: np.ndarray,
    components: int,
    used: Callable[[Distribution], Distribution] = lambda q: q,
    widened_by: Callable[[int], float] | None = None,
) -> Sets:
    """Products of the first 1, 2, 4 ... n factors of each set, judged at the thetas that the sets were simulated at.

    Args:
        factors: m sets of n posteriors of one trajectory each, as they are multiplied in use.
        thetas: [m, d].
        components: of the products.
        used: what else is done to a product before it is used.
        widened_by: the factor that products of n are used with; None: the best is found, by sets it is not judged on.
    """
    rows, counts = [], counts_to(len(factors[0]))
    for n, products in zip(counts, multiplied(factors, components, counts), strict=True):
        given = None if widened_by is None else widened_by(n)
        rows.append(counted(n, stacked([used(q) for q in products]), np.asarray(thetas), given))
    return Sets(tuple(rows))


def multiplied(
    factors: Sequence[Sequence[Distribution]], components: int, counts: Sequence[int]
) -> list[list[Distribution]]:
    """For each n of `counts`, which rise, the products of the first n factors of each set."""

    def one(each: Sequence[Distribution]) -> list[Distribution]:
        alone = [combine([each[0]], components)] if counts[0] == 1 else []
        return alone + (each[0].products(*each[1:], components=components, counts=more) if more else [])

    more = [n for n in counts if n > 1]
    return [list(column) for column in zip(*map(one, factors), strict=True)]


def moved(q: Distribution, move: np.ndarray | None) -> Distribution:
    """Every Gaussian moved by [d] in the coordinates of the chart; as it is where nothing would be left in the box."""
    if move is None:
        return q
    there = Distribution.from_unit(q.space, q.logits, q.means + jnp.asarray(move), q.scales, q.prior_weight, q.chart)
    return there if float(there.log_inside - q.log_inside) > ROUNDED else q


def stacked(items: Sequence[Distribution]) -> Distribution:
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *items)


@jax.jit
def _gains(q: Distribution, thetas: jax.Array) -> jax.Array:
    """Log gain [factors, m] of batched posteriors at thetas [m, d], widened by each of FACTORS."""

    def at(factor: jax.Array) -> jax.Array:
        return jax.vmap(gain_at, in_axes=(0, 0, None))(q, thetas, factor)

    return jax.lax.map(at, jnp.asarray(FACTORS, jnp.float32))


@program
def _levels(q: Distribution, thetas: jax.Array, factors: jax.Array) -> jax.Array:
    return jax.vmap(lambda q, t, f: tempered(q, f).credible_level(t))(q, thetas, factors)


def _best(gains: np.ndarray) -> int:
    """Index of the best of FACTORS for the sets, by gains [factors, m] and the prior on the factor."""
    return int(np.argmax(gains.sum(1) - 0.5 * (np.log(FACTORS) / DOUBT) ** 2))


def counted(n: int, products: Distribution, thetas: np.ndarray, given: float | None = None) -> Count:
    """Results of batched products of n at thetas [m, d], widened by `given` or the best factor of the other half."""
    at = jnp.asarray(thetas, jnp.float32)
    gains = np.nan_to_num(np.asarray(_gains(products, at), float), nan=-100.0, neginf=-100.0)
    part = np.arange(len(thetas)) % 2
    if given is None:
        chosen = np.array([_best(gains[:, part != p]) for p in (0, 1)])[part]
        best = _best(gains)
    else:
        best = int(np.argmin(np.abs(FACTORS - given)))
        chosen = np.full(len(thetas), best)
    own = gains[chosen, np.arange(len(thetas))]
    levels = np.asarray(_levels(products, at, jnp.asarray(FACTORS[chosen], jnp.float32)), float)
    error = float(own.std(ddof=1) / np.sqrt(len(own)))
    return Count(n, float(FACTORS[best]), float(own.mean()), error, float(gains[0].mean()), levels)


__all__ = ["LEVELS", "Count", "Sets", "counted", "counts_to", "judge", "moved", "multiplied", "stacked"]
