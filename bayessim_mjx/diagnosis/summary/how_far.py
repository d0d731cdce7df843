"""The gap of every stage, by horizon and by joint: in physical units, as shares of the motion, in noise units."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.logcheck import noise
from bayessim_mjx.diagnosis.request import Tolerance
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.summary.again import Whole
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]


def measured(found: Findings, closed: dict[str, Any]) -> Gap:
    """Measure the gap over the windows and over a shorter horizon: the geometric mean of one step and a window."""
    setup, predictions = found.setup, found.predictions
    cut, allowed = setup.fitter.simulator.windows, setup.tolerance
    again = repeats(setup.fitter, found.model.fit, setup.logs)
    still = constant_velocity_baseline(cut, setup.robot.mj_model)
    rows = []
    for steps in (round(cut.steps**0.5), cut.steps):
        row = heldout.stages({k: p.cost(steps) for k, p in predictions.items()}, cut.condition)
        row |= _floor(again, steps, row)
        each = {s: by_joint(p, steps, allowed) for s, p in predictions.items()}
        seconds = steps * cut.dt
        rows.append({"name": f"{seconds:.2g} s", "seconds": seconds, **row, **_physical(each, allowed)})
    main = rows[-1]
    noises = {s: by_joint(p, cut.steps, allowed) / cut.sigma_q for s, p in predictions.items()}
    by_channel = {n: {s: float(v[i]) for s, v in noises.items()} for i, n in allowed.measured()}
    physical = {n: main["physical"][n] | own for n, own in _remains(predictions["with_effects"], allowed).items()}
    step, own = setup.discretisation, found.selection.state.nominal
    otherwise = float(np.sqrt(own.quadratic()[0].c.sum() / own.r.size))  # with its start states fitted
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
        integrator=step.to_dict() | step.in_gap(main["nominal"], otherwise) if step else {},
        coasting=heldout.stages({"coasting": still.cost(cut.steps)}, cut.condition)["coasting"],
        in_sample=cut.blocks,
    )


def with_whole(far: Gap, over: Whole, allowed: Tolerance) -> Gap:
    """Return the gap with one more horizon: whole logs, where some can be predicted."""
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
    """Return the floor of every model: the difference of repeated commands; the noise where there are none."""
    if again is None:
        return _level(1.0, (1.0, 1.0), row, "noise")
    prediction, group = again
    own = heldout.stages({"own": prediction.cost(steps)}, group)
    return _level(own["own"], tuple(own["ci"]["own"]), row, "repeats")


def _level(level: float, ci: tuple[float, float], row: dict[str, Any], source: str) -> dict[str, Any]:
    """Return the floor of one horizon, between noise and last stage; its interval is added to the row's."""
    low, high = (max(v, 1.0) for v in ci)
    level = min(max(level, 1.0), row["with_effects"])
    row["ci"]["reducible_floor"] = [min(low, level), max(level, min(high, row["ci"]["with_effects"][1]))]
    return {"reducible_floor": float(level), "floor": source}


def repeats(fitter: Fitter, fit: Fit, logs: Sequence[Log]) -> tuple[Prediction, NDArray[np.int64]] | None:
    """Return the error of a perfect model of what repeats, window by window, and the windows' conditions `[P]`.

    Two runs of the same commands differ by twice the variance of what is not reproducible. What comes of their
    different start states is taken out as it is from a model's errors, by the fit's derivatives.

    Args:
        logs: as recorded, in the order of the windows' logs.

    Returns:
        None where nothing was repeated.
    """
    cut = fitter.simulator.windows
    model = fitter.simulator.physics.mj_model
    errors, offsets, group = [], [], []
    for w, partner in _pairs(fitter, logs):
        rows = slice(int(cut.start[w]) + 1, int(cut.start[w]) + 1 + cut.steps)
        d = _apart(model, cut.logs[cut.log[w]], cut.logs[partner], rows)[:, fitter.used] / fitter.sigma / np.sqrt(2)
        error, offset = _settled(d, fit.B[w], fit.spread)
        errors.append(error)
        offsets.append(offset)
        group.append(cut.group[w])
    return (Prediction(np.stack(errors), np.stack(offsets)), np.array(group)) if errors else None


def _pairs(fitter: Fitter, logs: Sequence[Log]) -> Iterator[tuple[int, int]]:
    """(window, another log with the same commands in the same rows)."""
    cut = fitter.simulator.windows
    index = {id(log): r for r, log in enumerate(logs)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # told where the noise was looked at
        groups = [[index[id(log)] for log in group] for group in noise.repeats(logs)]
    for w, (r, start) in enumerate(zip(cut.log, cut.start, strict=True)):
        for other in (p for group in groups if r in group for p in group if p != r):
            rows = slice(int(start), int(start) + cut.steps)
            a, b = cut.logs[r], cut.logs[other]
            if len(b) > rows.stop and np.allclose(a.ctrl[rows], b.ctrl[rows]):
                yield w, other


def _apart(model: mujoco.MjModel, a: Log, b: Log, rows: slice) -> Array:
    """b - a `[H, 2 nv]` in some rows, positions in the tangent space."""
    return np.concatenate([_displaced(model, a.qpos[rows], b.qpos[rows]), b.qvel[rows] - a.qvel[rows]], axis=1)


def _displaced(model: mujoco.MjModel, begin: Array, end: Array) -> Array:
    """end - begin `[H, nv]` of positions `[H, nq]`, in the tangent space of each beginning."""
    out = np.zeros((len(end), model.nv))
    for row, x, y in zip(out, begin, end, strict=True):
        mujoco.mj_differentiatePos(model, row, 1.0, x, y)
    return out


def _settled(d: Array, B: Array, spread: Array) -> tuple[Array, Array]:
    """(d `[H, channels]` without the part that other start states explain, these states `[s]`).

    Args:
        B: `[H channels, s]`, derivatives by the start state; spread: `[s]`, of its Gaussian prior.
    """
    x = np.linalg.solve(B.T @ B + np.diag(1.0 / np.square(spread)), B.T @ d.reshape(-1))
    return np.asarray(d - (B @ x).reshape(d.shape)), np.asarray(x)


def constant_velocity_baseline(windows: Windows, model: mujoco.MjModel) -> Prediction:
    """Motion without any simulator: every joint keeps its speed. No law that does not beat that is a finding.

    Windows begin anew at the measured state, so a short one is predicted well by whatever hardly accelerates. Where a
    simulator's forces are far off, effects that only keep it from moving (a huge inertia, brakes everywhere) close
    almost all of its gap. Measured beside this predictor they close nothing. Start states are estimated on each window
    as those of a simulation are.
    """
    around, time = windows.batch.around, windows.dt * np.arange(1, windows.steps + 1)[:, None]
    qpos, qvel = (np.asarray(x, np.float64) for x in (windows.batch.qpos, windows.batch.qvel))
    begins = np.repeat(np.asarray(around.qpos, np.float64)[:, around.start, None], windows.steps, axis=1)
    speed = np.asarray(around.qvel, np.float64)[:, around.start, None]
    sigma = np.concatenate([windows.sigma_q, windows.sigma_v])
    used, one = np.isfinite(sigma), np.eye(model.nv)
    # derivatives by (position, speed) at the start: of positions 1 and the time, of speeds 0 and 1
    B = np.stack([np.block([[one, t * one], [0 * one, one]]) for t in time[:, 0]])[:, used] / sigma[used, None]
    errors, offsets = [], []
    for begin, end, slope, rates in zip(begins, qpos, speed, qvel, strict=True):
        ahead = np.concatenate([_displaced(model, begin, end) - slope * time, rates - slope], axis=1)
        error, offset = _settled(ahead[:, used] / sigma[used], B.reshape(-1, 2 * model.nv), windows.spread)
        errors.append(error)
        offsets.append(offset)
    return Prediction(np.stack(errors), np.stack(offsets))
