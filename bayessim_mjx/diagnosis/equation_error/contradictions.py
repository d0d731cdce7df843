"""What the efforts contradict: one value for all joints where joints differ, and faults of drives that obey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error.fit import Term
from bayessim_mjx.diagnosis.equation_error.search import Found
from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.diagnosis.logcheck.drive_channel import Channel
from bayessim_mjx.quantities import percent


@dataclass(frozen=True)
class Limits:
    """When something is contradicted. Error rates: benchmarks/results.md (diagnosis: before any simulation)."""

    nats: float = 20.0  # of held-out density that one value everywhere loses against values at some places
    apart: float = 0.05  # by which two drives' scales differ


LIMITS = Limits()
# frictions are not among them: 1 of 16 that were the same everywhere would have been lost
TIED = ("actuator_gain",)
# what would make a drive's effort another function of its command than a scale and a constant
OF_DRIVES = ("actuator_deadband", "actuator_saturation", "rate_limit", "speed_torque_limit", "effort_loss")


def contradicted(
    sums: Sums, known: Sequence[Term], offered: Sequence[Term], found: Found, channels: Sequence[Channel]
) -> dict[str, str]:
    """{label of a candidate: why}."""
    out = {f"{effect}@all": why for effect in TIED if (why := _elsewhere(sums, known, offered, found, effect))}
    if why := _unlike(channels):
        out["actuator_gain@all"] = why
    sound = {c.actuator: c for c in channels if c.static and c.sound}
    for effect in OF_DRIVES:
        for name, c in sound.items():
            out[f"{effect}@{name}"] = f"{name}'s effort follows its command but for {percent(c.left)}"
        if sound:
            out[f"{effect}@all"] = f"{next(iter(sound))}'s effort follows its command"
    return out


def _elsewhere(sums: Sums, known: Sequence[Term], offered: Sequence[Term], found: Found, effect: str) -> str:
    """Why an effect is not the same everywhere: at some places alone it explains far more; or nothing."""
    own = [p for p in found.proposals if p.term.effect == effect and p.term.where != "all"]
    tied = [t for t in offered if (t.effect, t.where) == (effect, "all")]
    if not own or not tied:
        return ""
    others = [p.term for p in found.proposals if p not in own]
    density = float(fitting.score(sums, [*known, *others, *tied]).sum())
    if found.density[1] - density < LIMITS.nats:
        return ""
    values = [f"{next(iter(p.parameters.values())):.2g} at {p.term.where}" for p in own]
    return f"{' and '.join(values)}, and not elsewhere"


def _unlike(channels: Sequence[Channel]) -> str:
    """Two drives whose efforts are different shares of what was commanded; or nothing."""
    told = sorted((c for c in channels if c.told and not c.echo), key=lambda c: c.scale)
    if len(told) < 2 or all(c.off == 1.0 for c in told):
        return ""
    low, high = told[0], told[-1]
    if high.scale - low.scale < LIMITS.apart + 3.0 * (low.deviation + high.deviation):
        return ""
    return f"{low.scale:.2g} of the command at {low.actuator}, {high.scale:.2g} at {high.actuator}"
