"""Is a log's effort related to its motion? The best bounded linear model of the inverse dynamics has to explain it.

Bounds keep friction from standing in for a robot that is not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck import drives
from bayessim_mjx.diagnosis.logcheck.drives import Effort, efforts
from bayessim_mjx.diagnosis.logcheck.regressor import (
    FEWEST,
    TILT,
    Bounded,
    Mask,
    Regressor,
    bandwidth,
    filtered,
    motion,
)
from bayessim_mjx.diagnosis.logcheck.rigid_body import inertial, moving_bodies, nominal
from bayessim_mjx.diagnosis.logcheck.single_log import Finding
from bayessim_mjx.diagnosis.logcheck.timing import Late
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.quantities import percent


@dataclass(frozen=True)
class Limits:
    """How much of a logged effort the motion has to explain. Error rates: benchmarks/records/log_checks.json."""

    # share of the effort's variance explained
    refused: float = 0.3
    doubtful: float = 0.7
    # s by which motion may follow the command for physical reasons: delay, lag, elasticity; beyond it clocks disagree
    causal: tuple[float, float] = (-0.003, 0.15)
    clear: float = 0.5  # of what one explanation leaves unexplained, that a better one leaves at most
    gain: float = 0.02  # of the variance, which a lag has to explain
    far: float = 0.5  # s, the largest offset between clocks that is looked for


LIMITS = Limits()
# A body's inertia and the actuator's gain may be wrong by this factor either way. Rule of thumb; no sound log needs
# more: benchmarks/records/log_checks.json.
FACTOR = 2.0


@dataclass(frozen=True)
class Relation:
    """How far one joint's effort follows from its motion.

    Attributes:
        explained: share of the variance, at the best lag that physics allows; None: not tested, `text` says why.
        friction: the share that friction and offset explain without any body.
        late: the motion behind the effort; gain: share of the variance that this lag explains more than none.
        mend: what would mend it, or nothing.
        certain: the mend is a sign or a unit, which no robot has wrong.
    """

    joint: str
    source: str
    explained: float | None
    friction: float = 0.0
    late: Late = Late(0.0)
    gain: float = 0.0
    mend: str = ""
    certain: bool = False
    text: str = ""

    @property
    def lag(self) -> float:
        """s by which the motion follows the effort, where that is reported; else 0."""
        return self.late.seconds if self.gain >= LIMITS.gain else 0.0

    @property
    def refused(self) -> bool:
        """Too little is explained; or what is explained is a sign of the velocity that owes nothing to the masses."""
        e = self.explained
        vain = self.certain or e is not None and e < self.friction + 0.05
        return e is not None and (e < LIMITS.refused or (e < LIMITS.doubtful and vain))


def relations(log: Log, mj_model: mujoco.MjModel) -> list[Relation]:
    """One relation per joint and source of effort."""
    found = list(efforts(log, mj_model))
    if not found:
        return []
    top = bandwidth(log)
    cutoffs = sorted({max(3.0, top / 2), top})  # the slower one is the quieter one
    pictures = [_Picture.of(log, mj_model, cutoff) for cutoff in cutoffs]
    return [_relation(log, mj_model, effort, pictures) for effort in found]


def remarks(related: Sequence[Relation]) -> list[Finding]:
    """A log is refused where at least half of its joints have no effort that fits their motion."""
    best: dict[str, Relation] = {}
    for r in related:
        if r.explained is not None and (r.joint not in best or r.explained > (best[r.joint].explained or 0.0)):
            best[r.joint] = r
    bad = [r for r in best.values() if r.refused]
    out: list[Finding] = []
    for r in best.values():
        explained = r.explained or 0.0
        if r in bad:
            out.append(Finding("refused" if 2 * len(bad) >= len(best) else "warning", _unrelated(r)))
        elif explained < LIMITS.doubtful:
            text = f"{r.joint}: no model explains {percent(1 - explained)} of its effort ({r.source})"
            out.append(Finding("warning", f"{text} ({r.mend})" if r.mend else text))
        if r.lag and r not in bad:
            text = f"{r.joint}: its motion follows the effort ({r.source}) {r.lag * 1e3:+.0f} ms late"
            physical = LIMITS.causal[0] <= r.lag <= LIMITS.causal[1]
            out.append(Finding("finding", text) if physical else Finding("warning", f"{text}: do the clocks agree?"))
    return out


def _unrelated(r: Relation) -> str:
    explained = r.explained or 0.0
    share = percent(min(1.0, 1.0 - explained))
    text = f"effort unrelated to motion: {share} of the effort of {r.joint} ({r.source}) unexplained by any model"
    if explained >= LIMITS.refused:
        text += f", and friction alone explains {percent(r.friction)}"
    why = r.mend or "column not aligned in time, wrong scale, or forces that were not logged?"
    return f"{text} ({why})"


def _relation(
    log: Log, mj_model: mujoco.MjModel, effort: Effort, pictures: list[_Picture], laden: bool = False
) -> Relation:
    """laden: with an unknown load, which is no fault of a log."""
    own = Relation(effort.joint, effort.source, None)
    tests = [t for t in (_Test.of(log, effort, p, laden) for p in pictures) if t.independent >= FEWEST]
    if not tests:
        return replace(own, text="too little motion, free of contacts and limits, to compare the effort with")
    if any(t.small for t in tests):
        share = _in_radians(log, mj_model, tests[0])
        if share > LIMITS.doubtful:
            return replace(
                own, explained=0.0, certain=True, mend=f"positions in degrees would explain {percent(share)}"
            )
        return replace(own, text="the effort hardly changes against the inertial forces; free motion tests nothing")
    lags = np.linspace(-LIMITS.far, LIMITS.far, 41)
    curves = [t.over(lags) for t in tests]
    test, curve = max(zip(tests, curves, strict=True), key=lambda p: float(np.max(p[1])))
    physical = (lags >= LIMITS.causal[0]) & (lags <= LIMITS.causal[1])
    explained = max(float(c[physical].max()) for c in curves)
    best = float(curve.max())
    # a periodic motion fits one period later too
    far = explained < LIMITS.doubtful or 1.0 - best <= LIMITS.clear * (1.0 - explained)
    late, gain = _nearest(lags, curve, physical | far, test.independent)
    relation = replace(own, explained=explained, friction=test.friction(), late=late, gain=gain)
    if explained >= LIMITS.doubtful and not relation.lag:
        return relation
    share, mend, certain = (
        (best, "", False) if explained >= LIMITS.doubtful else _mend(log, mj_model, relation, curve, test)
    )
    if not laden:
        other = _relation(log, mj_model, effort, pictures, laden=True)
        explained = other.explained or 0.0
        if explained >= LIMITS.doubtful and not other.refused and 1.0 - explained < LIMITS.clear * (1.0 - share):
            return other
    return replace(relation, mend=mend, certain=certain)


def _nearest(lags: Array, curve: Array, allowed: Mask, count: float) -> tuple[Late, float]:
    """The smallest lag that is about as good as the best of those allowed, and how much more than none it explains.

    count: independent rows n. Of residuals with the variance s(lag) the likelihood is s^(-n/2), whose curvature at the
    vertex of a parabola s = s0 + c (lag - lag0)^2 gives the error sqrt(s0 / (n c)).
    """
    best, now = float(curve[allowed].max()), float(np.interp(0.0, lags, curve))
    good = np.flatnonzero(allowed & (curve >= best - min(0.002, 0.1 * (best - now))))
    k = int(good[np.argmin(np.abs(lags[good]))])
    first, last = np.flatnonzero(allowed)[[0, -1]]
    while first < k < last and max(curve[k - 1], curve[k + 1]) > curve[k]:
        k += 1 if curve[k + 1] > curve[k - 1] else -1  # to the top of its hill
    if k in (0, len(lags) - 1) or max(curve[k - 1], curve[k + 1]) > curve[k]:
        return Late(float(lags[k])), best - now  # no top lies among the lags
    left, top, right = curve[k - 1 : k + 2]  # the vertex of the parabola through them
    bend, step = max(2 * top - left - right, 1e-12), float(lags[1] - lags[0])
    error = step * float(np.sqrt(max(1.0 - top, 0.0) / (0.5 * bend * max(count, 1.0))))
    return Late(float(lags[k] + 0.5 * step * (right - left) / bend), error), best - now


@dataclass(frozen=True, eq=False)
class _Picture:
    """The regressor of a log's motion at one cutoff: a column for each body at nominal inertia, and for loads.

    Loads are 1 kg at and around the last links' centres of mass, of which there may be `most` kg `[P]`.
    """

    own: Regressor
    bodies: int
    most: Array

    @classmethod
    def of(cls, log: Log, model: mujoco.MjModel, cutoff: float) -> _Picture:
        inertia, moving = nominal(model), moving_bodies(model)
        sets, most = list(np.eye(len(moving))[:, :, None] * inertia), []
        for body, place, heaviest in drives.at_the_ends(model):
            sets.append(np.zeros_like(inertia))
            sets[-1][moving.index(body)] = inertial(1.0, place, np.zeros((3, 3)))
            most.append(heaviest)
        return cls(Regressor.of(model, motion(log, model, cutoff), sets=np.array(sets)), len(moving), np.array(most))

    def bounded(self, dof: int, laden: bool) -> Bounded:
        """The linear model of the effort at one degree of freedom.

        Inertias within FACTOR, springs and friction only with the sign of springs and friction, gravity tilted by up to
        TILT, any offset, and with `laden` loads.
        """
        own, shown = self.own, lambda x: np.abs(x).max(axis=0) > 1e-9
        loose = np.stack([own.own[n][:, dof] for n in ("one", "speed", "dry", "drag", "acceleration")], 1)
        travel = own.own["position"][:, dof]
        parts = np.column_stack([own.columns[:, dof, : self.bodies], own.spring[:, dof]])
        load, tilt = own.columns[:, dof, self.bodies :], own.tilt[:, dof]
        felt = shown(load) & laden
        parts, tilt = parts[:, shown(parts)], tilt[:, shown(tilt)]
        x = np.column_stack([loose, travel - travel.mean(), parts, tilt, load[:, felt]])
        rigid, turned = np.ones(parts.shape[1]), np.full(tilt.shape[1], TILT)
        low = np.concatenate([[-np.inf], np.zeros(5), rigid / FACTOR, -turned, np.zeros(felt.sum())])
        high = np.concatenate([np.full(6, np.inf), rigid * FACTOR, turned, self.most[felt]])
        return Bounded(x, low, high, slice(6, 6 + len(rigid)))


@dataclass(frozen=True, eq=False)
class _Test:
    """One effort against one picture of the motion."""

    log: Log
    effort: Effort
    picture: _Picture
    model: Bounded
    rows: Mask

    @classmethod
    def of(cls, log: Log, effort: Effort, picture: _Picture, laden: bool = False) -> _Test:
        return cls(log, effort, picture, picture.bounded(effort.dof, laden), picture.own.moved.moving(effort.dof))

    @property
    def signal(self) -> Array:
        return filtered(self.effort.signal, self.log, self.picture.own.moved)

    @property
    def cutoff(self) -> float:
        return self.picture.own.moved.cutoff

    @property
    def independent(self) -> float:
        """How many independent rows its rows are."""
        return float(self.rows.sum()) * self.picture.own.moved.share

    @property
    def small(self) -> bool:
        """Whether the effort hardly changes against the forces of inertia."""
        y, own = self.signal[self.rows], self.picture.own
        force = (own.columns[..., : self.picture.bodies].sum(-1) - own.weight)[self.rows, self.effort.dof]
        idle = float(y.std()) <= 1e-6 * float(np.abs(y).max()) + 1e-12
        return idle or (self.effort.scaled and float(y.std()) < 0.1 * float(np.sqrt(np.mean(force**2))))

    def over(self, lags: Array) -> Array:
        """[L] share explained where the effort is delayed by each lag."""
        signals = filtered(self.effort.signal, self.log, self.picture.own.moved, lags)
        return self.model.explained(signals, self.rows, self.effort.scaled)

    def friction(self) -> float:
        return float(self.model.friction().explained(self.signal[None], self.rows)[0])

    def share(self, rows: Mask | None = None, sign: float = 1.0, scaled: bool | None = None) -> float:
        """Explained without a lag, over other rows, with the other sign or at any scale."""
        scaled = self.effort.scaled if scaled is None else scaled
        return float(self.model.explained(sign * self.signal[None], self.rows if rows is None else rows, scaled)[0])

    def pieces(self) -> list[tuple[float, float]]:
        """Spans [s since the start] that the model does explain, from windows of a tenth of the log, at least 2 s."""
        moved = self.picture.own.moved
        edges = np.arange(moved.time[0], moved.time[-1] + 1e-9, max(2.0, 0.1 * self.log.duration))
        spans: list[tuple[float, float]] = []
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            rows = self.rows & (moved.time >= a) & (moved.time < b)
            if rows.sum() * moved.share >= FEWEST and self.share(rows) > 0.9:
                start = (
                    spans.pop()[0] if spans and abs(spans[-1][1] - (a - moved.time[0])) < 1e-6 else a - moved.time[0]
                )
                spans.append((float(start), float(b - moved.time[0])))
        return spans


def _mend(log: Log, mj_model: mujoco.MjModel, now: Relation, curve: Array, test: _Test) -> tuple[float, str, bool]:
    """One remedy that would explain the effort, (how much of it, in words or nothing, whether a sign or a unit)."""
    best = float(curve.max())
    if now.lag and best > LIMITS.doubtful:
        return best, f"shifting the command by {now.lag:+.3f} s would explain {percent(best)}", False
    turned = test.share(sign=-1.0)
    if turned > LIMITS.doubtful:
        return turned, f"the opposite sign would explain {percent(turned)}", True
    radians = _in_radians(log, mj_model, test)
    if radians > LIMITS.doubtful:
        return radians, f"positions in degrees would explain {percent(radians)}", True
    free = test.share(scaled=False)
    if test.effort.scaled and free > LIMITS.doubtful:
        return free, f"another scale of the command would explain {percent(free)}", False
    spans = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in test.pieces())
    return 0.0, (f"the part from {spans} alone can be explained: cut the file there" if spans else ""), False


def _in_radians(log: Log, mj_model: mujoco.MjModel, test: _Test) -> float:
    """Share explained if the positions were degrees; 0 where they are too small for that."""
    if np.abs(log.qpos).max() < 6.0:
        return 0.0
    radians = replace(log, qpos=np.radians(log.qpos), qvel=np.radians(log.qvel))
    return _Test.of(radians, test.effort, _Picture.of(radians, mj_model, test.cutoff)).share()
