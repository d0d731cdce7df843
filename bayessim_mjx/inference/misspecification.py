"""Whether a real summary lies outside what simulation can produce, with p-values that are exact by ranks.

Three scores of a summary z, each ranked among those of fresh simulations (exchangeable with a real trajectory where
nothing is wrong): the distance of z from what emulator.py says is simulated at the theta that explains it best, in
units of the noise at that theta; its part that is as smooth as what theta does; the distance to the nearest simulations
in the network's last hidden layer. The first is two-sided, as noise that is lower than assumed makes the residual too
small. The three p-values are combined and the combination is ranked again, which makes
it one p-value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.inference import emulator, mdn
from bayessim_mjx.inference.numbers import DRAWS
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import REGRESSED, RIDGE, inverse_spread, product

# random features of theta-hat behind E[z | theta-hat]; as many whitened coordinates: a longer summary's residual is
# projected at random
FOURIER = InferenceSettings.fourierFeatures
WIDTH = 6**-0.5  # their length scale in units of the box: the root mean square distance of two draws of the prior
# p-value below which the posterior is distrusted: 6.0 % (2.8 to 8.0) of sound trajectories are.
# source: benchmarks/records/misspecified.json
FLAGGED = 0.05
TWO_SIDED = (True, False, False)


class Scores(NamedTuple):
    """Scores of n summaries."""

    joint: Array  # [n, 3] residual, smooth residual, distance to simulations
    features: Array  # [n, D] residual of each feature given the others, in its standard deviations


@dataclass(frozen=True)
class Misfit:
    """Distance of real summaries from simulated ones; arrays over n real trajectories, on the host."""

    p: np.ndarray  # [n] of each trajectory: uniform where nothing is wrong
    parts: np.ndarray  # [n, 3] the p-value of each score by itself
    sides: np.ndarray  # [n, 3] +1 the score is high, -1 low
    features: np.ndarray  # [n, D] two-sided p-value of each feature by itself
    residuals: np.ndarray  # [n, D] of each feature given the others, in its standard deviations
    reference: int  # simulations that they were ranked among
    names: tuple[str, ...] = ()  # [D] of the features

    @property
    def joint(self) -> float:
        """One p-value for all trajectories (Cauchy combination: they share theta, hence are not independent)."""
        return combined(self.p)

    @property
    def flagged(self) -> bool:
        return self.joint < FLAGGED

    def prior_share(self, most: float) -> float:
        """Share of the prior in the randomisation: 0 where nothing is flagged, rising to `most` at p = 0."""
        return most * max(0.0, 1.0 - self.joint / FLAGGED)

    def part(self, rows: slice) -> Misfit:
        """Select the result of some of the trajectories."""
        found = {name: getattr(self, name)[rows] for name in ("p", "parts", "sides", "features", "residuals")}
        return replace(self, **found)

    def sentence(self) -> str:
        """Write a sentence for a person; empty where nothing is wrong."""
        if not self.flagged:
            return ""
        worst = int(np.argmin(self.p))
        many = "" if len(self.p) == 1 else f", worst of {len(self.p)}: trajectory {worst + 1}"
        count = f"p = {self.joint:.2g} among {self.reference} simulations{many}"
        return f"the real trajectories are unlike anything simulated ({count}): {self._why(worst)}"

    def _why(self, row: int) -> str:
        # of all trajectories together: the least likely one may lie on the other side by chance
        score = int(np.argmin([combined(own) for own in self.parts.T]))
        if TWO_SIDED[score] and np.median(self.sides[:, score]) < 0:
            return "they follow the simulator too closely, so the noise is assumed too large"
        return f"something moves them that no parameter explains, or the noise is larger (most in {self.worst(row)})"

    def worst(self, row: int) -> str:
        """Name the feature of one trajectory that is least like simulated ones."""
        # several may lie beyond all simulations: then the farthest
        feature = int(np.lexsort((-np.abs(self.residuals[row]), self.features[row]))[0])
        return self.names[feature] if self.names else f"feature {feature}"


def combined(p: np.ndarray) -> float:
    """Cauchy combination of p-values [n], valid under dependence (Liu and Xie 2020)."""
    p = np.clip(p, 1e-6, 1 - 1e-6)
    return float(0.5 - np.arctan(np.mean(np.tan((0.5 - p) * np.pi))) / np.pi)


def detect(
    state: Any, simulated: tuple[Array, Array, int | Array], held: Array, real: Array, names: Sequence[str] = ()
) -> Misfit:
    """Test real summaries [n, D] against fresh simulations `held` [m, D] that the network has not seen.

    `simulated` is what the network of `state` was fitted on: thetas [N, d], x [N, D] and how many of their rows are
    valid. `names` [D] say what the features are.
    """
    rows, (thetas, x, count) = jnp.concatenate([jnp.asarray(held), jnp.asarray(real)]), simulated
    scores = jax.tree.map(np.asarray, score(state, thetas, x, jnp.asarray(count, jnp.int32), rows))
    m = held.shape[0]
    usable = np.all(np.isfinite(scores.joint[:m]), axis=1) & np.all(np.isfinite(scores.features[:m]), axis=1)
    found = ranked(Scores(*(s[:m][usable] for s in scores)), Scores(*(s[m:] for s in scores)))
    return replace(found, names=tuple(names))


def ranked(held: Scores, real: Scores) -> Misfit:
    """p-values of `real` scores by their ranks among `held` ones and themselves; not finite counts as the highest."""
    joint = np.nan_to_num(np.asarray(real.joint, np.float64), nan=np.inf)
    found = [_joint(np.asarray(held.joint, np.float64), row) for row in joint]
    p, parts, sides = (np.asarray(v) for v in zip(*found, strict=True))
    residuals = np.asarray(real.features)
    return Misfit(p, parts, sides, _two_sided(np.asarray(held.features), residuals), residuals, len(held.joint))


def _joint(held: np.ndarray, row: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """(p, p of each score, its side) of one row [3] pooled with held [m, 3]: exact where all are exchangeable."""
    pool = np.concatenate([held, row[None]])
    n = len(pool)
    at_least = n - _count_below(pool)  # [n, 3] members of the pool that are as high or higher
    at_most = n - _count_below(-pool)
    tail = np.minimum(np.where(TWO_SIDED, 2.0 * np.minimum(at_least, at_most), at_least) / n, 1.0)
    # Cauchy combination; a score that fits well (p > 1/2) is no evidence against the others
    evidence = np.sum(np.tan((0.5 - np.minimum(tail, 0.5)) * np.pi) - 1e-3 * tail, axis=1)  # the last: no ties
    p = float(np.mean(evidence >= evidence[-1]))
    return p, tail[-1], np.where(at_least[-1] <= at_most[-1], 1, -1)


def _count_below(pool: np.ndarray) -> np.ndarray:
    """Count the smaller values in each column, [n, k]."""
    return np.stack([np.searchsorted(np.sort(column), column, side="left") for column in pool.T], axis=1)


def _two_sided(held: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Two-sided rank p-value of each column of real [n, D] among held [m, D] and itself."""
    below = np.stack([np.mean(held <= row, axis=0) for row in real])
    above = np.stack([np.mean(held >= row, axis=0) for row in real])
    m = len(held)
    return np.minimum(1.0, 2 * (m * np.minimum(below, above) + 1) / (m + 1))


def latent(state: Any, x: Array) -> Array:
    """Compute the network's features of summaries x [n, D]: the last hidden layers of all members, [n, E H]."""
    z = state.inputs(x)
    layers = jax.vmap(lambda params: mdn.hidden(params, mdn.embedded(params, z, state.settings), state.settings))(
        state.params
    )
    return jnp.moveaxis(layers, 0, 1).reshape(x.shape[0], -1)


@jax.jit
def score(state: Any, thetas: Array, x: Array, count: Array, rows: Array) -> Scores:
    """Scores of summaries `rows` [n, D]; the first `count` of thetas [N, d], x [N, D] describe the simulations."""
    finite = jnp.all(jnp.isfinite(x), axis=1)
    used = ((jnp.arange(x.shape[0]) < count) & finite).astype(jnp.float32)
    x = jnp.where(finite[:, None], x, 0.0)
    z, z_new = _standardised(x, used, x, rows)
    h, h_new = _standardised(latent(state, x), used, latent(state, x), latent(state, rows))
    u = jnp.where(used[:, None] > 0, jax.vmap(state.space.to_unit)(thetas), 0.5)
    ones = jnp.ones((x.shape[0], 1)), jnp.ones((rows.shape[0], 1))
    whitener = _whitener(z, used)
    y, y_new = product(z, whitener), product(z_new, whitener)
    params = emulator.trained(u, y, used)
    # noise, and the emulator's error: what is left at the true theta
    unit = _whitener(y - emulator.emulated(params, u), used)
    turn, weight = _signal(product(emulator.emulated(params, u), unit), used)
    unit = product(unit, turn)
    estimate = _ridge(jnp.concatenate([h, z, ones[0]], 1), u, used)
    first = lambda v: v[:DRAWS]  # noqa: E731
    (best, w), (best_new, w_new) = (
        emulator.explained(params, unit, first(u), jnp.clip(product(jnp.concatenate([*rows], 1), estimate), 0, 1), goal)
        for rows, goal in (((first(h), first(z), first(ones[0])), first(y)), ((h_new, z_new, ones[1]), y_new))
    )
    f, f_new = _fourier(best), _fourier(best_new)
    # log w^2 given theta: noise and the reach of the emulator differ over the box
    spread = _ridge(f, jnp.log(w * w + 1e-3), first(used))
    scaled = w_new / jnp.exp(0.5 * product(f_new, spread))
    near = _nearest(first(h), first(used), h_new)
    smooth = jnp.log(jnp.sum(weight[None, :] * scaled**2, 1))
    joint = jnp.stack([jnp.log(jnp.sum(scaled**2, 1)), smooth, near], axis=1)
    return Scores(joint, _alone(z, f, used, z_new, f_new))


def _signal(signal: Array, used: Array) -> tuple[Array, Array]:
    """Principal directions [m, m] of what theta does to the signal [N, m], in noises, and the weight of each [m].

    Unmodelled physics moves a trajectory as smoothly as theta does, noise does not: sum weight w^2 is twice
    log N(w; 0, I + S) / N(w; 0, I) but for a constant, S the covariance of the signal.
    """
    away = (signal - _mean(signal, used)[None, :]) * used[:, None]
    values, vectors = jnp.linalg.eigh(product(away.T, away) / jnp.maximum(jnp.sum(used), 1.0))
    values = jnp.maximum(values, 0.0)
    return vectors, values / (1 + values)


def _alone(z: Array, f: Array, used: Array, z_new: Array, f_new: Array) -> Array:
    """Distance of each feature from its prediction by all others, in standard deviations -> [n, D].

    One odd feature spoils theta-hat and with it the residuals of features that are as they should be; so those are
    taken only where there are too many features to invert their covariance. f [DRAWS, F] are functions of theta-hat.
    """
    if z.shape[1] > REGRESSED:
        z, used = z[: f.shape[0]], used[: f.shape[0]]
        mean = _ridge(f, z, used)
        r, r_new = z - product(f, mean), z_new - product(f_new, mean)
        return r_new / (jnp.sqrt(_mean(r * r, used)) + 1e-6)[None, :]
    cov = product((z * used[:, None]).T, z) / jnp.maximum(jnp.sum(used), 1.0) + RIDGE * jnp.eye(z.shape[1])
    precision = jnp.linalg.inv(cov)
    # z_j - E[z_j | the others] = (P z)_j / P_jj, of variance 1 / P_jj
    return product(z_new, precision) / jnp.sqrt(jnp.diagonal(precision))[None, :]


def _mean(values: Array, used: Array) -> Array:
    return used @ values / jnp.maximum(jnp.sum(used), 1.0)


def _standardised(x: Array, used: Array, *arrays: Array) -> list[Array]:
    """Each of `arrays` by mean and sd of the used rows of x; columns that do not vary become 0."""
    mean = _mean(x, used)
    sd = jnp.sqrt(_mean((x - mean[None, :]) ** 2, used))
    rate = inverse_spread(mean, sd)
    return [
        jnp.clip((a - mean[None, :]) * rate[None, :], -InferenceSettings.clip, InferenceSettings.clip) for a in arrays
    ]


def _ridge(f: Array, y: Array, used: Array) -> Array:
    """Coefficients [F, Y] of y [N, Y] on f [N, F]."""
    n = jnp.maximum(jnp.sum(used), 1.0)
    gram = product((f * used[:, None]).T, f) / n + RIDGE * jnp.eye(f.shape[1])
    return jnp.linalg.solve(gram, product((f * used[:, None]).T, y) / n)


def _fourier(u: Array) -> Array:
    """Smooth functions of theta-hat [n, d] -> [n, FOURIER + d + 1]."""
    rng, d = np.random.default_rng(0), u.shape[1]
    frequency = jnp.asarray(rng.normal(size=(d, FOURIER)) / (WIDTH * np.sqrt(max(1.0, d / 3))), jnp.float32)
    phase = jnp.asarray(rng.uniform(0, 2 * np.pi, FOURIER), jnp.float32)
    waves = np.float32(np.sqrt(2.0)) * jnp.cos(product(u, frequency) + phase[None, :])
    return jnp.concatenate([waves, u, jnp.ones((u.shape[0], 1))], axis=1)


def _whitener(r: Array, used: Array) -> Array:
    """Matrix [D, m] after which the used residuals have covariance 1; m <= FOURIER."""
    size = r.shape[1]
    projection = jnp.eye(size)
    if size > FOURIER:
        projection = jnp.asarray(np.random.default_rng(1).normal(size=(size, FOURIER)) / np.sqrt(size), jnp.float32)
    p = product(r, projection) * used[:, None]
    cov = product(p.T, p) / jnp.maximum(jnp.sum(used), 1.0)
    values, vectors = jnp.linalg.eigh(cov)
    floor = 1e-5 * jnp.max(values)
    kept = jnp.where(values > floor, 1.0 / jnp.sqrt(jnp.maximum(values, floor)), 0.0)  # constant columns
    return product(projection, vectors * kept[None, :])


def _nearest(h: Array, used: Array, new: Array) -> Array:
    """Log distance of new [n, H] to the nearest used row of h [N, H]."""
    square = jnp.sum(new**2, 1)[:, None] + jnp.sum(h**2, 1)[None, :] - 2 * product(new, h.T)
    square = jnp.where(used[None, :] > 0, jnp.maximum(square, 1e-9), jnp.inf)
    return 0.5 * jnp.log(jnp.min(square, axis=1))
