"""The look before any simulation, in lines: command -> effort, effort -> motion, what explains it, what it excludes."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Joint, Look
from bayessim_mjx.diagnosis.equation_error.search import Proposal
from bayessim_mjx.diagnosis.logcheck.drive_channel import Channel
from bayessim_mjx.diagnosis.phrases import titled
from bayessim_mjx.quantities import listed, percent

FEW = 4  # places that are listed
ROUGH = 0.05  # of an effort, rms: more is worth telling


def lines(look: Look) -> list[str]:
    """Most important first."""
    if not look.joints:
        return ["effort -> motion: no joint with a known effort moved freely enough to be looked at"]
    out = [verdict(look)] if look.channels else []
    out += [_channels(look.channels)] if look.channels else []
    out.append(_mechanism(look))
    out += [_proposal(p) for p in look.proposals]
    if look.proposals:
        out.append(f"together they explain {percent(look.explained)} of the squared effort that the model leaves")
    if look.shifts:
        moved = [f"{s.what} of {s.where} {percent(s.share, sign=True)} ({abs(s.away):.1f} sd)" for s in look.shifts]
        out.append(f"known parameters far from the data sheet: {listed(moved, most=FEW)}")
    if look.unit != 1.0:
        out.append(f"the efforts have a unit of their own: 1 of it is about {look.unit:.3g} of the model's")
    out += [
        f"contradicted: {titled(*label.rsplit('@', 1))}: {why}" for label, why in look.vetoes.items() if _news(label)
    ]
    if look.identifiability and look.identifiability.unknown:
        names = listed(look.identifiability.unknown, most=FEW)
        out.append(f"these logs do not tell the mass of {names} better than the data sheet does")
    return out


def _news(label: str) -> bool:
    """What a sound channel contradicts is many effects for one reason, which the channel's line has told."""
    return label.startswith("actuator_gain@")


def verdict(look: Look) -> str:
    """The actuators' channel and the mechanism apart, in one sentence; nothing where no effort was measured."""
    if not look.channels:
        return ""
    shown = [c for c in look.channels if c.identified]
    obey = all(c.sound for c in shown)
    motors = "the motors do what they are told" if obey else "the motors do not do what they are told"
    motors = motors if shown else "the encoders are too coarse to tell what the motors do"
    measured = [j for j in look.joints if j.source == "effort"]
    if not measured:
        return motors
    fits = all(j.nominal < 2 * ROUGH for j in measured)
    ratios = [j.needs for j in measured if math.isfinite(j.needs)]
    mean = math.exp(sum(math.log(max(r, 1e-3)) for r in ratios) / max(len(ratios), 1))
    if fits:
        mechanism = "the mechanism moves as the model says"
    elif mean > 1 + ROUGH:
        mechanism = "the mechanism is heavier or stiffer than the model"
    elif mean < 1 - ROUGH:
        mechanism = "the mechanism is lighter than the model"
    else:
        mechanism = "the mechanism is not the model's"
    return f"{motors}, {'and' if obey == fits else 'but'} {mechanism}"


def apart(look: Look) -> str:
    """The verdict as a sentence of the report; nothing where no effort was measured."""
    text = verdict(look)
    return f"By the logged efforts alone, {text}." if text else ""


def _channels(every: Sequence[Channel]) -> str:
    found = [c for c in every if c.identified]
    if not found:
        return "command -> effort: not told: noise of the encoders hides what the servos' own law asks for"
    off = [c for c in found if not c.sound]
    late = 1e3 * max(abs(c.late) for c in found)
    if not off:
        low, high = min(c.scale for c in found), max(c.scale for c in found)
        echo = "; the logged effort is the command itself, not a measurement" if any(c.echo for c in found) else ""
        return f"command -> effort: {low:.2f} to {high:.2f} of what is commanded, at most {late:.0f} ms late{echo}"
    parts = [
        f"{c.actuator} {c.scale:.2f} of it, {1e3 * c.late:.0f} ms late, {percent(c.left)} otherwise" for c in off[:FEW]
    ]
    others = len(found) - len(off)
    rest = f"; {others} as commanded" if others else ""
    more = f"; {len(off) - FEW} more" if len(off) > FEW else ""
    return f"command -> effort: not as commanded: {'; '.join(parts)}{more}{rest}"


def _mechanism(look: Look) -> str:
    source = {j.source for j in look.joints} - {"none"}
    name = (
        "effort -> motion"
        if source == {"effort"}
        else "command -> motion"
        if "effort" not in source
        else "effort or command -> motion"
    )
    worst = sorted(look.joints, key=lambda j: -j.nominal)
    if worst[0].nominal < ROUGH:
        return f"{name}: the model explains the motion of every joint to {percent(worst[0].nominal)} of the effort"
    parts = [f"{j.name} {percent(j.nominal)}{_needs(j)}" for j in worst[:FEW] if j.nominal >= ROUGH]
    after = max(j.left for j in look.joints)
    tail = f"; with what follows {percent(after)} at most" if look.proposals else ""
    return f"{name}: effort that the model does not explain (rms): {', '.join(parts)}{tail}"


def _needs(j: Joint) -> str:
    return (
        f" (takes {j.needs:.2f} of what the model needs)" if math.isfinite(j.needs) and abs(j.needs - 1) > ROUGH else ""
    )


def _proposal(p: Proposal) -> str:
    numbers = ", ".join(f"{k.replace('_', ' ')} {_number(v, p.deviations[k])}" for k, v in p.parameters.items() if v)
    rivals = listed([titled(*r.rsplit("@", 1)) for r in p.rivals], "or", FEW)
    return f"explained by {titled(p.term.effect, p.term.where)}: {numbers}{f'; or by {rivals}' if rivals else ''}"


def _number(value: float, deviation: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(deviation))) if 0 < deviation < 1e6 else 3
    return f"{value:.{min(digits, 6)}f} +- {deviation:.{min(digits, 6)}f}"
