"""What the loop's policies would be worth with the truth known: PPO on the surrogate's own parameters, several seeds.

    python benchmarks/loop/at_truth.py --task Ant --seeds 5 env.numEnvs=4096 ppo.max_iterations=250

Prints, per seed, mean return and its standard error over `bayessim.realEvals` episodes on the surrogate real, as the
loop evaluates its own policies: the same settings and iterations, another random start, and physics fixed at
`env.realParams`.
"""

import argparse
import json

import jax
import numpy as np

from bayessim_mjx import loop, registry, rl
from bayessim_mjx.config import load
from bayessim_mjx.distributions import Distribution

SD = 1e-3  # of a parameter's range: as good as fixed, and still a distribution


def one(task: str, seed: int, arguments: list[str]) -> dict:
    """Train at the truth with one seed; return and standard error on the surrogate real."""
    config = load(task, overrides=[*arguments, f"seed={seed}"])
    env = registry.make(task, config=config)
    parts = loop.make(config, env)
    space = env.space
    domain = Distribution.gaussian(space, parts.source.truth, SD * (np.asarray(space.high) - np.asarray(space.low)))
    key = jax.random.key(seed)
    state = rl.start(env, config.ppo, jax.random.fold_in(key, 0), domain)
    state, _ = rl.run(env, config.ppo, state, domain, iterations=config.ppo.max_iterations)
    thetas = parts.source.sample(jax.random.fold_in(key, 1), config.bayessim.realEvals)
    returns = np.asarray(rl.evaluate(env, rl.policy_of(state), jax.random.fold_in(key, 2), thetas)["return"])
    return {
        "seed": seed,
        "return": round(float(returns.mean()), 1),
        "se": round(float(returns.std() / len(returns) ** 0.5), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("overrides", nargs="*", help="key=value settings, as main takes them")
    args = parser.parse_args()
    for seed in range(args.seeds):
        print(json.dumps(one(args.task, seed, args.overrides)), flush=True)


if __name__ == "__main__":
    main()
