"""Generalised advantage estimation (Schulman et al. 2016) with the time limit done right (Pardo et al. 2018)."""

import jax


def gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    gamma: float,
    lam: float,
    unroll: int = 1,
) -> tuple[jax.Array, jax.Array]:
    """Advantages and returns, [T, ...] each, from time-major arrays [T, ...].

    `next_value` is the value of the *true* next observation, before any reset: after a termination the value is 0,
    after a truncation (time limit) it is the critic's. Both end the sum of an episode.
    unroll: steps per turn of the loop.
    """
    # delta_t = r_t + gamma (1 - terminated_t) V(s_{t+1}) - V(s_t)
    delta = reward + gamma * (1 - terminated) * next_value - value
    # A_t = delta_t + gamma lam (1 - ended_t) A_{t+1}
    decay = gamma * lam * (1 - terminated) * (1 - truncated)

    def step(advantage: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        advantage = now[0] + now[1] * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(step, 0.0 * delta[0], (delta, decay), reverse=True, unroll=unroll)
    return advantage, advantage + value
