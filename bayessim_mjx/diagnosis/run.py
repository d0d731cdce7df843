"""The diagnosis from logs to result: gate, known parameters, race, verdict, how far, where, next experiment."""

from __future__ import annotations

import importlib.metadata
import warnings as python_warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis import candidates, gap, scales, search, uncertainty, verdict, windows
from bayessim_mjx.diagnosis.fit import Fitter
from bayessim_mjx.diagnosis.models import Model
from bayessim_mjx.diagnosis.result import Diagnosis, Estimate, FoundEffect, Gap, Place
from bayessim_mjx.diagnosis.robot import Robot
from bayessim_mjx.diagnosis.simulate import Simulator
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import Physics

WINDOW = 0.5  # s
SHORTEST = 0.004  # s, control period of the diagnosis; faster logs are resampled
LIMITS = ((1, 160), (3, 96), (7, 64), (100, 48))  # (up to so many dofs, windows)
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is fixed before the race."""

    robot: Robot
    physics: Physics
    logs: tuple[Log, ...]
    fitter: Fitter
    candidates: list[candidates.Candidate]
    scales: scales.Scales
    settings: search.Settings
    seed: int
    warnings: list[str] = field(default_factory=list)


def control_period(robot: Robot, logs: Sequence[Log]) -> float:
    """s: the task's, else the logs' own, or a multiple of it that is not too short to simulate."""
    if robot.control_dt is not None:
        return robot.control_dt
    period = float(np.median([log.period for log in logs]))
    return period * max(1, int(np.ceil(SHORTEST / period - 1e-6)))


def prepare(
    robot: Robot,
    logs: Sequence[Log],
    effects: str | Sequence[str | type[Effect]] = "all",
    *,
    group: str | None = None,
    seed: int = 0,
    settings: search.Settings | None = None,
    use_qvel: bool = True,
) -> Setup:
    """Compile-ready set-up from logs that passed the gate.

    Raises:
        UserError: unknown effects, logs too short.
    """
    dt = control_period(robot, logs)
    length = int(np.clip(round(WINDOW / dt), 8, 100))
    names = library.names() if effects == "all" else list(effects)
    kinds = [library.load(n) if isinstance(n, str) else n for n in names]
    plain = robot.physics(dt)
    even = [log for log in logs]
    size = scales.measure(robot.mj_model, even)
    stack, _ = candidates.stack(kinds, robot.space, size)
    physics = robot.physics(dt, stack)
    limit = next(n for dofs, n in LIMITS if robot.mj_model.nv <= dofs)
    cut = windows.cut(logs, physics.mj_model, dt, plain.substeps, length, limit=limit, group=group, use_qvel=use_qvel)
    fitter = Fitter(Simulator(physics, cut), candidates.base_coordinates(robot.space), physics.space.nominal)
    every = candidates.enumerate_candidates(physics)
    return Setup(robot, physics, tuple(logs), fitter, every, size, settings or search.Settings(), seed)


def diagnose(
    robot: Robot,
    logs: Sequence[Log],
    effects: str | Sequence[str | type[Effect]] = "all",
    *,
    group: str | None = None,
    seed: int = 0,
    settings: search.Settings | None = None,
    progress: Progress | None = None,
) -> tuple[Diagnosis, Setup, search.Race]:
    """The whole diagnosis."""
    say = progress or (lambda text, done, total: None)
    setup = prepare(robot, logs, effects, group=group, seed=seed, settings=settings)
    race = search.run(setup.fitter, setup.candidates, setup.settings, say)
    ruling = verdict.rule(race, say)
    return _assemble(setup, race, ruling, say), setup, race


def _assemble(setup: Setup, race: search.Race, ruling: verdict.Ruling, say: Progress) -> Diagnosis:
    fitter, model = setup.fitter, ruling.model
    cut = fitter.simulator.windows
    predictions = {"nominal": gap.nominal(fitter, race.nominal), "calibrated": gap.predict(fitter, race.base)}
    predictions["with_effects"] = gap.predict(fitter, model) if model.effects else predictions["calibrated"]
    name = _verdict(race, ruling)
    sd = uncertainty.deviations(fitter, model)
    found = _effects(setup, race, ruling, predictions, sd, say) if model.effects else []
    return Diagnosis(
        verdict=name,
        sentences=[],
        effects=found,
        where=[],
        gap=_gap(setup, predictions),
        parameters=_parameters(race, model, sd),
        candidates=_ranking(race),
        warnings=list(setup.warnings),
        next_experiment={},
        versions=versions(),
    )


def _verdict(race: search.Race, ruling: verdict.Ruling) -> str:
    if ruling.model.effects:
        return "ambiguous" if ruling.ambiguous else "effects"
    floor = race.noise * len(race.base.cost) * race.settings.floor**2
    q, _ = race.nominal.quadratic(race.fitter.spread)
    moved = q.c.sum() > max(1.1 * race.base.total, floor)
    return "parameters" if moved else "no_gap"


def _effects(
    setup: Setup, race: search.Race, ruling: verdict.Ruling, predictions: dict, sd: np.ndarray, say: Progress
) -> list:
    fitter, model = setup.fitter, ruling.model
    group = fitter.simulator.windows.group
    shares = verdict.shapley(race, model, say)
    steps = fitter.simulator.windows.steps
    reference = min(1.0, float(predictions["with_effects"].cost(steps).mean()))
    out = []
    for effect in model.effects:
        own = [model.job.names.index(c.name) for c in effect.coordinates]
        rivals = ruling.rivals.get(effect.label, [])
        rest = verdict.without(race, model, effect, say)
        before = gap.predict(fitter, rest) if rest.effects else predictions["calibrated"]
        closed, ci = gap.closure(
            before.cost(steps), predictions["with_effects"].cost(steps), reference, group, setup.seed
        )
        weights = uncertainty.win_share(
            [model, *(r.model for r in rivals if not r.contains)], group, race.noise, np.random.default_rng(setup.seed)
        )
        out.append(FoundEffect(
            name=effect.effect,
            where=effect.where,
            parameters={c.name.rsplit(".", 1)[1]: Estimate(float(model.job.values[i]), float(sd[i]), c.unit) for i, c in zip(own, effect.coordinates, strict=True)},
            probability=float(weights[0]),
            gap_closed=closed,
            gap_closed_ci=ci,
            equivalent_to=[r.to_dict() for r in rivals],
            share=shares.get(effect.label, float("nan")),
        ))  # fmt: skip
    return sorted(out, key=lambda e: -e.share if e.share == e.share else -e.gap_closed)


def _gap(setup: Setup, predictions: dict[str, gap.Prediction]) -> Gap:
    cut = setup.fitter.simulator.windows
    lengths = {
        "10 control steps": min(10, cut.steps),
        "0.25 s": max(1, round(0.25 / cut.dt)),
        f"{cut.steps * cut.dt:.2g} s": cut.steps,
    }
    horizons = []
    for name, steps in lengths.items():
        horizons.append(
            {"name": name, "seconds": steps * cut.dt, **gap.stages(predictions, None, steps, cut.group, setup.seed)}
        )
    whole = horizons[-1]
    names = _dof_names(setup.physics.mj_model)
    by_channel = {
        joint: {stage: float(np.sqrt(p.cost(cut.steps, slice(i, i + 1)).mean())) for stage, p in predictions.items()}
        for i, joint in enumerate(names)
    }
    physical = {
        joint: {s: v * float(cut.sigma_q[i]) for s, v in by_channel[joint].items()} for i, joint in enumerate(names)
    }
    return Gap(1.0, whole["nominal"], whole["calibrated"], whole["with_effects"], min(1.0, whole["with_effects"]), by_channel=by_channel, horizons=horizons, physical=physical)  # fmt: skip


def _dof_names(model: mujoco.MjModel) -> list[str]:
    out = [""] * model.nv
    for j in range(model.njnt):
        name = model.joint(j).name or f"joint{j}"
        width = {0: 6, 1: 3}.get(int(model.jnt_type[j]), 1)
        for k in range(width):
            out[int(model.jnt_dofadr[j]) + k] = name if width == 1 else f"{name}[{k}]"
    return out


def _parameters(race: search.Race, model: Model, sd: np.ndarray) -> dict[str, dict[str, Any]]:
    remarks = verdict.structural(race, model, sd)
    return {
        c.name: {"mean": float(model.job.values[i]), "sd": float(sd[i]), "nominal": c.neutral, "low": c.low, "high": c.high, "unit": c.unit, "structural": remarks.get(c.name, "")}
        for i, c in enumerate(race.fitter.base)
    }  # fmt: skip


def _ranking(race: search.Race) -> list[dict[str, Any]]:
    out = []
    for model in search.ranked(race)[:40]:
        c = race.better(race.base, model)
        group = race.fitter.simulator.windows.group
        gain = race.base.cost - model.cost
        sums = np.array([gain[group == g].sum() for g in np.unique(group)])
        se = float(np.std(sums, ddof=1) * np.sqrt(len(sums))) if len(sums) > 1 else float("nan")
        above = max(race.base.total - race.noise * len(race.base.cost), 1e-9)
        out.append({
            "effects": [e.label for e in model.effects], "label": model.label, "score": c.evidence, "se": se / above,
            "gap_closed": race.closure(model), "rms": float(np.sqrt(model.total / model.job.r.size)),
            "parameters": dict(zip(model.job.names, map(float, model.job.values), strict=True)),
        })  # fmt: skip
    return out


def versions() -> dict[str, str]:
    """Versions of what the result depends on."""
    return {p: importlib.metadata.version(p) for p in ("bayessim-mjx", "mujoco", "mujoco-mjx", "jax", "numpy")}
