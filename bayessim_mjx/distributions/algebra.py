"""Mixture algebra on the host in float64: products and quotients of Gaussian mixtures with a flat part, reduction.

A `Mixture` is  exp(flat) p + sum_k exp(log_weights_k) N(means_k, scales_k scales_k^T)  up to a constant factor. The
prior p is 1 on the unit cube (precision 0) or N(0, I) (precision 1).

Covariances and precisions are never formed where they are added: S is the Cholesky factor of a covariance, T = S^-1,
and a triangular factor of T1^T T1 + T2^T T2 comes of T1 and T2 stacked, by orthogonal transformations (Bierman, 1977).
So everything stays positive definite, and twice as many digits are kept.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

from bayessim_mjx.distributions.box import separated

NEGLIGIBLE = 1e-8  # relative mass below which a component is dropped
FAINT = 1e-12  # the same of a factor: where all others contradict, a faint component may decide
MASS_POINTS, FEW_POINTS = (
    64,
    16,
)  # behind the mass of a component in the cube: where pairs are merged, where some are dropped
CROWD = 96  # components kept before merging (bounds the pairwise work)
# standard deviations in coordinates of the chart: what is broader is flat over the unit cube to 1e-8, what is thinner
# a point in float32; a network may put out both in one component
WIDEST, THINNEST = 1e4, 1e-10


class Mixture(NamedTuple):
    """Unnormalised density; flat is -inf where there is no part of the prior."""

    flat: float
    log_weights: np.ndarray  # [K]
    means: np.ndarray  # [K, d]
    scales: np.ndarray  # [K, d, d] lower Cholesky factors of the covariances
    prior: float = 0.0  # precision of the prior


def product(a: Mixture, b: Mixture) -> Mixture:
    """Compute a b / p: all pairs N(m1, S1) N(m2, S2) / p, and each part of the prior leaves the other factor."""
    a, b = (_conditioned(prune(x, FAINT)) for x in (a, b))
    terms = [_pairs(a, b)]
    if np.isfinite(b.flat):
        terms.append((a.log_weights + b.flat, a.means, a.scales))
    if np.isfinite(a.flat):
        terms.append((b.log_weights + a.flat, b.means, b.scales))
    weights, means, scales = (np.concatenate(part) for part in zip(*terms, strict=True))
    return _rescaled(Mixture(a.flat + b.flat, weights, means, scales, a.prior))


def _conditioned(mixture: Mixture) -> Mixture:
    """Express the same density in the cube by components whose widths float64 can add.

    In the probit chart a component that is broader than the prior is cut to it: a single data set cannot take knowledge
    away, and the product of many would have no finite mass.
    """
    k, d = mixture.means.shape
    eye = np.broadcast_to(np.eye(d), (k, d, d))
    scales = root(np.concatenate([np.swapaxes(mixture.scales, -1, -2), THINNEST * eye], axis=-2))
    mixture = mixture._replace(scales=scales)
    if mixture.prior:
        _, widths, axes = np.linalg.svd(_inverse(scales))
        whiten = _coroot(np.maximum(widths, np.sqrt(mixture.prior))[..., None] * axes)
        return mixture._replace(scales=_inverse(whiten))
    flat = Mixture(-np.inf, np.zeros(1), np.full((1, d), 0.5), WIDEST * eye[:1])
    weights, means, scales = _pairs(mixture, flat)
    # up to the height of the flat Gaussian
    weights = weights + d * (np.log(WIDEST) + 0.5 * np.log(2 * np.pi))
    return mixture._replace(log_weights=weights, means=means, scales=scales)


def _pairs(a: Mixture, b: Mixture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """N(m1, S1) N(m2, S2) / p of all pairs: log masses [n], means [n, d] and scales [n, d, d].

    |T1 (x - m1)|^2 + |E2 (x - m2)|^2 = |T (x - m)|^2 + rest^2, E2^T E2 = T2^T T2 - prior, is one least-squares problem;
    of a Gaussian prior a linear term m2 x - |m2|^2 / 2 is left.
    """
    (ka, d), kb = a.means.shape, len(b.means)
    Ta, Tb = _inverse(a.scales), _inverse(b.scales)
    Eb = Tb
    if a.prior:
        _, widths, axes = np.linalg.svd(Tb)
        Eb = np.sqrt(np.maximum(widths**2 - a.prior, 0.0))[..., None] * axes
    delta = b.means[None, :] - a.means[:, None]
    stack = np.zeros((ka, kb, 2 * d, 1 + d))
    stack[..., :d, 1:], stack[..., d:, 1:] = Ta[:, None], Eb[None]
    stack[..., d:, 0] = np.einsum("bij,abj->abi", Eb, delta)
    both = _coroot(stack)  # [[rest, 0], [T m, T]]
    scales = _inverse(both[..., 1:, 1:])
    means = a.means[:, None] + np.einsum("abij,abj->abi", scales, both[..., 1:, 0])
    weights = _log_det(Ta)[:, None] + _log_det(Tb)[None] + _log_det(scales) - 0.5 * both[..., 0, 0] ** 2
    if a.prior:
        pull = np.einsum("abji,bj->abi", scales, b.means)
        weights = weights + np.einsum("abi,bi->ab", means, b.means) - 0.5 * np.sum(b.means**2, axis=1)[None]
        weights = weights + 0.5 * np.sum(pull**2, axis=-1)
        means = means + np.einsum("abij,abj->abi", scales, pull)
    else:
        weights = weights - 0.5 * d * np.log(2 * np.pi)
    weights = weights + a.log_weights[:, None] + b.log_weights[None, :]
    return weights.reshape(-1), means.reshape(-1, d), scales.reshape(-1, d, d)


def divide(mixture: Mixture, mean: np.ndarray, scale: np.ndarray) -> tuple[Mixture | None, float]:
    """mixture p / N(mean, scale scale^T) (BayesSim, eq. 19 with Sigma'), and the share of weight of what is left out.

    Left out are components whose quotient has no positive definite precision P_k + P_p - P_0. None where none is left.
    The mixture's part of the prior is taken to be negligible.
    """
    k, d = mixture.means.shape
    eye = np.broadcast_to(np.eye(d), (k, d, d))
    Tk, T0 = _inverse(mixture.scales), _inverse(scale[None])[0]
    whiten = _coroot(np.concatenate([Tk, np.sqrt(mixture.prior) * eye], axis=-2))  # of P_k + P_p
    _, widths, axes = np.linalg.svd(T0 @ _inverse(whiten))
    proper = widths[:, 0] ** 2 < 1 - 1e-9
    shares = np.exp(mixture.log_weights - np.logaddexp.reduce(mixture.log_weights))
    lost = float(shares[~proper].sum())
    if not proper.any():
        return None, lost
    means, off = mixture.means[proper], mixture.means[proper] - mean
    rows = np.sqrt(1 - widths[proper] ** 2)[..., None] * axes[proper]
    scales = _inverse(_coroot(rows @ whiten[proper]))
    # log density and its slope at the component's mean, where the component itself has none
    height = 0.5 * np.sum((off @ T0.T) ** 2, axis=1) - 0.5 * mixture.prior * np.sum(means**2, axis=1)
    pull = np.einsum("kji,kj->ki", scales, off @ T0.T @ T0 - mixture.prior * means)
    weights = mixture.log_weights[proper] + _log_det(Tk[proper]) + _log_det(scales)
    weights = weights + height + 0.5 * np.sum(pull**2, axis=1)
    means = means + np.einsum("kij,kj->ki", scales, pull)
    return _rescaled(Mixture(-np.inf, weights, means, scales, mixture.prior)), lost


def reduce(mixture: Mixture, components: int) -> Mixture:
    """Drop negligible components, then merge the pair that costs least (Runnalls 2007, eq. 16) until K are left.

    Of Gaussians that are cut off to the unit cube the masses inside are what they weigh, and what is kept of a pair.
    """
    mixture = prune(mixture)
    inside = np.zeros(len(mixture.means)) if mixture.prior else log_masses(mixture.means, mixture.scales)
    worth, means, scales = mixture.log_weights + inside, mixture.means, mixture.scales
    weights = np.exp(np.maximum(worth - worth.max(), -600.0))
    if (left := len(weights)) <= components:
        return mixture
    weights, means, scales, alive = weights.copy(), means.copy(), scales.copy(), np.ones(left, bool)
    covs, log_dets, cost = scales @ np.swapaxes(scales, -1, -2), _log_det(scales), np.full((left, left), np.inf)
    first, second = np.triu_indices(left, 1)
    cost[first, second] = cost[second, first] = _costs(weights, means, scales, covs, log_dets, first, second)
    for _ in range(left - components):
        i, j = sorted(divmod(int(np.argmin(cost)), left))
        share = weights[i] / (weights[i] + weights[j])
        scales[i] = _joined(np.array([share]), (means[i] - means[j])[None], scales[i : i + 1], scales[j : j + 1])[0]
        covs[i], log_dets[i] = scales[i] @ scales[i].T, _log_det(scales[i])
        weights[i], means[i] = weights[i] + weights[j], share * means[i] + (1 - share) * means[j]
        alive[j], cost[j, :], cost[:, j] = False, np.inf, np.inf
        others = np.flatnonzero(alive & (np.arange(left) != i))
        row = _costs(weights, means, scales, covs, log_dets, np.full(len(others), i), others)
        cost[i, others] = cost[others, i] = row
    logs, means, scales = np.log(weights[alive]) + worth.max(), means[alive], scales[alive]
    logs = logs if mixture.prior else logs - log_masses(means, scales)
    return Mixture(mixture.flat, logs, means, scales, mixture.prior)


def prune(mixture: Mixture, negligible: float = NEGLIGIBLE) -> Mixture:
    """Drop components whose mass inside the cube is negligible, and all but the CROWD heaviest; the heaviest stays."""
    scores = mixture.log_weights if mixture.prior else _masses_worth(mixture, np.log(negligible))
    scores = np.where(np.isnan(scores), -np.inf, scores)
    keep = scores > max(scores.max(), mixture.flat) + np.log(negligible)
    keep &= scores >= np.sort(scores)[-min(CROWD, len(scores))]
    keep[np.argmax(scores)] = True
    kept = mixture.log_weights[keep], mixture.means[keep], mixture.scales[keep]
    return _rescaled(Mixture(mixture.flat, *kept, mixture.prior))


def _masses_worth(mixture: Mixture, negligible: float) -> np.ndarray:
    """Log mass of each component inside the cube [K]; -inf where it is `negligible` of the largest, or crowded out.

    By the bound alone where all means are inside. Far outside it may be hundreds of nats too high, and a component that
    hardly has any mass would stand in the place of all others.
    """
    weights, means, scales = mixture.log_weights, mixture.means, mixture.scales
    most = weights + log_mass_bound(means, scales)
    if not np.any((means < 0) | (means > 1)):
        return most
    order, found = np.argsort(np.where(np.isnan(most), -np.inf, most))[::-1], np.full(len(most), -np.inf)
    for start in range(0, len(order), CROWD):
        some = order[start : start + CROWD]
        least = max(found.max(), mixture.flat) + negligible
        if start >= CROWD:  # no more than so many are kept
            least = max(least, np.partition(found, -CROWD)[-CROWD])
        if most[some[0]] < least:
            break
        found[some] = weights[some] + log_masses(means[some], scales[some], FEW_POINTS)
    return found


def log_masses(means: np.ndarray, scales: np.ndarray, points: int = MASS_POINTS) -> np.ndarray:
    """Log mass of each Gaussian inside the cube [K], by the separation of variables (see `box`), in float64."""
    logs = separated(means, scales, points)[1]
    return np.asarray(np.logaddexp.reduce(logs, axis=1) - np.log(points))


def log_mass_bound(means: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Each Gaussian's log mass beyond the nearest wall of the cube (log 1/2 for a mean inside), [K]: a cheap bound."""
    sd = np.maximum(np.sqrt(np.sum(scales**2, axis=-1)), THINNEST)
    return np.min(log_ndtr(np.minimum(np.minimum(means, 1 - means) / sd, 0)), axis=1, initial=0.0)


def _rescaled(mixture: Mixture) -> Mixture:
    top = max(float(mixture.log_weights.max()), mixture.flat)
    return mixture._replace(flat=mixture.flat - top, log_weights=mixture.log_weights - top)


def root(rows: np.ndarray) -> np.ndarray:
    """Lower S with positive diagonal, S S^T = rows^T rows: rows [..., m, d] -> [..., d, d]."""
    return np.swapaxes(_positive(_triangle(rows)), -1, -2)


def _coroot(rows: np.ndarray) -> np.ndarray:
    """Lower T with positive diagonal, T^T T = rows^T rows: rows [..., m, d] -> [..., d, d]."""
    return _positive(_triangle(rows[..., ::-1])[..., ::-1, ::-1])


def _triangle(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _positive(triangular: np.ndarray) -> np.ndarray:
    signs = np.where(np.diagonal(triangular, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return triangular * signs[..., None]


def _inverse(lower: np.ndarray) -> np.ndarray:
    """Of lower triangular matrices [..., d, d], by forward substitution: exact to rounding row by row."""
    out, eye = np.zeros_like(lower), np.eye(lower.shape[-1])
    for i in range(lower.shape[-1]):
        before = (lower[..., i, None, :i] @ out[..., :i, :])[..., 0, :]
        out[..., i, :] = (eye[i] - before) / lower[..., i, i, None]
    return out


def _log_det(triangular: np.ndarray) -> np.ndarray:
    return np.sum(np.log(np.diagonal(triangular, axis1=-2, axis2=-1)), axis=-1)


def _costs(
    w: np.ndarray, m: np.ndarray, s: np.ndarray, covs: np.ndarray, log_dets: np.ndarray, i: np.ndarray, j: np.ndarray
) -> np.ndarray:
    """Runnalls' bound on the divergence of merging components i [n] with j [n], -> [n].

    Their covariances are added as they are, which takes a third of the time of adding factors: what is lost of the
    digits decides between pairs that cost alike. Where the sum is no covariance any more, factors are added.
    """
    share, gap = w[i] / (w[i] + w[j]), m[i] - m[j]
    a, b, c = share[:, None, None], (1 - share)[:, None, None], (share * (1 - share))[:, None, None]
    sign, joint = np.linalg.slogdet(a * covs[i] + b * covs[j] + c * gap[:, :, None] * gap[:, None, :])
    joint = 0.5 * joint
    if (bad := ~((sign > 0) & np.isfinite(joint))).any():
        joint[bad] = _log_det(_joined(share[bad], gap[bad], s[i[bad]], s[j[bad]]))
    # B(i, j) = 1/2 [(w_i + w_j) ln|S_ij| - w_i ln|S_i| - w_j ln|S_j|], determinants of covariances
    return (w[i] + w[j]) * joint - w[i] * log_dets[i] - w[j] * log_dets[j]


def _joined(share: np.ndarray, gap: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Scales [K, d, d] of pairs of components as one; share [K] of the first, gap [K, d] between their means."""
    a, b = np.sqrt(share)[:, None, None], np.sqrt(1 - share)[:, None, None]
    first, second = np.swapaxes(first, -1, -2), np.swapaxes(second, -1, -2)
    return root(np.concatenate([a * first, b * second, a * b * gap[:, None, :]], axis=-2))
