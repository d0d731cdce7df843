"""The diagnosis on published logs of real robots.

    python benchmarks/diagnosis/real.py emps|xl330|dfki --data DIR --out DIR

Converts the logs, runs `python -m bayessim_mjx.diagnose` on them and compares what it says with what was published.
What is measured is defined in the NOTES.md beside the data; ../records/robots_*.json have the figures.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import real_logs as source
from scipy.optimize import least_squares
from scipy.signal import butter, filtfilt

from bayessim_mjx import diagnose
from bayessim_mjx.diagnosis import result
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.robot import of_file
from bayessim_mjx.diagnosis.fitting.simulator import Simulator
from bayessim_mjx.diagnosis.logcheck import gate
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.setup import control_period
from bayessim_mjx.effects import load
from bayessim_mjx.logs import read_logs
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import Drive, Physics, begin, control_step

STEP = 0.001  # s, the rate of EMPS
CUTOFF = 20.0  # Hz, zero-phase: motion and force of EMPS alike
ENDS = 0.3  # s at both ends of a log that the filter spoils
WINDOW = 0.5  # s, XL330


def lowpass(x: np.ndarray, step: float) -> np.ndarray:
    """x [T, n], sampled every `step` s, zero-phase Butterworth at CUTOFF."""
    return np.asarray(filtfilt(*butter(4, 2 * CUTOFF * step), x, axis=0))


def force_error(physics: Physics, theta: np.ndarray, log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A motion's time [T] s, what the drive's force has more than this motion needs in the simulator [T, nv], and it.

    The first is the force to be added so that the simulator's acceleration is the measured one, found by Newton steps
    that dry friction needs. Motion and forces are filtered alike, as the authors of EMPS do.
    """
    q = lowpass(log.qpos, log.period)
    v = np.gradient(q, log.period, axis=0)
    target = np.gradient(v, log.period, axis=0)
    even = log.time[0] + log.period * np.arange(len(log))
    given = lowpass(log.ctrl, log.period)
    before = v - log.period * target  # friction is implicit: it belongs to the velocity at the end of a sub-step
    moved = dataclasses.replace(log, time=even, qpos=q, qvel=before, ctrl=given)
    cut = windows.cut([moved], physics.mj_model, physics.dt, physics.substeps, 1, limit=len(log), use_qvel=False)
    rows = cut.start  # one sub-step per row: `control_step` tells the acceleration at the beginning of the last one
    batch = cut.batch.replace(command=given[rows][:, None, None])  # of that very moment, as in the authors' regression

    @jax.jit
    @jax.vmap
    def accelerated(own: Any, force: jax.Array) -> jax.Array:
        world = begin(physics, jnp.asarray(theta, jnp.float32), own.around)
        return control_step(physics, world, own.command[0], Drive(force, None, own.law))[1].qacc

    force, size = np.zeros_like(target[rows]), 100 * np.abs(log.ctrl).max()
    slope = (accelerated(batch, force + size) - accelerated(batch, force - size)) / (2 * size)
    for _ in range(4):
        force = force + (target[rows] - accelerated(batch, force)) / slope
    inner = slice(round(ENDS / physics.dt), -round(ENDS / physics.dt))
    return log.time[rows][inner], -force[inner], given[rows][inner]


def relative(missing: np.ndarray, given: np.ndarray) -> float:
    return float(np.linalg.norm(missing) / np.linalg.norm(given))


def held_out(physics: Physics, start: np.ndarray, logs: Sequence[Log]) -> dict[str, float]:
    """Root mean square position error of each condition, rad, and of all, with parameters fitted to the other ones.

    Windows of WINDOW s side by side in all logs, from the measured state (not re-estimated), as in the data's NOTES.md.
    """
    steps = round(WINDOW / physics.dt)
    cut = windows.cut(logs, physics.mj_model, physics.dt, physics.substeps, steps, limit=10**6, use_qvel=False)
    simulator, space = Simulator(physics, cut), physics.space
    low, high = (np.array([getattr(p, end) for p in space.parameters]) for end in ("low", "high"))
    start = np.clip(start, low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    shift = 0.002 * (high - low)

    def errors(x: np.ndarray, which: np.ndarray) -> np.ndarray:
        return simulator.run(x, None, which)[..., 0].reshape(len(x), -1)

    def slopes(x: np.ndarray, which: np.ndarray) -> np.ndarray:
        sign = np.where(x + shift > high, -1.0, 1.0)
        moved = errors(np.stack([x, *(x + np.diag(sign * shift))]), which)
        return ((moved[1:] - moved[0]) / (sign * shift)[:, None]).T

    squares: dict[str, np.ndarray] = {}
    for g, name in enumerate(cut.groups):
        rest, own = np.flatnonzero(cut.group != g), np.flatnonzero(cut.group == g)
        fit = least_squares(
            lambda x, w=rest: errors(x[None], w)[0], start, lambda x, w=rest: slopes(x, w), bounds=(low, high),
            x_scale=high - low, max_nfev=25, ftol=1e-4,
        )  # fmt: skip
        squares[name] = errors(fit.x[None], own)[0] ** 2
    return {n: float(np.sqrt(x.mean())) for n, x in squares.items()} | {
        "all": float(np.sqrt(np.concatenate(list(squares.values())).mean()))
    }


def diagnosed(out: Path, parameters: str | None, folder: str = "diagnosis") -> Diagnosis:
    """The command line's own result on the converted logs in `out`; one that is already there is taken up."""
    where = out / folder
    if not (where / "diagnosis.json").is_file():
        given = ["--parameters", str(out / parameters)] if parameters else []
        files = ["--model", str(out / "model.xml"), "--data", str(out / "logs"), "--out", str(where)]
        if diagnose.main([*files, *given, "--headless"]):
            raise SystemExit(f"the diagnosis of {out} failed")
    return result.load(where)


def told(found: Diagnosis) -> dict[str, Any]:
    """What the verdict says, in short."""
    values = {e.name: {k: round(v.mean, 4) for k, v in e.parameters.items()} for e in found.effects}
    rivals = {e.name: [" + ".join(r["effects"]) for r in e.equivalent_to] for e in found.effects}
    known = {k: round(v["mean"], 4) for k, v in found.parameters.items()}
    gap = {
        k: {s: v for s, v in row.items() if s in ("nominal", "calibrated", "with_effects")}
        for k, row in found.gap.physical.items()
    }
    return {"verdict": found.verdict, "effects": values, "equivalent": rivals, "parameters": known, "gap": gap}


def measure_emps(out: Path) -> dict[str, Any]:
    """Both bases: what is named, and the force error on both logs, beside that of the authors' values."""
    report: dict[str, Any] = {"published": _forces(out, *_published(out))}
    for base, parameters in (("inertia", None), ("inertia_viscous", "viscous.yaml")):
        found = diagnosed(out, parameters, base)
        robot = of_file(out / "model.xml", out / parameters if parameters else None)
        physics = found.apply(robot.physics(STEP))
        report[base] = told(found) | _forces(out, physics, physics.space.nominal)
        report[base]["named"] = _named({e.name for e in found.effects}, viscous=parameters is not None)
    return report


def _named(names: set[str], viscous: bool) -> dict[str, bool]:
    """Which of the published terms the verdict has; levels of friction that differ by direction hold an offset."""
    both = "asymmetric_friction" in names
    return {
        "coulomb": both or "coulomb_friction" in names,
        "viscous": both or viscous or "viscous_friction" in names,
        "offset": both or "actuator_bias" in names,
        "nothing_else": names <= {"asymmetric_friction", "coulomb_friction", "viscous_friction", "actuator_bias"},
    }


def _published(out: Path) -> tuple[Physics, np.ndarray]:
    """Janot, Gautier and Brunot's: 95.1089 kg, 203.5034 N s/m, 20.3935 N, offset -3.1648 N in F - offset."""
    robot = of_file(out / "model.xml")
    places = {"viscous_friction": "slide", "coulomb_friction": "slide", "actuator_bias": "motor"}
    physics = robot.physics(STEP, [load(name)(where) for name, where in places.items()])
    return physics, np.array([95.1089 / robot.mj_model.body("carriage").mass[0], 203.5034, 20.3935, 3.1648])


def _forces(out: Path, physics: Physics, theta: np.ndarray) -> dict[str, Any]:
    each = {}
    for name in ("logs", "validation"):
        (log,) = read_logs(out / name, physics.mj_model)
        _, missing, given = force_error(physics, theta, log)
        each[name] = relative(missing, given)
    return {"force_error": each}


def measure_xl330(out: Path) -> dict[str, Any]:
    """What is named, and the held-out error of half-second windows with the motor's parameters alone and with it."""
    found = diagnosed(out, "params.yaml")
    robot = of_file(out / "model.xml", out / "params.yaml")
    logs = read_logs(out / "logs", robot.mj_model)
    dt = control_period(robot, logs)
    base, named = robot.physics(dt), found.apply(robot.physics(dt))
    errors = {
        "base": held_out(base, base.space.nominal, logs),
        "named": held_out(named, named.space.nominal, logs),
    }
    milli = {stage: {k: round(1e3 * v, 1) for k, v in row.items()} for stage, row in errors.items()}
    return told(found) | {"load_friction_named": "load_friction" in [e.name for e in found.effects], "mrad": milli}


def measure_dfki(out: Path) -> dict[str, Any]:
    """What the gate says of each log, and how the command line ends where it gets the refused ones only."""
    robot = of_file(out / "model.xml")
    logs = read_logs(out / "logs", robot.mj_model, out / "map.yaml")
    seen = gate.check(logs, robot.mj_model, control_period(robot, logs))
    each = {
        r.log.name: {"usable": r.usable} | {k: list(r.of(k)) for k in ("refused", "warning", "finding") if r.of(k)}
        for r in seen.reports
    }
    bad = [str(out / "logs" / name) for name in seen.refused]
    files = ["--model", str(out / "model.xml"), "--map", str(out / "map.yaml"), "--out", str(out / "refused")]
    return {"logs": each, "exit_code_of_refused_alone": diagnose.main([*files, "--data", *bad, "--headless"])}


ROBOTS = {
    "emps": ("emps", source.convert_emps, measure_emps),
    "xl330": ("xl330_servo", source.convert_xl330, measure_xl330),
    "dfki": ("dfki_simple_pendulum", source.convert_dfki, measure_dfki),
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot", choices=list(ROBOTS))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, required=True, help="converted logs, diagnoses and real.json")
    args = parser.parse_args(argv)
    folder, convert, measure = ROBOTS[args.robot]
    if not (args.data / folder).is_dir():
        print(f"--data {args.data}: it has no folder {folder}", file=sys.stderr)
        return 2
    convert(args.data, args.out)
    found = measure(args.out)
    (args.out / "real.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
