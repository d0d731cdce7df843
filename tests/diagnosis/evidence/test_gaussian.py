"""The marginal likelihood of linear-Gaussian windows against densities that are written out."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, _slope, learn, marginal
from tests.diagnosis.evidence.linear import CHANNELS, NODES, ROWS, SPREAD, covariance, draw, wide

HYPER = Hyper(np.array([0.02]), 4.0, np.array([1.0, 1.2]))


def log_density(Q, logdet, p):
    """Of residuals given parameters, from what `marginal` has."""
    n = CHANNELS * ROWS
    cost = Q[:, 0, 0] - 2 * Q[:, 1:, 0] @ p + np.einsum("i,wij,j->w", p, Q[:, 1:, 1:], p)
    return -0.5 * (cost + logdet + n * np.log(2 * np.pi))


def test_force_and_start_are_integrated_out():
    case = draw(0)
    found = marginal(case.windows(), HYPER)
    for p in (case.p, np.zeros(2)):
        exact = [
            multivariate_normal(a @ p, covariance(0.02, 4.0, (1.0, 1.2), b, d, case.scale)).logpdf(r)
            for r, a, b, d in zip(case.r, case.A, case.B, case.D, strict=True)
        ]
        assert log_density(found.Q, found.logdet, p) == pytest.approx(np.array(exact), rel=1e-8)


def test_products_keep_their_digits_where_residuals_are_many_thousand_noises():
    """Against least squares of the stacked columns; a linear drive's log leaves thousands of noises unexplained."""
    case = draw(5, gain=7e7)
    found = marginal(case.windows(), HYPER)
    size = found.root.shape[0]
    noise = np.tile(HYPER.noise, ROWS)[:, None]
    for r, A, B, D, Q, logdet in zip(case.r, case.A, case.B, case.D, found.Q, found.logdet, strict=True):
        explained = np.concatenate([D * case.scale[0], B * SPREAD], 1) / noise @ found.root
        rest = np.concatenate([r[:, None], A], 1) / noise
        stacked = np.block([[explained, rest], [np.eye(size), np.zeros((size, 3))]])
        R = np.linalg.qr(stacked, mode="r")
        assert pytest.approx(R[size:, size:].T @ R[size:, size:], rel=1e-3, abs=1e-3) == Q
        exact = 2 * np.sum(np.log(np.abs(np.diag(R)[:size]))) + 2 * ROWS * np.sum(np.log(HYPER.noise))
        assert logdet == pytest.approx(exact, abs=1e-3)


def test_the_force_is_its_posterior_mean():
    """Against conditioning of the joint Gaussian of force and residual."""
    case = draw(1)
    found = marginal(case.windows(), HYPER)
    mean = found.root @ (found.mean[0] @ np.concatenate([[1.0], -case.p]))
    C = covariance(0.02, 4.0, (1.0, 1.2), case.B[0], case.D[0], case.scale)
    lag = np.abs(np.subtract.outer(np.arange(NODES), np.arange(NODES)))
    prior = 0.02**2 * case.scale[0] ** 2 * np.exp(-lag / 4.0)
    left = np.linalg.solve(C, case.r[0] - case.A[0] @ case.p)
    assert mean[:NODES] * case.scale[0] == pytest.approx(prior @ case.D[0].T @ left, rel=1e-5)
    assert mean[NODES:] * SPREAD == pytest.approx(SPREAD**2 * case.B[0].T @ left, rel=1e-5)


def test_a_start_as_measured_counts_whatever_start_the_fit_has():
    """Residuals about another start state are the same data."""
    from bayessim_mjx.diagnosis.evidence.gaussian import windows_of

    case, moved = draw(2), np.random.default_rng(3).normal(size=(40, 2))
    there = case.r - np.einsum("wns,ws->wn", case.B, moved)
    again = windows_of(there, case.A, case.B, case.D, moved, np.full(2, SPREAD), case.scale, CHANNELS)
    assert pytest.approx(marginal(case.windows(), HYPER).Q, rel=1e-9) == marginal(again, HYPER).Q


@pytest.mark.parametrize("memory", (1.0, 4.0, 16.0))
def test_slopes_of_the_hyperparameters(memory):
    windows, belief = draw(4).windows(), wide(2)
    x = np.log(np.array([0.01, 1.1, 0.8]))
    _, slope = _slope(x, windows, belief, memory)
    for i in range(3):
        step = 1e-5 * np.eye(3)[i]
        numeric = (_slope(x + step, windows, belief, memory)[0] - _slope(x - step, windows, belief, memory)[0]) / 2e-5
        assert slope[i] == pytest.approx(numeric, rel=1e-4, abs=1e-3)


def test_hyperparameters_are_found():
    """The amplitude within its sampling error (400 windows of 4 nodes), the noise within a few percent."""
    amplitudes, noises = [], []
    for seed in range(6):
        found = learn(draw(10 + seed, count=400).windows(), wide(2))
        amplitudes.append(found.hyper.amplitude[0])
        noises.append(found.hyper.noise)
        assert found.hyper.memory == 4.0
    assert np.mean(amplitudes) == pytest.approx(0.02, rel=0.06)
    assert np.mean(noises, 0) == pytest.approx([1.0, 1.2], rel=0.02)


def test_no_force_is_found_where_there_is_none():
    found = learn(draw(20, count=200, amplitude=0.0).windows(), wide(2))
    windows = draw(20, count=200, amplitude=0.0).windows()
    motion = np.sqrt(np.mean(np.einsum("cwii->cwi", windows.gram)[..., 3 : 3 + NODES]) / ROWS)
    assert found.hyper.amplitude[0] * motion < 0.15  # of the noise
    assert found.hyper.noise == pytest.approx([1.0, 1.2], rel=0.05)


def test_parameters_have_their_posterior_under_the_missing_force():
    """90 % intervals hold 90 % of the drawn parameters, hyperparameters learnt: a force that is ignored would not."""
    held, ignored, n = 0, 0, 0
    for seed in range(150):
        case = draw(1000 + seed, count=20, k=2)
        found = learn(case.windows(), wide(2))
        sd = np.sqrt(np.diag(np.linalg.inv(found.Q[1:, 1:] + np.eye(2))))
        held += np.sum(np.abs(case.p - found.step) < norm.ppf(0.95) * sd)
        plain = marginal(case.windows(), Hyper(np.array([1e-9]), 4.0, np.ones(2))).Q.sum(0)
        alone = np.linalg.solve(plain[1:, 1:] + np.eye(2), plain[1:, 0])
        ignored += np.sum(np.abs(case.p - alone) < norm.ppf(0.95) * np.sqrt(np.diag(np.linalg.inv(plain[1:, 1:]))))
        n += 2
    assert 0.85 < held / n < 0.95, held / n
    assert ignored / n < held / n - 0.1, ignored / n
