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
from scipy.linalg import cho_factor, cho_solve

from bayessim_mjx.diagnosis import motion_inputs
from bayessim_mjx.diagnosis.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.fit import Fitter, Job
from bayessim_mjx.diagnosis.models import clustered_t
from bayessim_mjx.diagnosis.motion_inputs import QUANTITIES, WORDS, Inputs
from bayessim_mjx.diagnosis.quadratic import TRUST, Quadratic, solve

Array = NDArray[np.float64]
RIDGES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)  # of the mean curvature of each joint's features
RANDOM = 24  # random features per joint and seed
PICKED = 5  # inputs of each
BLOCK = 1.0  # s, held-out blocks within conditions
FOLDS = 4
LIMIT = 4.0  # standard deviations at which features are clipped: no extrapolation
SLACK = 0.02  # of the best ridge's gain, for a plainer model
QUIET = 1.1  # squared residual per sample that counts as noise alone
IMPORTANT = 0.1  # share of the gain that an input must carry to be named


@dataclass(frozen=True, eq=False)
class Held:
    """Held-out costs under one way of splitting.

    Attributes:
        cost: `[W]`, of the median seed with the best ridge, unweighted; base: `[W]`, of the model without the force.
        totals: `[seeds, ridges]`; ridge, seed: the one in `cost`.
        gain, se: how much cheaper all windows together are, and its standard error over folds.
        t: mean over standard error of the windows' log gain above the noise, clustered by fold; unlike the gain itself
            it is not ruled by the conditions with the largest errors.
    """

    cost: Array
    base: Array
    totals: Array
    ridge: float
    seed: int
    plain: float
    gain: float
    se: float
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
        text: one sentence each.
        force: `[W, m, nv]`, of the median seed on all windows, N m or N.
    """

    condition: Held
    interpolation: Held
    depends_on: list[dict]
    where: dict[str, float]
    text: list[str]
    force: Array = field(repr=False)

    @property
    def cost_by_window(self) -> Array:
        return self.condition.cost

    def details(self, base_rms: float = np.nan, winner_rms: float = np.nan) -> dict:
        """Numbers for pictures."""
        count = self.force.shape[0]
        seeds = np.sqrt(np.maximum(self.condition.totals.min(1), 0.0) / count)
        return {
            "depends_on": [{"input": d["input"], "importance": d["importance"]} for d in self.depends_on],
            "where": self.text, "seeds": seeds.tolist(), "rms_on_base": base_rms, "rms_on_winner": winner_rms,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Features:
    """Phi of each joint: `phi [W, m, nv, F]`, standardised, of inputs `z [W, H, I]` named (joint, quantity)."""

    phi: Array
    names: tuple[tuple[int, str], ...]


def flexible(
    fitter: Fitter,
    job: Job,
    disturbance: Disturbance | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    ridges: Sequence[float] = RIDGES,
) -> Flexible:
    """Fit and score a flexible force on top of a fitted job.

    Args:
        disturbance: of this job, for its columns and its linearisation; None: estimated here.
    """
    disturbance = estimate(fitter, job) if disturbance is None else disturbance
    windows = fitter.simulator.windows
    inputs = motion_inputs.measured(windows, fitter.simulator.physics.mj_model)
    problem = _Problem(fitter, job, disturbance, inputs)
    folds = {"condition": windows.group, "interpolation": blocks(windows.log, windows.start, round(BLOCK / windows.dt))}
    runs = {seed: problem.seeded(seed) for seed in seeds}
    held = {name: _held(problem, runs, of, ridges) for name, of in folds.items()}
    best = held["interpolation" if held["interpolation"].gain > held["condition"].gain else "condition"]
    name = "interpolation" if best is held["interpolation"] else "condition"
    seeded = runs[best.seed]
    solutions = seeded.predict(folds[name], best.plain)[1]
    importance = _importance(problem, seeded, folds[name], solutions, best)
    where = _by_joint(problem, seeded, folds[name], solutions, best)
    whole = seeded.solve(np.ones(len(windows), bool), best.plain)[1]
    force = np.einsum("wmvf,vf->wmv", seeded.features.phi, whole.reshape(problem.nv, -1))
    return Flexible(
        held["condition"], held["interpolation"], importance, where, _words(held, importance, where, fitter.size), force
    )


def blocks(log: NDArray[np.int64], start: NDArray[np.int64], steps: int) -> NDArray[np.int64]:
    """Fold `[W]` of each window: consecutive blocks of `steps` control steps go to the folds in turn."""
    fold = (start // max(steps, 1) + log) % FOLDS
    return np.unique(fold, return_inverse=True)[1]


class _Problem:
    """What all seeds share: the quadratic in (parameters, forces), inputs, weights, costs without the force."""

    def __init__(self, fitter: Fitter, job: Job, disturbance: Disturbance, inputs: Inputs) -> None:
        linear = disturbance.linear
        self.q: Quadratic = linear.quadratic
        self.k, self.nv, self.m = job.A.shape[2], len(linear.scale), linear.nodes
        self.job, self.fitter, self.inputs, self.scale = job, fitter, inputs, linear.scale
        self.average = linear.basis / linear.basis.sum(0)  # [H, m], features at the nodes
        self.precision, self.pull, self.low, self.high = job.prior()

    def seeded(self, seed: int) -> _Seeded:
        return _Seeded(self, seed)

    def base(self, fold: NDArray[np.int64]) -> Array:
        return self.fitter.scores(self.job, fold)[0]


class _Seeded:
    """The regression with one draw of random features."""

    def __init__(self, problem: _Problem, seed: int) -> None:
        self.problem, self.seed = problem, seed
        self.mapping = Mapping.draw(problem.inputs, seed)
        self.features = self.mapping(problem.inputs, problem.average)
        k, w = problem.k, problem.job.weight
        phi, q = self.features.phi, problem.q
        W, m, nv, F = phi.shape
        # columns of beta are those of the forces at the nodes times the features; beta in units of the force scale
        dd = q.S[:, k:, k:].reshape(W, nv, m, nv, m)
        scaled = phi * problem.scale[:, None]
        self.scaled = scaled
        half = np.einsum("wimjn,wnjg->wimjg", dd, scaled, optimize=True)
        self.S = np.einsum("wmif,wimjg->wifjg", scaled, half, optimize=True).reshape(W, nv * F, nv * F)
        pd = q.S[:, :k, k:].reshape(W, k, nv, m)
        self.C = np.einsum("wkim,wmif->wkif", pd, scaled, optimize=True).reshape(W, k, nv * F)
        self.g = np.einsum("wim,wmif->wif", q.g[:, k:].reshape(W, nv, m), scaled).reshape(W, nv * F)
        self.weight = w
        self.each = F

    def solve(self, train: NDArray[np.bool_], ridge: float) -> tuple[Array, Array]:
        """(parameter step `[k]`, beta `[nv F]` in units of force) from the windows `train`."""
        problem, w = self.problem, self.weight * train
        k = problem.k
        S, g = np.tensordot(w, self.S, 1), w @ self.g
        C = np.tensordot(w, self.C, 1)
        curvature = np.diag(S).reshape(problem.nv, -1).mean(1)
        S[np.diag_indices(len(S))] += ridge * np.repeat(curvature, self.each) + 1e-9 * curvature.max() + 1e-300
        both = cho_solve(cho_factor(S), np.concatenate([g[:, None], C.T], 1))
        gp, Spp = problem.q.subset(np.arange(k)).weighted(w)
        step = np.zeros(0)
        if k:
            Spp = Spp - C @ both[:, 1:] + np.diag(problem.precision + TRUST * np.diag(Spp))
            step = solve(Spp, gp + problem.pull - C @ both[:, 0], problem.low, problem.high)
        beta = both[:, 0] - both[:, 1:] @ step
        return step, beta * np.repeat(problem.scale, self.each)

    def predict(self, fold: NDArray[np.int64], ridge: float) -> tuple[Array, list[tuple[Array, Array]]]:
        """Costs `[W]` of windows from the fits without their fold, and the fits, in the order of the folds."""
        fits = [self.solve(fold != name, ridge) for name in np.unique(fold)]
        return self.costs(fold, fits, self.features.phi), fits

    def costs(self, fold: NDArray[np.int64], fits: list[tuple[Array, Array]], phi: Array) -> Array:
        problem = self.problem
        step = np.stack([p for p, _ in fits])[fold]
        beta = np.stack([b for _, b in fits])[fold].reshape(len(fold), problem.nv, -1)
        force = np.einsum("wmvf,wvf->wvm", phi, beta, optimize=True).reshape(len(fold), -1)
        return problem.q.at(np.concatenate([step, force], 1))


@dataclass(frozen=True, eq=False)
class Mapping:
    """Inputs -> features of one seed; standardised by the logs it was drawn on."""

    names: tuple[tuple[int, str], ...]
    weights: Array  # [nv, RANDOM, I]
    shifts: Array  # [nv, RANDOM]
    moments: list[tuple[Array, Array]] = field(default_factory=list)

    @classmethod
    def draw(cls, inputs: Inputs, seed: int) -> Mapping:
        nv = len(inputs.joints)
        names = tuple((v, quantity) for v in range(nv) for quantity in QUANTITIES)
        rng = np.random.default_rng(seed)
        weights = np.zeros((nv, RANDOM, len(names)))
        for v in range(nv):
            own = np.array([1.0 if joint == v else 0.5 / max(nv - 1, 1) for joint, _ in names])
            own[[i for i, (_, q) in enumerate(names) if q == "time"]] *= 0.3
            for f in range(RANDOM):
                picked = rng.choice(len(names), PICKED, replace=False, p=own / own.sum())
                weights[v, f, picked] = rng.normal(size=PICKED) * rng.choice([0.5, 1.0, 2.0])
        return cls(names, weights, rng.uniform(-1.5, 1.5, (nv, RANDOM)))

    def __call__(self, inputs: Inputs, average: Array) -> Features:
        """Standardised features at the nodes; the first call fixes the standardisation."""
        z = self._inputs(inputs)
        random = np.tanh(np.einsum("whi,vfi->whvf", z, self.weights, optimize=True) + self.shifts)
        raw = np.concatenate([own_features(inputs), cross_features(inputs), random], 3)
        phi = np.einsum("hm,whvf->wmvf", average, raw, optimize=True)
        phi = self._standard(1, phi)
        return Features(np.concatenate([np.ones((*phi.shape[:3], 1)), phi], 3), self.names)

    def _inputs(self, inputs: Inputs) -> Array:
        z = [_single(inputs.of(q))[..., v] for v, q in self.names]
        return self._standard(0, np.stack(z, 2))

    def _standard(self, which: int, values: Array) -> Array:
        if len(self.moments) <= which:
            mean, sd = values.mean((0, 1)), values.std((0, 1))
            self.moments.append((mean, np.where(sd > 1e-9 * (np.abs(mean) + 1e-9), sd, np.inf)))
        mean, sd = self.moments[which]
        return np.clip((values - mean) / sd, -LIMIT, LIMIT)


def _single(values: Array) -> Array:
    """`[W, H, nv]`: of quantities that come in two sizes the second."""
    return values if values.ndim == 3 else values[..., 1]


def own_features(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: laws that forces in a joint may follow, of that joint's own motion."""
    q, w, s = inputs.position, inputs.speed / inputs.speed_scale, inputs.direction
    load, effort = inputs.load / inputs.load_scale, inputs.effort / inputs.effort_scale
    sign, fast = np.tanh(w / 0.02), np.tanh(w / 0.2)
    turn = np.where(inputs.hinge, 1.0, 0.0)
    recent = s * np.exp(-inputs.since_reversal / 0.1)
    columns = [
        q, np.sin(q) * turn, np.cos(q) * turn, w, sign, fast, w * np.abs(w),
        s, recent, inputs.stop[..., 0], inputs.stop[..., 1],
        effort, np.abs(effort), effort * np.abs(effort), np.abs(effort) * sign, load, np.abs(load) * sign,
        inputs.pull, inputs.past[..., 0], inputs.past[..., 1],
        inputs.time, inputs.time * sign, inputs.time * effort,
        q * sign, np.sin(q) * turn * sign, np.cos(q) * turn * sign,
    ]  # fmt: skip
    return np.stack(columns, 3)


def cross_features(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: what other joints do, for couplings; nothing for one joint alone."""
    nv = len(inputs.joints)
    w = inputs.speed / inputs.speed_scale
    rows = []
    for v in range(nv):
        others = [u for u in range(nv) if u != v]
        parts = [np.tanh(w[..., others] / 0.1), w[..., others], inputs.effort[..., others], inputs.pull[..., others]]
        rows.append(np.concatenate([*parts, inputs.position[..., others]], 2))
    return np.stack(rows, 2)


def _held(problem: _Problem, runs: dict[int, _Seeded], fold: NDArray[np.int64], ridges: Sequence[float]) -> Held:
    fold = np.unique(fold, return_inverse=True)[1]
    costs = np.array([[run.predict(fold, ridge)[0] for ridge in ridges] for run in runs.values()])  # [seeds, ridges, W]
    totals = costs.sum(2)
    median = np.median(totals, 0)
    at = int(np.argmin(median))
    seed = int(np.argsort(totals[:, at])[(len(runs) - 1) // 2])
    base, cost = problem.base(fold), costs[seed, at]
    plain = float(ridges[_widest(median, base.sum())])
    by_fold = np.array([np.sum((base - cost)[fold == name]) for name in np.unique(fold)])
    se = float(np.sqrt(len(by_fold)) * np.std(by_fold, ddof=1)) if len(by_fold) > 1 else np.inf
    size = problem.fitter.size
    t = clustered_t(np.log(np.maximum(base, 0) + size) - np.log(np.maximum(cost, 0) + size), fold)
    return Held(cost, base, totals, float(ridges[at]), list(runs)[seed], plain, float(by_fold.sum()), se, t)


def _widest(totals: Array, base: float) -> int:
    """The largest ridge that loses little of the best one's gain: fewer features that cancel each other."""
    allowed = totals.min() + SLACK * max(base - totals.min(), 0.0)
    return int(np.flatnonzero(totals <= allowed).max())


def _shuffled(inputs: Inputs, joint: int, quantity: str, order: NDArray[np.int64]) -> Inputs:
    values = np.array(inputs.of(quantity))
    values[:, :, joint] = values[order][:, :, joint]
    return replace(inputs, **{quantity: values})  # type: ignore[arg-type]


def _importance(problem: _Problem, run: _Seeded, fold: NDArray[np.int64], fits: list, best: Held) -> list[dict]:
    """Share of the held-out gain that is lost when an input comes from other windows, largest first."""
    rng = np.random.default_rng(0)
    order = [rng.permutation(len(fold)) for _ in range(3)]
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


def _by_joint(problem: _Problem, run: _Seeded, fold: NDArray[np.int64], fits: list, best: Held) -> dict[str, float]:
    """{joint: share of the held-out gain lost without the force on it}."""
    reference, out = run.costs(fold, fits, run.features.phi).sum(), {}
    for v, joint in enumerate(problem.inputs.joints):
        phi = run.features.phi.copy()
        phi[:, :, v] = 0.0
        lost = float(run.costs(fold, fits, phi).sum()) - reference
        out[joint] = float(np.clip(lost / best.gain, 0.0, 1.0)) if best.gain > 0 else 0.0
    return out


def _words(held: dict[str, Held], importance: list[dict], where: dict[str, float], samples: int) -> list[str]:
    if not any(h.significant for h in held.values()):
        return ["a flexible force finds nothing more that would hold on data not used for fitting"]
    if all(float(h.base.mean()) < QUIET * samples for h in held.values()):
        return ["what is left lies within the measurement noise; of it a flexible force still finds a part"]
    text = []
    for name, h in held.items():
        how = "other operating conditions" if name == "condition" else "the same conditions at other times"
        share = h.gain / max(float(h.base.sum()), 1e-300)
        text.append(f"on {how} a flexible force removes {share:.0%} of the squared gap that is left")
    joints = [j for j, share in where.items() if share > 0.2 * max(where.values())]
    inputs = [d["input"] for d in importance if d["importance"] > IMPORTANT * max(importance[0]["importance"], 0.5)][:4]
    depends = f"depends on {', '.join(inputs)}" if inputs else "depends on nothing that was measured: it is constant"
    return [*text, f"what is missing acts at {', '.join(joints)} and {depends}"]
