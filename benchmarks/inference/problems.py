"""Inference problems: gaussian_linear and two_moons are sbibm's; all but `bounces` have exact posteriors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.stats import multivariate_t, truncnorm

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.parameters import Parameter, ParameterSpace

DRAWS = 400_000  # of the prior, behind the pendulum's exact posterior


@dataclass(frozen=True)
class Problem:
    name: str
    space: ParameterSpace
    simulate: Callable[[Array, Array], Array]  # key, theta [n, d] -> x [n, D]
    exact: Callable[[np.random.Generator, np.ndarray, int], np.ndarray] | None  # rng, x [D], n -> theta [n, d]
    settings: dict  # what suits the problem: Gaussian priors are exact in probit coordinates
    measured: bool = False  # whether all that `simulate` draws is measurement noise, added to one motion of theta
    gain: Callable[[np.ndarray, np.ndarray], float] | None = None  # x [n, D], theta [d] -> of the exact posterior, nats

    def pairs(self, key: Array, n: int) -> tuple[Array, Array]:
        """theta [n, d] from the prior, x [n, D]."""
        key_theta, key_x = jax.random.split(key)
        thetas = Distribution.prior(self.space).sample(key_theta, n)
        return thetas, self.simulate(key_x, thetas)


def gaussian_linear() -> Problem:
    """theta in R^10 ~ N(0, 0.1 I), x = theta + N(0, 0.1 I): posterior N(x / 2, 0.05 I)."""
    sd = 0.1**0.5
    space = ParameterSpace([Parameter(f"t{i}", 0.0, -2.0, 2.0, prior="gaussian", mean=0.0, sd=sd) for i in range(10)])

    def simulate(key: Array, theta: Array) -> Array:
        return theta + sd * jax.random.normal(key, theta.shape)

    def exact(rng: np.random.Generator, x: np.ndarray, n: int) -> np.ndarray:
        return x / 2 + 0.05**0.5 * rng.normal(size=(n, 10))

    def gain(x: np.ndarray, theta: np.ndarray) -> float:
        variance = 0.1 / (len(x) + 1)
        away = (theta - x.sum(0) / (len(x) + 1)) ** 2 / variance - theta**2 / 0.1
        return float(np.sum(-0.5 * away) + 5 * np.log(len(x) + 1))

    return Problem("gaussian_linear", space, simulate, exact, {"coordinates": "probit", "components": 1}, gain=gain)


def told_weakly() -> Problem:
    """theta ~ U[0, 1]^8, each measured with noise of its own, from .03 to .8: posteriors are Gaussians cut off."""
    sds = np.geomspace(0.03, 0.8, 8)
    space = ParameterSpace([Parameter(f"t{i}", 0.5, 0.0, 1.0) for i in range(8)])

    def simulate(key: Array, theta: Array) -> Array:
        return theta + jnp.asarray(sds, jnp.float32)[None] * jax.random.normal(key, theta.shape)

    def exact(rng: np.random.Generator, x: np.ndarray, n: int) -> np.ndarray:
        return truncnorm((0 - x) / sds, (1 - x) / sds, x, sds).rvs((n, 8), random_state=rng)

    def gain(x: np.ndarray, theta: np.ndarray) -> float:
        mean, sd = x.mean(0), sds / len(x) ** 0.5
        return float(truncnorm((0 - mean) / sd, (1 - mean) / sd, mean, sd).logpdf(theta).sum())

    return Problem("told_weakly", space, simulate, exact, {}, gain=gain)


def two_moons() -> Problem:
    """theta ~ U[-1, 1]^2, a crescent of radius N(0.1, 0.01^2) moved by (-|t1 + t2|, t2 - t1) / sqrt(2)."""
    space = ParameterSpace([Parameter(f"t{i}", 0.0, -1.0, 1.0) for i in range(2)])

    def simulate(key: Array, theta: Array) -> Array:
        key_angle, key_radius = jax.random.split(key)
        a = jax.random.uniform(key_angle, theta.shape[:1], minval=-jnp.pi / 2, maxval=jnp.pi / 2)
        r = 0.1 + 0.01 * jax.random.normal(key_radius, theta.shape[:1])
        moved = jnp.stack([-jnp.abs(theta[:, 0] + theta[:, 1]), theta[:, 1] - theta[:, 0]], axis=1) / jnp.sqrt(2.0)
        return jnp.stack([r * jnp.cos(a) + 0.25, r * jnp.sin(a)], axis=1) + moved

    def exact(rng: np.random.Generator, x: np.ndarray, n: int) -> np.ndarray:
        a, r = rng.uniform(-np.pi / 2, np.pi / 2, 20 * n), rng.normal(0.1, 0.01, 20 * n)
        rest = x[None] - np.stack([r * np.cos(a) + 0.25, r * np.sin(a)], 1)
        total = np.sqrt(2) * rest[:, 0] * rng.choice([-1, 1], 20 * n)
        difference = np.sqrt(2) * rest[:, 1]
        theta = np.stack([total - difference, total + difference], 1) / 2
        return theta[(rest[:, 0] <= 0) & np.all(np.abs(theta) <= 1, axis=1)][:n]

    return Problem("two_moons", space, simulate, exact, {"coordinates": "plain", "components": 16})


def pendulum() -> Problem:
    """q'' = -(9.81 / L) sin q - (b q' - u) / (m L^2) from q = 1, u = 1.5 sin 2t, 40 noisy (angle, velocity) in 2 s."""
    ranges = (("length", 0.3, 1.5), ("mass", 0.3, 2.0), ("damping", 0.02, 0.5))
    space = ParameterSpace([Parameter(n, (lo + hi) / 2, lo, hi) for n, lo, hi in ranges])
    noise = np.tile(np.float32([0.05, 0.2]), 40)

    def motion(theta: Array) -> Array:
        length, mass, damping = theta

        def step(state: tuple[Array, Array], t: Array) -> tuple[tuple[Array, Array], Array]:
            q, v = state
            torque = damping * v - 1.5 * jnp.sin(2 * t)
            v = v + 0.01 * (-9.81 / length * jnp.sin(q) - torque / (mass * length**2))
            q = q + 0.01 * v
            return (q, v), jnp.stack([q, v])

        _, states = jax.lax.scan(step, (jnp.ones(()), jnp.zeros(())), 0.01 * jnp.arange(200))
        return states[4::5].reshape(-1)

    clean = jax.jit(jax.vmap(motion))

    def simulate(key: Array, theta: Array) -> Array:
        return clean(theta) + noise * jax.random.normal(key, (theta.shape[0], 80))

    cache: list[tuple[np.ndarray, np.ndarray]] = []

    def exact(rng: np.random.Generator, x: np.ndarray, n: int) -> np.ndarray:
        """Importance resampling of prior draws, twice: the second time around the first result."""
        if not cache:
            theta = Distribution.prior(space).sample(jax.random.PRNGKey(77), DRAWS)
            cache.append((np.asarray(theta), np.asarray(clean(theta))))
        theta, y = cache[0]
        first = theta[_resample(rng, _log_likelihood(y, x), 2000)]
        centre, cov = first.mean(0), 4 * np.cov(first.T) + 1e-8 * np.eye(3)
        draws = rng.multivariate_normal(centre, cov, DRAWS // 4)
        draws = draws[np.all((draws >= space.low) & (draws <= space.high), axis=1)].astype(np.float32)
        gap = draws - centre
        log_q = -0.5 * np.einsum("ni,ij,nj->n", gap, np.linalg.inv(cov), gap)
        likelihood = _log_likelihood(np.asarray(clean(jnp.asarray(draws))), x)
        return draws[_resample(rng, likelihood - log_q, n)]

    def _log_likelihood(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        return -0.5 * np.sum(((y - x) / noise) ** 2, axis=1, dtype=np.float64)

    def gain(x: np.ndarray, theta: np.ndarray) -> float:
        # the mean of x is all that they tell
        return _gain(
            lambda at: np.asarray(clean(jnp.asarray(at, jnp.float32))) / noise, x.mean(0) / noise, len(x), theta, space
        )

    settings = {"coordinates": "plain", "components": 8, "ensemble": 5}
    return Problem("pendulum", space, simulate, exact, settings, True, gain)


def _gain(
    motion: Callable[[np.ndarray], np.ndarray], mean: np.ndarray, n: int, theta: np.ndarray, space: ParameterSpace
) -> float:
    """Gain at theta [d], nats, of the posterior of n records of unit noise and this mean [D], by importance sampling.

    motion: theta [N, d] -> [N, D] without noise.
    """

    def log_likelihood(at: np.ndarray) -> np.ndarray:
        return -0.5 * n * np.sum((motion(at).astype(np.float64) - mean) ** 2, axis=1)

    d, step = len(theta), 1e-3 * np.diag(space.high - space.low)
    slope = np.linalg.solve(2 * step, motion(theta + step) - motion(theta - step))
    proposal = multivariate_t(theta, 2 * np.linalg.inv(n * slope @ slope.T + 1e-6 * np.eye(d)), df=5)
    rng, evidence = np.random.default_rng(0), 0.0
    for _ in range(4):
        draws = np.atleast_2d(proposal.rvs(20_000, random_state=rng))
        inside = np.all((draws >= space.low) & (draws <= space.high), axis=1)
        log_weights = np.where(inside, log_likelihood(draws) - proposal.logpdf(draws), -np.inf)
        weights = np.exp(log_weights - log_weights.max())
        evidence = log_weights.max() + np.log(weights.mean())
        weights /= weights.sum()
        away = draws - weights @ draws
        proposal = multivariate_t(weights @ draws, 1.5 * (away * weights[:, None]).T @ away + 1e-12 * np.eye(d), df=5)
    return float(log_likelihood(theta[None])[0] - evidence + np.log(space.high - space.low).sum())


def bounces() -> Problem:
    """A ball thrown on a floor whose slope at each contact is N(0, 0.15^2) rad: restitution, friction and drag.

    30 noisy (x, z) in 1.5 s. The slopes are not observed and every one changes all that follows: the likelihood is an
    integral over all of them, and a replay has none.
    """
    ranges = (("restitution", 0.3, 0.95), ("friction", 0.0, 0.6), ("drag", 0.0, 1.0))
    space = ParameterSpace([Parameter(n, (lo + hi) / 2, lo, hi) for n, lo, hi in ranges])
    dt, steps = 0.01, 150

    def one(key: Array, theta: Array) -> Array:
        restitution, friction, drag = theta
        k_start, k_slope, k_noise = jax.random.split(key, 3)
        height, across, up = jax.random.uniform(k_start, (3,))

        def step(state: tuple[Array, Array], slope: Array) -> tuple[tuple[Array, Array], Array]:
            at, v = state
            v = v - dt * (drag * v + jnp.asarray([0.0, 9.81]))
            normal = jnp.stack([-jnp.sin(slope), jnp.cos(slope)])
            along = jnp.stack([normal[1], -normal[0]])
            into, past = v @ normal, v @ along
            bounced = -restitution * into * normal + (1 - friction) * past * along
            v = jnp.where((at[1] < 0) & (into < 0), bounced, v)
            at = at + dt * v
            return (at, v), at

        start = jnp.stack([jnp.zeros(()), 0.5 + height]), jnp.stack([0.5 + 1.5 * across, 2 * up - 1])
        _, path = jax.lax.scan(step, start, 0.15 * jax.random.normal(k_slope, (steps,)))
        seen = path[4::5]
        return (seen + 0.02 * jax.random.normal(k_noise, seen.shape)).reshape(-1)

    thrown = jax.jit(jax.vmap(one))

    def simulate(key: Array, theta: Array) -> Array:
        return thrown(jax.random.split(key, theta.shape[0]), theta)

    return Problem("bounces", space, simulate, None, {"coordinates": "plain"})


def _resample(rng: np.random.Generator, log_weights: np.ndarray, n: int) -> np.ndarray:
    weights = np.exp(log_weights - log_weights.max())
    return rng.choice(len(weights), n, p=weights / weights.sum())


PROBLEMS = {make.__name__: make for make in (gaussian_linear, told_weakly, two_moons, pendulum, bounces)}
