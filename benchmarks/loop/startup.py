"""First and second start: a tiny run of the loop in fresh processes, with an empty compilation cache, then a full one.

Seconds until the first iteration of training is reported, and to the end of the run.

python benchmarks/loop/startup.py --task Pendulum
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time

TINY = ["bayessim.realIters=1", "bayessim.trainTrajs=1000", "bayessim.realEvals=10", "ppo.max_iterations=1"]


def start(task: str, scratch: str) -> tuple[float, float]:
    """Seconds until training, seconds in all."""
    began, training = time.perf_counter(), float("nan")
    command = [sys.executable, "-m", "bayessim_mjx.main", "--task", task, "--headless", "--logdir", f"{scratch}/logs"]
    cached = os.environ | {"BAYESSIM_MJX_CACHE": f"{scratch}/cache"}
    with subprocess.Popen([*command, *TINY], env=cached, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if line.startswith("training 1/"):
                training = time.perf_counter() - began
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    return training, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Pendulum")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        first = start(args.task, scratch)
        second = [start(args.task, scratch) for _ in range(3)]
    for what, one, later in zip(("training", "end"), first, zip(*second, strict=True), strict=True):
        median = sorted(later)[1]
        print(f"{args.task}, to {what}: first {one:.1f} s, second {median:.1f} s (of 3), ratio {one / median:.2f}")


if __name__ == "__main__":
    main()
