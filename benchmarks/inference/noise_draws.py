"""What it is worth that training sees another draw of the measurement noise in every epoch (`bayessim.noiseDraws`).

    python benchmarks/inference/noise_draws.py --task Cartpole Pendulum --draws 1 16 --seeds 3

One JSON row per task, number of draws and seed: log q of the true parameters and coverage over fresh trajectories
under random commands, of the network's posterior (`bare`) and of the posterior as it is used, with the prior where a
parameter is not identified. Tasks without sensor noise of their own get `--noise`. Further settings go to the run:
`bayessim.coordinates=probit`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import config, loop
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import Again, InferenceSettings, calibration, condition, fit, init
from bayessim_mjx.inference.checks import conditioned
from bayessim_mjx.loop.trajectories import simulated
from bayessim_mjx.registry import make

FRESH = 1000  # pairs that score a network


def scored(key: jax.Array, posteriors: Distribution, thetas: jax.Array) -> dict[str, Any]:
    """Log q, gain over the prior with its standard error, and coverage at thetas [n, d]."""
    found = calibration.ranks(key, posteriors, thetas)
    gain = np.asarray(found.gain)
    log_q = float(np.mean(gain + jax.vmap(posteriors.space.unbatched.log_prior)(thetas)))
    row: dict[str, Any] = {"log q": round(log_q, 3), "gain": round(float(gain.mean()), 3)}
    row["se"] = round(float(gain.std() / len(gain) ** 0.5), 3)
    return row | {"coverage 50/80/95": [round(float(np.mean(found.level <= p)), 3) for p in (0.5, 0.8, 0.95)]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=["Cartpole"])
    parser.add_argument("--draws", nargs="+", type=int, default=[1, 16])
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--noise", type=float, default=0.02, help="standard deviation, where a task states none")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    args, more_settings = parser.parse_known_args()
    for name in args.task:
        fixed = ["bayessim.collectPolicy=policy_random", "bayessim.refine=off"]
        settings = config.load(name, overrides=[*fixed, *more_settings])
        parts = loop.make(settings, make(name, config=settings))
        source = dataclasses.replace(parts.source, noise=parts.source.noise or args.noise)
        prior, space = Distribution.prior(parts.env.space), parts.env.space
        for seed in range(args.first, args.first + args.seeds):
            keys = jax.random.split(jax.random.PRNGKey(seed), 5)
            count = args.simulations + FRESH
            thetas, x, more = simulated(source, keys[0], None, prior.sample, count, max(args.draws))
            n, own = args.simulations, jnp.arange(args.simulations, dtype=jnp.int32)
            for draws in args.draws:
                clock = time.process_time()
                state = init(keys[1], InferenceSettings.of(settings.bayessim), space, x.shape[1])
                again = None if draws == 1 else Again(more[:n, : draws - 1], own)
                state, info = fit(keys[2], state, thetas[:n], x[:n], again=again)
                jax.block_until_ready(state.params)
                row = {"task": name, "draws": draws, "seed": seed, "cpu s": round(time.process_time() - clock, 1)}
                for kind, of in (("bare", condition), ("used", conditioned)):
                    row[kind] = scored(keys[3], of(state, x[n:]), thetas[n:])
                row["identified"] = [p for p, told in zip(space.names, state.identified, strict=True) if told]
                print(json.dumps(row | {"held out": round(float(info.log_q), 3)}), flush=True)


if __name__ == "__main__":
    main()
