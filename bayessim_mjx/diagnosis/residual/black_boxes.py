"""Forces without a name that are fitted to what a model leaves: flexible ones, a small network, a sparse formula.

All are linear regressions through the simulator's own columns,  r_w = D_w Phi_w beta + B_w x + A_w p + noise,  Phi
features of the measured motion, and all are scored on conditions that they have not seen. The flexible force knows what
effects depend on: it shows the part of the gap that motion predicts, and the inputs of that part. Network and formula
know only positions, speeds and efforts: they are rivals of the named effects. Their inputs are measured motion, so that
they are favoured: in a simulation they would have to live with the motion that they cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import RULES, solve
from bayessim_mjx.diagnosis.residual import motion_inputs
from bayessim_mjx.diagnosis.residual.disturbance import Linear, estimate
from bayessim_mjx.diagnosis.residual.motion_inputs import PLAIN, QUANTITIES, WORDS, Features, Inputs, laws, plain
from bayessim_mjx.diagnosis.residual.regions import FALSE
from bayessim_mjx.diagnosis.statistics import Gap, normal_deviate

Array = NDArray[np.float64]
Groups = NDArray[np.int64]

# Of the mean curvature of each joint's features, a decade apart; the best one is chosen on held-out data. A rule of
# thumb, not counted: no verdict rests on it
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)


class Problem:
    """What all regressions on a fit share: windows, priors, inputs, costs without a force."""

    def __init__(self, fitter: Fitter, fit: Fit, linear: Linear) -> None:
        self.fitter, self.fit, self.linear, self.q = fitter, fit, linear, linear.quadratic
        self.inputs = motion_inputs.measured(fitter.simulator.windows, fitter.simulator.physics.mj_model)
        self.precision, self.pull, self.low, self.high = fit.prior()
        self.k, self.nv = fit.A.shape[2], len(linear.scale)

    def base(self, fold: Groups) -> Array:
        """Held-out costs `[W]` of the fit itself."""
        return self.fitter.scores(self.fit, fold)[0]

    def with_priors(self, S: Array, g: Array, pulled: Array) -> tuple[Array, Array]:
        """(curvature, slope) of parameters and weights with their priors; pulled: `[F]`, precision of the weights'."""
        more = np.concatenate([self.precision + RULES.trust * np.diag(S)[: self.k], pulled])
        return S + np.diag(more), g + np.concatenate([self.pull, 0 * pulled])

    def solve(self, A: Array, b: Array) -> Array:
        """Most probable parameters, within their bounds, and weights, which have none and are eliminated first."""
        k = self.k
        weights = cho_factor(A[k:, k:])
        by_parameters, alone = cho_solve(weights, A[k:, :k]), cho_solve(weights, b[k:])
        p = solve(A[:k, :k] - A[:k, k:] @ by_parameters, b[:k] - A[:k, k:] @ alone, self.low, self.high)
        return np.concatenate([p, alone - by_parameters @ p])

    def features(self, quantities: Sequence[str], seed: int = 0, physics: bool = False) -> Features:
        """Of the logs."""
        return Features(self.inputs, self.linear.average, quantities, seed, physics)


class Regression:
    """A fit's parameters and weights of features phi `[W, m, nv, F]` together, as one linear model of K = k + nv F."""

    def __init__(self, problem: Problem, phi: Array) -> None:
        self.problem, self.phi = problem, phi

    def sums(self, some: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Curvature `[K, K]` and slope `[K]` of some windows."""
        k, (count, m, nv, each) = self.problem.k, self.phi[some].shape
        T = np.zeros((count, k + nv * m, k + nv * each))  # to (parameters, forces at the nodes)
        T[:, np.arange(k), np.arange(k)] = 1.0
        for v, scale in enumerate(self.problem.linear.scale):
            T[:, k + v * m : k + (v + 1) * m, k + v * each : k + (v + 1) * each] = scale * self.phi[some][:, :, v]
        q, weight = self.problem.q, self.problem.fit.weight[some]
        half = np.concatenate([q.S[some] @ T, q.g[some][..., None]], 2) * weight[:, None, None]
        both = np.tensordot(T, half, ([0, 1], [0, 1]))
        return both[:, :-1], both[:, -1]

    def fitted(self, S: Array, g: Array, ridge: float) -> Array:
        """`[K]`, with a ridge of the mean curvature of each joint's features."""
        own = np.diag(S)[self.problem.k :].reshape(self.problem.nv, -1)
        pulled = np.repeat(ridge * own.mean(1) + np.finfo(np.float32).eps * own.max(), own.shape[1]) + 1e-300
        return self.problem.solve(*self.problem.with_priors(S, g, pulled))

    def without(self, fold: Groups, ridges: Sequence[float]) -> Array:
        """`[ridges, folds, K]`, the fits without each fold."""
        parts = [self.sums(fold == name) for name in np.unique(fold)]
        S, g = sum(part[0] for part in parts), sum(part[1] for part in parts)
        return np.array([[self.fitted(S - s, g - t, ridge) for s, t in parts] for ridge in ridges])

    def costs(self, fold: Groups, fits: Array, phi: Array | None = None) -> Array:
        """Costs `[W]` of windows under fits `[folds, K]` without their fold, with other features phi if given."""
        each, phi = fits[np.unique(fold, return_inverse=True)[1]], self.phi if phi is None else phi
        weights = each[:, self.problem.k :].reshape(len(phi), *phi.shape[2:]) * self.problem.linear.scale[:, None]
        force = np.einsum("wmvf,wvf->wvm", phi, weights, optimize=True).reshape(len(phi), -1)
        return self.problem.q.at(np.concatenate([each[:, : self.problem.k], force], 1))


@dataclass(frozen=True, eq=False)
class Held:
    """Held-out costs under one way of splitting.

    Attributes:
        cost: `[W]`, of the median seed, unweighted, each fold's with the ridge that is best on the others; base: `[W]`,
            of the model without the force.
        totals: `[seeds, ridges]`; seed: the one in `cost`.
        ridge: the largest that loses less than a standard error against the best (Breiman et al., 1984, sec. 3.4.3).
        gain: how much cheaper all windows together are.
        t: of the windows' log gain above the noise by folds, as a normal deviate; unlike the gain itself
            it is not ruled by the conditions with the largest errors.
    """

    cost: Array
    base: Array
    totals: Array
    ridge: float
    seed: int
    gain: float
    t: float

    @property
    def significant(self) -> bool:
        """Whether chance alone hardly gains as much."""
        return self.gain > 0 and self.t > normal_quantile()


def normal_quantile() -> float:
    """Return the normal deviate beyond which, on either side, chance is as rare as false discoveries."""
    from scipy.special import ndtri

    return float(-ndtri(FALSE / 2))


def held_out(problem: Problem, runs: Sequence[Regression], fold: Groups) -> Held:
    """Held-out costs of regressions that differ in their random features."""
    costs = np.array([[run.costs(fold, fits) for fits in run.without(fold, RIDGES)] for run in runs])
    totals, base = costs.sum(2), problem.base(fold)
    best = int(np.argmin(np.median(totals, 0)))
    seed = int(np.argsort(totals[:, best])[(len(runs) - 1) // 2])
    wide = [j for j in range(best, len(RIDGES)) if normal_deviate(costs[seed, j] - costs[seed, best], fold) < 1]
    cost, names = np.empty(len(fold)), np.unique(fold)
    for name in names:
        own = fold == name
        rest = ~own if len(names) > 1 else own
        cost[own] = costs[seed, int(np.argmin(np.median(costs[:, :, rest].sum(2), 0))), own]
    size = problem.fitter.size
    t = normal_deviate(np.log(np.maximum(base, 0) + size) - np.log(np.maximum(cost, 0) + size), fold)
    return Held(cost, base, totals, RIDGES[max(wide, default=best)], seed, float(np.sum(base - cost)), t)


@dataclass(frozen=True, eq=False)
class Flexible:
    """Outcome of the flexible force.

    Attributes:
        condition, interpolation: held out by operating condition, by blocks within conditions.
        depends_on: [{"input": "elbow speed", "joint", "quantity", "importance"}], largest first; importance: share of
            the gain that is lost when it is taken from other windows.
        where: {joint: share of the gain lost without the force on it}; samples: residuals in a window.
    """

    condition: Held
    interpolation: Held
    depends_on: list[dict]
    where: dict[str, float]
    samples: int


def flexible(
    fitter: Fitter, fit: Fit, linear: Linear | None = None, *, seeds: Sequence[int] = (0, 1, 2, 3, 4)
) -> Flexible:
    """Fit and score a flexible force on top of a fit; one black box tells nothing, so over several seeds.

    linear: of this fit, None: made here.
    """
    problem = Problem(fitter, fit, estimate(fitter, fit).linear if linear is None else linear)
    windows, features = fitter.simulator.windows, [problem.features(QUANTITIES, seed, physics=True) for seed in seeds]
    runs = [Regression(problem, own(problem.inputs)) for own in features]
    folds = {
        "condition": windows.group,
        "interpolation": blocks(windows.log, windows.start, windows.steps),
    }
    held = {name: held_out(problem, runs, fold) for name, fold in folds.items()}
    name = max(held, key=lambda n: held[n].gain)
    best, fold = held[name], folds[name]
    run, fits = runs[best.seed], runs[best.seed].without(fold, [best.ridge])[0]
    reference = run.costs(fold, fits).sum()

    def lost(phi: Array) -> float:
        share = (run.costs(fold, fits, phi).sum() - reference) / max(best.gain, 1e-300)
        return float(np.clip(share, 0.0, 1.0)) if best.gain > 0 else 0.0

    joints = problem.inputs.joints
    depends: list[dict[str, Any]] = []
    for v, joint in enumerate(joints):
        for quantity in QUANTITIES:
            phi = features[best.seed](_elsewhere(problem.inputs, v, quantity))
            words = f"{joint} {WORDS[quantity]}"
            depends.append({"input": words, "joint": joint, "quantity": quantity, "importance": lost(phi)})
    where = {joint: lost(run.phi * (np.arange(len(joints)) != v)[:, None]) for v, joint in enumerate(joints)}
    depends.sort(key=lambda d: -d["importance"])
    return Flexible(held["condition"], held["interpolation"], depends, where, fitter.size)


def blocks(log: Groups, start: Groups, steps: int) -> Groups:
    """Fold `[W]` of each window: pairs of windows in a row go to the parts of a held-out condition in turn."""
    return (start // (2 * steps) + log) % RULES.parts


def _elsewhere(inputs: Inputs, joint: int, quantity: str) -> Inputs:
    """Return the inputs, of which one comes from other windows."""
    values = np.array(inputs.of(quantity))
    values[:, :, joint] = np.random.default_rng(0).permutation(values[:, :, joint])
    return replace(inputs, **{quantity: values})  # type: ignore[arg-type]


@dataclass(frozen=True)
class Term:
    """`force` N m or N per unit of `what` at a joint; where: "0.31 sign(speed)"."""

    joint: str
    what: str
    force: float


@dataclass(frozen=True, eq=False)
class BlackBoxes:
    """Shares of the recalibrated simulator's squared gap above the noise that are closed, on conditions held out.

    Attributes:
        network, formula: of the black boxes; named: of the effects of the verdict, NaN of none. Below 0: worse than
            nothing.
        terms: of the formula that is fitted to all conditions, for people.
        folds: conditions, each of which was held out.
    """

    network: float
    formula: float
    named: float
    terms: tuple[Term, ...]
    folds: int


def race(fitter: Fitter, base: Fit, named: Fit | None, linear: Linear, noise: float) -> BlackBoxes | None:
    """All of them on the same windows; None where there is one condition only.

    Args:
        base: the fit of the known parameters; named: with the effects, None without any.
        linear: of the base fit; noise: squared residual of a window that is noise alone.
    """
    fold = fitter.simulator.windows.group
    if len(np.unique(fold)) < 2:
        return None
    problem = Problem(fitter, base, linear)
    before, floor = float(problem.base(fold).sum()), noise * len(fold)

    def closed(cost: Array) -> float:
        return Gap(before, float(cost.sum()), floor).closed

    of_formula, terms = formula(problem, fold)
    of_names = float("nan") if named is None else closed(fitter.scores(named, fold)[0])
    return BlackBoxes(closed(network(problem, fold)), closed(of_formula), of_names, terms, len(np.unique(fold)))


def network(problem: Problem, fold: Groups) -> Array:
    """Costs `[W]` of windows under networks of one hidden layer trained without their fold."""
    phi = problem.features(PLAIN)(problem.inputs)
    return held_out(problem, [Regression(problem, phi)], fold).cost


def formula(problem: Problem, fold: Groups) -> tuple[Array, tuple[Term, ...]]:
    """(costs `[W]` of windows under the formulas without their fold, terms of the one of all windows)."""
    values, joints = plain(problem.inputs), problem.inputs.joints
    size = np.sqrt(np.mean(values**2, (0, 1))) + 1e-300
    average = problem.linear.average
    on = Regression(problem, np.einsum("hm,whvf->wmvf", average, values / size, optimize=True))
    costs, names = problem.fit.weight * problem.q.c, np.unique(fold)
    fits = np.array([_chosen(on, fold != name, float(costs[fold != name].sum())) for name in names])
    whole = _chosen(on, fold == fold, float(costs.sum()))[problem.k :].reshape(problem.nv, -1)
    beta = whole / size * problem.linear.scale[:, None]
    own = list(laws(problem.inputs))
    terms = []
    for v, f in np.argwhere(beta):
        others = [f"{what} of {other}" for what in "qwu" for i, other in enumerate(joints) if i != v]
        terms.append(Term(joints[v], [*own, *others][f], float(beta[v, f])))
    return on.costs(fold, fits), tuple(terms)


def _chosen(on: Regression, some: NDArray[np.bool_], cost: float) -> Array:
    """`[K]`, numbers with terms by forward selection, the fit's parameters refitted; 0 of terms that are not in.

    A term stays if it explains more than chance does: log(candidates) + log(numbers) / 2 nats (the extended Bayesian
    criterion of Chen and Chen, 2008), in misfits as large as those that are left.
    """
    problem, (S, g) = on.problem, on.sums(some)
    k, count, numbers = problem.k, len(g), problem.fitter.numbers
    A, b = problem.with_priors(S, g, np.finfo(np.float32).eps * np.diag(S)[k:] + 1e-300)  # terms may be alike
    price = np.log(count - k) + 0.5 * np.log(numbers)
    keep, found, left = np.arange(count) < k, np.zeros(count), np.inf
    while True:
        own, trial = np.flatnonzero(keep), np.zeros(count)
        trial[own] = problem.solve(A[np.ix_(own, own)], b[own])
        now = max(cost - 2 * float(g @ trial) + float(trial @ S @ trial), 1e-300)
        if 0.5 * numbers * np.log(left / now) < price:
            return found
        found, left = trial, now
        free, p = keep.copy(), trial[:k]  # parameters that rest at a bound do not move with a further term
        free[:k] = (p > problem.low) & (p < problem.high)
        gains = np.where(keep, 0.0, _gains(A, b - A @ trial, free))
        if not gains.max() > 0:
            return found
        keep = keep | (np.arange(count) == np.argmax(gains))


def _gains(A: Array, slope: Array, inside: NDArray[np.bool_]) -> Array:
    """`[K]`, by how much each further number would lower the cost, those inside refitted."""
    cross = A[inside]
    solved = np.linalg.solve(A[np.ix_(inside, inside)], np.concatenate([cross, slope[inside][:, None]], 1))
    left, curvature = slope - cross.T @ solved[:, -1], np.diag(A) - np.einsum("ij,ij->j", cross, solved[:, :-1])
    rounding = np.finfo(np.float32).eps * np.diag(A)
    return np.where(curvature > rounding, left**2 / np.maximum(curvature, 1e-300), 0.0)
