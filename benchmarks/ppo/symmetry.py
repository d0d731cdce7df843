"""What mirror symmetry is worth: samples to a return, last return, symmetry of policy and gait; with it and without.

    python benchmarks/ppo/symmetry.py --iterations 300 --num_envs 4096 --seeds 5 --reward 3000 --out symmetry.jsonl

Each way trains from the same seeds with the task's own settings. Columns: env steps until the mean return of the last
100 training episodes reaches --reward; return of 128 deterministic episodes after the last iteration; and in these
- policy: |a(M o) - M a(o)| / (|a(M o)| + |a(o)|), root mean squares over all states visited
- gait: |left - right| / (left + right) of the root mean square action of each pair of joints, mean over pairs
Both are 0 for perfect symmetry and 1 at most. Median and range over seeds; seconds of the first include compilation.
"""

import argparse
import json
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import config, registry, rl
from bayessim_mjx.config import SymmetryConfig
from bayessim_mjx.rl.symmetry import mirrored
from bayessim_mjx.rollout import rollout

WAYS = {
    "off": None,
    "augmentation": SymmetryConfig(use_data_augmentation=True),
    "mirror loss": SymmetryConfig(use_mirror_loss=True, mirror_loss_coeff=1.0),
    "both": SymmetryConfig(use_data_augmentation=True, use_mirror_loss=True, mirror_loss_coeff=1.0),
}
FIGURES = ("steps_to_reward", "return", "policy", "gait", "seconds")
EPISODES = 128


def learn(env, ppo, seed: int, reward: float) -> tuple[rl.Policy, int | None, float]:
    """(policy, env steps until the training return reached `reward` or None, seconds)."""
    reached: list[int] = []

    def progress(metrics, state):
        if not reached and metrics["Train/mean_reward"] >= reward:
            reached.append(int(metrics["env_steps"]))

    started = time.perf_counter()
    state, _ = rl.run(env, ppo, rl.init(env, ppo, jax.random.PRNGKey(seed)), progress=progress)
    return rl.policy_of(state), reached[0] if reached else None, time.perf_counter() - started


def rms(x: jax.Array, weight: jax.Array) -> np.ndarray:
    """Root mean square over all but the last axis, where weight is 1."""
    return np.sqrt(np.asarray((x**2 * weight[..., None]).sum((0, 1)) / weight.sum()))


def asymmetry(env, policy: rl.Policy, key: jax.Array) -> tuple[float, float]:
    """Of the policy and of its gait, by the environment's first mirror map; 0 is symmetric."""
    mirror = env.mirrors[0]
    policy = replace(policy, deterministic=True)
    run = rollout(env, policy, key, jnp.tile(jnp.asarray(env.space.nominal), (EPISODES, 1)), env.episode_length)
    seen = run.observation[:, :-1]
    action, of_mirrored = policy.act(None, seen), policy.act(None, mirrored(seen, mirror.observation["policy"]))
    difference = rms(of_mirrored - mirrored(action, mirror.action), run.valid)
    size, partner = rms(run.action, run.valid), mirror.action[0]
    pairs = partner != np.arange(len(partner))
    gait = (np.abs(size - size[partner]) / (size + size[partner] + 1e-8))[pairs]
    norms = [np.linalg.norm(rms(x, run.valid)) for x in (difference, action, of_mirrored)]
    return float(norms[0] / (norms[1] + norms[2] + 1e-8)), float(gait.mean()) if pairs.any() else float("nan")


def measure(env, ppo, seed: int, reward: float) -> dict:
    policy, steps, seconds = learn(env, ppo, seed, reward)
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (EPISODES, 1))
    score = float(rl.evaluate(env, policy, jax.random.PRNGKey(1), thetas)["return"].mean())
    of_policy, of_gait = asymmetry(env, policy, jax.random.PRNGKey(2))
    return dict(zip(FIGURES, (steps, score, of_policy, of_gait, seconds), strict=True))


def spread(values: list) -> str:
    """ "median (least to most)"; runs that never got there count as the worst."""
    numbers = np.array([np.inf if v is None else v for v in values], float)
    if np.isnan(numbers).any():
        return "-"
    short = [f"{v:.3g}" if np.isfinite(v) else "never" for v in (np.median(numbers), numbers.min(), numbers.max())]
    return f"{short[0]} ({short[1]} to {short[2]})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--num_envs", type=int, default=4096)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--reward", type=float, default=3000.0)
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--out", help="append each run as a line of JSON")
    parser.add_argument("overrides", nargs="*", help="settings as key=value")
    args = parser.parse_args()
    settings = config.load(args.task, overrides=[f"env.numEnvs={args.num_envs}", *args.overrides])
    env = registry.make(args.task, config=settings)
    base = replace(settings.ppo, max_iterations=args.iterations, log_interval=min(5, args.iterations))
    print(jax.devices(), base, flush=True)
    results: dict[str, list[dict]] = {way: [] for way in args.ways}
    for seed in range(args.seeds):
        for way in args.ways:
            run = measure(env, replace(base, symmetry=WAYS[way]), seed, args.reward)
            results[way].append(run)
            print(f"seed {seed} {way:12s} {run}", flush=True)
            if args.out:
                with open(args.out, "a", encoding="utf-8") as file:
                    file.write(json.dumps({"task": args.task, "seed": seed, "way": way, **run}) + "\n")
    print("| symmetry | env steps to reward | return | asymmetry of policy | of gait | s |\n|---|---|---|---|---|---|")
    for way, runs in results.items():
        print(f"| {way} | " + " | ".join(spread([run[name] for run in runs]) for name in FIGURES) + " |")


if __name__ == "__main__":
    main()
