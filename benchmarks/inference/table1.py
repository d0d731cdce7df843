"""Rows of Table I of the BayesSim paper (RSS 2019): log q of one truth, as there, and of 500 truths from the prior.

    python benchmarks/inference/table1.py --seeds 5

Pendulum, cart-pole and acrobot have gym's equations; the second link's length is none of the acrobot's, so its row asks
whether a method knows that it learnt nothing. As in the paper: 1000 simulations, x = cross-correlations of state
differences and actions, mean and variance, averaged over 10 rollouts of 200 steps, networks trained on that statistic.
A cell is the marginal log density of a parameter at the truth; gym's own values are the single truth.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, calibration, checks, fit, init, summarizers
from bayessim_mjx.parameters import Parameter, ParameterSpace

STEPS, ROLLOUTS, TRUTHS = 200, 10, 500


@dataclass(frozen=True)
class Row:
    """A simulator of one rollout, and what the paper reports."""

    ranges: dict[str, tuple[float, float]]
    truth: tuple[float, ...]
    # (key, theta) -> states [T + 1, S], actions [T, A], valid [T]
    simulate: Callable[[Array, Array], tuple[Array, Array, Array]]
    published: dict[str, tuple[float, str]]  # best of the four methods

    @property
    def space(self) -> ParameterSpace:
        return ParameterSpace(
            [Parameter(name, (low + high) / 2, low, high) for name, (low, high) in self.ranges.items()]
        )


def trajectory(
    key: Array, first: Array, act: Callable, step: Callable, see: Callable, over: Callable
) -> tuple[Array, Array, Array]:
    """States seen, actions and whether the episode still ran, from act(key, state) and step(state, action)."""

    def one(carry: tuple[Array, Array], key: Array) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        state, running = carry
        action = act(key, state)
        new = jnp.where(running, step(state, action), state)
        return (new, running & ~over(new)), (see(new), action, running)

    _, (states, actions, valid) = jax.lax.scan(one, (first, jnp.array(True)), jax.random.split(key, STEPS))
    return jnp.concatenate([see(first)[None], states]), actions[:, None], valid.astype(jnp.float32)


def pendulum(key: Array, theta: Array) -> tuple[Array, Array, Array]:
    """Pendulum-v1 of length 1 and mass 1 with random torques; theta = (dt,)."""
    key_first, key = jax.random.split(key)
    first = jax.random.uniform(key_first, (2,), minval=-1.0) * jnp.array([jnp.pi, 1.0])

    def step(state: Array, u: Array) -> Array:
        speed = jnp.clip(state[1] + (15.0 * jnp.sin(state[0]) + 3.0 * u) * theta[0], -8, 8)
        return jnp.stack([state[0] + speed * theta[0], speed])

    act = lambda key, _: jax.random.uniform(key, minval=-2.0, maxval=2.0)  # noqa: E731
    see = lambda s: jnp.stack([jnp.cos(s[0]), jnp.sin(s[0]), s[1]])  # noqa: E731
    return trajectory(key, first, act, step, see, lambda s: jnp.array(False))


def cartpole(key: Array, theta: Array) -> tuple[Array, Array, Array]:
    """CartPole-v1, pushed to where the pole leans, one push in five at random; theta = (half length, mass)."""
    length, mass = theta
    key_first, key = jax.random.split(key)

    def step(state: Array, push: Array) -> Array:
        x, v, q, w = state
        total, moment = 1.0 + mass, mass * length
        pressed = (10.0 * push + moment * w**2 * jnp.sin(q)) / total
        turn = (9.8 * jnp.sin(q) - jnp.cos(q) * pressed) / (length * (4 / 3 - mass * jnp.cos(q) ** 2 / total))
        speed = pressed - moment * turn * jnp.cos(q) / total
        return state + 0.02 * jnp.stack([v, speed, w, turn])

    def act(key: Array, state: Array) -> Array:
        key_coin, key_side = jax.random.split(key)
        lean = jnp.sign(state[2] + 0.3 * state[3])
        return jnp.where(jax.random.bernoulli(key_coin, 0.2), jax.random.rademacher(key_side, (), jnp.float32), lean)

    first = jax.random.uniform(key_first, (4,), minval=-0.05, maxval=0.05)
    over = lambda s: (jnp.abs(s[0]) > 2.4) | (jnp.abs(s[2]) > 0.2095)  # noqa: E731
    return trajectory(key, first, act, step, lambda s: s, over)


def acrobot(key: Array, theta: Array) -> tuple[Array, Array, Array]:
    """Acrobot-v1 with random torques; theta = (mass 1, mass 2, length 1, length 2), the last without effect."""
    m1, m2, l1, _ = theta
    half, moment, g = 0.5, 1.0, 9.8  # centres of mass and moments of inertia are not those of the lengths in gym
    key_first, key = jax.random.split(key)

    def slope(s: Array, u: Array) -> Array:
        q1, q2, w1, w2 = s
        d1 = m1 * half**2 + m2 * (l1**2 + half**2 + 2 * l1 * half * jnp.cos(q2)) + 2 * moment
        d2 = m2 * (half**2 + l1 * half * jnp.cos(q2)) + moment
        phi2 = m2 * half * g * jnp.cos(q1 + q2 - jnp.pi / 2)
        turning = m2 * l1 * half * jnp.sin(q2) * (w2**2 + 2 * w2 * w1)
        phi1 = -turning + (m1 * half + m2 * l1) * g * jnp.cos(q1 - jnp.pi / 2) + phi2
        pull = u + d2 / d1 * phi1 - m2 * l1 * half * w1**2 * jnp.sin(q2) - phi2
        a2 = pull / (m2 * half**2 + moment - d2**2 / d1)
        return jnp.stack([w1, w2, -(d2 * a2 + phi1) / d1, a2])

    def step(s: Array, u: Array) -> Array:
        a = slope(s, u)
        b = slope(s + 0.1 * a, u)
        c = slope(s + 0.1 * b, u)
        d = slope(s + 0.2 * c, u)
        s = s + 0.2 / 6 * (a + 2 * b + 2 * c + d)
        angles = jnp.mod(s[:2] + jnp.pi, 2 * jnp.pi) - jnp.pi
        return jnp.concatenate(
            [angles, jnp.clip(s[2:], -jnp.array([4.0, 9.0]) * jnp.pi, jnp.array([4.0, 9.0]) * jnp.pi)]
        )

    act = lambda key, _: jax.random.randint(key, (), -1, 2).astype(jnp.float32)  # noqa: E731
    see = lambda s: jnp.concatenate([jnp.cos(s[:2]), jnp.sin(s[:2]), s[2:]])  # noqa: E731
    first = jax.random.uniform(key_first, (4,), minval=-0.1, maxval=0.1)
    return trajectory(key, first, act, step, see, lambda s: jnp.array(False))


ROWS = {
    "Pendulum": Row({"dt": (0.01, 0.3)}, (0.05,), pendulum, {"dt": (3.199, "BayesSim NN")}),
    "CartPole": Row(
        {"length": (0.1, 2.0), "mass": (0.1, 2.0)}, (0.5, 0.1), cartpole,
        {"length": (-0.211, "e-Free"), "mass": (0.973, "BayesSim RFF")},
    ),
    "Acrobot": Row(
        {"mass_1": (0.5, 2.0), "mass_2": (0.5, 2.0), "length_1": (0.1, 1.5), "length_2": (0.5, 1.5)},
        (1.0, 1.0, 1.0, 1.0), acrobot,
        {
            "mass_1": (2.046, "BayesSim RFF"), "mass_2": (2.237, "e-Free"), "length_1": (2.421, "rejection ABC"),
            "length_2": (-0.148, "BayesSim RFF"),
        },
    ),
}  # fmt: skip


@partial(jax.jit, static_argnums=(0, 1, 2))
def statistics(name: str, summary: str, lags: int, key: Array, thetas: Array) -> Array:
    """Summary averaged over 10 rollouts at each of thetas [n, d] -> [n, D]."""
    summarize = summarizers.get(summary, **({"lags": lags} if lags else {}))

    def one(inputs: tuple[Array, Array]) -> Array:
        key, theta = inputs
        rollouts = jax.vmap(lambda k: summarize(*ROWS[name].simulate(k, theta)))(jax.random.split(key, ROLLOUTS))
        return jnp.mean(rollouts, axis=0)

    return jax.lax.map(one, (jax.random.split(key, thetas.shape[0]), thetas), batch_size=500)


@partial(jax.jit, static_argnums=2)
def cells(posteriors: Distribution, thetas: Array, names: tuple[str, ...]) -> Array:
    """Marginal log density of each parameter at thetas [n, d] -> [n, d]."""

    def one(q: Distribution, theta: Array) -> Array:
        return jnp.stack([q.marginal((name,)).log_prob(theta[i : i + 1]) for i, name in enumerate(names)])

    return jax.vmap(one)(posteriors, thetas)


def measure(
    name: str, seed: int, simulations: int, summary: str, lags: int, settings: InferenceSettings
) -> Iterator[dict[str, Any]]:
    """One line per parameter."""
    row, prior = ROWS[name], Distribution.prior(ROWS[name].space)
    keys = jax.random.split(jax.random.PRNGKey(1000 + seed), 6)
    thetas, truths = prior.sample(keys[0], simulations), prior.sample(keys[1], TRUTHS)
    truths = jnp.concatenate([truths, jnp.asarray([row.truth], jnp.float32)])
    x, seen = (statistics(name, summary, lags, k, t) for k, t in ((keys[2], thetas), (keys[3], truths)))
    wall = time.perf_counter()
    state, _ = fit(keys[4], init(keys[5], settings, row.space, x.shape[1]), thetas, x)
    jax.block_until_ready(state.params)
    wall = time.perf_counter() - wall
    posteriors = checks.conditioned(state, seen)  # as the loop uses it: what was not identified keeps its prior
    score = np.asarray(cells(posteriors, truths, tuple(row.ranges)))
    level = np.asarray(calibration.ranks(jax.random.PRNGKey(3), posteriors, truths).level)[:-1]
    for i, (parameter, (low, high)) in enumerate(row.ranges.items()):
        best, method = row.published[parameter]
        yield {
            "problem": name, "parameter": parameter, "seed": seed, "simulations": simulations, "summary": summary,
            "lags": lags,
            "log q at the one truth": round(float(score[-1, i]), 3), "prior": round(-float(np.log(high - low)), 3),
            "mean log q": round(float(score[:-1, i].mean()), 3), "truths": TRUTHS,
            "published": best, "by": method, "identified": bool(state.identified[i]),
            "coverage 50/80/95, all parameters": [round(float(np.mean(level <= p)), 3) for p in (0.5, 0.8, 0.95)],
            "wall s with compilation": round(wall, 2),
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--summary", default="corrdiff", help="of the trajectory; the paper's is corrdiff")
    parser.add_argument("--lags", type=int, default=0, help="of corr and corrdiff; the paper has none")
    args = parser.parse_args()
    for name in args.problems:
        for seed in range(args.first, args.first + args.seeds):
            for row in measure(name, seed, args.simulations, args.summary, args.lags, InferenceSettings()):
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
