"""Cases of the diagnosis benchmark: which cause where, how strong, written as model, logs and sealed truth."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import causes_actuator as actuator
import causes_joint as joint
import causes_other as other
import causes_unknown as unknown
import numpy as np
from causes import Cause, Scales
from strength import Ruler, resize
from systems import RUNS, SYSTEMS, System
from truth import Plant, Run, base_parameters, run, scales_of

STRENGTHS = {"weak": 3.0, "medium": 10.0, "strong": 30.0, "severe": 100.0}
SPREAD = 0.2
_ROTOR = ("backlash", "joint_elasticity")  # driven joints only


def _causes(*rooms: object) -> dict[str, type[Cause]]:
    every = [c for room in rooms for c in vars(room).values() if isinstance(c, type) and issubclass(c, Cause)]
    return {c.name: c for c in every if "name" in vars(c)}


KNOWN = _causes(joint, actuator, other)
UNKNOWN = _causes(unknown)
CAUSES = KNOWN | UNKNOWN


@dataclasses.dataclass(frozen=True)
class Case:
    """out/model.xml (nominal), out/logs/, out/truth.json, and the truth as a dict."""

    out: Path
    truth: dict


def places(system: System, effect: str, scales: Scales) -> list[str]:
    """Where the effect makes sense on this robot."""
    cause, driven = CAUSES[effect], list(scales.drives.values())
    if cause.kind == "actuator":
        return [] if effect == "unknown_cross_coupling" and len(scales.force) < 2 else list(scales.drives)
    if cause.kind == "world":
        return [] if system.name == "cartpole" else ["world"]
    if cause.kind == "geom":
        return ["foot"] if 'name="foot"' in system.xml else []
    if cause.kind == "body":
        return list(scales.mass)[-2:]  # what is carried is carried at the end
    return driven if effect in _ROTOR else list(scales.force)


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
    runs = [run(plant, i, seed, noise) for i in range(len(RUNS))]
    logged = drawn if velocity is None else velocity
    truth = {"system": system, "seed": seed, "strength": strength, "velocity": logged, "base": base, "effects": truths}
    _write(out, robot, runs, truth)
    return Case(out, truth)


def draw_cause(
    effect: str | tuple[str, str], robot: System, scales: Scales, taken: Sequence[Cause], rng: np.random.Generator
) -> Cause:
    name, where = (effect, None) if isinstance(effect, str) else effect
    allowed = places(robot, name, scales)
    if not allowed:
        raise ValueError(f"{name} makes no sense on {robot.name}")
    free = [p for p in allowed if p not in {c.where for c in taken}]
    drawn = str(rng.choice(free or allowed))
    return CAUSES[name](where or drawn, scales, rng)


def _write(out: Path, robot: System, runs: Sequence[Run], truth: dict) -> None:
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    (out / "model.xml").write_text(robot.xml)
    plant = Plant(robot, {})
    actuators = [plant.model.actuator(i).name for i in range(plant.model.nu)]
    header = ["time", *(f"ctrl:{a}" for a in actuators), *(f"qpos:{j}" for j in plant.joints)]
    header += [f"qvel:{j}" for j in plant.joints] if truth["velocity"] else []
    for i, r in enumerate(runs):
        columns = [r.time[:, None], r.ctrl, r.qpos] + ([r.qvel] if truth["velocity"] else [])
        stem = logs / f"{i:02d}_{RUNS[i][0]}"
        table = np.concatenate(columns, 1)
        np.savetxt(stem.with_suffix(".csv"), table, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
        law = "" if robot.servo else "controller: {law: torque}\n"
        label = RUNS[i][0]
        stem.with_suffix(".yaml").write_text(f"condition: {label}\noperating_condition: {label}\n{law}")
    (out / "truth.json").write_text(json.dumps(truth, indent=1, default=float))
