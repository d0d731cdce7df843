"""Posteriors against exact ones: C2ST, log score, coverage and wall time with the compilation apart.

    python benchmarks/inference/posteriors.py --problems gaussian_linear two_moons pendulum --seeds 5
    python benchmarks/inference/posteriors.py --problems two_moons coordinates=truncated ensemble=5  # InferenceSettings
    python benchmarks/inference/posteriors.py --peers mdn maf nsf --sbi ENV/lib/python3.11/site-packages

One row per problem, model and seed, as JSON. C2ST is the mean over three observations (0.5 = exact).
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from c2st import c2st
from problems import PROBLEMS, Problem
from sbi_peer import peer

from bayessim_mjx.inference import Again, InferenceSettings, calibration, condition, fit, init

OBSERVATIONS, HELD_OUT = 3, 1000


def ours(
    problem: Problem, seed: int, thetas: Any, x: Any, options: dict, draws: int = 1
) -> tuple[dict, Callable, Callable | None]:
    """Fit twice, the second time compiled; -> row, sampler of (x, n), and log score and credible levels of pairs."""
    settings = InferenceSettings(**{**problem.settings, **options})
    again = None
    if draws > 1 and problem.measured:
        keys = jax.random.split(jax.random.PRNGKey(2000 + seed), draws - 1)
        more = jnp.stack([problem.simulate(key, thetas) for key in keys], axis=1)
        again = Again(more, jnp.arange(len(thetas), dtype=jnp.int32))
    seconds, cpu = [], []
    for _ in range(2):
        wall, process = time.perf_counter(), time.process_time()
        state = init(jax.random.PRNGKey(seed), settings, problem.space, x.shape[1])
        state, info = fit(jax.random.PRNGKey(seed + 1), state, thetas, x, again=again)
        jax.block_until_ready(state.params)
        seconds.append(time.perf_counter() - wall)
        cpu.append(time.process_time() - process)
    row = {
        "model": settings.modelClass,
        "draws of noise": 1 if again is None else draws,
        "coordinates": settings.coordinates,
        "wall s": round(seconds[1], 2),
        "cpu s": round(cpu[1], 2),
        "wall s with compilation": round(seconds[0], 2),
        "best": int(info.best),
    }

    def sample(x: np.ndarray, n: int) -> np.ndarray:
        return np.asarray(condition(state, jnp.asarray(x)[None]).split()[0].sample(jax.random.PRNGKey(9), n))

    def scores(thetas: Any, x: Any) -> tuple[np.ndarray, np.ndarray]:
        found = calibration.ranks(jax.random.PRNGKey(3), condition(state, x), thetas)
        return np.asarray(found.gain + jax.vmap(problem.space.log_prior)(thetas)), np.asarray(found.level)

    return row, sample, scores


def measure(problem: Problem, seed: int, simulations: int, samples: int, model: Callable) -> dict:
    """One row: fit `model` and compare it with the exact posterior."""
    thetas, x = problem.pairs(jax.random.PRNGKey(1000 + seed), simulations)
    row, sample, scores = model(problem, seed, thetas, x)
    row = {"problem": problem.name, "seed": seed, "simulations": simulations, **row}
    if scores is not None:
        density, level = scores(*problem.pairs(jax.random.PRNGKey(8), HELD_OUT))
        row["log q"] = round(float(density.mean()), 3)
        row["coverage 50/80/95"] = [round(float(np.mean(level <= p)), 3) for p in (0.5, 0.8, 0.95)]
        row["pairs"] = len(level)
    if samples and problem.exact is not None:
        _, observed = problem.pairs(jax.random.PRNGKey(7), OBSERVATIONS)
        rng = np.random.default_rng(seed)
        values = [c2st(problem.exact(rng, x_o, samples), sample(x_o, samples), seed) for x_o in np.asarray(observed)]
        row |= {"c2st": round(float(np.mean(values)), 4), "each": [round(v, 3) for v in values]}
    return row


def option(text: str) -> tuple[str, Any]:
    name, _, value = text.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--samples", type=int, default=5000, help="of each posterior, for C2ST; 0: no C2ST")
    parser.add_argument("--defaults", action="store_true", help="not the settings that suit the problem")
    parser.add_argument("--draws", type=int, default=16, help="of measurement noise, where a problem has any")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only-peers", action="store_true", help="not the library itself")
    parser.add_argument("--peers", nargs="*", default=[], choices=["mdn", "maf", "nsf"])
    parser.add_argument("--epochs", type=int, default=2**31 - 1, help="of peers, at most")
    parser.add_argument("--sbi", help="folder that sbi and torch are installed in, if not beside this library")
    args, rest = parser.parse_known_args()
    if args.sbi:
        sys.path.append(args.sbi)
    if args.peers and importlib.util.find_spec("sbi") is None:
        parser.error("--peers needs sbi: pip install sbi")
    options = dict(option(text) for text in rest)
    for name in args.problems:
        problem = PROBLEMS[name]()
        if args.defaults:
            problem = replace(problem, settings={})
        models: list[Callable] = [] if args.only_peers else [lambda *a: ours(*a, options, args.draws)]
        models += [lambda *a, e=e: peer(*a, e, args.epochs) for e in args.peers]
        for seed in range(args.first, args.first + args.seeds):
            for model in models:
                print(json.dumps(measure(problem, seed, args.simulations, args.samples, model)), flush=True)


if __name__ == "__main__":
    main()
