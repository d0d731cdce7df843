"""From findings to the result: the verdict's name and words, numbers per effect, gap, ranking, numbers for pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx import versions
from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.experiment.propose import Experiment
from bayessim_mjx.diagnosis.findings import Findings, Where
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.phrases import effects as phrases
from bayessim_mjx.diagnosis.phrases import notes, residual
from bayessim_mjx.diagnosis.phrases.verdict import sentences
from bayessim_mjx.diagnosis.request import length_unit
from bayessim_mjx.diagnosis.residual.black_boxes import BlackBoxes
from bayessim_mjx.diagnosis.result import Diagnosis, Gap, Place
from bayessim_mjx.diagnosis.selection import bounds
from bayessim_mjx.diagnosis.selection.models import systematic
from bayessim_mjx.diagnosis.selection.numbers import HIDDEN, SINGLES
from bayessim_mjx.diagnosis.selection.search_state import SearchState, ranked
from bayessim_mjx.diagnosis.summary import estimates, how_far
from bayessim_mjx.diagnosis.summary.again import AtFinerSteps, Whole
from bayessim_mjx.diagnosis.summary.verdict import Verdict, force_in_numbers, verdict_of
from bayessim_mjx.effects import spec_of
from bayessim_mjx.logs.log import Channels

PACKAGES = ("bayessim-mjx", "mujoco", "mujoco-mjx", "jax", "numpy")  # what the result depends on


def diagnosis_of(found: Findings, about: Mapping[str, Any] | None = None, file: str = "") -> Diagnosis:
    """Make the result of the findings: numbers first, and then the sentences that are made of them.

    Args:
        about: what was diagnosed, see `Diagnosis`; file: name of the proposal's command file, where there is one.
    """
    setup, selection, model = found.setup, found.selection, found.model
    own = selection.estimated
    together = own.covariance + np.diag(systematic(model, setup.fitter.simulator.windows.dt) ** 2)
    finer = found.part(AtFinerSteps)
    steps = finer.notes(model, together) if finer else []
    base = len(setup.fitter.base)
    together = _told(found, together + finer.covariance(base) if finer else together)
    sd = np.sqrt(np.diag(together))
    closed = estimates.closed_by(found)
    effects = estimates.effects_of(found, sd, closed)
    far = how_far.measured(found, {k: v for k, v in closed.items() if k != "each"})
    verdict = verdict_of(found, far)
    known = own.mean[:base] + (finer.shift[:base] if finer else 0.0)
    over, where, proposal = found.part(Whole), found.part(Where), found.part(Experiment)
    far = how_far.with_whole(far, over, setup.tolerance) if over else far
    warned = [*setup.warnings, *steps, *(over.notes if over else ()), *(notes.horizon_warning(far) if effects else [])]
    more: dict[str, Any] = {"force_left": force_in_numbers(found, far)}
    more |= {"maps": where.found.maps, "frequency": [heard.details() for heard in where.spectra]} if where else {}
    more |= {"experiments": proposal.details()} if proposal else {}
    experiment = proposal.to_dict(file) if proposal else {}
    cut, own_model = setup.fitter.simulator.windows, setup.physics.mj_model
    simulated = {
        "conditions": cut.conditions,
        "timestep": cut.dt / cut.batch.command.shape[2],
        "integrator": mujoco.mjtIntegrator(own_model.opt.integrator).name.removeprefix("mjINT_"),
    }
    result = Diagnosis(
        verdict=verdict.name,
        sentences=[],
        effects=effects,
        where=residual.places(where.found) if where and where.found.spots else _where(found),
        gap=far,
        parameters=estimates.parameters(selection, model, sd, known),
        candidates=ranking(selection.state, selection.answer.effects),
        warnings=[*warned, *estimates.less_accurate(model, own.sheet), *found.warnings],
        next_experiment=experiment,
        versions=versions.of(PACKAGES),
        details=details(found) | more,
        covariance={"names": list(model.fit.names), "matrix": together},
        not_fitted=not_fitted(selection.state),
        about={**about, **simulated} if about else {},
        hidden=list(selection.hidden),
        accuracy=estimates.accuracy(model, own.sheet),
        evidence=selection.weighed.to_dicts(),
        answers=estimates.answers(effects, experiment),
        basis=basis(found, verdict),
    )
    rivals = residual.black_boxes(found.part(BlackBoxes), setup.fitter.simulator.windows.blocks)
    lies = [*residual.located(where.found), *residual.spectra(where.spectra)] if where else []
    return replace(result, sentences=[*sentences(result), *rivals, *lies])


def basis(found: Findings, verdict: Verdict) -> dict[str, Any]:
    """Return the numbers behind the sentences that stand nowhere else in the result, see `Diagnosis.basis`."""
    state, cut, weighed = found.selection.state, found.setup.fitter.simulator.windows, found.selection.weighed
    window = cut.steps * cut.dt
    top = found.flexible_winner
    on = "effects" if found.model.effects else "recalibrated"
    return {
        "window": window,
        "remains": verdict.remains,
        "noise_memory": verdict.noise.memory * window if verdict.noise is not None else None,
        "far_off": verdict.bent,
        "builds_up": verdict.builds_up,
        "above_noise": state.above_noise(state.base),
        "probability": weighed.chance(),
        "flexible": residual.flexible_of(top, on) if top is not None else {},
        "efforts": notes.first_verdict(found.setup.look),
        "tried": sorted({e.name for e in found.setup.physics.effects}),
        "not_tried": not_tried(state),
    }


def _told(found: Findings, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance without its entries for parameters that end at a bound."""
    model, physics = found.model, found.setup.physics
    at = []
    for effect in model.effects:
        for c, value in zip(effect.coordinates, model.values_of(effect), strict=True):
            bound = bounds.of(physics, c, float(value))
            at += [model.fit.names.index(c.name)] if bound is not None and bound.kind != "off" else []
    return bounds.spread_out(covariance, model.fit.away, at)


def ranking(state: SearchState, answer: Sequence[Candidate] = ()) -> list[dict[str, Any]]:
    """Return the best models, with all before the answer: held-out score, nats over the known parameters, its error."""
    rows = statistics.leave_one_out(state.fitter.simulator.windows.condition)
    absorbed = {s.candidate.label: s.absorbed for s in state.screened}
    out: list[dict[str, Any]] = []
    every = ranked(state)
    named = {e.label for e in answer}
    at = next((k for k, model in enumerate(every, 1) if named and {e.label for e in model.effects} == named), 0)
    rows_of = every[: max(60, at)]
    samples = rows_of[0].samples  # one for all, so that scores are in the order of the errors
    for model in rows_of:
        ratio = np.log((rows @ state.base.cost) / (rows @ model.cost))
        error = float(0.5 * samples * statistics.error(ratio)) if len(rows) else float("nan")
        out.append({
            "effects": [e.label for e in model.effects],
            "label": model.label,
            "score": 0.5 * samples * float(np.log(state.base.total / model.total)),
            "se": error,
            "gap_closed": state.gap(model).closed,
            "rms": float(np.sqrt(model.total / model.fit.r.size)),
            "parameters": dict(zip(model.fit.names, map(float, model.fit.values), strict=True)),
            "absorbed": absorbed.get(model.effects[0].label) if len(model.effects) == 1 else None,
        })  # fmt: skip
    return out


def _where(found: Findings) -> list[Place]:
    """Shares of the calibrated gap by joint, above the noise."""
    setup = found.setup
    cut = setup.fitter.simulator.windows
    calibrated = found.predictions["calibrated"]
    channels, used = Channels.of(setup.physics.mj_model).qvel, setup.fitter.used[: setup.physics.mj_model.nv]
    names = [n for n, seen in zip(channels, used, strict=True) if seen]
    if not names:
        return []
    costs = np.stack([np.maximum(calibrated.cost(cut.steps, slice(i, i + 1)) - 1.0, 0.0) for i in range(len(names))], 1)
    total = costs.sum()
    if total <= 0.1 * costs.size:
        return []
    ends = statistics.interval_of_shares(costs, cut.condition)
    out = [Place(n, float(costs[:, i].sum() / total), ends[i], "") for i, n in enumerate(names)]
    return sorted(out, key=lambda p: -p.share)


def insufficient(reason: str, notes: Sequence[str], about: Mapping[str, Any] | None = None) -> Diagnosis:
    """Return the verdict where nothing can be held out."""
    nothing = Gap(1.0, *(float("nan"),) * 4)
    said = [f"Too little data: {reason}."]
    about, own = dict(about or {}), versions.of(PACKAGES)
    return Diagnosis("insufficient_data", said, [], [], nothing, {}, [], list(notes), {}, own, about=about)


def not_fitted(state: SearchState) -> dict[str, list[str]]:
    """{reason: labels of candidates that are in no model}, of reasons that there are."""
    fitted = frozenset().union(*state.models)
    gains = {s.candidate.label: s.gain for s in state.screened}
    out: dict[str, list[str]] = {}
    for label in (c.label for c in state.candidates if c.label not in fitted):
        out.setdefault(_reason(state, label, gains), []).append(label)
    return out


def not_tried(state: SearchState) -> dict[str, Any]:
    """Parts of the search that the time was too short for, with the minutes that there were; {} if none."""
    parts = [f"{count} models ({part})" for part, count in state.skipped.items() if part != SINGLES]
    parts = [f"{len(state.cut_short)} single effects", *parts] if state.cut_short else parts
    budget = state.settings.budget
    return {"minutes": budget.seconds / 60, "before": budget.fixed / 60, "parts": parts} if parts else {}


def _reason(state: SearchState, label: str, gains: dict[str, float]) -> str:
    if label in state.cut_short:
        return phrases.NO_TIME_LEFT
    if label not in gains:
        return phrases.NOT_SCREENED
    if gains[label] <= 0.0:
        return phrases.NO_GAIN
    return phrases.LESS_PROMISING if state.above_noise(state.base) else phrases.NOTHING_LEFT


def details(found: Findings) -> dict[str, Any]:
    """Return the numbers of the pictures, see `report`."""
    model, cut = found.model, found.setup.fitter.simulator.windows
    each, deviation = estimates.per_condition(found.setup.fitter, model)
    names = model.fit.names
    return {
        "effect_specs": {e.name: spec_of(e) for e in found.setup.physics.effects if e.quantities},
        "overlays": _overlays(found),
        "isolability": _isolability(found.selection.state),
        "episodes": _episodes(found),
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
        "before_simulation": {"lines": notes.first_look(found.setup.look)} | found.setup.look.to_dict(),
        "noise": [
            {"channel": n, "sigma": float(s)}
            for n, s in zip(Channels.of(found.setup.physics.mj_model).qvel, cut.sigma_q, strict=True)
        ],
    }  # fmt: skip


def _flexible(found: Findings) -> dict[str, Any]:
    """Return the flexible force on the recalibrated simulator and beside the effects, in noise standard deviations."""
    base = found.flexible_base
    winner = found.flexible_winner if found.model.effects else None
    shown, on = winner or base, "effects" if winner else "recalibrated"
    if shown is None:
        return {}
    size = found.setup.fitter.size
    levels = [np.nan if f is None else float(np.sqrt(f.condition.cost.mean() / size)) for f in (base, winner)]
    seeds = np.sqrt(np.maximum(shown.condition.totals.min(1), 0.0) / len(shown.condition.cost))
    return {
        "depends_on": [{"input": d["input"], "importance": d["importance"]} for d in shown.depends_on],
        "where": residual.flexible(residual.flexible_of(shown, on), found.setup.fitter.simulator.windows.blocks),
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
    return shares | {"terms": terms, "formula_in_words": residual.formula(found), "folds": found.folds}


def _overlays(found: Findings) -> list[dict[str, Any]]:
    setup = found.setup
    cut, model = setup.fitter.simulator.windows, setup.physics.mj_model
    out: list[dict[str, Any]] = []
    for r, log in enumerate(cut.logs):
        own = np.flatnonzero(cut.log == r)
        for joint in range(model.njnt):
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            if int(model.jnt_type[joint]) not in (2, 3) or not len(own) or not log.seen_dofs[v]:
                continue
            rows = np.concatenate([np.arange(cut.start[w] + 1, cut.start[w] + 1 + cut.steps) for w in own])
            entry: dict[str, Any] = {
                "log": log.name, "joint": model.joint(joint).name or f"joint{joint}", "unit": length_unit(model, v),
                "time": log.time[rows] - log.time[0], "measured": log.qpos[rows, q],
                "starts": log.time[cut.start[own]] - log.time[0],
            }  # fmt: skip
            shown = {k: p for k, p in found.predictions.items() if k != "with_effects" or found.model.effects}
            for stage, prediction in shown.items():
                error = setup.tolerance.by_dof(prediction.error[own])[..., v]
                entry[stage] = log.qpos[rows, q] - (error * cut.sigma_q[v]).reshape(-1)
            out.append(entry)
    return out


def _isolability(of: SearchState) -> dict[str, Any]:
    """|cos| between what the candidates change in the residual, known parameters and starts projected out."""
    some = [s for s in of.screened if s.absorbed < HIDDEN]
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
