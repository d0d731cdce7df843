"""How much an experiment would tell: the evidence between rivals after the losing one has adapted all it can.

T-optimality with refit (Atkinson and Fedorov, 1975), each rival held back by what the logs have already taught it, on
average over what they leave open about the truth.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.experiment.rehearsal import Played
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import eliminate, solve
from bayessim_mjx.diagnosis.selection.models import Model, systematic
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.statistics import root

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scored:
    """One experiment of the menu: evidence in nats, mean and of pairs `[M, M]` (truth, rival), and its needs."""

    name: str
    played: Played
    evidence: float
    pairs: Array
    needs: str = ""


class Scorer:
    """Evidence of experiments, simulated by the diagnosis' own compiled program.

    Attributes:
        models: rivals; weights: `[M]`; posterior: `[M]` precisions `[k, k]` from the logs; points: `[M]` deviations of
            parameters that stand for it; ratio: effective share of samples; misfit: of each model in noise variances.
    """

    def __init__(self, setup: Setup, models: Sequence[Model], weights: Array) -> None:
        self.setup, self.fitter, self.models, self.weights = setup, setup.fitter, list(models), weights
        count = models[0].fit.r.size
        self.ratio = np.array([min(m.samples / count, 1.0) for m in models])
        self.misfit = np.array([max(m.total / count, 0.5) for m in models])
        self.posterior = [self._posterior(m, k) for m, k in zip(models, self.ratio / self.misfit, strict=True)]
        self.points = [self._points(i) for i in range(len(models))]

    def _posterior(self, model: Model, discount: float) -> Array:
        q, _ = model.fit.quadratic()
        _, S = q.weighted(model.fit.weight)
        return discount * S + np.diag(model.fit.belief())

    def score(self, played: Sequence[Played], shift: Array, each: int) -> list[Array]:
        """Evidence `[M, M]` in nats of every experiment: row the truth, column the rival that adapts.

        Args:
            shift: `[P]`, added to every theta (a known payload, another mount); each: windows looked at per experiment.

        The diagonal holds, for the truth itself, log(sd before / sd after) of its least certain parameter.
        """
        logs = [p.log for p in played]
        original = self.fitter.simulator.windows
        model, substeps, limit = self.setup.physics.mj_model, self.setup.physics.substeps, each * len(logs)
        cut = windows.cut(logs, model, original.dt, substeps, original.steps, limit=limit, centred=False)
        found = [self._jobs(chunk, shift) for chunk in _chunks(cut, original)]
        full = (len(logs[0]) - 1) // original.steps
        out = []
        for k in range(len(logs)):
            own = np.flatnonzero(cut.log == k)
            chunk, row = own // len(original), own % len(original)
            where = [(found[c], row[chunk == c]) for c in np.unique(chunk)]
            out.append(self._evidence(where, full / max(len(own), 1), full))
        return out

    def _jobs(self, chunk: windows.Windows, shift: Array) -> list[Fit]:
        simulator = copy.copy(self.fitter.simulator)  # shares the compiled program
        simulator.windows = chunk
        fitter = _Shifted(self.fitter, simulator, shift)
        fits = [fitter.begin(m.fit.coordinates, m.fit.values) for m in self.models]
        self.fitter.simulator.rollouts = simulator.rollouts
        return fits

    def _evidence(self, where: list[tuple[list[Fit], NDArray[np.int64]]], scale: float, full: int) -> Array:
        m = len(self.models)
        out, discount, samples = (
            np.zeros((m, m)),
            scale * self.ratio / self.misfit,
            full * self.fitter.size * self.ratio,
        )
        for i in range(m):
            own = self._quadratic(where, i, i)
            out[i, i] = self._sharper(own[2], i, discount[i])
            for j in range(m):
                if i != j:
                    out[i, j] = self._adapted((i, own), (j, self._quadratic(where, i, j)), discount[i], samples[i])
        return out

    def _quadratic(self, where: list, i: int, j: int) -> tuple[float, Array, Array]:
        """|y_i(p_i + dq) - y_j(p_j + dp)|^2, summed over windows, starts free, as a quadratic in z = (dp, dq)."""
        size = self.models[j].size + self.models[i].size
        c, g, S = 0.0, np.zeros(size), np.zeros((size, size))
        for fits, some in where:
            r, x = (fits[j].r - fits[i].r)[some], np.zeros_like(fits[j].offsets[some])
            A = np.concatenate([fits[j].A[some], -fits[i].A[some]], axis=2)
            q, _ = eliminate(r, A, fits[j].B[some], x, fits[j].spread)
            c, g, S = c + q.c.sum(), g + q.g.sum(0), S + q.S.sum(0)
        return float(c), g, S

    def _adapted(self, own: tuple, other: tuple, discount: float, samples: float) -> float:
        """Mean over i's posterior of N/2 log((N + D_ij) / (N + D_ii)), half the difference of the D if they are small.

        D_ij = min over dp of discount |y_i(p_i + dq) - y_j(p_j + dp)|^2 + dp' P_j dp, dq from the posterior that the
        logs leave of i: how large an effect really is matters, and they may hardly know.
        """
        gains = []
        for dq in self.points[own[0]]:
            rival, truth = (self._distance(q, dq, k, discount) for k, q in (other, own))
            gains.append(0.5 * samples * np.log((samples + rival) / (samples + truth)))
        return max(float(np.mean(gains)), 0.0)

    def _distance(self, quadratic: tuple[float, Array, Array], dq: Array, j: int, discount: float) -> float:
        c, g, S = quadratic
        k = self.models[j].size
        rest = c - 2 * float(g[k:] @ dq) + float(dq @ S[k:, k:] @ dq)
        pull = discount * (g[:k] - S[:k, k:] @ dq)
        _, _, low, high = self.models[j].fit.prior()
        H = discount * S[:k, :k] + self.posterior[j]
        p = solve(H, pull, low, high)
        return max(discount * rest - 2 * float(pull @ p) + float(p @ H @ p), 0.0)

    def _points(self, i: int) -> Array:
        """`[2 k, k]`, deviations of model i's parameters, inside their bounds, whose means are a Gaussian's.

        Exact for polynomials of the third degree (Arasaratnam and Haykin, IEEE Trans. Autom. Control 54, 2009).
        """
        half = root(np.asarray(np.linalg.pinv(self.posterior[i]), np.float64)).T * np.sqrt(self.models[i].size)
        _, _, low, high = self.models[i].fit.prior()
        return np.clip(np.concatenate([half, -half]) if len(half) else np.zeros((1, 0)), low, high)

    def _sharper(self, S: Array, i: int, discount: float) -> float:
        k = self.models[i].size
        worst, before = self.loosest(i)
        after = np.linalg.pinv(self.posterior[i] + discount * S[:k, :k])[worst, worst] + self.allowed(i)[worst]
        return float(0.5 * np.log(before / max(after, 1e-300)))

    def loosest(self, i: int) -> tuple[int, float]:
        """(index, variance) of model i's least certain parameter, relative to its range; effects' before known ones."""
        variance = np.diag(np.linalg.pinv(self.posterior[i])) + self.allowed(i)
        coordinates, base = self.models[i].fit.coordinates, len(self.fitter.base)
        relative = np.sqrt(variance) / np.array([c.high - c.low for c in coordinates])
        first = base if len(coordinates) > base else 0
        # optional numbers are mostly off: how large an effect is matters more
        relative[base:][[self.setup.physics.quantity(c.index[0]).optional for c in coordinates[base:]]] = 0.0
        worst = first + int(np.argmax(relative[first:]))
        return worst, float(variance[worst])

    def allowed(self, i: int) -> Array:
        """Variances `[k]` of model i's parameters between simulators, which no experiment reduces."""
        return systematic(self.models[i], self.fitter.simulator.windows.dt) ** 2

    def mean(self, pairs: Array) -> float:
        """Evidence over all pairs, weighted by how probable the two are."""
        w = np.outer(self.weights, self.weights) * (1 - np.eye(len(self.weights)))
        return float((w * pairs).sum() / w.sum()) if w.sum() else float(pairs[0, 0])


class _Shifted(Fitter):
    """The same fitter on other windows, with something known added to every theta."""

    def __init__(self, fitter: Fitter, simulator: Any, shift: Array) -> None:
        self.__dict__.update(fitter.__dict__)
        self.simulator, self.shift = simulator, shift

    def vector(self, coordinates: Any, values: Array) -> Array:
        return super().vector(coordinates, values) + self.shift


def _chunks(cut: windows.Windows, like: windows.Windows) -> list[windows.Windows]:
    """Windows in pieces of the size that the program was compiled for, the last one filled up."""
    batch, size, out = cut.batch, len(like), []
    if like.batch.enabled is not None and batch.enabled is None:
        batch = batch.replace(enabled=np.ones((len(cut), cut.steps, batch.command.shape[-1]), np.float32))
    for a in range(0, len(cut), size):
        index = np.minimum(np.arange(a, a + size), len(cut) - 1)
        own = jax.tree.map(lambda x: jax.numpy.asarray(np.asarray(x)[index]), batch)  # noqa: B023  # used at once
        out.append(replace(cut, batch=own, log=cut.log[index], start=cut.start[index], group=cut.group[index]))
    return out
