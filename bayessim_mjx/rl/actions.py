"""Distributions of raw actions: a Gaussian, clipped or squashed by tanh, or a Beta on the allowed range.

Each has two parameters as arrays, (mean, log sd) of the Gaussian and both concentrations of the Beta; the environment
gets clip(u, +- limit), or limit tanh(u) where the Gaussian is squashed.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betaln, digamma

HALF_LOG_2PI = 0.9189385332046727
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(16)  # sum w f(x) = sqrt(2 pi) E f(x), x ~ N(0, 1)
EDGE = 1e-6  # how far a Beta's samples stay from the ends, of the range: its density may be 0 there


def bounded(raw: jax.Array, limit: float, squash: bool) -> jax.Array:
    """Clip raw actions to +- limit, for the environment."""
    return limit * jnp.tanh(raw) if squash else jnp.clip(raw, -limit, limit)


def log_slope(raw: jax.Array, limit: float) -> jax.Array:
    """log |d a / d u| of a = limit tanh(u), summed over the last axis: log limit + 2 (log 2 - u - softplus(-2 u))."""
    return (jnp.log(limit) + 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))).sum(-1)


def log_prob(mean: jax.Array, log_std: jax.Array, action: jax.Array) -> jax.Array:
    """log N(action; mean, diag(std^2)), summed over the last axis."""
    z = (action - mean) * jnp.exp(-log_std)
    return -(0.5 * z**2 + log_std + HALF_LOG_2PI).sum(-1)


def entropy(log_std: jax.Array) -> jax.Array:
    """Entropy of the Gaussian in nats: sum over dimensions of log std + (1 + log 2 pi) / 2."""
    return (log_std + 0.5 + HALF_LOG_2PI).sum(-1)


def squashed_entropy(mean: jax.Array, log_std: jax.Array, limit: float) -> jax.Array:
    """Entropy of limit tanh(u), [...]: that of u plus E log |d a / d u|, by Gauss-Hermite quadrature."""
    nodes, weights = jnp.asarray(NODES, jnp.float32), jnp.asarray(WEIGHTS / WEIGHTS.sum(), jnp.float32)
    u = mean[..., None, :] + jnp.exp(log_std)[..., None, :] * nodes[:, None]  # [..., nodes, A]
    return entropy(log_std) + log_slope(u, limit) @ weights


def kl(mean: jax.Array, log_std: jax.Array, new_mean: jax.Array, new_log_std: jax.Array) -> jax.Array:
    """KL(old || new) of diagonal Gaussians, [...]; exactly 0 where they agree. Squashing both leaves it as it is.

    = sum 1/2 [ (r - 1 - log r) + ((mean - new_mean) / new_std)^2 ],  r = (std / new_std)^2
    """
    log_ratio = 2 * (log_std - new_log_std)
    distance = (mean - new_mean) * jnp.exp(-new_log_std)
    return 0.5 * (jnp.expm1(log_ratio) - log_ratio + distance**2).sum(-1)


@dataclass(frozen=True)
class Gaussian:
    """Parameters: mean [..., A], log sd [A] or [..., A]."""

    limit: float = 1.0
    squash: bool = False

    def mean(self, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """Compute the raw action that the deterministic policy takes."""
        return mean

    def sd(self, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """Compute the standard deviation of raw actions."""
        return jnp.exp(log_std)

    def noise(self, key: jax.Array, steps: int, worlds: int, size: int) -> jax.Array:
        """Of as many steps in as many worlds, [T, N, ...]: what `made` needs."""
        return jax.random.normal(key, (steps, worlds, size))

    def made(self, noise: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """Raw actions [N, A] of one step's noise."""
        return mean + jnp.exp(log_std) * noise

    def drawn(self, key: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """Raw actions of any batch."""
        return mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)

    def log_prob(self, mean: jax.Array, log_std: jax.Array, raw: jax.Array) -> jax.Array:
        """Log density of raw actions, summed over the last axis."""
        return log_prob(mean, log_std, raw)

    def entropy(self, mean: jax.Array, log_std: jax.Array) -> jax.Array:
        """Of what the environment gets, were it not clipped."""
        return squashed_entropy(mean, log_std, self.limit) if self.squash else entropy(log_std)

    def kl(self, *old_and_new: jax.Array) -> jax.Array:
        """KL(old || new), of both old and then both new parameters."""
        return kl(*old_and_new)


@dataclass(frozen=True)
class Beta:
    """Raw actions limit (2 x - 1), x ~ Beta(a, b) (Chou et al. 2017). Parameters: a, b [..., A], both above 1."""

    limit: float = 1.0
    squash = False

    def _inner(self, raw: jax.Array) -> jax.Array:
        return jnp.clip((raw / self.limit + 1) / 2, EDGE, 1 - EDGE)

    def _outer(self, x: jax.Array) -> jax.Array:
        return self.limit * (2 * jnp.clip(x, EDGE, 1 - EDGE) - 1)

    def mean(self, a: jax.Array, b: jax.Array) -> jax.Array:
        return self.limit * (2 * a / (a + b) - 1)

    def sd(self, a: jax.Array, b: jax.Array) -> jax.Array:
        return 2 * self.limit * jnp.sqrt(a * b / (a + b + 1)) / (a + b)

    def noise(self, key: jax.Array, steps: int, worlds: int, size: int) -> jax.Array:
        return jax.random.split(key, (steps, worlds))

    def made(self, noise: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
        return self._outer(jax.vmap(jax.random.beta)(noise, a, b))

    def drawn(self, key: jax.Array, a: jax.Array, b: jax.Array) -> jax.Array:
        return self._outer(jax.random.beta(key, a, b))

    def log_prob(self, a: jax.Array, b: jax.Array, raw: jax.Array) -> jax.Array:
        x = self._inner(raw)
        density = (a - 1) * jnp.log(x) + (b - 1) * jnp.log1p(-x) - betaln(a, b)
        return (density - jnp.log(2 * self.limit)).sum(-1)

    def entropy(self, a: jax.Array, b: jax.Array) -> jax.Array:
        inside = betaln(a, b) - (a - 1) * digamma(a) - (b - 1) * digamma(b) + (a + b - 2) * digamma(a + b)
        return (inside + jnp.log(2 * self.limit)).sum(-1)

    def kl(self, a: jax.Array, b: jax.Array, new_a: jax.Array, new_b: jax.Array) -> jax.Array:
        more_a, more_b = new_a - a, new_b - b
        same = betaln(new_a, new_b) - betaln(a, b) - more_a * digamma(a) - more_b * digamma(b)
        return (same + (more_a + more_b) * digamma(a + b)).sum(-1)


Law = Gaussian | Beta


def of(config: Any) -> Law:
    """Choose the distribution of the `ppo:` settings."""
    if config.distribution == "beta":
        return Beta(config.action_clip)
    return Gaussian(config.action_clip, config.action_bound == "tanh")


@jax.custom_vjp
def clamped(x: jax.Array, low: float, high: float) -> jax.Array:
    """`x` within its limits. Beyond them a gradient passes where its descent leads back: x does not stay there."""
    return jnp.clip(x, low, high)


def _clamped(x: jax.Array, low: float, high: float) -> tuple[jax.Array, tuple]:
    return clamped(x, low, high), (x, low, high)


def _back(kept: tuple, slope: jax.Array) -> tuple[jax.Array, None, None]:
    x, low, high = kept
    stays = ((x >= high) & (slope < 0)) | ((x <= low) & (slope > 0))
    return jnp.where(stays, 0.0, slope), None, None


clamped.defvjp(_clamped, _back)
