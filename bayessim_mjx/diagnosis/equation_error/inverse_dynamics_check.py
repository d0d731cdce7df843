"""Efforts against inverse dynamics, before any simulation: drives, mechanism, proposals, contradictions.

The search leaves out candidates that the efforts contradict, and begins others where the efforts put them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error import sums as summing
from bayessim_mjx.diagnosis.equation_error import terms
from bayessim_mjx.diagnosis.equation_error.fit import Fit, Term
from bayessim_mjx.diagnosis.equation_error.search import STRONG, Found, OfModel, Proposal, contradicted, described
from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, base_coordinates
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.logcheck import drives
from bayessim_mjx.diagnosis.logcheck.links import Channel, channels_of
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import controllers

Array = NDArray[np.float64]
UNITS = ("N m", "Nm", "N")  # of efforts, as metadata may state them: those of the model's actuators


FAR = math.sqrt(2 * STRONG)  # standard deviations of the data sheet's, at which the odds for it are strong no more


@dataclass(frozen=True)
class Joint:
    """One joint whose effort is known.

    Attributes:
        source: where its effort comes from: `effort` as measured, `ctrl` as commanded, `none` where nothing drives it.
        needs: measured effort as a multiple of what the model needs; NaN where nothing drives it.
        nominal, known, left: root mean square of what is not explained, as a share of the effort: by the model as it
            is, within the data sheet's accuracy, with the proposals.
    """

    name: str
    source: str
    needs: float
    nominal: float
    known: float
    left: float


@dataclass(frozen=True)
class Shift:
    """A known parameter that the efforts move: `share` of its nominal value, `away` standard deviations of the data
    sheet's."""

    what: str
    where: str
    share: float
    away: float


@dataclass(frozen=True, eq=False)
class Look:
    """What was seen.

    Attributes:
        channels: of drives whose effort was measured; joints: of known effort.
        unit: what one unit of the measured efforts is in the model's, if that had to be found; 1 if it is known.
        proposals: effects that the efforts call for; explained: share that they and the known parameters explain of
            the squared effort that the model leaves.
        shifts: known parameters that move with the proposals; of those that hardly move nothing is said.
        vetoes: {label of a candidate: why it is contradicted}.
        unknown: bodies whose mass these logs tell less of than the data sheet.
        note: why nothing was seen.
    """

    channels: tuple[Channel, ...] = ()
    joints: tuple[Joint, ...] = ()
    unit: float = 1.0
    proposals: tuple[Proposal, ...] = ()
    explained: float = float("nan")
    shifts: tuple[Shift, ...] = ()
    vetoes: Mapping[str, str] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()
    seconds: float = 0.0
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        rows = [
            {
                "effect": p.term.effect, "where": p.term.where, "parameters": p.parameters, "sd": p.deviations,
                "nats": p.nats, "equivalent_to": list(p.rivals),
            }
            for p in self.proposals
        ]  # fmt: skip
        return {
            "channels": [vars(c) for c in self.channels], "joints": [vars(j) for j in self.joints], "unit": self.unit,
            "proposals": rows, "explained": self.explained, "shifts": [vars(s) for s in self.shifts],
            "contradicted": dict(self.vetoes), "seconds": self.seconds, "inertial": {"unknown": self.unknown},
        }  # fmt: skip


def check(
    logs: Sequence[Log],
    model: mujoco.MjModel,
    accuracy: Mapping[tuple[str, str], float] | None = None,
    rating: Mapping[int, float] | None = None,
) -> Look:
    """All that logs tell without a simulation, in seconds.

    Args:
        accuracy: of known parameters, as for `terms.known`.
        rating: {body: kg} that may be there; of others, what the drives hold.
    """
    began = time.monotonic()
    sums = summing.gather(logs, model)
    if not sums.used.any():
        return Look(seconds=time.monotonic() - began)
    places = [log.qpos for log in summing.shortened(logs)]
    carried = drives.carried(model, np.concatenate(places), rating)
    known = terms.known(model, sums.layout, accuracy or {}, sums.period)
    offered = terms.effects(model, sums.layout, sums.source, carried, controllers.of_logs(logs, model))
    stated = all(str(log.metadata.get("effort_unit", "")) in UNITS for log in logs)
    own = OfModel(logs, model)
    found, unit = described(sums, known, offered, stated)
    while doubtful := own.artefacts(known, found):
        offered = [t for t in offered if t.label not in doubtful]
        found, unit = described(sums, known, offered, stated)
    # the model as it is; how late efforts are logged is no fault of it
    nominal = fitting.fit(sums, [t for t in known if t.effect == "lateness"])
    channels = channels_of(logs, model, unit == 1.0)
    vetoes = contradicted(sums, known, offered, found, channels) if unit == 1.0 else {}
    return Look(
        channels,
        _joints(model, sums, nominal, found),
        unit,
        found.proposals,
        _explained(sums, nominal, found),
        _shifts(known, found.fit),
        vetoes,
        _unknown(known, found.fit),
        time.monotonic() - began,
    )


def _joints(model: mujoco.MjModel, sums: Sums, nominal: Fit, found: Found) -> tuple[Joint, ...]:
    lay, on = sums.layout, sums.used
    size = sums.size
    whole = sums.gram
    parts = [
        np.sqrt(fitting.left(sums, m)) / np.maximum(size, 1e-300)
        for m in (nominal.model, found.base.model, found.fit.model)
    ]
    out = []
    for v in np.flatnonzero(on):
        needed = float(whole[v, lay.at("known"), lay.at("known")])
        ratio = float(whole[v, lay.at("known"), lay.at("effort")]) / needed if needed > 0 else float("nan")
        ratio = ratio if sums.source[v] != "none" else float("nan")
        out.append(Joint(terms.joint_of(model, int(v)), sums.source[v], ratio, *(float(p[v]) for p in parts)))
    return tuple(out)


def _shifts(known: Sequence[Term], found: Fit) -> tuple[Shift, ...]:
    """Known parameters farther from the data sheet than it says, the farthest first."""
    out = []
    for term in (t for t in known if t.effect != "lateness"):
        share = float(found.of(term)[0])
        away = share / float(term.sd(found.of(term))[0])
        if abs(away) > FAR:
            out.append(Shift(term.effect, term.where, share, away))
    return tuple(sorted(out, key=lambda s: -abs(s.away)))


def _explained(sums: Sums, nominal: Fit, found: Found) -> float:
    """Share that is explained of the squared effort that the model leaves, each joint in units of its own effort."""
    size, on = sums.size, sums.used
    before, after = (float(np.sum((fitting.left(sums, f.model) / size**2)[on])) for f in (nominal, found.fit))
    return 1.0 - after / before if before > 0 and found.proposals else float("nan")


def _unknown(known: Sequence[Term], found: Fit) -> tuple[str, ...]:
    """Bodies of whose mass the logs have less information (1 / variance) than the data sheet."""
    masses = [(t.where, found.deviation(t)[0], t.sd(found.of(t))[0]) for t in known if t.effect == "mass"]
    return tuple(where for where, after, before in masses if 1 / after**2 - 1 / before**2 < 1 / before**2)


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


def looked(logs: Sequence[Log], robot: Robot) -> Look:
    """Look before any simulation; a failure costs the race its leads, not the diagnosis, and is noted."""
    lost = sorted({name for log in logs for name in log.lost})
    if lost:
        need = f"they need the motion of all joints, and {', '.join(lost)} was not measured"
        return Look(note=f"checks and proposals before any simulation are left out: {need}")
    try:
        return check(logs, robot.mj_model, _deviations(robot), robot.rating)
    except Exception as error:
        return Look(note=f"equation errors: not available ({type(error).__name__}: {error})")


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
