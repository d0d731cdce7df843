"""Mixture algebra on the host in float64: products and quotients of Gaussian mixtures with a flat part, reduction.

A `Mixture` is  exp(flat) p + sum_k exp(log_weights_k) N(means_k, covs_k)  up to a constant factor. The prior p is 1 on
the unit cube (precision 0) or N(0, I) (precision 1).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

NEGLIGIBLE = 1e-8  # relative mass below which a component is dropped
CROWD = 96  # components kept before merging (bounds the pairwise work)


class Mixture(NamedTuple):
    """Unnormalised density; flat is -inf where there is no part of the prior."""

    flat: float
    log_weights: np.ndarray  # [K]
    means: np.ndarray  # [K, d]
    covs: np.ndarray  # [K, d, d]
    prior: float = 0.0  # precision of the prior


def product(a: Mixture, b: Mixture) -> Mixture:
    """a b / p, closed form: all pairs N(m1, S1) N(m2, S2) / p, and each part of the prior leaves the other factor."""
    weights, means, covs = _pairs(a, b) if a.prior == 0 else _pairs_over_normal(a, b)
    terms = [(weights, means, covs)]
    if np.isfinite(b.flat):
        terms.append((a.log_weights + b.flat, a.means, a.covs))
    if np.isfinite(a.flat):
        terms.append((b.log_weights + a.flat, b.means, b.covs))
    weights, means, covs = (np.concatenate(part) for part in zip(*terms, strict=True))
    return _rescaled(Mixture(a.flat + b.flat, weights, means, covs, a.prior))


def _pairs(a: Mixture, b: Mixture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """N(m1, S1) N(m2, S2) = N(m1; m2, S1 + S2) N(m, S), S^-1 = S1^-1 + S2^-1."""
    d = a.means.shape[1]
    total = a.covs[:, None] + b.covs[None, :]  # [Ka, Kb, d, d]
    gain = np.swapaxes(np.linalg.solve(total, np.broadcast_to(a.covs[:, None], total.shape)), -1, -2)  # S1 (S1+S2)^-1
    delta = b.means[None, :] - a.means[:, None]
    means = a.means[:, None] + np.einsum("abij,abj->abi", gain, delta)
    covs = np.einsum("abij,bjk->abik", gain, b.covs)
    maha = np.einsum("abi,abi->ab", delta, np.linalg.solve(total, delta[..., None])[..., 0])
    overlap = -0.5 * (maha + np.linalg.slogdet(total)[1] + d * np.log(2 * np.pi))
    weights = a.log_weights[:, None] + b.log_weights[None, :] + overlap
    return weights.reshape(-1), means.reshape(-1, d), _symmetric(covs.reshape(-1, d, d))


def _pairs_over_normal(a: Mixture, b: Mixture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """N(m1, S1) N(m2, S2) / N(0, I): precision P1 + P2 - I, shift P1 m1 + P2 m2."""
    d = a.means.shape[1]
    (pa, ha, ca), (pb, hb, cb) = _natural(a), _natural(b)
    precision = (pa[:, None] + pb[None] - np.eye(d)).reshape(-1, d, d)
    weights = (a.log_weights + ca)[:, None] + (b.log_weights + cb)[None]
    return _moments(weights.reshape(-1), precision, (ha[:, None] + hb[None]).reshape(-1, d))


def _natural(mixture: Mixture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Precisions, shifts P m and 1/2 (log|P| - m P m). A component that is broader than the prior is cut to it:
    a single data set cannot take knowledge away, and the product of many would have no finite mass."""
    precision = _symmetric(np.linalg.inv(mixture.covs))
    if mixture.prior:
        values, vectors = np.linalg.eigh(precision)
        precision = np.einsum("kij,kj,klj->kil", vectors, np.maximum(values, mixture.prior), vectors)
    shift = np.einsum("kij,kj->ki", precision, mixture.means)
    return precision, shift, 0.5 * (np.linalg.slogdet(precision)[1] - np.sum(shift * mixture.means, axis=1))


def _moments(
    weights: np.ndarray, precision: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Completes the square: exp(weights - z P z / 2 + h z) -> log masses (less d/2 log 2 pi), means, covariances."""
    covs = _symmetric(np.linalg.inv(precision))
    means = np.einsum("kij,kj->ki", covs, shift)
    gain = 0.5 * (np.sum(shift * means, axis=1) - np.linalg.slogdet(precision)[1])
    return weights + gain, means, covs


def divide(mixture: Mixture, mean: np.ndarray, cov: np.ndarray) -> tuple[Mixture | None, float]:
    """mixture p / N(mean, cov) (BayesSim, eq. 19 with Sigma'), and the share of weight of components left out.

    Left out are components whose quotient has no positive definite precision P_k + P_p - P_0. None where none is left.
    The mixture's part of the prior is taken to be negligible.
    """
    d = len(mean)
    # not `_natural(mixture)`: here a component may be broader than the prior
    pk, hk, ck = _natural(mixture._replace(prior=0.0))
    p0, h0, _ = _natural(Mixture(-np.inf, np.zeros(1), mean[None], cov[None]))
    precision = pk + mixture.prior * np.eye(d) - p0
    proper = np.linalg.eigvalsh(precision)[:, 0] > 1e-9 * np.linalg.eigvalsh(pk)[:, 0]
    shares = np.exp(mixture.log_weights - np.logaddexp.reduce(mixture.log_weights))
    lost = float(shares[~proper].sum())
    if not proper.any():
        return None, lost
    weights, means, covs = _moments((mixture.log_weights + ck)[proper], precision[proper], (hk - h0)[proper])
    return _rescaled(Mixture(-np.inf, weights, means, covs, mixture.prior)), lost


def reduce(mixture: Mixture, components: int) -> Mixture:
    """Drop negligible components, then merge the pair that costs least (Runnalls 2007, eq. 16) until K are left."""
    mixture = prune(mixture)
    weights, means, covs = np.exp(np.maximum(mixture.log_weights, -600.0)), mixture.means, mixture.covs
    if len(weights) <= components:
        return mixture
    cost = _cost_table(weights, means, covs)
    while len(weights) > components:
        i, j = sorted(divmod(int(np.argmin(cost)), len(weights)))
        weights, means, covs = _merge(weights, means, covs, i, j)
        cost = np.delete(np.delete(cost, j, 0), j, 1)
        row = _costs_to(weights, means, covs, i)
        cost[i, :], cost[:, i] = row, row
    return Mixture(mixture.flat, np.log(weights), means, covs, mixture.prior)


def prune(mixture: Mixture) -> Mixture:
    """Drop components whose mass inside the cube is negligible, and all but the CROWD heaviest."""
    scores = mixture.log_weights
    if mixture.prior == 0:  # the others are not cut off
        scores = scores + log_mass_bound(mixture.means, mixture.covs)
    keep = scores > max(scores.max(), mixture.flat) + np.log(NEGLIGIBLE)
    keep &= scores >= np.sort(scores)[-min(CROWD, len(scores))]
    keep |= scores == scores.max()
    kept = mixture.log_weights[keep], mixture.means[keep], mixture.covs[keep]
    return _rescaled(Mixture(mixture.flat, *kept, mixture.prior))


def log_mass_bound(means: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """Each Gaussian's log mass beyond the nearest wall of the cube (log 1/2 for a mean inside), [K]: a cheap bound."""
    sd = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    return np.min(log_ndtr(np.minimum(np.minimum(means, 1 - means) / sd, 0)), axis=1)


def _rescaled(mixture: Mixture) -> Mixture:
    top = max(float(mixture.log_weights.max()), mixture.flat)
    return mixture._replace(flat=mixture.flat - top, log_weights=mixture.log_weights - top)


def _symmetric(covs: np.ndarray) -> np.ndarray:
    return 0.5 * (covs + np.swapaxes(covs, -1, -2))


def _join(w: np.ndarray, m: np.ndarray, c: np.ndarray, i: int, j: np.ndarray | int) -> tuple:
    """Moments of component i joined with each of the components j."""
    share = (w[i] / (w[i] + w[j]))[..., None]
    gap = m[i] - m[j]
    mean = share * m[i] + (1 - share) * m[j]
    spread = (share * (1 - share))[..., None] * gap[..., :, None] * gap[..., None, :]
    return mean, share[..., None] * c[i] + (1 - share[..., None]) * c[j] + spread


def _costs_to(w: np.ndarray, m: np.ndarray, c: np.ndarray, i: int) -> np.ndarray:
    """Runnalls' bound on the divergence of merging i with every other component, [K]."""
    everyone = np.arange(len(w))
    log_det = np.linalg.slogdet(c)[1]
    joint = np.linalg.slogdet(_join(w, m, c, i, everyone)[1])[1]
    # B(i, j) = 1/2 [(w_i + w_j) ln|S_ij| - w_i ln|S_i| - w_j ln|S_j|]
    cost = 0.5 * ((w[i] + w) * joint - w[i] * log_det[i] - w * log_det)
    cost[i] = np.inf
    return cost


def _cost_table(w: np.ndarray, m: np.ndarray, c: np.ndarray) -> np.ndarray:
    return np.stack([_costs_to(w, m, c, i) for i in range(len(w))])


def _merge(w: np.ndarray, m: np.ndarray, c: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mean, cov = _join(w, m, c, i, j)
    w, m, c = w.copy(), m.copy(), c.copy()
    w[i], m[i], c[i] = w[i] + w[j], mean, _symmetric(cov)
    return np.delete(w, j), np.delete(m, j, 0), np.delete(c, j, 0)
