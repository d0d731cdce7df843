"""Is the posterior as sure as it may be? Ranks, coverage and TARP on held-out pairs, and a verdict in words.

All of it rests on one fact: with theta drawn from the prior and x simulated at it, the rank of theta among draws of an
exact q(theta | x) is uniform, for any function of theta that is ranked (Cook et al. 2006; Talts et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.special import ndtr

from bayessim_mjx.compat import brief
from bayessim_mjx.distributions import Distribution, box
from bayessim_mjx.distributions.evaluate import candidates
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.numbers import ALPHA, DRAWS, FEW, NEGLIGIBLE
from bayessim_mjx.inference.temperature import LEVELS, TEMPERATURES, temperature, widened
from bayessim_mjx.keys import branch
from bayessim_mjx.quantities import MOST, listed, p_value, percent, percent_estimate

FEWEST = round(1 / (1 - LEVELS[-1]))  # pairs that a verdict needs: one of them lies outside the largest region
SHARE = ALPHA / 4  # of each family of tests: bias, spread, HPD levels, ranks
CALIBRATED, OVER, UNDER, BIASED, ODD = "calibrated", "over-confident", "under-confident", "biased", "miscalibrated"
HOW = ("narrow", "wide")  # widths of an over-confident and an under-confident posterior


class Ranks(NamedTuple):
    """Fractional ranks of n truths among posterior draws, uniform on [0, 1] where the posterior is exact."""

    parameters: Array  # [n, d] each parameter: simulation-based calibration
    level: Array  # [n] mass of draws denser than the truth: HPD levels
    tarp: Array  # [n] share of draws nearer to a random point than the truth (Lemos et al. 2023)
    gain: Array  # [n] log q(theta) - log p(theta)
    variance: Array  # [n, d] of the draws, in theta units


@partial(brief, static_argnames="draws")
def ranks(
    key: Array, posteriors: Distribution, thetas: Array, draws: int = FEW, tilt: Distribution | None = None
) -> Ranks:
    """Ranks of thetas [n, d] among up to `draws` of each of n batched posteriors; all pairs in one program.

    `tilt`: the thetas come from it instead of the prior, so they are ranked among draws of q tilt / prior.
    """
    space = posteriors.space.unbatched
    u = jax.vmap(space.to_unit)(thetas)

    def one(key: Array, q: Distribution, theta: Array, u: Array, reference: Array) -> Ranks:
        k_draw, k_tilt, *keys = jax.random.split(key, 5)
        # ranks among a random number of draws are as uniform as among a fixed one
        v, drawn = candidates(q, k_draw, draws)
        kept = drawn.astype(jnp.float32)
        sample = jax.vmap(space.from_unit)(v)
        points = jnp.concatenate([theta[None], sample])
        gain = q.log_gain(points)
        if tilt is not None:
            ratio = tilt.log_gain(points)
            gain = gain + ratio
            kept = kept * (jnp.log(jax.random.uniform(k_tilt, (draws,), minval=1e-7)) < ratio[1:] - jnp.max(ratio[1:]))
        near, far = (jnp.sum((x - reference[None, :]) ** 2, axis=-1, keepdims=True) for x in (v, u[None]))
        parameters = _rank(keys[0], v, u[None, :], kept)
        level = _rank(keys[1], -gain[1:, None], -gain[:1, None], kept)
        tarp = _rank(keys[2], near, far, kept)
        mean = kept @ sample / jnp.maximum(jnp.sum(kept), 1.0)
        variance = kept @ (sample - mean[None, :]) ** 2 / jnp.maximum(jnp.sum(kept) - 1, 1.0)
        return Ranks(parameters, level[0], tarp[0], gain[0], variance)

    # the point that distances are taken to: the truth of another pair, which x says nothing about
    return jax.vmap(one)(jax.random.split(key, u.shape[0]), posteriors, thetas, u, jnp.roll(u, 1, axis=0))


def _rank(key: Array, draws: Array, value: Array, kept: Array) -> Array:
    """Fractional rank of value [1, k] in the kept rows of draws [S, k], ties and gaps broken at random -> [k]."""
    below, equal = kept @ (draws < value).astype(jnp.float32), kept @ (draws == value).astype(jnp.float32)
    return (below + (equal + 1) * jax.random.uniform(key, below.shape)) / (jnp.sum(kept) + 1)


@dataclass(frozen=True)
class Report:
    """Calibration of a posterior on held-out pairs; arrays on the host."""

    names: tuple[str, ...]
    verdict: str  # calibrated, over-confident, under-confident, biased, miscalibrated
    words: str  # the verdict as a sentence
    coverage: dict[float, tuple[float, float]]  # nominal level -> (share of truths in that HPD region, standard error)
    p: dict[str, float]  # Anderson-Darling p-values: of each parameter's ranks, of "HPD level" and "TARP"
    bias: np.ndarray  # [d] standard errors by which the truths lie above the draws
    spread: np.ndarray  # [d] the same for truths too far out: > 0 over-confident
    gain: float  # mean log q(theta) - log p(theta)
    contraction: np.ndarray  # [d] 1 - mean posterior variance / prior variance
    ranks: Ranks
    temperature: float | None = None  # factor on the standard deviations that was applied
    before: str | None = None  # the verdict without it
    widths: tuple[int, ...] = ()  # parameters on whose widths alone an over- or under-confident verdict rests
    predictive: float | None = None  # p-value of the posterior predictive check
    fitted: int = 0  # pairs besides, on which the temperature was fitted

    @property
    def pairs(self) -> int:
        return len(self.ranks.level)

    @property
    def densities(self) -> int:
        """Pairs whose posterior is a density, whatever they were used for."""
        return self.pairs + self.fitted

    def evidence(self) -> str:
        """Return the coverage that the verdict rests on: `HPD coverage 50 %: 49 ± 2 %, 80 %: ...`.

        The regions of all parameters may hold enough where one parameter's intervals do not: then these.
        """
        if not self.widths:
            return _covered("HPD coverage", self.coverage)
        return "; ".join(_covered(what, shares) for what, shares in self.interval_coverage().items())

    def intervals(self) -> dict[str, np.ndarray]:
        """Masses [n] of the smallest central intervals that hold the truths, of parameters with a wrong width."""
        away = 2 * np.abs(np.asarray(self.ranks.parameters, np.float64) - 0.5)
        return {self.names[i]: away[:, i] for i in self.widths[:MOST]}

    def interval_coverage(self) -> dict[str, dict[float, tuple[float, float]]]:
        """Count these intervals: {what: {nominal level: (share of truths inside, standard error)}}."""
        error = {a: float(np.sqrt(a * (1 - a) / self.pairs)) for a in LEVELS}
        return {
            f"intervals of {name}": {a: (float(np.mean(masses <= a)), error[a]) for a in LEVELS}
            for name, masses in self.intervals().items()
        }

    @property
    def limit(self) -> float:
        """p-value of ranks below which they are a fault: all tests together find one by chance in ALPHA of cases."""
        return SHARE / len(self.p)

    @property
    def moment_limit(self) -> float:
        """The same of the mean of a parameter's ranks, and of their spread."""
        return SHARE / len(self.names)

    def moments(self) -> dict[str, str]:
        """{parameter: `spread p = 0.0004`} where mean or spread of its ranks is a fault, which their curve may hide."""
        found = {}
        for name, bias, spread in zip(self.names, self.bias, self.spread, strict=True):
            p, what = min((_two_sided(bias), "mean"), (_two_sided(spread), "spread"))
            if p < self.moment_limit:
                found[name] = f"{what} {p_value(p)}"
        return found

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        return {
            "verdict": self.verdict, "words": self.words, "pairs": self.pairs, "p": self.p, "gain": self.gain,
            "coverage": {f"{a:g}": {"observed": c, "se": s} for a, (c, s) in self.coverage.items()},
            "bias": dict(zip(self.names, self.bias.tolist(), strict=True)),
            "spread": dict(zip(self.names, self.spread.tolist(), strict=True)),
            "contraction": dict(zip(self.names, self.contraction.tolist(), strict=True)),
            "temperature": self.temperature, "before": self.before, "predictive": self.predictive,
        }  # fmt: skip


def check(
    key: Array, posteriors: Distribution, thetas: Array, draws: int = FEW, tilt: Distribution | None = None
) -> Report:
    """Judge n batched posteriors by the thetas [n, d] that their data were simulated at; theta ~ prior, or `tilt`.

    Pairs that are not finite are left out; ValueError where hardly any remains.
    """
    found = jax.tree.map(np.asarray, ranks(key, posteriors, jnp.asarray(thetas), draws, tilt))
    return judge(_usable(found), posteriors.space.unbatched)


def _usable(found: Ranks) -> Ranks:
    keep = np.isfinite(found.gain) & np.all(np.isfinite(found.variance), axis=1)
    if keep.sum() < FEWEST:
        raise UserError(f"calibration: {int(keep.sum())} usable pairs; at least {FEWEST} are needed")
    return Ranks(*(part[keep] for part in found))


def judge(found: Ranks, space: Any) -> Report:
    """Make the report on given ranks."""
    n, names = len(found.level), tuple(space.names)
    pit = np.asarray(found.parameters, np.float64)
    coverage = {a: (float(np.mean(found.level <= a)), float(np.sqrt(a * (1 - a) / n))) for a in LEVELS}
    p = {name: uniform_p(pit[:, i]) for i, name in enumerate(names)}
    p |= {"HPD level": uniform_p(np.asarray(found.level)), "TARP": uniform_p(np.asarray(found.tarp))}
    # sd of U is 1/sqrt(12), that of (U - 1/2)^2 is 1/sqrt(180)
    bias = (pit.mean(0) - 0.5) * np.sqrt(12 * n)
    spread = (np.mean((pit - 0.5) ** 2, axis=0) - 1 / 12) * np.sqrt(180 * n)
    level = (found.level.astype(np.float64).mean() - 0.5) * np.sqrt(12 * n)
    verdict, words, widths = _verdict(names, bias, spread, float(level), p)
    prior = jax.vmap(space.from_unit)(jnp.asarray(box.lattice(1024, len(space))))
    contraction = 1 - found.variance.mean(0) / np.var(np.asarray(prior), axis=0)
    gain = float(found.gain.mean())
    return Report(names, verdict, words, coverage, p, bias, spread, gain, contraction, found, widths=widths)


def _covered(what: str, shares: dict[float, tuple[float, float]]) -> str:
    rows = [f"{percent(a)}: {percent_estimate(c, s, 1)}" for a, (c, s) in shares.items()]
    return f"{what} {', '.join(rows)}"


def _verdict(
    names: Sequence[str], bias: np.ndarray, spread: np.ndarray, level: float, p: dict[str, float]
) -> tuple[str, str, tuple[int, ...]]:
    """(verdict, sentence, parameters on whose widths alone it rests).

    Each family of tests has its SHARE, shared by its members. The sentence names the test that decides, its p-value and
    its limit.
    """

    def against(p: float, limit: float) -> str:
        return f"({p_value(p)}, a fault below {limit:.3g})"

    families = [*([_two_sided(z) for z in family] for family in (bias, spread, [level])), list(p.values())]
    means, widths, [joint], _ = families
    each = SHARE / len(names)
    biased = [i for i in range(len(names)) if means[i] < each]
    odd_width = [i for i in range(len(names)) if widths[i] < each]
    if biased:
        sides = [f"{names[i]} (the truth is {'above' if bias[i] > 0 else 'below'})" for i in biased]
        return BIASED, f"biased in {', '.join(sides)}, by the mean of the ranks {against(min(means), each)}", ()
    if joint < SHARE:
        kind, how = (OVER, HOW[0]) if level > 0 else (UNDER, HOW[1])
        most = int(np.argmax(np.sign(level) * spread))
        where = f", most in {names[most]}" if most in odd_width and len(names) > 1 else ""
        return kind, f"{kind}: too {how}{where}, by the mean HPD level {against(joint, SHARE)}", ()
    if odd_width:
        kind, order = (OVER, HOW) if spread[odd_width].sum() > 0 else (UNDER, HOW[::-1])
        odd = {how: [names[i] for i in odd_width if (spread[i] > 0) == (how == "narrow")] for how in order}
        texts = [f"too {how} in {listed(own, most=MOST)}" for how, own in odd.items() if own]
        test = f"by the spread of the ranks {against(min(widths), each)}"
        return kind, f"{kind}: {', '.join(texts)}, {test}", tuple(odd_width)
    worst = min(p, key=lambda name: p[name])
    if p[worst] < SHARE / len(p):
        test = against(p[worst], SHARE / len(p))
        return ODD, f"{ODD}: the ranks of {worst} are not uniform {test}, the shape is wrong", ()
    together, lowest = min((len(families) * len(family) * min(family), min(family)) for family in families)
    if together > NEGLIGIBLE:
        return CALIBRATED, CALIBRATED, ()
    return CALIBRATED, f"{CALIBRATED} (lowest p {lowest:.2g}; corrected for all tests {together:.2g})", ()


def _two_sided(z: float) -> float:
    return float(2 * ndtr(-abs(z)))


def uniform_p(values: np.ndarray) -> float:
    """p-value of the Anderson-Darling statistic of [n] values against U[0, 1], by simulation of the statistic."""
    null = _null(len(values))
    return float((1 + np.sum(null >= anderson_darling(np.asarray(values, np.float64)[None])[0])) / (1 + len(null)))


def anderson_darling(values: np.ndarray) -> np.ndarray:
    """A^2 of each row of [m, n] against U[0, 1] -> [m]."""
    n = values.shape[-1]
    u = np.clip(np.sort(values, axis=-1), 1e-7, 1 - 1e-7)
    # A^2 = -n - 1/n sum_i (2i - 1) (ln u_i + ln(1 - u_(n+1-i)))
    return -n - np.mean((2 * np.arange(1, n + 1) - 1) * (np.log(u) + np.log1p(-u[:, ::-1])), axis=-1)


@lru_cache(maxsize=8)
def _null(n: int, draws: int = DRAWS) -> np.ndarray:
    return anderson_darling(np.random.default_rng(0).random((draws, n)))


def corrected(key: Array, posteriors: Distribution, thetas: Array, tilt: Distribution | None = None) -> Report:
    """`check`; where it finds over-confidence, a temperature is fitted on one half and judged on the other."""
    report = check(key, posteriors, thetas, tilt=tilt)
    if report.verdict != OVER:
        return report
    n = thetas.shape[0]
    first = np.arange(n) < n // 2
    if tilt is not None:
        factor = _temperature_by_level(key, posteriors, thetas, first, tilt)
    else:
        factor = temperature(posteriors, thetas, first)
    if factor <= 1.0:
        return report
    wider = widened(posteriors, factor)
    # all of them: a program that is compiled already
    found = jax.tree.map(np.asarray, ranks(branch(key, 1), wider, jnp.asarray(thetas), tilt=tilt))
    after = judge(_usable(Ranks(*(part[n // 2 :] for part in found))), posteriors.space.unbatched)
    words = f"{report.words}; standard deviations times {factor:.2f}, then {after.words}"
    fitted = report.pairs - after.pairs
    return replace(after, words=words, temperature=factor, before=report.verdict, fitted=fitted)


def _temperature_by_level(
    key: Array, posteriors: Distribution, thetas: Array, use: np.ndarray, tilt: Distribution
) -> float:
    """Find the smallest factor at which the truths have HPD levels of mean 1/2: q tilt / prior has no known norm."""
    for factor in TEMPERATURES:
        level = np.asarray(ranks(key, widened(posteriors, factor), jnp.asarray(thetas), tilt=tilt).level)[use]
        if np.nanmean(level) <= 0.5:
            break
    return float(factor)


def predictive(x: np.ndarray, replicates: np.ndarray) -> tuple[float, np.ndarray]:
    """Posterior predictive check of summaries x [n, D] by replicates [n, R, D] simulated at draws given each x.

    The ranks of an x among its own replicates crowd in the middle (the posterior has seen x), so only a bias counts:
    per feature the two-sided p-value of the mean rank [D], and their minimum times D.
    """
    below = np.mean(replicates < x[:, None, :], axis=1) + 0.5 * np.mean(replicates == x[:, None, :], axis=1)
    n = len(x)
    sd = np.maximum(below.std(axis=0), 1e-3)
    p = 2 * ndtr(-np.abs(below.mean(0) - 0.5) / sd * np.sqrt(n))
    return float(min(1.0, p.min() * len(p))), p
