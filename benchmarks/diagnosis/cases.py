"""Cases of the diagnosis benchmark: which cause where, how strong, written as model, logs and sealed truth."""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from drawn import DRAWN as KNOWN
from systems import SYSTEMS

from bayessim_mjx.blind.reality.cause import Cause
from bayessim_mjx.blind.reality.menu import CAUSES, UNKNOWN, draw_cause, places
from bayessim_mjx.blind.reality.plant import Plant, Run, base_parameters, scales_of
from bayessim_mjx.blind.reality.strength import Ruler, resize
from bayessim_mjx.blind.reality.system import RUNS, System

__all__ = ["CAUSES", "KNOWN", "STRENGTHS", "SYSTEMS", "UNKNOWN", "Case", "draw_cause", "make_case", "places"]

STRENGTHS = {"weak": 3.0, "medium": 10.0, "strong": 30.0, "severe": 100.0}
SPREAD = 0.2
ACCURACY = f"{100 * SPREAD / math.sqrt(3):.1f}%"  # what a data sheet says whose values are uniform within the spread


@dataclasses.dataclass(frozen=True)
class Case:
    """out/model.xml (nominal), out/logs/, out/truth.json, and the truth as a dict."""

    out: Path
    truth: dict


def make_case(
    system: str,
    effects: Sequence[str | tuple[str, str]],
    strength: str,
    seed: int,
    out: str | Path,
    *,
    velocity: bool | None = None,
    spread: float = SPREAD,
    noise: bool = True,
) -> Case:
    """Write a case.

    Args:
        system: of SYSTEMS.
        effects: names, or (name, where); () is a case in which nothing but base parameters is wrong.
        strength: weak, medium, strong, severe: 3, 10, 30, 100 noises within half a second, and a third of that still
            there after the base parameters have been refitted.
        seed: of everything; below 2000 for development, from 2000 on for the benchmark.
        out: folder, created.
        velocity: log velocities (default: drawn).
        spread: of the base parameters; noise: of the encoders.

    Raises:
        ValueError: the effect makes no sense on this robot.
    """
    robot, out = SYSTEMS[system], Path(out)
    rng = np.random.default_rng((seed, *system.encode()))
    base = base_parameters(robot, spread, rng)
    drawn = bool(rng.uniform() < 0.5)
    ruler = Ruler(robot, base, spread, seed) if effects else None
    causes: list[Cause] = []
    truths = []
    for effect in effects:
        assert ruler
        cause = draw_cause(effect, robot, scales_of(ruler.plain, ruler.runs), causes, rng)
        raw, left = resize(cause, ruler, STRENGTHS[strength])
        causes.append(cause)
        told = {"name": cause.name, "where": cause.where, "parameters": cause.parameters(), "size": cause.size}
        truths.append(told | {"raw": raw, "left": left})
    plant = Plant(robot, base, causes)
    runs = [robot.record(plant, i, seed, noise) for i in range(len(RUNS))]
    logged = drawn if velocity is None else velocity
    truth = {"system": system, "seed": seed, "strength": strength, "velocity": logged, "base": base, "effects": truths}
    write(out, robot, runs, truth)
    return Case(out, truth)


def write(out: Path, robot: System, runs: Sequence[Run], truth: dict) -> None:
    """The nominal model, a log of each run and the truth."""
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    (out / "model.xml").write_text(robot.xml)
    plant = Plant(robot, {})
    actuators = [plant.model.actuator(i).name for i in range(plant.model.nu)]
    header = ["time", *(f"ctrl:{a}" for a in actuators), *(f"qpos:{j}" for j in plant.joints)]
    header += [f"qvel:{j}" for j in plant.joints] if truth["velocity"] else []
    for r in runs:
        columns = [r.time[:, None], r.ctrl, r.qpos] + ([r.qvel] if truth["velocity"] else [])
        label = RUNS[r.index][0]
        stem = logs / f"{r.index:02d}_{label}"
        table = np.concatenate(columns, 1)
        np.savetxt(stem.with_suffix(".csv"), table, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
        law = "" if robot.servo else "controller: {law: torque}\n"
        stem.with_suffix(".yaml").write_text(f"condition: {label}\noperating_condition: {label}\n{law}")
    (out / "truth.json").write_text(json.dumps(truth, indent=1, default=float))
