"""Posteriors of several trajectories: the tempered product against a network that sees the set, beside exact ones.

    python benchmarks/inference/set_networks.py --problem gaussian_linear pendulum bounces --n 1 4 16 --out sets.json

The product is that of the loop: factors with a share of the prior, standard deviations widened by what 64 simulated
sets ask for. The network of sets is trained anew for every truth, on sets simulated in the product's region. `bounces`
is a ball on a rough floor, whose slopes nobody knows: no replay has a likelihood. A table tells how often the 50, 80
and 95 % regions hold the truth, and the mean gain over the prior in nats.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from problems import PROBLEMS, Problem

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import (
    Again,
    InferenceSettings,
    combine,
    condition,
    fit,
    init,
    product_calibration,
    set_network,
)
from bayessim_mjx.inference.temperature import tempered

LEVELS = (0.5, 0.8, 0.95)
COMPONENTS, PRIOR_SHARE, SETS = 10, 0.05, 64  # as the loop has them
DRAWS = 16  # of measurement noise, where a problem has any


def trained(problem: Problem, simulations: int) -> Any:
    """The network of single trajectories."""
    thetas, x = problem.pairs(jax.random.PRNGKey(1000), simulations)
    settings = InferenceSettings(coordinates="probit" if problem.settings["coordinates"] == "probit" else "plain")
    again = None
    if problem.measured:
        keys = jax.random.split(jax.random.PRNGKey(2000), DRAWS - 1)
        more = jnp.stack([problem.simulate(key, thetas) for key in keys], axis=1)
        again = Again(more, jnp.arange(len(thetas), dtype=jnp.int32))
    state = init(jax.random.PRNGKey(0), settings, problem.space, x.shape[1])
    return fit(jax.random.PRNGKey(1), state, thetas, x, again=again)[0]


def recorded(problem: Problem, key: jax.Array, count: int, n: int) -> tuple[jax.Array, jax.Array]:
    """(thetas [count, d], sets [count, n, D])."""
    k_theta, k_x = jax.random.split(key)
    thetas = Distribution.prior(problem.space).sample(k_theta, count)
    return thetas, problem.simulate(k_x, jnp.repeat(thetas, n, axis=0)).reshape(count, n, -1)


def factors(network: Any, x: jax.Array) -> list[Distribution]:
    """Posteriors of summaries [n, D] as they are multiplied."""
    rows = jax.tree.map(np.asarray, condition(network, x)).split()
    return [replace(row, prior_weight=jnp.float32(PRIOR_SHARE)) for row in rows]


def judged(q: Distribution, theta: jax.Array, name: str) -> dict[str, float]:
    return {f"{name} level": float(q.credible_level(theta)), f"{name} gain": float(q.log_gain(theta))}


def rows_of(problem: Problem, counts: list[int], truths: int, simulations: int, count: int, out: Path) -> None:
    """One row per truth and number of trajectories, written as they come."""
    rows = json.loads(out.read_text()) if out.exists() else []
    done = {(r["problem"], r["n"], r["truth"]) for r in rows}
    clock = time.process_time()
    network = trained(problem, simulations)
    most = max(counts)
    at, x = recorded(problem, jax.random.PRNGKey(3), SETS, most)
    widening = product_calibration.judge([factors(network, each) for each in x], np.asarray(at), COMPONENTS)
    told = {c.trajectories: (round(c.widening, 2), round(c.gain, 2)) for c in widening.counts}
    print(
        problem.name, "network and sets", round(time.process_time() - clock, 1), "s; widening, gain", told, flush=True
    )
    thetas, x = recorded(problem, jax.random.PRNGKey(5), truths, most)
    for i in range(truths):
        single = factors(network, x[i])
        for n in counts:
            if (problem.name, n, i) in done:
                continue
            clock = time.process_time()
            product = tempered(combine(single[:n], COMPONENTS), widening.at(n).widening)
            after = time.process_time()
            key = jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(7), i), n)
            learnt = set_network.learn(key, network, product, problem.simulate, n, count)
            (posterior,) = learnt.posteriors([one[None] for one in x[i, :n]]).split()
            posterior = replace(posterior, prior_weight=jnp.float32(PRIOR_SHARE))
            row = {"problem": problem.name, "n": n, "truth": i, "best": int(learnt.info.best)}
            row |= judged(product, thetas[i], "product") | judged(posterior, thetas[i], "sets")
            if problem.gain is not None:
                row["exact"] = problem.gain(np.asarray(x[i, :n]), np.asarray(thetas[i]))
            row |= {"product s": after - clock, "sets s": time.process_time() - after}
            rows.append(row)
            out.write_text(json.dumps(rows))


def line(rows: list[dict], name: str) -> str:
    held = [np.mean([r[f"{name} level"] <= p for r in rows]) for p in LEVELS]
    gains = np.array([r[f"{name} gain"] for r in rows])
    exact = [r["exact"] for r in rows if "exact" in r]
    text = f"| {rows[0]['problem']} | {rows[0]['n']} | {name} | {' '.join(f'{h:.2f}' for h in held)} "
    text += f"| {gains.mean():.2f} +- {gains.std() / len(gains) ** 0.5:.2f} "
    difference = gains - np.array([r["product gain"] for r in rows])
    text += f"| {difference.mean():.2f} +- {difference.std() / len(gains) ** 0.5:.2f} "
    text += f"| {np.mean(exact):.2f} " if exact else "| "
    return text + f"| {np.median([r[name + ' s'] for r in rows]):.1f} | {len(rows)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", nargs="+", default=["gaussian_linear"], choices=list(PROBLEMS))
    parser.add_argument("--n", nargs="+", type=int, default=[1, 4, 16])
    parser.add_argument("--truths", type=int, default=64)
    parser.add_argument("--simulations", type=int, default=10_000, help="of single trajectories")
    parser.add_argument("--sets", type=int, default=2000, help="simulated for each network of sets")
    parser.add_argument("--out", type=Path, default=Path("sets.json"), help="kept after every truth, taken up")
    a = parser.parse_args()
    for name in a.problem:
        rows_of(PROBLEMS[name](), a.n, a.truths, a.simulations, a.sets, a.out)
    rows = json.loads(a.out.read_text())
    print("| problem | n | posterior | 50 80 95 % | gain, nats | more than the product | exact | CPU s | truths |")
    for key in sorted({(r["problem"], r["n"]) for r in rows}):
        for name in ("product", "sets"):
            print(line([r for r in rows if (r["problem"], r["n"]) == key], name))


if __name__ == "__main__":
    main()
