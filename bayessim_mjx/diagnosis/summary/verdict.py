"""The verdict: whether what is named explains the gap, and what the rest is, where more of it remains than matters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.gap import of_one, of_rms
from bayessim_mjx.diagnosis.residual.origin import Origin, origin
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.numbers import FLOOR
from bayessim_mjx.diagnosis.summary.whole_logs import Whole


@dataclass(frozen=True)
class Limits:
    """When a verdict says that something remains unexplained.

    Rules of thumb, chosen on 22 recorded cases in which something was named: what is rightly named left 3 % of the gap
    at most, causes that the library lacks 8 to 60 %. Rates on later cases: benchmarks/records/diagnosis_fresh.json.
    """

    # noise standard deviations that remain: of a simulator without effects, and beside effects that leave a large
    # share (docs/decisions/at_noise.md)
    matters: float = 1.5
    shows: float = 1.2
    # share of the calibrated gap: named effects that leave more, or on top of which a flexible force closes more, are
    # not the explanation; what leaves less is, though its law may be imperfect
    share: float = 0.15
    # shares of the named effects' cost, and of the gap, by which a flexible force alone does better
    beaten: float = 0.4
    relevant: float = 0.05
    # chance that known parameters of a robot lie together as far from their data sheet as the named effects leave them,
    # were it so many times as inaccurate as stated (or as the least accurate ones, `data_sheet.WORST`, where nobody
    # stated it): below that the effects explain the motion of another robot. In 63 simulated
    # cases in which something was named the least was .0016, but for an unknown cause (6e-7)
    doubtful: float = 1e-4
    loose: float = 1.5
    far: float = 2.0  # standard deviations, from which on a known parameter is counted as far off
    # times that errors over whole logs are larger (rms, median of the logs) than noise, start and parameters make
    # likely: told from here on, and no reason for a verdict. In 207 simulated cases seven right laws had 2.4 to 4.1 and
    # four wrong ones 3.2 to 4.4: as a verdict it lost more than it found
    builds_up: float = 2.2


LIMITS = Limits()


@dataclass(frozen=True)
class Verdict:
    """Its name, and what it rests on.

    Attributes:
        remains: share of the calibrated gap that a flexible force still closes on top of the effects; 0 where not
            significant. beaten: whether a flexible force alone does much better than they do.
        noise: where what remains comes from, if nothing predicts it and no force does; else None.
        bent: (known parameters far from the data sheet, of so many), where that is no chance; else (0, 0).
        builds_up: times what is likely, rms, that the error grows to over whole logs, where windows hardly show it;
            else 0. It is told, and has no part in the name.
    """

    name: str
    remains: float
    beaten: bool
    noise: Origin | None
    bent: tuple[int, int] = (0, 0)
    builds_up: float = 0.0


def verdict_of(found: Findings, far: Gap) -> Verdict:
    """The verdict on what was found; `far`: what remains of the gap."""
    left, alone, noise = remains(found), beaten(found), sensors_noise(found)
    off = bent(found.model) if found.model.effects else (0, 0)
    name = _name(found, far, left, alone, noise)
    return Verdict("unexplained" if any(off) else name, left, alone, noise, off, builds_up(found, far))


def bent(model: Model) -> tuple[int, int]:
    """(Known parameters far from the data sheet, of so many), where that is no chance; else (0, 0)."""
    named = {c.name for effect in model.effects for c in effect.coordinates}
    pairs = zip(model.fit.coordinates, model.fit.values, strict=True)
    away = np.array([(v - c.neutral) * _precise(c) for c, v in pairs if c.stated and c.name not in named])
    likely = chi2.sf(np.sum((away / LIMITS.loose) ** 2), max(len(away), 1)) > LIMITS.doubtful
    return (0, 0) if likely else (int(np.sum(np.abs(away) > LIMITS.far)), len(away))


def _precise(c: Coordinate) -> float:
    """1 / standard deviation, as stated; of what nobody stated, that of the least accurate data sheet."""
    return c.precision**0.5 * (data_sheet.ACCURACY / data_sheet.WORST if c.kind else 1.0)


def builds_up(found: Findings, far: Gap) -> float:
    """How many times larger (rms) the error over whole logs is than noise, start and parameters make likely; else 0.

    Only where windows are within a few noises, which begin anew at the measured state: where they show more, that is
    what is told. A law that is not quite right may pass in them, but so may a right one with an integrator's error.
    """
    over = found.part(Whole)
    if over is None or not len(over.beyond) or not found.model.effects:
        return 0.0
    times = over.over_likely
    return times if times > LIMITS.builds_up and far.with_effects <= LIMITS.matters else 0.0


def _name(found: Findings, far: Gap, remaining: float, alone: bool, noise: Origin | None) -> str:
    state, model = found.selection.state, found.model
    if model.effects:
        matters = far.with_effects > LIMITS.shows or bool(far.beyond)
        little = of_rms(far.calibrated, far.with_effects).left <= LIMITS.share or noise is not None
        little = little and not standstill(far)
        structured = state.above_noise(model) and not remaining <= LIMITS.share  # NaN: all is on top
        if (matters and not little) or structured or (found.flexible_winner is not None and alone):
            return "unexplained"
        return "ambiguous" if found.selection.ambiguous else "effects"
    calibrated = state.gap(state.base)
    if calibrated.rms > LIMITS.matters:
        return "unexplained" if noise is None or remaining > LIMITS.share else "noise"
    if state.above_noise(state.base) and remaining > LIMITS.share:
        return "unexplained"
    q, _ = state.nominal.quadratic(state.fitter.spread)
    nominal = of_one(float(q.c.sum()), calibrated.noise)
    return "parameters" if nominal.rms > FLOOR and nominal.after > 1.1 * calibrated.after else "no_gap"


def standstill(far: Gap) -> bool:
    """Whether effects hardly do better than joints that keep their speed, in the place of a simulator that does worse.

    Beside forces that are far off, whatever hardly accelerates closes almost all of the gap. Noise of the sensors
    excuses nothing here: it is in both.
    """
    if far.coasting is None or far.coasting >= far.calibrated:
        return False
    return not of_rms(far.coasting, far.with_effects).left <= LIMITS.share  # also where they coast within the noise


def remains(found: Findings) -> float:
    """Share of the calibrated gap that a flexible force still closes on top of the winner; 0 where not significant."""
    flex, base, model = found.flexible_winner, found.selection.state.base, found.model
    if flex is None or not flex.condition.significant:
        return 0.0
    cost = float(model.plain.sum())  # as the force's is: of predictions, with nothing open
    top = cost - min(float(flex.condition.cost.sum()), cost)
    return of_one(float(base.plain.sum()), found.selection.state.noise * len(base.cost)).share(top)


def beaten(found: Findings) -> bool:
    """Whether a flexible force alone predicts held-out conditions much better than the named effects do.

    By a relevant share of the gap too: of effects that close 99.9 % something is left that a force can learn.
    """
    state, base, model = found.selection.state, found.flexible_base, found.model
    if base is None or not base.condition.significant:
        return False
    cost = float(model.plain.sum())
    better = cost - float(base.condition.cost.sum())
    share = of_one(float(state.base.plain.sum()), state.noise * len(state.base.cost)).share(better)
    return better > LIMITS.beaten * cost and share > LIMITS.relevant


def sensors_noise(found: Findings) -> Origin | None:
    """Where what remains comes from, if that is noise of the sensors, larger than estimated; None if not.

    A flexible force predicts nothing of it, neither in other conditions nor in between, and its covariance is not that
    of the trace of forces.
    """
    flex, missing = found.flexible_winner, found.disturbance
    if flex is None or missing is None or flex.condition.significant or flex.interpolation.significant:
        return None
    fit = found.model.fit
    fitter = found.selection.state.fitter
    channels = int(fitter.used.sum())
    where = origin(fit.r, fit.B, missing.linear.D, missing.amplitude, channels, fit.weight, fitter.rate())
    return where if where.of_sensors else None
