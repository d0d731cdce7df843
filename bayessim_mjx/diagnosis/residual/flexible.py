"""A flexible residual force on top of a fitted model: the demonstrated floor of the gap, and what the rest depends on.

Linear regression through the simulator:  r_w = D_w Phi_w beta + B_w x + A_w p + noise,  Phi features of the measured
motion at the nodes of the force. Scored on held-out operating conditions and on held-out blocks within conditions, over
several seeds of its random features and several ridges, because one black box tells nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.residual import motion_inputs
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.motion_inputs import WORDS, Inputs
from bayessim_mjx.diagnosis.residual.regression import Regression, Seeded
from bayessim_mjx.diagnosis.statistics import normal_deviate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How a flexible force is fitted. Rules of thumb, not counted: they decide what a report shows, and no verdict.

    Attributes:
        ridges: of the mean curvature of each joint's features, a decade apart; the best one is chosen on held-out data.
        block: s, of held-out blocks within conditions; folds: into which these go in turn.
        slack: share of the best ridge's gain that may be lost for a plainer model.
    """

    ridges: tuple[float, ...] = (0.0001, 0.001, 0.01, 0.1, 1.0)
    block: float = 1.0
    folds: int = 4
    slack: float = 0.02


RULES = Rules()


@dataclass(frozen=True, eq=False)
class Held:
    """Held-out costs under one way of splitting.

    Attributes:
        cost: `[W]`, of the median seed, unweighted, each fold's with the ridge that is best on the others; base: `[W]`,
            of the model without the force.
        totals: `[seeds, ridges]`; ridge: best on all folds; seed: the one in `cost`.
        gain: how much cheaper all windows together are.
        t: of the windows' log gain above the noise by folds, as a normal deviate; unlike the gain itself
            it is not ruled by the conditions with the largest errors.
    """

    cost: Array
    base: Array
    totals: Array
    ridge: float
    seed: int
    plain: float
    gain: float
    t: float

    @property
    def significant(self) -> bool:
        return self.gain > 0 and self.t > 2


@dataclass(frozen=True, eq=False)
class Flexible:
    """Outcome of the flexible force.

    Attributes:
        condition, interpolation: held out by operating condition, by blocks within conditions.
        depends_on: [{"input": "elbow speed", "joint", "quantity", "importance"}], largest first; importance: share of
            the gain that is lost when it is shuffled.
        where: {joint: share of the gain lost without the force on it}.
        force: `[W, m, nv]`, of the median seed on all windows, N m or N; samples: residuals in a window.
    """

    condition: Held
    interpolation: Held
    depends_on: list[dict]
    where: dict[str, float]
    force: Array = field(repr=False)
    samples: int


def flexible(
    fitter: Fitter,
    fit: Fit,
    disturbance: Disturbance | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    ridges: Sequence[float] = RULES.ridges,
) -> Flexible:
    """Fit and score a flexible force on top of a fit.

    Args:
        disturbance: of this fit, for its columns and its linearisation; None: estimated here.
    """
    disturbance = estimate(fitter, fit) if disturbance is None else disturbance
    windows = fitter.simulator.windows
    inputs = motion_inputs.measured(windows, fitter.simulator.physics.mj_model)
    problem = Regression(fitter, fit, disturbance, inputs)
    folds = {
        "condition": windows.group,
        "interpolation": blocks(windows.log, windows.start, round(RULES.block / windows.dt)),
    }
    folds = {name: np.unique(fold, return_inverse=True)[1] for name, fold in folds.items()}
    runs = {seed: Seeded(problem, seed) for seed in seeds}
    held = {name: _held(problem, runs, fold, ridges) for name, fold in folds.items()}
    name = max(held, key=lambda n: held[n].gain)
    best, fold = held[name], folds[name]
    run = runs[best.seed]
    fits = run.without(fold, [best.plain])[0]
    importance = _importance(problem, run, fold, fits, best)
    where = _by_joint(problem, run, fold, fits, best)
    return Flexible(held["condition"], held["interpolation"], importance, where, run.whole(best.plain), fitter.size)


def blocks(log: NDArray[np.int64], start: NDArray[np.int64], steps: int) -> NDArray[np.int64]:
    """Fold `[W]` of each window: consecutive blocks of `steps` control steps go to the folds in turn."""
    return (start // max(steps, 1) + log) % RULES.folds


def _held(problem: Regression, runs: dict[int, Seeded], fold: NDArray[np.int64], ridges: Sequence[float]) -> Held:
    costs = np.array([
        [run.costs(fold, fits, run.features.phi) for fits in run.without(fold, ridges)] for run in runs.values()
    ])  # [seeds, ridges, W]  # fmt: skip
    totals = costs.sum(2)
    median = np.median(totals, 0)
    at = int(np.argmin(median))
    seed = int(np.argsort(totals[:, at])[(len(runs) - 1) // 2])
    base, cost = problem.base(fold), _chosen_without(costs, seed, fold)
    plain = float(ridges[_widest(median, base.sum())])
    by_fold = np.array([np.sum((base - cost)[fold == name]) for name in np.unique(fold)])
    size = problem.fitter.size
    t = normal_deviate(np.log(np.maximum(base, 0) + size) - np.log(np.maximum(cost, 0) + size), fold)
    return Held(cost, base, totals, float(ridges[at]), list(runs)[seed], plain, float(by_fold.sum()), t)


def _chosen_without(costs: Array, seed: int, fold: NDArray[np.int64]) -> Array:
    """Costs `[W]` of one seed, those of each fold with the ridge that is best on all others."""
    out = np.empty(len(fold))
    for name in np.unique(fold):
        own = fold == name
        rest = ~own if not own.all() else own
        out[own] = costs[seed, int(np.argmin(np.median(costs[:, :, rest].sum(2), 0))), own]
    return out


def _widest(totals: Array, base: float) -> int:
    """The largest ridge that loses little of the best one's gain: fewer features that cancel each other."""
    allowed = totals.min() + RULES.slack * max(base - totals.min(), 0.0)
    return int(np.flatnonzero(totals <= allowed).max())


def _shuffled(inputs: Inputs, joint: int, quantity: str, order: NDArray[np.int64]) -> Inputs:
    values = np.array(inputs.of(quantity))
    values[:, :, joint] = values[order][:, :, joint]
    return replace(inputs, **{quantity: values})  # type: ignore[arg-type]


def _importance(problem: Regression, run: Seeded, fold: NDArray[np.int64], fits: list, best: Held) -> list[dict]:
    """Share of the held-out gain that is lost when an input comes from other windows, largest first."""
    rng = np.random.default_rng(0)
    order = [rng.permutation(len(fold)) for _ in range(3 if problem.nv <= 2 else 1)]
    reference, found = run.costs(fold, fits, run.features.phi).sum(), []
    for v, quantity in run.features.names:
        lost = []
        for shuffle in order:
            phi = run.mapping(_shuffled(problem.inputs, v, quantity, shuffle), problem.average).phi
            lost.append(float(run.costs(fold, fits, phi).sum()) - reference)
        share = float(np.clip(np.mean(lost) / best.gain, 0.0, 1.0)) if best.gain > 0 else 0.0
        joint = problem.inputs.joints[v]
        found.append({"input": f"{joint} {WORDS[quantity]}", "joint": joint, "quantity": quantity, "importance": share})
    return sorted(found, key=lambda d: -d["importance"])


def _by_joint(problem: Regression, run: Seeded, fold: NDArray[np.int64], fits: list, best: Held) -> dict[str, float]:
    """{joint: share of the held-out gain lost without the force on it}."""
    reference, out = run.costs(fold, fits, run.features.phi).sum(), {}
    for v, joint in enumerate(problem.inputs.joints):
        phi = run.features.phi.copy()
        phi[:, :, v] = 0.0
        lost = float(run.costs(fold, fits, phi).sum()) - reference
        out[joint] = float(np.clip(lost / best.gain, 0.0, 1.0)) if best.gain > 0 else 0.0
    return out
