"""Cases of the diagnosis benchmark: which cause where, how strong, written as model, logs and sealed truth."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from diagnosis_causes import Cause, Scales
from diagnosis_causes_rest import KNOWN, UNKNOWN
from diagnosis_systems import RUNS, SYSTEMS, System
from diagnosis_truth import PUSHED, Plant, Run, base_parameters, equivalent_noise, run, scales_of

STRENGTHS = {"weak": 3.0, "medium": 10.0, "strong": 30.0, "severe": 100.0}
SPREAD = 0.2
CAUSES = KNOWN | UNKNOWN
ALONE = {"backlash", "joint_elasticity"}  # need a rotor: driven joints only
BISECTIONS = 12


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
        return ["world"] if effect != "base_flexibility" or system.name != "cartpole" else []
    if cause.kind == "body":
        return list(scales.mass)[-2:]  # what is carried is carried at the end
    return driven if effect in ALONE else list(scales.force)


def make_case(
    system: str, effects: Sequence[str | tuple[str, str]], strength: str, seed: int, out: str | Path,
    *, velocity: bool | None = None, spread: float = SPREAD, noise: bool = True,
) -> Case:  # fmt: skip
    """Write a case.

    Args:
        system: of SYSTEMS.
        effects: names, or (name, where); () is a case in which nothing but base parameters is wrong.
        strength: weak, medium, strong or severe: the motion is 3, 10, 30 or 100 noises off within half a second.
        seed: of everything; below 1000 for development, from 1000 on for the benchmark.
        out: folder, created.
        velocity: log velocities (default: drawn).
        spread: of the base parameters; noise: of the encoders.
    """
    robot, out = SYSTEMS[system], Path(out)
    rng = np.random.default_rng((seed, *system.encode()))
    base = base_parameters(robot, spread, rng)
    velocity = bool(rng.uniform() < 0.5) if velocity is None else velocity
    plain = Plant(robot, base)
    scales = scales_of(plain, [run(plain, i, seed, noise=False) for i in PUSHED])
    causes, strengths = [], []
    for effect in effects:
        name, where = (effect, None) if isinstance(effect, str) else effect
        allowed = places(robot, name, scales)
        place = where or str(rng.choice([p for p in allowed if p not in {c.where for c in causes}] or allowed))
        cause = CAUSES[name](place, scales, rng)
        strengths.append(sized(cause, robot, base, plain, STRENGTHS[strength], seed))
        causes.append(cause)
    plant = Plant(robot, base, causes)
    runs = [run(plant, i, seed, noise) for i in range(len(RUNS))]
    truth = {
        "system": system, "seed": seed, "strength": strength, "velocity": velocity, "base": base,
        "total_noise_equivalent": equivalent_noise(plain, runs) if causes else 0.0,
        "effects": [
            {"name": c.name, "where": c.where, "parameters": c.parameters(), "noise_equivalent": s}
            for c, s in zip(causes, strengths, strict=True)
        ],
    }  # fmt: skip
    write(out, robot, runs, truth, velocity)
    return Case(out, truth)


def sized(cause: Cause, robot: System, base: dict[str, float], plain: Plant, goal: float, seed: int) -> float:
    """Set `cause.size` so that the motion is `goal` noises off; what was reached (less where the range ends)."""

    def reached(size: float) -> float:
        cause.size = float(size)
        try:
            return equivalent_noise(plain, [run(Plant(robot, base, [cause]), i, seed, noise=False) for i in PUSHED])
        except FloatingPointError:
            return np.inf

    low, high = max(cause.smallest, 1e-4 * cause.largest), cause.largest
    value = reached(size := np.sqrt(low * high))
    for _ in range(BISECTIONS):
        if 0.9 * goal < value < 1.1 * goal or high / low < 1.02:
            break
        low, high = (size, high) if value < goal else (low, size)
        # effects grow about in proportion: guess so, and stay inside the bracket
        guess = size * goal / value if np.isfinite(value) and value > 0 else np.sqrt(low * high)
        size = guess if low * 1.05 < guess < high / 1.05 else np.sqrt(low * high)
        value = reached(size)
    return value


def write(out: Path, robot: System, runs: Sequence[Run], truth: dict, velocity: bool) -> None:
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    (out / "model.xml").write_text(robot.xml)
    plant = Plant(robot, {})
    actuators = [plant.model.actuator(i).name for i in range(plant.model.nu)]
    header = ["time", *(f"ctrl:{a}" for a in actuators), *(f"qpos:{j}" for j in plant.joints)]
    header += [f"qvel:{j}" for j in plant.joints] if velocity else []
    for i, r in enumerate(runs):
        columns = [r.time[:, None], r.ctrl, r.qpos] + ([r.qvel] if velocity else [])
        stem = logs / f"{i:02d}_{RUNS[i][0]}"
        table = np.concatenate(columns, 1)
        np.savetxt(stem.with_suffix(".csv"), table, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
        law = "" if robot.servo else "controller: {law: torque}\n"
        label = RUNS[i][0]
        stem.with_suffix(".yaml").write_text(f"condition: {label}\noperating_condition: {label}\n{law}")
    (out / "truth.json").write_text(json.dumps(truth, indent=1))
