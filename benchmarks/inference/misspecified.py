"""Is a real trajectory flagged that no simulation produces? Rates on fresh cases, a new theta from the prior for each.

    python benchmarks/inference/misspecified.py --seeds 5

The damped pendulum of problems.py (40 noisy angles and velocities in 2 s), driven hard enough that its motor
matters. The faults are none of its parameters: commands or measurements 50 ms late, an angle that is read wrong by
0.15 rad, friction that sticks, noise of twice and of half the assumed size, and two sizes that are nearer. `flagged`
counts p < 0.05, trajectories one by one; `flagged where moved` only those that the fault moves by more than the noise
(rms over the trajectory). Coverage is that of the posterior at the same cases.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import FitState, InferenceSettings, calibration, condition, fit, init, misspecification
from bayessim_mjx.parameters import Parameter, ParameterSpace

RANGES = (("length", 0.3, 1.5), ("mass", 0.3, 2.0), ("damping", 0.02, 0.5))
SPACE = ParameterSpace([Parameter(name, (low + high) / 2, low, high) for name, low, high in RANGES])
NOISE = np.float32([0.05, 0.2])  # rad, rad/s
STEP, STEPS, SEEN = 0.01, 200, 5  # s, steps, steps from one measurement to the next


@dataclass(frozen=True)
class Reality:
    """What differs from the simulator."""

    delay: float = 0.0  # s, of the command
    late: float = 0.0  # s, of the measurement
    bias: float = 0.0  # rad, of the measured angle
    friction: float = 0.0  # N m, dry
    noise: float = 1.0  # times the assumed one


FAULTS = {
    "nothing": Reality(),
    "delay 50 ms": Reality(delay=0.05),
    "measured 50 ms late": Reality(late=0.05),
    "angle bias 0.15 rad": Reality(bias=0.15),
    "friction that sticks": Reality(friction=2.0),
    "noise x 2": Reality(noise=2.0),
    "noise x 1.5": Reality(noise=1.5),
    "noise x 0.67": Reality(noise=0.67),
    "noise x 0.5": Reality(noise=0.5),
}


def torque(t: Array) -> Array:
    """Multisine of 1.2, 3.1 and 5.3 Hz, N m: 50 ms of it are more than the noise at every theta."""
    return 4.0 * (jnp.sin(7.5 * t) + jnp.sin(19.5 * t + 1) + jnp.sin(33.3 * t + 2))


def motion(theta: Array, real: Reality) -> Array:
    """Angle and velocity [40, 2] without noise: q'' = -(9.81 / L) sin q - (b q' - u) / (m L^2) from q = 1."""
    length, mass, damping = theta
    inertia = mass * length**2

    def step(state: tuple[Array, Array], t: Array) -> tuple[tuple[Array, Array], Array]:
        q, v = state
        # no command has come through yet before the delay
        u = jnp.where(t >= real.delay, torque(t - real.delay), 0.0)
        v = v + STEP * (-9.81 / length * jnp.sin(q) - (damping * v - u) / inertia)
        # dry friction takes what speed there is, down to none: it sticks
        v = jnp.sign(v) * jnp.maximum(jnp.abs(v) - STEP * real.friction / inertia, 0.0)
        q = q + STEP * v
        return (q, v), jnp.stack([q, v])

    first = jnp.array([1.0, 0.0])
    _, states = jax.lax.scan(step, tuple(first), STEP * jnp.arange(STEPS))
    seen = SEEN * np.arange(1, STEPS // SEEN + 1) - round(real.late / STEP)  # late: an older state
    return jnp.concatenate([first[None], states])[seen]


@partial(jax.jit, static_argnums=(1, 2))
def pairs(key: Array, n: int, real: Reality = FAULTS["nothing"]) -> tuple[Array, Array]:
    """theta [n, 3] from the prior, measurements [n, 80]."""
    key_theta, key_noise = jax.random.split(key)
    thetas = Distribution.prior(SPACE).sample(key_theta, n)
    clean = jax.vmap(lambda theta: motion(theta, real))(thetas)
    measured = clean + jnp.array([real.bias, 0.0]) + real.noise * NOISE * jax.random.normal(key_noise, clean.shape)
    return thetas, measured.reshape(n, -1)


@partial(jax.jit, static_argnums=1)
def moved(thetas: Array, real: Reality) -> Array:
    """Rms over each trajectory of what the fault does to it, in noises: thetas [n, 3] -> [n]."""
    gap = jax.vmap(lambda theta: motion(theta, real) - motion(theta, FAULTS["nothing"]))(thetas)
    gap = (gap + jnp.array([real.bias, 0.0])) / NOISE
    return jnp.sqrt(jnp.mean(gap**2, axis=(1, 2)))


def learnt(seed: int, simulations: int, settings: InferenceSettings) -> tuple[FitState, Array, Array]:
    """The network and what it was fitted on."""
    key, key_init, key_fit = jax.random.split(jax.random.PRNGKey(seed), 3)
    thetas, x = pairs(key, simulations)
    state, _ = fit(key_fit, init(key_init, settings, SPACE, x.shape[1]), thetas, x)
    return state, thetas, x


def rows(seed: int, simulations: int, cases: int, settings: InferenceSettings) -> Iterator[dict[str, Any]]:
    """One row per fault: `cases` trajectories, each at a theta of its own and tested by itself."""
    state, thetas, x = learnt(seed, simulations, settings)
    held = pairs(jax.random.PRNGKey(10_000 + seed), 1000)[1]
    for i, (name, real) in enumerate(FAULTS.items()):
        truth, seen = pairs(jax.random.PRNGKey(20_000 + 100 * seed + i), cases, real)
        wall = time.perf_counter()
        found = misspecification.detect(state, (thetas, x, simulations), held, seen)
        wall = time.perf_counter() - wall
        level = np.asarray(calibration.ranks(jax.random.PRNGKey(3), condition(state, seen), truth).level)
        flagged, by = found.p < misspecification.FLAGGED, np.asarray(moved(truth, real))
        visible = by > 1 if by.any() else np.ones(cases, bool)  # noise moves nothing
        yield {
            "fault": name, "seed": seed, "moved by noises": round(float(np.median(by)), 2),
            "flagged": round(float(np.mean(flagged)), 3), "cases": cases,
            "flagged where moved": round(float(np.mean(flagged[visible])), 3), "moved": int(visible.sum()),
            "by score": [round(float(v), 3) for v in np.mean(found.parts < misspecification.FLAGGED, axis=0)],
            "coverage 50/80/95": [round(float(np.mean(level <= p)), 3) for p in (0.5, 0.8, 0.95)],
            "s": round(wall, 2),
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--simulations", type=int, default=10_000)
    parser.add_argument("--cases", type=int, default=400)
    args = parser.parse_args()
    for seed in range(args.first, args.first + args.seeds):
        for row in rows(seed, args.simulations, args.cases, InferenceSettings()):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
