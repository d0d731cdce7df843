"""Is a log's effort related to its motion? The best bounded linear model of the inverse dynamics has to explain it.

Bounds keep friction from standing in for a robot that is not there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.drives import LEAST, Effort, dof_of, efforts
from bayessim_mjx.diagnosis.logcheck.regressor import FEWEST, LOOSE, Bounded, Mask, Regressor, motion
from bayessim_mjx.diagnosis.logcheck.rigid_body import inertial, moving_bodies, nominal
from bayessim_mjx.diagnosis.logcheck.single_log import Finding
from bayessim_mjx.diagnosis.logcheck.timing import LAGS, Late, nearest
from bayessim_mjx.effects.gravity_tilt import GravityTilt
from bayessim_mjx.logs.excited import crossing, moved_most
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.velocities import bandwidth
from bayessim_mjx.logs.views import sheet_of
from bayessim_mjx.parameters.geometry import reach, tree_mass
from bayessim_mjx.quantities import percent

# Of an effort's variance: a log is refused where more is unexplained than explained, and doubted below the second. One
# explanation is better than another where it leaves half as much. Error rates: benchmarks/records/log_checks.json.
HALF, SOUND = 0.5, 0.7
# s by which motion may follow a command for physical reasons: delay, lag, elasticity; beyond it clocks disagree.
# Error rates: benchmarks/records/log_checks.json.
CAUSAL = 0.15
# A body's inertia and the actuator's gain may be wrong by this factor either way. Rule of thumb; no sound log needs
# more: benchmarks/records/log_checks.json.
FACTOR = 2.0
_LAGS = LAGS[::5]  # a bounded fit at each is dear


@dataclass(frozen=True)
class Relation:
    """How far one joint's effort follows from its motion.

    Attributes:
        explained: share of the variance, at the best lag that physics allows; None: not tested, `text` says why.
        late: the motion behind the effort; lag: s of it where it is surely another row's and explains something, or 0.
        hold: s of the lag that a held command makes by itself: half a row.
        mend: what would mend it, or nothing; mended: share of the variance that it would explain.
    """

    joint: str
    source: str
    explained: float | None
    late: Late = Late(0.0)
    lag: float = 0.0
    hold: float = 0.0
    mend: str = ""
    mended: float = 0.0
    text: str = ""

    @property
    def refused(self) -> bool:
        """Too little is explained."""
        return self.explained is not None and self.explained < HALF

    @property
    def delay(self) -> float:
        """s by which the motion follows later than a held command would act; 0 where there is no lag."""
        return self.lag - self.hold if self.lag else 0.0


def relations(log: Log, mj_model: mujoco.MjModel, found: Sequence[Effort]) -> list[Relation]:
    """One relation per joint and source of effort (`drives.efforts`)."""
    if not found:
        return []
    top = bandwidth(log)
    cutoffs = sorted({max(3.0, top / 2), top})  # the slower one is the quieter one
    pictures = [_Picture.of(log, mj_model, cutoff) for cutoff in cutoffs]
    related = [_relation(log, mj_model, effort, pictures) for effort in found]
    tested = [r for r in related if r.explained is not None]
    worst = min(tested, key=lambda r: r.explained or 0.0, default=None)
    if worst is not None and (worst.explained or 0.0) < SOUND:
        related[related.index(worst)] = _by_columns(log, mj_model, worst, top)
    return related


def remarks(related: Sequence[Relation]) -> list[Finding]:
    """Refuse a log where at least half of its joints have no effort that fits their motion."""
    best: dict[str, Relation] = {}
    for r in related:
        if r.explained is not None and (r.joint not in best or r.explained > (best[r.joint].explained or 0.0)):
            best[r.joint] = r
    bad = [r for r in best.values() if r.refused]
    out = [Finding("refused" if 2 * len(bad) >= len(best) else "warning", _unrelated(r)) for r in bad]
    for r in (r for r in best.values() if r not in bad):
        if (r.explained or 0.0) < SOUND:
            text = f"{r.joint}: no model explains {percent(1 - (r.explained or 0.0))} of its effort ({r.source})"
            out.append(Finding("warning", f"{text} ({r.mend})" if r.mend else text))
        if r.lag:
            text = f"{r.joint} follows its {'command' if r.source == 'ctrl' else 'logged effort'}"
            size = f"{1e3 * abs(r.delay):.0f} ms {'late' if r.delay > 0 else 'early'}"
            physical = 0.0 <= r.lag <= CAUSAL
            out.append(
                Finding("finding", text, r.delay)
                if physical
                else Finding("warning", f"{text} {size}: do the clocks agree?")
            )
    return out


def _unrelated(r: Relation) -> str:
    explained = r.explained or 0.0
    share = percent(min(1.0, 1.0 - explained))
    text = f"effort unrelated to motion: {share} of the effort of {r.joint} ({r.source}) unexplained by any model"
    why = r.mend or "column not aligned in time, wrong scale, or forces that were not logged?"
    return f"{text} ({why})"


def _relation(
    log: Log, mj_model: mujoco.MjModel, effort: Effort, pictures: list[_Picture], laden: bool = False
) -> Relation:
    """laden: with an unknown load, which is no fault of a log."""
    own = Relation(effort.joint, effort.source, None, hold=effort.hold)
    tests = [t for t in (_Test.of(log, effort, p, laden) for p in pictures) if t.independent >= FEWEST]
    if not tests:
        return replace(own, text="too little motion, free of contacts and limits, to compare the effort with")
    if any(t.small for t in tests):
        share = _in_radians(log, mj_model, tests[0])
        if share > SOUND:
            return replace(own, explained=0.0, mend=f"positions in degrees would explain {percent(share)}")
        return replace(own, text="the effort hardly changes against the inertial forces; free motion tests nothing")
    curves = [t.over(_LAGS) for t in tests]
    test, curve = max(zip(tests, curves, strict=True), key=lambda p: float(np.max(p[1])))
    physical = (_LAGS >= 0.0) & (_LAGS <= CAUSAL)
    explained, best = max(float(c[physical].max()) for c in curves), float(curve.max())
    # a periodic motion fits one period later too
    far = explained < SOUND or 1.0 - best <= HALF * (1.0 - explained)
    late = nearest(_LAGS, curve, physical | far, test.independent)
    lag = late.beyond(log.period) if best - curve[len(_LAGS) // 2] > LEAST**2 else 0.0
    relation = replace(own, explained=explained, late=late, lag=lag)
    if explained >= SOUND and not relation.lag:
        return relation
    share, mend = (best, "") if explained >= SOUND else _mend(log, mj_model, relation, curve, test)
    if not laden:
        other = _relation(log, mj_model, effort, pictures, laden=True)
        if (other.explained or 0.0) > max(SOUND, 1.0 - HALF * (1.0 - share)):
            return other
    return replace(relation, mend=mend, mended=share)


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
        for body, place, heaviest in _at_the_ends(model):
            sets.append(np.zeros_like(inertia))
            sets[-1][moving.index(body)] = inertial(1.0, place, np.zeros((3, 3)))
            most.append(heaviest)
        moved, loads = motion(log, model, cutoff), len(sets) - len(moving)
        return cls(Regressor.of(model, moved, sets=np.array(sets), loads=loads), len(moving), np.array(most))

    def bounded(self, dof: int, laden: bool) -> Bounded:
        """Return the linear model of the effort at one degree of freedom.

        Inertias within FACTOR, springs and friction only with the sign of springs and friction, gravity tilted as far
        as the effect of that name, any offset, and with `laden` loads.
        """
        own, shown = self.own, lambda x: np.abs(x).max(axis=0) > 1e-9
        loose = np.stack([own.own[n][:, dof] for n in LOOSE], 1)
        loose[:, -1] -= loose[:, -1].mean()
        parts = np.column_stack([own.columns[:, dof, : self.bodies], own.spring[:, dof]])
        load, tilt = own.columns[:, dof, self.bodies :], own.tilt[:, dof]
        felt = shown(load) & laden
        parts, tilt = parts[:, shown(parts)], tilt[:, shown(tilt)]
        x = np.column_stack([loose, parts, tilt, load[:, felt]])
        rigid, turned = np.ones(parts.shape[1]), np.full(tilt.shape[1], GravityTilt.quantities[0].high)
        low = np.concatenate([[-np.inf], np.zeros(len(LOOSE) - 1), rigid / FACTOR, -turned, np.zeros(felt.sum())])
        high = np.concatenate([np.full(len(LOOSE), np.inf), rigid * FACTOR, turned, self.most[felt]])
        return Bounded(x, low, high, slice(len(LOOSE), len(LOOSE) + len(rigid)))


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
        return self.picture.own.moved.filtered(self.effort.signal, self.log)

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
        signals = self.picture.own.moved.filtered(self.effort.signal, self.log, lags)
        return self.model.explained(signals, self.rows, self.effort.scaled)

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


def _mend(log: Log, mj_model: mujoco.MjModel, now: Relation, curve: Array, test: _Test) -> tuple[float, str]:
    """One remedy that would explain the effort: (how much of it, in words or nothing)."""
    remedies = [
        (float(curve.max()) if now.lag else 0.0, f"shifting the command by {now.delay:+.3f} s"),
        (test.share(sign=-1.0), "the opposite sign"),
        (_in_radians(log, mj_model, test), "positions in degrees"),
        (test.share(scaled=False) if test.effort.scaled else 0.0, "another scale of the command"),
    ]
    share, mend = next((r for r in remedies if r[0] > SOUND), (0.0, ""))
    if mend:
        return share, f"{mend} would explain {percent(share)}"
    spans = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in test.pieces())
    return 0.0, f"the part from {spans} alone can be explained: cut the file there" if spans else ""


def _by_columns(log: Log, mj_model: mujoco.MjModel, now: Relation, cutoff: float) -> Relation:
    """With the mend that explains the effort: a position of the other sign, or columns exchanged with another joint."""
    drive_of = {log.joints[int(mj_model.dof_jntid[d])]: i for i in range(mj_model.nu)
                if (d := dof_of(mj_model, i)) is not None}  # fmt: skip
    mine, q, v = drive_of[now.joint], np.arange(log.qpos.shape[1]), np.arange(log.qvel.shape[1])
    other = moved_most(sheet_of(log), log.actuators[mine], now.joint)
    pair = [now.joint, *([other] if other in drive_of else [])]
    at_q, at_v = ([log.channels.columns(joint, stream).start for joint in pair] for stream in ("qpos", "qvel"))
    trials = []
    for joint, a, b in zip(pair, at_q, at_v, strict=True):
        turned = replace(log, qpos=log.qpos * np.where(q == a, -1.0, 1.0), qvel=log.qvel * np.where(v == b, -1.0, 1.0))
        trials.append((turned, f"the opposite sign of the position of {joint}"))
    if len(pair) > 1:
        u, own = np.arange(log.ctrl.shape[1]), [mine, drive_of[other]]
        for order, columns in ((q, at_q), (v, at_v), (u, own)):
            order[columns] = columns[::-1]
        names = [f"effort:{log.actuators[i]}" for i in own]
        streams = {new: log.streams[old] for new, old in zip(names, names[::-1], strict=True) if old in log.streams}
        words = crossing(other, log.actuators[mine], now.joint, log.actuators[own[1]])
        positions = replace(log, qpos=log.qpos[:, q], qvel=log.qvel[:, v])
        commands = replace(log, ctrl=log.ctrl[:, u], streams={**log.streams, **streams})
        trials += [(positions, f"{words} Exchanged positions"), (commands, f"{words} Exchanged commands")]
    for changed, text in trials:
        picture = _Picture.of(changed, mj_model, cutoff)
        mended = [e for e in efforts(changed, mj_model) if (e.joint, e.source) == (now.joint, now.source)]
        share = max((_Test.of(changed, e, picture).share() for e in mended), default=0.0)
        if share > SOUND and share - max(now.mended, now.explained or 0.0) > LEAST:
            now = replace(now, mend=f"{text} would explain {percent(share)}", mended=share)
    return now


def _in_radians(log: Log, mj_model: mujoco.MjModel, test: _Test) -> float:
    """Share explained if the positions were degrees; 0 where they are too small for that."""
    if np.abs(log.qpos).max() < 6.0:
        return 0.0
    radians = replace(log, qpos=np.radians(log.qpos), qvel=np.radians(log.qvel))
    return _Test.of(radians, test.effort, _Picture.of(radians, mj_model, test.cutoff)).share()


def _at_the_ends(model: mujoco.MjModel) -> Iterator[tuple[int, Array, float]]:
    """(body, place `[3]` m in its frame, kg that may be there), at and around the last links' centres of mass."""
    jointed = np.flatnonzero(model.body_jntnum)
    above = {int(model.body_weldid[model.body_parentid[b]]) for b in jointed}
    for body in (int(b) for b in jointed if int(b) not in above):
        for side in np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]):
            yield body, model.body_ipos[body] + reach(model, body) * side, tree_mass(model, body)
