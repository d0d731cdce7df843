"""What the loop's policies would be worth with the truth known: PPO on the surrogate's own parameters, several seeds.

    python benchmarks/loop/at_truth.py --task Ant --seeds 5 env.numEnvs=4096 ppo.max_iterations=250
    python benchmarks/loop/at_truth.py --task Ant --runs logs/Ant/RUN ... env.numEnvs=4096 ppo.max_iterations=1000

Prints, per seed, mean return and its standard error over `bayessim.realEvals` episodes on the surrogate real, as the
loop evaluates its own policies: the same settings and iterations, another random start, and physics fixed at
`env.realParams`. With `--runs` one policy for each of these runs, on its last posterior, as in `train --domain`.
"""

import argparse
import json

import jax
import numpy as np

from bayessim_mjx import loop, registry, rl
from bayessim_mjx.config import load
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.runs import Run
from bayessim_mjx.wrappers.worlds import domain_of

SD = 1e-3  # of a parameter's range: as good as fixed, and still a distribution


def one(task: str, seed: int, arguments: list[str], run: str | None = None) -> dict:
    """Train at the truth (or on the run's posterior) with one seed; return and standard error on the surrogate real."""
    config = load(task, overrides=[*arguments, f"seed={seed}"])
    env = registry.make(task, config=config)
    parts = loop.make(config, env)
    space = env.space
    fixed = SD * (np.asarray(space.high) - np.asarray(space.low))
    domain = domain_of(env, run) if run else Distribution.gaussian(space, parts.source.truth, fixed)
    key = jax.random.key(seed)
    state = rl.start(env, config.ppo, jax.random.fold_in(key, 0), domain)
    state, _ = rl.run(env, config.ppo, state, domain, iterations=config.ppo.max_iterations)
    thetas = parts.source.sample(jax.random.fold_in(key, 1), config.bayessim.realEvals)
    returns = np.asarray(rl.evaluate(env, rl.policy_of(state), jax.random.fold_in(key, 2), thetas)["return"])
    return {
        "domain": run or "truth",
        "seed": seed,
        "iterations": config.ppo.max_iterations,
        "return": round(float(returns.mean()), 1),
        "se": round(float(returns.std() / len(returns) ** 0.5), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument(
        "--runs", nargs="+", default=[], help="of the loop: train on the posterior of each, with its seed"
    )
    parser.add_argument("overrides", nargs="*", help="key=value settings, as main takes them")
    args = parser.parse_args()
    args.overrides += [text for text in args.runs if "=" in text]  # settings behind the names of runs
    args.runs = [text for text in args.runs if "=" not in text]
    for run in args.runs:
        print(json.dumps(one(args.task, Run.open(run).config.seed, args.overrides, run)), flush=True)
    for seed in () if args.runs else range(args.first, args.first + args.seeds):
        print(json.dumps(one(args.task, seed, args.overrides)), flush=True)


if __name__ == "__main__":
    main()
