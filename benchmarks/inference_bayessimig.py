"""Posteriors on BayesSimIG's own pendulum data (10 000 noise-free rows, regenerated from its equations).

    python benchmarks/inference_bayessimig.py --data ../shared/data/pendulum_ones --seeds 5
    python benchmarks/inference_bayessimig.py --data ../shared/data/pendulum_ones max_steps=16000    # any setting

`tail`: mean log q over 1000 unseen pairs; `star`: log q of the one truth (1.0, 0.5) that BayesSimIG is tested at. By
default the first 8000 rows are used, as its models are trained on 80 % of them. The uniform prior scores -1.376.
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
from inference import option

from bayessim_mjx.inference import InferenceSettings, calibration, condition, fit, init
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 1.0, 0.01, 2.0) for name in ("length", "mass")])
# held-out mean log density and CPU seconds of its best model at 1000 and 10 000 Adam steps (median of five seeds)
THEIRS = {"random_start": {1000: (0.51, 17.1), 10_000: (1.09, 135.8)}, "fixed_start": {1000: (2.19, 13.1)}}


def load(folder: Path, start: str, part: str) -> tuple[jax.Array, jax.Array]:
    """(theta [n, 2], summary_start [n, 40])."""
    with np.load(folder / f"{start}_{part}.npz") as file:
        return tuple(jnp.atleast_2d(jnp.asarray(file[k], jnp.float32)) for k in ("params", "data"))  # type: ignore


def measure(folder: Path, start: str, seed: int, rows: int, settings: InferenceSettings) -> dict[str, Any]:
    """Fit twice, the second time compiled, and score the unseen pairs and the one truth."""
    thetas, x = (v[:rows] for v in load(folder, start, "train"))
    seconds = []
    for _ in range(2):
        cpu = time.process_time()
        state = init(jax.random.PRNGKey(seed), settings, SPACE, x.shape[1])
        state, _ = fit(jax.random.PRNGKey(seed + 1), state, thetas, x)
        jax.block_until_ready(state.params)
        seconds.append(round(time.process_time() - cpu, 2))
    tail, star = load(folder, start, "test"), load(folder, start, "true")
    report = calibration.check(jax.random.PRNGKey(3), condition(state, tail[1]), tail[0])
    prior = float(SPACE.log_prior(SPACE.nominal))
    one = condition(state, star[1]).split()[0]
    return {
        "start": start, "seed": seed, "tail": round(report.gain + prior, 3),
        "star": round(float(one.log_prob(star[0][0])), 3), "coverage": report.table(), "pairs": report.pairs,
        "cpu s": seconds[1], "cpu s with compilation": seconds[0], "BayesSimIG": THEIRS[start],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rows", type=int, default=8000)
    parser.add_argument("--starts", nargs="+", default=list(THEIRS), choices=list(THEIRS))
    args, rest = parser.parse_known_args()
    settings = InferenceSettings(**dict(option(text) for text in rest))
    for start in args.starts:
        for seed in range(args.seeds):
            print(json.dumps(measure(args.data, start, seed, args.rows, settings)), flush=True)


if __name__ == "__main__":
    main()
