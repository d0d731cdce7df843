"""What the inverse-dynamics check means for the search: which candidates it leaves out, and where others start."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Look, check
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, base_coordinates
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.logcheck import gate
from bayessim_mjx.logs.log import Log


@dataclass(frozen=True, eq=False)
class Proposals:
    """The candidates that race.

    Attributes:
        candidates: without those that are contradicted; proposals also start where the efforts put them.
        vetoed: {label: why} of those left out.
    """

    candidates: tuple[Candidate, ...]
    vetoed: Mapping[str, str]

    def sentences(self) -> list[str]:
        """One for all that one reason contradicts."""
        reasons: dict[str, list[str]] = {}
        for label, why in self.vetoed.items():
            reasons.setdefault(why, []).append(label.replace("@", " at "))
        return [
            f"not tried, contradicted by the efforts: {', '.join(labels)} ({why})" for why, labels in reasons.items()
        ]


def checked(
    logs: Sequence[Log], robot: Robot, dt: float, notes: list[str], say: Callable[[Look], None]
) -> tuple[gate.Gate, Look]:
    """The gate, after the look, which takes less time and is said at once; again where the gate refuses more logs."""
    sound = [log for log in logs if not gate.unusable(log, dt)]
    seen = looked(sound, robot, notes)
    say(seen)
    found = gate.check(logs, robot.mj_model, dt)
    if 0 < len(found.usable) < len(sound):
        seen = looked(found.usable, robot, notes)
        say(seen)
    return found, seen


def looked(logs: Sequence[Log], robot: Robot, notes: list[str]) -> Look:
    """The look before any simulation; a failure costs the race its leads, not the diagnosis, and is `told`."""
    lost = sorted({name for log in logs for name in log.lost})
    if lost:
        need = f"they need the motion of all joints, and {', '.join(lost)} was not measured"
        text = f"checks and proposals before any simulation are left out: {need}"
        notes += [text] if text not in notes else []  # the gate may ask for a second look
        return Look()
    try:
        return check(logs, robot.mj_model, _deviations(robot), robot.rating)
    except Exception as error:
        notes.append(f"equation errors: not available ({type(error).__name__}: {error})")
        return Look()


def _deviations(robot: Robot) -> dict[tuple[str, str], float]:
    """{(mass, armature, damping or friction; element): standard deviation as a share}, of the known parameters."""
    base = base_coordinates(robot.space, robot.accuracy)
    pairs = zip(robot.space.parameters, base, strict=True)
    return {(p.attribute, p.target): c.precision**-0.5 / abs(c.neutral) for p, c in pairs if c.neutral and c.precision}


def lead(candidates: Iterable[Candidate], look: Look) -> Proposals:
    """Vetoes and starts; an effect that is itself proposed, or that would do in its place, is never left out."""
    every = tuple(candidates)
    starts = proposed(look)
    first = {*starts, *(r for p in look.proposals for r in p.rivals)}
    vetoed = {c.label: look.vetoes[c.label] for c in every if c.label in look.vetoes and c.label not in first}
    kept = tuple(_started(c, starts.get(c.label)) for c in every if c.label not in vetoed)
    return Proposals(kept, vetoed)


def proposed(look: Look) -> dict[str, dict[str, float]]:
    """{label: parameters}: of the mechanism, and gains of drives that do not give what is commanded.

    Where the effort was measured a drive's gain is what the channel and the mechanism make of it together.
    """
    out = {p.label: dict(p.parameters) for p in look.proposals}
    if look.unit != 1.0:
        return {label: own for label, own in out.items() if not label.startswith("effort_unit")}
    for c in look.channels:
        label = f"actuator_gain@{c.actuator}"
        if c.off != 1.0:
            out[label] = {"gain": c.off * out.get(label, {"gain": 1.0})["gain"]}
        if c.shifted:
            out[f"actuator_bias@{c.actuator}"] = {"bias": c.shifted}
    return out


def _started(candidate: Candidate, start: Mapping[str, float] | None) -> Candidate:
    """With one more starting point, inside the ranges."""
    if not start:
        return candidate
    point = [start.get(c.name.rsplit(".", 1)[-1], c.neutral) for c in candidate.coordinates]
    low, high = (np.array([getattr(c, end) for c in candidate.coordinates]) for end in ("low", "high"))
    row = np.clip(point, low, high)[None]
    return replace(candidate, probes=np.concatenate([candidate.probes.reshape(-1, len(point)), row]))
