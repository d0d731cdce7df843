"""How much an experiment would tell: the evidence between rivals after the losing one has adapted all it can.

T-optimality with refit (Atkinson and Fedorov, 1975), each rival held back by what the logs have already taught it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import windows
from bayessim_mjx.diagnosis.fit import Fitter, Job
from bayessim_mjx.diagnosis.models import Model
from bayessim_mjx.diagnosis.quadratic import eliminate, solve
from bayessim_mjx.diagnosis.rehearsal import Played

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.run import Setup

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scored:
    """One experiment of the menu: evidence in nats, mean and of pairs `[M, M]` (truth, rival), and its needs."""

    name: str
    played: Played
    evidence: float
    pairs: Array
    needs: str = ""
    sharpened: tuple[float, float] = (0.0, 0.0)


class Scorer:
    """Evidence of experiments, simulated by the diagnosis' own compiled program.

    Attributes:
        models: rivals; weights: `[M]`; posterior: `[M]` precisions `[k, k]` from the logs; ratio: effective share of
            samples; misfit: of each model in noise variances.
    """

    def __init__(self, setup: Setup, models: Sequence[Model], weights: Array) -> None:
        self.setup, self.fitter, self.models, self.weights = setup, setup.fitter, list(models), weights
        count = models[0].job.r.size
        self.ratio = np.array([min(m.samples / count, 1.0) for m in models])
        self.misfit = np.array([max(m.total / count, 0.5) for m in models])
        self.posterior = [self._posterior(m, k) for m, k in zip(models, self.ratio / self.misfit, strict=True)]

    def _posterior(self, model: Model, discount: float) -> Array:
        q, _ = model.job.quadratic(self.fitter.spread)
        _, S = q.weighted(model.job.weight)
        return discount * S + np.diag(model.job.prior()[0])

    def score(self, played: Sequence[Played], shift: Array, each: int) -> list[Array]:
        """Evidence `[M, M]` in nats of every experiment: row the truth, column the rival that adapts.

        Args:
            shift: `[P]`, added to every theta (a known payload, another mount); each: windows looked at per experiment.

        The diagonal holds, for the truth itself, log(sd before / sd after) of its least certain parameter.
        """
        logs = [p.log for p in played]
        original = self.fitter.simulator.windows
        model, substeps, limit = self.setup.physics.mj_model, self.setup.physics.substeps, each * len(logs)
        cut = windows.cut(logs, model, original.dt, substeps, original.steps, limit=limit)
        found = [self._jobs(chunk, shift) for chunk in _chunks(cut, original)]
        full = (len(logs[0]) - 1) // original.steps
        out = []
        for k in range(len(logs)):
            own = np.flatnonzero(cut.log == k)
            chunk, row = own // len(original), own % len(original)
            where = [(found[c], row[chunk == c]) for c in np.unique(chunk)]
            out.append(self._evidence(where, full / max(len(own), 1), full))
        return out

    def _jobs(self, chunk: windows.Windows, shift: Array) -> list[Job]:
        simulator = copy.copy(self.fitter.simulator)  # shares the compiled program
        simulator.windows = chunk
        fitter = _Shifted(self.fitter, simulator, shift)
        jobs = [fitter.begin(m.job.coordinates, m.job.values) for m in self.models]
        self.fitter.simulator.rollouts = simulator.rollouts
        return jobs

    def _evidence(self, where: list[tuple[list[Job], NDArray[np.int64]]], scale: float, full: int) -> Array:
        m = len(self.models)
        out = np.zeros((m, m))
        for i in range(m):
            for j in range(m):
                out[i, j] = self._adapted(where, i, j, scale, full) if i != j else self._sharper(where, i, scale)
        return out

    def _quadratic(self, where: list, i: int, j: int) -> tuple[float, Array, Array]:
        """Squared difference between truth i and rival j, summed over windows, as a quadratic in j's parameters."""
        c, g, S = 0.0, np.zeros(self.models[j].size), np.zeros((self.models[j].size,) * 2)
        for jobs, some in where:
            r = (jobs[j].r - jobs[i].r)[some]
            q, _ = eliminate(
                r, jobs[j].A[some], jobs[j].B[some], np.zeros_like(jobs[j].offsets[some]), self.fitter.spread
            )
            c, g, S = c + q.c.sum(), g + q.g.sum(0), S + q.S.sum(0)
        return float(c), g, S

    def _adapted(self, where: list, i: int, j: int, scale: float, full: int) -> float:
        """D = min over dp of discount |y_i - y_j(p_j + dp)|^2 + dp' P dp; evidence N/2 log(1 + D/N), or D/2 if small."""
        c, g, S = self._quadratic(where, i, j)
        discount = scale * self.ratio[i] / self.misfit[i]
        _, _, low, high = self.models[j].job.prior()
        H = discount * S + self.posterior[j]
        p = solve(H, discount * g, low, high)
        D = max(discount * c - 2 * discount * float(g @ p) + float(p @ H @ p), 0.0)
        samples = full * self.fitter.size * self.ratio[i]
        return float(0.5 * samples * np.log1p(D / samples))

    def _sharper(self, where: list, i: int, scale: float) -> float:
        _, _, S = self._quadratic(where, i, i)
        worst, before = self.loosest(i)
        after = np.linalg.pinv(self.posterior[i] + scale * self.ratio[i] / self.misfit[i] * S)[worst, worst]
        return float(0.5 * np.log(before / max(after, 1e-300)))

    def loosest(self, i: int) -> tuple[int, float]:
        """(index, variance) of model i's least certain parameter, relative to its range; effects' before known ones."""
        variance = np.diag(np.linalg.pinv(self.posterior[i]))
        coordinates, base = self.models[i].job.coordinates, len(self.fitter.base)
        relative = np.sqrt(variance) / np.array([c.high - c.low for c in coordinates])
        first = base if len(coordinates) > base else 0
        worst = first + int(np.argmax(relative[first:]))
        return worst, float(variance[worst])

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
        own = jax.tree.map(lambda x: jax.numpy.asarray(x)[index], batch)  # noqa: B023  # used at once
        out.append(replace(cut, batch=own, log=cut.log[index], start=cut.start[index], group=cut.group[index]))
    return out
