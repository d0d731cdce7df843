"""What each summary lets the network learn: a damped pendulum under random torques, measured with noise.

    python benchmarks/inference/summaries.py [--summaries start signatory_3 ...] [--simulations 6000] [--seeds 0 1]

Prints, per summary, its size and the mean log density of held-out (length, damping) over the prior [nats].
"""

from __future__ import annotations

import argparse
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.inference import InferenceSettings, fit, init, summarizers
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("length", 1.0, 0.3, 1.5), Parameter("damping", 0.1, 0.02, 0.5)])
DT, STEPS, NOISE = 0.05, 30, 0.02
DEFAULT = (
    "start",
    "waypts",
    "corr",
    "corrdiff",
    "corrdiff_5",
    "signatory_2",
    "signatory_3",
    "signatory_4",
    "logsignature",
)


def simulate(key: Array, theta: Array) -> tuple[Array, Array]:
    """States [T+1, 3] (cos, sin, rad/s) and torques [T, 1]: q'' = -(9.81 / L) sin q - (b q' - u) / L^2."""
    k_torque, k_angle, k_noise = jax.random.split(key, 3)
    torque = jax.random.uniform(k_torque, (STEPS, 1), minval=-1.5, maxval=1.5)
    length, damping = theta

    def step(state: tuple[Array, Array], u: Array) -> tuple[tuple[Array, Array], Array]:
        q, v = state
        v = v + DT * (-9.81 / length * jnp.sin(q) - (damping * v - u[0]) / length**2)
        q = q + DT * v
        return (q, v), jnp.stack([jnp.cos(q), jnp.sin(q), v])

    q = jax.random.uniform(k_angle, minval=-2.0, maxval=2.0)
    first = jnp.stack([jnp.cos(q), jnp.sin(q), 0.0])
    states = jnp.concatenate([first[None], jax.lax.scan(step, (q, jnp.float32(0)), torque)[1]])
    return states + NOISE * jax.random.normal(k_noise, states.shape), torque


@partial(jax.jit, static_argnums=0)
def features(name: str, key: Array, thetas: Array) -> Array:
    """Summaries [N, D] of one trajectory at each theta [N, 2]."""
    summarize = summarizers.get(name)
    return jax.vmap(lambda key, theta: summarize(*simulate(key, theta)))(jax.random.split(key, len(thetas)), thetas)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--summaries", nargs="+", default=DEFAULT)
    parser.add_argument("--simulations", type=int, default=6000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    args = parser.parse_args()
    settings = InferenceSettings(components=4, max_steps=1500)
    print("summary          size  held-out log density over the prior [nats], one per seed")
    for name in args.summaries:
        gains = []
        for seed in args.seeds:
            key = jax.random.PRNGKey(seed)
            uniform = np.random.default_rng(seed).uniform(SPACE.low, SPACE.high, (args.simulations, 2))
            thetas = jnp.asarray(uniform, jnp.float32)
            x = features(name, key, thetas)
            _, info = fit(jax.random.fold_in(key, 1), init(key, settings, SPACE, x.shape[1]), thetas, x)
            gains.append(f"{float(info.gain):.2f}")
        print(f"{name:15s} {x.shape[1]:5d}  {'  '.join(gains)}", flush=True)


if __name__ == "__main__":
    main()
