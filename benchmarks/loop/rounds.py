"""The whole loop with a task's default settings, several seeds: wall time, return, density of the truth.

    python benchmarks/loop/rounds.py --task Pendulum --seeds 5

Each seed is a fresh process, as a user would start it; the compilation cache is shared (the first seed fills it).
Prints one row per seed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def one(task: str, seed: int, logdir: str, overrides: list[str], cache: str) -> dict:
    """Run a seed; the last round's numbers, wall seconds and peak memory."""
    command = [sys.executable, "-m", "bayessim_mjx.main", "--task", task, "--seed", str(seed), "--headless"]
    command += ["--logdir", logdir, "--name", f"seed{seed}", *overrides]
    started = time.perf_counter()
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    subprocess.run(command, check=True, env=os.environ | {"BAYESSIM_MJX_CACHE": cache}, stdout=sys.stderr)
    seconds = time.perf_counter() - started
    peak = max(before, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
    folder = next(Path(logdir).glob(f"{task}/*_seed{seed}"))
    rounds = [json.loads(line) for line in (folder / "rounds.jsonl").read_text().splitlines()]
    return {"seed": seed, "wall": seconds, "peak_mib": peak / 1024, "rounds": rounds}


def row(result: dict) -> dict:
    last = result["rounds"][-1]
    scores = last["scores"]
    return {
        "seed": result["seed"],
        "wall s": round(result["wall"], 1),
        "peak MiB": round(result["peak_mib"]),
        "return": round(last["returns"]["mean"], 1),
        "gain nats": round(scores.get("gain_over_prior", float("nan")), 2),
        "level": round(scores.get("credible_level", float("nan")), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Pendulum")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", help="write all rounds of all seeds here as JSON")
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as scratch:
        for seed in range(args.seeds):
            results.append(one(args.task, seed, f"{scratch}/logs", args.overrides, f"{scratch}/cache"))
            print(json.dumps(row(results[-1])), flush=True)
    if args.out:
        Path(args.out).write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
