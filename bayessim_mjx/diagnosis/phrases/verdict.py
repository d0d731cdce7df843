"""The verdict in sentences, from the numbers of a `Diagnosis` alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from bayessim_mjx.diagnosis.phrases import advice, notes, parameters, residual
from bayessim_mjx.diagnosis.phrases import effects as named
from bayessim_mjx.diagnosis.result import Diagnosis, Gap
from bayessim_mjx.diagnosis.selection.numbers import ODDS, RELEVANCE
from bayessim_mjx.diagnosis.statistics import above_noise, of_one, of_rms
from bayessim_mjx.quantities import MOST, count, extent, finite, listed, percent

SHARES = ("predicted", "realised", "elsewhere")  # of `Gap.closed`; effects that widen the gap close none
HEADS = {
    "no_gap": "No gap above the noise: the logs differ from the simulator by {nominal}.",
    "parameters": "Only parameters are off: recalibration reduces the gap from {nominal} to {calibrated}.",
    "noise": "The noise is larger than estimated: no effect and no force predicts the residual of the recalibrated "
    "simulator, {calibrated}.",
    "unexplained": "No effect of the library explains the gap: recalibration leaves {calibrated}.",
}
TIME_STEP = (
    "No gap but the time step: at {own} the simulator as delivered differs from the logs by {nominal}. Simulated by "
    "{used} it differs by {otherwise} noise sd."
)
CLOSE = " No parameter is clearly off: recalibration leaves {calibrated}."
STEP_TOO = (
    "Parameters and the time step are off: recalibration and {used} reduce the gap from {nominal} to {calibrated}."
)
BOTH_STEPS = (
    "Before recalibration the gap is {delivered} noise sd at {own} as delivered, and {otherwise} noise sd by {used}. "
    "All further numbers are by {used}."
)
EITHER = (
    "Either the data sheet is wrong, or the cause is {effects}. The probability of a wrong data sheet is {own}. "
    "To separate them, measure {parameters} and state the accuracy (--accuracy). Recalibration reduces the gap "
    "from {nominal} to {calibrated}."
)
SMALL = " This exceeds the noise, but is too small to identify a cause."  # where the residual is above the noise
PARTLY_HEAD = "Partly explained: {named}."
PART = "The library explains only a part of the gap that recalibration leaves, {calibrated}."
REST = "More than the tolerance remains at {beyond}."
IMPERFECT = "No candidate closes the rest, {rest} of the squared gap: the law is not quite that of the real system."
LEFT = (
    "Of the squared gap above the noise {they} {leave} {rest}. The cause of this rest is unknown; it is within the "
    "tolerance."
)
NEAREST = "Nearest effects of the library: {nearest}."
LITTLE = "At most half is closed: {they} {explain} little of the gap."
ON_TOP = "Beside {them} a force is missing: that force makes {remains} of the squared gap."
LARGER = "Beside {them} a force is missing, and it makes more than the whole squared gap."
FALLS = (
    "On held-out {held} {they} {reduce} the gap from {calibrated} to {with_effects}. This closes {shown} of the "
    "squared gap above the noise."
)
PROMISED = (
    "Before any fit, one linear step predicted {predicted}. {nested} without each {one} in turn, {they} {close} "
    "{realised} (floor: the noise of the residuals)."
)
ELSEWHERE = (
    "Chosen without each {one} in turn, but fitted to all, {they} {close} {elsewhere}. Both shares may be a little too "
    "high. The choice compared models that were fitted to all {held}."
)
IN_SAMPLE = "These numbers are in sample: one log is one operating condition, and other conditions may differ."
WITHIN = "Every joint is within its tolerance. The closest is {within}."
PROBABLE = (
    "Probability among all fitted explanations: {own} for this one, {others}, {nothing} for the known parameters alone."
)
WITH_MORE = " Sets with {effects} as well have {more} of it. In the named set, known parameters replace that."
BEHIND = (
    "The held-out score alone ranks it {rank} of {count}, {behind} nats behind the first{error}. The verdict goes by "
    "the probability."
)
FURTHER = (
    "Ahead by the held-out score: {sets} with further effects. These close at most {more} more of the gap, less than "
    "the relevant {share}, and so count as this one."
)
PAST = "The missing force depends on something else, such as the past of the motion."
SPLITS = "To separate the explanations, run the next experiment: {name}."
HIDDEN = (
    "There may also be {hidden}. These logs would not show it: other numbers of the named {effect} give almost "
    "the same motion."
)
BUILDS_UP = (
    "Over whole logs the error is {times} times as large as noise, start and parameters explain. Within {window} it "
    "hardly shows. The law or the simulator's time step is not quite right."
)
BENT = (
    "The effects need {far} of {known} known parameters far from the data sheet. Less than 1 of 10 000 robots is so by "
    "chance, even if the data sheet is half as inaccurate again as stated. Something else may be missing, or the data "
    "sheet is of another robot (--accuracy, --parameters)."
)
ALLOWED = "Standard deviations allow for other simulators, which no data reduce. By the logs alone: {each}."
OF_SENSORS = "The residual has the covariance of sensor noise, {colour}."
CHANCE = (
    "No candidate and no flexible force predicts the residual, {calibrated}, on held-out {held}. Possible causes: "
    "process noise, an input that was not logged, or noise larger than estimated."
)
COASTS = (
    "Without any simulator, joints that keep their speed are {coasting} noise sd off, less than the recalibrated "
    "simulator's {calibrated}. Its forces are far off, or hardly show in such short windows.{more}"
)
COASTS_CLOSED = " The effects close {closed} of the squared gap of such joints."


def sentences(d: Diagnosis) -> list[str]:
    """Return the verdict, most important first; each number is one of the result's."""
    far, basis = d.gap, d.basis
    texts = [_head(d), *_how_far(d), *_doubts(d), coasting(far, bool(d.effects)), _probable(d), _behind(d)]
    ambiguous = [found for found in d.answers if len(found["members"]) > 1]
    texts += [SPLITS.format(name=d.next_experiment["name"])] if any(a["splits"] for a in ambiguous) else []
    members = {label for a in d.answers for m in a["members"] for label in m["effects"]}
    hidden = [label for label in d.hidden if label not in members]  # a class already says that they are not separated
    effect = "effect" if len(d.effects) == 1 else "effects"
    texts += [HIDDEN.format(effect=effect, hidden=named.any_of(hidden, MOST))] if hidden else []
    texts += _noise(d)
    if d.verdict == "unexplained" and basis.get("flexible"):
        texts += residual.flexible(basis["flexible"], far.in_sample)
        texts += [PAST] if basis.get("remains") and not residual.predicts(basis["flexible"]) else []
    if basis.get("efforts"):
        texts.append(f"By the logged efforts alone, {basis['efforts']}.")
    ends = [e for e in d.effects if any(v.bound not in ("", "off") for v in e.parameters.values())]
    texts += [f"At its bound: {named.titled(e.name, e.where)}. {e.sentence}" for e in ends]
    texts += parameters.remarks(d.parameters, said=d.verdict == "parameters")
    texts += [named.not_on_offer(basis["tried"])] if d.verdict == "unexplained" and basis.get("tried") else []
    return [text for text in [*texts, notes.not_tried(basis.get("not_tried"))] if text]


def _head(d: Diagnosis) -> str:
    """Return the first sentence: the verdict with the place and the numbers of each effect."""
    far, fill = d.gap, _fill(d)
    if not d.effects or d.verdict not in ("effects", "ambiguous", "unexplained"):
        quoted = {"no_gap": far.nominal, "parameters": far.calibrated}.get(d.verdict)
        above = quoted is not None and not of_one(quoted**2).at_noise
        head = HEADS["no_gap"].partition(": ")[2] if above and d.verdict == "no_gap" else HEADS[d.verdict]
        if d.verdict == "no_gap" and advice.time_step(d):
            head, above = TIME_STEP + CLOSE * (not of_one(far.integrator["otherwise"] ** 2).at_noise), False
        head = STEP_TOO if d.verdict == "parameters" and _step_shows(d) else head
        known = d.parameters if d.verdict == "parameters" else {}
        instead = parameters.stand_ins(known)
        far_off = [] if instead else parameters.far_from_model(known)
        if instead:
            chance = d.basis.get("probability")
            own = percent(chance["answer"]) if chance else "unknown"  # to files of before
            either = {"parameters": parameters.standing(known), "own": own}
            head, fill = EITHER, fill | either | {"effects": instead}
        first = named.capital((head + SMALL * above).format(**fill))
        return " ".join([first + _acts(d), *far_off])
    if d.verdict == "unexplained":
        head = HEADS["unexplained"] if advice.little(d) else PARTLY_HEAD if far.beyond else PART
        head += f" {REST}" if far.beyond else ""
        return head.format(named=named.lacking(d.effects), **fill) + _acts(d)
    several = {a["effect"]: a for a in d.answers if len(a["members"]) > 1}
    open_ = [named.answer(e, several[label]) for e in d.effects if (label := f"{e.name}@{e.where}") in several]
    sure = [e for e in d.effects if f"{e.name}@{e.where}" not in several]
    parts = [named.capital(named.lacking(sure)) + "."] if sure else []
    parts += [*open_, *(parameters.far_from_model(d.parameters) if d.accuracy else ())]
    return " ".join([*parts, *([REST.format(**fill)] if far.beyond else [])])


def _step_shows(d: Diagnosis) -> bool:
    """Whether the delivered time step makes a relevant share of the squared gap."""
    return bool(d.gap.integrator.get("share", 0.0) > RELEVANCE.share)


def _acts(d: Diagnosis) -> str:
    """Return the place of a force that is missing beside all effects; "" where none predicts the residual."""
    force = d.basis.get("flexible") or {}
    known = d.verdict == "unexplained" and force.get("joints") and residual.predicts(force)
    return f" A force is missing at {listed(force['joints'], most=3)}." if known else ""


def _fill(d: Diagnosis) -> dict[str, str]:
    """Numbers and forms of words that texts have places for."""
    far, one, step = d.gap, len(d.effects) == 1, d.gap.integrator
    worst = _worst(far)
    return {s: stage(far, s) for s in ("nominal", "calibrated", "with_effects")} | {
        "them": "it" if one else "them",
        "they": "the effect" if one else "the effects",
        "reduce": ("raise" if far.with_effects > far.calibrated else "reduce") + "s" * one,
        "explain": "explains" if one else "explain",
        "held": "parts of the log" if far.in_sample else "conditions",
        "one": "part of the log" if far.in_sample else "condition",
        "beyond": listed([_left(n, far.physical[n]) for n in worst if n in far.beyond], most=3),
        "within": _within(far),
        "shown": percent(of_rms(far.calibrated, far.with_effects).closed),
        "nested": "Chosen and fitted" if far.closed.get("nested") else "Fitted",
        "close": "closes" if one else "close",
        "leave": "leaves" if one else "leave",
        "rest": percent(of_rms(far.calibrated, far.with_effects).left),
        **{k: percent(max(v, 0.0)) for k, v in far.closed.items() if k in SHARES and finite(v)},
        "own": f"{1e3 * step.get('timestep', 0.0):.3g} ms ({step.get('delivered')})",
        "used": f"{step.get('integrator')} at {1e3 * step.get('substep', 0.0):.3g} ms",
        "otherwise": number(step.get("otherwise", 0.0)),
        "delivered": number(far.nominal),
    }


def _how_far(d: Diagnosis) -> list[str]:
    """Return the gap before and after, the shares closed, and the joints against their tolerances."""
    far, basis, out = d.gap, d.basis, []
    left = of_rms(far.calibrated, far.with_effects).left
    if d.effects:
        little = advice.little(d)
        nearest = d.verdict == "unexplained" and (little or not far.beyond)
        out += [NEAREST.replace("{nearest}", "; ".join(map(named.line, d.effects)))] if nearest else []
        out.append(FALLS)
        if d.verdict == "unexplained":
            out += [LITTLE] if little else []
            remains = basis.get("remains") or 0.0
            out += [(ON_TOP if remains <= 1 else LARGER).replace("{remains}", percent(remains))] if remains > 0 else []
        out += [IMPERFECT] if far.beyond and d.verdict != "unexplained" and left > 0 else []
        loud = left > RELEVANCE.share and not of_one(far.with_effects**2).at_noise
        out += [LEFT] if loud and not far.beyond and d.verdict != "unexplained" else []
        out += [PROMISED] if finite(far.closed.get("realised")) else []
        out += [ELSEWHERE] if finite(far.closed.get("elsewhere")) else []
    out += [BOTH_STEPS] if _step_shows(d) and not (d.verdict == "no_gap" and advice.time_step(d)) else []
    out += [IN_SAMPLE] if far.in_sample else []
    if d.verdict == "unexplained" and not d.effects:
        rest = [_left(n, far.physical[n]) for n in _worst(far) if "largest" in far.physical[n]]
        out += [f"After recalibration these errors remain: {listed(rest[:3])}."] if rest else []
    out += [_by_joint(far, bool(d.effects))] if len(far.physical) > 1 and d.verdict != "no_gap" else []
    out += [WITHIN] if d.effects and _within(far) and not far.beyond else []
    fill = _fill(d)
    return [text.format(**fill) for text in out]


def _doubts(d: Diagnosis) -> list[str]:
    far_off, known = d.basis.get("far_off") or (0, 0)
    out = [BENT.format(far=far_off, known=known)] if known else []
    if d.basis.get("builds_up"):
        times, window = f"{d.basis['builds_up']:.2g}", f"{d.basis['window']:.2g} s"
        out.append(BUILDS_UP.format(times=times, window=window))
    known_by = [
        (named.titled(e.name, e.where), p.sd, math.sqrt(max(p.sd**2 - p.allowed**2, 0.0)), p.unit)
        for e in d.effects
        for p in [*e.parameters.values()][:1]
        if finite(p.sd) and 2 * p.allowed**2 > p.sd**2
    ]
    scaled = [
        (name, 1e3 * sd, 1e3 * own, "ms") if unit == "s" else (name, sd, own, unit) for name, sd, own, unit in known_by
    ]
    each = [f"{own:.2g} of the {f'{sd:.2g} {unit}'.rstrip()} of {name}" for name, sd, own, unit in scaled]
    out += [ALLOWED.format(each=listed(each, most=3))] if each else []
    return out


def _noise(d: Diagnosis) -> list[str]:
    """Whether the residual is noise of the sensors, or chance that nothing predicts."""
    memory, fill = d.basis.get("noise_memory"), _fill(d)
    if memory is not None and (d.verdict == "noise" or d.gap.beyond or not of_one(d.gap.with_effects**2).at_noise):
        return [OF_SENSORS.format(colour=f"correlated over about {1e3 * memory:.2g} ms" if memory else "white")]
    predicted = bool(d.basis.get("flexible")) and residual.predicts(d.basis["flexible"])
    return [CHANCE.format(**fill)] if d.basis.get("above_noise") and not d.effects and not predicted else []


def _probable(d: Diagnosis) -> str:
    """Return the probability of the named effects, where they are the explanation."""
    chance = d.basis.get("probability")
    if not chance or not d.effects or (d.verdict == "unexplained" and not d.gap.beyond):
        return ""
    own, others, nothing = (percent(chance[k]) for k in ("answer", "rivals", "nothing"))
    nothing = nothing if nothing.strip("0. %") else "less than one in a million"  # by the digits of `percent`
    others = f"{others} for its rivals together" if chance["rivals"] else "which has no rival"
    return PROBABLE.format(own=own, others=others, nothing=nothing) + _with_more(d)


def _with_more(d: Diagnosis) -> str:
    """Say where sets with further effects have most of the probability of the named effects."""
    own = {f"{e.name}@{e.where}" for e in d.effects}
    larger = {frozenset(s["effects"]) - own: s["probability"] for s in d.evidence if own < {*s["effects"]}}
    whole = sum(larger.values())
    if not larger or 2 * whole <= d.basis["probability"]["answer"]:
        return ""
    likeliest = max(larger.items(), key=lambda item: item[1])[0]
    more = [label.split("@") for label in sorted(likeliest)]
    return WITH_MORE.format(more=percent(whole), effects=named.all_of(more))


def _behind(d: Diagnosis) -> str:
    """Say where another set has a clearly better held-out score, which the ranked candidates show."""
    rank = d.rank
    if rank in (None, 1) or not _probable(d):
        return ""
    first, own = d.candidates[0], d.candidates[rank - 1]
    ahead = [c for c in d.candidates[: rank - 1] if c["score"] - own["score"] >= math.log(ODDS.strong)]
    if not ahead:
        return ""
    if all(counts_as_answer(d, c) for c in ahead):
        ahead = [c for c in d.candidates[: rank - 1] if counts_as_answer(d, c)]
        more = percent(max(0.0, *(c["gap_closed"] - own["gap_closed"] for c in ahead)))
        return FURTHER.format(sets=count(len(ahead), "set"), more=more, share=percent(RELEVANCE.share))
    error = f" (standard error {first['se']:.0f})" if finite(first.get("se")) else ""
    return BEHIND.format(rank=rank, count=len(d.candidates), behind=f"{first['score'] - own['score']:.0f}", error=error)


def counts_as_answer(d: Diagnosis, candidate: Mapping[str, Any]) -> bool:
    """Whether a set holds the named effects and others that close an irrelevant share of the gap (docs/evidence.md)."""
    named, own = {f"{e.name}@{e.where}" for e in d.effects}, d.candidates[(d.rank or 1) - 1]
    if d.rank is None or not named < set(candidate.get("effects") or []):
        return False
    more = (candidate.get("gap_closed") or math.nan) - (own.get("gap_closed") or math.nan)
    return bool(more < RELEVANCE.share)


def coasting(far: Gap, named: bool) -> str:
    """Where no simulator at all predicts better than the recalibrated one."""
    if far.coasting is None or not far.coasting < far.calibrated:
        return ""
    closed = of_rms(far.coasting, far.with_effects).closed
    more = COASTS_CLOSED.format(closed=percent(max(closed, 0.0))) if named and finite(closed) else ""
    return COASTS.format(coasting=number(far.coasting), calibrated=number(far.calibrated), more=more)


def stage(far: Gap, name: str) -> str:
    """`1.2 deg (2.1 % of the motion, 27.0 noise sd)`; of several joints the share alone."""
    parts = [f"{percent(far.shares[name])} of the motion"] if name in far.shares else []
    level = getattr(far, name)
    within = [", within the noise"] if of_one(level**2).at_noise else [""]
    noises = f"{number(level)} noise sd{within[0]}"
    if len(far.physical) == 1:
        (row,) = far.physical.values()
        return f"{extent(row[name], row['unit'])} ({', '.join([*parts, noises])})"
    return f"{parts[0]} ({noises})" if parts else noises


def _worst(far: Gap) -> list[str]:
    """Joints, the largest error against its tolerance first."""

    def against(row: Mapping[str, Any]) -> float:
        return float(row["with_effects"] / row["tolerance"]) if row.get("tolerance") else 0.0

    return sorted(far.physical, key=lambda n: -against(far.physical[n]))


def _left(name: str, row: Mapping[str, Any]) -> str:
    """`elbow: 1.2 deg rms, 3.4 deg at most (2.1 % of its motion; tolerance 0.8 deg)`."""
    unit = row["unit"]
    most = f"{extent(row['with_effects'], unit)} rms, {extent(row['largest'], unit)} at most"
    part = f"{percent(row['with_effects'] / row['motion'])} of its motion; " if row["motion"] else ""
    return f"{name}: {most} ({part}tolerance {extent(row['tolerance'], unit)})"


def _within(far: Gap) -> str:
    """Return the joint that is closest to its tolerance."""
    name = next((n for n in _worst(far) if far.physical[n].get("tolerance")), "")
    if not name:
        return ""
    row = far.physical[name]
    noise, unit = row.get("noise", 0.0), row["unit"]
    above, limit = float(above_noise(row["with_effects"], noise)), max(row["tolerance"], noise)
    part = f" ({percent(limit / row['motion'])} of its motion)" if row["motion"] else ""
    return f"{name}: {extent(above, unit)} above the noise, tolerance {extent(limit, unit)}{part}"


def _by_joint(far: Gap, effects: bool) -> str:
    """`By joint, without and with the effects: elbow 1.2 deg to 0.05 deg; ...`, the worst first."""
    stages = ("calibrated", "with_effects") if effects else ("nominal", "calibrated")
    words = "without and with the effects" if effects else "before and after recalibration"
    names = _worst(far)
    rows = [
        f"{n} {' to '.join(extent(far.physical[n][s], far.physical[n]['unit']) for s in stages)}" for n in names[:MOST]
    ]
    more = f"; {len(names) - MOST} more in the table" if len(names) > MOST else ""
    return f"By joint, {words}: {'; '.join(rows)}{more}."


def number(value: float) -> str:
    """Three digits, in plain notation."""
    return f"{value:.2f}" if value < 9.995 else f"{value:.1f}" if value < 99.95 else f"{value:.0f}"
