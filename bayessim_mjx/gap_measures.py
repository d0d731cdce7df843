"""What a correction of the simulator is worth in closed loop: gap of the return, ranking, recovery, relevance.

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
DRAWS = 2000  # of the bootstrap


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


def recovery(real: Mapping[str, Array], seed: int) -> dict[str, Any]:
    """Share of the lost return that retraining recovers: R = (J(pi) - J(pi_0)) / (J(oracle) - J(pi_0)), all real.

    Args:
        real: {role: `[seeds, episodes]`}, pi_0 being "nominal". The intervals (90 %) are bootstrapped over both.
    """
    rng = np.random.default_rng(seed)
    drawn = {role: np.array([_redrawn(x, rng) for _ in range(DRAWS)]) for role, x in real.items()}
    lost = drawn["oracle"] - drawn["nominal"]
    mean = {role: float(x.mean()) for role, x in real.items()}
    out: dict[str, Any] = {"real": mean, "lost": mean["oracle"] - mean["nominal"], "lost_se": float(lost.std())}
    sure = out["lost"] > SURE * out["lost_se"]
    for role in ("corrected", "wide"):
        share = (mean[role] - mean["nominal"]) / out["lost"] if sure else None
        ends = np.quantile((drawn[role] - drawn["nominal"])[lost > 0] / lost[lost > 0], [0.05, 0.95]) if sure else None
        out[role] = {"recovered": share, "ci": None if ends is None else ends.tolist()}
    return out


def _redrawn(x: Array, rng: np.random.Generator) -> float:
    seeds, episodes = x.shape
    return float(x[rng.integers(seeds, size=seeds)][:, rng.integers(episodes, size=episodes)].mean())


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
