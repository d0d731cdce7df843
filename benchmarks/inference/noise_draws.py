"""What it is worth that training sees another draw of the measurement noise in every epoch (`bayessim.noiseDraws`).

    python benchmarks/inference/noise_draws.py --task Cartpole Pendulum --draws 1 16 --seeds 3

One JSON row per task, number of draws and seed: log q of the true parameters and coverage over fresh trajectories under
random commands. Tasks without sensor noise of their own get `--noise`.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import config, loop
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import Again, InferenceSettings, calibration, condition, fit, init
from bayessim_mjx.loop.simulations import simulated
from bayessim_mjx.registry import make

FRESH = 1000  # pairs that score a network


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=["Cartpole"])
    parser.add_argument("--draws", nargs="+", type=int, default=[1, 16])
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--noise", type=float, default=0.02, help="standard deviation, where a task states none")
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    for name in args.task:
        settings = config.load(name, overrides=["bayessim.collectPolicy=policy_random", "bayessim.refine=off"])
        parts = loop.make(settings, make(name, config=settings))
        source = dataclasses.replace(parts.source, noise=parts.source.noise or args.noise)
        prior, space = Distribution.prior(parts.env.space), parts.env.space
        for seed in range(args.seeds):
            keys = jax.random.split(jax.random.PRNGKey(seed), 5)
            count = args.simulations + FRESH
            thetas, x, more = simulated(source, keys[0], None, prior, "prior", count, draws=max(args.draws))
            n, own = args.simulations, jnp.arange(args.simulations, dtype=jnp.int32)
            for draws in args.draws:
                clock = time.process_time()
                state = init(keys[1], InferenceSettings.of(settings.bayessim), space, x.shape[1])
                again = None if draws == 1 else Again(more[:n, : draws - 1], own)
                state, info = fit(keys[2], state, thetas[:n], x[:n], again=again)
                jax.block_until_ready(state.params)
                row = {"task": name, "draws": draws, "seed": seed, "cpu s": round(time.process_time() - clock, 1)}
                found = calibration.ranks(keys[3], condition(state, x[n:]), thetas[n:])
                density = np.asarray(found.gain + jax.vmap(space.log_prior)(thetas[n:]))
                row |= {"log q": round(float(density.mean()), 3), "gain": round(float(np.mean(found.gain)), 3)}
                row["coverage 50/80/95"] = [round(float(np.mean(found.level <= p)), 3) for p in (0.5, 0.8, 0.95)]
                print(json.dumps(row | {"held out": round(float(info.log_q), 3)}), flush=True)


if __name__ == "__main__":
    main()
