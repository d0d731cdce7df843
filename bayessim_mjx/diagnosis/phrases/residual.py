"""Residual forces in words: places, signatures, spectra, and the shares that flexible force and formula close."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_mjx.diagnosis.result import Diagnosis, Place
from bayessim_mjx.diagnosis.statistics import Gap, of_one, of_rms
from bayessim_mjx.quantities import MOST, count, finite, listed, percent

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.residual.black_boxes import BlackBoxes, Flexible
    from bayessim_mjx.diagnosis.residual.frequency import Heard
    from bayessim_mjx.diagnosis.residual.where import Fingerprint, Located

AXES = {
    "position": "position", "speed": "speed", "load": "gravity load", "effort": "effort", "time": "time in the log",
    "speed size": "speed", "load size": "gravity load (size)", "effort size": "effort (size)",
}  # fmt: skip
WITHOUT = "Without effects, "  # begins each sentence on the recalibrated simulator, before an effect is added
OPPOSITES = ("against/with", "more/less")  # of which a number's sign chooses one


@dataclass(frozen=True)
class Signature:
    """Words for a signature of the missing force: head with its joint, {name of a number: words after it}."""

    head: str
    terms: Mapping[str, str]


SIGNATURES = {
    "odd and even in speed": Signature(
        "the missing force at {joint} has a part of",
        {"constant": "against/with the motion at any speed", "linear": "against/with the motion, linear in speed",
         "quadratic": "against/with the motion, quadratic in speed", "offset": "in one direction at any speed",
         "even": "in one direction that grows with speed"},
    ),
    "load": Signature("the force against the motion at {joint} changes by", {"load": "of gravity load"}),
    "time": Signature(
        "in the course of a log the force at {joint} changes by",
        {"friction": "against the motion", "drift": "in one direction"},
    ),
    "time since reversal": Signature(
        "within {recent:.2g} s after reversals the force against the motion at {joint} is", {"recent": "more/less"}
    ),
    "lag": Signature(
        "the measured motion at {joint} lags behind the simulated one by",
        {"constant": "at any speed", "lag": "times the speed"},
    ),
}  # fmt: skip


def parted(d: Diagnosis) -> tuple[list[str], list[str]]:
    """Part the sentences below the first: those on the verdict, and those on the simulator without the named effects.

    Where no effect is named, the second are a part of the verdict.
    """
    first = [text for text in d.sentences[1:] if not (d.effects and text.startswith(WITHOUT))]
    return first, [text for text in d.sentences[1:] if text not in first]


def beside_effects(d: Diagnosis) -> str:
    """Say how much of the gap a flexible force closes beside the named effects, and whether that is relevant."""
    rms = (d.details.get("flexible") or {}).get("rms_on_winner")
    if not d.effects or not finite(rms):
        return ""
    stages = (of_rms(d.gap.calibrated, level).closed for level in (d.gap.with_effects, rms))
    now, with_force = stages
    rest, limit = max(with_force - now, 0.0), (d.details.get("force_left") or {}).get("relevant_share")
    said = f"Beside the named effects it closes {percent(rest)} of the squared gap above the noise"
    if not finite(limit):
        return f"{said}."
    if rest <= limit:
        return f"{said}. Relevant is more than {percent(limit)}: no further cause follows from it."
    return f"{said}, more than the relevant {percent(limit)}: a cause without a name remains."


def located(found: Located) -> list[str]:
    """One sentence for each joint's missing force, and for each signature of a known cause.

    All is of the recalibrated simulator, before an effect is added, and the sentences say so.
    """
    if not found.spots:
        return [f"{WITHOUT}the residual of the recalibrated simulator lies within the measurement noise."]
    text = []
    for spot in found.spots:
        forces = [
            f"{missing_force(leaf.mean, spot.unit, spot.along)} ({region(leaf.where, spot.units)})"
            for leaf in spot.leaves
        ]
        if spot.looked and not forces:
            forces = [f"{spot.size:.2g} {spot.unit} rms, in no simple region of the state"]
        text += [f"{WITHOUT}a force is missing at {spot.joint}: {'; '.join(forces)}."] if forces else []
    signs = [signature for f in found.prints if (signature := _signature(f))]
    return text + [f"{WITHOUT}{sign}." for sign in signs]


def places(found: Located) -> list[Place]:
    """Joints with their shares, and the first region of each."""
    return [Place(s.joint, s.share, s.ci, region(s.leaves[0].where, s.units) if s.leaves else "") for s in found.spots]


def region(limits: Iterable[tuple[str, bool, float]], units: Mapping[str, str]) -> str:
    """`speed below 0.2 rad/s, moving forward`, of (axis, above, limit); nested limits of one axis: the tighter one."""
    kept: dict[str, dict[bool, float]] = {}
    for axis, above, limit in limits:
        own = kept.setdefault(axis, {})
        own[above] = limit if above not in own else (max if above else min)(own[above], limit)
    return ", ".join(_side(axis, own, units[axis]) for axis, own in kept.items()) or "everywhere"


def _side(axis: str, own: Mapping[bool, float], unit: str) -> str:
    if axis == "direction":
        return "moving forward" if True in own else "moving backward"
    if axis == "time since reversal":
        ends = [f"{'later than' if above else 'within'} {limit:.2g} s" for above, limit in own.items()]
        return f"{' and '.join(ends)} after a reversal"
    if len(own) == 2:
        return f"{AXES[axis]} between {own[True]:.2g} and {own[False]:.2g} {unit}".rstrip()
    ((above, limit),) = own.items()
    return f"{AXES[axis]} {'above' if above else 'below'} {limit:.2g} {unit}".rstrip()


def missing_force(mean: float, unit: str, along: bool) -> str:
    """`0.3 N m against the motion`; with a sign where it does not go along with the motion."""
    return f"{abs(mean):.2g} {unit} {'against' if mean < 0 else 'with'} the motion" if along else f"{mean:+.2g} {unit}"


def _signature(found: Fingerprint) -> str:
    own, numbers = SIGNATURES[found.name], found.relevant
    parts = [
        signed(n.value, n.low, n.high, n.unit, words)
        for key, words in own.terms.items()
        if (n := numbers.get(key)) is not None
    ]
    return f"{own.head.format(joint=found.joint, recent=found.recent)} {', '.join(parts)}" if parts else ""


def signed(value: float, low: float, high: float, unit: str, phrase: str) -> str:
    """Return a number with its interval and phrase; its sign in words where the phrase has a place for it."""
    for pair in OPPOSITES:
        if pair in phrase:
            positive = value > 0
            shown = (value, low, high) if positive else (-value, -high, -low)
            return f"{bracketed(*shown, unit)} {phrase.replace(pair, pair.split('/')[0 if positive else 1])}"
    return f"{bracketed(value, low, high, unit)} {phrase}"


def bracketed(value: float, low: float, high: float, unit: str) -> str:
    """`0.3 [0.2, 0.4] N m`."""
    return f"{value:.2g} [{low:.2g}, {high:.2g}] {unit}"


def spectra(found: Sequence[Heard]) -> list[str]:
    """Name delays, orders and lines, joint by joint, and a line that several joints share."""
    each = [f"{WITHOUT}{text}." for heard in found for text in _heard(heard)]
    return each + _shared(found)


def _heard(found: Heard) -> list[str]:
    says, late = [], found.late
    if late.low > 0.0:
        ms = [f"{1e3 * x:.2g}" for x in (late.value, late.low, late.high)]
        says.append(
            f"the motion at {found.joint} follows the command {ms[0]} ms [{ms[1]}, {ms[2]}] later than simulated"
        )
    missing = f"the missing force at {found.joint}"
    if found.orders:
        top = max(found.orders, key=lambda t: t["amplitude"])
        size = f"{top['amplitude']:.2g} {found.unit}"
        says.append(f"{missing} repeats {top['order']} times per turn, amplitude {size}")
    if found.height:
        above = f"{found.height:.2g} times above its surroundings"
        says.append(f"{missing} has a line at {found.line_hz:.3g} Hz, {above}")
    return says


def _shared(found: Sequence[Heard]) -> list[str]:
    """Point to the mount where several joints have one line: no further apart than the spectra resolve."""
    hz = {heard.joint: heard.line_hz for heard in found if np.isfinite(heard.line_hz)}
    if len(hz) < 2 or max(hz.values()) - min(hz.values()) > found[0].picture["hz"][0]:
        return []
    mean, joints = float(np.mean(list(hz.values()))), listed(list(hz))
    return [f"The line near {mean:.3g} Hz is the same at {joints}: it points to the mount rather than to one joint."]


def flexible_of(found: Flexible, on: str) -> dict[str, Any]:
    """Return the numbers behind the sentences on a flexible force, for JSON.

    Args:
        on: the model that it is added to, `effects` or `recalibrated`.

    Returns:
        {"on", "held": {"condition", "interpolation": {"significant", "closed", "at_noise"}}, "joints", "inputs"}.
    """
    held = {}
    for name, own in (("condition", found.condition), ("interpolation", found.interpolation)):
        cost, noise = float(own.base.sum()), float(found.samples * len(own.base))
        gap = Gap(cost, cost - own.gain, noise)
        at_noise = of_one(cost, noise).at_noise
        held[name] = {"significant": bool(own.significant), "closed": gap.closed, "at_noise": at_noise}
    joints = [j for j, share in found.where.items() if share >= np.mean(list(found.where.values()))]
    usual = np.mean([d["importance"] for d in found.depends_on])
    inputs = [d["input"] for d in found.depends_on if d["importance"] >= usual > 0.0][:MOST]
    return {"on": on, "held": held, "joints": joints, "inputs": inputs}


def predicts(found: Mapping[str, Any]) -> bool:
    """Whether a flexible force predicts a part of the residual, held out one way or the other; `flexible_of`."""
    return any(held["significant"] for held in found["held"].values())


def flexible(found: Mapping[str, Any], one_log: bool = False) -> list[str]:
    """Say which part of a model's residual a flexible force removes, its place and its inputs; `flexible_of`."""
    names = ("by part of the log" if one_log else "by condition", "in time")
    held = dict(zip(names, (found["held"]["condition"], found["held"]["interpolation"]), strict=True))
    of = "with the effects" if found["on"] == "effects" else "of the recalibrated simulator"
    if not predicts(found):
        return [f"A flexible force of motion and effort predicts nothing of the residual {of} on held-out data."]
    if not (loud := {how: h for how, h in held.items() if not h["at_noise"]}):
        return [f"The residual {of} lies within the measurement noise; a flexible force still predicts a part of it."]
    (first, own), *others = loud.items()
    more = "".join(f"; held out {how}, {percent(h['closed'])}" for how, h in others)
    depends = f"depends on {listed(found['inputs'])}" if found["inputs"] else "is constant: it depends on no input"
    return [
        f"Held out {first}, a flexible force removes {percent(own['closed'])} of the squared residual {of}{more}.",
        f"This force acts at {listed(found['joints'])} and {depends}.",
    ]


def black_boxes(found: BlackBoxes | None, one_log: bool = False) -> list[str]:
    """Say which shares black boxes close of the gap beside the named effects; nothing where they were not tried."""
    if found is None:
        return []
    shares = [f"a small network without physics closes {_closes(found.network)} of the squared gap"]
    shares += [f"a formula of {count(len(found.terms), 'term')} {_closes(found.formula)}"]
    shares += [f"the named effects {_closes(found.named)}"] if found.named == found.named else []
    return [f"On held-out {'parts of the log' if one_log else 'conditions'} {listed(shares)}."]


def _closes(share: float) -> str:
    return percent(min(share, 1.0)) if share > 0 else "nothing"


def formula(found: BlackBoxes) -> list[str]:
    """`shoulder: -0.061 sign w + 0.3 q`, joint by joint; q, w, u: position, speed, effort in SI units."""
    each: dict[str, list[str]] = {}
    for term in found.terms:
        text = f"{term.force:+.3g} {term.what}".removesuffix(" 1")
        each.setdefault(term.joint, []).append(f"{text[0]} {text[1:]}")
    formulas = {joint: " ".join(terms).removeprefix("+ ") for joint, terms in each.items()}
    return [
        f"{joint}: {'-' if text.startswith('- ') else ''}{text.removeprefix('- ')}" for joint, text in formulas.items()
    ]
