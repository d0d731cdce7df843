"""A sparse formula for a missing force: few terms of positions, speeds and efforts, chosen one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regression import OnFeatures, Regression, Sums

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How large a formula may be.

    A term is worth it where it explains more than chance does: log(candidates) + log(numbers) / 2 nats (the extended
    Bayesian criterion of Chen and Chen, 2008), in misfits as large as those that are left.
    """

    most: int = 3  # terms for each joint on average
    tried: int = 5  # terms that are fitted in each turn, the most promising ones by linear algebra
    ridge: float = 1e-6
    slow: float = 0.02  # of the largest speed, where a sign changes gradually


RULES = Rules()


@dataclass(frozen=True)
class Term:
    """`force` N m or N per unit of `what` at a joint; where: "0.31 sign(speed)"."""

    joint: str
    what: str
    force: float


def features(inputs: Inputs) -> tuple[Array, tuple[str, ...]]:
    """(values `[W, H, nv, F]`, names): of the joint itself in rad or m, rad/s or m/s, N m or N."""
    q, w, u = inputs.position, inputs.speed, inputs.effort
    sign = np.tanh(w / (RULES.slow * inputs.speed_scale))
    terms = {
        "1": np.ones_like(q), "q": q, "q^2": q**2, "q^3": q**3, "sin q": np.sin(q), "cos q": np.cos(q),
        "w": w, "sign w": sign, "w |w|": w * np.abs(w), "u": u, "|u|": np.abs(u), "u |u|": u * np.abs(u),
        "|u| sign w": np.abs(u) * sign, "q w": q * w, "q u": q * u, "u w": u * w, "q sign w": q * sign,
    }  # fmt: skip
    others = [np.stack([np.delete(x, v, 2) for v in range(q.shape[2])], 2) for x in (q, w, u)]
    names = [f"{n} of another joint ({i + 1})" for n in "qwu" for i in range(q.shape[2] - 1)]
    return np.concatenate([np.stack(list(terms.values()), 3), *others], 3), (*terms, *names)


def held_out(problem: Regression, fold: NDArray[np.int64]) -> tuple[Array, tuple[Term, ...]]:
    """(costs `[W]` of windows under the formulas without their fold, terms of the one of all windows)."""
    values, names = features(problem.inputs)
    size = np.sqrt(np.mean(values**2, (0, 1))) + 1e-12
    on = OnFeatures(problem, np.einsum("hm,whvf->wmvf", problem.average, values / size, optimize=True))
    parts = on.sums(fold)
    whole = reduce(Sums.plus, parts)
    costs = problem.fit.weight * problem.q.c
    fits = [_chosen(on, whole.minus(part), float(costs[fold != f].sum())) for f, part in enumerate(parts)]
    beta = _chosen(on, whole, float(costs.sum()))[1].reshape(problem.nv, -1) / size
    terms = [
        Term(problem.inputs.joints[v], _named(names[f], problem.inputs.joints, v), float(beta[v, f]))
        for v, f in np.argwhere(beta)
    ]
    return on.costs(fold, fits, on.phi), tuple(terms)


def _named(name: str, joints: tuple[str, ...], v: int) -> str:
    """`w of elbow`."""
    what, _, which = name.partition(" of another joint (")
    others = [*joints[:v], *joints[v + 1 :]]
    return f"{what} of {others[int(which[:-1]) - 1]}" if which else what


def _chosen(on: OnFeatures, sums: Sums, cost: float) -> tuple[Array, Array]:
    """(parameter step, beta `[nv F]`, 0 of terms that are not in) by forward selection, known parameters refitted."""
    problem = on.problem
    unit = np.repeat(problem.scale, on.each)
    keep = np.zeros(len(sums.g), bool)
    best, step, beta = _cost(on, sums, keep, cost)
    numbers = problem.fitter.numbers
    price = np.log(len(keep)) + 0.5 * np.log(numbers)
    for _ in range(RULES.most * problem.nv):
        # parameters that rest at a bound do not move with the term
        free = (step > problem.low) & (step < problem.high)
        further = [keep | (np.arange(len(keep)) == i) for i in np.argsort(-_gains(sums, keep, free))[: RULES.tried]]
        found = [_cost(on, sums, terms, cost) for terms in further]
        at = int(np.argmin([f[0] for f in found]))
        if 0.5 * numbers * np.log(best / max(found[at][0], 1e-300)) < price:
            break
        keep, (best, step, beta) = further[at], found[at]
    return step, beta * unit


def _gains(sums: Sums, keep: NDArray[np.bool_], free: NDArray[np.bool_]) -> Array:
    """`[nv F]`, by how much each further term would lower the cost, free parameters and terms so far refitted."""
    A = np.block([[sums.Spp[np.ix_(free, free)], sums.C[free]], [sums.C[free].T, sums.S]])
    g = np.concatenate([sums.gp[free], sums.g])
    inside = np.concatenate([np.ones(int(free.sum()), bool), keep])
    own = A[np.ix_(inside, inside)] + 1e-9 * np.diag(np.diag(A)[inside] + 1e-300)
    cross = A[np.ix_(inside, ~inside)]
    solved = np.linalg.solve(own, np.concatenate([cross, g[inside][:, None]], 1))
    left = g[~inside] - cross.T @ solved[:, -1]
    alone = np.diag(A)[~inside]
    curvature = alone - np.einsum("ij,ij->j", cross, solved[:, :-1])
    gains = np.full(len(keep), -1.0)
    gains[~keep] = np.where(curvature > 1e-6 * alone, left**2 / np.maximum(curvature, 1e-300), 0.0)
    return gains


def _cost(on: OnFeatures, sums: Sums, keep: NDArray[np.bool_], cost: float) -> tuple[float, Array, Array]:
    """(cost, parameter step, beta `[nv F]` in units of the joints' scale) with the terms that are in."""
    some = np.flatnonzero(keep)
    own = Sums(sums.S[np.ix_(some, some)], sums.C[:, some], sums.g[some], sums.Spp, sums.gp)
    problem = on.problem
    step, inner = problem.together(own, RULES.ridge)
    beta = np.zeros(len(keep))
    beta[some] = inner
    p = step
    left = cost - 2 * (own.gp @ p + own.g @ inner) + p @ own.Spp @ p + 2 * p @ own.C @ inner + inner @ own.S @ inner
    return float(left), step, beta
