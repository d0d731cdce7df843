"""Posteriors on BayesSimIG's own pendulum data (10 000 noise-free rows, regenerated from its equations).

    python benchmarks/inference/bayessimig.py --data ../shared/data/pendulum_ones --seeds 5
    python benchmarks/inference/bayessimig.py --data ../shared/data/pendulum_ones max_steps=16000    # any setting

`tail`: mean log q over 1000 unseen pairs; `star`: log q of the one truth (1.0, 0.5) that BayesSimIG is tested at. The
same rows are used as for its models: 8000 from random, 1000 from fixed start states. The uniform prior scores -1.376.
`times faster`: its CPU seconds over the wall time here, compilation apart, for each number of steps it was run for; its
figures are of an AMD EPYC, so take them from a like core. `--quick` fits one small network, to match its time.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from posteriors import option

from bayessim_mjx.inference import InferenceSettings, calibration, condition, fit, init
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 1.0, 0.01, 2.0) for name in ("length", "mass")])
# of its models: {steps: (held-out mean log density, CPU seconds)}, best of one thread, median of five seeds, trained on
# 80 % of the rows given: 10 000 from random, 1250 from fixed start states
THEIRS = {"random_start": {1000: (0.51, 17.1), 10_000: (1.09, 135.8)}, "fixed_start": {1000: (2.19, 13.1)}}
ROWS = {"random_start": 8000, "fixed_start": 1000}


def load(folder: Path, start: str, part: str) -> tuple[jax.Array, jax.Array]:
    """(theta [n, 2], summary_start [n, 40])."""
    with np.load(folder / f"{start}_{part}.npz") as file:
        return tuple(jnp.atleast_2d(jnp.asarray(file[k], jnp.float32)) for k in ("params", "data"))  # type: ignore


def measure(folder: Path, start: str, seed: int, rows: int, settings: InferenceSettings) -> dict[str, Any]:
    """Fit twice, the second time compiled, and score the unseen pairs and the one truth."""
    thetas, x = (v[:rows] for v in load(folder, start, "train"))
    seconds = []
    for _ in range(2):
        wall = time.perf_counter()
        state = init(jax.random.PRNGKey(seed), settings, SPACE, x.shape[1])
        state, _ = fit(jax.random.PRNGKey(seed + 1), state, thetas, x)
        jax.block_until_ready(state.params)
        seconds.append(round(time.perf_counter() - wall, 2))
    tail, star = load(folder, start, "test"), load(folder, start, "true")
    report = calibration.check(jax.random.PRNGKey(3), condition(state, tail[1]), tail[0])
    prior = float(SPACE.log_prior(SPACE.nominal))
    one = condition(state, star[1]).split()[0]
    return {
        "start": start, "seed": seed, "tail": round(report.gain + prior, 3),
        "star": round(float(one.log_prob(star[0][0])), 3), "pairs": report.pairs,
        "coverage 50/80/95": [round(share, 3) for share, _ in report.coverage.values()],
        "wall s": seconds[1], "wall s with compilation": seconds[0], "BayesSimIG": THEIRS[start],
        "times faster": {steps: round(cpu / seconds[1], 1) for steps, (_, cpu) in THEIRS[start].items()},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--rows", type=int, help="of the training data")
    parser.add_argument("--quick", action="store_true", help="two networks of 64 units for 1000 steps")
    parser.add_argument("--starts", nargs="+", default=list(THEIRS), choices=list(THEIRS))
    args, rest = parser.parse_known_args()
    quick = {"ensemble": 2, "hiddenLayers": (64, 64), "max_steps": 1000, "components": 6} if args.quick else {}
    settings = InferenceSettings(**{**quick, **dict(option(text) for text in rest)})
    for start in args.starts:
        for seed in range(args.first, args.first + args.seeds):
            row = measure(args.data, start, seed, args.rows or ROWS[start], settings)
            print(json.dumps({**row, "quick": args.quick}), flush=True)


if __name__ == "__main__":
    main()
