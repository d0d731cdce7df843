"""Value of a correction of the simulator in closed loop: gap of the return, ranking, recovery, relevance.

Measures of gap diagnosis 3.10; numbers in, numbers out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IRRELEVANT = 0.05  # of the return that the gap costs, below which an effect does not matter for the task
SURE = 2.0  # standard errors
ROLES = ("nominal", "corrected", "wide", "oracle")
FEWEST = 5  # trainings of each kind that an interval takes


def standard_error(x: Array) -> float:
    """Of the mean."""
    return float(np.std(x, ddof=1) / np.sqrt(len(x))) if len(x) > 1 else float("nan")


def gap(returns: Sequence[Mapping[str, Array]]) -> dict[str, Any]:
    """gap_J = |J_real - J_simulated|, mean over policies: before and after the correction, and the share closed.

    Args:
        returns: per policy, {"nominal", "corrected", "real"}: `[episodes]`, paired.
    """
    before, after = (
        float(np.mean([abs(np.mean(r["real"] - r[s])) for r in returns])) for s in ("nominal", "corrected")
    )
    # episodes are the same for all policies, so their errors are averaged episode by episode
    errors = [(r["real"] - r["nominal"]) * np.sign(np.mean(r["real"] - r["nominal"])) for r in returns]
    noise = standard_error(np.mean(errors, axis=0))
    closed = 1 - after / before if before > SURE * noise else None
    return {"before": before, "after": after, "se": noise, "closure": closed}


def ranking(returns: Sequence[Mapping[str, Array]]) -> dict[str, Any]:
    """How well each simulator ranks the policies: Kendall's tau, and the mean largest violation of the real order.

    The violation of a policy is its largest difference of real return from a policy that the simulator puts on the
    other side of it (SIMPLER's mean maximum rank violation), in units of return.
    """
    from scipy.stats import kendalltau

    mean = {s: np.array([r[s].mean() for r in returns]) for s in ("nominal", "corrected", "real")}
    tau, violation = {}, {}
    for s in ("nominal", "corrected"):
        statistic = float(kendalltau(mean[s], mean["real"]).statistic) if len(returns) > 2 else float("nan")
        tau[s] = statistic if np.isfinite(statistic) else None
        ahead, apart = mean[s][:, None] > mean[s], mean["real"][:, None] - mean["real"]
        violation[s] = float(np.max(np.where(ahead != (apart > 0), np.abs(apart), 0.0), axis=1).mean())
    return {"policies": len(returns), "tau": tau, "violation": violation}


def recovery(real: Mapping[str, Array]) -> dict[str, Any]:
    """Share of the lost return that retraining recovers: R = (J(pi) - J(pi_0)) / (J(oracle) - J(pi_0)), all real.

    Trainings differ by their seeds more than episodes do, so fewer than FEWEST seeds give no interval.

    Args:
        real: {role: `[seeds, episodes]`}, pi_0 being "nominal", with one row where the policy was given.

    Returns:
        {"real": {role: return}, "seeds", "lost", "lost_se", "corrected", "wide": {"recovered", "ci"}}, 90 % intervals
        or None; shares too are None where no return is surely lost.
    """
    mean = {role: float(x.mean()) for role, x in real.items()}
    seeds = min(len(x) for role, x in real.items() if role != "nominal" or len(x) > 1)
    out: dict[str, Any] = {"real": mean, "seeds": seeds, "lost": mean["oracle"] - mean["nominal"]}
    out["lost_se"] = float(np.sqrt(_spread([(_one("oracle") - _one("nominal"))], real)[0][0, 0]))
    sure = out["lost"] > SURE * out["lost_se"]
    for role in ("corrected", "wide"):
        share = (mean[role] - mean["nominal"]) / out["lost"] if sure else None
        ends = _fieller(role, real) if sure and seeds >= FEWEST else None
        out[role] = {"recovered": share, "ci": ends}
    return out


def _one(role: str) -> Array:
    return np.array([float(r == role) for r in ROLES])


def _spread(contrasts: Sequence[Array], real: Mapping[str, Array]) -> tuple[Array, list[tuple[Array, int]]]:
    """(covariance `[k, k]` of contrasts of mean returns `[roles]`, its parts with their degrees of freedom).

    Trainings are independent of each other, episodes begin alike for all policies. One seed's spread is unknown.
    """
    C = np.array(contrasts)
    parts = []
    for i, role in enumerate(ROLES):
        by_seed = real[role].mean(1)
        if len(by_seed) > 1:
            parts.append((np.outer(C[:, i], C[:, i]) * np.var(by_seed, ddof=1) / len(by_seed), len(by_seed) - 1))
    episodes = C @ np.stack([real[role].mean(0) for role in ROLES])
    parts.append((np.atleast_2d(np.cov(episodes)) / episodes.shape[1], episodes.shape[1] - 1))
    return np.sum([v for v, _ in parts], axis=0), parts


def _fieller(role: str, real: Mapping[str, Array]) -> list[float] | None:
    """Shares that the returns do not contradict (Fieller, 1954); None where they leave an end open.

    A share r is kept where won - r lost is within Student's t of its standard error from 0, with the degrees of freedom
    of Welch (1947) at the estimate.
    """
    from scipy import stats

    contrasts = [_one(role) - _one("nominal"), _one("oracle") - _one("nominal")]
    returns = np.array([real[r].mean() for r in ROLES])
    won, lost = (float(c @ returns) for c in contrasts)
    both, parts = _spread(contrasts, real)
    off = np.array([1.0, -won / lost])
    each = [(float(off @ v @ off), n) for v, n in parts]
    freedom = sum(v for v, _ in each) ** 2 / max(sum(v**2 / n for v, n in each), 1e-300)
    t2 = float(stats.t.ppf(0.95, freedom)) ** 2
    # (won - r lost)^2 <= t^2 (V11 - 2 r V12 + r^2 V22)
    a, b, c = lost**2 - t2 * both[1, 1], won * lost - t2 * both[0, 1], won**2 - t2 * both[0, 0]
    if a <= 0:
        return None
    half = float(np.sqrt(max(b * b - a * c, 0.0)))
    return [(b - half) / a, (b + half) / a]


def relevance(nominal: Sequence[dict], corrected: Sequence[dict], cost: float) -> list[dict[str, Any]]:
    """Which effects matter for the task: {"effect", "where", "change": {policy: {"last", "alone"}}, "irrelevant"}.

    Args:
        nominal, corrected: what `closed_loop.Judge.one_by_one` says of pi_0 and pi_1.
        cost: return that pi_0 loses by the whole correction (predicted).
    """
    out = []
    for before, after in zip(nominal, corrected, strict=True):
        change = {n: {k: x[k] for k in ("last", "alone")} for n, x in (("nominal", before), ("corrected", after))}
        every = [x for each in change.values() for x in each.values()]
        idle = all(abs(x["mean"]) < max(IRRELEVANT * abs(cost), SURE * x["se"]) for x in every)
        out.append({"effect": before["effect"], "where": before["where"], "change": change, "irrelevant": idle})
    return out
