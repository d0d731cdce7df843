"""The evidence of fitted models, each with the missing force learnt anew, and the posterior of the answer's numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence import doubts
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, Learnt, Windows, learn, marginal, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import Integrated, Posterior, belief_of, integrated
from bayessim_mjx.diagnosis.evidence.sets import Weighed, weighed
from bayessim_mjx.diagnosis.fitting import forces as disturbance
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.models import BASE, Key, Model, scored
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, ODDS, PRIORS, RELEVANCE
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.statistics import Z90, mixture_quantiles

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scored:
    """A fitted model with its evidence; fit: its own with the numbers of `doubts` beside its own numbers."""

    model: Model
    fit: Fit
    learnt: Learnt
    found: Integrated


class Weighing:
    """The evidence of all fitted sets of a search.

    Attributes:
        scored: {set: its model with its evidence}; D: `[W, n, nv m]`, effect of forces on the windows
            (`disturbance.columns`), at the fit of the known parameters.
    """

    def __init__(self, state: SearchState) -> None:
        fitter = state.fitter
        self.state = state
        self.scale = disturbance.force_scale(fitter)
        self.D = disturbance.columns(fitter, state.base.fit, disturbance.default_nodes(fitter), self.scale)
        self.channels = int(fitter.used.sum())
        self.scored: dict[Key, Scored] = {}
        self._doubts = doubts.found(fitter, self.D, state.base.fit.B)
        self.score([BASE])

    def doubted(self, fit: Fit) -> Fit:
        """With what simulators differ by as further numbers."""
        return doubts.doubted(fit, self._doubts)

    def windows(self, fit: Fit, r: Array) -> Windows:
        """The linear model about a fit, of residuals `[W, n]` at its values."""
        spread = self.state.fitter.spread
        return windows_of(r, fit.A, fit.B, self.D, fit.offsets, spread, self.scale, self.channels)

    def score(self, keys: Iterable[Key]) -> None:
        """Compute the evidence of fitted models, again where the fit has changed."""
        for key in keys:
            model, old = self.state.models.get(key), self.scored.get(key)
            if model is not None and (old is None or old.model is not model):
                fit = self.doubted(model.fit)
                own = self.windows(fit, fit.r)
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
        return model.total / (self.state.noise * len(model.cost))

    def _floor(self) -> float:
        return float(np.mean(self.scored[self._best()].learnt.hyper.noise ** 2))

    def _best(self) -> Key:
        return max(self.scored, key=self.total)

    def settled(self, key: Key) -> bool:
        """Whether a set of effects leaves nothing that matters."""
        return bool(key) and self.excess(key) <= RELEVANCE.noise + RELEVANCE.share * max(self.excess(BASE), 0.0)

    def total(self, key: Key) -> float:
        """Log of evidence and prior over those of the known parameters alone."""
        more = self.state.log_prior(key)
        return self.scored[key].found.nats + more - self.scored[BASE].found.nats

    def weighed(self) -> Weighed:
        """The posterior over what was weighed."""
        return self._weighed({k: s.found.nats for k, s in self.scored.items()})

    def without(self, condition: int) -> Weighed:
        """The posterior given all windows but those of one operating condition, with the same hyperparameters."""
        kept = self.state.fitter.simulator.windows.group != condition
        return self._weighed({k: _without(s, kept) for k, s in self.scored.items()})

    def _weighed(self, nats: dict[Key, float]) -> Weighed:
        floor = self._floor()
        excess = {k: self._error(k) - floor for k in self.scored}
        numbers = {k: sum(len(e.coordinates) for e in s.model.effects) for k, s in self.scored.items()}
        return weighed(nats, excess, numbers, len(self.state.candidates))


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


@dataclass(frozen=True, eq=False)
class Estimated:
    """Posterior of the answer's numbers.

    Attributes:
        mean: `[k]`, where the fit could not be moved there not its values; covariance: `[k, k]`.
        sheet: the data sheet's accuracies behind it.
        noise: `[C]`, most likely noise of each channel, in what was estimated from the logs.
        step: most probable step `[k]` from the answer's fit, of residuals `[W, n]` at its values.
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    sheet: Posterior
    noise: NDArray[np.float64]
    step: Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Size:
    """How large an effect is: the parameter that lies most standard deviations from neutral, and by how much.

    Attributes:
        quantity: the parameter's name; mean, sd: of its distance from neutral, in its unit.
    """

    quantity: str
    mean: float
    sd: float
    unit: str


def size_of(effect: Candidate, values: Array, sd: Array) -> Size:
    """How large an effect with these numbers `[k]` and standard deviations `[k]` is; shapes are no sizes."""
    each = zip(effect.coordinates, effect.shapes, values, sd, strict=True)
    sizes = [
        Size(c.name.rsplit(".", 1)[1], abs(float(v - c.neutral)), float(s), c.unit)
        for c, shape, v, s in each
        if not shape
    ]
    return max(sizes, key=lambda size: size.mean / max(size.sd, 1e-12))


def at_its_mean(weighing: Weighing, key: Key) -> Model:
    """The model at its posterior mean, held-out estimates refitted; where it was if that is no better place.

    A mean far from the fit is the step of a linear model: from there it is looked for again.
    """
    fitter, state, old = weighing.state.fitter, weighing.state, weighing.scored[key]
    low, high = (np.array([getattr(c, end) for c in old.model.fit.coordinates]) for end in ("low", "high"))
    for _ in range(EFFORT.rounds):
        here = weighing.scored[key]
        mean, covariance = _own(here)
        mean = np.clip(mean, low, high)
        # a move by d standard deviations changes the log density by d^2 / 2 nats
        if np.all((mean - here.model.fit.values) ** 2 <= 2 * EFFORT.tolerance * np.diag(covariance)):
            break
        moved = fitter.refresh(replace(here.model.fit, values=mean, history=()))
        state.models[key] = scored(fitter, moved, old.model.effects)
        weighing.score([key])
    else:
        if weighing.scored[key].found.nats < old.found.nats - np.log(ODDS.mention):
            state.models[key], weighing.scored[key] = old.model, old
    (model,) = heldout.refitted(fitter, [state.models[key]])
    state.models[key] = model
    weighing.scored[key] = replace(weighing.scored[key], model=model)
    return model


def estimated(weighing: Weighing, found: Weighed) -> Estimated:
    """Of the answer's numbers; known parameters with all sets that are possible, by their probabilities."""
    answer, base = weighing.scored[found.answer], len(weighing.state.fitter.base)
    mean, covariance = _own(answer)
    covariance[:base, :base] += _beside(answer, base)
    keys = found.possible
    share = np.array([found.sets[k] for k in keys])
    share /= share.sum()
    each = [_known(weighing.scored[key], base) for key in keys]
    away, spread = (np.array(x) for x in zip(*((m - mean[:base], s) for m, s in each), strict=True))
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    wider = np.ones(len(sd))
    wider[:base] = np.maximum(_spread(share, away, spread) / sd[:base], 1.0)
    covariance = covariance * wider[:, None] * wider
    away = np.where(
        np.arange(len(sd)) < base, 0.0, mean - answer.model.fit.values
    )  # effects' numbers are those of the fit
    covariance = covariance + np.diag(away**2)

    def step(r: Array) -> Array:
        there = marginal(weighing.windows(answer.fit, r), answer.learnt.hyper)
        return belief_of(answer.fit).best(there.Q.sum(0))[: len(answer.model.fit.values)]

    above = np.maximum(answer.learnt.hyper.amplitude**2 - PRIORS.least**2, 0.0)  # less is there for any law
    size = weighing.scale * np.sqrt(above)
    covariance = covariance + doubts.covariance(weighing.state.fitter, weighing.D, size, step, answer.fit.r)
    return Estimated(mean, covariance, answer.found.posterior, answer.learnt.hyper.noise, step)


def _known(of: Scored, base: int) -> tuple[Array, Array]:
    """(means, standard deviations) `[base]` of the known parameters in one set."""
    mean, covariance = _own(of)
    covariance = covariance[:base, :base] + _beside(of, base)
    return mean[:base], np.sqrt(np.maximum(np.diag(covariance), 1e-300))


def _spread(share: Array, away: Array, sd: Array) -> Array:
    """Standard deviations `[k]` about 0 of a mixture of Gaussians; 1.645 of them hold 90 % of it at least.

    With a fifth of its probability far off, 1.645 standard deviations of a mixture do not reach there.

    Args:
        share: `[m]`, adding up to 1; away, sd: `[m, k]`, means and standard deviations.
    """
    both = np.concatenate([away, -away])  # the distance from 0 is within what this mixture holds up to 95 %
    half = mixture_quantiles(np.tile(share / 2, 2), both, np.tile(sd, (2, 1)), (0.95,))[0]
    return np.asarray(np.maximum(np.sqrt(share @ (sd**2 + away**2)), half / Z90))


def size_in(of: Scored, effect: Candidate) -> Size:
    """How large one of the model's effects is."""
    mean, covariance = _own(of)
    own = [of.model.fit.names.index(c.name) for c in effect.coordinates]
    return size_of(effect, mean[own], np.sqrt(np.diag(covariance)[own]))


def _beside(of: Scored, base: int) -> Array:
    """Covariance `[base, base]` of the known parameters that rest at a bound: none of them is known without error."""
    return np.diag(of.found.beside[:base] ** 2)


def _own(of: Scored) -> tuple[Array, Array]:
    """(mean `[k]`, covariance) of the model's numbers; of those at a bound no spread."""
    posterior, free = of.found.posterior, np.flatnonzero(of.found.free)
    mean, covariance = np.asarray(of.fit.values + of.learnt.step), np.zeros((len(of.fit.values),) * 2)
    mean[free] = posterior.middle
    covariance[np.ix_(free, free)] = posterior.together()
    k = len(of.model.fit.values)
    return mean[:k], covariance[:k, :k]
