"""From findings to the result: the verdict's name and words, numbers per effect, gap, ranking, numbers for pictures."""

from __future__ import annotations

import importlib.metadata
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.result import Diagnosis, Gap, Place
from bayessim_mjx.diagnosis.selection import bounds, search, uncertainty, verdict
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.summary import effects_found, how_far, whole_logs
from bayessim_mjx.diagnosis.summary.details import details
from bayessim_mjx.diagnosis.summary.sentences import horizon_warning, sentences
from bayessim_mjx.logs.log import Channels

UNEXPLAINED = 1.5  # noise standard deviations that remain and that nothing predicts
LITTLE = 0.3  # share of the calibrated gap that named effects may leave
REMAINS = 0.3  # share of the calibrated gap that a flexible force closes on top of named effects: not in the library


def diagnosis_of(found: Findings, say: search.Progress = lambda text, done, total: None) -> Diagnosis:
    """The result of a diagnosis."""
    setup, race, ruling = found.setup, found.race, found.ruling
    model = ruling.model
    timestep = float(setup.robot.mj_model.opt.timestep) * (setup.discretisation.factor if setup.discretisation else 1)
    together = uncertainty.covariance(setup.fitter, model, found.weak_directions)
    together = together + np.diag(uncertainty.systematic(model, timestep, race.left(model)) ** 2)
    together = _told(found, together)
    sd = np.sqrt(np.diag(together))
    closed = effects_found.closed_by(found)
    effects = effects_found.effects_of(found, sd, closed, say)
    remains = _remains(found)
    far = how_far.measured(found, {k: v for k, v in closed.items() if k != "each"})
    name = _verdict(found, remains, far)
    parameters = _parameters(race, model, sd)
    say("whole logs", 0, 1)
    over = whole_logs.simulate(found)
    far = how_far.with_whole(far, over, setup.tolerance)
    return Diagnosis(
        verdict=name,
        sentences=sentences(name, effects, parameters, found, far, remains, _beaten(found)),
        effects=effects,
        where=_where(found),
        gap=far,
        parameters=parameters,
        candidates=ranking(race),
        warnings=[*setup.warnings, *over.notes, *(horizon_warning(far) if effects else [])],
        next_experiment={},
        versions=versions(),
        details=details(found, effects, closed),
        covariance={"names": list(model.fit.names), "matrix": together},
    )


def _told(found: Findings, covariance: np.ndarray) -> np.ndarray:
    """The covariance without what it says of parameters that end at a bound."""
    model, physics = found.ruling.model, found.setup.physics
    at = []
    for effect in model.effects:
        for c, value in zip(effect.coordinates, model.values_of(effect), strict=True):
            bound = bounds.of(physics, c, float(value))
            at += [model.fit.names.index(c.name)] if bound is not None and bound.kind != "off" else []
    neutral = np.array([c.neutral for c in model.fit.coordinates])
    return bounds.spread_out(covariance, model.fit.values, neutral, at)


def _remains(found: Findings) -> float:
    """Share of the calibrated gap that a flexible force still closes on top of the winner; 0 where not significant."""
    flex, race, model = found.flexible_winner, found.race, found.ruling.model
    if flex is None or not flex.condition.significant:
        return 0.0
    floor = race.noise * len(race.base.cost)
    top = model.total - min(float(flex.condition.cost.sum()), model.total)
    return float(top / max(race.base.total - floor, 1e-9))


def _verdict(found: Findings, remains: float, far: Gap) -> str:
    race, model = found.race, found.ruling.model
    if model.effects and far.beyond:
        return "unexplained"  # partly explained: what is left still matters
    cost = {k: float(p.cost(found.setup.fitter.simulator.windows.steps).mean()) for k, p in found.predictions.items()}
    left = cost["with_effects"] - 1.0
    if model.effects and left > UNEXPLAINED**2 - 1.0 and left > LITTLE * (cost["calibrated"] - 1.0):
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
    """Whether a flexible force alone predicts held-out conditions much better than the named effects do.

    By a relevant share of the gap too: of effects that close 99.9 % something is left that a force can learn.
    """
    race, base, model = found.race, found.flexible_base, found.ruling.model
    if base is None or not base.condition.significant:
        return False
    better = model.total - float(base.condition.cost.sum())
    above = race.base.total - race.noise * len(race.base.cost)
    return better > 0.4 * model.total and better > race.settings.relevance * above


def _parameters(race: search.Race, model: Model, sd: np.ndarray) -> dict[str, dict[str, Any]]:
    remarks = verdict.structural(race, model, sd)
    return {
        c.name: {
            "mean": float(model.fit.values[i]), "sd": float(sd[i]), "nominal": c.neutral, "low": c.low, "high": c.high,
            "unit": c.unit, "structural": remarks.get(c.name, ""),
        }
        for i, c in enumerate(race.fitter.base)
    }  # fmt: skip


def ranking(race: search.Race) -> list[dict[str, Any]]:
    """Models tried, best first: held-out score, nats over the known parameters alone, and its standard error."""
    rows = statistics.leave_one_out(race.fitter.simulator.windows.group)
    absorbed = {s.candidate.label: s.absorbed for s in race.screened}
    out: list[dict[str, Any]] = []
    tried = search.ranked(race)[:60]
    samples = tried[0].samples  # one for all, so that scores are in the order of the errors
    for model in tried:
        ratio = np.log((rows @ race.base.cost) / (rows @ model.cost))
        error = float(0.5 * samples * statistics.error(ratio)) if len(rows) else float("nan")
        out.append({
            "effects": [e.label for e in model.effects],
            "label": model.label,
            "score": 0.5 * samples * float(np.log(race.base.total / model.total)),
            "se": error,
            "gap_closed": race.closure(model),
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
    names = Channels.of(setup.physics.mj_model).qvel
    costs = np.stack([np.maximum(calibrated.cost(cut.steps, slice(i, i + 1)) - 1.0, 0.0) for i in range(len(names))], 1)
    total = costs.sum()
    if total <= 0.1 * costs.size:
        return []
    ends = statistics.interval_of_shares(costs, cut.group)
    out = [Place(n, float(costs[:, i].sum() / total), ends[i], "") for i, n in enumerate(names)]
    return sorted(out, key=lambda p: -p.share)


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
    from bayessim_mjx.diagnosis.residual import frequency, where

    if found.disturbance is None:
        return result
    fitter, fit = found.setup.fitter, found.race.base.fit
    places, maps, told = where.locate(fitter, fit, found.disturbance, seed=found.setup.seed)
    spectra, heard = frequency.analyse(fitter, fit, found.disturbance)
    more = result.details | {"maps": maps, "frequency": spectra}
    return replace(result, where=places or result.where, sentences=[*result.sentences, *told, *heard], details=more)


def _with_experiment(result: Diagnosis, found: Findings, folder: Path) -> Diagnosis:
    from bayessim_mjx.diagnosis.experiment import command_file, propose

    if not (found.ruling.model.effects or found.race.above_noise(found.race.base)):
        return result
    proposal = propose.propose(found.setup, found.race, found.ruling, seed=found.setup.seed)
    file = ""
    if proposal.chosen is not None:
        folder.mkdir(parents=True, exist_ok=True)
        file = command_file.write_command(folder / "next_experiment.csv", proposal, str(folder / "diagnosis.json")).name
    more = result.details | {"experiments": proposal.details()}
    return replace(result, next_experiment=proposal.to_dict(file), details=more)
