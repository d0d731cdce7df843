"""Posteriors of several trajectories, judged and mended where they lie.

A network that is right on average over the prior may be wrong at one place, and alike in all trajectories there: in a
corner of the ranges, which hardly any draw of the prior reaches, it leans towards the middle. A product narrows around
that. So sets are simulated at draws of the product itself. What the products of these sets are off by on average is
what the real one is off by, and it is moved back by as much: the fixed point of indirect inference (Gourieroux, Monfort
and Renault, 1993), whose bias is that of the bootstrap. What is left of their errors is what it is widened by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2, f

from bayessim_mjx.distributions import Distribution, box
from bayessim_mjx.distributions.charts import EDGE, to_chart
from bayessim_mjx.inference.numbers import ALPHA, FEW, TURNS
from bayessim_mjx.inference.product_calibration import FACTORS, Count, Sets, counted, moved, multiplied, stacked

SAME = float((FACTORS[1] / FACTORS[0]) ** 0.5)  # factor between widenings that counts as none: half a step
# error that a product counts as off by, at most, in its chart; source: rule of thumb, not counted
FAR = {"plain": 1.0, "probit": 4.0}

Factors = Sequence[Sequence[Distribution]]
Drawn = Callable[[Distribution, int], tuple[Factors, np.ndarray] | None]


def recalibrated(found: Sets, product: Distribution, drawn: Drawn, components: int) -> Sets:
    """`found`, with what sets at draws of the posterior ask for.

    The posterior is moved and widened as the sets at its draws ask for, and the next sets are at the draws of what came
    of it, until they ask for no more.

    Args:
        found: by `product_calibration.judge`.
        product: of the found.multiplied real trajectories, neither moved nor widened.
        drawn: (posterior, turn) -> factors and thetas of sets at its draws, as `product_calibration.judge` takes
            them; None: none.
        components: of the products.
    """
    n, product = found.multiplied, replace(product, prior_weight=jnp.zeros_like(product.prior_weight))
    for turn in range(TURNS):
        widening, before = found.widening(n), found.move
        simulated = drawn(found.used(product, n), turn)
        if simulated is None:
            break
        one, move, still = judged(*simulated, components, before)
        found = replace(found, near=(*found.near, one), move=move)
        if still and found.widening(n) <= widening * SAME:
            break
    else:
        return replace(found, settled=False)
    return found


def judged(
    factors: Factors, thetas: np.ndarray, components: int, before: np.ndarray | None
) -> tuple[Count, np.ndarray | None, bool]:
    """Judge products of all factors of each set, moved and widened as they ask for.

    Returns:
        The results, each with the move that the other sets ask for: a move that the same sets have chosen fits their
        chance. The move [d]. Whether it differs from the move `before` by no more than chance makes of two means of as
        many errors.
    """
    products = stacked(multiplied(factors, components, [len(factors[0])])[0])
    off = np.asarray(_errors(products, jnp.asarray(thetas, jnp.float32)), float)
    off = np.clip(off, -FAR[products.chart], FAR[products.chart])
    move, cov = mean_error(off)
    moves = [mean_error(np.delete(off, k, axis=0))[0] for k in range(len(off))]
    move = None if all(each is None for each in moves) else move  # as none of them is judged with one
    change = (0.0 if move is None else move) - (0.0 if before is None else before) + np.zeros(off.shape[1])
    squared = float(change @ np.linalg.solve(cov, change)) * len(off) / 2
    apart = stacked([moved(q, own) for q, own in zip(products.split(), moves, strict=True)])
    return counted(len(factors[0]), apart, thetas), move, squared < chi2.isf(ALPHA, len(change))


def count(
    factors: Factors, thetas: np.ndarray, components: int, move: np.ndarray | None, widening: float | None = None
) -> Count:
    """Results of products of all factors of each set with this move [d] and this widening (None: the best)."""
    products = stacked(multiplied(factors, components, [len(factors[0])])[0])
    return counted(len(factors[0]), shifted(products, move), thetas, widening)


def shifted(products: Distribution, move: np.ndarray | None) -> Distribution:
    """Batched products, each `moved`."""
    return products if move is None else stacked([moved(q, move) for q in products.split()])


def mean_error(off: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
    """Mean of the errors [m, d] of m products, None where chance may do that, and their covariance [d, d].

    Hotelling's test; what passes is shrunk by as much as chance adds to it (James and Stein, 1961).
    """
    m, d = off.shape
    mean = off.mean(0)
    cov = np.atleast_2d(np.cov(off.T)) + 1e-12 * np.eye(d)
    if m <= d:
        return None, cov
    statistic = m * float(mean @ np.linalg.solve(cov, mean))
    chance = d * (m - 1) / (m - d)
    if statistic < chance * f.isf(ALPHA, d, m - d):
        return None, cov
    return mean * (1 - chance / statistic), cov


@jax.jit
def _errors(products: Distribution, thetas: jax.Array) -> jax.Array:
    """thetas [m, d] less the means of batched products, where they are not cut off, in coordinates of the chart."""

    def one(q: Distribution, theta: jax.Array) -> jax.Array:
        inside = box.log_masses(q.means, q.scales, FEW) if q.chart == "plain" else jnp.zeros_like(q.logits)
        at = to_chart(jnp.clip(q.space.to_unit(theta), EDGE, 1 - EDGE), q.chart)
        return at - jax.nn.softmax(q.logits + inside) @ q.means

    return jax.vmap(one)(products, thetas)


__all__ = ["count", "judged", "mean_error", "recalibrated", "shifted"]
