"""The look before any simulation on cheap rigs with known truth: what it names, how near, and what it rules out.

    python benchmarks/diagnosis/first_look.py --seeds 1000:1003            # development; 2000 and on are for results
    python benchmarks/diagnosis/first_look.py --seeds 2000:2003 --out rows.json

Prints how often the effect is proposed first, or among the proposals and what is told as equivalent; errors of values;
false alarms where nothing is wrong but data-sheet values by 5 %; and vetoes that would have lost the truth.
"""

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rigs import Rig, draw, record

SYSTEMS = ("pendulum", "cartpole", "two_link", "leg", "arm_torque", "arm_servo")
EFFECTS = (
    "", "payload", "actuator_gain", "gain_everywhere", "coulomb_friction", "friction_everywhere", "viscous_friction",
    "actuator_bias", "actuator_saturation", "friction_in_each", "servo_stiffness", "servo_damping",
)  # fmt: skip
PERIODS = (0.01, 0.005, 0.002, 0.001)
VALUES = {"payload": "mass", "actuator_gain": "gain", "coulomb_friction": "level", "viscous_friction": "damping"}
VALUES |= {"actuator_bias": "bias", "servo_stiffness": "factor", "servo_damping": "factor"}


def rigs(seeds: Sequence[int], systems: Sequence[str] = SYSTEMS, effects: Sequence[str] = EFFECTS) -> list[Rig]:
    """Every system with every effect, each seed with its own rate, noise, resolution and logged effort."""
    out = []
    for seed, (system, effect) in itertools.product(seeds, itertools.product(systems, effects)):
        if effect.startswith("servo") and system != "arm_servo":
            continue
        rng = np.random.default_rng((seed, *system.encode(), *effect.encode()))
        truth = draw(system, effect, rng)
        quantum = float(rng.choice([0.0, 2 * np.pi / 4096, 2 * np.pi / 16384]))
        sigma = float(rng.choice([1e-4, 3e-4, 1e-3])) if not quantum else 0.0
        if system == "cartpole":  # its rail is measured in metres
            sigma, quantum = 0.2 * sigma, 0.2 * quantum
        effort = bool(rng.uniform() < 0.5)
        out.append(
            Rig(system, truth, float(rng.choice(PERIODS)), sigma, quantum, effort, seed=int(rng.integers(2**31)))
        )
    return out


def judged(rig: Rig) -> dict[str, Any]:
    """One rig's row."""
    from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check, proposed

    model, logs = record(rig)
    began = time.process_time()
    seen = check(logs, model)
    took = time.process_time() - began
    starts = proposed(seen)
    true = f"{rig.truth.effect}@{rig.truth.where}" if rig.truth.effect else ""
    every = [f"actuator_gain@{a}" for a in logs[0].actuators]
    # each drive's own gain, measured, is a gain everywhere; and so is the only drive's
    tied = true == "actuator_gain@all" and all(e in starts for e in every)
    place = logs[0].joints[0] if "friction" in true else logs[0].actuators[0]
    same = f"{rig.truth.effect}@{place}" if len(every) == 1 and true.endswith("@all") else true
    found = next((n for n in (true, same, *(every if tied else ())) if n in starts), "")
    if rig.truth.where == "each":
        return _each(rig, model, seen, starts) | {"seconds": took}
    rivals = [r for p in seen.proposals for r in p.rivals]
    error, deviations = _error(rig, starts.get(found), next((p for p in seen.proposals if p.label == found), None))
    return {
        "system": rig.system, "truth": true, "values": rig.truth.values, "period": rig.period, "effort": rig.effort,
        "sigma": rig.sigma, "quantum": rig.quantum, "seconds": took, "proposed": list(starts), "found": bool(found),
        "only": bool(found) and (len(starts) == 1 or tied), "told": bool(found) or true in rivals or same in rivals,
        "error": error, "deviations": deviations, "vetoed": true in seen.vetoes, "vetoes": sorted(seen.vetoes),
        "nominal": max((j.nominal for j in seen.joints), default=0.0),
        "left": max((j.left for j in seen.joints), default=1.0),
    }  # fmt: skip


def _each(rig: Rig, model: Any, seen: Any, starts: dict[str, Any]) -> dict[str, Any]:
    """The row of friction of another size in every joint: named where it is named at each of them."""
    joints = [model.joint(int(i)).name for i in model.actuator_trnid[:, 0]]
    levels = [starts.get(f"coulomb_friction@{j}", {}).get("level", 0.0) for j in joints]
    found = all(level > 0 for level in levels)
    errors = [abs(level / true - 1) for level, true in zip(levels, rig.truth.values, strict=True)]
    return {
        "system": rig.system, "truth": "coulomb_friction@each", "values": rig.truth.values, "period": rig.period,
        "effort": rig.effort, "sigma": rig.sigma, "quantum": rig.quantum, "proposed": list(starts), "found": found,
        "only": found and len(starts) == len(joints), "told": found, "vetoed": False, "vetoes": sorted(seen.vetoes),
        "error": float(np.median(errors)) if found else float("nan"), "deviations": float("nan"),
        "nominal": max((j.nominal for j in seen.joints), default=0.0),
        "left": max((j.left for j in seen.joints), default=1.0),
    }  # fmt: skip


def _error(rig: Rig, start: Any, proposal: Any) -> tuple[float, float]:
    """(error as a share of the effect's size, and in standard deviations)."""
    key = VALUES.get(rig.truth.effect)
    if start is None or key is None:
        return float("nan"), float("nan")
    off, true = start[key] - rig.truth.values[0], rig.truth.values[0]
    size = abs(true - (1.0 if key in ("gain", "factor") else 0.0))
    return abs(off) / max(size, 1e-12), off / proposal.deviations[key] if proposal else float("nan")


def table(rows: Sequence[dict[str, Any]]) -> None:
    """Rates by effect, by robot and by whether efforts were logged; false alarms; vetoes."""
    named = [r for r in rows if r["truth"]]
    within = [r for r in named if _kind(r) != "actuator_saturation"]
    print(
        "| truth | cases | proposed | alone | or told as equivalent | error: median, 90 % |\n|---|---|---|---|---|---|"
    )
    for key in sorted({_kind(r) for r in named}):
        _line(key, [r for r in named if _kind(r) == key])
    for own in SYSTEMS:
        _line(f"all but saturation, {own}", [r for r in within if r["system"] == own])
    for measured in (True, False):
        _line(
            f"all but saturation, effort{'' if measured else ' not'} logged",
            [r for r in within if r["effort"] == measured],
        )
    null = [r for r in rows if not r["truth"]]
    print(f"nothing wrong: {sum(bool(r['proposed']) for r in null)} of {len(null)} with a proposal")
    away = [abs(r["deviations"]) for r in named if np.isfinite(r["deviations"])]
    print(f"values within 2 standard deviations: {sum(a < 2 for a in away)} of {len(away)}")
    _vetoes(rows, named)
    seconds = [r["seconds"] for r in rows]
    print(f"CPU seconds: median {np.median(seconds):.1f}, most {max(seconds):.1f}")


def _line(name: str, some: Sequence[dict[str, Any]]) -> None:
    errors = [r["error"] for r in some if np.isfinite(r["error"])]
    middle = "-"
    if errors:
        middle = f"{100 * np.median(errors):.1f} %, {100 * np.quantile(errors, 0.9):.0f} %"
    counts = " | ".join(str(sum(r[k] for r in some)) for k in ("found", "only", "told"))
    print(f"| {name} | {len(some)} | {counts} | {middle} |")


def _vetoes(rows: Sequence[dict[str, Any]], named: Sequence[dict[str, Any]]) -> None:
    """Vetoes that would have lost the truth, and those of one value for all places that should have come."""
    lost = sum(r["vetoed"] for r in named)
    print(
        f"vetoes: {sum(len(r['vetoes']) for r in rows)} in {len(rows)} cases, {lost} of {len(named)} truths among them"
    )
    for kind in ("@all", "actuator_saturation"):
        own = [r for r in named if kind in r["truth"]]
        print(f"  {kind}: {sum(r['vetoed'] for r in own)} of {len(own)}")
    several = [r for r in named if r["system"] not in ("pendulum", "cartpole") and not r["truth"].endswith("@all")]
    single = [r for r in several if r["truth"].startswith("actuator_gain@")]
    out = sum("actuator_gain@all" in r["vetoes"] for r in single)
    print(f"  a gain at one of several drives, the same gain at all ruled out: {out} of {len(single)}")


def _kind(row: dict[str, Any]) -> str:
    effect, _, where = row["truth"].partition("@")
    return f"{effect} everywhere" if where == "all" else f"{effect} in each" if where == "each" else effect


def published(data: Path) -> None:
    """What the look says of real logs with published truth (`NOTES.md` beside them), with data-sheet values at 5 %."""
    import real_logs

    from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check
    from bayessim_mjx.diagnosis.fitting import robot
    from bayessim_mjx.diagnosis.phrases import notes
    from bayessim_mjx.logs import read_logs

    for name, convert in (("EMPS", real_logs.convert_emps), ("XL330", real_logs.convert_xl330)):
        with tempfile.TemporaryDirectory() as folder:
            convert(data, Path(folder))
            rig = robot.of_file(Path(folder) / "model.xml")
            logs = read_logs(str(Path(folder) / "logs"), rig.mj_model, None)
            began = time.process_time()
            seen = check(logs, rig.mj_model)
            print(f"{name} ({time.process_time() - began:.1f} CPU s)", *notes.first_look(seen), sep="\n  ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1000:1002", help="first:last, last excluded")
    parser.add_argument(
        "--data", type=Path, help="folder of published logs: print what the look says of EMPS and XL330"
    )
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, choices=SYSTEMS, metavar="NAME", help="robots")
    parser.add_argument("--effects", nargs="+", default=EFFECTS, choices=EFFECTS, metavar="NAME", help="truths")
    parser.add_argument("--out", type=Path, help="file for every rig's row")
    args = parser.parse_args()
    if args.data:
        published(args.data)
        return
    first, last = map(int, args.seeds.split(":"))
    rows = []
    for rig in rigs(range(first, last), args.systems, args.effects):
        rows.append(judged(rig))
        if args.out:
            args.out.write_text(json.dumps(rows, indent=1, default=float))
    table(rows)


if __name__ == "__main__":
    main()
