"""The gap of every stage, by horizon and by joint: in physical units, as shares of the motion, in noise units."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.coasting import coasting
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.summary import repeated, whole_logs
from bayessim_mjx.diagnosis.tolerance import Tolerance

Array = NDArray[np.float64]
SHORT = 0.1  # s, the first horizon


def measured(found: Findings, closed: dict[str, Any]) -> Gap:
    """The gap over the windows and a shorter horizon; `with_whole` adds that over whole logs."""
    setup, predictions = found.setup, found.predictions
    cut, allowed = setup.fitter.simulator.windows, setup.tolerance
    again = repeated.floor(setup.fitter, found.model.fit, setup.logs)
    short, still = max(1, min(round(SHORT / cut.dt), cut.steps // 2)), coasting(cut, setup.robot.mj_model)
    rows = []
    for steps in (short, cut.steps):
        row = heldout.stages({k: p.cost(steps) for k, p in predictions.items()}, cut.condition)
        row |= _floor(again, steps, row)
        each = {s: by_joint(p, steps, allowed) for s, p in predictions.items()}
        seconds = steps * cut.dt
        rows.append({"name": f"{seconds:.2g} s", "seconds": seconds, **row, **_physical(each, allowed)})
    main = rows[-1]
    noises = {s: by_joint(p, cut.steps, allowed) / cut.sigma_q for s, p in predictions.items()}
    by_channel = {n: {s: float(v[i]) for s, v in noises.items()} for i, n in allowed.measured()}
    physical = {n: main["physical"][n] | own for n, own in _remains(predictions["with_effects"], allowed).items()}
    return Gap(
        noise_floor=1.0,
        nominal=main["nominal"],
        calibrated=main["calibrated"],
        with_effects=main["with_effects"],
        reducible_floor=main["reducible_floor"],
        by_channel=by_channel,
        horizons=rows,
        physical=physical,
        shares=main["shares"],
        beyond=[n for n, own in physical.items() if own["beyond"]],
        closed=closed,
        integrator=setup.discretisation.to_dict() if setup.discretisation else {},
        coasting=heldout.stages({"coasting": still.cost(cut.steps)}, cut.condition)["coasting"],
        in_sample=cut.blocks,
    )


def with_whole(far: Gap, over: whole_logs.Whole, allowed: Tolerance) -> Gap:
    """The gap with one more horizon: whole logs, where some can be predicted."""
    if not len(over.group):
        return far
    row = heldout.stages(over.cost, over.group)
    floor = far.reducible_floor if far.horizons[-1]["floor"] == "repeats" else 1.0
    level = np.sqrt(max(floor, 1.0) ** 2 + float(over.chance.mean()))
    row |= _level(level, (level, level), row, "start")
    each = {s: np.sqrt(c.mean(0)) * allowed.noise for s, c in over.by_channel.items()}
    longest = {"name": over.name, "seconds": over.seconds, **row, **_physical(each, allowed)}
    longest |= {"over_likely": over.over_likely, "in_sample": over.in_sample}
    return replace(far, horizons=[*far.horizons, longest])


def by_joint(prediction: Prediction, steps: int, allowed: Tolerance) -> Array:
    """Root mean square errors `[nv]`, rad or m, over the first steps."""
    return np.sqrt(np.mean(allowed.by_dof(prediction.error[:, :steps]) ** 2, axis=(0, 1))) * allowed.noise


def _physical(each: dict[str, Array], allowed: Tolerance) -> dict[str, Any]:
    """{"physical": {joint: {stage: rad or m}}, "shares": {stage: share of the range of motion}} of `[nv]` errors."""
    rows = {n: {s: float(v[i]) for s, v in each.items()} | {"unit": allowed.units[i]} for i, n in allowed.measured()}
    moves = (allowed.motion > 0) & np.isfinite(allowed.noise)
    shares = {s: float(np.sqrt(np.mean((v[moves] / allowed.motion[moves]) ** 2))) for s, v in each.items()}
    return {"physical": rows, "shares": shares if moves.any() else {}}


def _remains(last: Prediction, allowed: Tolerance) -> dict[str, dict[str, Any]]:
    """By joint, what the last stage leaves against what is tolerated, rad or m."""
    error = allowed.by_dof(last.error) * allowed.noise
    rms = np.sqrt(np.mean(error**2, axis=(0, 1)))
    largest, beyond = np.max(np.abs(error), axis=(0, 1)), allowed.exceeded(rms)
    return {
        n: {
            "noise": float(allowed.noise[i]), "motion": float(allowed.motion[i]), "tolerance": float(allowed.limit[i]),
            "largest": float(largest[i]), "beyond": bool(beyond[i]),
        }
        for i, n in allowed.measured()
    }  # fmt: skip


def _floor(again: Any, steps: int, row: dict[str, Any]) -> dict[str, Any]:
    """What no model can undercut: what repeats of the same commands differ by; the noise where there are none."""
    if again is None:
        return _level(1.0, (1.0, 1.0), row, "noise")
    prediction, group = again
    own = heldout.stages({"own": prediction.cost(steps)}, group)
    return _level(own["own"], tuple(own["ci"]["own"]), row, "repeats")


def _level(level: float, ci: tuple[float, float], row: dict[str, Any], source: str) -> dict[str, Any]:
    """The floor of one horizon, between the noise and what the last stage reaches; adds its interval to the row's."""
    low, high = (max(v, 1.0) for v in ci)
    level = min(max(level, 1.0), row["with_effects"])
    row["ci"]["reducible_floor"] = [min(low, level), max(level, min(high, row["ci"]["with_effects"][1]))]
    return {"reducible_floor": float(level), "floor": source}
