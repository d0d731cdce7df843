"""The simulator at hidden parameters, standing in for hardware."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.env import Env
from bayessim_mjx.inference.summaries import Summarizer
from bayessim_mjx.keys import branch
from bayessim_mjx.logs import Channels
from bayessim_mjx.loop.collection import POLICY_DEPENDENT, Seen, named, policy_function, summarise, tiled
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, replay, rollout


@dataclasses.dataclass(frozen=True, eq=False)  # compared by identity: static under jit
class Surrogate:
    """The simulator at hidden parameters, standing in for hardware (`env.realParams`)."""

    env: Env
    space: ParameterSpace
    weights: np.ndarray  # [K]
    means: np.ndarray  # [K, d]
    sds: np.ndarray  # [K, d]
    policy_name: str
    length: int
    noise: float  # standard deviation of the noise on observations, in simulation and in reality
    summarizer: Summarizer
    ends: tuple[np.ndarray, np.ndarray] | None = None  # lowest, highest theta [d]; None: those of `space`

    @property
    def truth(self) -> np.ndarray:
        """Mean of the heaviest component [d]."""
        return self.means[int(np.argmax(self.weights))]

    def truth_of(self, keys: list[Array], count: int) -> np.ndarray:
        """What the trajectories `real(key, .., count, ..)` of these keys can tell [d]: the mean of their theta.

        Parameters vary from trajectory to trajectory (`env.realParams.stds`), by more than a posterior may be wide.
        Those of the heaviest component count; its mean where it made none.
        """
        drawn = [self._drawn(jax.random.split(key)[0], count) for key in keys]
        component, theta = (
            np.concatenate([np.asarray(part, float) for part in parts]) for parts in zip(*drawn, strict=True)
        )
        heaviest = component == np.argmax(self.weights)
        return theta[heaviest].mean(0).astype(np.float32) if heaviest.any() else self.truth

    @property
    def supply(self) -> int | None:
        """How many real trajectories there are; None: as many as asked for."""
        return None

    @property
    def policy_dependent(self) -> bool:
        """Whether the trajectories, simulated and real, are made by the policy of their round."""
        return self.policy_name in POLICY_DEPENDENT

    @property
    def memory(self) -> int:
        """Numbers of memory at the end of the policy's actions (`rl.recurrent`)."""
        return getattr(self.env, "memory_size", 0)

    @property
    def channels(self) -> Seen:
        """What the summarizer sees: observations and actions."""
        (size,) = self.env.observation_size["policy"]
        states = named(getattr(self.env, "observation_names", ()), size, "observation")
        model = getattr(self.env, "mj_model", None)
        commands = () if model is None else Channels.of(model).actuators
        return Seen(self.length, states, named(commands, self.env.action_size - self.memory, "action"))

    def sample(self, key: Array, count: int) -> Array:
        """theta [count, d] of the surrogate, inside the box, or between `ends`."""
        return self._drawn(key, count)[1]

    def _drawn(self, key: Array, count: int) -> tuple[Array, Array]:
        """Components [count] and their theta [count, d]."""
        k_component, k_noise = jax.random.split(key)
        component = jax.random.choice(k_component, len(self.weights), (count,), p=jnp.asarray(self.weights))
        noise_ = jax.random.normal(k_noise, (count, len(self.space)))
        theta = jnp.asarray(self.means)[component] + jnp.asarray(self.sds)[component] * noise_
        low, high = self.ends or (self.space.low, self.space.high)
        return component, jnp.clip(theta, low, high).astype(jnp.float32)

    def simulate(self, key: Array, thetas: Array, policy: Policy) -> Array:
        """Features [N, D] of simulated trajectories at `thetas`."""
        return summarise(self.summarizer, self._observe(key, thetas, policy))

    @property
    def noisy(self) -> bool:
        """Whether sensors add anything."""
        return self.noise > 0

    def measured(self, key: Array, thetas: Array, policy: Policy, draws: int) -> Array:
        """Features [N, draws, D] of trajectories at `thetas`, each measured so often; first those of `simulate`."""
        k_roll, k_noise = jax.random.split(key)
        clean = self._acted(k_roll, thetas, policy)

        def again(draw: Array) -> Array:
            return summarise(self.summarizer, self._noisy(jnp.where(draw > 0, branch(k_noise, draw), k_noise), clean))

        found = jax.lax.map(again, jnp.arange(draws, dtype=jnp.uint32))
        return jnp.moveaxis(found, 0, 1)

    def _observe(self, key: Array, thetas: Array, policy: Policy) -> Trajectory:
        k_roll, k_noise = jax.random.split(key)
        return self._noisy(k_noise, self._acted(k_roll, thetas, policy))

    def _acted(self, key: Array, thetas: Array, policy: Policy) -> Trajectory:
        """Trajectories without measurement noise."""
        actions = self.env.action_size
        act = policy_function(self.policy_name, policy, actions, self.memory)
        trajectory = rollout(self.env, act, key, thetas, self.length)
        return dataclasses.replace(trajectory, action=trajectory.action[..., : actions - self.memory])

    def _noisy(self, key: Array, trajectory: Trajectory) -> Trajectory:
        seen = trajectory.observation
        return dataclasses.replace(trajectory, observation=seen + self.noise * jax.random.normal(key, seen.shape))

    def real(self, key: Array, first: int, count: int, policy: Policy) -> tuple[Array, Trajectory]:
        """`count` real trajectories and their features [count, D]; `first` of them were asked for before."""
        del first
        k_theta, k_roll = jax.random.split(key)
        trajectory = self._observe(k_roll, self.sample(k_theta, count), policy)
        return summarise(self.summarizer, trajectory), trajectory

    def repeated(self, first: int, real: Trajectory, thetas: Array) -> dict[str, Array]:
        """The first of the trajectories `real` replayed at thetas [n, d]: its motion, see `rollout.replay`."""
        del first
        first_rows = (real.qpos[:, 0], real.qvel[:, 0], real.command)
        qpos0, qvel0, command = (tiled(x[0], len(thetas)) for x in first_rows)
        return replay(self.env.physics, qpos0, qvel0, command, thetas)  # type: ignore[attr-defined]
