"""The force that a model leaves: its posterior amplitude, its evidence, and the posterior of what it moves.

The model is that of `gaussian`: r = A p + B x + D d + e, where d is a force of amplitude a at each joint. Given a, p
and the noise, d is Gaussian. With the start states refitted it moves, squared and summed over all windows,

    E = sum_w d_w' M_w d_w,    M = D'D - D'B (B'B + 1)^-1 B'D.

Mean and variance of this quadratic form are known. The uncertainty of log a and of p is added to first order. The
slope of E in log a is the posterior covariance of E and the force's own square; the curvature of the likelihood in
log a follows from that square's variance (Louis, J. R. Stat. Soc. B 44, 1982). E is taken to be a gamma variable with
this mean and variance (Satterthwaite, Biometrics Bulletin 2, 1946).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, log_ndtr, ndtr
from scipy.stats import gamma

from bayessim_mjx.diagnosis.evidence.gaussian import (
    PRIORS,
    Belief,
    Hyper,
    Learnt,
    Marginal,
    Windows,
    learn,
)
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.selection.models import Key
from bayessim_mjx.diagnosis.statistics import Z90

Array = NDArray[np.float64]
ENDS = ndtr((-Z90, Z90))  # of a 90 % interval


@dataclass(frozen=True)
class ForceLeft:
    """The posterior of the force that a model leaves.

    Attributes:
        amplitude: `[nv]`, most likely rms of the force at each joint, in N m or N; low, high: its 90 % interval.
        nats: log evidence for a force above `PRIORS.least`, over that force alone and larger noise of the sensors.
        motion, sd: posterior mean and standard deviation of the square that a force above it moves, in noise variances
            of each residual.
        by_joint: `[nv]`, mean of `motion` by the force at each joint alone.
        noise: most likely variance of the sensors' noise, mean over the channels, in the one estimated from the logs.
    """

    amplitude: Array
    low: Array
    high: Array
    nats: float
    motion: float
    sd: float
    by_joint: Array
    noise: float

    def chance(self, limit: float) -> float:
        """Posterior probability that there is a force and that it moves more than `limit`, in the unit of `motion`.

        A force and none are equally likely beforehand.
        """
        shape, scale = self._gamma()
        return float(expit(self.nats) * gamma.sf(limit, shape, scale=scale))

    def interval(self) -> tuple[float, float]:
        """90 % interval of `motion`."""
        shape, scale = self._gamma()
        low, high = gamma.ppf(ENDS, shape, scale=scale)
        return float(low), float(high)

    def _gamma(self) -> tuple[float, float]:
        """(shape, scale) of the gamma density with the mean and the standard deviation of `motion`."""
        return (self.motion / self.sd) ** 2, self.sd**2 / self.motion


def of_set(weighing: Weighing, key: Key) -> ForceLeft:
    """Return the posterior of the force that a weighed set of effects leaves."""
    found = weighing.scored[key]
    return force_left(weighing.windows(found.fit), belief_of(found.fit), found.learnt, weighing.scale)


def force_left(windows: Windows, belief: Belief, learnt: Learnt, scale: Array) -> ForceLeft:
    """Return the posterior of the force at a fit with its best hyperparameters.

    Args:
        windows, belief: of the fit; learnt: their best hyperparameters; scale: `[nv]`, the robot's force scale.
    """
    hyper, forces = learnt.hyper, _Forces.of(windows, belief, learnt.marginal)
    least = replace(hyper, amplitude=np.full_like(hyper.amplitude, PRIORS.least))
    none = learn(windows, belief, [least], most=PRIORS.least)  # no force above the least one, the noise at its best
    slope, curvature, shared = forces.in_amplitude(hyper)
    free = hyper.amplitude > PRIORS.least * (1 + 1e-6)
    sizes, ways = np.linalg.eigh(curvature[np.ix_(free, free)])
    sizes = np.maximum(sizes, PRIORS.spread**-2)  # the data do not make the prior less certain
    inverse = (ways / sizes) @ ways.T
    factor, sd = np.ones((2, len(free))), np.sqrt(np.diag(inverse))
    factor[:, free] = np.exp(sd * np.array([[-Z90], [Z90]]))
    volume = 0.5 * float(np.sum(np.log(2 * np.pi / sizes)))
    volume += float(np.sum(log_ndtr(np.log(hyper.amplitude[free] / PRIORS.least) / sd)))  # the lower end cuts it
    for joint in np.flatnonzero(~free):
        more, factor[1, joint] = _at_the_end(slope[joint], curvature[joint, joint])
        volume, factor[0, joint] = volume + more, 0.0
    mean, variance, by_joint = forces.motion()
    rows = windows.rows * windows.gram.shape[0] * windows.gram.shape[1]
    away = np.log(hyper.amplitude / PRIORS.usual) / PRIORS.spread
    prior = -0.5 * np.sum(away**2) - len(free) * np.log(PRIORS.spread * np.sqrt(2 * np.pi))
    return ForceLeft(
        amplitude=hyper.amplitude * scale,
        low=factor[0] * hyper.amplitude * scale,
        high=factor[1] * hyper.amplitude * scale,
        nats=float(_density(belief, learnt) + prior + volume - _density(belief, none)),
        motion=mean / rows,
        sd=float(np.sqrt(variance + shared[free] @ inverse @ shared[free])) / rows,
        by_joint=by_joint / rows,
        noise=float(np.mean(hyper.noise**2)),
    )


def _at_the_end(slope: float, curvature: float) -> tuple[float, float]:
    """(log integral of the density over log a from `PRIORS.least` on, 95 % quantile of a / `PRIORS.least`).

    A force that small is a small part of each covariance, so the log likelihood is quadratic in a^2. slope, curvature:
    of the log density in log a, its prior included.
    """
    usual = np.log(PRIORS.least / PRIORS.usual) / PRIORS.spread**2
    slope, curvature = slope + usual, curvature - PRIORS.spread**-2  # of the likelihood
    logs = np.linspace(0.0, np.log(1 / PRIORS.least), 2000)
    square = np.expm1(2 * logs)
    each = slope / 2 * square + min(-curvature - 2 * slope, 0.0) / 8 * square**2
    density = np.exp(each - usual * logs - 0.5 * (logs / PRIORS.spread) ** 2)
    below = np.cumsum(density) * logs[1]
    return float(np.log(below[-1])), float(np.exp(np.interp(ENDS[1] * below[-1], below, logs)))


def _density(belief: Belief, learnt: Learnt) -> float:
    """Log density of the data at the most probable step, with the noise's prior."""
    noise = float(np.sum((np.log(learnt.hyper.noise) / PRIORS.noise) ** 2))
    return -0.5 * (belief.cost(learnt.Q, learnt.step) + float(learnt.marginal.logdet.sum()) + noise)


@dataclass(frozen=True, eq=False)
class _Forces:
    """The posterior of all windows' forces, in units of their prior.

    Attributes:
        u, C: `[W, F]`, `[W, F, F]`, mean and covariance; M: `[W, F, F]`, what they move, squared.
        by_step: `[W, F, k]`, minus the slope of the mean in the parameters' step; step: `[k, k]`, its covariance.
        joints: nv, F = nv m.
    """

    u: Array
    C: Array
    M: Array
    by_step: Array
    step: Array
    joints: int

    @classmethod
    def of(cls, windows: Windows, belief: Belief, there: Marginal) -> _Forces:
        own, F = 1 + windows.parameters, windows.forces
        Q = there.Q.sum(0)
        p = belief.best(Q)
        G = windows.gram.sum(0)[:, own:, own:]
        starts = G[:, F:, F:] + np.eye(G.shape[1] - F)
        root = there.root[:F, :F]
        M = root.T @ (G[:, :F, :F] - G[:, :F, F:] @ np.linalg.solve(starts, G[:, F:, :F])) @ root
        free = (p > belief.low) & (p < belief.high)
        step = np.zeros((len(p), len(p)))
        step[np.ix_(free, free)] = np.linalg.inv((Q[1:, 1:] + np.diag(belief.precision))[np.ix_(free, free)])
        u = there.mean[:, :F] @ np.concatenate([[1.0], -p])
        return cls(u, there.cov[:, :F, :F], M, there.mean[:, :F, 1:], step, windows.joints)

    def motion(self) -> tuple[float, float, Array]:
        """(mean, variance) of E given the amplitudes, and its mean `[nv]` by the force at each joint alone."""
        MC, Mu = self.M @ self.C, (self.M @ self.u[..., None])[..., 0]
        mean = float(np.sum(self.u * Mu) + np.einsum("wii->", MC))
        variance = 2 * float(np.einsum("wij,wji->", MC, MC)) + 4 * float(np.einsum("wi,wij,wj->", Mu, self.C, Mu))
        slope = 2 * np.einsum("wi,wik->k", Mu, self.by_step)
        mean += float(np.einsum("wik,wij,wjl,kl->", self.by_step, self.M, self.by_step, self.step, optimize=True))
        second = np.sum((self.u[:, :, None] * self.u[:, None, :] + self.C) * self.M, axis=0)
        parts = second.reshape(self.joints, len(second) // self.joints, self.joints, -1)
        return mean, variance + float(slope @ self.step @ slope), np.einsum("vmvn->v", parts)

    def in_amplitude(self, hyper: Hyper) -> tuple[Array, Array, Array]:
        """(slope `[nv]`, minus the second derivative `[nv, nv]` of the log density in log a; that of E `[nv]`)."""
        W, F = self.u.shape

        def own(x: Array) -> Array:
            return x.reshape(W, self.joints, -1)

        square = own(self.u**2 + np.einsum("wii->wi", self.C)).sum((0, 2))
        slope = square - W * F / self.joints - np.log(hyper.amplitude / PRIORS.usual) / PRIORS.spread**2
        block = self.C.reshape(W, self.joints, F // self.joints, self.joints, -1)
        twice = 2 * np.einsum("wvmun,wvmun->vu", block, block)
        twice += 4 * np.einsum("wvm,wvmun,wun->vu", own(self.u), block, own(self.u), optimize=True)
        MC = self.M @ self.C
        shared = 2 * own(np.einsum("wij,wij->wj", self.C, MC)).sum((0, 2))
        shared += 4 * own((np.einsum("wi,wij->wj", self.u, MC)) * self.u).sum((0, 2))
        return slope, np.diag(2 * square + PRIORS.spread**-2) - twice, shared
