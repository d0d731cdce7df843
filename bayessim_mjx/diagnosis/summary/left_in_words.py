"""What named effects leave, in words: what a flexible force makes of it, and what its spectrum shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.gap import Gap, of_one
from bayessim_mjx.diagnosis.residual.black_boxes import BlackBoxes
from bayessim_mjx.diagnosis.residual.flexible import Flexible
from bayessim_mjx.diagnosis.residual.frequency import Heard
from bayessim_mjx.diagnosis.residual.where import LIMITS, Fingerprint, Located
from bayessim_mjx.diagnosis.result import Place
from bayessim_mjx.effects.support.words import words
from bayessim_mjx.quantities import listed, percent


@dataclass(frozen=True)
class Rules:
    """What is worth a word of a flexible force."""

    important: float = 0.1  # share of the gain that an input must carry to be named


RULES = Rules()


def flexible_in_words(found: Flexible, one_log: bool = False) -> list[str]:
    """How much of what is left a flexible force removes, where it acts, and what it depends on."""
    others = ("other parts of the log", "the same parts at other times")
    names = others if one_log else ("other operating conditions", "the same conditions at other times")
    held = dict(zip(names, (found.condition, found.interpolation), strict=True))
    if not any(h.significant for h in held.values()):
        return ["a flexible force finds nothing more that would hold on data not used for fitting"]
    sums = {how: (float(h.base.sum()), found.samples * len(h.base)) for how, h in held.items()}
    gaps = {how: Gap(cost, cost - held[how].gain, noise) for how, (cost, noise) in sums.items()}
    if not (loud := {how: gap for how, gap in gaps.items() if not of_one(gap.before, gap.noise).at_noise}):
        return ["what is left lies within the measurement noise; of it a flexible force still finds a part"]
    text = [
        f"on {how} a flexible force removes {percent(gap.closed)} of the squared gap that is left"
        for how, gap in loud.items()
    ]
    least = RULES.important * max(found.depends_on[0]["importance"], 0.5)
    joints = [j for j, share in found.where.items() if share > 0.2 * max(found.where.values())]
    inputs = [d["input"] for d in found.depends_on if d["importance"] > least][:4]
    depends = f"depends on {', '.join(inputs)}" if inputs else "depends on nothing that was measured: it is constant"
    return [*text, f"what is missing acts at {', '.join(joints)} and {depends}"]


def not_on_offer(tried: Iterable[str]) -> str:
    """Effects that are tried only where they are named, in words; "" where all were. tried: names of effects."""
    names = [name for name in library.names() if not library.load(name).offered and name not in set(tried)]
    if not names:
        return ""
    nouns = listed([words(name).noun for name in names])
    return f"Not tried, as they were not named: {nouns} (--effects all,{','.join(names)})."


def black_boxes_in_words(found: BlackBoxes | None, one_log: bool = False) -> list[str]:
    """What black boxes close of the gap beside the named effects; nothing where they were not tried."""
    if found is None:
        return []
    text = (
        f"On {'parts of the log' if one_log else 'conditions'} held out a small network that knows nothing of physics"
    )
    text += f" closes {_closes(found.network)} of"
    text += f" the squared gap, {_formula(found)} {_closes(found.formula)}"
    return [f"{text}, the named effects {_closes(found.named)}." if found.named == found.named else f"{text}."]


def _closes(share: float) -> str:
    return percent(min(share, 1.0)) if share > 0 else "nothing"


def _formula(found: BlackBoxes) -> str:
    return f"a formula of {len(found.terms)} term{'' if len(found.terms) == 1 else 's'}"


def formula_in_words(found: BlackBoxes) -> list[str]:
    """`shoulder: -0.061 sign w + 0.3 q`, joint by joint; q, w, u: position, speed, effort in SI units."""
    each: dict[str, list[str]] = {}
    for term in found.terms:
        text = f"{term.force:+.3g} {term.what}".removesuffix(" 1")
        each.setdefault(term.joint, []).append(f"{text[0]} {text[1:]}")
    formulas = {joint: " ".join(terms).removeprefix("+ ") for joint, terms in each.items()}
    return [
        f"{joint}: {'-' if text.startswith('- ') else ''}{text.removeprefix('- ')}" for joint, text in formulas.items()
    ]


def places_of(found: Located) -> list[Place]:
    """Joints with their shares, and the first region told of each."""
    return [
        Place(s.joint, s.share, s.ci, phrases.region(s.leaves[0].where, s.units) if s.leaves else "")
        for s in found.spots
    ]


def located_in_words(found: Located) -> list[str]:
    """One sentence per region of a joint's missing force, and per signature of a known cause."""
    if not found.spots:
        return [phrases.WITHIN_NOISE]
    text = []
    for spot in found.spots:
        for leaf in spot.leaves:
            force = phrases.missing_force(leaf.mean, spot.unit, spot.along)
            text.append(f"missing at {spot.joint}, {phrases.region(leaf.where, spot.units)}: {force}")
        if spot.looked and not spot.leaves:
            text.append(phrases.placeless_force(spot.joint, spot.size, spot.unit))
    return text + [signature for f in found.prints if (signature := _signature(f))]


def _signature(found: Fingerprint) -> str:
    own, numbers = phrases.SIGNATURES[found.name], found.relevant
    parts = [
        phrases.signed(n.value, n.low, n.high, n.unit, words)
        for key, words in own.terms.items()
        if (n := numbers.get(key)) is not None
    ]
    return f"{found.joint}: {own.head.format(recent=LIMITS.recent)} {', '.join(parts)}" if parts else ""


def spectra_in_words(found: Sequence[Heard]) -> list[str]:
    """Delays, orders and lines, joint by joint, and a line that several joints share."""
    each = [f"{heard.joint}: {text}" for heard in found for text in _heard(heard)]
    return each + _shared([(heard.joint, heard.line_hz) for heard in found])


def _heard(found: Heard) -> list[str]:
    says, late = [], found.late
    if late.low > 0.02 * found.period:
        ms = [f"{1e3 * x:.2g}" for x in (late.value, late.low, late.high)]
        says.append(f"the effort acts {ms[0]} ms [{ms[1]}, {ms[2]}] later than commanded")
    if found.orders:
        top = max(found.orders, key=lambda t: t["amplitude"])
        size = f"{top['amplitude']:.2g} {found.unit}"
        says.append(f"the missing force repeats {top['order']} times per turn, amplitude {size}")
    if found.height:
        above = f"{found.height:.2g} times above its surroundings"
        says.append(f"the missing force has a line at {found.line_hz:.3g} Hz, {above}")
    return says


def _shared(lines: list[tuple[str, float]]) -> list[str]:
    """A line common to several joints points to the mount, one in a single joint to its transmission."""
    hz = [(name, f) for name, f in lines if np.isfinite(f)]
    if len(hz) < 2 or max(f for _, f in hz) > 1.1 * min(f for _, f in hz):
        return []
    mean = float(np.mean([f for _, f in hz]))
    return [
        f"the same line near {mean:.3g} Hz in {', '.join(n for n, _ in hz)}: the mount or base rather than one joint"
    ]
