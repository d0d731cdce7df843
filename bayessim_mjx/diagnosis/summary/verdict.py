"""The verdict: whether what is named explains the gap, and what the rest is, where more of it remains than matters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.phrases.effects import CLEAR
from bayessim_mjx.diagnosis.residual.disturbance import Origin, origin
from bayessim_mjx.diagnosis.residual.regions import MENTIONED
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.numbers import FLOOR, ODDS, RELEVANCE
from bayessim_mjx.diagnosis.statistics import of_one, of_rms
from bayessim_mjx.diagnosis.summary.again import Whole
from bayessim_mjx.logs.log import Channels


@dataclass(frozen=True)
class Limits:
    """When a verdict says that something remains unexplained (docs/decisions/force_left.md has the counts).

    Attributes:
        share: of the squared gap above the noise. Effects that leave a missing force which makes more of it are not the
            explanation. Those that leave less are, though their law may be imperfect.
    """

    share: float = MENTIONED
    # chance that known parameters of a robot lie together as far from their data sheet as the named effects leave them,
    # were it so many times as inaccurate as stated (or as the least accurate ones, `data_sheet.WORST`, where nobody
    # stated it): below that the effects explain the motion of another robot. In 63 simulated cases in which something
    # was named the least was .0016, but for an unknown cause (6e-7)
    doubtful: float = 1e-4
    loose: float = 1.5


LIMITS = Limits()


@dataclass(frozen=True)
class Verdict:
    """Its name, and what it rests on.

    Attributes:
        remains: share of the gap that the missing force makes which the answer leaves, posterior mean; 0 where it is
            probably not relevant. chance: probability that it is.
        noise: where what remains comes from, if it is noise of the sensors larger than estimated; else None.
        bent: (known parameters far from the data sheet, of so many), where that is no chance; else (0, 0).
        builds_up: times what is likely, rms, that the error grows to over whole logs, where windows hardly show it;
            else 0. It is told, and has no part in the name.
    """

    name: str
    remains: float
    chance: float
    noise: Origin | None
    bent: tuple[int, int] = (0, 0)
    builds_up: float = 0.0


def verdict_of(found: Findings, far: Gap) -> Verdict:
    """Return the verdict on what was found; `far`: what remains of the gap."""
    force, (limit, gap) = found.selection.force, relevant(found, far)
    chance = force.chance(limit)
    probable = chance > ODDS.strong / (1.0 + ODDS.strong)
    noise = sensors_noise(found) if probable or force.noise > FLOOR**2 else None
    missing = probable and noise is None
    off = bent(found.model) if found.model.effects else (0, 0)
    # noise of the sensors excuses a remainder, and not that the effects close little of what is above it
    above = of_rms(far.calibrated, far.with_effects, math.sqrt(max(force.noise, 1.0)))
    little = bool(found.model.effects) and above.left > above.closed
    name = "unexplained" if missing or any(off) or little else _explained(found, far, noise)
    return Verdict(name, force.motion / gap if missing else 0.0, chance, noise, off, builds_up(found, far))


def relevant(found: Findings, far: Gap) -> tuple[float, float]:
    """(square that a missing force has to move to be relevant, squared gap that the answer had to close).

    Above the noise, in noise variances of each residual. The gap is that of joints which keep their speed where these
    do better than the recalibrated simulator: beside forces that are far off, effects that only keep it from moving
    close almost all of its gap.
    """
    before = min(far.calibrated, math.inf if far.coasting is None else far.coasting)
    gap = max(before**2 - found.selection.force.noise, RELEVANCE.noise)
    return (max(RELEVANCE.noise, LIMITS.share * gap) if found.model.effects else FLOOR**2 - 1.0), gap


def force_in_numbers(found: Findings, far: Gap) -> dict[str, Any]:
    """Return the missing force for JSON: by joint its rms in N m or N; evidence, share of the gap, relevance."""
    force, (limit, gap) = found.selection.force, relevant(found, far)
    names = Channels.of(found.setup.physics.mj_model).qvel
    rows = zip(names, force.amplitude, force.low, force.high, force.by_joint, strict=True)
    return {
        "joints": [{"joint": n, "rms": a, "low": low, "high": high, "share": s / gap} for n, a, low, high, s in rows],
        "nats": force.nats,
        "share": force.motion / gap,
        "share_ci": [end / gap for end in force.interval()],
        "relevant_share": limit / gap,
        "chance": force.chance(limit),
    }


def bent(model: Model) -> tuple[int, int]:
    """(Known parameters far from the data sheet, of so many), where that is no chance; else (0, 0)."""
    named = {c.name for effect in model.effects for c in effect.coordinates}
    pairs = zip(model.fit.coordinates, model.fit.values, strict=True)
    away = np.array([(v - c.neutral) * _precise(c) for c, v in pairs if c.stated and c.name not in named])
    likely = chi2.sf(np.sum((away / LIMITS.loose) ** 2), max(len(away), 1)) > LIMITS.doubtful
    return (0, 0) if likely else (int(np.sum(np.abs(away) > CLEAR)), len(away))


def _precise(c: Coordinate) -> float:
    """1 / standard deviation, as stated; of what nobody stated, that of the least accurate data sheet."""
    return c.precision**0.5 * (data_sheet.ACCURACY / data_sheet.WORST if c.kind else 1.0)


def builds_up(found: Findings, far: Gap) -> float:
    """How many times larger (rms) the error over whole logs is than noise, start and parameters make likely; else 0.

    Only where windows are at the noise, which begin anew at the measured state: where they show more, that is reported.
    A law that is not quite right may pass in them, but so may a right one with an integrator's error. So this is no
    reason for a verdict: in 207 simulated cases seven right laws had 2.4 to 4.1 times, four wrong ones 3.2 to 4.4.
    """
    over = found.part(Whole)
    if over is None or not len(over.beyond) or not found.model.effects:
        return 0.0
    return over.over_likely if over.over_likely > CLEAR and far.with_effects <= FLOOR else 0.0


def _explained(found: Findings, far: Gap, noise: Origin | None) -> str:
    """Return the verdict where no relevant force is missing.

    No gap is there too where the delivered simulator is at the noise, or where its time step makes most of the gap and
    no parameter is clearly off.
    """
    state, model = found.selection.state, found.model
    if model.effects:
        return "ambiguous" if found.selection.ambiguous else "effects"
    if noise is not None or found.selection.force.noise > FLOOR**2:
        return "noise"
    if "share" in far.integrator:
        own, neutral = found.selection.estimated, np.array([c.neutral for c in model.fit.coordinates])
        off = np.abs(own.mean - neutral) > CLEAR * np.sqrt(np.diag(own.covariance))
        if of_one(far.nominal**2).at_noise or (far.integrator["share"] > 0.5 and not off.any()):
            return "no_gap"
    calibrated = state.gap(state.base)
    q, _ = state.nominal.quadratic()
    nominal = of_one(float(q.c.sum()), calibrated.noise)
    return "parameters" if nominal.rms > FLOOR and nominal.after > 1.1 * calibrated.after else "no_gap"


def sensors_noise(found: Findings) -> Origin | None:
    """Where what remains comes from, if its covariance is that of noise of the sensors, and not that of forces."""
    missing, fit = found.disturbance, found.model.fit
    if missing is None:
        return None
    fitter = found.selection.state.fitter
    channels = int(fitter.used.sum())
    where = origin(fit.r, fit.B, missing.linear.D, found.selection.force.amplitude, channels, fit.weight, fitter.rate())
    return where if where.of_sensors else None
