"""Distributions over a ParameterSpace: one type, bounded by the box, for prior, randomisation and posterior."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bayessim_mjx.distributions.distribution import Distribution

if TYPE_CHECKING:
    from bayessim_mjx.parameters import ParameterSpace

__all__ = ["Distribution", "Gaussian", "GaussianMixture", "Uniform"]


def Uniform(space: "ParameterSpace", components: int = 1) -> Distribution:  # noqa: N802
    """Make the prior over the box (log-uniform or Gaussian where the space says so)."""
    return Distribution.prior(space, components)


def Gaussian(space: "ParameterSpace", mean: Any, sd: Any, components: int = 1) -> Distribution:  # noqa: N802
    """Gaussian in theta units, truncated to the box; sd scalar, [d], or a covariance [d, d]."""
    return Distribution.gaussian(space, mean, sd, components)


def GaussianMixture(  # noqa: N802
    space: "ParameterSpace", weights: Sequence[float], means: Any, sds: Any, components: int | None = None
) -> Distribution:
    """Mixture in theta units, truncated to the box; sds [K] of scalar, [d], or covariance [d, d]."""
    return Distribution.mixture(space, weights, means, sds, components)
