"""Black boxes as rivals of the named effects: a small network and a sparse formula for the force that is missing.

Both know only positions, speeds and efforts of the joints, and are fitted through the simulator's own columns (as the
flexible force is) to what the recalibrated simulator leaves, together with its known parameters. All three are scored
on the same conditions, which none of them saw. Their inputs are measured motion, so that they are favoured: in a
simulation they would have to live with the motion that they cause.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import solve
from bayessim_mjx.diagnosis.residual import motion_inputs
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regression import SIZES as CLIPPED
from bayessim_mjx.diagnosis.residual.regression import OnFeatures, Regression, Sums
from bayessim_mjx.diagnosis.statistics import Gap

Array = NDArray[np.float64]
FOLDS = 4  # of conditions, at most: each is one more training of the network; a rule of thumb


@dataclass(frozen=True, eq=False)
class BlackBoxes:
    """Shares of the recalibrated simulator's squared gap above the noise that are closed, on conditions held out.

    Attributes:
        network, formula: of the black boxes; named: of the effects of the verdict, NaN of none. Below 0: worse than
            nothing.
        terms: of the formula that is fitted to all conditions, for people.
        folds: into which the conditions were divided.
    """

    network: float
    formula: float
    named: float
    terms: tuple[Term, ...]
    folds: int


def race(fitter: Fitter, base: Fit, named: Fit | None, missing: Disturbance, noise: float) -> BlackBoxes | None:
    """All of them on the same windows; None where there is one condition only.

    Args:
        base: the fit of the known parameters; named: with the effects, None without any.
        missing: of the base fit, for its columns; noise: squared residual of a window that is noise alone.
    """
    windows = fitter.simulator.windows
    fold = np.unique(windows.group, return_inverse=True)[1] % FOLDS
    if len(np.unique(fold)) < 2:
        return None
    problem = Regression(fitter, base, missing, motion_inputs.measured(windows, fitter.simulator.physics.mj_model))
    before, floor = float(problem.base(fold).sum()), noise * len(fold)

    def closed(cost: Array) -> float:
        return Gap(before, float(cost.sum()), floor).closed

    of_formula, terms = formula_costs(problem, fold)
    of_names = float("nan") if named is None else closed(fitter.scores(named, fold)[0])
    return BlackBoxes(closed(network_costs(problem, fold)), closed(of_formula), of_names, terms, len(np.unique(fold)))


@dataclass(frozen=True)
class Sizes:
    """Of the network and its training. Rules of thumb, neither tuned nor counted: no verdict rests on them.

    Attributes:
        hidden: neurons for each joint; iterations: of the training, at most.
        seeds: networks whose forces are averaged, so that no single draw of first weights counts.
        spread: prior standard deviations of weights into and out of the hidden layer.
    """

    hidden: int = 6
    seeds: int = 2
    iterations: int = 40
    spread: tuple[float, float] = (1.5, 0.3)


SIZES = Sizes()


def network_costs(problem: Regression, fold: NDArray[np.int64]) -> Array:
    """Costs `[W]` of windows under the networks trained without their fold."""
    inputs = _inputs(problem.inputs)
    out = np.zeros(len(fold))
    for name in np.unique(fold):
        train, test = fold != name, fold == name
        trained = [_trained(problem, inputs, train, seed) for seed in range(SIZES.seeds)]
        force = np.mean([_nodes(problem, _force(weights, inputs[:, test])[0]) for weights, _ in trained], 0)
        step = np.mean([p for _, p in trained], 0)
        both = np.concatenate([np.broadcast_to(step, (test.sum(), problem.k)), force], 1)
        out[test] = problem.q_of(test).at(both)
    return out


def _inputs(inputs: Inputs) -> Array:
    """`[nv, W, H, I]`: position, speed, effort and past effort of the joint, position and speed of all others."""
    own = [inputs.position, np.tanh(inputs.speed / (0.1 * inputs.speed_scale)), inputs.speed, inputs.effort]
    own += [inputs.past[..., 0], inputs.past[..., 1]]
    nv = inputs.position.shape[2]
    others = [np.stack([np.delete(x, v, 2) for v in range(nv)], 2) for x in (inputs.position, inputs.speed)]
    z = np.concatenate([np.stack(own, 3), *others], 3)
    mean, sd = z.mean((0, 1)), z.std((0, 1))
    z = np.clip((z - mean) / np.where(sd > 1e-12, sd, np.inf), -CLIPPED.limit, CLIPPED.limit)
    z = np.concatenate([z, np.ones((*z.shape[:3], 1))], 3)
    return np.ascontiguousarray(np.moveaxis(z, 2, 0))


def _force(weights: tuple[Array, Array], z: Array) -> tuple[Array, Array]:
    """(force `[nv, W, H]` in units of the joints' scale, hidden layer `[nv, W, H, h]`) of inputs `[nv, W, H, I]`."""
    into, out = weights  # [nv, I, h], [nv, h + 1]
    hidden = np.tanh(z @ into[:, None])
    return (hidden @ out[:, None, :-1, None])[..., 0] + out[:, None, -1:], hidden


def _nodes(problem: Regression, force: Array) -> Array:
    """`[W, nv m]`, N m or N at the nodes of the columns, of a force `[nv, W, H]` in units of the joints' scale."""
    at_nodes = force @ problem.average * problem.scale[:, None, None]
    return np.asarray(np.moveaxis(at_nodes, 0, 1).reshape(force.shape[1], -1))


def _trained(
    problem: Regression, inputs: Array, train: NDArray[np.bool_], seed: int
) -> tuple[tuple[Array, Array], Array]:
    """((weights into, weights out), parameter step) at the most probable weights, misfits as large as the gap."""
    z, q, weight = inputs[:, train], problem.q_of(train), problem.fit.weight[train]
    k, (nv, count, _, width) = problem.k, z.shape
    shapes = (nv, width, SIZES.hidden), (nv, SIZES.hidden + 1)
    cut = int(np.prod(shapes[0]))
    spread = np.concatenate([np.full(cut, SIZES.spread[0]), np.full(int(np.prod(shapes[1])), SIZES.spread[1])])
    doubt = max(float(weight @ q.c), 1e-300) / problem.fitter.numbers
    Spp, gp = np.einsum("w,wij->ij", weight, q.S[:, :k, :k]), weight @ q.g[:, :k]
    Spf = weight[:, None, None] * q.S[:, :k, k:]

    def unpacked(x: Array) -> tuple[Array, Array]:
        return x[:cut].reshape(shapes[0]), x[cut:].reshape(shapes[1])

    def step_of(f: Array) -> Array:
        if not k:
            return np.zeros(0)
        pull = gp + problem.pull - np.sum(Spf @ f[:, :, None], 0)[:, 0]
        return solve(Spp + np.diag(problem.precision), pull, problem.low, problem.high)

    def cost(x: Array) -> tuple[float, Array]:
        into, out = unpacked(x)
        force, hidden = _force((into, out), z)
        f = _nodes(problem, force)
        full = np.concatenate([np.broadcast_to(step_of(f), (count, k)), f], 1)
        pulled = (q.S @ full[:, :, None])[..., 0]
        each = q.c + np.sum(full * (pulled - 2 * q.g), 1)
        slope = 2 * weight[:, None] * (pulled - q.g)[:, k:]  # at the best step, whose own slope is none
        by_node = np.moveaxis(slope.reshape(count, nv, -1), 1, 0) * problem.scale[:, None, None]
        by_step = (by_node @ problem.average.T)[..., None]
        # window by window: products of large matrices would call threads that wait for each other
        to_out = np.concatenate([np.sum(hidden * by_step, (1, 2)), np.sum(by_step, (1, 2))], 1)
        inner = by_step * out[:, None, None, :-1] * (1 - hidden**2)
        to_into = np.sum(np.moveaxis(z, 2, 3) @ inner, 1)
        gradient = np.concatenate([to_into.ravel(), to_out.ravel()]) / doubt + 2 * x / spread**2
        return float(weight @ each) / doubt + float(np.sum((x / spread) ** 2)), gradient

    start = np.random.default_rng(seed).normal(size=len(spread)) * spread * (np.arange(len(spread)) < cut)
    found = minimize(cost, start, jac=True, method="L-BFGS-B", options={"maxiter": SIZES.iterations})
    weights = unpacked(found.x)
    return weights, step_of(_nodes(problem, _force(weights, z)[0]))


@dataclass(frozen=True)
class Rules:
    """How large a formula may be.

    A term stays if it explains more than chance does: log(candidates) + log(numbers) / 2 nats (the extended
    Bayesian criterion of Chen and Chen, 2008), in misfits as large as those that are left. The numbers below are rules
    of thumb, not counted.

    Attributes:
        most: terms for each joint on average: what a person reads.
        tried: terms that are fitted in each turn, the most promising ones by linear algebra.
        ridge: of the curvature, against terms that are alike.
        slow: share of the largest speed within which a sign changes gradually.
    """

    most: int = 3
    tried: int = 5
    ridge: float = 1e-6
    slow: float = 0.02


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


def formula_costs(problem: Regression, fold: NDArray[np.int64]) -> tuple[Array, tuple[Term, ...]]:
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
