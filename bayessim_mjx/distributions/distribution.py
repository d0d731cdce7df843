"""One distribution over theta, used as prior, as randomisation domain and as posterior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import ArrayLike

from bayessim_mjx.distributions import algebra, charts, convert, evaluate, storage
from bayessim_mjx.distributions.estimates import PRIOR_ITSELF, Estimates, estimates

if TYPE_CHECKING:
    from bayessim_mjx.parameters import ParameterSpace


@struct.dataclass
class Distribution:
    """w0 prior + (1 - w0) MoG in the coordinates z of a chart (charts.py) of the unit cube u = space.to_unit(theta).

    In the plain chart z = u and the MoG is truncated to the cube; every prior is uniform there, hence a product of
    posteriors needs no division by the prior. All leaves are float32 arrays whose shapes depend on K and d only, so a
    prior and a posterior of K components share compiled programs. Leaves may carry leading axes (see `split`, or
    jax.vmap over the distribution).
    """

    prior_weight: Array  # [] w0
    logits: Array  # [K]
    means: Array  # [K, d] in the chart's coordinates
    scales: Array  # [K, d, d] lower Cholesky factors of the covariances
    log_inside: Array  # [] log mass of the untruncated MoG inside the cube
    space: Any  # ParameterSpace; where ranges may move, a `parameters.ranged.Ranged`
    chart: str = struct.field(pytree_node=False, default="plain")

    # ---- constructors -------------------------------------------------------------------------------------------
    @classmethod
    def from_unit(
        cls,
        space: ParameterSpace,
        logits: ArrayLike,
        means: ArrayLike,
        scales: ArrayLike,
        prior_weight: ArrayLike = 0.0,
        chart: str = "plain",
    ) -> Distribution:
        """From coordinates of the chart: logits [K], means [K, d], lower Cholesky factors [K, d, d]. Traceable."""
        w0, logits, means, scales = (jnp.asarray(v, jnp.float32) for v in (prior_weight, logits, means, scales))
        cut = charts.check(chart) == "plain"
        inside = evaluate.log_inside(logits, means, scales) if cut else jnp.zeros((), jnp.float32)
        return cls(w0, logits, means, scales, inside, space, chart)

    @classmethod
    def prior(cls, space: ParameterSpace, components: int = 1, chart: str = "plain") -> Distribution:
        """Make the prior itself, with `components` unused Gaussians so that its structure is a posterior's."""
        _, means, scales = convert.empty(components, len(space), charts.NEUTRAL[charts.check(chart)][0])
        return cls.from_unit(space, np.zeros(components), means, scales, 1.0, chart)

    @classmethod
    def gaussian(cls, space: ParameterSpace, mean: Any, cov_or_sd: Any, components: int = 1) -> Distribution:
        """Gaussian in theta units: mean [d] or {name: value}, standard deviations (scalar or [d]) or covariance [d, d].

        Exact for uniform priors; for others it is Gaussian in unit coordinates, matched to first order at the mean.
        """
        mean = np.asarray(space.vector(mean) if isinstance(mean, dict) else mean, np.float64)
        return cls.mixture(space, [1.0], [mean], [cov_or_sd], components)

    @classmethod
    def mixture(
        cls, space: ParameterSpace, weights: Sequence[float], means: Any, covs: Any, components: int | None = None
    ) -> Distribution:
        """Mixture in theta units: weights [K], means [K, d], covs [K] of sd or covariance as in `gaussian`."""
        weight = np.asarray(weights, np.float64)
        k, d = max(len(weight), components or 0), len(space)
        if not (len(weight) == len(means) == len(covs)) or np.any(weight < 0) or not weight.sum() > 0:
            raise ValueError(f"mixture: weights {weights}, {len(means)} means, {len(covs)} covariances do not match")
        logits, m, s = convert.empty(k, d)
        for i, (mean, cov) in enumerate(zip(means, covs, strict=True)):
            m[i], s[i] = convert.unit_gaussian(space, mean, cov)
            logits[i] = np.log(weight[i] / weight.sum()) if weight[i] > 0 else convert.OFF
        return cls.from_unit(space, logits, m, s)

    # ---- densities and draws (traceable) ------------------------------------------------------------------------
    @property
    def components(self) -> int:
        return self.logits.shape[-1]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.space.names)

    @property
    def coordinates(self) -> dict[str, Any]:
        """What the arrays mean: names, box, priors and chart, as a checkpoint keeps them beside the arrays."""
        return storage.coordinates(self.space, self.chart)

    @property
    def centres(self) -> Array:
        """Centres of the Gaussians in unit coordinates, kept in the cube [K, d]."""
        return evaluate.centres_unit(self)

    def sample(self, key: Array, n: int) -> Array:
        """n draws -> theta [n, d], every one inside [space.low, space.high]."""
        return evaluate.sample(self, key, n)

    def log_gain(self, theta: Array) -> Array:
        """log density relative to the prior: theta [..., d] -> [...]; -inf outside the box."""
        return evaluate.log_gain(self, jnp.asarray(theta, jnp.float32))

    def log_prob(self, theta: Array) -> Array:
        """log density in theta units (it integrates to 1 over the box): theta [..., d] -> [...]; -inf outside."""
        theta = jnp.asarray(theta, jnp.float32)
        return self.log_gain(theta) + evaluate.rowwise(self.space.log_prior, theta)

    def quadrature(self, points: int = evaluate.POINTS) -> tuple[Array, Array]:
        """Deterministic weighted points: theta [(K + 1) points, d] and weights that sum to 1."""
        return evaluate.quadrature(self, points)

    def mean(self) -> Array:
        """Mean in theta units [d], truncation and the prior's share included."""
        return evaluate.moments(self)[0]

    def cov(self) -> Array:
        """Covariance in theta units [d, d]: within components, between components, truncation included."""
        return evaluate.moments(self)[1]

    def sd(self) -> Array:
        """Compute standard deviations in theta units [d], of all draws: a person wants those of `estimates`."""
        return jnp.sqrt(jnp.diagonal(self.cov()))

    def mode(self) -> Array:
        """Find the densest point in unit coordinates, of component means and quadrature points -> theta [d]."""
        return evaluate.mode(self)

    def contraction(self) -> Array:
        """1 - var_posterior / var_prior per parameter [d], the prior's share included: 0 nothing learnt, 1 exact."""
        return 1.0 - jnp.diagonal(self.cov()) / jnp.var(evaluate.prior_points(self.space), axis=0)

    def credible_level(self, theta: Array) -> Array:
        """Mass of the region denser than theta: theta [..., d] -> [...]; within the 95 % HPD region where <= 0.95."""
        return evaluate.credible_level(self, jnp.asarray(theta, jnp.float32))

    def marginal(self, names: Sequence[str]) -> Distribution:
        """Distribution of the named parameters, on space.subset(names).

        The mass of each component is exact; its shape is the Gaussian's marginal, truncated (exact where the
        parameters left out are not correlated with those kept, or not cut off by the box).
        """
        index = tuple(self.space.index(name) for name in names)
        logits, means, scales = evaluate.marginal(self, index)
        return Distribution.from_unit(self.space.subset(names), logits, means, scales, self.prior_weight, self.chart)

    def condition(self, values: Mapping[str, float]) -> Distribution:
        """Distribution of the other parameters where those named have these values (theta units). Exact.

        ValueError where a value lies outside its range.
        """
        given = tuple(self.space.index(name) for name in values)
        free = tuple(i for i in range(len(self.space)) if i not in given)
        for i, value in zip(given, values.values(), strict=True):
            if not self.space.low[i] <= np.float32(value) <= self.space.high[i]:
                low, high = self.space.low[i], self.space.high[i]
                raise ValueError(f"condition: {self.names[i]} = {value:g} is outside [{low:g}, {high:g}]")
        u = jnp.clip(self.space.subset(tuple(values)).to_unit(np.asarray([*values.values()], np.float32)), 0, 1)
        logits, means, scales, weight = evaluate.conditional(self, given, free, u)
        rest = self.space.subset([self.names[i] for i in free])
        return Distribution.from_unit(rest, logits, means, scales, weight, self.chart)

    @property
    def sound(self) -> bool:
        """Whether it is a density: finite, with weights and widths that a mixture can have (on the host)."""
        try:
            convert.to_mixture(self)
        except ValueError:
            return False
        return True

    # ---- mixture algebra (on the host) --------------------------------------------------------------------------
    def product(self, *others: Distribution, components: int | None = None) -> Distribution:
        """Posterior given independent data sets: p(theta)^(1-n) prod_i q_i(theta), reduced to `components` (this K).

        Logit distributions, whose prior is no Gaussian, are carried over to the probit chart first (see `rechart`).
        ValueError where one of them is no density (see `sound`).
        """
        return self.products(*others, components=components, counts=(1 + len(others),))[0]

    def products(
        self, *others: Distribution, components: int | None = None, counts: Sequence[int]
    ) -> list[Distribution]:
        """`product` of the first n of this one and the others, for each n of `counts`, which rise."""
        k = components or self.components
        chart = "probit" if self.chart == "logit" else self.chart
        result, found = convert.to_mixture(self.rechart(chart)), []
        for n, other in enumerate((None, *others), 1):
            if other is not None:
                convert.check_same_space(self.space, other.space)
                factor = convert.to_mixture(other.rechart(chart))
                result = algebra.reduce(algebra.product(result, factor), max(4 * k, 32))
            if n in counts:
                found.append(self._of(self.space, algebra.reduce(result, k), k, chart))
        return found

    def divide(self, proposal: Distribution) -> tuple[Distribution, float]:
        """self * prior / proposal, the proposal being one Gaussian; and the share of weight that had to be left out.

        Left out are components broader than the proposal allows: their quotient is no density. Where nothing is left
        the result is self, with share 1. ValueError for a proposal of several components or in another chart.
        """
        convert.check_same_space(self.space, proposal.space)
        if proposal.chart != self.chart or self.chart == "logit":
            raise ValueError(f"divide: charts {self.chart} and {proposal.chart}; both must be plain, or both probit")
        if proposal.components != 1:
            raise ValueError(f"divide: a proposal of {proposal.components} Gaussians; reduce it to 1")
        divisor = convert.to_mixture(proposal)
        quotient, lost = algebra.divide(convert.to_mixture(self), divisor.means[0], divisor.scales[0])
        if quotient is None:
            return self, lost
        return self._of(self.space, quotient, self.components, self.chart), lost

    def reduce(self, components: int) -> Distribution:
        """Reduce the density to at most `components` Gaussians (negligible ones dropped, then Runnalls merging)."""
        mixture = algebra.reduce(convert.to_mixture(self), components)
        return self._of(self.space, mixture, components, self.chart)

    def rechart(self, chart: str) -> Distribution:
        """Express it in another chart; each Gaussian keeps its mean and covariance in the new coordinates.

        An approximation, good where components are narrow against the range or the charts alike (logit, probit).
        """
        if charts.check(chart) == self.chart:
            return self
        means, scales, logits = convert.recharted(self, chart)
        return Distribution.from_unit(self.space, logits, means, scales, self.prior_weight, chart)

    def over(self, space: Any) -> Distribution:
        """Extend it to the ranges of `space`, which have grown, on the host; half the growth wider there.

        A component that was cut off at an end which has moved goes on beyond it: an extrapolation, to simulate from.
        """
        means, scales, logits = convert.regrown(self, space)
        return Distribution.from_unit(space, logits, means, scales, self.prior_weight, self.chart)

    @classmethod
    def _of(cls, space: Any, mixture: algebra.Mixture, components: int, chart: str) -> Distribution:
        """Pad to `components` and weigh the flat part against the mass of the Gaussians inside the cube."""
        logits, means, scales, total = convert.padded(mixture, components)
        q = cls.from_unit(space, logits, means, scales, chart=chart)
        bulk = total + float(q.log_inside)
        w0 = np.exp(mixture.flat - np.logaddexp(mixture.flat, bulk)) if np.isfinite(mixture.flat) else 0.0
        return replace(q, prior_weight=jnp.asarray(w0, jnp.float32))

    def split(self) -> list[Distribution]:
        """List the rows of a batched distribution (leaves with one leading axis)."""
        return [jax.tree.map(lambda leaf, i=i: leaf[i], self) for i in range(self.logits.shape[0])]

    # ---- storage ------------------------------------------------------------------------------------------------
    def save(self, path: str | Path) -> Path:
        """Write arrays and a JSON header (names, box, priors, chart) into one .npz, atomically."""
        arrays = {f: np.asarray(getattr(self, f)) for f in storage.FIELDS}
        return storage.write(path, arrays, self.space, self.chart)

    @classmethod
    def load(cls, path: str | Path, space: ParameterSpace) -> Distribution:
        """Read what `save` wrote; ValueError if its parameters are not those of `space`."""
        arrays, chart, space = storage.read(path, space)
        return cls(**{k: jnp.asarray(v) for k, v in arrays.items()}, space=space, chart=chart)

    # ---- what it says to a person (on the host) -----------------------------------------------------------------
    @property
    def inferred(self) -> Distribution:
        """The Gaussians without the share of the prior that is kept; the prior where that is most. To be shown."""
        if float(self.prior_weight) >= PRIOR_ITSELF:
            return self
        return replace(self, prior_weight=jnp.zeros_like(self.prior_weight))

    def estimates(self) -> Estimates:
        """Median, 68 % interval, mean, sd and correlation of what was inferred, in theta units."""
        points, weights = (np.asarray(v) for v in self.inferred.quadrature())
        prior_sd = np.asarray(evaluate.prior_points(self.space), np.float64).std(0)
        return estimates(points, prior_sd, weights, float(self.prior_weight))

    def summary(self) -> str:
        """Write a line for each parameter: median and 68 % interval, posterior over prior standard deviation."""
        return self.estimates().lines(self.names, self.space.units)

    def describe(self) -> dict[str, dict[str, float]]:
        """Per parameter name: numbers of `estimates` (q16 to q84 is the 68 % interval), contraction, and the box."""
        e = self.estimates()
        rows = e.median, e.low, e.high, e.mean, e.sd, e.contraction, self.space.low, self.space.high
        keys = ("median", "q16", "q84", "mean", "sd", "contraction", "low", "high")
        return {
            name: {key: float(row[i]) for key, row in zip(keys, rows, strict=True)} for i, name in enumerate(self.names)
        }
