"""Put the best policy of finished runs of `train` among those that come with the package (bayessim_mjx.pretrained).

    python docs/release_policy.py RUN [RUN ...] [--episodes N]

The policy is evaluated on fresh episodes at nominal physics; its return, the command that trained it and the SHA-256
of its file go into index.json.
"""

import argparse
import re

import jax
import jax.numpy as jnp

from bayessim_mjx import cli, registry, rl
from bayessim_mjx.rl import pretrained

PATHS = re.compile(r" --(?:logdir|device|name|cache_dir)[ =]\S+| --headless")  # what does not change a policy


def release(run: str, episodes: int) -> None:
    path, found = cli.find_checkpoint(run, None, "")
    if found is None:
        raise SystemExit(f"{run}: not the folder of a run")
    config = found.config
    env = registry.make(config.task, config=config)
    policy = cli.load_policy(path, env, config)
    thetas = jnp.tile(jnp.asarray(env.space.nominal, jnp.float32), (episodes, 1))
    returns = rl.evaluate(env, policy, jax.random.PRNGKey(1), thetas)["return"]
    facts = {
        "return": {"mean": round(float(returns.mean()), 2), "sd": round(float(returns.std()), 2), "episodes": episodes},
        "command": PATHS.sub("", found.manifest["command"]),
        "versions": {name: found.manifest["versions"][name] for name in ("bayessim-mjx", "jax", "mujoco")},
    }
    file = pretrained.write(policy, config.task, facts)
    print(f"{file}: {file.stat().st_size / 1000:.0f} kB, return {facts['return']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="+", help="folders of runs")
    parser.add_argument("--episodes", type=int, default=512, help="episodes of the evaluation (default: 512)")
    args = parser.parse_args()
    for run in args.run:
        release(run, args.episodes)


if __name__ == "__main__":
    main()
