"""Notes among the warnings of a diagnosis: on its preparation, its stages, whole logs and finer steps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Look
from bayessim_mjx.diagnosis.equation_error.search import Proposal
from bayessim_mjx.diagnosis.logcheck.drives import LEAST
from bayessim_mjx.diagnosis.logcheck.links import Channel
from bayessim_mjx.diagnosis.phrases.effects import CLEAR, any_of, measured, multiplied, titled
from bayessim_mjx.diagnosis.request import Tolerance
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.selection.numbers import RELEVANCE
from bayessim_mjx.diagnosis.statistics import of_one, of_rms
from bayessim_mjx.effects.support.words import spelt
from bayessim_mjx.odometry.base import Base
from bayessim_mjx.odometry.stand import Stand
from bayessim_mjx.quantities import EXACT, MOST, estimate, extent, finite, listed, number, percent

NEAR = math.log(1.2)  # of a ratio to 180 / pi, within which a wrong unit may be its cause; a rule of thumb, not counted
NO_TIME = "the time was over, so these are left out: "
STAGES = {"nominal": "as delivered", "calibrated": "recalibrated", "with_effects": "with the effects"}


def failed(stage: str, error: Exception) -> str:
    """Name a stage that failed with an error."""
    return f"{stage}: not available ({type(error).__name__}: {error})"


def out_of_time(warnings: Iterable[str], stage: str) -> tuple[str, ...]:
    """Return the warnings with a stage for which the time was over; one of them lists all such stages."""
    known = list(warnings)
    late = [text.removeprefix(NO_TIME) for text in known if text.startswith(NO_TIME)]
    return (*(text for text in known if not text.startswith(NO_TIME)), f"{NO_TIME}{', '.join([*late, stage])}")


def below_noise(allowed: Tolerance) -> list[str]:
    """Name the tolerances that are below the noise."""
    each = zip(allowed.names, allowed.units, allowed.limit, allowed.noise, allowed.given, strict=True)
    return [
        f"--tolerance {name}: {extent(limit, unit)} is below the noise, {extent(noise, unit)}: the noise is tolerated"
        for name, unit, limit, noise, own in each
        if own and limit < noise and finite(float(noise))
    ]


def rows(period: float, timestep: float, dt: float, fastest: bool) -> list[str]:
    """Say that logs are faster than the comparison, or than the model's steps.

    Args:
        period: of the logs' rows, timestep: of the model, dt: control period of the diagnosis; s.
        fastest: whether dt is the shortest that there is.
    """
    text = f"the logs have a row every {1e3 * period:.3g} ms"
    if fastest and period < dt * (1 - EXACT):
        return [f"{text}; one every {1e3 * dt:.3g} ms is compared"]
    if timestep > dt * (1 + EXACT):
        return [f"{text}, and the model steps {1e3 * timestep:.3g} ms: it is simulated at {1e3 * dt:.3g} ms"]
    return []


def conditions(count: int, one_log: bool) -> list[str]:
    """Say that few operating conditions were logged."""
    if one_log:
        return [
            "one log is one operating condition: parts of it are held out, so all numbers are in sample; "
            "no interval between conditions is given"
        ]
    return [f"{count} operating conditions: intervals are rough"] if count < 4 else []


def finer_steps(moved: Iterable[tuple[str, float, float, str, float]]) -> list[str]:
    """Name the effects' parameters that finer time steps would move clearly.

    Args:
        moved: (name, value, shift, unit, standard deviation) of each.
    """
    parts = [
        f"{name} {value + shift:.3g} in place of {value:.3g} {unit}".rstrip()
        for name, value, shift, unit, sd in moved
        if abs(shift) > CLEAR * sd
    ]
    text = "the time step of the simulator changes the parameters: finer steps would give"
    return [f"{text} {', '.join(parts)} (their intervals allow for it)"] if parts else []


def whole_logs(
    names: Sequence[str],
    chaotic: Sequence[str],
    broken: Sequence[str],
    seconds: float,
    away: Mapping[str, int],
    kept: int,
    seen: int,
) -> list[str]:
    """Say how far whole logs can be predicted, and which stages fail on them.

    Args:
        chaotic, broken: logs that no simulator predicts whole, and that diverge, among `names`.
        seconds: the longest time that counts. away: {stage: logs whose motion it leaves}, of `kept` logs.
        seen: logs that are simulated in sample.
    """
    out = []
    if chaotic:
        used = f"they count up to there, {seconds:.2g} s at most" if kept else "they are not counted"
        out.append(
            f"unstable or chaotic motion: in {_some(chaotic, names)} the uncertain start alone exceeds the tolerance. "
            f"No simulator can predict them whole: {used}"
        )
    if broken:
        out.append(f"simulated open loop, {_some(broken, names)} diverge: whole logs are compared without them")
    lost = [f"{STAGES[stage]} in {count} of {kept}" for stage, count in away.items() if count]
    if lost:
        text = "over whole logs the simulator leaves the measured motion"
        out.append(f"{text} ({', '.join(lost)}): the size of its error says little")
    if seen:
        text = f"{seen} of {len(names)} whole logs are simulated with parameters fitted to them"
        out.append(f"{text}: these errors are in sample")
    return out


def not_tried(short: Mapping[str, Any] | None) -> str:
    """Parts of the search that the time was too short for."""
    if not short:
        return ""
    text = f"In {short['minutes']:.3g} minutes not everything was tried: no time for {listed(short['parts'])}."
    before = f" Before the search, reading the logs and compiling took {short['before']:.2g} of them."
    return text + before * bool(short["before"])


def horizon_warning(far: Gap) -> list[str]:
    """Warn of a share closed that changes with the horizon: of one horizon its interval lies above another's."""
    loud = [row for row in far.horizons if not of_one(row["calibrated"] ** 2).at_noise]
    ends = [[of_rms(row["calibrated"], level).closed for level in row["ci"]["with_effects"]] for row in loud]
    differ = len(loud) > 1 and max(least for _, least in ends) > min(most for most, _ in ends) + RELEVANCE.share
    closed = {row["name"]: of_rms(row["calibrated"], row["with_effects"]).closed for row in loud}
    each = [f"{percent(share) if share > 0 else 'none'} ({name})" for name, share in closed.items()]
    return [f"the share of the gap that is closed depends on the horizon: {', '.join(each)}"] if differ else []


def _some(few: Sequence[str], names: Sequence[str]) -> str:
    return f"{len(few)} of {len(names)} logs ({listed(few, most=MOST)})"


def inertial(found: Sequence[Base], stands: Sequence[Stand | None]) -> list[str]:
    """Say how well the motion of a floating base was estimated, or what inertial units show of a fixed one.

    Args:
        found: the estimates; stands: of each log, None where there is no unit or the base floats.
    """
    seen = [stand for stand in stands if stand is not None]
    fixed, moving = (list(dict.fromkeys(n for s in seen for n in getattr(s, key))) for key in ("sensors", "others"))
    lean, shake = (max((x for s in seen if finite(x := getattr(s, k))), default=0.0) for k in ("lean", "shake"))
    out = []
    if fixed:
        out += [
            f"{listed(fixed)}: the base is fixed in the model, so they are not compared. The base leans by "
            f"{extent(lean, 'rad')} from the model's vertical and turns by {number(shake)} rad/s (rms)"
        ]
    if fixed and lean > CLEAR * seen[0].sd_lean:
        out += ["the base leans more than an accelerometer's usual bias: tilt the model's gravity or its base"]
    if moving:
        out += [f"{listed(moving)}: not compared, for other channels measure the motion of the bodies that carry them"]
    out += [f"inertial units are set aside: {text}" for text in dict.fromkeys(s.unplaced for s in seen) if text]
    if not found:
        return out
    names = listed([s.label for s in found[0].sensors])
    tilt, height = (float(np.max([np.median(b.sd_qpos[:, i]) for b in found])) for i in (3, 2))
    spread, mean = np.max([b.sd_gyro_bias for b in found], 0), np.mean([b.gyro_bias for b in found], 0)
    resting = float(np.mean([b.points.rests.any(axis=1).mean() for b in found]))
    return [
        f"the floating base was not measured. {names} and feet at rest on level ground give its tilt (sd "
        f"{extent(tilt, 'rad')}) and height (sd {extent(height, 'm')}). Feet rest in {percent(resting)} of the rows. "
        "Its place on the ground and its heading are unknown: they are not compared",
        f"the gyroscope's bias is {listed([estimate(m, s) for m, s in zip(mean, spread, strict=True)])} rad/s in the "
        "base's frame; its rates are compared without it. The accelerometer serves the estimate alone",
    ]


NO_REPEATS = "no run was repeated: these logs do not show how much of the gap is chance"


# The check by inverse dynamics, before any simulation, in lines: command, effort, motion, first guesses


def first_look(look: Look) -> list[str]:
    """Most important first."""
    if not look.joints:
        return ["effort -> motion: no joint with a known effort moved freely enough to be compared"]
    out = [first_verdict(look), _channels(look.channels)] if look.channels else []
    out.append(_mechanism(look))
    out += [_proposal(p) for p in look.proposals]
    if look.proposals:
        out.append(f"together these guesses explain {percent(look.explained)} of the squared residual effort")
    if look.shifts:
        moved = [f"{s.what} of {s.where} {percent(s.share, sign=True)} ({abs(s.away):.1f} sd)" for s in look.shifts]
        out.append(f"known parameters far from the data sheet: {listed(moved, most=MOST)}")
    if look.unit != 1.0:
        out.append(f"the logged efforts have another unit: 1 of it is about {look.unit:.3g} of the model's")
    # a sound channel contradicts many effects for one reason, which the channel's line gives
    out += [
        f"contradicted: {titled(*label.rsplit('@', 1))}: {why}"
        for label, why in look.vetoes.items()
        if label.startswith("actuator_gain@")
    ]
    if look.unknown:
        names = listed(look.unknown, most=MOST)
        out.append(f"these logs determine the mass of {names} no better than the data sheet does")
    return out


def first_verdict(look: Look) -> str:
    """Tell the actuators' channel and the mechanism apart, in one sentence; nothing where no effort was measured."""
    if not look.channels:
        return ""
    shown = [c for c in look.channels if c.identified]
    obey = all(c.sound for c in shown)
    motors = "the motors follow their commands" if obey else "the motors do not follow their commands"
    motors = motors if shown else "the encoders are too coarse to check the motors"
    measured_ = [j for j in look.joints if j.source == "effort"]
    if not measured_:
        return motors
    fits = all(j.nominal < 3 * LEAST for j in measured_)
    ratios = [j.needs for j in measured_ if math.isfinite(j.needs)]
    mean = math.exp(sum(math.log(max(r, 1e-3)) for r in ratios) / max(len(ratios), 1))
    if fits:
        mechanism = "the mechanism moves as the model predicts"
    elif mean > 1 + LEAST:
        mechanism = "the mechanism is heavier or stiffer than the model"
    elif mean < 1 - LEAST:
        mechanism = "the mechanism is lighter than the model"
    else:
        mechanism = "the mechanism differs from the model"
    return f"{motors}, {'and' if obey == fits else 'but'} {mechanism}"


def _channels(every: Sequence[Channel]) -> str:
    found = [c for c in every if c.identified]
    if not found:
        return "command -> effort: unknown: encoder noise hides the efforts that the servos' law gives"
    off = [c for c in found if not c.sound]
    late = 1e3 * max(abs(c.late) for c in found)
    if not off:
        low, high = min(c.scale for c in found), max(c.scale for c in found)
        echo = "; the logged effort is the command itself, not a measurement" if any(c.echo for c in found) else ""
        return f"command -> effort: {low:.2f} to {high:.2f} of the command, at most {late:.0f} ms late{echo}"
    parts = [
        f"{c.actuator} {c.scale:.2f} of it, {1e3 * c.late:.0f} ms late, {percent(c.left)} otherwise" for c in off[:MOST]
    ]
    others = len(found) - len(off)
    rest = f"; {others} as commanded" if others else ""
    more = f"; {len(off) - MOST} more" if len(off) > MOST else ""
    return f"command -> effort: not as commanded: {'; '.join(parts)}{more}{rest}"


def _mechanism(look: Look) -> str:
    source = {j.source for j in look.joints} - {"none"}
    only = "effort -> motion" if source == {"effort"} else "command -> motion"
    name = "effort or command -> motion" if len(source) > 1 and "effort" in source else only
    worst = sorted(look.joints, key=lambda j: -j.nominal)
    if worst[0].nominal < LEAST:
        return f"{name}: the model explains the motion of every joint to {percent(worst[0].nominal)} of the effort"
    unlike = [j for j in worst if abs(j.needs - 1) > LEAST]  # NaN: unknown
    off = {j.name: f" (effort over the model's: {j.needs:.2f})" for j in unlike}
    parts = [f"{j.name} {percent(j.nominal)}{off.get(j.name, '')}" for j in worst[:MOST] if j.nominal >= LEAST]
    after = max(j.left for j in look.joints)
    tail = f"; at most {percent(after)} with the guesses below" if look.proposals else ""
    factors = {j.name: abs(math.log(j.needs)) for j in look.joints if j.source == "ctrl" and j.needs > 0}
    turned = [n for n, factor in factors.items() if abs(factor - math.log(math.degrees(1))) < NEAR]
    unit = f". {listed(turned, most=MOST)} differs by the factor of rad to deg: is its unit right?" if turned else ""
    return f"{name}: effort that the model does not explain (rms): {', '.join(parts)}{tail}{unit}"


def _proposal(p: Proposal) -> str:
    each = [(k, v, sd if (sd := p.deviations[k]) < 1e6 else None) for k, v in p.parameters.items() if v]
    own = p.term.modelled
    numbers = ", ".join(multiplied(own[k], v, sd) if k in own else f"{spelt(k)} {measured(v, sd)}" for k, v, sd in each)
    rivals = any_of(p.rivals, MOST)
    return f"first guess: {titled(p.term.effect, p.term.where)}: {numbers}{f'; or {rivals}' if rivals else ''}"
