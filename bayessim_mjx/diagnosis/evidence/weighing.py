"""The evidence of the models of a pool: each by its own fit, with the missing force learnt anew."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence import doubts
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, Learnt, learn, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import Integrated, belief_of, integrated
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.residual import forcing
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Pool
from bayessim_mjx.diagnosis.selection.sets import BASE, RELEVANCE, Key, Weighed, log_prior, weighed

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scored:
    """A fitted model with its evidence; fit: its own, with what simulators differ by (`doubts`)."""

    model: Model
    fit: Fit
    learnt: Learnt
    found: Integrated


class Weighing:
    """What was weighed so far.

    Attributes:
        scored: by their sets; D: `[W, n, nv m]`, what forces do to the windows, of the fit of the known parameters.
    """

    def __init__(self, pool: Pool) -> None:
        fitter = pool.fitter
        self.pool = pool
        self.scale = forcing.force_scale(fitter)
        self.D = forcing.columns(fitter, pool.base.fit, forcing.default_nodes(fitter), self.scale)
        self.channels = int(fitter.used.sum())
        self.scored: dict[Key, Scored] = {}
        self._doubts = doubts.found(fitter, self.D, pool.base.fit.B)
        self.score([BASE])

    def doubted(self, fit: Fit) -> Fit:
        """With what simulators differ by as further numbers."""
        return doubts.doubted(fit, self._doubts)

    def score(self, keys: Iterable[Key]) -> None:
        """The evidence of models that are fitted, anew where the fit is another."""
        for key in keys:
            model, old = self.pool.models.get(key), self.scored.get(key)
            if model is not None and (old is None or old.model is not model):
                fit, spread = self.doubted(model.fit), self.pool.fitter.spread
                own = windows_of(fit.r, fit.A, fit.B, self.D, fit.offsets, spread, self.scale, self.channels)
                learnt = learn(own, belief_of(fit), self._alike())
                self.scored[key] = Scored(model, fit, learnt, integrated(fit, learnt, _numbers(model)))

    def _alike(self) -> list[Hyper]:
        """Hyperparameters to begin at: of the known parameters alone, and of the likeliest set."""
        some = {BASE: 0, self._best(): 0} if self.scored else {}
        return [self.scored[k].learnt.hyper for k in some]

    def excess(self, key: Key) -> float:
        """Held-out squared error above the likeliest set's noise, in noise variances as estimated from the logs."""
        return self._error(key) - self._floor()

    def _error(self, key: Key) -> float:
        model = self.scored[key].model
        return model.total / (self.pool.noise * len(model.cost))

    def _floor(self) -> float:
        return float(np.mean(self.scored[self._best()].learnt.hyper.noise ** 2))

    def _best(self) -> Key:
        return max(self.scored, key=self.total)

    def settled(self, key: Key) -> bool:
        """Whether a set of effects leaves nothing that matters."""
        return bool(key) and self.excess(key) <= RELEVANCE.noise + RELEVANCE.share * max(self.excess(BASE), 0.0)

    def total(self, key: Key) -> float:
        """Log of evidence and prior over those of the known parameters alone."""
        more = log_prior(key, len(self.pool.candidates))
        return self.scored[key].found.nats + more - self.scored[BASE].found.nats

    def weighed(self) -> Weighed:
        """The posterior over what was weighed."""
        return self._weighed({k: s.found.nats for k, s in self.scored.items()})

    def without(self, condition: int) -> Weighed:
        """The posterior given all windows but those of one operating condition, with the same hyperparameters."""
        kept = self.pool.fitter.simulator.windows.group != condition
        return self._weighed({k: _without(s, kept) for k, s in self.scored.items()})

    def _weighed(self, nats: dict[Key, float]) -> Weighed:
        floor = self._floor()
        excess = {k: self._error(k) - floor for k in self.scored}
        numbers = {k: sum(len(e.coordinates) for e in s.model.effects) for k, s in self.scored.items()}
        return weighed(nats, excess, numbers, len(self.pool.candidates))


def _without(of: Scored, kept: NDArray[np.bool_]) -> float:
    """Evidence given some of the windows alone, with the same hyperparameters."""
    there = of.learnt.marginal
    part = replace(there, Q=there.Q[kept], logdet=there.logdet[kept], cov=there.cov[kept], mean=there.mean[kept])
    learnt = replace(of.learnt, marginal=part, step=belief_of(of.fit).best(part.Q.sum(0)))
    return integrated(of.fit, learnt, _numbers(of.model)).nats


def _numbers(model: Model) -> list[dict[int, bool]]:
    """Of each effect, {index of its number in the fit: whether it is a shape}."""
    names = model.fit.names
    pairs = [zip(e.coordinates, e.shapes, strict=True) for e in model.effects]
    return [{names.index(c.name): shape for c, shape in each} for each in pairs]
