"""The check by inverse dynamics, before any simulation, in lines: command, effort, motion, first guesses."""

from __future__ import annotations

import math
from collections.abc import Sequence

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Look
from bayessim_mjx.diagnosis.equation_error.search import Proposal
from bayessim_mjx.diagnosis.logcheck.drives import LEAST
from bayessim_mjx.diagnosis.logcheck.links import Channel
from bayessim_mjx.diagnosis.phrases.effects import any_of, measured, multiplied, titled
from bayessim_mjx.quantities import MOST, listed, percent


def lines(look: Look) -> list[str]:
    """Most important first."""
    if not look.joints:
        return ["effort -> motion: no joint with a known effort moved freely enough to be compared"]
    out = [verdict(look), _channels(look.channels)] if look.channels else []
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


def verdict(look: Look) -> str:
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
    off = {j.name: f" (measured / model = {j.needs:.2f})" for j in worst if abs(j.needs - 1) > LEAST}  # NaN: unknown
    parts = [f"{j.name} {percent(j.nominal)}{off.get(j.name, '')}" for j in worst[:MOST] if j.nominal >= LEAST]
    after = max(j.left for j in look.joints)
    tail = f"; at most {percent(after)} with the guesses below" if look.proposals else ""
    return f"{name}: effort that the model does not explain (rms): {', '.join(parts)}{tail}"


def _proposal(p: Proposal) -> str:
    each = [(k, v, sd if (sd := p.deviations[k]) < 1e6 else None) for k, v in p.parameters.items() if v]
    own = p.term.modelled
    numbers = ", ".join(
        multiplied(own[k], v, sd) if k in own else f"{k.replace('_', ' ')} {measured(v, sd)}" for k, v, sd in each
    )
    rivals = any_of(p.rivals, MOST)
    return f"first guess: {titled(p.term.effect, p.term.where)}: {numbers}{f'; or {rivals}' if rivals else ''}"
