"""In which coordinates a task's posteriors are best, of one trajectory and of products (`bayessim.coordinates`).

    python benchmarks/inference/coordinates.py --task Ant --runs FOLDER --coordinates plain truncated probit logit

The best policy of the task's newest run in FOLDER acts (random commands without --runs). Networks of all coordinates
are fitted to the same simulations. One JSON row for each: gain over the prior and coverage over fresh trajectories, and
the same for products of --n trajectories, widened as sets ask for, at draws of the prior (`prior`) and at the task's
own hidden parameters (`truth`), which often lie in a corner of the ranges. Further settings go to the run.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from noise_draws import scored

from bayessim_mjx import cli, config, loop
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, fit, init, product_calibration
from bayessim_mjx.loop.posterior import conditioned, kept
from bayessim_mjx.loop.trajectories import features, simulated
from bayessim_mjx.registry import make

FRESH = 500  # pairs that score a network
SETS = 64


def factors_of(state: Any, columns: list[jax.Array], share: float) -> tuple[list[list[Distribution]], list[int]]:
    """Factors of the sets that have some, from trajectories' summaries [m, D], one array a trajectory; which sets."""
    each = []
    for x in columns:
        factors = kept(conditioned(state, x, jnp.float32(1)), state.identified, share)
        each.append(jax.tree.map(np.asarray, factors).split())
    rows = [list(row) for row in zip(*each, strict=True)]
    good = [i for i, row in enumerate(rows) if all(q.sound for q in row)]
    return [rows[i] for i in good], good


def widening(found: product_calibration.Sets, trajectories: int) -> float:
    """The factor that these sets asked for."""
    return found.at(trajectories).widening


def told(found: product_calibration.Sets) -> dict[str, Any]:
    """Of products of each number of trajectories."""
    return {
        c.trajectories: {
            "gain": round(c.gain, 2), "se": round(c.error, 2),
            "unwidened": round(c.plain, 2), "widening": round(c.widening, 2),
            "50/80/95": [round(float(np.mean(c.levels <= p)), 2) for p in product_calibration.LEVELS],
        }
        for c in found.counts
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--runs", help="folder of runs, for a policy")
    parser.add_argument("--coordinates", nargs="+", default=["plain", "truncated", "probit", "logit"])
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--n", type=int, default=4, help="trajectories of a set")
    parser.add_argument("--seed", type=int, default=0)
    args, more = parser.parse_known_args()
    collect = "policy_rl" if args.runs else "policy_random"
    settings = config.load(args.task, overrides=[f"bayessim.collectPolicy={collect}", "bayessim.refine=off", *more])
    env = make(args.task, config=settings)
    parts = loop.make(settings, env)
    source, space, policy = parts.source, env.space, None
    assert source is not None
    if args.runs:
        path, run = cli.find_checkpoint("best", args.task, args.runs)
        assert run is not None
        policy = cli.load_policy(path, env, run.config)
    keys = jax.random.split(jax.random.PRNGKey(args.seed), 6)
    n, clock = args.simulations, time.perf_counter()
    thetas, x, _ = simulated(source, keys[0], policy, Distribution.prior(space).sample, n + FRESH)
    at = {
        "prior": thetas[n : n + SETS],
        "truth": jnp.broadcast_to(jnp.asarray(source.truth, jnp.float32), (SETS, len(space))),
    }
    columns = {
        kind: [features(source, key, where[None], policy) for key in jax.random.split(keys[1], args.n)]
        for kind, where in at.items()
    }
    print(json.dumps({"task": args.task, "simulated s": round(time.perf_counter() - clock, 1)}), flush=True)
    for chart in args.coordinates:
        own = config.load(args.task, overrides=[*more, f"bayessim.coordinates={chart}"])
        clock = time.process_time()
        state = init(keys[2], InferenceSettings.of(own.bayessim), space, x.shape[1])
        state, info = fit(keys[3], state, thetas[:n], x[:n])
        row = {
            "coordinates": chart,
            "cpu s": round(time.process_time() - clock, 1),
            "held out": round(float(info.log_q), 3),
        }
        factors = kept(conditioned(state, x[n:], jnp.float32(1)), state.identified, own.bayessim.priorShare)
        row["one"] = scored(keys[4], factors, thetas[n:])
        judged: dict[str, product_calibration.Sets] = {}
        for kind, where in at.items():  # the sets at the prior's draws say how products are widened
            rows, good = factors_of(state, columns[kind], own.bayessim.priorShare)
            by = judged.get("prior")
            widened = None if by is None else functools.partial(widening, by)
            judged[kind] = product_calibration.judge(
                rows, np.asarray(where)[good], own.bayessim.components, widened_by=widened
            )
            row[kind] = told(judged[kind])
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
