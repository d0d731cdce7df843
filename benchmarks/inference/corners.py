"""Posteriors of several trajectories where the truth lies in a corner of the ranges, as an ant's hidden masses do.

    python benchmarks/inference/corners.py --problem linear --truths 24 --n 2 4 8
    python benchmarks/inference/corners.py --problem Cartpole --truths 12 --n 2 4 bayessim.components=5

Every parameter of a truth lies --beside of its range from one of its ends. `linear` has an exact posterior: --dim
parameters, uniform in [-1, 1], each measured with noise of .5. A task's trajectories are under random commands. One
JSON row for each number of trajectories: mean gain over the prior and shares of truths in the 50, 80 and 95 % regions
of the product as it is, as wide as sets at draws of the prior ask for, and as sets at its own draws do.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from coordinates import factors_of
from scipy.stats import norm

from bayessim_mjx import config, loop
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, fit, init, near, sets
from bayessim_mjx.inference.posterior import combine
from bayessim_mjx.inference.temperature import tempered
from bayessim_mjx.loop.simulations import features
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.registry import make

SETS, NOISE = 64, 0.5


@dataclass(frozen=True)
class Study:
    space: Any
    simulate: Callable[[jax.Array, jax.Array], jax.Array]  # key, theta [m, d] -> summaries [m, D]
    settings: Any  # of a network
    share: float  # of the prior in each factor
    exact: Callable[[np.ndarray, np.ndarray], float] | None  # summaries [n, D], theta [d] -> nats over the prior


def linear(dim: int, settings: Any) -> Study:
    """theta ~ U[-1, 1]^dim, x = theta + N(0, NOISE^2)."""
    space = ParameterSpace([Parameter(f"t{i}", 0.0, -1.0, 1.0) for i in range(dim)])

    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        return theta + NOISE * jax.random.normal(key, theta.shape)

    def exact(x: np.ndarray, theta: np.ndarray) -> float:
        sd, mean = NOISE / len(x) ** 0.5, x.mean(0)
        inside = norm.cdf((1 - mean) / sd) - norm.cdf((-1 - mean) / sd)
        return float(np.sum(norm.logpdf(theta, mean, sd) - np.log(inside) + np.log(2)))

    return Study(space, simulate, InferenceSettings.of(settings.bayessim), settings.bayessim.priorShare, exact)


def task(name: str, settings: Any) -> Study:
    """A task's summaries, under random commands."""
    parts = loop.make(settings, make(name, config=settings))
    source = parts.source
    assert source is not None

    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        return features(source, key, theta[None], None)  # type: ignore[arg-type]

    b = settings.bayessim
    return Study(parts.env.space, simulate, InferenceSettings.of(b), b.priorShare, None)


def summed(gains: list[float], levels: list[float]) -> dict[str, Any]:
    found = np.asarray(levels)
    return {
        "gain": round(float(np.mean(gains)), 2), "se": round(float(np.std(gains) / len(gains) ** 0.5), 2),
        "50/80/95": [round(float(np.mean(found <= p)), 2) for p in sets.LEVELS],
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", default="linear", help="linear, or a task")
    parser.add_argument("--dim", type=int, default=10)
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--truths", type=int, default=24)
    parser.add_argument("--beside", type=float, default=0.02)
    parser.add_argument("--middle", action="store_true", help="truths from the prior instead")
    parser.add_argument("--still", action="store_true", help="products are widened, but not moved")
    parser.add_argument("--n", nargs="+", type=int, default=[2, 4, 8])
    parser.add_argument("--seed", type=int, default=0)
    args, more = parser.parse_known_args()
    if args.still:
        near.CHANCE = 0.0
    plain = args.problem == "linear"
    fixed = ["bayessim.collectPolicy=policy_random", "bayessim.refine=off", *more]
    settings = config.load("Pendulum" if plain else args.problem, overrides=fixed)
    study = linear(args.dim, settings) if plain else task(args.problem, settings)
    keys = jax.random.split(jax.random.PRNGKey(args.seed), 6)
    thetas = Distribution.prior(study.space).sample(keys[0], args.simulations)
    x = study.simulate(keys[1], thetas)
    state, info = fit(keys[3], init(keys[2], study.settings, study.space, x.shape[1]), thetas, x)
    print(json.dumps({"problem": args.problem, "held out": round(float(info.log_q), 3)}), flush=True)
    k = settings.bayessim.components

    def drawn(key: jax.Array, where: jax.Array, n: int) -> tuple[list[list[Distribution]], np.ndarray]:
        columns = [study.simulate(one, where) for one in jax.random.split(key, n)]
        rows, good = factors_of(state, columns, study.share)
        return rows, np.asarray(where)[good]

    ends = jax.random.bernoulli(keys[4], shape=(args.truths, len(study.space)))
    unit = jnp.where(ends, 1 - args.beside, args.beside)
    unit = jax.random.uniform(keys[4], unit.shape) if args.middle else unit
    truths = jax.vmap(study.space.from_unit)(unit)
    everywhere = sets.judge(*drawn(keys[5], Distribution.prior(study.space).sample(keys[5], SETS), max(args.n)), k)
    for n in args.n:
        found = replace(everywhere, counts=tuple(c for c in everywhere.counts if c.trajectories <= n))
        columns = [study.simulate(one, truths) for one in jax.random.split(keys[4], n)]
        rows, good = factors_of(state, columns, study.share)
        kinds: dict[str, tuple[list[float], list[float]]] = {}
        factors, turns, seconds, exact = [], [], 0.0, []
        for i, row in zip(good, rows, strict=True):
            product, at = combine(row, k), truths[i]
            clock = time.perf_counter()

            def around(posterior: Distribution, turn: int, i: int = i, n: int = n) -> Any:
                key = jax.random.fold_in(jax.random.fold_in(keys[5], i), 10 * n + turn)
                return drawn(key, posterior.sample(key, SETS), n)

            settled = near.settled(found, product, around, k)
            seconds += time.perf_counter() - clock
            factors.append(settled.widening(n))
            turns.append(len(settled.near))
            ways = {
                "as it is": product,
                "prior": tempered(product, found.widening(n)),
                "here": settled.used(product, n),
            }
            for kind, q in ways.items():
                gains, levels = kinds.setdefault(kind, ([], []))
                gains.append(max(float(q.log_gain(at)), -100.0))
                levels.append(float(q.credible_level(at)))
            if study.exact is not None:
                exact.append(study.exact(np.stack([np.asarray(c[i]) for c in columns]), np.asarray(at)))
        row = {"n": n, "truths": len(good), "exact": round(float(np.mean(exact)), 2) if exact else None}
        row |= {"widening at the prior's draws": round(found.widening(n), 2)}
        row |= {"widening here": round(float(np.median(factors)), 2), "turns": round(float(np.mean(turns)), 1)}
        row |= {"s": round(seconds / len(good), 1)}
        print(json.dumps(row | {kind: summed(*each) for kind, each in kinds.items()}), flush=True)


if __name__ == "__main__":
    main()
