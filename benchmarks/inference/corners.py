"""Posteriors of several trajectories where the truth lies in a corner of the ranges, as an ant's hidden masses do.

    python benchmarks/inference/corners.py --problem linear --truths 24 --n 2 4 8
    python benchmarks/inference/corners.py bayessim.components=5 --problem Cartpole --truths 12 --n 2 4

Every parameter of a truth lies --beside of its range from one of its ends. `linear` has an exact posterior: --dim
parameters, uniform in [-1, 1], each measured with noise of .5. A task's trajectories are under random commands. One
JSON row for each number of trajectories: mean gain over the prior and shares of truths in the 50, 80 and 95 % regions
of the product as it is, as wide as sets at draws of the prior ask for (`prior`), and moved and as wide as sets at its
own draws do (`here`). Without --middle, truths lie where hardly any draw of the prior does.
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
from bayessim_mjx.inference import InferenceSettings, combine, fit, init, local_recalibration, product_calibration
from bayessim_mjx.inference.temperature import tempered
from bayessim_mjx.loop.trajectories import features
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
        "50/80/95": [round(float(np.mean(found <= p)), 2) for p in product_calibration.LEVELS],
    }  # fmt: skip


@dataclass(frozen=True)
class Fitted:
    """A network of single trajectories, and how products of its posteriors are on average over the prior."""

    study: Study
    state: Any
    components: int
    everywhere: product_calibration.Sets

    def drawn(self, key: jax.Array, thetas: jax.Array, n: int) -> tuple[list[list[Distribution]], np.ndarray]:
        """Factors of sets of n trajectories at thetas [m, d], and the thetas of those that have any."""
        return drawn(self.study, self.state, key, thetas, n)


def drawn(
    study: Study, state: Any, key: jax.Array, thetas: jax.Array, n: int
) -> tuple[list[list[Distribution]], np.ndarray]:
    columns = [study.simulate(one, thetas) for one in jax.random.split(key, n)]
    rows, good = factors_of(state, columns, study.share)
    return rows, np.asarray(thetas)[good]


def fitted(study: Study, components: int, simulations: int, most: int, seed: int) -> Fitted:
    keys = jax.random.split(jax.random.PRNGKey(seed), 6)
    prior = Distribution.prior(study.space)
    thetas = prior.sample(keys[0], simulations)
    x = study.simulate(keys[1], thetas)
    state, info = fit(keys[3], init(keys[2], study.settings, study.space, x.shape[1]), thetas, x)
    print(json.dumps({"held out": round(float(info.log_q), 3)}), flush=True)
    found = product_calibration.judge(*drawn(study, state, keys[5], prior.sample(keys[5], SETS), most), components)
    return Fitted(study, state, components, found)


def measured(one: Fitted, truths: jax.Array, n: int, key: jax.Array) -> dict[str, Any]:
    """The row of n trajectories."""
    k, study = one.components, one.study
    found = replace(one.everywhere, counts=tuple(c for c in one.everywhere.counts if c.trajectories <= n))
    columns = [study.simulate(each, truths) for each in jax.random.split(key, n)]
    rows, good = factors_of(one.state, columns, study.share)
    kinds: dict[str, tuple[list[float], list[float]]] = {}
    settled, exact, clock = [], [], 0.0
    for i, row in zip(good, rows, strict=True):
        product, at, began = combine(row, k), truths[i], time.perf_counter()

        def around(posterior: Distribution, turn: int, i: int = i) -> Any:
            own = jax.random.fold_in(jax.random.fold_in(key, i), 10 * n + turn)
            return one.drawn(own, posterior.sample(own, SETS), n)

        settled.append(local_recalibration.recalibrated(found, product, around, k))
        clock += time.perf_counter() - began
        wide = tempered(product, found.widening(n))
        for kind, q in {"as it is": product, "prior": wide, "here": settled[-1].used(product, n)}.items():
            gains, levels = kinds.setdefault(kind, ([], []))
            gains.append(max(float(q.log_gain(at)), -100.0))
            levels.append(float(q.credible_level(at)))
        if study.exact is not None:
            exact.append(study.exact(np.stack([np.asarray(c[i]) for c in columns]), np.asarray(at)))
    told = {"n": n, "truths": len(good), "exact": round(float(np.mean(exact)), 2) if exact else None}
    told |= {"widening at the prior's draws": round(found.widening(n), 2)}
    told |= {"widening here": round(float(np.median([s.widening(n) for s in settled])), 2)}
    told |= {"turns": round(float(np.mean([len(s.near) for s in settled])), 1), "s": round(clock / len(good), 1)}
    return told | {kind: summed(*each) for kind, each in kinds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", default="linear", help="linear, or a task")
    parser.add_argument("--dim", type=int, default=6, help="of linear")
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--truths", type=int, default=24)
    parser.add_argument("--beside", type=float, default=0.02)
    parser.add_argument("--middle", action="store_true", help="truths from the prior instead")
    parser.add_argument("--still", action="store_true", help="products are widened, but not moved")
    parser.add_argument("--n", nargs="+", type=int, default=[2, 4, 8])
    parser.add_argument("--seed", type=int, default=0)
    args, more = parser.parse_known_args()
    if args.still:
        local_recalibration.ALPHA = 0.0
    own = args.problem == "linear"
    fixed = ["bayessim.collectPolicy=policy_random", "bayessim.refine=off", *more]
    settings = config.load("Pendulum" if own else args.problem, overrides=fixed)
    study = linear(args.dim, settings) if own else task(args.problem, settings)
    one = fitted(study, settings.bayessim.components, args.simulations, max(args.n), args.seed)
    k_truth, k_set = jax.random.split(jax.random.PRNGKey(100 + args.seed))
    ends = jax.random.bernoulli(k_truth, shape=(args.truths, len(study.space)))
    unit = jnp.where(ends, 1 - args.beside, args.beside)
    unit = jax.random.uniform(k_truth, unit.shape) if args.middle else unit
    truths = jax.vmap(study.space.from_unit)(unit)
    for n in args.n:
        print(json.dumps({"problem": args.problem, **measured(one, truths, n, k_set)}), flush=True)


if __name__ == "__main__":
    main()
