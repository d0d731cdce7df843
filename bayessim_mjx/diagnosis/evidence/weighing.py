"""The evidence of fitted models, the posterior over sets of effects, and that of the answer's numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from bayessim_mjx.diagnosis.evidence import doubts, gaussian
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, Learnt, Windows, learn, marginal, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import Integrated, Posterior, belief_of, integrated, unlikely
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.models import BASE, Key, Model, scored
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, ODDS, PRIORS, RELEVANCE
from bayessim_mjx.diagnosis.selection.screen import part
from bayessim_mjx.diagnosis.selection.search_state import SearchState, log_prior
from bayessim_mjx.diagnosis.statistics import Z90, mixture_quantiles

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weighed:
    """Posterior probabilities of the sets that were fitted, most likely first.

    A set with irrelevant effects is no explanation of its own: it counts for the set without them (`core`). An effect
    that does the work of known parameters is relevant where these lie far from the data sheet without it. Known
    parameters are averaged over the sets as they are, as an irrelevant effect may take a part of their values.

    Attributes:
        weight: {explanation: probability}; nats: {explanation: log of evidence and prior over those of the known
            parameters alone}. numbers: {set: free numbers of its effects}.
        sets: {set: probability}, every one by itself.
        left: {set: what its model leaves}.
    """

    weight: Mapping[Key, float]
    nats: Mapping[Key, float]
    numbers: Mapping[Key, int]
    sets: Mapping[Key, float]
    left: Mapping[Key, Left]

    @property
    def answer(self) -> Key:
        """Of the sets that are as likely as the most likely one (`Odds.mention`), that with the fewest numbers.

        No effects that leave a relevant gap which others of them close: their evidence may rest on one of `doubts`,
        such as a late sensor, that no simulator gets. No effect without which only known parameters move, unless the
        logs alone and the data sheet alone both speak for it: else it is not separated from a wrong data sheet.
        """
        likely, top = self._within(ODDS.mention), next(iter(self.weight))
        limit = min(self.left[k].excess for k in likely) + _relevant(self.left)
        closing = [k for k in likely if not k or self.left[k].excess <= limit]
        closing += [k for k in self.weight if k < top and self.left[k].excess <= limit and not self._separate(top, k)]
        return min(closing, key=lambda k: (len(k), self.numbers[k], -self.weight[k], sorted(k)))

    def _separate(self, whole: Key, part: Key) -> bool:
        """Whether the logs alone and the data sheet alone both speak strongly for what a set has more than its part."""
        sheet = self.left[part].unlikely - self.left[whole].unlikely
        return bool(min(sheet, self.nats[whole] - self.nats[part] - sheet) > np.log(ODDS.strong))

    @property
    def beside(self) -> list[Key]:
        """The other sets that the evidence does not speak strongly against, most likely first."""
        return [k for k in self._within(ODDS.strong) if k != self.answer]

    @property
    def possible(self) -> list[Key]:
        """The sets by themselves that the evidence does not speak strongly against, and the answer."""
        best = max(self.sets.values())
        return list(dict.fromkeys([self.answer, *(k for k, w in self.sets.items() if w * ODDS.strong >= best)]))

    def chance(self) -> dict[str, float]:
        """Probabilities of the answer with or without more, of its rivals, and of the known parameters alone."""
        answer = [k for k in self.weight if self.answer <= k] if self.answer else [BASE]
        rivals = [k for k in self.beside if k not in answer]
        each = {"answer": answer, "rivals": rivals, "nothing": [BASE]}
        return {name: sum(self.weight.get(k, 0.0) for k in some) for name, some in each.items()}

    def to_dicts(self) -> list[dict[str, Any]]:
        """Return the sets with 99.9 % of the probability, and the known parameters alone, for JSON."""
        kept, whole = [], 0.0
        for key, weight in self.weight.items():
            kept += [key] if whole < 0.999 or key == BASE else []
            whole += weight
        base = self.nats[BASE]
        return [{"effects": sorted(k), "probability": self.weight[k], "nats": self.nats[k] - base} for k in kept]

    def _within(self, odds: float) -> list[Key]:
        best = max(self.weight.values())
        return [k for k, w in self.weight.items() if w * odds >= best]


@dataclass(frozen=True)
class Left:
    """What a set's model leaves.

    Attributes:
        excess: held-out squared error above the noise, in noise variances.
        unlikely: minus the log prior density of its known parameters, in nats (`parameters.unlikely`).
    """

    excess: float
    unlikely: float = 0.0


def core(key: Key, left: Mapping[Key, Left]) -> Key:
    """Return the smallest subset of a set that does as well: neither gap nor known parameters are relevantly farther.

    Args:
        left: of all sets that were fitted.
    """
    limit, unlikely = left[key].excess + _relevant(left), left[key].unlikely + np.log(ODDS.mention)
    enough = [k for k in left if k <= key and left[k].excess <= limit and left[k].unlikely <= unlikely]
    return min(enough, key=lambda k: (len(k), left[k].excess, sorted(k)))


def _relevant(left: Mapping[Key, Left]) -> float:
    """Return the smallest difference in `Left.excess` that is a relevant part of the gap."""
    return RELEVANCE.noise + RELEVANCE.share * max(left[BASE].excess, 0.0)


def weighed(
    evidence: Mapping[Key, float],
    left: Mapping[Key, Left],
    numbers: Mapping[Key, int],
    candidates: int,
    special: Mapping[Key, Key] = MappingProxyType({}),
) -> Weighed:
    """Return the posterior; `evidence` and `left` have the empty set, the known parameters alone.

    special: {set: the same with a special case in the place of a law whose further numbers are neutral}: one model.
    """
    total = {k: e + log_prior(k, candidates) for k, e in evidence.items()}
    own, of = {k: left[k] for k in evidence}, dict[Key, list[float]]()
    for key, nats in total.items():
        needed = core(key, own)
        of.setdefault(special.get(needed, needed), []).append(nats - total[BASE])
    explained = {k: float(logsumexp(each)) for k, each in of.items()}
    return Weighed(_shares(explained), dict(explained), numbers, _shares(total), own)


def _shares(nats: Mapping[Key, float]) -> dict[Key, float]:
    """Probabilities by their logs, the greatest first."""
    whole = logsumexp(list(nats.values()))
    return {k: float(np.exp(nats[k] - whole)) for k in sorted(nats, key=lambda k: (-nats[k], len(k), sorted(k)))}


@dataclass(frozen=True, eq=False)
class Scored:
    """A fitted model with its evidence; fit: its own with the numbers of `doubts` beside its own numbers."""

    model: Model
    fit: Fit
    learnt: Learnt
    found: Integrated

    def numbers(self) -> tuple[Array, Array]:
        """(mean `[k]`, covariance) of the model's numbers; of those at a bound no spread."""
        free, k = np.flatnonzero(self.found.free), len(self.model.fit.values)
        mean, covariance = np.asarray(self.fit.values + self.learnt.step), np.zeros((len(self.fit.values),) * 2)
        mean[free] = self.found.posterior.middle
        covariance[np.ix_(free, free)] = self.found.posterior.together()
        return mean[:k], covariance[:k, :k]

    def known(self, base: int) -> tuple[Array, Array]:
        """(mean `[base]`, covariance) of the known parameters; none that rests at a bound is known without error."""
        mean, covariance = self.numbers()
        return mean[:base], covariance[:base, :base] + np.diag(self.found.beside[:base] ** 2)


class Weighing:
    """The evidence of all fitted sets of a search.

    Attributes:
        scored: {set: its model with its evidence}; D: `[W, n, nv m]`, effect of forces on the windows
            (`gaussian.columns`), at the fit of the known parameters. special: as in `weighed`.
    """

    def __init__(self, state: SearchState) -> None:
        fitter = state.fitter
        self.state = state
        self.scale = gaussian.force_scale(fitter)
        self.D = gaussian.columns(fitter, state.base.fit, gaussian.default_nodes(fitter), self.scale)
        self.channels = int(fitter.used.sum())
        self.scored: dict[Key, Scored] = {}
        self.special: dict[Key, Key] = {}
        self.doubts = doubts.found(fitter, self.D, state.base.fit.B)
        self.score([BASE])

    def windows(self, fit: Fit, own: NDArray[np.int64] | slice = slice(None)) -> Windows:
        """Return the linear model about a fit to the windows `own`."""
        return windows_of(fit.r, fit.A, fit.B, self.D[own], fit.offsets, fit.spread, self.scale, self.channels)

    def products(self, fit: Fit, hyper: Hyper, more: Array, own: NDArray[np.int64]) -> tuple[Array, float]:
        """`Marginal.Q` of (r, A, more `[w, n, c]`), and the log determinant, summed over the windows `own`."""
        Q, logdet = np.zeros((1 + len(fit.values) + more.shape[2],) * 2), 0.0
        for i, window in enumerate(own[:, None]):  # one by one: their products are large
            some = part(fit, window)
            some = replace(some, A=np.concatenate([some.A, more[i : i + 1]], 2))
            there = marginal(self.windows(some, window), hyper)
            Q, logdet = Q + there.Q[0], logdet + float(there.logdet[0])
        return Q, logdet

    def score(self, keys: Iterable[Key]) -> None:
        """Compute the evidence of fitted models, again where the fit has changed."""
        for key in keys:
            model, old = self.state.models.get(key), self.scored.get(key)
            if model is not None and (old is None or old.model is not model):
                fit, like, numbers = self.doubts.beside(model.fit), self._alike(), _numbers(model)
                windows = self.windows(fit)
                learnt = learn(windows, belief_of(fit), like)
                self.scored[key] = Scored(model, fit, learnt, integrated(fit, learnt, numbers))

    def _alike(self) -> list[Hyper]:
        """Hyperparameters to begin at: of the known parameters alone, and of the likeliest set."""
        some = {BASE: 0, self._best(): 0} if self.scored else {}
        return [self.scored[k].learnt.hyper for k in some]

    def left(self, keys: Iterable[Key]) -> dict[Key, Left]:
        """Return what sets leave, above the likeliest set's noise, in noise variances as estimated from the logs."""
        floor = float(np.mean(self.scored[self._best()].learnt.hyper.noise ** 2))
        models = {k: self.scored[k].model for k in keys}
        squares = {k: m.total / (self.state.noise * len(m.cost)) for k, m in models.items()}
        return {k: Left(squares[k] - floor, unlikely(m.fit.coordinates, m.fit.away)) for k, m in models.items()}

    def _best(self) -> Key:
        return max(self.scored, key=self.total)

    def settled(self, key: Key) -> bool:
        """Whether a set of effects leaves nothing that matters."""
        left = self.left([key, BASE])
        return bool(key) and left[key].excess <= _relevant(left)

    def total(self, key: Key) -> float:
        """Log of evidence and prior over those of the known parameters alone."""
        more = self.state.log_prior(key)
        return self.scored[key].found.nats + more - self.scored[BASE].found.nats

    def weighed(self) -> Weighed:
        """Return the posterior over what was weighed."""
        return self._weighed({k: s.found.nats for k, s in self.scored.items()})

    def without(self, condition: int) -> Weighed:
        """Return the posterior given all windows but those of one operating condition, by the same hyperparameters."""
        kept = self.state.fitter.simulator.windows.group != condition
        rough = {k: _without(s, kept, sizes=False) for k, s in self.scored.items()}
        total = {k: nats + self.state.log_prior(k) for k, nats in rough.items()}
        near = [k for k in rough if k == BASE or total[k] > max(total.values()) - EFFORT.margin]
        return self._weighed(rough | {k: _without(self.scored[k], kept) for k in near})

    def _weighed(self, nats: dict[Key, float]) -> Weighed:
        numbers = {k: sum(len(e.coordinates) for e in s.model.effects) for k, s in self.scored.items()}
        return weighed(nats, self.left(self.scored), numbers, len(self.state.candidates), self.special)


def _without(of: Scored, kept: NDArray[np.bool_], sizes: bool = True) -> float:
    """Evidence given some of the windows alone, with the same hyperparameters; sizes: of effects summed over."""
    there = of.learnt.marginal
    some = replace(there, Q=there.Q[kept], logdet=there.logdet[kept], cov=there.cov[kept], mean=there.mean[kept])
    learnt = replace(of.learnt, marginal=some, step=belief_of(of.fit).best(some.Q.sum(0)))
    return integrated(of.fit, learnt, _numbers(of.model) if sizes else ()).nats


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

    mean: Array
    covariance: Array
    sheet: Posterior
    noise: Array
    step: Callable[[Array], Array]


def at_its_mean(weighing: Weighing, key: Key) -> Model:
    """Return the model at its posterior mean, held-out estimates refitted; where it was if that is no place as good.

    A mean far from the fit is the step of a linear model: from there it is looked for again. Of a product of two
    numbers that the logs do not tell apart (a payload's mass and lever) the means are not the product.
    """
    fitter, state, old = weighing.state.fitter, weighing.state, weighing.scored[key]
    low, high = (np.array([getattr(c, end) for c in old.model.fit.coordinates]) for end in ("low", "high"))
    for _ in range(EFFORT.rounds):
        here = weighing.scored[key]
        mean, covariance = here.numbers()
        mean = np.clip(mean, low, high)
        # a move by d standard deviations changes the log density by d^2 / 2 nats
        if np.all((mean - here.model.fit.values) ** 2 <= 2 * RELEVANCE.share * np.diag(covariance)):
            break
        moved = fitter.refresh(replace(here.model.fit, values=mean, history=()))
        state.models[key] = scored(fitter, moved, old.model.effects)
        weighing.score([key])
    worse = np.mean(weighing.scored[key].model.fit.r ** 2 - old.model.fit.r**2) > RELEVANCE.noise
    if worse or weighing.scored[key].found.nats < old.found.nats - np.log(ODDS.mention):
        state.models[key], weighing.scored[key] = old.model, old
    state.models[key] = model = heldout.refitted(fitter, state.models[key])
    weighing.scored[key] = replace(weighing.scored[key], model=model)
    return model


def estimated(weighing: Weighing, found: Weighed) -> Estimated:
    """Of the answer's numbers; known parameters with all sets that are possible, by their probabilities."""
    answer, base = weighing.scored[found.answer], len(weighing.state.fitter.base)
    mean, covariance = answer.numbers()
    covariance[:base, :base] = answer.known(base)[1]
    sd = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    share = np.array([found.sets[k] for k in found.possible])
    each = [weighing.scored[key].known(base) for key in found.possible]
    away = np.array([m - mean[:base] for m, _ in each])
    spread = np.sqrt(np.maximum([np.diag(c) for _, c in each], 1e-300))
    wider = np.ones(len(sd))
    wider[:base] = np.maximum(_spread(share / share.sum(), away, spread) / sd[:base], 1.0)
    covariance = covariance * wider[:, None] * wider
    moved = mean - answer.model.fit.values  # effects' numbers are those of the fit
    moved[:base] = 0.0
    covariance = covariance + np.diag(moved**2)

    def step(r: Array) -> Array:
        there = marginal(weighing.windows(replace(answer.fit, r=r)), answer.learnt.hyper)
        return belief_of(answer.fit).best(there.Q.sum(0))[: len(answer.model.fit.values)]

    above = np.maximum(answer.learnt.hyper.amplitude**2 - PRIORS.least**2, 0.0)  # less is there for any law
    size = weighing.scale * np.sqrt(above)
    covariance = covariance + _taken(weighing, answer, doubts.common(weighing.state.fitter, weighing.D, size))
    return Estimated(mean, covariance, answer.found.posterior, answer.learnt.hyper.noise, step)


def _taken(weighing: Weighing, of: Scored, columns: Array) -> Array:
    """`[k, k]`, of a model's numbers that take errors with columns `[W, n, c]`, each of standard deviation 1."""
    k, free = len(of.fit.values), np.flatnonzero(of.found.free)
    Q, _ = weighing.products(of.fit, of.learnt.hyper, columns, np.arange(len(of.fit.r)))
    H, moves = Q[1 : 1 + k, 1 : 1 + k] + np.diag(belief_of(of.fit).precision), np.zeros((k, columns.shape[2]))
    moves[free] = np.linalg.solve(H[np.ix_(free, free)], Q[1 : 1 + k, 1 + k :][free])
    return np.asarray(moves @ moves.T)[: len(of.model.fit.values), : len(of.model.fit.values)]


def _spread(share: Array, away: Array, sd: Array) -> Array:
    """Return standard deviations `[k]` about 0 of a mixture of Gaussians; 1.645 of them hold 90 % of it at least.

    With a fifth of its probability far off, 1.645 standard deviations of a mixture do not reach there.

    Args:
        share: `[m]`, adding up to 1; away, sd: `[m, k]`, means and standard deviations.
    """
    both = np.concatenate([away, -away])  # the distance from 0 is within what this mixture holds up to 95 %
    half = mixture_quantiles(np.tile(share / 2, 2), both, np.tile(sd, (2, 1)), (0.95,))[0]
    return np.asarray(np.maximum(np.sqrt(share @ (sd**2 + away**2)), half / Z90))
