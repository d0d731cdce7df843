"""What plots need to know of a distribution: draws, ranges, names that fit, and smoothed densities of draws."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayessim_mjx.distributions.estimates import PRIOR_ITSELF, Estimates, estimates


@dataclass(frozen=True)
class Draws:
    """Draws of what was inferred in plotting coordinates: parameters with a log-uniform prior are kept as log10."""

    values: np.ndarray  # [n, d]
    numbers: Estimates  # what titles and tables say, in the parameters' own units
    names: tuple[str, ...]
    units: tuple[str, ...]
    low: np.ndarray  # [d]
    high: np.ndarray  # [d]
    log: np.ndarray  # [d] bool
    prior: np.ndarray | None = None  # [m, d] draws from the prior; None: uniform in these coordinates
    means: np.ndarray | None = None  # [K, d] means of a mixture's components

    @property
    def d(self) -> int:
        return len(self.names)

    def pick(self, index: Sequence[int] | np.ndarray) -> "Draws":
        """Pick the draws of some parameters only, in the order of `index`."""
        i = np.asarray(index, int)
        names, units = tuple(self.names[j] for j in i), tuple(self.units[j] for j in i)
        prior = None if self.prior is None else self.prior[:, i]
        means = None if self.means is None else self.means[:, i]
        numbers = self.numbers.pick(i)
        return Draws(self.values[:, i], numbers, names, units, self.low[i], self.high[i], self.log[i], prior, means)

    def coordinate(self, theta: Any) -> np.ndarray | None:
        """theta [..., d] in the parameters' own units -> plotting coordinates."""
        return None if theta is None else _logged(np.asarray(theta, float), self.log)


def draws_of(
    posterior: Any,
    names: Sequence[str] | None = None,
    low: Any = None,
    high: Any = None,
    prior: Any = None,
    units: Sequence[str] | None = None,
    log: Any = None,
    means: Any = None,
    count: int = 10_000,
) -> Draws:
    """`Draws` of a Distribution (which knows its names, ranges and prior) or of an array of samples [n, d].

    Of a Distribution they are those of what was inferred, without the share of the prior that is kept.

    Args:
        names, low, high: [d]; defaults: the distribution's own, else numbers and the range of the samples.
        prior: Distribution or samples [m, d]; None: the distribution's own, else uniform over [low, high].
        log: [d] bool, shown on a log axis.
        means: [K, d] component means to mark.
    Raises:
        ValueError: no finite sample, or names and ranges that do not match the samples' width.
    """
    space, known = getattr(posterior, "space", None), getattr(posterior, "estimates", None)
    posterior = getattr(posterior, "inferred", posterior)
    if space is not None:
        names, low, high = names or space.names, space.low if low is None else low, space.high if high is None else high
        units = units or space.units
        kinds = [p.prior for p in space.parameters]
        log = [kind == "loguniform" for kind in kinds] if log is None else log
        means = _component_means(posterior) if means is None else means
        if prior is None and "gaussian" in kinds:
            prior = space.from_unit(np.random.default_rng(0).random((count, len(space)), np.float32))
    values = _finite(_sample(posterior, count))
    d = values.shape[1]
    low = values.min(0) if low is None else np.asarray(low, float)
    high = values.max(0) if high is None else np.asarray(high, float)
    names = tuple(names) if names is not None else tuple(f"parameter {i + 1}" for i in range(d))
    for what, given in (("names", names), ("low", low), ("high", high)):
        if len(given) != d:
            raise ValueError(f"{what} has {len(given)} entries, but the samples have {d} parameters")
    high = np.where(high > low, high, low + np.maximum(np.abs(low) * 1e-3, 1e-6))
    log = np.zeros(d, bool) if log is None else np.asarray(log, bool) & (low > 0)
    back = None if prior is None else _logged(_finite(_sample(prior, count)), log)
    means = None if means is None else _logged(np.asarray(means, float).reshape(-1, d), log)
    units = tuple(units) if units else ("",) * d
    low, high = _logged(low, log), _logged(high, log)
    numbers = known() if known else estimates(values, natural(_even(low, high) if back is None else back, log).std(0))
    return Draws(_logged(values, log), numbers, names, units, low, high, log, back, means)


def natural(values: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Convert plotting coordinates [..., d] to the parameters' own units."""
    return np.where(log, 10.0 ** np.where(log, values, 0.0), values)


def _even(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.linspace(low, high, 2001)


def _sample(distribution: Any, count: int) -> np.ndarray:
    if hasattr(distribution, "sample"):
        distribution = distribution.sample(np.array([0, 7], np.uint32), count)  # a raw JAX key: plots repeat exactly
    array = np.asarray(distribution, float)
    if array.ndim != 2:
        raise ValueError(f"samples have shape {array.shape}; expected [n, d]")
    return array


def _finite(values: np.ndarray) -> np.ndarray:
    good = values[np.isfinite(values).all(1)]
    if not len(good):
        raise ValueError(f"none of the {len(values)} samples is finite")
    return good


def _logged(values: np.ndarray, log: np.ndarray) -> np.ndarray:
    return np.where(log, np.log10(np.where(log, np.maximum(values, 1e-30), 1.0)), values)


def _component_means(distribution: Any) -> np.ndarray | None:
    """Means [k, d] of the components that carry weight; none for a bare prior. Means outside the box are held at it."""
    if float(getattr(distribution, "prior_weight", 1.0)) >= PRIOR_ITSELF or not hasattr(distribution, "means"):
        return None
    logits = np.asarray(distribution.logits, float)
    weights = np.exp(logits - logits.max())
    means = np.clip(np.asarray(distribution.means), 0.0, 1.0)[weights / weights.sum() > 0.02]
    return np.asarray(distribution.space.from_unit(means))


# ---- densities: histograms smoothed by a Gaussian that is reflected at the ends, so no mass leaks out of the range


def density(values: np.ndarray, low: float, high: float, cells: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed density of values [n] on [low, high]: (cell centres [cells], density [cells]), integrating to 1."""
    from scipy.ndimage import gaussian_filter1d

    counts, edges = np.histogram(values, cells, (low, high))
    width = _bandwidth(values, 1) / (high - low) * cells
    smooth = gaussian_filter1d(counts.astype(float), max(width, 0.7), mode="reflect")
    return (edges[1:] + edges[:-1]) / 2, smooth / max(smooth.sum(), 1e-12) * cells / (high - low)


def density2(x: np.ndarray, y: np.ndarray, box: tuple[float, float, float, float], cells: int = 80) -> Any:
    """Smoothed density of (x, y) in box (x low, x high, y low, y high): (xs, ys, density [cells y, cells x])."""
    from scipy.ndimage import gaussian_filter

    counts, ex, ey = np.histogram2d(x, y, cells, ((box[0], box[1]), (box[2], box[3])))
    narrow = np.sqrt(max(1.0 - _correlation(x, y) ** 2, 0.02))  # do not blur a thin ridge
    sigma = [
        max(_bandwidth(v, 2) * narrow / (b - a) * cells, 0.8) for v, a, b in ((x, box[0], box[1]), (y, box[2], box[3]))
    ]
    smooth = gaussian_filter(counts, sigma, mode="reflect").T
    return (ex[1:] + ex[:-1]) / 2, (ey[1:] + ey[:-1]) / 2, smooth / max(smooth.sum(), 1e-12)


def levels(density: np.ndarray, masses: Sequence[float]) -> list[float]:
    """Heights of the contours that hold the given masses (highest density regions), rising."""
    ranked = np.sort(density.ravel())[::-1]
    total = np.cumsum(ranked)
    found = [float(ranked[min(np.searchsorted(total, m * total[-1]), len(ranked) - 1)]) for m in masses]
    return sorted(set(found))


def _bandwidth(values: np.ndarray, d: int) -> float:
    """Scott's rule, n^(-1/(d+4)), with a spread that ignores far modes; contours of a plane want a quarter more."""
    quartiles = np.percentile(values, [25, 75])
    spread = min(float(values.std()), float(quartiles[1] - quartiles[0]) / 1.34 or float(values.std()))
    return (1.25 if d > 1 else 1.0) * spread * len(values) ** (-1.0 / (d + 4))


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    sx, sy = x.std(), y.std()
    return float(((x - x.mean()) * (y - y.mean())).mean() / (sx * sy)) if sx > 0 and sy > 0 else 0.0


# ---- names that fit
