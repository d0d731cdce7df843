"""The force that a linear model leaves, against densities that are written out and forces that were drawn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.optimize import minimize
from scipy.stats import norm

from bayessim_mjx.diagnosis.evidence.force_left import force_left
from bayessim_mjx.diagnosis.evidence.gaussian import PRIORS, Hyper, Learnt, learn, marginal
from tests.diagnosis.evidence.linear import NODES, ROWS, SPREAD, Drawn, draw, wide

MEMORY, NOISE = 4.0, (1.0, 1.2)
NORMAL = np.tile(NOISE, ROWS)


def correlation():
    lag = np.abs(np.subtract.outer(np.arange(NODES), np.arange(NODES)))
    return np.exp(-lag / MEMORY) + 1e-9 * np.eye(NODES)


def moved(case, forces):
    """The square that forces `[W, m]` (shares of the scale) move, start states refitted, for each residual."""
    out = 0.0
    for B, D, d in zip(case.B, case.D, forces, strict=True):
        B, m = B * SPREAD, D @ d * case.scale[0]
        out += m @ m - m @ B @ np.linalg.solve(B.T @ B + np.eye(B.shape[1]), B.T @ m)
    return out / case.r.size


def drawn(seed, amplitude, count=30, noise=1.0):
    """(windows with a force, its motion)."""
    rng, case = np.random.default_rng(seed), draw(seed, count=count)
    d = amplitude * rng.normal(size=(count, NODES)) @ np.linalg.cholesky(correlation()).T
    x, p = SPREAD * rng.normal(size=(count, case.B.shape[2])), rng.normal(size=2)
    e = noise * NORMAL * rng.normal(size=case.r.shape)
    force = np.einsum("wnm,wm->wn", case.D, d) * case.scale[0]
    r = case.A @ p + np.einsum("wns,ws->wn", case.B, x) + force + e
    return Drawn(r, case.A, case.B, case.D, p, case.scale), moved(case, d)


def left(case, belief=None):
    windows, belief = case.windows(), wide(2) if belief is None else belief
    return force_left(windows, belief, learn(windows, belief), case.scale)


def test_its_motion_is_that_of_the_conditional_gaussian():
    """Mean and variance of d'Md by dense algebra; parameters known, the amplitude's own uncertainty taken off."""
    case, _ = drawn(0, 0.02, count=4)
    case = replace(case, A=case.A[:, :, :0], r=case.r - case.A @ case.p, p=np.zeros(0))
    windows, belief = case.windows(), wide(0)
    hyper = Hyper(np.array([0.02]), MEMORY, np.array(NOISE))
    learnt = Learnt(hyper, np.zeros(0), marginal(windows, hyper), 0.0)
    found = force_left(windows, belief, learnt, case.scale)
    mean = variance = 0.0
    slopes = {}
    for a in (0.02, 0.02 * np.exp(1e-4)):
        mean = variance = 0.0
        for r, B, D in zip(case.r, case.B, case.D, strict=True):
            prior = (a * case.scale[0]) ** 2 * correlation()
            C = D @ prior @ D.T + SPREAD**2 * B @ B.T + np.diag(NORMAL**2)
            d, cov = prior @ D.T @ np.linalg.solve(C, r), prior - prior @ D.T @ np.linalg.solve(C, D @ prior)
            S = SPREAD * B
            M = D.T @ D - D.T @ S @ np.linalg.solve(S.T @ S + np.eye(S.shape[1]), S.T @ D)
            mean += d @ M @ d + np.trace(M @ cov)
            variance += 2 * np.trace(M @ cov @ M @ cov) + 4 * d @ M @ cov @ M @ d
        slopes[a] = mean, variance
    (mean, variance), (further, _) = slopes.values()
    assert found.motion * case.r.size == pytest.approx(mean, rel=1e-6)
    slope, sd = (further - mean) / 1e-4, np.log(found.high[0] / found.amplitude[0]) / norm.ppf(0.95)
    assert (found.sd * case.r.size) ** 2 == pytest.approx(variance + (slope * sd) ** 2, rel=1e-3)


@pytest.mark.parametrize("amplitude", [0.0, 0.003, 0.006])
def test_the_evidence_is_the_integral_over_the_amplitude(amplitude):
    """Against quadrature, the noise at its best for each amplitude; within a third of a nat."""
    case, _ = drawn(3, amplitude, count=60)
    windows, belief = case.windows(), wide(2)
    learnt = learn(windows, belief)
    found = force_left(windows, belief, learnt, case.scale)
    logs = np.linspace(np.log(PRIORS.least), np.log(0.05), 60)

    def at(log):
        def minus(x):
            there = marginal(windows, Hyper(np.exp([log]), learnt.hyper.memory, np.exp(x)))
            Q = there.Q.sum(0)
            return 0.5 * (belief.cost(Q, belief.best(Q)) + there.logdet.sum() + np.sum((x / PRIORS.noise) ** 2))

        return -minimize(minus, np.log(learnt.hyper.noise), method="Nelder-Mead", options={"maxiter": 30}).fun

    each = np.array([at(log) for log in logs])
    prior = norm.pdf(logs, np.log(PRIORS.usual), PRIORS.spread)
    whole = np.log(trapezoid(prior * np.exp(each - each.max()), logs)) + each.max()
    assert found.nats == pytest.approx(whole - each[0], abs=0.35)


def test_intervals_hold_the_drawn_force():
    """90 % of the drawn motions and amplitudes, everything else learnt; a binomial 99 % interval about .9 of 50."""
    held = np.zeros(2)
    for seed in range(50):
        case, truth = drawn(100 + seed, 0.02, count=20)
        found = left(case)
        low, high = found.interval()
        held += [low < truth < high, found.low[0] < 0.02 * case.scale[0] < found.high[0]]
    assert np.all((held >= 39) & (held <= 50)), held


@pytest.mark.parametrize("noise", [1.0, 1.5])
def test_noise_of_the_sensors_is_no_force_however_large(noise):
    chances = [left(drawn(300 + seed, 0.0, noise=noise)[0]).chance(0.1) for seed in range(5)]
    assert max(chances) < 1 / 20


def test_a_force_is_told_from_larger_noise():
    case, truth = drawn(400, 0.03, noise=1.3)
    found = left(case)
    assert found.chance(0.5 * truth) > 0.95 and found.chance(2.0 * truth) < 0.05


def test_the_joint_with_the_force_has_it():
    """Two joints, of which one is pushed."""
    case, _ = drawn(500, 0.03)
    other = np.random.default_rng(1).normal(size=case.D.shape) @ np.eye(NODES)
    both = Drawn(case.r, case.A, case.B, np.concatenate([case.D, other], 2), case.p, np.repeat(case.scale, 2))
    found = left(both)
    assert found.by_joint[0] > 20 * found.by_joint[1]
    assert found.low[0] > 0
