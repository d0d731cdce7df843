"""The next experiment: which safe motion separates the models that survived, or sharpens the one that is left."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.selecting import Selection
from bayessim_mjx.diagnosis.experiment.design import Scored, Scorer
from bayessim_mjx.diagnosis.experiment.limits import Drives, Excitation, Limits, Room, limits_of, menu
from bayessim_mjx.diagnosis.experiment.rehearsal import Played, Rehearsal
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.phrases import advice as phrases
from bayessim_mjx.diagnosis.phrases.effects import all_of
from bayessim_mjx.diagnosis.selection.models import Model, nats
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, ODDS, Progress
from bayessim_mjx.diagnosis.selection.search_state import ranked
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.effects.support.bodies import tilted
from bayessim_mjx.effects.support.words import words
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Size:
    """Of a proposal. Rules of thumb, not measured.

    Attributes:
        seconds: of an experiment; final: experiments that are looked at in full, and rivals that they have to tell
            from the answer.
    """

    seconds: float = 10.0
    final: int = 3


SIZE = Size()
MENTION, STRONG = math.log(ODDS.mention), math.log(ODDS.strong)  # nats: less separates no models, is called a tie


@dataclass(frozen=True, eq=False)
class Experiment:
    """The proposal.

    Attributes:
        name, why, evidence, needs: in words and nats; pairs: [{"a", "b", "evidence"}].
        table: every experiment with its evidence, best first; witnesses: streams worth logging as well.
        chosen: what is to be played, None where nothing helps; menu: best ones in full; drives, limits: of the robot.
        labels: of the models; unsafe: motions that left the limits however small they were made.
    """

    name: str
    why: str
    evidence: float
    pairs: list[dict[str, Any]]
    table: list[dict[str, Any]]
    needs: str
    witnesses: list[str]
    chosen: Scored | None
    menu: list[Scored]
    drives: Drives
    limits: Limits
    labels: list[str] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)

    def to_dict(self, file: str = "") -> dict[str, Any]:
        """For diagnosis.json."""
        names = ("name", "why", "evidence", "pairs", "table", "needs", "witnesses", "unsafe")
        return {k: getattr(self, k) for k in names} | {"file": file if self.chosen is not None else ""}

    def details(self) -> list[dict[str, Any]]:
        """For the report: [{"name", "evidence", "pairs", "command": {"time", "ctrl": {actuator: values}}}]."""
        out = []
        for s in self.menu:
            log, pairs = s.played.log, _named(s.pairs, self.labels)
            ctrl = {n: c.tolist() for n, c in zip(log.actuators, log.ctrl.T, strict=True)}
            command = {"time": log.time.tolist(), "ctrl": ctrl}
            out.append({"name": s.name, "evidence": s.evidence, "pairs": pairs, "command": command})
        return out


def stage(found: Findings, say: Progress) -> Findings:
    """With a proposal, where there is anything left to tell apart."""
    wanted = found.model.effects or found.selection.state.above_noise(found.selection.state.base)
    return found.having(propose(found)) if wanted else found


def propose(
    found: Findings, rivals_models: Sequence[Model] | None = None, limits: Mapping[str, Any] | None = None
) -> Experiment:
    """Return the experiment that separates the surviving models best, within the limits.

    Args:
        rivals_models: models to be told from the winner; None: its rivals, and without any the closest losers.
        limits: see `limits.limits_of`.
    """
    setup = found.setup
    cut, model = setup.fitter.simulator.windows, setup.physics.mj_model
    models, contested = _contenders(found.selection, rivals_models)
    known = found.selection.weighed.weight
    weights = np.array([known.get(frozenset(c.label for c in m.effects), 0.0) for m in models])
    weights = np.maximum(weights / max(weights.sum(), 1e-300), 1 / ODDS.strong)  # else it were no rival
    scorer = Scorer(setup, models, weights)
    allowed = limits_of(model, cut.logs, limits)
    rows = max(cut.steps, int(round(SIZE.seconds / cut.dt)) // cut.steps * cut.steps)
    time = np.asarray(cut.dt * np.arange(rows), np.float64)
    effects = {c.effect for m in models for c in m.effects} | {"payload", "gravity_tilt"}
    stand = Rehearsal(setup, effects, time, allowed)
    joints = _touched(stand.drives.joints(), models, model)
    loaded = sorted(joints, key=lambda n: -setup.scales.force[joints[n]])[: max(len(models) - 1, 1)]  # one per rival
    room = Room(time, stand.half, allowed.speed)
    every = menu(room, joints, loaded, stand.release) if joints else []
    scored = _look(scorer, stand, every)
    attended = _with_help(scorer, stand, scored, model)
    final = _in_full(scorer, stand, scored, attended)
    safe = {s.played.excitation.name for s in scored}
    chosen = _decide(scorer, stand, final, [*scored, *attended], contested)
    return replace(chosen, unsafe=[e.name for e in every if e.name not in safe])


def _contenders(of: Selection, given: Sequence[Model] | None) -> tuple[list[Model], bool]:
    """(winner and rivals, whether the logs left it open between them)."""
    found = [r.model for rivals in of.rivals.values() for r in rivals if not r.contains] if given is None else given
    found = list({id(m): m for m in found if m is not of.answer}.values())
    if found:
        return [of.answer, *found[: SIZE.final]], True
    own = {c.effect for c in of.answer.effects}
    losers = [m for m in ranked(of.state) if m is not of.answer and not {c.effect for c in m.effects} & own]
    close = [m for m in losers if abs(nats(m, of.answer)) < EFFORT.margin and (m.effects or own)]
    return [of.answer, *close[: SIZE.final - 1]], False


def _touched(joints: dict[str, int], models: Sequence[Model], model: Any) -> dict[str, int]:
    """Driven joints that the models disagree about: named by an effect, at or above its body; for the world all."""
    places = {(c.kind, c.where) for m in models for c in m.effects}
    names: set[str] = set()
    for kind, where in places:
        if where == "all" or kind in ("world", "geom"):
            return joints
        if kind == "joint":
            names.add(where)
        if kind == "actuator":
            names |= {n for n in joints if model.joint(n).id == model.actuator(where).trnid[0]}
        body = model.body(where).id if kind == "body" else 0
        while body:
            names |= {n for n in joints if model.jnt_bodyid[model.joint(n).id] == body}
            body = int(model.body_parentid[body])
    own = {n: v for n, v in joints.items() if n in names}
    return own or joints


def _thetas(scorer: Scorer, shift: Array) -> Array:
    vector = scorer.fitter.vector
    return np.stack([vector(m.fit.coordinates, m.fit.values) + shift for m in scorer.models])


def _look(scorer: Scorer, stand: Rehearsal, every: Sequence[Excitation]) -> list[Scored]:
    """Look first at the whole menu, on about as many windows as the logs have, best first."""
    shift = np.zeros(len(scorer.fitter.theta))
    played = [p for p in stand.play(every, _thetas(scorer, shift)) if p.safe] if every else []
    if not played:
        return []
    each = int(np.clip(len(scorer.fitter.simulator.windows) // len(played), 2, stand.count))
    pairs = scorer.score(played, shift, each)
    return sorted((_scored(scorer, p, e) for p, e in zip(played, pairs, strict=True)), key=lambda s: -s.evidence)


def _scored(scorer: Scorer, played: Played, pairs: Array, help_: Help | None = None) -> Scored:
    name = played.excitation.name + (f", {help_.name}" if help_ else "")
    return Scored(name, played, scorer.mean(pairs), pairs, help_.needs if help_ else "")


def _with_help(scorer: Scorer, stand: Rehearsal, scored: list[Scored], model: Any) -> list[Scored]:
    """Play the best two motions again, with a known payload and with the robot mounted on its side."""
    out = []
    top = [s.played.excitation for s in scored[:2]]
    for own in helps(scorer.setup) if top else []:
        gravity = np.asarray(jax.jit(tilted)(model.opt.gravity, *own.tilt))
        played = [p for p in stand.play(top, _thetas(scorer, own.shift), gravity) if p.safe]
        if played:
            pairs = scorer.score(played, own.shift, max(2, stand.count // 3))
            out += [_scored(scorer, p, e, own) for p, e in zip(played, pairs, strict=True)]
    return sorted(out, key=lambda s: -s.evidence)


def _in_full(scorer: Scorer, stand: Rehearsal, scored: list[Scored], attended: list[Scored]) -> list[Scored]:
    """Play the best ones on all of their windows."""
    if not scored:
        return []
    best = [s.played for s in scored[: SIZE.final]]
    pairs = scorer.score(best, np.zeros(len(scorer.fitter.theta)), stand.count)
    exact = [_scored(scorer, p, e) for p, e in zip(best, pairs, strict=True)]
    return sorted([*exact, *attended[:2]], key=lambda s: -s.evidence)


def _decide(scorer: Scorer, stand: Rehearsal, final: list[Scored], looked: list[Scored], contested: bool) -> Experiment:
    labels = [title(m) for m in scorer.models]
    alone = [s for s in final if not s.needs]
    chosen = alone[0] if alone else None
    helped = next((s for s in final if s.needs), None)
    if helped and (chosen is None or (chosen.evidence < STRONG and helped.evidence > chosen.evidence + STRONG)):
        chosen = helped
    useful = chosen is not None and chosen.evidence > (MENTION if len(labels) > 1 else 0.1)
    why = reason(scorer, chosen, labels, contested, useful)
    kept = {s.name for s in final}
    everything = sorted([*final, *(s for s in looked if s.name not in kept)], key=lambda s: -s.evidence)
    return Experiment(
        name=chosen.name if chosen is not None and useful else "none",
        why=why,
        evidence=chosen.evidence if chosen is not None else 0.0,
        pairs=_named(chosen.pairs, labels) if chosen is not None else [],
        table=[{"experiment": s.name, "evidence": round(s.evidence, 2), "needs": s.needs} for s in everything],
        needs=chosen.needs if chosen is not None and useful else instead(scorer.models),
        witnesses=missing_streams(scorer.models, scorer.fitter.simulator.windows.logs),
        chosen=chosen if useful else None,
        menu=final,
        drives=stand.drives,
        limits=stand.limits,
        labels=labels,
    )


def _named(pairs: Array, labels: Sequence[str]) -> list[dict[str, Any]]:
    """Return the mean of both directions of every pair."""
    n = len(labels)
    return [
        {"a": labels[i], "b": labels[j], "evidence": float(pairs[i, j] + pairs[j, i]) / 2}
        for i in range(n)
        for j in range(i + 1, n)
    ]


STANDING = (("turned on its side (90 degrees about the world's x axis)", (math.pi / 2, 0.0)),
            ("turned forward (90 degrees about the world's y axis)", (0.0, math.pi / 2)))  # fmt: skip


@dataclass(frozen=True, eq=False)
class Help:
    """What a person changes: name, instruction, what it adds to theta `[P]`, and the mount's (roll, pitch)."""

    name: str
    needs: str
    shift: Array
    tilt: tuple[float, float] = (0.0, 0.0)


def helps(setup: Setup) -> list[Help]:
    """Offer a known payload on the last body, and two other mounts: where their effects are in the stack."""
    physics, out = setup.physics, []
    for effect in physics.effects:
        *_, last = physics.blocks_of(effect)
        if effect.name == "payload":
            place, own = last.place, last.parameters[0]
            mass = float(f"{(own.low + own.high) / 2:.2g}")
            shift = np.zeros(len(physics.space))
            shift[last.start] = mass
            out.append(Help(*phrases.known_payload(mass, place), shift))
        if effect.name == "gravity_tilt" and not _floats(physics.mj_model):
            for way, tilt in STANDING:
                shift = np.zeros(len(physics.space))
                shift[last.slice] = tilt
                out.append(Help(*phrases.other_mount(way), shift, tilt))
    return out


def _floats(model: mujoco.MjModel) -> bool:
    return bool(np.any(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)))


def title(model: Model) -> str:
    """Of a model, by its effects."""
    return all_of([(c.effect, c.where) for c in model.effects])


def missing_streams(models: Sequence[Model], logs: Sequence[Log]) -> list[str]:
    """Streams that would decide between the models' effects and that the logs do not have."""
    have = {name.split(":", 1)[0] for log in logs for name in log.streams}
    wanted = dict(seen for m in models for c in m.effects if (seen := words(c.effect).witness) is not None)
    return [text for key, text in wanted.items() if key not in have]


def instead(models: Sequence[Model]) -> str:
    """Name what else would separate the models' effects."""
    return phrases.separating(c.effect for m in models for c in m.effects)


def reason(scorer: Scorer, chosen: Scored | None, labels: Sequence[str], contested: bool, useful: bool) -> str:
    """One sentence: the motion, the rivals, the expected evidence."""
    if chosen is None:
        return phrases.nothing_safe(instead(scorer.models))
    action = phrases.run_experiment(chosen.name, chosen.played.log.duration)
    if len(labels) == 1:
        index, variance = scorer.loosest(0)
        c, before = scorer.models[0].fit.coordinates[index], math.sqrt(variance)
        change = c.name, before, before * math.exp(-chosen.evidence)
        allowed = math.sqrt(scorer.allowed(0)[index] / variance)
        return phrases.sharpens(action, *change) if useful else phrases.sharpens_little(chosen.name, *change, allowed)
    if not useful:
        return phrases.separates_nobody(labels, chosen.name, chosen.evidence, instead(scorer.models))
    return phrases.tells_apart(action, labels, chosen.evidence, contested, STRONG)
