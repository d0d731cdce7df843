"""What is refused before anything is compiled: settings, environments and machines that do not go together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np
from jax.sharding import Mesh

from bayessim_mjx import memory
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import catalogue, sharding
from bayessim_mjx.rl.extension import Learner
from bayessim_mjx.rl.groups import size_of
from bayessim_mjx.rollout import ring, traced

if TYPE_CHECKING:
    from bayessim_mjx.env import Env


def check(env: Env, config: PPOConfig, mesh: Mesh | None = None) -> None:
    """Refuse what does not go together."""
    if "policy" not in env.observation_size:
        raise UserError(f"observation groups {sorted(env.observation_size)}: a policy needs the group 'policy'")
    size_of(env, "policy")
    if config.policy_theta and getattr(env, "target", "") != "policy":
        raise UserError("ppo.policy_theta = True trains a teacher; the commands that can are train and play")
    if config.actor_groups != getattr(env, "actor_groups", ()):
        given = list(config.actor_groups)
        raise UserError(f"ppo.actor_groups = {given}: the commands that show an actor other groups are train and play")
    if config.memory_size != getattr(env, "memory_size", 0):
        raise UserError(
            f"ppo.memory = {config.memory}: the environment has to carry the memory on, see rl.recurrent.remembering"
        )
    learner = catalogue.learner(env, config, mesh)
    if config.shared_trunk and learner.critic_group != "policy":
        raise UserError(
            f"ppo.shared_trunk = True: {type(learner.env).__name__} shows its critic other observations than its "
            "policy, so they need a network each; set it to False"
        )
    for extension in learner.extensions:
        extension.check(learner)
    _check_shares(config, mesh)
    _check_memory(learner)


def _check_shares(config: PPOConfig, mesh: Mesh | None) -> None:
    """Refuse numbers of worlds and minibatches that the devices cannot share evenly."""
    devices, worlds = sharding.count(mesh), config.num_envs
    if worlds % (devices * ring(worlds)):
        raise UserError(
            f"ppo.num_envs = {worlds} cannot be shared evenly by {devices} devices; give a multiple of {32 * devices}"
        )
    part = (worlds if config.memory else worlds * config.num_steps // max(1, config.segment)) // config.num_minibatches
    if part % devices:
        what = "sequences" if config.memory else "segments" if config.segment else "transitions"
        raise UserError(
            f"ppo.num_minibatches = {config.num_minibatches} makes minibatches of {part} {what}, which {devices} "
            "devices cannot share evenly"
        )


def _check_memory(learner: Learner) -> None:
    """Refuse worlds whose states (and as many resets) and one collection do not fit into a device's memory."""
    env, config = learner.env, learner.config
    key, theta = jax.random.PRNGKey(0), np.asarray(env.space.nominal, np.float32)
    world = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(traced(env.reset), key, theta)))
    seen = sum(size_of(env, group) for group in {"policy", learner.critic_group})
    # observations before and after; actions, rewards, values ...; the critic judges all steps at once
    step = 4 * (2 * seen + 3 * env.action_size + 8 + max(config.hidden_critic, default=0))
    share = config.num_envs / sharding.count(learner.mesh)
    what = f"ppo.num_envs = {config.num_envs} (env.numEnvs) worlds, ppo.num_steps = {config.num_steps}"
    room = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    memory.refuse([(what, share * (2 * world + config.num_steps * step))], room)
