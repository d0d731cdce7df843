"""Efforts against inverse dynamics, before any simulation: drives, mechanism, proposals, contradictions."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error import sums as summing
from bayessim_mjx.diagnosis.equation_error import terms
from bayessim_mjx.diagnosis.equation_error.fit import Fit, Term, used
from bayessim_mjx.diagnosis.equation_error.search import Found, Proposal, contradicted, search
from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.diagnosis.logcheck import drives, rigid_body
from bayessim_mjx.diagnosis.logcheck.drive_channel import Channel, channels_of
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]
UNITS = ("N m", "Nm", "N")  # of efforts, as metadata may state them: those of the model's actuators


@dataclass(frozen=True)
class Limits:
    """What counts as the model's unit, as a shift of a parameter, as identifiable. Rules of thumb, not counted."""

    unit: float = 0.15  # efforts that are within this factor of the model's need are in its unit
    far: float = 2.0  # standard deviations of the data sheet's, from where on a known parameter's shift is told
    places: int = 20  # positions of each log at which drives hold loads
    rank: float = 1e-7  # of the largest singular value squared, columns at unit length
    shown: float = 0.7  # of what the data sheet leaves open: a mass whose deviation stays above this is not told


LIMITS = Limits()


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


@dataclass(frozen=True)
class Told:
    """What the motion shows of the inertial parameters.

    Attributes:
        parameters: of all moving bodies; combinations: of them that act on the known efforts in these logs (base
            parameters, Gautier 1991, by eigenvalues of the regressor's products).
        unknown: bodies whose mass these logs do not tell better than the data sheet.
    """

    parameters: int
    combinations: int
    unknown: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Look:
    """What was seen.

    Attributes:
        channels: of drives whose effort was measured; joints: of known effort.
        unit: what one unit of the measured efforts is in the model's, if that had to be found; 1 if it is known.
        proposals: effects that the efforts call for; explained: share that they and the known parameters explain of
            the squared effort that the model leaves.
        shifts: known parameters that move with the proposals; of those that hardly move nothing is said.
        vetoes: {label of a candidate: why it is contradicted}; told: what of the inertial parameters shows.
    """

    channels: tuple[Channel, ...] = ()
    joints: tuple[Joint, ...] = ()
    unit: float = 1.0
    proposals: tuple[Proposal, ...] = ()
    explained: float = float("nan")
    shifts: tuple[Shift, ...] = ()
    vetoes: Mapping[str, str] = field(default_factory=dict)
    identifiability: Told | None = None
    seconds: float = 0.0

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
            "contradicted": dict(self.vetoes), "seconds": self.seconds,
            "inertial": vars(self.identifiability) if self.identifiability else {},
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
    if not used(sums).any():
        return Look(seconds=time.monotonic() - began)
    known = terms.known(model, sums.layout, accuracy or {}, sums.period)
    carried = data_sheet.rated(drives.carried(model, _places(logs)), rating or {})
    offered = terms.effects(model, sums.layout, sums.source, carried)
    found, unit = _searched(sums, known, offered, _stated(logs))
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
        told_by(model, sums, known, found.fit),
        time.monotonic() - began,
    )


def _places(logs: Sequence[Log]) -> Array:
    return np.concatenate([log.qpos[:: max(1, len(log) // LIMITS.places)] for log in logs])


def _stated(logs: Sequence[Log]) -> bool:
    return all(str(log.metadata.get("effort_unit", "")) in UNITS for log in logs)


def _searched(sums: Sums, known: Sequence[Term], offered: Sequence[Term], stated: bool) -> tuple[Found, float]:
    """What the search came to, and the unit of the efforts: free where none is stated, unless it comes out as 1."""
    measured = np.array(sums.source) == "effort"
    if stated or not measured.any():
        return search(sums, known, offered), 1.0
    unit = terms.scale("effort_unit", "all", measured)
    others = [t for t in offered if (t.effect, t.where) != ("actuator_gain", "all")]
    found = search(sums, [*known, unit], others)
    factor = 1.0 / float(found.fit.of(unit)[0])
    if abs(np.log(abs(factor) + 1e-12)) < LIMITS.unit:
        return search(sums, known, offered), 1.0
    return found, factor


def _joints(model: mujoco.MjModel, sums: Sums, nominal: Fit, found: Found) -> tuple[Joint, ...]:
    lay, on = sums.layout, used(sums)
    size = sums.size
    whole, rows = sums.whole, np.maximum(sums.rows.sum(0), 1e-9)
    parts = [
        np.sqrt(fitting.left(sums, whole, m) / rows) / np.maximum(size, 1e-300)
        for m in (nominal.model, found.base.model, found.fit.model)
    ]
    out = []
    for v in np.flatnonzero(on):
        needed = float(whole[v, lay.known, lay.known])
        ratio = float(whole[v, lay.known, lay.effort]) / needed if needed > 0 else float("nan")
        ratio = ratio if sums.source[v] != "none" else float("nan")
        out.append(Joint(terms.joint_of(model, int(v)), sums.source[v], ratio, *(float(p[v]) for p in parts)))
    return tuple(out)


def _shifts(known: Sequence[Term], found: Fit) -> tuple[Shift, ...]:
    """Known parameters farther from the data sheet than it says, the farthest first."""
    out = []
    for term in (t for t in known if t.effect != "lateness"):
        share = float(found.of(term)[0])
        away = share / float(term.sd(found.of(term))[0])
        if abs(away) > LIMITS.far:
            out.append(Shift(term.effect, term.where, share, away))
    return tuple(sorted(out, key=lambda s: -abs(s.away)))


def _explained(sums: Sums, nominal: Fit, found: Found) -> float:
    """Share that is explained of the squared effort that the model leaves, each joint in units of its own effort."""
    size, on = sums.size, used(sums)
    rows = np.maximum(sums.rows.sum(0), 1e-9)
    before, after = (
        float(np.sum((fitting.left(sums, sums.whole, f.model) / rows / size**2)[on])) for f in (nominal, found.fit)
    )
    return 1.0 - after / before if before > 0 and found.proposals else float("nan")


def told_by(model: mujoco.MjModel, sums: Sums, known: Sequence[Term], found: Fit) -> Told:
    """From the products of the columns, and from the fit's covariance."""
    count = rigid_body.INERTIAL * sums.layout.bodies
    weight = np.where(used(sums), 1.0 / found.variance, 0.0)
    S = np.einsum("v,vpq->pq", weight, sums.whole[:, :count, :count])
    size = np.sqrt(np.diag(S))
    seen = size > 1e-6 * size.max(initial=1e-300)
    scaled = S[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    values = np.linalg.eigvalsh(scaled) if seen.any() else np.zeros(0)
    rank = int(np.sum(values > LIMITS.rank * values.max(initial=1e-300)))
    masses = [t for t in known if t.effect == "mass"]
    nothing = np.full(1, np.nan)
    unknown = [t.where for t in masses if found.deviation(t)[0] > LIMITS.shown * t.sd(nothing)[0]]
    return Told(count, rank, tuple(unknown))
