"""From findings to the result: the verdict's name and words, numbers per effect, gap, ranking, numbers for pictures."""

from __future__ import annotations

import importlib.metadata
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis import gap, search, uncertainty, verdict
from bayessim_mjx.diagnosis.candidates import Candidate
from bayessim_mjx.diagnosis.models import Model
from bayessim_mjx.diagnosis.result import Diagnosis, Estimate, FoundEffect, Gap, Place
from bayessim_mjx.diagnosis.run import Findings, Setup, dof_names

UNEXPLAINED = 2.0  # noise standard deviations that remain and that nothing predicts
MANY = 24  # candidates in the isolability matrix, overlays in the report
REMAINS = 0.3  # share of the calibrated gap that a flexible force closes on top of named effects: not in the library


def diagnosis_of(found: Findings, say: search.Progress = lambda text, done, total: None) -> Diagnosis:
    """The result of a diagnosis."""
    setup, race, ruling = found.setup, found.race, found.ruling
    model = ruling.model
    sd = uncertainty.deviations(setup.fitter, model)
    effects = _effects(found, sd, say)
    remains = _remains(found)
    name = _verdict(found, remains)
    parameters = _parameters(race, model, sd)
    return Diagnosis(
        verdict=name,
        sentences=_sentences(name, effects, parameters, found, remains),
        effects=effects,
        where=_where(found),
        gap=_gap(found),
        parameters=parameters,
        candidates=ranking(race),
        warnings=list(setup.warnings) + _horizon_warning(found),
        next_experiment={},
        versions=versions(),
        details=_details(found, effects),
    )


def _remains(found: Findings) -> float:
    """Share of the calibrated gap that a flexible force still closes on top of the winner; 0 where not significant."""
    flex, race, model = found.flexible_winner, found.race, found.ruling.model
    if flex is None or not flex.condition.significant:
        return 0.0
    floor = race.noise * len(race.base.cost)
    top = model.total - min(float(flex.condition.cost.sum()), model.total)
    return float(top / max(race.base.total - floor, 1e-9))


def _verdict(found: Findings, remains: float) -> str:
    race, model = found.race, found.ruling.model
    cost = {k: float(p.cost(found.setup.fitter.simulator.windows.steps).mean()) for k, p in found.predictions.items()}
    left = cost["with_effects"] - 1.0
    if model.effects and left > UNEXPLAINED**2 - 1.0 and left > 0.6 * (cost["calibrated"] - 1.0):
        return "unexplained"  # what is named closes little of it
    if (
        race.above_noise(model)
        and remains > REMAINS
        or (model.effects and found.flexible_winner is not None and _beaten(found))
    ):
        return "unexplained"
    if model.effects:
        return "ambiguous" if found.ruling.ambiguous else "effects"
    if np.sqrt(race.base.total / (race.noise * len(race.base.cost))) > UNEXPLAINED:
        return "unexplained"
    q, _ = race.nominal.quadratic(race.fitter.spread)
    floor = race.noise * len(race.base.cost) * race.settings.floor**2
    return "parameters" if q.c.sum() > max(1.1 * race.base.total, floor) else "no_gap"


def _beaten(found: Findings) -> bool:
    """Whether a flexible force alone predicts held-out conditions much better than the named effects do."""
    base, model = found.flexible_base, found.ruling.model
    return base is not None and base.condition.significant and float(base.condition.cost.sum()) < 0.6 * model.total


def _effects(found: Findings, sd: np.ndarray, say: search.Progress) -> list[FoundEffect]:
    model, race = found.ruling.model, found.race
    if not model.effects:
        return []
    shares = verdict.shapley(race, model, say)
    out = [_effect(found, e, sd, shares.get(e.label, float("nan")), say) for e in model.effects]
    return sorted(out, key=lambda e: -e.share if e.share == e.share else -e.gap_closed)


def _effect(found: Findings, effect: Candidate, sd: np.ndarray, share: float, say: search.Progress) -> FoundEffect:
    setup, race, model, predictions = found.setup, found.race, found.ruling.model, found.predictions
    fitter, cut = setup.fitter, setup.fitter.simulator.windows
    rivals = found.ruling.rivals.get(effect.label, [])
    rest = verdict.without(race, model, effect, say)
    before = gap.predict(fitter, rest) if rest.effects else predictions["calibrated"]
    after = predictions["with_effects"]
    reference = min(1.0, float(after.cost(cut.steps).mean()))
    calibrated = predictions["calibrated"].cost(cut.steps)
    whole, _ = gap.closure(calibrated, after.cost(cut.steps), 1.0, cut.group, setup.seed)
    alone = share if len(model.effects) > 1 and share == share else 1.0
    closed, ci = gap.closure(before.cost(cut.steps), after.cost(cut.steps), reference, cut.group, setup.seed)
    if len(model.effects) > 1:  # of the whole gap, by its share in what all close together
        closed, ci = whole * alone, (ci[0] * whole * alone, min(1.0, ci[1] * whole * alone))
    told = [model, *(r.model for r in rivals if not r.contains)]
    weight = uncertainty.win_share(told, cut.group, race.noise, np.random.default_rng(setup.seed))
    screened = next((s for s in race.screened if s.candidate.label == effect.label), None)
    above = max(race.base.total - race.noise * len(race.base.cost), 1e-9)
    own = [model.job.names.index(c.name) for c in effect.coordinates]
    numbers = {
        c.name.rsplit(".", 1)[1]: Estimate(float(model.job.values[i]), float(sd[i]), _unit(setup, effect, c.unit))
        for i, c in zip(own, effect.coordinates, strict=True)
    }
    return FoundEffect(
        name=effect.effect,
        where=effect.where,
        parameters=numbers,
        probability=float(weight[0]),
        gap_closed=closed,
        gap_closed_ci=ci,
        equivalent_to=[r.to_dict() for r in rivals],
        sentence="",
        predicted_gap_closed=float("nan") if screened is None else min(screened.gain / above, 1.0),
        share=share,
    )


def _unit(setup: Setup, effect: Candidate, unit: str) -> str:
    """A hinge's unit as a slide's, where the place is a slide."""
    model = setup.physics.mj_model
    if effect.kind not in ("joint", "actuator") or effect.where == "all":
        return unit
    try:
        joint = model.joint(effect.where).id if effect.kind == "joint" else int(model.actuator(effect.where).trnid[0])
    except KeyError:
        return unit
    if joint < 0 or int(model.jnt_type[joint]) != 2:
        return unit
    swap = {"N m/rad": "N/m", "N m s/rad": "N s/m", "N m s": "N s/m", "kg m^2": "kg", "N m": "N", "rad": "m"}
    return swap.get(unit, unit.replace("N m", "N").replace("rad", "m"))


def _gap(found: Findings) -> Gap:
    setup, predictions = found.setup, found.predictions
    cut = setup.fitter.simulator.windows
    floor = _floor(found)
    horizons = []
    for steps in sorted({min(10, cut.steps), max(1, min(cut.steps, round(0.25 / cut.dt))), cut.steps}):
        row = gap.stages(predictions, None, steps, cut.group, setup.seed)
        row["reducible_floor"] = min(floor, row["with_effects"])
        horizons.append({"name": f"{steps * cut.dt:.2g} s", "seconds": steps * cut.dt, **row})
    whole = horizons[-1]
    names = dof_names(setup.physics.mj_model)
    by_channel = {
        joint: {s: float(np.sqrt(p.cost(cut.steps, slice(i, i + 1)).mean())) for s, p in predictions.items()}
        for i, joint in enumerate(names)
    }
    physical = {
        joint: {s: v * float(cut.sigma_q[i]) for s, v in by_channel[joint].items()} | {"unit": _length(setup, i)}
        for i, joint in enumerate(names)
    }
    return Gap(
        noise_floor=1.0,
        nominal=whole["nominal"],
        calibrated=whole["calibrated"],
        with_effects=whole["with_effects"],
        reducible_floor=whole["reducible_floor"],
        by_channel=by_channel,
        horizons=horizons,
        physical=physical,
    )


def _floor(found: Findings) -> float:
    """The smallest held-out error that anything reached, named or flexible, not below the noise (rms)."""
    race = found.race
    totals = [m.total for m in race.models.values()]
    totals += [float(f.condition.cost.sum()) for f in (found.flexible_base, found.flexible_winner) if f is not None]
    return max(1.0, float(np.sqrt(min(totals) / (race.noise * len(race.base.cost)))))


def _length(setup: Setup, dof: int) -> str:
    model = setup.physics.mj_model
    joint = int(model.dof_jntid[dof])
    slides = int(model.jnt_type[joint]) == 2 or (
        int(model.jnt_type[joint]) == 0 and dof - int(model.jnt_dofadr[joint]) < 3
    )
    return "m" if slides else "rad"


def _parameters(race: search.Race, model: Model, sd: np.ndarray) -> dict[str, dict[str, Any]]:
    remarks = verdict.structural(race, model, sd)
    return {
        c.name: {
            "mean": float(model.job.values[i]), "sd": float(sd[i]), "nominal": c.neutral, "low": c.low, "high": c.high,
            "unit": c.unit, "structural": remarks.get(c.name, ""),
        }
        for i, c in enumerate(race.fitter.base)
    }  # fmt: skip


def ranking(race: search.Race) -> list[dict[str, Any]]:
    """Models tried, best first, with the held-out score (nats over the known parameters alone) and its standard error."""
    group = race.fitter.simulator.windows.group
    above = max(race.base.total - race.noise * len(race.base.cost), 1e-9)
    absorbed = {s.candidate.label: s.absorbed for s in race.screened}
    out = []
    for model in search.ranked(race)[:60]:
        gain = race.base.cost - model.cost
        sums = np.array([gain[group == g].sum() for g in np.unique(group)])
        error = float(np.std(sums, ddof=1) * np.sqrt(len(sums)) / above) if len(sums) > 1 else float("nan")
        out.append({
            "effects": [e.label for e in model.effects],
            "label": model.label,
            "score": race.better(race.base, model).evidence,
            "se": error,
            "gap_closed": race.closure(model),
            "rms": float(np.sqrt(model.total / model.job.r.size)),
            "parameters": dict(zip(model.job.names, map(float, model.job.values), strict=True)),
            "absorbed": absorbed.get(model.effects[0].label) if len(model.effects) == 1 else None,
        })  # fmt: skip
    return out


def _where(found: Findings) -> list[Place]:
    """Shares of the calibrated gap by joint, above the noise."""
    setup = found.setup
    cut = setup.fitter.simulator.windows
    draws = uncertainty.bootstrap_weights(cut.group, 400, np.random.default_rng(setup.seed))
    calibrated = found.predictions["calibrated"]
    names = dof_names(setup.physics.mj_model)
    costs = np.stack([np.maximum(calibrated.cost(cut.steps, slice(i, i + 1)) - 1.0, 0.0) for i in range(len(names))], 1)
    total = costs.sum()
    if total <= 0.1 * costs.size:
        return []
    sampled = draws @ costs
    shares = sampled / np.maximum(sampled.sum(1, keepdims=True), 1e-12)
    out = [
        Place(n, float(costs[:, i].sum() / total), uncertainty.interval(shares[:, i]), "") for i, n in enumerate(names)
    ]
    return sorted(out, key=lambda p: -p.share)


def _horizon_warning(found: Findings) -> list[str]:
    """A verdict that changes with the horizon is flagged."""
    if not found.ruling.model.effects:
        return []
    cut = found.setup.fitter.simulator.windows
    closed = []
    for steps in (min(10, cut.steps), cut.steps):
        before, after = (found.predictions[k].cost(steps).mean() for k in ("calibrated", "with_effects"))
        closed.append((before - after) / max(before - 1.0, 1e-9) if before > 1.2 else np.nan)
    if np.all(np.isfinite(closed)) and abs(closed[0] - closed[1]) > 0.3:
        short, long = (steps * cut.dt for steps in (min(10, cut.steps), cut.steps))
        return [
            f"the gap closed depends on the horizon: {closed[0]:.0%} over {short:.2g} s, {closed[1]:.0%} over {long:.2g} s"
        ]
    return []


def _sentences(name: str, effects: list[FoundEffect], parameters: dict, found: Findings, remains: float) -> list[str]:
    cost = {
        k: float(np.sqrt(p.cost(found.setup.fitter.simulator.windows.steps).mean()))
        for k, p in found.predictions.items()
    }
    named = " and ".join(f"{e.name.replace('_', ' ')} at {e.where}" for e in effects)
    head = {
        "no_gap": f"No gap above the noise: the simulator is within {cost['nominal']:.2g} noise standard deviations of the logs.",
        "parameters": f"The parameters are off, the structure is right: recalibrated, the gap falls from {cost['nominal']:.3g} to {cost['calibrated']:.3g} noise standard deviations.",
        "effects": f"The simulator lacks {named}.",
        "ambiguous": f"The simulator lacks something like {named}; these logs cannot tell it from its rivals.",
        "unexplained": "Something is missing that no effect of the library explains.",
        "insufficient_data": "Too little data to hold anything out.",
    }[name]
    out = [head]
    if name == "unexplained" and effects:
        out.append(
            f"Of the library {named} comes nearest; a flexible force on top of it still closes {remains:.0%} of the gap."
        )
    if effects:
        out.append(
            f"With it the gap falls from {cost['calibrated']:.3g} (recalibrated) to {cost['with_effects']:.3g} noise standard deviations on held-out conditions."
        )
    flex = found.flexible_winner
    if name == "unexplained" and flex is not None:
        out += flex.text
    if not effects and remains == 0.0 and found.race.above_noise(found.race.base):
        out.append(
            f"What remains ({cost['calibrated']:.3g}) no candidate and no flexible force predicts on held-out conditions: process noise, an input that was not logged, or noise larger than estimated."
        )
    out += [f"{k}: {v['structural']}." for k, v in parameters.items() if v["structural"]]
    return out


def _details(found: Findings, effects: list[FoundEffect]) -> dict[str, Any]:
    race, ruling = found.race, found.ruling
    flex = found.flexible_winner or found.flexible_base
    rms = {
        k: float(np.sqrt(p.cost(found.setup.fitter.simulator.windows.steps).mean()))
        for k, p in found.predictions.items()
    }
    each, deviation = verdict.per_condition(race, ruling.model)
    groups = found.setup.fitter.simulator.windows.groups
    return {
        "overlays": _overlays(found),
        "isolability": _isolability(race),
        "episodes": _episodes(found),
        "closure": [{"effects": e.name, "predicted": e.predicted_gap_closed, "realised": e.gap_closed} for e in effects],
        "shapley": [{"effect": f"{e.name}@{e.where}", "share": e.share} for e in effects if e.share == e.share],
        "flexible": {} if flex is None else flex.details(rms["calibrated"], rms["with_effects"]),
        "groups": {
            "names": list(groups),
            "parameters": {n: {"mean": each[:, i], "sd": deviation[:, i]} for i, n in enumerate(ruling.model.job.names)},
        },
        "links": [
            {"name": f"{k.name} ({k.where})", "slope": k.slope, "correlation": k.correlation, "lag": k.lag, "verdict": k.text}
            for k in found.links
        ],
        "noise": [
            {"channel": n, "sigma": float(s)}
            for n, s in zip(dof_names(found.setup.physics.mj_model), found.setup.fitter.simulator.windows.sigma_q, strict=True)
        ],
    }  # fmt: skip


def _overlays(found: Findings) -> list[dict[str, Any]]:
    setup = found.setup
    cut, model = setup.fitter.simulator.windows, setup.physics.mj_model
    out = []
    for r, log in enumerate(cut.logs):
        own = np.flatnonzero(cut.log == r)
        for joint in range(model.njnt):
            if int(model.jnt_type[joint]) not in (2, 3) or len(out) >= MANY or not len(own):
                continue
            q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            rows = np.concatenate([np.arange(cut.start[w] + 1, cut.start[w] + 1 + cut.steps) for w in own])
            entry: dict[str, Any] = {
                "log": log.name, "joint": model.joint(joint).name or f"joint{joint}", "unit": _length(setup, v),
                "time": log.time[rows] - log.time[0], "measured": log.qpos[rows, q],
                "starts": log.time[cut.start[own]] - log.time[0],
            }  # fmt: skip
            for stage, prediction in found.predictions.items():
                entry[stage] = log.qpos[rows, q] - (prediction.error[own, :, v] * cut.sigma_q[v]).reshape(-1)
            out.append(entry)
    return out


def _isolability(race: search.Race) -> dict[str, Any]:
    """|cos| between what the candidates change in the residual, known parameters and starts projected out."""
    some = [s for s in race.screened if s.absorbed < 0.999][:MANY]
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
    out = []
    for r, log in enumerate(cut.logs):
        own = cut.log == r
        if own.any():
            row: dict[str, Any] = {"log": log.name, "condition": cut.groups[int(cut.group[own][0])]}
            row |= {k: float(np.sqrt(p.cost(cut.steps)[own].mean())) for k, p in found.predictions.items()}
            out.append(row)
    return out


def versions() -> dict[str, str]:
    """Versions of what the result depends on."""
    out: dict[str, str] = {}
    for package in ("bayessim-mjx", "mujoco", "mujoco-mjx", "jax", "numpy"):
        try:
            out[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # run from a checkout that was not installed
            out[package] = "unknown"
    return out


def insufficient(reason: str, notes: list[str]) -> Diagnosis:
    """The verdict where nothing can be held out."""
    nothing = Gap(1.0, *(float("nan"),) * 4)
    return Diagnosis(
        "insufficient_data", [f"Too little data: {reason}."], [], [], nothing, {}, [], notes, {}, versions()
    )


def with_more(result: Diagnosis, found: Findings, folder: Path, say: search.Progress) -> Diagnosis:
    """The result with maps, spectra and the next experiment; what fails there becomes a warning, the verdict stands."""
    for part, text in ((_with_places, "where"), (_with_experiment, "next experiment")):
        say(text, 0, 1)
        try:
            result = part(result, found, folder)
        except Exception as error:  # the verdict is there: a picture or proposal less must not lose it
            result.warnings.append(f"{text}: not available ({type(error).__name__}: {error})")
    return result


def _with_places(result: Diagnosis, found: Findings, folder: Path) -> Diagnosis:
    from bayessim_mjx.diagnosis import frequency, where

    if found.disturbance is None:
        return result
    fitter, job = found.setup.fitter, found.race.base.job
    places, maps, sentences = where.locate(fitter, job, found.disturbance, seed=found.setup.seed)
    spectra, heard = frequency.analyse(fitter, job, found.disturbance, seed=found.setup.seed)
    details = result.details | {"maps": maps, "frequency": spectra}
    return replace(
        result, where=places or result.where, sentences=[*result.sentences, *sentences, *heard], details=details
    )


def _with_experiment(result: Diagnosis, found: Findings, folder: Path) -> Diagnosis:
    from bayessim_mjx.diagnosis import command, experiment

    if not (found.ruling.model.effects or found.race.above_noise(found.race.base)):
        return result
    proposal = experiment.propose(found.setup, found.race, found.ruling, seed=found.setup.seed)
    file = ""
    if proposal.chosen is not None:
        folder.mkdir(parents=True, exist_ok=True)
        file = command.write_command(folder / "next_experiment.csv", proposal, str(folder / "diagnosis.json")).name
    details = result.details | {"experiments": proposal.details()}
    return replace(result, next_experiment=proposal.to_dict(file), details=details)
