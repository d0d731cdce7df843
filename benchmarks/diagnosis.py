"""Blind benchmark of the gap diagnosis: is a hidden effect named, at its place, and nothing where there is none?

    python benchmarks/diagnosis.py generate --out CASES --seeds 2000:2010 --kinds single,double,null,unknown
    python benchmarks/diagnosis.py run CASES
    python benchmarks/diagnosis.py run CASES --leave-out-family
    python benchmarks/diagnosis.py score CASES

Seeds below 2000 are for development (1000 to 1029 were looked at, on the pendulum). Numbers to publish come from seeds
of 2000 and more, which nothing was tuned on.
"""

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from diagnosis_cases import KNOWN, STRENGTHS, SYSTEMS, UNKNOWN, make_case, places
from diagnosis_score import score
from diagnosis_truth import Plant, run, scales_of

KINDS = ("single", "double", "null", "unknown")
FAMILIES = (
    ("coulomb_friction", "stribeck_friction", "load_friction", "asymmetric_friction", "actuator_deadband"),
    ("viscous_friction", "quadratic_drag", "asymmetric_friction"),
    ("actuator_delay", "actuator_lag", "rate_limit", "sensor_delay", "sensor_filter"),
    ("backlash", "joint_elasticity", "base_flexibility", "actuator_deadband", "sensor_delay", "actuator_delay",
     "actuator_lag"),
    ("payload", "gravity_tilt", "external_force", "joint_spring", "joint_offset", "actuator_bias"),
    ("actuator_gain", "sensor_gain", "armature", "payload", "actuator_saturation", "effort_loss", "speed_torque_limit"),
    ("cogging",),
)  # fmt: skip
Job = tuple[str, str, tuple[str, ...], str, int, Path]


def jobs(out: Path, seeds: range, kinds: Iterable[str], systems: Iterable[str], strengths: list[str]) -> list[Job]:
    """(kind, system, effects, strength, seed, folder); effects take turns, so that all come up equally often."""
    found = []
    for system in systems:
        robot = SYSTEMS[system]
        plain = Plant(robot, {})
        scales = scales_of(plain, [run(plain, 0, 0, noise=False)])
        known, unknown = ([e for e in names if places(robot, e, scales)] for names in (KNOWN, UNKNOWN))
        shift = zlib.crc32(system.encode())
        known, unknown = (list(np.random.default_rng(shift).permutation(names)) for names in (known, unknown))
        for seed in seeds:
            rng = np.random.default_rng((seed, shift))
            strength = str(rng.choice(strengths))
            drawn = {
                "single": (str(known[seed % len(known)]),),
                "double": tuple(str(e) for e in rng.choice(known, 2, replace=False)),
                "null": (),
                "unknown": (str(unknown[seed % len(unknown)]),),
            }
            found += [(k, system, drawn[k], strength, seed, out / f"{system}_{k}_s{seed}") for k in kinds]
    return found


def _make(job: Job) -> str:
    kind, system, effects, strength, seed, folder = job
    if (folder / "truth.json").exists():
        return f"{folder.name}: is there"
    started = time.perf_counter()
    # each kind has base parameters and motions of its own
    case = make_case(system, effects, strength, seed + 1_000_000 * KINDS.index(kind), folder)
    truth = case.truth | {"kind": kind, "seed": seed}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1, default=float))
    told = ", ".join(f"{e['name']}@{e['where']} raw {e['raw']:.1f} left {e['left']:.1f}" for e in truth["effects"])
    return f"{folder.name}: {told or 'nothing'} ({time.perf_counter() - started:.0f} s)"


def generate(args: argparse.Namespace) -> None:
    first, _, last = args.seeds.partition(":")
    seeds = range(int(first), int(last or int(first) + 1))
    todo = jobs(args.out, seeds, args.kinds.split(","), args.systems.split(","), args.strengths.split(","))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one core per case is faster than all cores per case
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        for line in pool.imap(_make, todo):
            print(line, flush=True)


def without(effects: Iterable[str]) -> str:
    """The library less the families of these effects, for --effects."""
    left_out = {e for family in FAMILIES for e in family if set(effects) & set(family)}
    return ",".join(e for e in KNOWN if e not in left_out)


def diagnose(args: argparse.Namespace) -> None:
    """The command on every case that has no result yet; what it wrote and how long it took."""
    for folder in cases(args.cases):
        truth = json.loads((folder / "truth.json").read_text())
        if args.leave_out_family and truth.get("kind") != "single":
            continue
        out = folder / ("left_out" if args.leave_out_family else "diagnosis")
        if (out / "exit.json").exists():
            continue
        command = [
            sys.executable,
            "-m",
            "bayessim_mjx.diagnose",
            "--model",
            folder / "model.xml",
            "--data",
            folder / "logs",
        ]
        command += ["--out", out, "--seed", "0", *args.arguments]
        if args.leave_out_family:
            command += ["--effects", without(e["name"] for e in truth["effects"])]
        out.mkdir(exist_ok=True)
        started = time.perf_counter()
        with (out / "output.txt").open("w") as text:
            try:
                done = subprocess.run(
                    command, stdout=text, stderr=subprocess.STDOUT, timeout=args.timeout, env=os.environ
                )
                code = done.returncode
            except subprocess.TimeoutExpired:
                code = 124
        seconds = time.perf_counter() - started
        (out / "exit.json").write_text(json.dumps({"code": code, "seconds": seconds}))
        print(f"{folder.name}: exit {code}, {seconds:.0f} s", flush=True)


def cases(folder: Path) -> list[Path]:
    return sorted(p.parent for p in folder.glob("*/truth.json"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    new = commands.add_parser("generate", help="write cases")
    new.add_argument("--out", type=Path, required=True)
    new.add_argument("--seeds", default="2000:2010", help="first:last, last not included")
    new.add_argument("--kinds", default=",".join(KINDS))
    new.add_argument("--systems", default=",".join(SYSTEMS))
    new.add_argument("--strengths", default="medium,strong", help=f"of {', '.join(STRENGTHS)}; they take turns")
    new.add_argument("--workers", type=int, default=os.cpu_count())
    new.set_defaults(does=generate)
    old = commands.add_parser("run", help="diagnose every case that has no result yet")
    old.add_argument("cases", type=Path)
    old.add_argument("--leave-out-family", action="store_true", help="singles, without the effect and its look-alikes")
    old.add_argument("--timeout", type=float, default=3600.0, help="s per case")
    old.add_argument("arguments", nargs="*", help="more arguments of the command, after --")
    old.set_defaults(does=diagnose)
    told = commands.add_parser("score", help="rates with 90 %% Wilson intervals, confusion matrix")
    told.add_argument("cases", type=Path)
    told.add_argument("--out", type=Path, help="folder for score.md, score.json, confusion.csv (default: the cases')")
    told.set_defaults(does=lambda args: print(score(cases(args.cases), args.out or args.cases)))
    args = parser.parse_args()
    args.does(args)


if __name__ == "__main__":
    main()
