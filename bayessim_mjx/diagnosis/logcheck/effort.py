"""Is a log's effort related to its motion? The best bounded linear model of the inverse dynamics has to explain it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.drives import dof_of, is_effort
from bayessim_mjx.diagnosis.logcheck.filtered_motion import Mask, bandwidth, filtered, motion
from bayessim_mjx.diagnosis.logcheck.inverse_dynamics import Columns, Dynamics
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.physics import controllers
from bayessim_mjx.quantities import percent


@dataclass(frozen=True)
class Limits:
    """How much of a logged effort the motion has to bear out."""

    # share of the effort's variance explained
    refused: float = 0.3
    doubtful: float = 0.7
    # s by which motion may follow the command for physical reasons: delay, lag, elasticity
    causal: tuple[float, float] = (-0.003, 0.15)
    loaded: float = 0.5  # of what another remedy leaves unexplained, which a load has to undercut
    # of what the lags of a robot leave unexplained, which those of a clock have to undercut
    far_better: float = 1 / 3
    far: float = 0.5  # s, the largest offset between clocks that is looked for


LIMITS = Limits()


@dataclass(frozen=True, eq=False)
class Effort:
    """What drove one joint: signal [T of the log], in the model's unit (N m, N) where `scaled`."""

    joint: str
    dof: int
    source: str  # ctrl or effort
    signal: Array
    scaled: bool


@dataclass(frozen=True)
class Relation:
    """How far one joint's effort follows from its motion.

    Attributes:
        explained: share of the variance, at the best lag that physics allows; None: not tested, `text` says why.
        friction: the share that friction and offset explain without any body.
        lag: s by which the motion follows the effort.
        mend: what would mend it, or nothing.
        certain: the mend is a sign or a unit, which no robot has wrong.
    """

    joint: str
    source: str
    explained: float | None
    friction: float = 0.0
    lag: float = 0.0
    mend: str = ""
    certain: bool = False
    text: str = ""

    @property
    def refused(self) -> bool:
        """Too little is explained; or what is explained is a sign of the velocity that owes nothing to the masses."""
        e = self.explained
        vain = self.certain or e is not None and e < self.friction + 0.05
        return e is not None and (e < LIMITS.refused or (e < LIMITS.doubtful and vain))


def efforts(log: Log, mj_model: mujoco.MjModel) -> Iterator[Effort]:
    """The efforts of every joint whose drives are all known: from the `effort:` streams, and from ctrl."""
    dofs = [dof_of(mj_model, i) for i in range(mj_model.nu)]
    gear = mj_model.actuator_gear[:, 0]
    for dof in sorted({d for d in dofs if d is not None}):
        own = [i for i, d in enumerate(dofs) if d == dof]
        joint = log.joints[int(mj_model.dof_jntid[dof])]
        streams = [log.streams.get(f"effort:{log.actuators[i]}") for i in own]
        if all(s is not None and np.isfinite(s).all() for s in streams):
            yield Effort(joint, dof, "effort", sum(g * s for g, s in zip(gear[own], streams, strict=True)), False)
        if all(is_effort(mj_model, i) for i in own) and not closed(log):
            yield Effort(joint, dof, "ctrl", sum(gear[i] * _force(mj_model, i, log.ctrl[:, i]) for i in own), True)


def closed(log: Log) -> bool:
    """Whether a position or velocity loop stands between the logged command and the actuator."""
    given = log.metadata.get("controller")
    blocks = [given, *given.values()] if isinstance(given, dict) else []
    named = [str(b.get("law", "direct")).lower() for b in blocks if isinstance(b, dict)]
    return any(controllers.ALIASES.get(n, "direct") != "direct" for n in named)


def _force(mj_model: mujoco.MjModel, i: int, ctrl: Array) -> Array:
    if mj_model.actuator_ctrllimited[i]:
        ctrl = np.clip(ctrl, *mj_model.actuator_ctrlrange[i])
    force = mj_model.actuator_gainprm[i, 0] * ctrl
    return np.clip(force, *mj_model.actuator_forcerange[i]) if mj_model.actuator_forcelimited[i] else force


def relations(log: Log, mj_model: mujoco.MjModel) -> list[Relation]:
    """One relation per joint and source of effort."""
    found = list(efforts(log, mj_model))
    if not found:
        return []
    top = bandwidth(log)
    pictures = []
    for cutoff in sorted({max(3.0, top / 2), top}):  # the slower one is the quieter one
        moved = motion(log, mj_model, cutoff)
        pictures.append(Dynamics.of(mj_model, moved))
    laden = functools.cache(lambda: [p.loaded(mj_model) for p in pictures])
    return [_relation(log, mj_model, effort, pictures, laden) for effort in found]


def _relation(
    log: Log,
    mj_model: mujoco.MjModel,
    effort: Effort,
    pictures: list[Dynamics],
    laden: Callable[[], list[Dynamics]] | None = None,
) -> Relation:
    """laden: the pictures with an unknown load, which is no fault of a log."""
    own = Relation(effort.joint, effort.source, None)
    tests = [t for t in (_Test.of(log, effort, d) for d in pictures) if t.rows.sum() * t.step * t.cutoff >= 4.0]
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
    relation = replace(own, explained=explained, friction=test.friction(), lag=_nearest(lags, curve))
    if explained >= LIMITS.doubtful and 1.0 - best > LIMITS.far_better * (1.0 - explained):
        # a periodic motion fits one period later too
        relation = replace(relation, lag=_nearest(lags[physical], curve[physical]))
    if explained >= LIMITS.doubtful and not relation.lag:
        return relation
    share, mend, certain = (
        (best, "", False) if explained >= LIMITS.doubtful else _mend(log, mj_model, relation, curve, test)
    )
    if laden is not None:
        other = _relation(log, mj_model, effort, laden())
        told = other.explained or 0.0
        if told >= LIMITS.doubtful and not other.refused and 1.0 - told < LIMITS.loaded * (1.0 - share):
            return other
    return replace(relation, mend=mend, certain=certain)


def _nearest(lags: Array, curve: Array) -> float:
    """The smallest lag about as good as the best, between the grid's; 0 where the best is hardly better than none."""
    best, now = float(curve.max()), float(np.interp(0.0, lags, curve))
    if best - now < 0.02:
        return 0.0
    good = np.flatnonzero(curve >= best - min(0.002, 0.1 * (best - now)))
    k = int(good[np.argmin(np.abs(lags[good]))])
    while 0 < k < len(lags) - 1 and max(curve[k - 1], curve[k + 1]) > curve[k]:
        k += 1 if curve[k + 1] > curve[k - 1] else -1  # to the top of its hill
    if k in (0, len(lags) - 1):
        return float(lags[k])
    left, top, right = curve[k - 1 : k + 2]  # the vertex of the parabola through them
    return float(lags[k] + 0.5 * (lags[1] - lags[0]) * (left - right) / min(left - 2 * top + right, -1e-12))


@dataclass(frozen=True, eq=False)
class _Test:
    """One effort against one picture of the motion."""

    log: Log
    effort: Effort
    picture: Dynamics
    columns: Columns
    rows: Mask

    @classmethod
    def of(cls, log: Log, effort: Effort, picture: Dynamics) -> _Test:
        return cls(log, effort, picture, picture.columns(effort.dof), picture.moved.moving(effort.dof))

    @property
    def signal(self) -> Array:
        return filtered(self.effort.signal, self.log, self.picture.moved)

    @property
    def step(self) -> float:
        return self.picture.moved.step

    @property
    def cutoff(self) -> float:
        return self.picture.moved.cutoff

    @property
    def small(self) -> bool:
        y = self.signal[self.rows]
        force = (self.picture.bodies.sum(0) - self.picture.weight)[self.rows, self.effort.dof]
        idle = float(y.std()) <= 1e-6 * float(np.abs(y).max()) + 1e-12
        return idle or (self.effort.scaled and float(y.std()) < 0.1 * float(np.sqrt(np.mean(force**2))))

    def over(self, lags: Array) -> Array:
        """[L] share explained where the effort is delayed by each lag."""
        signals = filtered(self.effort.signal, self.log, self.picture.moved, lags)
        return self.columns.explained(signals, self.rows, self.effort.scaled)

    def friction(self) -> float:
        return float(self.columns.friction().explained(self.signal[None], self.rows)[0])

    def share(self, rows: Mask | None = None, sign: float = 1.0, scaled: bool | None = None) -> float:
        """Explained without a lag, over other rows, with the other sign or at any scale."""
        scaled = self.effort.scaled if scaled is None else scaled
        return float(self.columns.explained(sign * self.signal[None], self.rows if rows is None else rows, scaled)[0])

    def pieces(self) -> list[tuple[float, float]]:
        """Spans [s since the start] that the model does explain, from windows of a tenth of the log, at least 2 s."""
        moved = self.picture.moved
        edges = np.arange(moved.time[0], moved.time[-1] + 1e-9, max(2.0, 0.1 * self.log.duration))
        spans: list[tuple[float, float]] = []
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            rows = self.rows & (moved.time >= a) & (moved.time < b)
            enough = rows.sum() * moved.step * moved.cutoff >= 3.0
            if enough and self.share(rows) > 0.9:
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
    picture = Dynamics.of(mj_model, motion(radians, mj_model, test.cutoff))
    return _Test.of(radians, test.effort, picture).share()
