"""The next experiment: which safe motion separates the models that survived, or sharpens the one that is left.

T-optimality with refit (Atkinson and Fedorov, 1975): an experiment is worth what is left of the difference between two
rivals' predictions after the losing one has adapted all it can, against what the logs have already taught it.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import advice, windows
from bayessim_mjx.diagnosis.excitation import Excitation, Limits, limits_of, menu
from bayessim_mjx.diagnosis.fit import Fitter, Job
from bayessim_mjx.diagnosis.models import Model
from bayessim_mjx.diagnosis.quadratic import eliminate, solve
from bayessim_mjx.diagnosis.rehearsal import Drives, Played, Rehearsal
from bayessim_mjx.diagnosis.search import Race, ranked
from bayessim_mjx.diagnosis.uncertainty import win_share
from bayessim_mjx.diagnosis.verdict import MILD, Ruling
from bayessim_mjx.effects.gravity_tilt import tilted

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.run import Setup

Array = NDArray[np.float64]
SECONDS = 10.0
MOST = 4  # models compared
NOTHING = 1.0  # nats: less separates nobody
BUDGET = 24_000  # windows simulated for a first look at the whole menu
FINAL = 5  # experiments looked at in full
WEIGHT = 0.1  # least share of a surviving model


@dataclass(frozen=True, eq=False)
class Scored:
    """One experiment of the menu: mean evidence in nats, that of each pair `[M, M]` (truth, rival), and what it needs."""

    name: str
    played: Played
    evidence: float
    pairs: Array
    needs: str = ""
    sharpened: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Experiment:
    """The proposal.

    Attributes:
        name, why, evidence, needs: in words and nats; pairs: [{"a", "b", "evidence"}].
        table: every experiment with its evidence, best first; witnesses: streams worth logging as well.
        chosen: what is to be played, None where nothing helps; menu: best ones in full; drives, limits: of the robot.
        labels: of the models.
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

    def to_dict(self, file: str = "") -> dict[str, Any]:
        """For diagnosis.json."""
        own = {k: getattr(self, k) for k in ("name", "why", "evidence", "pairs", "table", "needs", "witnesses")}
        return own | {"file": file if self.chosen is not None else ""}

    def details(self) -> list[dict[str, Any]]:
        """For the report's pictures: [{"name", "evidence", "pairs", "command": {"time", "ctrl": {actuator: values}}}]."""
        out = []
        for s in self.menu:
            log = s.played.log
            command = {"time": log.time.tolist(), "ctrl": {n: c.tolist() for n, c in zip(log.actuators, log.ctrl.T, strict=True)}}  # fmt: skip
            out.append(
                {"name": s.name, "evidence": s.evidence, "pairs": _named(s.pairs, self.labels), "command": command}
            )
        return out


class Scorer:
    """Evidence of experiments, simulated by the diagnosis' own compiled program.

    Attributes:
        models: rivals; posterior: `[M]` precisions `[k, k]` from the logs; ratio: effective share of samples; misfit: of
            each model in noise variances.
    """

    def __init__(self, setup: Setup, models: Sequence[Model], weights: Array) -> None:
        self.setup, self.fitter, self.models, self.weights = setup, setup.fitter, list(models), weights
        count = models[0].job.r.size
        self.ratio = np.array([min(m.samples / count, 1.0) for m in models])
        self.misfit = np.array([max(m.total / count, 0.5) for m in models])
        self.posterior = [self._posterior(m, k) for m, k in zip(models, self.ratio / self.misfit, strict=True)]

    def _posterior(self, model: Model, discount: float) -> Array:
        q, _ = model.job.quadratic(self.fitter.spread)
        _, S = q.weighted(model.job.weight)
        return discount * S + np.diag(model.job.prior()[0])

    def score(self, played: Sequence[Played], shift: Array, each: int) -> list[Array]:
        """Evidence `[M, M]` in nats of every experiment: row the truth, column the rival that adapts.

        Args:
            shift: `[P]`, added to every theta (a known payload, another mount); each: windows looked at per experiment.

        The diagonal holds, for the truth itself, log(sd before / sd after) of its least certain parameter.
        """
        logs = [p.log for p in played]
        original = self.fitter.simulator.windows
        cut = windows.cut(
            logs, self.setup.physics.mj_model, original.dt, self.setup.physics.substeps, original.steps, limit=each * len(logs)
        )  # fmt: skip
        found = [self._jobs(chunk, shift) for chunk in _chunks(cut, original)]
        full = (len(logs[0]) - 1) // original.steps
        out = []
        for k in range(len(logs)):
            own = np.flatnonzero(cut.log == k)
            where = [(jobs, own[(own >= a) & (own < a + len(original))] - a) for a, jobs in zip(range(0, len(cut), len(original)), found, strict=True)]  # fmt: skip
            out.append(self._evidence([w for w in where if len(w[1])], full / max(len(own), 1), full))
        return out

    def _jobs(self, chunk: windows.Windows, shift: Array) -> list[Job]:
        simulator = copy.copy(self.fitter.simulator)  # shares the compiled program
        simulator.windows = chunk
        fitter = _Shifted(self.fitter, simulator, shift)
        jobs = [fitter.begin(m.job.coordinates, m.job.values) for m in self.models]
        self.fitter.simulator.rollouts = simulator.rollouts
        return jobs

    def _evidence(self, where: list[tuple[list[Job], NDArray[np.int64]]], scale: float, full: int) -> Array:
        m = len(self.models)
        out = np.zeros((m, m))
        for i in range(m):
            for j in range(m):
                out[i, j] = self._adapted(where, i, j, scale, full) if i != j else self._sharper(where, i, scale)
        return out

    def _quadratic(self, where: list, i: int, j: int) -> tuple[float, Array, Array]:
        """Sums over the windows of the squared difference between truth i and rival j, as a quadratic in j's parameters."""
        c, g, S = 0.0, np.zeros(self.models[j].size), np.zeros((self.models[j].size,) * 2)
        for jobs, some in where:
            r = (jobs[j].r - jobs[i].r)[some]
            q, _ = eliminate(
                r, jobs[j].A[some], jobs[j].B[some], np.zeros_like(jobs[j].offsets[some]), self.fitter.spread
            )
            c, g, S = c + q.c.sum(), g + q.g.sum(0), S + q.S.sum(0)
        return float(c), g, S

    def _adapted(self, where: list, i: int, j: int, scale: float, full: int) -> float:
        """min over dp of discount |y_i - y_j(p_j + dp)|^2 + dp' (posterior) dp; evidence N/2 log(1 + D/N), for small D D/2."""
        c, g, S = self._quadratic(where, i, j)
        discount = scale * self.ratio[i] / self.misfit[i]
        _, _, low, high = self.models[j].job.prior()
        H = discount * S + self.posterior[j]
        p = solve(H, discount * g, low, high)
        D = max(discount * c - 2 * discount * float(g @ p) + float(p @ H @ p), 0.0)
        samples = full * self.fitter.size * self.ratio[i]
        return float(0.5 * samples * np.log1p(D / samples))

    def _sharper(self, where: list, i: int, scale: float) -> float:
        _, _, S = self._quadratic(where, i, i)
        worst, before = self.loosest(i)
        after = np.linalg.pinv(self.posterior[i] + scale * self.ratio[i] / self.misfit[i] * S)[worst, worst]
        return float(0.5 * np.log(before / max(after, 1e-300)))

    def loosest(self, i: int) -> tuple[int, float]:
        """(index, variance) of model i's least certain parameter, relative to its range; effects' before known ones."""
        variance = np.diag(np.linalg.pinv(self.posterior[i]))
        coordinates, base = self.models[i].job.coordinates, len(self.fitter.base)
        relative = np.sqrt(variance) / np.array([c.high - c.low for c in coordinates])
        first = base if len(coordinates) > base else 0
        worst = first + int(np.argmax(relative[first:]))
        return worst, float(variance[worst])

    def mean(self, pairs: Array) -> float:
        """Evidence over all pairs, weighted by how probable the two are."""
        w = np.outer(self.weights, self.weights) * (1 - np.eye(len(self.weights)))
        return float((w * pairs).sum() / w.sum()) if w.sum() else float(pairs[0, 0])


class _Shifted(Fitter):
    """The same fitter on other windows, with something known added to every theta."""

    def __init__(self, fitter: Fitter, simulator: Any, shift: Array) -> None:
        self.__dict__.update(fitter.__dict__)
        self.simulator, self.shift = simulator, shift

    def vector(self, coordinates: Any, values: Array) -> Array:
        return super().vector(coordinates, values) + self.shift


def _chunks(cut: windows.Windows, like: windows.Windows) -> list[windows.Windows]:
    """Windows in pieces of the size that the program was compiled for, the last one filled up."""
    batch, size, out = cut.batch, len(like), []
    if like.batch.enabled is not None and batch.enabled is None:
        batch = batch.replace(enabled=np.ones((len(cut), cut.steps, batch.command.shape[-1]), np.float32))
    for a in range(0, len(cut), size):
        index = np.minimum(np.arange(a, a + size), len(cut) - 1)
        own = jax.tree.map(lambda x: jax.numpy.asarray(x)[index], batch)  # noqa: B023  # used at once
        out.append(replace(cut, batch=own, log=cut.log[index], start=cut.start[index], group=cut.group[index]))
    return out


def propose(
    setup: Setup,
    race: Race,
    ruling: Ruling,
    rivals_models: Sequence[Model] | None = None,
    limits: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> Experiment:
    """The experiment that separates the surviving models best, within the limits.

    Args:
        rivals_models: models to be told from the winner; None: the ruling's rivals, and without any the closest losers.
        limits: see `excitation.limits_of`.
    """
    cut, model = setup.fitter.simulator.windows, setup.physics.mj_model
    models, contested = _contenders(race, ruling, rivals_models)
    weights = np.maximum(win_share(models, cut.group, race.noise, np.random.default_rng(seed)), WEIGHT)
    scorer = Scorer(setup, models, weights)
    allowed = limits_of(model, cut.logs, limits)
    rows = max(cut.steps, int(round(SECONDS / cut.dt)) // cut.steps * cut.steps)
    time = cut.dt * np.arange(rows)
    effects = {c.effect for m in models for c in m.effects} | {"payload", "gravity_tilt"}
    stage = Rehearsal(setup, effects, time, allowed)
    joints = _touched(stage.drives.joints(), models, model)
    every = menu(time, joints, stage.half, allowed.speed, stage.release, seed) if joints else []
    scored = _look(scorer, stage, every)
    attended = _with_help(scorer, stage, scored, model)
    final = _in_full(scorer, stage, scored, attended)
    return _decide(scorer, stage, final, scored, attended, contested)


def _contenders(race: Race, ruling: Ruling, given: Sequence[Model] | None) -> tuple[list[Model], bool]:
    """(winner and rivals, whether the logs left it open between them)."""
    found = [r.model for rivals in ruling.rivals.values() for r in rivals if not r.contains] if given is None else given
    found = list({id(m): m for m in found if m is not ruling.model}.values())
    if found:
        return [ruling.model, *found[: MOST - 1]], True
    own = {c.effect for c in ruling.model.effects}
    losers = [m for m in ranked(race) if m is not ruling.model and not {c.effect for c in m.effects} & own]
    close = [m for m in losers if abs(race.better(m, ruling.model).evidence) < 3 * MILD and (m.effects or own)]
    if not ruling.model.effects:  # nothing is wrong as far as these logs can tell: what could still hide?
        close = close[:2]
    return [ruling.model, *close[: MOST - 2]], False


def _touched(joints: dict[str, int], models: Sequence[Model], model: Any) -> dict[str, int]:
    """Driven joints that the models disagree about: named by an effect, at or above its body; all where it is the world."""
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
    return np.stack([vector(m.job.coordinates, m.job.values) + shift for m in scorer.models])


def _look(scorer: Scorer, stage: Rehearsal, every: Sequence[Excitation]) -> list[Scored]:
    """A first look at the whole menu, on as many windows as the budget allows, best first."""
    shift = np.zeros(len(scorer.fitter.theta))
    played = [p for p in stage.play(every, _thetas(scorer, shift)) if p.safe] if every else []
    if not played:
        return []
    columns = sum(1 + m.size + 2 * scorer.fitter.simulator.nv for m in scorer.models)
    full = (len(stage.time)) // scorer.fitter.simulator.windows.steps
    each = int(np.clip(BUDGET / (columns * len(played)), 2, full))
    pairs = scorer.score(played, shift, each)
    return sorted((_scored(scorer, p, e) for p, e in zip(played, pairs, strict=True)), key=lambda s: -s.evidence)


def _scored(scorer: Scorer, played: Played, pairs: Array, help_: advice.Help | None = None) -> Scored:
    name = played.excitation.name + (f", {help_.name}" if help_ else "")
    return Scored(name, played, scorer.mean(pairs), pairs, help_.needs if help_ else "")


def _with_help(scorer: Scorer, stage: Rehearsal, scored: list[Scored], model: Any) -> list[Scored]:
    """The best three motions again, with a known payload and with the robot mounted on its side."""
    out = []
    top = [s.played.excitation for s in scored[:3]]
    for own in advice.helps(scorer.setup) if top else []:
        gravity = np.asarray(tilted(np.asarray(model.opt.gravity), *own.tilt))
        played = [p for p in stage.play(top, _thetas(scorer, own.shift), gravity) if p.safe]
        full = len(stage.time) // scorer.fitter.simulator.windows.steps
        if played:
            pairs = scorer.score(played, own.shift, max(2, full // 3))
            out += [_scored(scorer, p, e, own) for p, e in zip(played, pairs, strict=True)]
    return sorted(out, key=lambda s: -s.evidence)


def _in_full(scorer: Scorer, stage: Rehearsal, scored: list[Scored], attended: list[Scored]) -> list[Scored]:
    """The best ones on all of their windows."""
    if not scored:
        return []
    full = len(stage.time) // scorer.fitter.simulator.windows.steps
    best = [s.played for s in scored[:FINAL]]
    pairs = scorer.score(best, np.zeros(len(scorer.fitter.theta)), full)
    exact = [_scored(scorer, p, e) for p, e in zip(best, pairs, strict=True)]
    return sorted([*exact, *attended[:2]], key=lambda s: -s.evidence)


def _decide(
    scorer: Scorer, stage: Rehearsal, final: list[Scored], scored: list[Scored], attended: list[Scored], contested: bool
) -> Experiment:
    labels = [advice.title(m) for m in scorer.models]
    alone = [s for s in final if not s.needs]
    chosen = alone[0] if alone else None
    helped = next((s for s in final if s.needs), None)
    if helped and (chosen is None or (chosen.evidence < MILD and helped.evidence > 1.5 * chosen.evidence + NOTHING)):
        chosen = helped
    useful = chosen is not None and (chosen.evidence > NOTHING or (len(labels) == 1 and chosen.evidence > 0.1))
    why = advice.reason(scorer, chosen, labels, contested, useful, stage.limits)
    witnesses = advice.witnesses(scorer.models, scorer.fitter.simulator.windows.logs)
    kept = {s.name for s in final}
    table = [*final, *(s for s in [*scored, *attended] if s.name not in kept)]
    return Experiment(
        name=chosen.name if chosen is not None and useful else "none",
        why=why,
        evidence=chosen.evidence if chosen is not None else 0.0,
        pairs=_named(chosen.pairs, labels) if chosen is not None else [],
        table=[{"experiment": s.name, "evidence": round(s.evidence, 2), "needs": s.needs} for s in sorted(table, key=lambda s: -s.evidence)],
        needs=chosen.needs if chosen is not None and useful else advice.instead(scorer.models),
        witnesses=witnesses,
        chosen=chosen if useful else None,
        menu=final,
        drives=stage.drives,
        limits=stage.limits,
        labels=labels,
    )  # fmt: skip


def _named(pairs: Array, labels: Sequence[str]) -> list[dict[str, Any]]:
    """The mean of both directions of every pair."""
    n = len(labels)
    return [
        {"a": labels[i], "b": labels[j], "evidence": float(pairs[i, j] + pairs[j, i]) / 2}
        for i in range(n)
        for j in range(i + 1, n)
    ]
