"""One distribution over theta, used as prior, as randomisation domain and as posterior."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from bayessim_mjx.distributions import algebra, box, storage

if TYPE_CHECKING:
    from bayessim_mjx.parameters import ParameterSpace

OFF = np.float32(-1e9)  # logit of a component that is not in use
POINTS = 1024  # quadrature points per component behind mean, cov, mode, credible_level
TRIES, SPARE = 50, 32  # rejection rounds of sample, and points per row that is then still outside


@struct.dataclass
class Distribution:
    """w0 Uniform + (1 - w0) MoG truncated to the cube, in the unit coordinates u = space.to_unit(theta).

    There every prior is uniform, hence a product of posteriors needs no division by the prior. All leaves are float32
    arrays whose shapes depend on K and d only, so a prior and a posterior of K components share compiled programs.
    Leaves may carry leading axes (see `split`, or jax.vmap over the distribution).
    """

    prior_weight: Array  # [] w0
    logits: Array  # [K]
    means: Array  # [K, d] in unit coordinates
    scales: Array  # [K, d, d] lower Cholesky factors of the covariances
    log_inside: Array  # [] log mass of the untruncated MoG inside the cube
    space: Any = struct.field(pytree_node=False)  # ParameterSpace

    # ---- constructors -------------------------------------------------------------------------------------------
    @classmethod
    def from_unit(
        cls, space: ParameterSpace, logits: Array, means: Array, scales: Array, prior_weight: Array | float = 0.0
    ) -> Distribution:
        """From unit coordinates: logits [K], means [K, d], lower Cholesky factors [K, d, d]. Traceable."""
        logits, means, scales = (jnp.asarray(v, jnp.float32) for v in (logits, means, scales))
        inside = _log_inside(logits, means, scales)
        return cls(jnp.asarray(prior_weight, jnp.float32), logits, means, scales, inside, space)

    @classmethod
    def prior(cls, space: ParameterSpace, components: int = 1) -> Distribution:
        """The prior itself, with `components` unused Gaussians so that its structure is a posterior's."""
        d = len(space)
        means = np.full((components, d), 0.5, np.float32)
        scales = np.tile(np.eye(d, dtype=np.float32), (components, 1, 1))
        return cls.from_unit(space, np.zeros(components, np.float32), means, scales, 1.0)

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
        logits, m, s = np.full(k, OFF), np.full((k, d), 0.5), np.tile(np.eye(d), (k, 1, 1))
        for i, (mean, cov) in enumerate(zip(means, covs, strict=True)):
            m[i], s[i] = _unit_gaussian(space, mean, cov)
            logits[i] = np.log(weight[i] / weight.sum()) if weight[i] > 0 else OFF
        return cls.from_unit(space, logits, m, s)

    # ---- densities and draws (traceable) ------------------------------------------------------------------------
    @property
    def components(self) -> int:
        return self.logits.shape[-1]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.space.names)

    def sample(self, key: Array, n: int) -> Array:
        """n draws -> theta [n, d], every one inside [space.low, space.high]."""
        return _sample(self, key, n)

    def log_gain(self, theta: Array) -> Array:
        """log density relative to the prior: theta [..., d] -> [...]; -inf outside the box."""
        return _log_gain(self, jnp.asarray(theta, jnp.float32))

    def log_prob(self, theta: Array) -> Array:
        """log density in theta units (it integrates to 1 over the box): theta [..., d] -> [...]; -inf outside."""
        theta = jnp.asarray(theta, jnp.float32)
        return self.log_gain(theta) + _rowwise(self.space.log_prior, theta)

    def quadrature(self, points: int = POINTS) -> tuple[Array, Array]:
        """Deterministic weighted points: theta [(K + 1) points, d] and weights that sum to 1."""
        return _quadrature(self, points)

    def mean(self) -> Array:
        """Mean in theta units [d], truncation included."""
        return _moments(self)[0]

    def cov(self) -> Array:
        """Covariance in theta units [d, d]: within components, between components, truncation included."""
        return _moments(self)[1]

    def sd(self) -> Array:
        """Standard deviations in theta units [d]."""
        return jnp.sqrt(jnp.diagonal(self.cov()))

    def mode(self) -> Array:
        """The point of highest density in unit coordinates among component means and quadrature points -> theta [d]."""
        return _mode(self)

    def contraction(self) -> Array:
        """1 - var_posterior / var_prior per parameter [d]: 0 learnt nothing, 1 known exactly."""
        prior = _rowwise(self.space.from_unit, jnp.asarray(box.lattice(POINTS, len(self.space))))
        return 1.0 - jnp.diagonal(self.cov()) / jnp.var(prior, axis=0)

    def credible_level(self, theta: Array) -> Array:
        """Mass of the region denser than theta: theta [..., d] -> [...]; within the 95 % HPD region where <= 0.95."""
        return _credible_level(self, jnp.asarray(theta, jnp.float32))

    def marginal(self, names: Sequence[str]) -> Distribution:
        """Distribution of the named parameters, on space.subset(names).

        The mass of each component is exact; its shape is the Gaussian's marginal, truncated (exact where the
        parameters left out are not correlated with those kept, or not cut off by the box).
        """
        index = np.asarray([self.space.index(name) for name in names])
        return _marginal(self, tuple(index.tolist()), self.space.subset(names))

    # ---- mixture algebra (on the host) --------------------------------------------------------------------------
    def product(self, *others: Distribution, components: int | None = None) -> Distribution:
        """Posterior given independent data sets: p(theta)^(1-n) prod_i q_i(theta), reduced to `components` (this K)."""
        k = components or self.components
        result = self._mixture()
        for other in others:
            _same_space(self.space, other.space)
            result = algebra.reduce(algebra.product(result, other._mixture()), max(4 * k, 32))
        return _from_mixture(self.space, algebra.reduce(result, k), k)

    def reduce(self, components: int) -> Distribution:
        """The same density with at most `components` Gaussians (negligible ones dropped, then Runnalls merging)."""
        return _from_mixture(self.space, algebra.reduce(self._mixture(), components), components)

    def _mixture(self) -> algebra.Mixture:
        logits, means, scales = (np.asarray(v, np.float64) for v in (self.logits, self.means, self.scales))
        w0 = float(self.prior_weight)
        with np.errstate(divide="ignore"):
            flat, bulk = np.log(w0), np.log1p(-w0) - float(self.log_inside)
        weights = np.maximum(logits - np.logaddexp.reduce(logits) + bulk, -1e12)
        return algebra.Mixture(float(flat), weights, means, scales @ np.swapaxes(scales, -1, -2))

    def split(self) -> list[Distribution]:
        """The rows of a batched distribution (leaves with one leading axis), as a list."""
        return [jax.tree.map(lambda leaf, i=i: leaf[i], self) for i in range(self.logits.shape[0])]

    # ---- storage ------------------------------------------------------------------------------------------------
    def save(self, path: str | Path) -> Path:
        """Write arrays and a JSON header (names, box) into one .npz, atomically."""
        arrays = {f: np.asarray(getattr(self, f)) for f in storage.FIELDS}
        return storage.write(path, arrays, self.space)

    @classmethod
    def load(cls, path: str | Path, space: ParameterSpace) -> Distribution:
        """Read what `save` wrote; ValueError if its parameters are not those of `space`."""
        return cls(**{k: jnp.asarray(v) for k, v in storage.read(path, space).items()}, space=space)

    def describe(self) -> dict[str, dict[str, float]]:
        """Per parameter name: mean, sd, contraction, and the box."""
        rows = [np.asarray(v) for v in (self.mean(), self.sd(), self.contraction(), self.space.low, self.space.high)]
        keys = ("mean", "sd", "contraction", "low", "high")
        return {
            name: {key: float(row[i]) for key, row in zip(keys, rows, strict=True)} for i, name in enumerate(self.names)
        }


def _rowwise(function: Any, x: Array) -> Array:
    """Apply a function of one vector [d] over all leading axes."""
    rows = jax.vmap(function)(x.reshape(-1, x.shape[-1]))
    return rows.reshape(x.shape[:-1] + rows.shape[1:])


def _to_theta(space: Any, u: Array) -> Array:
    """Unit coordinates [n, d] -> theta [n, d], kept in the box against float32 rounding."""
    low, high = jnp.asarray(space.low), jnp.asarray(space.high)
    return jnp.clip(_rowwise(space.from_unit, u), low[None, :], high[None, :])


@jax.jit
def _log_inside(logits: Array, means: Array, scales: Array) -> Array:
    return jax.nn.logsumexp(jax.nn.log_softmax(logits) + box.log_masses(means, scales))


def _log_unit(q: Distribution, u: Array) -> Array:
    """Unit-cube log density of u [n, d] (taken to be inside) -> [n]."""
    mog = jax.nn.logsumexp(jax.nn.log_softmax(q.logits)[None, :] + box.log_density(u, q.means, q.scales), axis=1)
    return jnp.logaddexp(jnp.log(q.prior_weight), jnp.log1p(-q.prior_weight) + mog - q.log_inside)


@jax.jit
def _log_gain(q: Distribution, theta: Array) -> Array:
    rows = theta.reshape(-1, theta.shape[-1])
    inside = jax.vmap(q.space.contains)(rows)
    u = jnp.clip(
        _rowwise(q.space.to_unit, jnp.where(inside[:, None], rows, jnp.asarray(q.space.nominal)[None, :])), 0, 1
    )
    return jnp.where(inside, _log_unit(q, u), -jnp.inf).reshape(theta.shape[:-1])


@partial(jax.jit, static_argnames="n")
def _sample(q: Distribution, key: Array, n: int) -> Array:
    key_flat, key_u, key_mog = jax.random.split(key, 3)
    flat = jax.random.uniform(key_flat, (n,)) < q.prior_weight
    u = jax.random.uniform(key_u, (n, q.means.shape[-1]))
    u = box.draw(key_mog, q.logits, q.means, q.scales, flat, u, TRIES, SPARE)
    return _to_theta(q.space, u)


@partial(jax.jit, static_argnames="points")
def _quadrature(q: Distribution, points: int) -> tuple[Array, Array]:
    d = q.means.shape[-1]
    w = jnp.asarray(box.lattice(points, d))
    u, log_weight = jax.vmap(lambda m, s: box.separate(m, s, w))(q.means, q.scales)
    mass = jax.nn.softmax((jax.nn.log_softmax(q.logits)[:, None] + log_weight).reshape(-1))
    weights = jnp.concatenate([jnp.full((points,), 1 / points) * q.prior_weight, (1 - q.prior_weight) * mass])
    return _to_theta(q.space, jnp.concatenate([w, u.reshape(-1, d)])), weights


@jax.jit
def _moments(q: Distribution) -> tuple[Array, Array]:
    theta, weights = _quadrature(q, POINTS)
    mean = weights @ theta
    deviation = theta - mean[None, :]
    return mean, (deviation * weights[:, None]).T @ deviation


@jax.jit
def _mode(q: Distribution) -> Array:
    theta, _ = _quadrature(q, POINTS)
    centres = _to_theta(q.space, jnp.clip(q.means, 0, 1))
    candidates = jnp.concatenate([centres, _moments(q)[0][None, :], theta])
    return candidates[jnp.argmax(_log_gain(q, candidates))]


@jax.jit
def _credible_level(q: Distribution, theta: Array) -> Array:
    points, weights = _quadrature(q, POINTS)
    here, there = _log_gain(q, theta.reshape(-1, theta.shape[-1])), _log_gain(q, points)
    level = (there[None, :] > here[:, None]).astype(jnp.float32) @ weights
    return level.reshape(theta.shape[:-1])


@partial(jax.jit, static_argnums=(1, 2))
def _marginal(q: Distribution, index: tuple[int, ...], space: Any) -> Distribution:
    ids = np.asarray(index)
    rows = q.scales[:, ids, :]
    means, scales = q.means[:, ids], jnp.linalg.cholesky(rows @ jnp.swapaxes(rows, 1, 2))
    logits = jax.nn.log_softmax(q.logits) + box.log_masses(q.means, q.scales) - box.log_masses(means, scales)
    return Distribution.from_unit(space, logits, means, scales, q.prior_weight)


def _from_mixture(space: Any, mixture: algebra.Mixture, components: int) -> Distribution:
    """Pad to `components` and weigh the flat part against the mass of the Gaussians inside the cube."""
    k, d = len(mixture.log_weights), len(space)
    logits, means, scales = (
        np.full(components, OFF),
        np.full((components, d), 0.5),
        np.tile(np.eye(d), (components, 1, 1)),
    )
    total = np.logaddexp.reduce(mixture.log_weights)
    logits[:k], means[:k], scales[:k] = mixture.log_weights - total, mixture.means, np.linalg.cholesky(mixture.covs)
    q = Distribution.from_unit(space, logits, means, scales)
    flat, bulk = mixture.flat, total + float(q.log_inside)
    w0 = np.exp(flat - np.logaddexp(flat, bulk)) if np.isfinite(flat) else 0.0
    return q.replace(prior_weight=jnp.asarray(w0, jnp.float32))  # type: ignore[attr-defined]


def _unit_gaussian(space: Any, mean: Any, cov_or_sd: Any) -> tuple[np.ndarray, np.ndarray]:
    """Mean [d] and lower Cholesky factor [d, d] in unit coordinates; sd below 1e-6 of the box is raised to it."""
    d = len(space)
    theta, spread = np.asarray(mean, np.float64), np.asarray(cov_or_sd, np.float64)
    if theta.shape != (d,) or spread.shape not in ((), (d,), (d, d)):
        raise ValueError(f"{d} parameters {space.names}: mean of shape {theta.shape}, spread of shape {spread.shape}")
    for name, value, low, high in zip(space.names, theta, space.low, space.high, strict=True):
        if not np.float32(low) <= np.float32(value) <= np.float32(high):
            raise ValueError(f"mean of {name} is {value:g}, outside [{low:g}, {high:g}]")
    cov = spread if spread.ndim == 2 else np.diag(np.broadcast_to(spread, (d,)) ** 2)
    point = jnp.asarray(theta, jnp.float32)
    u, slope = jax.jvp(space.to_unit, (point,), (jnp.ones_like(point),))
    slope = np.asarray(slope, np.float64)
    if not np.all(np.isfinite(cov)) or np.any(np.diagonal(cov) < 0):
        raise ValueError(f"spread of {space.names} must be finite and not negative, not {cov_or_sd}")
    unit = slope[:, None] * cov * slope[None, :] + 1e-12 * np.eye(d)
    return np.asarray(u, np.float64), np.linalg.cholesky(unit)


def _same_space(a: Any, b: Any) -> None:
    if tuple(a.names) != tuple(b.names) or not (np.allclose(a.low, b.low) and np.allclose(a.high, b.high)):
        raise ValueError(f"distributions over different parameters: {tuple(a.names)} and {tuple(b.names)}")
