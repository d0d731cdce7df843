"""The gap of every stage, by horizon and by joint: in physical units, as shares of the motion, in noise units."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.logcheck import noise
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.summary import whole_logs
from bayessim_mjx.diagnosis.tolerance import Tolerance
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]
SHORT = 0.1  # s, the first horizon: a few control steps; a rule of thumb


def measured(found: Findings, closed: dict[str, Any]) -> Gap:
    """The gap over the windows and a shorter horizon; `with_whole` adds that over whole logs."""
    setup, predictions = found.setup, found.predictions
    cut, allowed = setup.fitter.simulator.windows, setup.tolerance
    again = repeats(setup.fitter, found.model.fit, setup.logs)
    short, still = (
        max(1, min(round(SHORT / cut.dt), cut.steps // 2)),
        constant_velocity_baseline(cut, setup.robot.mj_model),
    )
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


@dataclass(frozen=True)
class Limits:
    """When runs count as repeated; rules of thumb."""

    fewest: int = 3  # windows with a repeat: with fewer no floor is given
    same: float = 0.001  # of a command's range: commands that are the same


LIMITS = Limits()


def repeats(fitter: Fitter, fit: Fit, logs: Sequence[Log]) -> tuple[Prediction, NDArray[np.int64]] | None:
    """The error of a perfect model of what repeats, window by window, and the windows' conditions `[P]`.

    Two runs of the same commands differ by twice the variance of what is not reproducible. What comes of their
    different start states is taken out as it is from a model's errors, by the fit's derivatives.

    Args:
        logs: as recorded, in the order of the windows' logs.

    Returns:
        None where nothing was repeated.
    """
    cut = fitter.simulator.windows
    errors, group = [], []
    for w, partner in _pairs(fitter, logs):
        a, b = (_states(fitter.simulator.physics.mj_model, cut.logs[r]) for r in (cut.log[w], partner))
        rows = slice(int(cut.start[w]) + 1, int(cut.start[w]) + 1 + cut.steps)
        d = _apart(fitter.simulator.physics.mj_model, a[rows], b[rows])[:, fitter.used] / fitter.sigma / np.sqrt(2)
        errors.append(_settled(d, fit.B[w], fitter.spread))
        group.append(cut.group[w])
    if len(errors) < LIMITS.fewest:
        return None
    return Prediction(np.stack(errors), np.zeros((len(errors), fit.offsets.shape[1]))), np.array(group)


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
            if len(cut.logs[other]) > rows.stop and _same(cut.logs[r].ctrl, cut.logs[other].ctrl, rows):
                yield w, other


def _same(a: Array, b: Array, rows: slice) -> bool:
    return bool((np.abs(a[rows] - b[rows]) <= LIMITS.same * np.ptp(a, axis=0) + 1e-12).all())


def _states(model: mujoco.MjModel, log: Log) -> Array:
    return np.concatenate([log.qpos, log.qvel], axis=1)


def _apart(model: mujoco.MjModel, a: Array, b: Array) -> Array:
    """b - a `[H, 2 nv]`, positions in the tangent space."""
    out = np.zeros((len(a), 2 * model.nv))
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        mujoco.mj_differentiatePos(model, out[k, : model.nv], 1.0, x[: model.nq], y[: model.nq])
    out[:, model.nv :] = b[:, model.nq :] - a[:, model.nq :]
    return out


def _settled(d: Array, B: Array, spread: Array) -> Array:
    """d `[H, channels]` without what other start states explain: derivatives B `[n, s]`, a prior of `spread` each."""
    x = np.linalg.solve(B.T @ B + np.diag(1.0 / np.square(spread)), B.T @ d.reshape(-1))
    return np.asarray(d - (B @ x).reshape(d.shape))


def constant_velocity_baseline(windows: Windows, model: mujoco.MjModel) -> Prediction:
    """Motion without any simulator: every joint keeps its speed. No law that does not beat that is a finding.

    Windows begin anew at the measured state, so a short one is predicted well by whatever hardly accelerates. Where a
    simulator's forces are far off, effects that only keep it from moving (a huge inertia, brakes everywhere) close
    almost all of its gap. Measured beside this predictor they close nothing. Start states are estimated on each window
    as those of a simulation are.
    """
    moved, started = _displacements(windows, model)
    time = windows.dt * np.arange(1, windows.steps + 1)
    precise_q, precise_v = (_precision(s) for s in (windows.sigma_q, windows.sigma_v))
    loose_q, loose_v = np.split(_precision(windows.spread), 2)
    qvel = np.asarray(windows.batch.qvel, np.float64) - started[:, None]
    ahead = moved - started[:, None] * time[:, None]  # what the measured start state leaves

    # weighted least squares of (position, speed) at the start, each degree of freedom on its own
    a = windows.steps * precise_q + loose_q
    b = time.sum() * precise_q
    c = np.sum(time**2) * precise_q + windows.steps * precise_v + loose_v
    right_q = precise_q * ahead.sum(1)
    right_v = precise_q * np.einsum("whv,h->wv", ahead, time) + precise_v * qvel.sum(1)
    shared = a * c - b**2
    position, speed = (c * right_q - b * right_v) / shared, (a * right_v - b * right_q) / shared
    error = [ahead - position[:, None] - speed[:, None] * time[:, None], qvel - speed[:, None]]
    sigma = np.concatenate([windows.sigma_q, windows.sigma_v])
    used = np.isfinite(sigma)
    return Prediction(np.concatenate(error, 2)[..., used] / sigma[used], np.concatenate([position, speed], 1))


def _displacements(windows: Windows, model: mujoco.MjModel) -> tuple[Array, Array]:
    """(`[W, H, nv]` from each window's measured start, in its tangent; `[W, nv]`, measured speeds there)."""
    around = windows.batch.around
    begins, qpos = (np.asarray(x, np.float64) for x in (np.asarray(around.qpos)[:, around.start], windows.batch.qpos))
    out = np.zeros((*qpos.shape[:2], model.nv))
    for row, begin, there in zip(out, begins, qpos, strict=True):
        for one, position in zip(row, there, strict=True):
            mujoco.mj_differentiatePos(model, one, 1.0, begin, position)
    return out, np.asarray(around.qvel[:, around.start], np.float64)


def _precision(sigma: Array) -> Array:
    """1 / sigma^2; 0 where nothing is measured."""
    return np.where(np.isfinite(sigma), np.asarray(sigma, np.float64) ** -2, 0.0)
