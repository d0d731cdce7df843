"""Numbers for the pictures of a diagnosis: overlays, isolability, per-log and per-condition tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.residual.black_boxes import BlackBoxes
from bayessim_mjx.diagnosis.result import FoundEffect
from bayessim_mjx.diagnosis.selection import conditions
from bayessim_mjx.diagnosis.selection.tried import Tried
from bayessim_mjx.diagnosis.summary import first_look
from bayessim_mjx.diagnosis.summary.left_in_words import flexible_in_words, formula_in_words
from bayessim_mjx.diagnosis.tolerance import length_unit
from bayessim_mjx.effects import spec_of
from bayessim_mjx.logs.log import Channels

MANY = 24  # candidates in the isolability matrix, overlays in the report


def details(found: Findings, effects: list[FoundEffect], closed: dict[str, Any]) -> dict[str, Any]:
    model, cut = found.model, found.setup.fitter.simulator.windows
    each, deviation = conditions.per_condition(found.selection, model)
    names = model.fit.names
    return {
        "effect_specs": {e.name: spec_of(e) for e in found.setup.physics.effects if e.quantities},
        "overlays": _overlays(found),
        "isolability": _isolability(found.selection),
        "episodes": _episodes(found),
        "closure": _closure(effects, closed),
        "shapley": [{"effect": f"{e.name}@{e.where}", "share": e.share} for e in effects if e.share == e.share],
        "flexible": _flexible(found),
        "black_boxes": _black_boxes(found.part(BlackBoxes)),
        "groups": {
            "names": list(cut.groups),
            "parameters": {n: {"mean": each[:, i], "sd": deviation[:, i]} for i, n in enumerate(names)},
        },
        "links": [
            {
                "name": f"{k.name} ({k.where})", "slope": k.slope, "correlation": k.correlation, "lag": k.lag,
                "verdict": k.text,
            }
            for k in found.links
        ],
        "before_simulation": {"lines": first_look.lines(found.setup.look)} | found.setup.look.to_dict(),
        "noise": [
            {"channel": n, "sigma": float(s)}
            for n, s in zip(Channels.of(found.setup.physics.mj_model).qvel, cut.sigma_q, strict=True)
        ],
    }  # fmt: skip


def _closure(effects: list[FoundEffect], closed: dict[str, Any]) -> list[dict[str, Any]]:
    """Promised and realised, of each effect and of all together."""
    labels = [f"{e.name}@{e.where}" for e in effects]
    rows: list[dict[str, Any]] = [
        {"effects": [n], "predicted": e.predicted_gap_closed, "realised": e.gap_closed, "ci": e.gap_closed_ci}
        for n, e in zip(labels, effects, strict=True)
    ]
    both = {k: closed[k] for k in ("predicted", "realised", "ci")} if len(rows) > 1 else {}
    return [*rows, {"effects": labels} | both] if both else rows


def _flexible(found: Findings) -> dict[str, Any]:
    """The flexible force on the recalibrated simulator and on top of the effects, in noise standard deviations."""
    base = found.flexible_base
    winner = found.flexible_winner if found.model.effects else None
    shown = winner or base
    if shown is None:
        return {}
    size = found.setup.fitter.size
    levels = [np.nan if f is None else float(np.sqrt(f.condition.cost.mean() / size)) for f in (base, winner)]
    seeds = np.sqrt(np.maximum(shown.condition.totals.min(1), 0.0) / shown.force.shape[0])
    return {
        "depends_on": [{"input": d["input"], "importance": d["importance"]} for d in shown.depends_on],
        "where": flexible_in_words(shown, found.setup.fitter.simulator.windows.blocks),
        "seeds": [s / np.sqrt(size) for s in seeds.tolist()],
        "rms_on_base": levels[0],
        "rms_on_winner": levels[1],
    }


def _black_boxes(found: BlackBoxes | None) -> dict[str, Any]:
    """Shares of the squared gap above the noise that are closed on conditions held out, and the formula."""
    if found is None:
        return {}
    terms = [{"joint": t.joint, "term": t.what, "force": t.force} for t in found.terms]
    shares = {"network": found.network, "formula": found.formula, "named_effects": found.named}
    return shares | {"terms": terms, "formula_in_words": formula_in_words(found), "folds": found.folds}


def _overlays(found: Findings) -> list[dict[str, Any]]:
    setup = found.setup
    cut, model = setup.fitter.simulator.windows, setup.physics.mj_model
    out: list[dict[str, Any]] = []
    for r, log in enumerate(cut.logs):
        own = np.flatnonzero(cut.log == r)
        for joint in range(model.njnt):
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            if int(model.jnt_type[joint]) not in (2, 3) or len(out) >= MANY or not len(own) or not log.seen_dofs[v]:
                continue
            rows = np.concatenate([np.arange(cut.start[w] + 1, cut.start[w] + 1 + cut.steps) for w in own])
            entry: dict[str, Any] = {
                "log": log.name, "joint": model.joint(joint).name or f"joint{joint}", "unit": length_unit(model, v),
                "time": log.time[rows] - log.time[0], "measured": log.qpos[rows, q],
                "starts": log.time[cut.start[own]] - log.time[0],
            }  # fmt: skip
            told = {k: p for k, p in found.predictions.items() if k != "with_effects" or found.model.effects}
            for stage, prediction in told.items():
                error = setup.tolerance.by_dof(prediction.error[own])[..., v]
                entry[stage] = log.qpos[rows, q] - (error * cut.sigma_q[v]).reshape(-1)
            out.append(entry)
    return out


def _isolability(of: Tried) -> dict[str, Any]:
    """|cos| between what the candidates change in the residual, known parameters and starts projected out."""
    some = [s for s in of.screened if s.absorbed < 0.999][:MANY]
    if len(some) < 2:
        return {}
    columns = np.stack([s.column.reshape(-1) for s in some])
    columns = columns / np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-300)
    return {
        "labels": [s.candidate.label for s in some],
        "cosine": np.abs(columns @ columns.T),
        "absorbed": [s.absorbed for s in some],
    }


def _episodes(found: Findings) -> list[dict[str, Any]]:
    cut = found.setup.fitter.simulator.windows
    out: list[dict[str, Any]] = []
    for r, log in enumerate(cut.logs):
        own = cut.log == r
        if own.any():
            row: dict[str, Any] = {
                "log": log.name,
                "condition": log.name if cut.blocks else cut.groups[int(cut.group[own][0])],
            }
            row |= {k: float(np.sqrt(p.cost(cut.steps)[own].mean())) for k, p in found.predictions.items()}
            out.append(row)
    return out
