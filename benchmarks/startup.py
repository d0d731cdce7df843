"""First and second start: a tiny run of the loop in fresh processes, with an empty compilation cache, then a full one.

python benchmarks/startup.py --task Pendulum
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time

TINY = ["bayessim.realIters=1", "bayessim.trainTrajs=1000", "bayessim.realEvals=10", "ppo.max_iterations=1"]


def start(task: str, scratch: str) -> float:
    began = time.perf_counter()
    command = [sys.executable, "-m", "bayessim_mjx.main", "--task", task, "--headless", "--logdir", f"{scratch}/logs"]
    cached = os.environ | {"BAYESSIM_MJX_CACHE": f"{scratch}/cache"}
    subprocess.run([*command, *TINY], check=True, env=cached, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Pendulum")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        first = start(args.task, scratch)
        second = [start(args.task, scratch) for _ in range(3)]
    median = sorted(second)[1]
    print(f"{args.task}: first start {first:.1f} s, second {median:.1f} s (median of 3), ratio {first / median:.2f}")


if __name__ == "__main__":
    main()
