"""Prior CDF, its inverse and log density, elementwise over the parameters of a space."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr, ndtri

from bayessim_mjx.parameters.parameter import Parameter


class Space(Protocol):
    """What is read of a `ParameterSpace`, `[d]` each."""

    parameters: tuple[Parameter, ...]
    low: Any  # numpy's, known when a program is compiled, or arrays of a `Ranged` space
    high: Any


def _library(space: Space) -> Any:
    """Choose the library that computes with the ends of the ranges: constants stay numpy's."""
    return np if isinstance(space.low, np.ndarray) else jnp


def to_unit(space: Space, theta: jax.Array) -> jax.Array:
    """theta `[..., d]` -> CDF values `[..., d]`; 0 below and 1 above the range."""
    theta = jnp.clip(theta, space.low, space.high)
    u = (theta - space.low) / (space.high - space.low)
    log, gauss = _is(space, "loguniform"), _is(space, "gaussian")
    if log.any():
        xp = _library(space)
        low, high = xp.where(log, space.low, 1.0), xp.where(log, space.high, 2.0)
        # u = ln(theta / low) / ln(high / low)
        u = jnp.where(log, jnp.log(jnp.where(log, theta, 1.0) / low) / xp.log(high / low), u)
    if gauss.any():
        mean, sd, a, b = _normal(space)
        # u = (Phi(z) - Phi(a)) / (Phi(b) - Phi(a))
        u = jnp.where(gauss, (ndtr((theta - mean) / sd) - ndtr(a)) / (ndtr(b) - ndtr(a)), u)
    return jnp.clip(u, 0.0, 1.0)


def from_unit(space: Space, u: jax.Array) -> jax.Array:
    """CDF values `[..., d]` -> theta `[..., d]`, clipped to the range."""
    u = jnp.clip(u, 0.0, 1.0)
    theta = space.low + u * (space.high - space.low)
    log, gauss = _is(space, "loguniform"), _is(space, "gaussian")
    if log.any():
        xp = _library(space)
        low, high = xp.where(log, space.low, 1.0), xp.where(log, space.high, 2.0)
        theta = jnp.where(log, low * jnp.exp(u * xp.log(high / low)), theta)
    if gauss.any():
        mean, sd, a, b = _normal(space)
        theta = jnp.where(gauss, mean + sd * ndtri(ndtr(a) + u * (ndtr(b) - ndtr(a))), theta)
    # the ends exactly, and no rounding beyond them
    theta = jnp.where(u <= 0.0, space.low, jnp.where(u >= 1.0, space.high, theta))
    return jnp.clip(theta, space.low, space.high)


def log_density(space: Space, theta: jax.Array) -> jax.Array:
    """Log density per parameter `[..., d]`, in theta units; meaningful inside the range only."""
    xp = _library(space)
    width = (space.high - space.low).astype(np.float64 if xp is np else np.float32)
    density = jnp.broadcast_to(jnp.asarray(-xp.log(width), jnp.float32), theta.shape)
    log, gauss = _is(space, "loguniform"), _is(space, "gaussian")
    if log.any():
        low, high = xp.where(log, space.low, 1.0), xp.where(log, space.high, 2.0)
        # p = 1 / (theta ln(high / low))
        safe = jnp.where(log & (theta > 0), theta, 1.0)
        density = jnp.where(log, -jnp.log(safe) - xp.log(xp.log(high / low)), density)
    if gauss.any():
        mean, sd, a, b = _normal(space)
        z = (theta - mean) / sd
        mass = jnp.log(ndtr(b) - ndtr(a))
        density = jnp.where(gauss, -0.5 * z**2 - jnp.log(sd) - 0.5 * np.log(2 * np.pi) - mass, density)
    return density


def _is(space: Space, prior: str) -> np.ndarray:
    return np.asarray([p.prior == prior for p in space.parameters], bool)


def _normal(space: Space) -> tuple[np.ndarray, np.ndarray, Any, Any]:
    """mean, sd and the standardised ends; harmless numbers in the columns of other priors."""
    gauss = _is(space, "gaussian")
    mean = np.asarray([p.mean if g else 0.0 for p, g in zip(space.parameters, gauss, strict=True)], np.float32)
    sd = np.asarray([p.sd if g else 1.0 for p, g in zip(space.parameters, gauss, strict=True)], np.float32)
    xp = _library(space)
    a, b = xp.where(gauss, (space.low - mean) / sd, -1.0), xp.where(gauss, (space.high - mean) / sd, 1.0)
    return mean, sd, a.astype(np.float32), b.astype(np.float32)
