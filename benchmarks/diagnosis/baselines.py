"""Baselines of the diagnosis on the very fits that it made: same simulator, windows, known parameters, effects.

Each returns what a diagnosis says (verdict, effects with place, parameters, equivalents), so that one score is for all.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from families import FAMILIES

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.quadratic import RULES, solve
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.models import Model, of_noise
from bayessim_mjx.diagnosis.selection.screen import Screened
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.selection.successive_halving import fit_entries

SINGLES = 24  # effects that are fitted alone
TESTED = 0.3  # share of the operating conditions in the one test set of the single fold
# what the flexible force depends on most -> the effect that a reader would name; not here: nothing that can be named
MEANS = {
    "position": "joint_spring", "speed": "viscous_friction", "direction": "coulomb_friction",
    "stop": "coulomb_friction", "load": "payload", "effort": "actuator_gain", "past": "actuator_delay",
    "pull": "armature", "since_reversal": "backlash",
}  # fmt: skip
Said = dict[str, Any]


def _quiet(text: str, done: int, total: int) -> None:
    """No progress."""


class Reopened:
    """What a diagnosis found, with its pool of models open again: further models are fitted on the same windows."""

    def __init__(self, found: Findings) -> None:
        self.setup, self.predictions, self.flexible_base = found.setup, found.predictions, found.flexible_base
        state = found.selection.state
        self.pool = replace(state, models=dict(state.models), keep=lambda state: None)


def candidate_of(pool: SearchState, name: str, where: str, joint_of: dict[str, str]) -> Candidate | None:
    """The pool's candidate of that name at that place; an actuator and its joint are one place."""
    same = lambda place: joint_of.get(place, place)  # noqa: E731
    found = [c for c in pool.candidates if c.effect == name and same(c.where) == same(where)]
    return found[0] if found else None


def fitted(pool: SearchState, effects: Sequence[Candidate]) -> Model:
    """The model of these effects, fitted one after the other, as the pool does it."""
    screened = {s.candidate.label: s for s in pool.screened}
    model = pool.base
    for effect in effects:
        model = extended(pool, model, [screened[effect.label]])[0]
    return model


def extended(pool: SearchState, model: Model, more: Sequence[Screened]) -> list[Model]:
    """The model with each of some further effects, from its screened start and where it was looked at."""
    entries = {}
    for s in more:
        key = frozenset([*(e.label for e in model.effects), s.candidate.label])
        starts = [pool.fitter.derive(pool.begun(model.fit), s.candidate.coordinates, x) for x in (s.start, *s.others)]
        entries[key] = (starts, (*model.effects, s.candidate))
    fit_entries(pool, {key: entry for key, entry in entries.items() if key not in pool.models}, "", _quiet)
    return [pool.models[key] for key in entries]


def singles(pool: SearchState) -> list[Model]:
    """Every effect at every place that screening gave a chance, also where the pool saw nothing to explain."""
    return extended(pool, pool.base, [s for s in pool.screened if s.gain > 0][:SINGLES])


def closure(found: Reopened, model: Model) -> float:
    """Share of the calibrated gap that a model closes on held-out conditions, as in diagnosis.json."""
    fitter = found.setup.fitter
    cut = fitter.simulator.windows
    after = heldout.predict(fitter, model).cost(cut.steps)
    before = found.predictions["calibrated"].cost(cut.steps)
    return heldout.Closed(before, after, cut.group).value


def told(found: Reopened, model: Model) -> Said:
    """A model as a verdict: each of its effects is named, with intervals."""
    if not model.effects:
        return {"verdict": "parameters", "effects": []}
    sd = np.sqrt(np.diag(of_noise(found.setup.fitter, model)))
    closed = closure(found, model)
    effects = []
    for effect in model.effects:
        own = [model.fit.names.index(c.name) for c in effect.coordinates]
        numbers = {model.fit.names[i].rsplit(".", 1)[1]: {"mean": model.fit.values[i], "sd": sd[i]} for i in own}
        effects.append(_named(effect.effect, effect.where, numbers, closed / len(model.effects)))
    return {"verdict": "effects", "effects": effects}


def _named(name: str, where: str, parameters: Said, closed: float | None, rivals: Sequence[str] = ()) -> Said:
    others = [{"effects": [f"{rival}@{where}"]} for rival in rivals]
    return {"name": name, "where": where, "parameters": parameters, "gap_closed": closed, "equivalent_to": others}


def refit(found: Reopened) -> Said:
    """The known parameters alone, as mujoco.sysid: it never names an effect."""
    return told(found, found.pool.base)


def bic(model: Model) -> float:
    """N log(RSS / N) + k log N (Schwarz, 1978) in sample, every residual counted as independent."""
    q, _ = model.fit.quadratic()
    n = model.fit.r.size
    return float(n * np.log(q.c.sum() / n) + model.size * np.log(n))


def naive_bic(found: Reopened) -> Said:
    """The lowest BIC of all models that were fitted, the known parameters alone among them."""
    pool = found.pool
    return told(found, min(pool.models.values(), key=bic))


def fold_error(model: Model, test: np.ndarray) -> float:
    """Cost of the windows `test` `[W]` (bool) under the estimates from the others, by one Newton step from the fit."""
    q, _ = model.fit.quadratic()
    precision, pull, low, high = model.fit.prior()
    g, S = q.weighted(model.fit.weight * ~test)
    p = solve(S + np.diag(precision + RULES.trust * np.diag(S)), g + pull, low, high)
    return float(np.maximum(q.at(p)[test], 0.0).sum())


def single_fold(found: Reopened) -> Said:
    """The smallest error on one test set of operating conditions, as BAM: no threshold, no interval."""
    pool, group = found.pool, found.pool.fitter.simulator.windows.group
    names = np.unique(group)
    rng = np.random.default_rng(found.setup.seed)
    tested = rng.choice(names, max(1, round(TESTED * len(names))), replace=False)
    test = np.isin(group, tested)
    return told(found, min(pool.models.values(), key=lambda m: fold_error(m, test)))


def importance(found: Reopened) -> Said:
    """What the flexible force depends on most, read as an effect; its family counts as equivalent."""
    flex = found.flexible_base
    if flex is None or not flex.condition.significant or not flex.depends_on:
        return {"verdict": "parameters", "effects": []}
    first = flex.depends_on[0]
    if first["quantity"] not in MEANS:
        return {"verdict": "unexplained", "effects": []}
    name = MEANS[first["quantity"]]
    rivals = sorted({e for family in FAMILIES if name in family for e in family} - {name})
    model = found.setup.physics.mj_model
    where = f"{first['joint']}+{model.body(int(model.joint(first['joint']).bodyid[0])).name}"  # or the body behind it
    whole, left = flex.condition.base.sum(), flex.condition.cost.sum()
    floor = found.pool.noise * len(flex.condition.base)
    closed = float(np.clip((whole - left) / max(whole - min(floor, left), 1e-9), 0.0, 1.0))
    return {"verdict": "effects", "effects": [_named(name, where, {}, closed, rivals)]}


def classifier(found: Reopened) -> Said:
    """A classifier trained on simulations of every candidate on the case's own windows."""
    from lda import classify

    pool = found.pool
    effect = classify(pool.fitter, pool.base.fit, pool.candidates, np.random.default_rng(found.setup.seed))
    return told(found, pool.base if effect is None else fitted(pool, [effect]))


BASELINES: dict[str, Callable[[Reopened], Said]] = {
    "parameter refit": refit,
    "naive BIC": naive_bic,
    "single fold": single_fold,
    "classifier": classifier,
    "flexible importance": importance,
}


def all_baselines(found: Reopened) -> dict[str, Said]:
    """{baseline: what it says}; `seconds` beyond the fits, which all share."""
    started = time.perf_counter()
    singles(found.pool)
    shared = time.perf_counter() - started
    out = {}
    for name, baseline in BASELINES.items():
        started = time.perf_counter()
        said = baseline(found)
        out[name] = said | {"seconds": time.perf_counter() - started, "shared_seconds": shared}
    return out
